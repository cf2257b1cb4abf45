"""Slow twins: simple loops as references for fast code."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.terrain import Terrain
from blocksar.constants import SPEED_OF_LIGHT


@lru_cache(maxsize=4)
def geometry(collection: Collection) -> Geometry:
    return Geometry(collection=collection)


def lit(collection: Collection, pulse: int, x: float, y: float) -> bool:
    """Return whether the beam lights a ground point at a pulse, by the definition of the store."""
    if collection.beam_axis is not None:
        within = abs(offset(collection, pulse, x, y)) <= (collection.beam_width or 0.0) / 2
        return within and on_side(collection, pulse, x, y)
    if collection.beam_width is None:
        return True
    yaw = float(geometry(collection).yaw(np.array(x), np.array(y)))
    away = yaw - collection.beam_azimuth[pulse]
    away = np.arctan2(np.sin(away), np.cos(away))
    return bool(abs(away) <= collection.beam_width / 2)


def on_side(collection: Collection, pulse: int, x: float, y: float) -> bool:
    """Whether a point is on the side of the track that the antenna lights: of the vertical plane through its axis."""
    if collection.beam_axis is None or collection.side_of_track is None:
        return True
    ahead, position = collection.beam_axis[pulse], collection.antenna_position
    middle = collection.n_pulse // 2
    if collection.beam_axis[middle] @ (position[middle + 1] - position[middle]) < 0:
        ahead = -ahead
    left = float(np.cross(ahead, np.array([x, y, 0.0]) - position[pulse])[2])
    return left >= 0 if collection.side_of_track == "left" else left <= 0


def ray_clearance(terrain: Terrain, antenna: NDArray[np.float64], point: NDArray[np.float64]) -> float:
    """Step along the ray from a point (3,) to the antenna (3,), m, every metre: its least height above the ground."""
    way = float(np.linalg.norm(antenna[:2] - point[:2]))
    part = np.arange(1.0, min(way, 3000.0)) / way
    ray = point + part[:, None] * (antenna - point)
    above = ray[:, 2] - terrain(ray[:, 0], ray[:, 1])
    return float(above[np.isfinite(above)].min(initial=np.inf))


def offset(collection: Collection, pulse: int, x: float, y: float) -> float:
    """Angle of a ground point off the beam's centre, by the definition of the store, rad."""
    if collection.beam_axis is None or collection.beam_steering is None:
        away = float(geometry(collection).yaw(np.array(x), np.array(y))) - collection.beam_azimuth[pulse]
        return float(np.arctan2(np.sin(away), np.cos(away)))
    sight = np.array([x, y, collection.ground_height]) - collection.antenna_position[pulse]
    sine = float((sight * collection.beam_axis[pulse]).sum()) / float(np.linalg.norm(sight))
    return math.asin(sine) - float(collection.beam_steering[pulse])


def gain(collection: Collection, pulse: int, x: float, y: float) -> float:
    """Two-way amplitude of the antenna's patterns."""
    value = 1.0
    if collection.beam_pattern is not None:
        assert collection.beam_offset is not None
        value *= float(np.interp(offset(collection, pulse, x, y), collection.beam_offset, collection.beam_pattern))
    if collection.elevation_pattern is not None:
        assert collection.elevation is not None
        height = float(collection.antenna_position[pulse, 2]) - collection.ground_height
        down = math.asin(height / distance(collection, pulse, x, y))
        value *= float(np.interp(down, collection.elevation, collection.elevation_pattern))
    return value


def distance(collection: Collection, pulse: int, x: float, y: float) -> float:
    point = np.array([x, y, collection.ground_height])
    return float(np.linalg.norm(point - collection.antenna_position[pulse]))


def phase_history(
    collection: Collection, targets: Iterable[tuple[float, float, complex]], pulses: Iterable[int] | None = None
) -> NDArray[np.complex128]:
    """Samples of targets (x, y, reflectivity), (n_pulse, n_range_frequency), by the formula of the contract."""
    chosen, targets = list(range(collection.n_pulse) if pulses is None else pulses), list(targets)
    signal = np.zeros((len(chosen), collection.n_range_frequency), np.complex128)
    wavenumber = 4 * np.pi * (collection.carrier + collection.range_frequency) / SPEED_OF_LIGHT
    for row, pulse in enumerate(chosen):
        for x, y, sigma in targets:
            if lit(collection, pulse, x, y):
                away = distance(collection, pulse, x, y) - collection.reference_range[pulse]
                signal[row] += gain(collection, pulse, x, y) * sigma * np.exp(-1j * wavenumber * away)
    return signal


def raw_echo(
    collection: Collection,
    targets: Iterable[tuple[float, float, complex]],
    *,
    fast_time: NDArray[np.float64],
    chirp_rate: float,
    pulse_width: float,
    pulses: Iterable[int],
) -> NDArray[np.complex128]:
    """Chirped echo of targets over fast time, (n_pulse, n_fast_time)."""
    chosen, targets = list(pulses), list(targets)
    echo = np.zeros((len(chosen), fast_time.size), np.complex128)
    for row, pulse in enumerate(chosen):
        for x, y, sigma in targets:
            if lit(collection, pulse, x, y):
                r = distance(collection, pulse, x, y)
                tau = fast_time - 2 * r / SPEED_OF_LIGHT
                chirp = np.where(np.abs(tau) <= pulse_width / 2, np.exp(1j * np.pi * chirp_rate * tau**2), 0)
                away = r - collection.reference_range[pulse]
                echo[row] += sigma * chirp * np.exp(-4j * np.pi * collection.carrier * away / SPEED_OF_LIGHT)
    return echo


def back_projection(
    collection: Collection,
    signal: NDArray[Any],
    x: NDArray[Any],
    y: NDArray[Any],
    *,
    in_range: Callable[[Any], Any] = np.ones_like,
    in_azimuth: Callable[[Any], Any] = np.ones_like,
) -> NDArray[np.complex128]:
    """Mean over lit pulses and all frequencies of signal exp(+4j pi (fc + f) / c (R - reference_range)).

    It is weighted by in_range(v) and in_azimuth(v), with v in -1 .. 1 over the band and over the beam (or the pulses of
    a beam that is not steered). With patterns, the sum of weights is one of weights times their gain.

    NaN samples are left out of the mean. The image is NaN where nothing valid is lit, or where a lit pulse sees the
    pixel outside |R - reference_range| <= c / (4 df).

    Parameters
    ----------
    collection : Collection
    signal : (n_pulse, n_range_frequency) complex
    x, y : (...) float
        m, of one shape.

    Returns
    -------
    (...) complex128
    """
    light = 299_792_458.0
    frequency = collection.carrier + collection.range_frequency
    half_window = light / (4 * collection.range_frequency_step)
    theta = Geometry(collection=collection).yaw(x, y)
    n = collection.n_range_frequency
    band = in_range((2 * np.arange(n) + 1.0 - n) / n)
    image = np.empty(x.shape, np.complex128)
    for pixel in np.ndindex(x.shape):
        total, count, outside = 0j, 0.0, False
        for pulse in range(collection.n_pulse):
            place = (2 * pulse + 1 - collection.n_pulse) / collection.n_pulse
            if collection.beam_axis is not None:
                if not lit(collection, pulse, x[pixel], y[pixel]):
                    continue
                place = 2 * offset(collection, pulse, x[pixel], y[pixel]) / (collection.beam_width or 0.0)
            elif collection.beam_width is not None:
                away = theta[pixel] - collection.beam_azimuth[pulse]
                away = away - 2 * np.pi * np.rint(away / (2 * np.pi))
                if not abs(away) <= collection.beam_width / 2:
                    continue
                place = 2 * away / collection.beam_width
            weights = band * in_azimuth(np.array(place))
            point = np.array([x[pixel], y[pixel], collection.ground_height])
            distance = np.linalg.norm(point - collection.antenna_position[pulse])
            distance -= collection.reference_range[pulse]
            outside = outside or abs(distance) > half_window
            terms = signal[pulse] * np.exp(4j * np.pi * frequency / light * distance)
            valid = ~np.isnan(terms)
            total += (weights * terms)[valid].sum()
            count += weights[valid].sum() * gain(collection, pulse, x[pixel], y[pixel])
        image[pixel] = total / count if count and not outside else np.nan
    return image
