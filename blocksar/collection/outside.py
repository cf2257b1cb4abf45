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


@contextmanager
def remedied(geometry: Geometry, grid: Grid) -> Iterator[None]:
    """Say what to do about a grid that is found outside the swath."""
    try:
        yield
    except OutsideSwath as error:
        raise OutsideSwath(str(error).replace(MOVE, remedy(geometry, grid))) from None


def remedy(geometry: Geometry, grid: Grid) -> str:
    """What to do about a grid outside the swath.

    Its numbers may mean km, if its middle would then be in the swath. On a terrain these may be wrong heights: of those
    in the swath the middle is told, z = height of the antenna - sqrt(reference range^2 - distance^2).
    """
    collection = geometry.collection
    x, y = (500 * np.asarray(low + high) for low, high in ((grid.x0, grid.x1), (grid.y0, grid.y1)))
    reference = np.interp(geometry.epoch, collection.time, collection.reference_range)
    kilometres = abs(float(geometry.epoch_range(x, y)) - reference) <= collection.range_window / 2
    if kilometres or geometry.terrain is None:
        return "it looks like km: give metres" if kilometres else MOVE
    squares = reference**2 - float(np.sum((np.array([x, y]) / 1000 - geometry.nadir[:2]) ** 2))
    if squares <= 0:
        return MOVE
    low, high = geometry.terrain.limits
    return (
        f"the terrain lies at z = {low:.6g} .. {high:.6g} m, but the middle of what was recorded at "
        f"{float(geometry.epoch_position[2]) - math.sqrt(squares):.1f} m there: correct its heights (unit, datum), or "
        f"{MOVE}{''.join(f'; {remark}' for remark in geometry.terrain.remarks)}"
    )
