"""Slow twins: obviously right loops that fast code is compared with."""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.constants import SPEED_OF_LIGHT


@lru_cache(maxsize=4)
def geometry(collection: Collection) -> Geometry:
    return Geometry(collection=collection)


def lit(collection: Collection, pulse: int, x: float, y: float) -> bool:
    """Whether the beam lights a ground point at a pulse, by the definition of the store."""
    if collection.beam_width is None:
        return True
    yaw = float(geometry(collection).yaw(np.array(x), np.array(y)))
    away = yaw - collection.beam_azimuth[pulse]
    away = np.arctan2(np.sin(away), np.cos(away))
    return bool(abs(away) <= collection.beam_width / 2)


def distance(collection: Collection, pulse: int, x: float, y: float) -> float:
    point = np.array([x, y, collection.ground_height])
    return float(np.linalg.norm(point - collection.antenna_position[pulse]))


def phase_history(
    collection: Collection, targets: Iterable[tuple[float, float, complex]], pulses: Iterable[int] | None = None
) -> NDArray[np.complex128]:
    """Samples of targets (x, y, reflectivity), (n_pulse, n_range_frequency), straight from the contract."""
    chosen, targets = list(range(collection.n_pulse) if pulses is None else pulses), list(targets)
    signal = np.zeros((len(chosen), collection.n_range_frequency), np.complex128)
    wavenumber = 4 * np.pi * (collection.carrier + collection.range_frequency) / SPEED_OF_LIGHT
    for row, pulse in enumerate(chosen):
        for x, y, sigma in targets:
            if lit(collection, pulse, x, y):
                away = distance(collection, pulse, x, y) - collection.reference_range[pulse]
                signal[row] += sigma * np.exp(-1j * wavenumber * away)
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
