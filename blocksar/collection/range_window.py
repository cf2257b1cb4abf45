"""The ranges at each yaw that a collection's samples tell apart, and of whose pulses a raw echo recorded enough."""

from __future__ import annotations

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.collection.beam import dwell_at
from blocksar.collection.geometry import Geometry
from blocksar.collection.outside import WINDOW_GUARD, why_not_recorded, why_outside
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import OutsideSwath


def range_window(
    geometry: Geometry, yaw: FloatArray, within: tuple[float, float] | None
) -> tuple[FloatArray, FloatArray]:
    """Nearest and farthest epoch range at each yaw whose echo stays in the unambiguous window over the dwell, m.

    Of a raw echo, and whose pulses are recorded: whole over the dwell, or where parts count, in part at any time of it.

    Raises
    ------
    OutsideSwath
        If there are none at some yaw, or none `within` two ranges, m, if these are given.
    """
    collection = geometry.collection
    half = collection.range_window / 2 - WINDOW_GUARD * SPEED_OF_LIGHT / (2 * collection.bandwidth)
    reference = np.interp(geometry.epoch, collection.time, collection.reference_range)
    floor = float(geometry.epoch_position[2] - collection.ground_height)
    spread = np.ptp(collection.reference_range) + np.ptp(geometry.track.position(collection.time), axis=0).max()
    low = max(reference - half - spread, floor * 1.0005)
    trial = np.linspace(low, reference + half + spread, 41)
    point = geometry.ground_point(trial[None, :], yaw[:, None])
    first, last = dwell_at(geometry, yaw[:, None], trial[None, :])
    u = np.linspace(0, 1, 9)
    time = first[..., None] + (last - first)[..., None] * u
    if collection.has_axis:  # where nothing is lit, times lie outside
        time = np.clip(time, collection.time[0], collection.time[-1])
    rng, _ = geometry.range_history(point[:, :, None, :], time)
    held = rng - np.interp(time, collection.time, collection.reference_range)
    nearest, farthest = held.min(axis=2), held.max(axis=2)
    if half <= 0 or not np.isfinite(nearest).any(axis=1).all():
        raise OutsideSwath(why_outside(collection, half, within, held, trial))
    ends = within or (float(trial[0]), float(trial[-1]))
    near, far = (np.full(yaw.size, end) for end in ends)
    if (recorded := collection.recorded) is not None:
        least, most = rng.min(axis=2), rng.max(axis=2)
        if recorded.partial:
            nearest_held, farthest_held = _between(most, least, trial, *recorded.reached)
        else:
            nearest_held, farthest_held = _between(least, most, trial, *recorded.whole)
        near, far = np.maximum(near, nearest_held), np.minimum(far, farthest_held)
        if not (far > near).all():
            raise OutsideSwath(why_not_recorded(recorded, within))
    first, last = _between(nearest, farthest, trial, -half, half)
    near, far = np.maximum(near, first), np.minimum(far, last)
    if not (far > near).all():
        raise OutsideSwath(why_outside(collection, half, within, held, trial))
    return near, far


def _between(
    nearest: FloatArray, farthest: FloatArray, trial: FloatArray, low: float, high: float
) -> tuple[FloatArray, FloatArray]:
    """The trial range at which `nearest` (n_yaw, n_range) is low, and that at which `farthest` is high, at each yaw."""
    known = [np.isfinite(row) for row in nearest]
    return (
        np.array([np.interp(low, row[held], trial[held]) for row, held in zip(nearest, known, strict=True)]),
        np.array([np.interp(high, row[held], trial[held]) for row, held in zip(farthest, known, strict=True)]),
    )
