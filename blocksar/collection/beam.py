"""Which targets are lit, and when."""

from __future__ import annotations

import numpy as np

from blocksar.arrays import BoolArray, FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry


def has_full_dwell(geometry: Geometry, x: float, y: float) -> bool:
    """Whether the beam sweeps wholly over a target at x, y (m), within a pulse; true if it is not steered."""
    collection = geometry.collection
    if collection.beam_width is None:
        return True
    beam = collection.beam_azimuth
    low, high = float(beam.min()), float(beam.max())
    yaw = float(geometry.yaw(np.array(x), np.array(y)))
    yaw = (low + high) / 2 + float(np.mod(yaw - (low + high) / 2 + np.pi, 2 * np.pi)) - np.pi
    half = collection.beam_width / 2
    if low == high:
        return bool(abs(yaw - low) <= half)
    pulse = (high - low) / (collection.n_pulse - 1)
    return bool(low - pulse <= yaw - half and yaw + half <= high + pulse)


def lit_during(geometry: Geometry, yaw: FloatArray, pulses: slice) -> BoolArray:
    """Which pulses light targets at yaws (n,): (n, n_pulse)."""
    collection = geometry.collection
    beam = collection.beam_azimuth[pulses]
    if collection.beam_width is None:
        return np.ones((yaw.size, beam.size), dtype=np.bool_)
    off = np.mod(yaw[:, None] - beam + np.pi, 2 * np.pi) - np.pi
    return np.asarray(np.abs(off) <= collection.beam_width / 2)


def lit_yaw(collection: Collection) -> tuple[float, float]:
    """First and last yaw that is ever lit by a steered beam, rad."""
    half = (collection.beam_width or 0.0) / 2
    return float(collection.beam_azimuth.min() - half), float(collection.beam_azimuth.max() + half)


def lit_pulses(collection: Collection, yaw: FloatArray, valid: FloatArray) -> FloatArray:
    """Number of lit pulses at each yaw, missing ones left out: sum of `valid` (n_pulse,) over the dwell."""
    total = np.concatenate([[0.0], np.cumsum(valid)])
    if collection.beam_width is None:
        return np.full(yaw.shape, total[-1])
    beam = collection.beam_azimuth
    middle = (beam[0] + beam[-1]) / 2
    turn = middle + np.mod(yaw - middle + np.pi, 2 * np.pi) - np.pi
    sign = 1.0 if beam[-1] >= beam[0] else -1.0
    half = collection.beam_width / 2
    first = np.searchsorted(sign * beam, sign * turn - half, side="left")
    last = np.searchsorted(sign * beam, sign * turn + half, side="right")
    return total[last] - total[first]
