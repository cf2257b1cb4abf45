"""The region that can be imaged, the default grid over it, and the seams between blocks.

Regions are given in yaw, and in range from the antenna position at the epoch.

Errors about a grid outside the swath give the reason and a remedy.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from blocksar.arrays import BoolArray, FloatArray
from blocksar.collection.axis_beam import side_of
from blocksar.collection.beam import lit_yaw, wrapped
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid, ground_resolution, ground_steps, outline
from blocksar.collection.meant import describe_pointing, find_meant
from blocksar.collection.raw_echo import RecordedRanges
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError, OutsideSwath, Unfocusable

WINDOW_GUARD = 8  # range cells kept free at either end of the range window
MOVE = "move the grid"
ROUND = 1.25 * np.pi  # rad over which a grid is seen by a track that goes round it


def why_outside(
    collection: Collection, half: float, within: tuple[float, float] | None, held: FloatArray, trial: FloatArray
) -> str:
    """Explain why no range stays in the range window while it is lit.

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
    """Explain why a raw echo recorded no pulse, or no whole pulse, from the lit ground."""
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
    """Add the remedy to errors in the block about a grid outside the swath."""
    try:
        yield
    except OutsideSwath as error:
        if (seen := seen_from(geometry.collection, grid)) > ROUND:
            raise Unfocusable(
                f"the track goes round the grid, which is seen over {np.degrees(seen):.0f} degrees, and lies on no "
                "one side of it, which yaws and ranges have to tell; take the pulses of one side"
            ) from None
        pointing = f"{describe_pointing(geometry, grid)}; " if geometry.collection.has_axis else ""
        raise OutsideSwath(str(error).replace(MOVE, pointing + remedy(geometry, grid))) from None


def seen_from(collection: Collection, grid: Grid) -> float:
    """Angle, rad, by which an unsteered antenna circles the middle of a grid; 0 if the grid leaves the range window."""
    middle = np.array([grid.x0 + grid.x1, grid.y0 + grid.y1]) / 2
    place = np.array([*middle, collection.ground_height])
    away, change = collection.antenna_position - place, collection.distances(place) - collection.reference_range
    if collection.steered or not (np.abs(change) <= collection.range_window / 2).all():
        return 0.0
    return float(np.ptp(np.unwrap(np.arctan2(away[:, 1], away[:, 0]))))


def remedy(geometry: Geometry, grid: Grid) -> str:
    """Suggest what to do about a grid outside the swath.

    A unit may be wrong (`find_meant`). On a terrain these may be wrong heights: of those in the swath the middle
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
    low = max(reference - half - spread - collection.half_baseline, floor * 1.0005)
    trial = np.linspace(low, reference + half + spread, 41)
    point = geometry.ground_point(trial[None, :], yaw[:, None])
    first, last = geometry.beam.dwell_at(yaw[:, None], trial[None, :])
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
    """Trial ranges at each yaw where `nearest` (n_yaw, n_range) equals `low`, and `farthest` equals `high`."""
    known = [np.isfinite(row) for row in nearest]
    return (
        np.array([np.interp(low, row[held], trial[held]) for row, held in zip(nearest, known, strict=True)]),
        np.array([np.interp(high, row[held], trial[held]) for row, held in zip(farthest, known, strict=True)]),
    )


# Yaws of a grid at which the lit ground of a beam about its axis is sought, yaws beyond the grid examined at a time,
# and yaws between which its ends are refined; ranges for both.
LEAST_YAWS, MOST_YAWS, YAWS_AT_ONCE, FINE_YAWS = 16, 4096, 16, 257
FEW_RANGES, LIT_RANGES = 17, 129
SIDE_ENDS = 0.02  # rad along the flight and against it, where nothing is imaged
LONG = 0.9  # of the longest dwell: less is seen with other resolution and noise
FULL_RANGES, FULL_YAWS = 33, 257  # at which the ground with full dwell is looked for
MOST_SAMPLES = 1024  # of a terrain, along each axis, whose range is computed
SEEN_AT = 64  # points along a side of a grid that are tested for being seen
LOOKED_AT = 256  # points along a side of a grid, of which those outside the window are counted


@dataclass(frozen=True, kw_only=True, eq=False)
class Region:
    """The region that can be imaged: lit yaws, and at each yaw the epoch ranges inside the range window.

    yaw (n,), rad, ascending, both ends included; near, far (n,), m.
    """

    yaw: FloatArray
    near: FloatArray
    far: FloatArray

    def limits(self, low: float, high: float) -> tuple[float, float]:
        """Nearest and farthest range between two yaws, m."""
        yaw = np.concatenate([[low], self.yaw[(self.yaw > low) & (self.yaw < high)], [high]])
        near, far = self.at(yaw)
        return float(near.min()), float(far.max())

    def at(self, yaw: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Near and far range at yaws of any shape, m, by linear interpolation."""
        return np.interp(yaw, self.yaw, self.near), np.interp(yaw, self.yaw, self.far)


Owned = Callable[[FloatArray, FloatArray], BoolArray]  # whether points x, y (n,), m, are to be imaged


class Extent(NamedTuple):
    """A box in yaw, rad, and epoch range, m."""

    low: float
    high: float
    near: float
    far: float


def plan_region(geometry: Geometry, grid: Grid | None) -> Region:
    """Find the yaws and ranges to plan for.

    Raises
    ------
    InputError
        If there is no grid where the beam is not steered, or has an axis and the side of the track is unknown, or the
        grid lies outside the swath or holds the nadir.
    """
    collection = geometry.collection
    if geometry.beam.by_yaw:
        low, high = lit_yaw(collection)
        near, far = range_window(geometry, np.linspace(low, high, 65), None)
        return Region(yaw=np.linspace(low, high, 65), near=near, far=far)
    if grid is None and collection.has_axis:
        ends = _side_yaws(geometry)
        return _joined([_lit_region(level, "the ground on the side_of_track", *ends) for level in geometry.levels])
    if grid is None:
        raise InputError(
            "grid is missing: a collection whose beam is not steered lights everything, so give --grid "
            f"x0:x1:dx,y0:y1:dy for the ground to image{_proposed(geometry)}"
        )
    x, y = outline(grid)
    if grid.x0 <= geometry.nadir[0] <= grid.x1 and grid.y0 <= geometry.nadir[1] <= grid.y1:
        raise InputError(
            f"grid {grid.x0:g}:{grid.x1:g},{grid.y0:g}:{grid.y1:g} holds the platform's nadir "
            f"({geometry.nadir[0]:.6g}, {geometry.nadir[1]:.6g}) m, about which yaw has no meaning; move it aside"
        )
    yaw = np.unwrap(geometry.yaw(x, y))
    if collection.has_axis:
        what = f"grid {grid.x0:g}:{grid.x1:g},{grid.y0:g}:{grid.y1:g}"
        ends = float(yaw.min()), float(yaw.max())
        with remedied(geometry, grid):
            return _joined([_lit_region(level, what, *ends) for level in geometry.levels])
    rng = geometry.epoch_range(*on_terrain(geometry, grid, x, y))
    slack = float(np.hypot(grid.dx, grid.dy))  # keeps the farthest pixel off the region's edge
    span, pixel = float(np.ptp(yaw)), slack / float(np.hypot(x - geometry.nadir[0], y - geometry.nadir[1]).min())
    pad = 0.01 * span if span > pixel else pixel  # a line of pixels along a ray spans no yaw
    nodes = np.linspace(yaw.min() - pad, yaw.max() + pad, 33)
    with remedied(geometry, grid):
        near, far = range_window(geometry, nodes, (float(rng.min()) - slack, float(rng.max()) + slack))
    return Region(yaw=nodes, near=near, far=far)


def _proposed(geometry: Geometry) -> str:
    """Suggest a grid about the scene's origin, for a message; empty if the origin is not in view."""
    with suppress(InputError):
        return f", such as --grid='{facing_grid(geometry).as_option}' about the point that the reference range follows"
    return ""


def imaged_side(geometry: Geometry) -> str | None:
    """Side of the track where the ground imaged by a beam about its axis lies; None if unknown.

    Without `side_of_track` that of the scene's origin, if the reference range follows the origin.
    """
    collection = geometry.collection
    if collection.side_of_track is not None:
        return collection.side_of_track
    ahead, middle = collection.antenna_position[-1] - collection.antenna_position[0], collection.n_pulse // 2
    sight = np.array([0.0, 0.0, collection.ground_height]) - collection.antenna_position[middle]
    away = abs(float(np.linalg.norm(sight)) - collection.reference_range[middle])
    return None if away > collection.range_window / 8 else side_of(ahead, sight)


def _side_yaws(geometry: Geometry) -> tuple[float, float]:
    """First and last yaw, rad, of the side of the track where the imaged ground of a beam about its axis lies.

    Raises
    ------
    InputError
        If nothing tells.
    """
    side = imaged_side(geometry)
    if side is None:
        raise InputError(
            "grid is missing: a beam about the antenna's axis (beam_axis) lights ground on both sides of the "
            "track, and the reference range does not follow the scene's origin, so give --grid x0:x1:dx,y0:y1:dy "
            "for the ground to image, or the attribute side_of_track"
        )
    ahead = geometry.collection.antenna_position[-1] - geometry.collection.antenna_position[0]
    heading = float(np.arctan2(ahead[1], ahead[0]))
    first = heading if side == "left" else heading - np.pi
    return first + SIDE_ENDS, first + np.pi - SIDE_ENDS


def _lit_region(geometry: Geometry, what: str, low: float, high: float) -> Region:
    """Find all ground that a beam about its axis lights, on the side of the track with the yaws low .. high, rad.

    `what` names these in an error.

    Ranges are those that are lit at a yaw or at its neighbours: between yaws, all that is lit is then inside.
    """
    collection = geometry.collection
    reference = float(np.interp(geometry.epoch, collection.time, collection.reference_range))
    floor = float(geometry.epoch_position[2] - collection.ground_height) * 1.0005
    ends = max(reference - collection.range_window / 2, floor), max(reference + collection.range_window / 2, floor)
    step = (collection.beam_width or 0.0) / 4

    def is_any_lit(yaw: FloatArray) -> BoolArray:
        return _lit_ranges(geometry, yaw, *(np.full(yaw.size, end) for end in ends), count=FEW_RANGES)[2]

    def first_unlit(edge: float, sign: float) -> float:
        """Step from yaw `edge` to the first yaw at which no ground is lit, at most a quarter turn."""
        for first in range(1, math.ceil(np.pi / 2 / step), YAWS_AT_ONCE):
            outwards = np.asarray(edge + sign * step * (first + np.arange(YAWS_AT_ONCE)), np.float64)
            if not (lit := is_any_lit(outwards)).all():
                return float(outwards[int(lit.argmin())])
        return edge + sign * np.pi / 2

    side = _sides(geometry, low, high)
    inside = np.linspace(low, high, min(max(math.ceil((high - low) / step), LEAST_YAWS), MOST_YAWS) + 1)
    lit = np.flatnonzero(is_any_lit(inside))
    if lit.size == 0:
        raise OutsideSwath(
            f"{what} lies outside the swath: the beam (beam_axis, beam_steering, beam_width) lights none of its yaws; "
            f"{MOVE}"
        )
    outer = first_unlit(inside[lit[0]], -1.0), first_unlit(inside[lit[-1]], 1.0)
    yaw = np.linspace(max(outer[0], side[0]), min(outer[1], side[1]), FINE_YAWS)
    near, far = range_window(geometry, yaw, None)
    lit = np.flatnonzero(_lit_ranges(geometry, yaw, near, far, count=FEW_RANGES)[2])
    if lit.size == 0:
        raise OutsideSwath(f"grid lies outside the swath: the beam lights nothing in the range window; {MOVE}")
    yaw = np.linspace(yaw[max(lit[0] - 1, 0)], yaw[min(lit[-1] + 1, FINE_YAWS - 1)], 65)
    near, far = range_window(geometry, yaw, None)
    nearest, farthest, any_lit = _lit_ranges(geometry, yaw, near, far, count=LIT_RANGES)
    nearest = np.pad(np.where(any_lit, nearest, np.inf), 1, mode="edge")
    farthest = np.pad(np.where(any_lit, farthest, -np.inf), 1, mode="edge")
    nearest = np.minimum(np.minimum(nearest[:-2], nearest[1:-1]), nearest[2:])
    farthest = np.maximum(np.maximum(farthest[:-2], farthest[1:-1]), farthest[2:])
    lit_there = nearest < farthest
    return Region(yaw=yaw, near=np.where(lit_there, nearest, near), far=np.where(lit_there, farthest, far))


def _sides(geometry: Geometry, low: float, high: float) -> tuple[float, float]:
    """First and last yaw, rad, of the side of the track with yaws low .. high; infinite if they lie on both."""
    ahead = geometry.collection.antenna_position[-1] - geometry.collection.antenna_position[0]
    heading = float(np.arctan2(ahead[1], ahead[0]))
    first = heading + np.pi * math.floor((low + high - 2 * heading) / (2 * np.pi))
    if low < first or high > first + np.pi:
        return -np.inf, np.inf
    return first + SIDE_ENDS, first + np.pi - SIDE_ENDS


def _joined(regions: Sequence[Region]) -> Region:
    """Combine regions into one that contains them."""
    if len(regions) == 1:
        return regions[0]
    low, high = min(float(each.yaw[0]) for each in regions), max(float(each.yaw[-1]) for each in regions)
    yaw = np.linspace(low, high, regions[0].yaw.size)
    near, far = (np.array(limits) for limits in zip(*(each.at(yaw) for each in regions), strict=True))
    return Region(yaw=yaw, near=near.min(axis=0), far=far.max(axis=0))


def _lit_ranges(
    geometry: Geometry, yaw: FloatArray, near: FloatArray, far: FloatArray, *, count: int
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Nearest and farthest of `count` ranges that are lit at each yaw (n,), with a step of room; and whether any is."""
    ranges = near + (far - near) * np.linspace(0, 1, count)[:, None]
    first, last = geometry.beam.dwell_at(yaw, ranges)
    lit = last > first
    low, high = lit.argmax(axis=0) - 1, count - lit[::-1].argmax(axis=0)
    each = np.arange(yaw.size)
    nearest, farthest = ranges[np.maximum(low, 0), each], ranges[np.minimum(high, count - 1), each]
    return nearest, farthest, np.asarray(lit.any(axis=0))


def grid_extent(geometry: Geometry, region: Region, grid: Grid, owned: Owned | None = None) -> Extent:
    """Part of the region that the grid covers; with `owned`, the part of that where it is true.

    Raises
    ------
    OutsideSwath
        If the grid covers none of it; the message gives the extents of the grid and of the region.
    """
    x, y = outline(grid)
    inside_x = np.linspace(grid.x[0], grid.x[-1], 65)
    inside_y = np.linspace(grid.y[0], grid.y[-1], 65)
    mesh_x, mesh_y = (m.ravel() for m in np.meshgrid(inside_x, inside_y))
    x, y, z = on_terrain(geometry, grid, np.concatenate([x, mesh_x]), np.concatenate([y, mesh_y]))
    yaw, rng, within_yaw, within_range = _placed(geometry, region, x, y, z)
    covered = within_yaw & within_range
    if owned is not None:
        covered &= owned(x, y)
    step = np.hypot((grid.x[-1] - grid.x[0]) / 64, (grid.y[-1] - grid.y[0]) / 64)
    if not covered.any():
        degrees = np.degrees([yaw.min(), yaw.max(), region.yaw[0], region.yaw[-1]])
        raise OutsideSwath(
            f"grid {grid.x0:g}:{grid.x1:g},{grid.y0:g}:{grid.y1:g} lies outside the swath: it spans yaw "
            f"{degrees[0]:.2f} .. {degrees[1]:.2f} degrees and range {rng.min():.6g} .. {rng.max():.6g} m, but lit are "
            f"{degrees[2]:.2f} .. {degrees[3]:.2f} degrees and {region.near.min():.6g} .. {region.far.max():.6g} m; "
            f"{remedy(geometry, grid)}"
        )
    slack = step / np.hypot(x - geometry.nadir[0], y - geometry.nadir[1])[covered].min()
    return Extent(
        low=max(float(yaw[covered].min() - slack), float(region.yaw[0])),
        high=min(float(yaw[covered].max() + slack), float(region.yaw[-1])),
        near=float(rng[covered].min() - step),
        far=float(rng[covered].max() + step),
    )


def check_seen(geometries: Sequence[Geometry], grid: Grid) -> None:
    """Refuse a grid of which no collection sees any point, lit and within the range window at once.

    Raises
    ------
    OutsideSwath
        If none does.
    """
    if any(_sees_some(geometry, grid) for geometry in geometries):
        return
    grid_extent(geometries[0], plan_region(geometries[0], grid), grid)  # which tells why
    raise OutsideSwath(f"grid lies outside the swath: nothing of it is lit; {remedy(geometries[0], grid)}")


def _sees_some(geometry: Geometry, grid: Grid) -> bool:
    collection = geometry.collection
    x, y = np.meshgrid(*(axis[:: math.ceil(axis.size / SEEN_AT)] for axis in (grid.x, grid.y)))
    first, last = geometry.beam.passes(x, y)
    points, middle = geometry.on_ground(x, y), np.minimum((first + last) // 2, collection.n_pulse - 1)
    away = collection.distances(points, middle) - collection.reference_range[middle]
    return bool(((last > first) & (np.abs(away) <= collection.range_window / 2)).any())


def share_outside(lit: Sequence[tuple[Geometry, Region]], grid: Grid) -> float:
    """Share of a grid's points at lit yaws that lie outside the range window of every collection in `lit`.

    From every n-th row and column; points without a height count as within. Under a beam about its axis, which does not
    light all ranges, of points that are lit.
    """
    axes = (axis[:: math.ceil(axis.size / LOOKED_AT)] for axis in (grid.x, grid.y))
    x, y = (mesh.ravel() for mesh in np.meshgrid(*axes))
    any_yaw, held = np.zeros(x.size, bool), np.zeros(x.size, bool)
    for geometry, region in lit:
        _, rng, within_yaw, within_range = _placed(geometry, region, x, y)
        if geometry.collection.has_axis:
            beyond = np.flatnonzero(within_yaw & ~within_range)
            first, last = geometry.beam.dwell(x[beyond], y[beyond])
            within_yaw[beyond] = last > first
        any_yaw |= within_yaw
        held |= within_yaw & within_range | ~np.isfinite(rng)
    return float((any_yaw & ~held).mean())


def _placed(
    geometry: Geometry, region: Region, x: FloatArray, y: FloatArray, z: FloatArray | None = None
) -> tuple[FloatArray, FloatArray, BoolArray, BoolArray]:
    """Yaw, rad, and epoch range, m, of points (n,), m; whether a region holds the yaw, and whether it holds both.

    On the ground, unless z is given.
    """
    middle = (region.yaw[0] + region.yaw[-1]) / 2
    yaw = middle + wrapped(geometry.yaw(x, y) - middle)
    rng = geometry.epoch_range(x, y, z)
    near, far = region.at(yaw)
    return yaw, rng, (yaw >= region.yaw[0]) & (yaw <= region.yaw[-1]), (rng >= near) & (rng <= far)


def on_terrain(
    geometry: Geometry, grid: Grid, x: FloatArray, y: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    """Points (n,), m, of a grid; on a terrain those with known height, and the terrain's own samples in the grid.

    Last their heights, m; None on the plane.
    """
    terrain = geometry.terrain
    if terrain is None:
        return x, y, None
    axes = []
    for axis, low, high in ((terrain.x, grid.x[0], grid.x[-1]), (terrain.y, grid.y[0], grid.y[-1])):
        inside = axis[(axis >= low) & (axis <= high)]
        axes.append(inside[:: max(math.ceil(inside.size / MOST_SAMPLES), 1)])
    mesh_x, mesh_y = (mesh.ravel() for mesh in np.meshgrid(*axes))
    samples = terrain.on_grid(*axes).ravel() if mesh_x.size else np.empty(0)
    x, y, z = np.concatenate([x, mesh_x]), np.concatenate([y, mesh_y]), np.concatenate([terrain(x, y), samples])
    known = np.isfinite(z)
    return x[known], y[known], z[known]


def default_grid(geometry: Geometry, region: Region) -> Grid:
    """The bounding box of the lit sector, sampled at half the resolution along x and along y, on round coordinates.

    Under a beam about its axis that of the ground with full dwell.
    """
    if geometry.collection.has_axis:
        return _full_grid(geometry, region)
    yaw = np.concatenate([region.yaw, region.yaw])
    point = geometry.ground_point(np.concatenate([region.near, region.far]), yaw)
    x, y = point[:, 0], point[:, 1]
    dx, dy = map(_round_step, ground_steps(geometry, (region.near + region.far) / 2, region.yaw))

    def box(values: FloatArray, step: float) -> tuple[float, float, float]:
        return float(np.floor(values.min() / step) * step), float(np.ceil(values.max() / step + 1) * step), step

    return Grid(*box(x, dx), *box(y, dy))


def _full_grid(geometry: Geometry, region: Region) -> Grid:
    """Bounding box of a region's ground with full dwell; if there is none, with nearly the longest dwell.

    Within it, since a spotlight lights ground just beyond twice: before and after it leaves the beam.
    """
    # Yaws that are even on the ground: those of a long strip crowd towards its ends.
    fine = np.linspace(region.yaw[0], region.yaw[-1], 8 * FULL_YAWS)
    middle = geometry.ground_point(np.add(*region.at(fine)) / 2, fine)
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(middle, axis=0), axis=1))])
    yaw = np.interp(np.linspace(0, way[-1], FULL_YAWS), way, fine)
    near, far = region.at(yaw)
    ranges = near + (far - near) * np.linspace(0, 1, FULL_RANGES)[:, None]
    x, y = geometry.ground_axes(ranges, yaw)
    first, last = geometry.beam.dwell_at(yaw, ranges)
    full = geometry.beam.has_full_dwell(x, y) & (last > first)
    if not full.any():
        full = last - first >= LONG * np.nanmax(last - first)
    rows, columns = np.nonzero(full)
    centre = np.argmin(np.hypot(rows - rows.mean(), (columns - columns.mean()) * FULL_RANGES / FULL_YAWS))
    at = rows[centre], columns[centre]
    dx, dy = map(_round_step, ground_steps(geometry, ranges[at][None], yaw[at[1]][None]))

    def box(values: FloatArray, step: float) -> tuple[float, float, float]:
        low, high = np.ceil(values.min() / step), np.floor(values.max() / step)
        return float(low * step), float(max(high, low + 1) * step), step

    return Grid(*box(x[full], dx), *box(y[full], dy))


def facing_grid(geometry: Geometry) -> Grid:
    """A square of ground about the scene's origin, for a beam that is not steered.

    Data that were compensated to the origin have its distance as their reference range; their beam was held on it. The
    square lies in the range window and in the unambiguous Doppler band, with a tenth to spare. Pixels as in
    `default_grid`.

    Raises
    ------
    InputError
        If the reference range does not follow the origin: nothing then tells where the beam looked.
    """
    collection = geometry.collection
    centre = np.array([0.0, 0.0, collection.ground_height])
    distance = collection.distances(centre)
    if np.abs(distance - collection.reference_range).max() > collection.range_window / 8 or collection.n_pulse < 2:
        raise InputError(
            "grid is missing: the beam is not steered, and the reference range does not follow the scene's origin, so "
            "give --grid x0:x1:dx,y0:y1:dy for the ground to show"
        )
    sights = [centre - getattr(collection, name) for name in collection.antennas]
    direction = np.mean([sight / np.linalg.norm(sight, axis=1)[:, None] for sight in sights], axis=0)
    turn = np.linalg.norm(np.diff(direction, axis=0), axis=1).mean() / collection.pulse_interval  # rad/s
    slope = float(np.linalg.norm(direction[:, :2], axis=1).mean())
    room = collection.range_window / 2
    if (recorded := collection.recorded) is not None:
        room = min(room, float(distance.min()) - recorded.whole[0], recorded.whole[1] - float(distance.max()))
    half = 0.9 * min(room / slope, collection.prf * collection.wavelength / 4 / max(turn, 1e-12))
    step = _step_at(geometry, 0.0, 0.0)
    half = max(float(np.floor(half / np.sqrt(2) / step) * step), step)
    return Grid(-half, half, step, -half, half, step)


def joint_grid(geometries: Sequence[Geometry]) -> Grid:
    """The bounding box of the default grids of collections, at the finest of their spacings.

    Raises
    ------
    InputError
        If one of them has no default grid.
    """
    grids = [default_grid(geometry, plan_region(geometry, None)) for geometry in geometries]
    if len(grids) == 1:
        return grids[0]

    def box(sides: list[tuple[float, float, float]]) -> tuple[float, float, float]:
        low, high, step = min(side[0] for side in sides), max(side[1] for side in sides), min(side[2] for side in sides)
        return float(step * round(low / step)), float(step * round(high / step)), step

    x, y = box([(grid.x0, grid.x1, grid.dx) for grid in grids]), box([(grid.y0, grid.y1, grid.dy) for grid in grids])
    return Grid(*x, *y)


def area_grid(geometry: Geometry, x: tuple[float, float], y: tuple[float, float]) -> Grid:
    """A grid that holds an area, m, in steps of half the resolution at its middle, on whole multiples of them."""
    step = _step_at(geometry, sum(x) / 2, sum(y) / 2)
    x0, x1, y0, y1 = (float(round(end) * step) for low, high in (x, y) for end in (low / step, high / step))
    return Grid(x0, max(x1, x0 + step), step, y0, max(y1, y0 + step), step)


def _step_at(geometry: Geometry, x: float, y: float) -> float:
    """Half the resolution at a place, m, rounded."""
    at = np.array([x]), np.array([y])
    rng, yaw = float(geometry.epoch_range(*at)[0]), float(geometry.yaw(*at)[0])
    return _round_step(min(ground_resolution(geometry, rng, yaw)) / 2)


def _round_step(value: float) -> float:
    """Round to the nearest of 1, 1.5, 2, 3, 5, 7 times a power of ten."""
    decade = 10.0 ** np.floor(np.log10(value))
    steps = decade * np.array([1.0, 1.5, 2.0, 3.0, 5.0, 7.0, 10.0])
    return float(f"{steps[np.argmin(np.abs(np.log(steps / value)))]:.3g}")


def block_seams(geometry: Geometry, region: Region, count: int) -> FloatArray:
    """Yaws (count + 1,) of the blocks' borders, rad, ascending.

    The steering interval of a steered collection is divided evenly (paper A, Figure 7), and the first and last block
    extend to the ends of the lit yaws. Any other region is divided evenly from end to end.
    """
    collection = geometry.collection
    low, high = region.yaw[0], region.yaw[-1]
    if not geometry.beam.by_yaw or np.ptp(collection.beam_azimuth) == 0:
        return np.linspace(low, high, count + 1)
    seams = np.linspace(collection.beam_azimuth.min(), collection.beam_azimuth.max(), count + 1)
    seams[0], seams[-1] = low, high
    return seams
