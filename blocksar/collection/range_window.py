"""The ranges at each yaw that a collection's samples tell apart, and of whose pulses a raw echo recorded enough."""

from __future__ import annotations

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.collection.beam import dwell_at
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.recorded import RecordedRanges
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import OutsideSwath

MOVE = "move the grid"  # what to do about one outside the swath
WINDOW_GUARD = 8  # range cells kept free at either end of the range window


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
        raise OutsideSwath(_outside(collection, half, within, held, trial))
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
            raise OutsideSwath(_not_recorded(recorded, within))
    first, last = _between(nearest, farthest, trial, -half, half)
    near, far = np.maximum(near, first), np.minimum(far, last)
    if not (far > near).all():
        raise OutsideSwath(_outside(collection, half, within, held, trial))
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


def _not_recorded(recorded: RecordedRanges, within: tuple[float, float] | None) -> str:
    """Why a raw echo has no pulse of what is lit, or no whole one."""
    where = "" if within is None else f" (the grid's ranges are {within[0]:.6g} .. {within[1]:.6g} m at the epoch)"
    (nearest, farthest), (first, last) = recorded.reached, recorded.whole
    held = f"fast_time holds echoes from ranges {nearest:.6g} .. {farthest:.6g} m"
    if recorded.partial or (within is not None and (within[1] < nearest or within[0] > farthest)):
        return f"grid lies outside the swath: {held}, and none of what is lit{where}; {MOVE}, or correct fast_time"
    whole = f"whole pulses from {first:.6g} .. {last:.6g} m" if first < last else "of no range the whole pulse"
    remedy = "give --grid for ground of which parts of pulses were recorded"
    if within is not None:
        remedy = f"{MOVE}, or leave out --whole-pulses"
    return f"grid lies outside the swath: {held}, {whole}, and no whole pulse of what is lit{where}; {remedy}"


def _outside(
    collection: Collection, half: float, within: tuple[float, float] | None, held: FloatArray, trial: FloatArray
) -> str:
    """Why no range stays in the range window while it is lit.

    `held` (n_yaw, n_range, n_time) are ranges less the reference range, of points at epoch ranges `trial`.
    """
    low, high = within or (float(trial[0]), float(trial[-1]))
    meant = (trial >= low) & (trial <= high)
    change = np.ptp(held[:, meant] if meant.any() else held, axis=-1)
    moves = float(np.min(change, where=np.isfinite(change), initial=np.inf))
    still = np.ptp(collection.reference_range) == 0
    swath = f"the range window of {collection.range_window:.6g} m about the reference range"
    where = "" if within is None else f" (the grid's ranges are {low:.6g} .. {high:.6g} m at the epoch)"
    if half <= 0:
        return (
            f"grid lies outside the swath: {swath} has {collection.n_range_frequency} range cells, of which "
            f"{WINDOW_GUARD} at either end are left free for side lobes; sample range frequency more densely"
        )
    if 2 * half < moves < np.inf:
        remedy = (
            "re-reference the samples to a range that follows the scene, reference_range = distance to its centre"
            if still
            else "let reference_range follow the scene's centre"
        )
        return (
            f"grid lies outside the swath: {swath} is shorter than the {moves:.4g} m by which ranges change while they "
            f"are lit{where}, so every point leaves it; {remedy}, or cut the collection in time"
        )
    reference = collection.reference_range
    return (
        f"grid lies outside the swath: no range stays in {swath}, {reference.min():.6g} .. {reference.max():.6g} m, "
        f"while it is lit{where}; {MOVE}"
    )
