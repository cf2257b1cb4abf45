"""What is said of a grid that lies outside the swath: why, and what to do."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.collection.recorded import RecordedRanges
from blocksar.collection.units import describe_pointing, find_meant
from blocksar.errors import OutsideSwath

WINDOW_GUARD = 8  # range cells kept free at either end of the range window
MOVE = "move the grid"


def why_outside(
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


def why_not_recorded(recorded: RecordedRanges, within: tuple[float, float] | None) -> str:
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


@contextmanager
def remedied(geometry: Geometry, grid: Grid) -> Iterator[None]:
    """Say what to do about a grid that is found outside the swath."""
    try:
        yield
    except OutsideSwath as error:
        pointing = f"{describe_pointing(geometry, grid)}; " if geometry.collection.has_axis else ""
        raise OutsideSwath(str(error).replace(MOVE, pointing + remedy(geometry, grid))) from None


def remedy(geometry: Geometry, grid: Grid) -> str:
    """What to do about a grid outside the swath.

    A unit may be wrong (`units.find_meant`). On a terrain these may be wrong heights: of those in the swath the middle
    is told, z = height of the antenna - sqrt(reference range^2 - distance^2).
    """
    collection = geometry.collection
    meant = find_meant(collection, grid, on_terrain=geometry.terrain is not None)
    if meant is not None or geometry.terrain is None:
        return meant or MOVE
    x, y = (np.asarray(low + high) / 2 for low, high in ((grid.x0, grid.x1), (grid.y0, grid.y1)))
    reference = np.interp(geometry.epoch, collection.time, collection.reference_range)
    squares = reference**2 - float(np.sum((np.array([x, y]) - geometry.nadir[:2]) ** 2))
    if squares <= 0:
        return MOVE
    low, high = geometry.terrain.limits
    return (
        f"the terrain lies at z = {low:.6g} .. {high:.6g} m, but the middle of what was recorded at "
        f"{float(geometry.epoch_position[2]) - math.sqrt(squares):.1f} m there: correct its heights (unit, datum), or "
        f"{MOVE}{''.join(f'; {remark}' for remark in geometry.terrain.remarks)}"
    )
