"""Azimuth ambiguities: echoes of other places that fold onto a pixel since the PRF is below the lit Doppler band.

Two places share range and Doppler in samples at the pulses where their ranges are equal and their range rates differ by
a multiple of lambda PRF / 2. Of two antennas they are found by Newton's method. With u the unit vector to a point at
horizontal distance d, range r and azimuth phi about the nadir, the range rate is
-v u = -(d / r) |v_h| cos(phi - phi_v) + v_z h / r: at the same range and height

    cos(phi' - phi_v) = cos(phi - phi_v) -+ lambda PRF r / (2 d |v_h|).

Its ghost at the other place has the amplitude of the sum that back-projection makes of its echo there, at the pulses
that light both: the largest over a shift in Doppler, by which it may lie beside that place.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.kernels.fourier import fast_length, fft_rows
from blocksar.kernels.nonuniform import sum_phasors

SHARES = (0.05, 0.5, 0.95)  # of a grid along either side, at which ghosts are looked for
TOLD = 0.01  # amplitude below which a ghost is not told
PARTS = (1 / 4, 1 / 3, 1 / 2, 2 / 3, 3 / 4, 1.0)  # of the PRF, by which uneven pulses fold, as their pattern repeats
NEAR = 12  # parts of the PRF, within one of which either way a shift belongs to one of these
PADDING = 4  # of the transform over pulses


class Ambiguity(NamedTuple):
    """Ghost of a place at another one: its place, m, and its amplitude relative to an equal target there."""

    source: tuple[float, float]
    ghost: tuple[float, float]
    amplitude: float


def worst_ambiguity(geometry: Geometry, grid: Grid) -> Ambiguity | None:
    """Find the strongest ghost at a few places of an image, without a weighting; None if none is above TOLD.

    Where no beam is known, everything counts as lit, and only ghosts of places of the image itself are looked for.
    """
    collection = geometry.collection
    xs, ys = (low + np.array(SHARES) * (high - low) for low, high in ((grid.x0, grid.x1), (grid.y0, grid.y1)))
    found = [
        _ghost(geometry, (x, y), source)
        for x in xs.tolist()
        for y in ys.tolist()
        for source in _sources(geometry, x, y)
        if collection.steered or (grid.x0 <= source[0] < grid.x1 and grid.y0 <= source[1] < grid.y1)
    ]
    worst = max(found, key=lambda each: each.amplitude, default=None)
    return worst if worst is not None and worst.amplitude > TOLD else None


def _sources(geometry: Geometry, x: float, y: float) -> list[tuple[float, float]]:
    """Places at the range and folded Doppler of a place, at the middle of its lit pulses."""
    collection, z = geometry.collection, _height(geometry, x, y)
    orders = (-1, 1) if collection.pulses.even else (*(-part for part in PARTS), *PARTS)
    if collection.bistatic:
        from blocksar.measurement.scenery import ambiguity_place  # with what few plans need

        found = (ambiguity_place(geometry, x, y, order) for order in orders)
        return [place for place in found if place is not None]
    lit = np.flatnonzero(geometry.beam.is_lit(np.array(x), np.array(y), z=np.array(z)))
    if not lit.size or not math.isfinite(z):
        return []
    time = np.array(collection.time[lit[lit.size // 2]])
    position, velocity = geometry.track.position(time), geometry.track.velocity(time)
    away = np.array([x, y]) - position[:2]
    distance, speed = math.hypot(*away), math.hypot(*velocity[:2])
    if not distance * speed:
        return []
    rng, heading = math.hypot(distance, position[2] - z), math.atan2(velocity[1], velocity[0])
    turn = math.atan2(away[1], away[0]) - heading
    places = []
    for fold in orders:
        cosine = math.cos(turn) + fold * collection.wavelength * collection.prf / 2 * rng / (distance * speed)
        if abs(cosine) <= 1:  # on the same side of the track
            azimuth = heading + math.copysign(math.acos(cosine), math.sin(turn))
            places.append((position[0] + distance * math.cos(azimuth), position[1] + distance * math.sin(azimuth)))
    return places


def _ghost(geometry: Geometry, at: tuple[float, float], source: tuple[float, float]) -> Ambiguity:
    """Amplitude of a source's echo at a place, over the pulses that light both."""
    collection, z = geometry.collection, np.array([_height(geometry, *at)])
    pulses, (x, y) = slice(None), (np.array([a, b]) for a, b in zip(at, source, strict=True))
    lit = geometry.beam.is_lit(x, y, z=np.repeat(z, 2))
    away = np.subtract(*collection.distances(np.stack([*np.broadcast_arrays(x, y, z)], axis=-1)[:, None]))
    gain = [geometry.beam.gain(a, b, pulses, z) for a, b in zip(x[:, None], y[:, None], strict=True)]
    turns = 2 * collection.bandwidth / SPEED_OF_LIGHT * away
    echo = np.where(lit.all(axis=0), gain[1] * np.sinc(turns), 0.0)
    echo = echo * np.exp(4j * np.pi / collection.wavelength * away)
    shares = collection.pulses.shares
    if shares is None:
        padded = np.zeros((1, fast_length(PADDING * away.size)), np.complex128)
        padded[0, : away.size] = echo
        summed = fft_rows(padded, inverse=False)
        total = float(gain[0][lit[0]].sum())
    else:
        place = (collection.time - collection.time.mean()) / collection.pulse_interval  # in pulses
        n = fast_length(int(2 * PADDING * np.abs(place).max()))
        near = slice(n // 2 - n // NEAR, n // 2 + n // NEAR + 1)  # further off lie the ghosts of other parts of the PRF
        summed = sum_phasors(echo * shares, place / n, n)[near]
        total = float((gain[0] * shares)[lit[0]].sum())
    return Ambiguity(source, at, float(np.abs(summed).max()) / total if total > 0 else 0.0)


def _height(geometry: Geometry, x: float, y: float) -> float:
    return float(np.asarray(geometry.height(np.array([x]), np.array([y]))).ravel()[0])


def azimuth_ambiguities(geometries: Sequence[Geometry], grid: Grid) -> list[str]:
    """Warn of the strongest ghost of all collections; empty if there is none."""
    found = [(each, geometry) for geometry in geometries if (each := worst_ambiguity(geometry, grid)) is not None]
    if not found:
        return []
    worst, geometry = max(found, key=lambda each: each[0].amplitude)
    collection = geometry.collection
    spread = "" if collection.pulses.even else ", spread by the uneven pulses"
    places = [f"x = {x:.6g}, y = {y:.6g} m" for x, y in (worst.source, worst.ghost)]
    return [
        f"PRF {collection.prf:.6g} Hz is below the Doppler that is lit together: echoes fold{spread}, such as from "
        f"{places[0]} to {places[1]}, where their ghosts have {20 * math.log10(worst.amplitude):.0f} dB"
    ]
