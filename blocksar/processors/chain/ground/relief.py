"""Terrain of a block: the smooth part that the block is fitted on, and deviations from it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev

from blocksar import solvers
from blocksar.arrays import BoolArray, FloatArray, IntArray
from blocksar.collection.beam import wrapped
from blocksar.collection.geometry import Geometry
from blocksar.processors.chain.ground.ground_map import Depth, SmoothGround
from blocksar.processors.chain.ground.surfaces import GroundRange, Surface

SMOOTH_DEGREE = 2, 2  # of the smooth ground, along range and yaw, on which coefficients are fitted: no finer is better
FINE_DEGREE = 16, 8  # of the finer one, which the dwell gate follows: a block is longer along range
CELLS = 64, 48  # of a block along range and yaw, whose heights these are fitted to
BINS, ABOUT = 160, 0.05  # along each side of a block, and half extents of it about a node: those of a chip or two
FEWEST_POINTS, MOST_POINTS = 129, 1 << 20  # of a terrain that are looked at: along an axis, and in all
ROOM = 0.02  # of the relief, that heights may go beyond on either side
LEAST_RELIEF = 0.5  # m
LAYER_HEIGHT, FEWEST_LAYERS, MOST_LAYERS = 250.0, 4, 8  # m of relief for one more height; heights that are traced

# Newton's steps to a yaw: a fraction of the beam's width for the slope, their number, the slope at which yaw no longer
# moves a point in the beam, and the longest step, rad.
TURN_STEP, TURN_STEPS, LEAST_TURN, MOST_TURN = 1 / 64, 3, 1e-3, 0.1


@dataclass(frozen=True, kw_only=True, eq=False)
class Relief:
    """Smooth ground and relief of a block's terrain.

    Attributes
    ----------
    smooth, fine : SmoothGround
        Two of its smooth parts.
    low, high : float
        Least and greatest height over the smoother one, m.
    lowest, highest : float
        Least and greatest z, m, also between the samples.
    points : three of (n,) float
        Samples: places in ground range and yaw, -1 .. 1, and heights over the finer smooth part, m.
    samples : Samples
        Those of all of the terrain.
    """

    smooth: SmoothGround
    fine: SmoothGround
    low: float
    high: float
    lowest: float
    highest: float
    points: tuple[FloatArray, FloatArray, FloatArray]
    samples: ReliefPoints

    @property
    def offsets(self) -> FloatArray:
        """Heights over the smooth ground, m, for which lines are traced."""
        count = min(FEWEST_LAYERS + int((self.high - self.low) // LAYER_HEIGHT), MOST_LAYERS)
        return (self.low + self.high) / 2 + (self.high - self.low) / 2 * solvers.end_nodes(count)

    def over(self, geometry: Geometry, offset: float) -> Geometry:
        """Geometry on the smooth ground, raised by an offset, m."""
        return geometry.over(None, replace(self.smooth, offset=offset))

    def usual(self, n_range: int, n_yaw: int) -> tuple[FloatArray, BoolArray]:
        """Typical heights (n_range, n_yaw), m, over the finer smooth ground about each end node; whether any is known.

        What is lost at the ends of a dwell is in proportion to their displacement, thus to the distance from the smooth
        ground: the mean of the losses about a node, as a chip of the image shows it, is the loss at the mean distance.
        That is of heights that are normally distributed, and has the sign of their mean. About a node are places nearer
        to it than to others, and those as near as in a chip.
        """
        middle, spread, known = self._about(n_range, n_yaw)
        return np.copysign(np.sqrt(middle**2 + 2 / np.pi * spread), middle), known

    def usual_ends(self, n_range: int, n_yaw: int) -> tuple[FloatArray, FloatArray]:
        """Typical low and high heights (n_range, n_yaw), m, about each end node: mean -+ standard deviation.

        Side lobes are those of each target: what is at one height is not made up for by what is at another.
        """
        middle, spread, _ = self._about(n_range, n_yaw)
        return middle - np.sqrt(spread), middle + np.sqrt(spread)

    def _about(self, n_range: int, n_yaw: int) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Mean and variance of heights over the finer smooth ground about each end node; whether any is known."""
        u, v, over = self.points
        cell = [bins_of(at, BINS) for at in (u, v)]
        which = cell[0] * BINS + cell[1]
        spans = [_bins_about(n) for n in (n_range, n_yaw)]

        def total(values: FloatArray | None) -> FloatArray:
            sums = np.zeros((BINS + 1, BINS + 1))
            sums[1:, 1:] = np.bincount(which, weights=values, minlength=BINS * BINS).reshape(BINS, BINS)
            sums = sums.cumsum(axis=0).cumsum(axis=1)
            (low_u, high_u), (low_v, high_v) = spans
            rows = sums[high_u] - sums[low_u]
            return np.asarray(rows[:, high_v] - rows[:, low_v])

        number = total(None)
        known = number > 0.5
        middle, square = (total(values) / np.maximum(number, 1) for values in (over, over**2))
        return middle, np.maximum(square - middle**2, 0.0), known


def bins_of(places: FloatArray, n: int) -> IntArray:
    """Bin, of n over -1 .. 1, of each place; the outermost bins include places beyond."""
    return np.clip(((places + 1) / 2 * n).astype(np.int64), 0, n - 1)


def _bins_about(n: int) -> tuple[IntArray, IntArray]:
    """First and end of the BINS over -1 .. 1 about each of n end nodes, (n,) each."""
    nodes = solvers.end_nodes(n)
    between = (nodes[1:] + nodes[:-1]) / 2
    low = np.minimum(np.append(-1.0, between), nodes - ABOUT)
    high = np.maximum(np.append(between, 1.0), nodes + ABOUT)
    low, high = (np.clip(np.rint((at + 1) / 2 * BINS), 0, BINS).astype(np.int64) for at in (low, high))
    return low, high


class ReliefPoints(NamedTuple):
    """Points sampled from a terrain, (n,): yaw (rad), epoch range and z (m).

    All of the terrain is within `apart`, m, of one of them; `turn` (n,), rad, is as far as seen from the nadir.
    """

    yaw: FloatArray
    epoch_range: FloatArray
    z: FloatArray
    apart: float
    turn: FloatArray


def sample_terrain(geometry: Geometry, x: tuple[float, float], y: tuple[float, float]) -> ReliefPoints:
    """Sample the geometry's terrain in a box, x and y from .. to, m, and along the box's edges."""
    terrain = geometry.terrain
    assert terrain is not None
    axes = []
    for (low, high), origin, step in ((x, terrain.x0, terrain.dx), (y, terrain.y0, terrain.dy)):
        inside = origin + step * np.arange(np.ceil((low - origin) / step), np.floor((high - origin) / step) + 1)
        axes.append(np.unique(np.concatenate([np.linspace(low, high, FEWEST_POINTS), inside])))
    skip = max(int(np.ceil(np.sqrt(axes[0].size * axes[1].size / MOST_POINTS))), 1)
    along_x, along_y = (np.unique(np.append(axis[::skip], axis[-1])) for axis in axes)
    z = terrain.on_grid(along_x, along_y)
    mesh_x, mesh_y = np.meshgrid(along_x, along_y)
    known = np.isfinite(z)
    px, py, heights = mesh_x[known], mesh_y[known], z[known]
    apart = float(np.hypot(np.diff(along_x).max(initial=0.0), np.diff(along_y).max(initial=0.0)))
    distance = np.hypot(px - geometry.nadir[0], py - geometry.nadir[1])
    return ReliefPoints(
        geometry.yaw(px, py), geometry.epoch_range(px, py, heights), heights, apart, apart / np.maximum(distance, apart)
    )


def find_relief(samples: ReliefPoints, geometry: Geometry, *, low: float, high: float, along: GroundRange) -> Relief:
    """Fit the relief between two yaws, rad, and two epoch ranges; the plane z = ground_height if nothing is known."""
    x, y = geometry.epoch_position[:2] - geometry.nadir
    depth = Depth(x=float(x), y=float(y), z=float(geometry.epoch_position[2]))
    turn = wrapped(samples.yaw - (low + high) / 2)
    u, v = along.place(samples.epoch_range), 2 * turn / (high - low)
    inside, around = (np.abs(u) <= 1) & (np.abs(v) <= 1), _beside(samples, turn, (high - low) / 2, along)
    inside = inside if inside.any() else around
    u, v, z = u[inside], v[inside], samples.z[inside]
    level = float(z.mean()) if z.size else geometry.collection.ground_height
    bounds = samples.z[around] if z.size else np.array([level])
    spare = ROOM * float(np.ptp(bounds))  # between samples heights may go beyond them
    cells = _in_cells(u, v, z, level)
    smooth, fine = (
        SmoothGround(surface=Surface(series=_fit(cells, degree), along=along, low=low, high=high), depth=depth)
        for degree in (SMOOTH_DEGREE, FINE_DEGREE)
    )
    at = samples.epoch_range[inside], (low + high) / 2 + turn[inside]
    over = z - smooth(*at) if z.size else np.zeros(1)
    room = ROOM * float(np.ptp(over)) + LEAST_RELIEF
    return Relief(
        smooth=smooth, fine=fine, low=float(over.min()) - room, high=float(over.max()) + room,
        lowest=float(bounds.min()) - spare, highest=float(bounds.max()) + spare,
        points=(u, v, z - fine(*at)), samples=samples,
    )  # fmt: skip


def _beside(samples: ReliefPoints, turn: FloatArray, half: float, along: GroundRange) -> BoolArray:
    """Mask of samples (n,) in a block, or close enough to bound its heights.

    A block has yaws of at most `half` from its middle, rad, and the ranges `along`; `turn` (n,) are the samples' yaws
    from its middle. It may be hardly larger than the distance between samples.
    """
    reach = 2 * samples.apart  # along the line of sight, on slopes of up to 60 degrees
    near, far = along.near - reach, along.far + reach
    return (np.abs(turn) <= half + samples.turn) & (samples.epoch_range >= near) & (samples.epoch_range <= far)


def _in_cells(u: FloatArray, v: FloatArray, z: FloatArray, mean: float) -> FloatArray:
    """Average heights of samples at (u, v) in -1 .. 1 over cells (CELLS), m; unknown cells are extrapolated."""
    rows, columns = (bins_of(at, n) for at, n in zip((u, v), CELLS, strict=True))
    which, count = rows * CELLS[1] + columns, CELLS[0] * CELLS[1]
    number = np.bincount(which, minlength=count).reshape(CELLS)
    middles = np.meshgrid(*((2 * np.arange(n) + 1) / n - 1 for n in CELLS), indexing="ij")
    mean_u, mean_v, mean_z = (
        np.where(number > 0, np.bincount(which, weights=values, minlength=count).reshape(CELLS), otherwise)
        / np.maximum(number, 1)
        for values, otherwise in zip((u, v, z), (*middles, np.array(mean)), strict=True)
    )
    filled = _continued(mean_z, number > 0)
    slopes = np.gradient(filled)
    for at, middle, slope, n in zip((mean_u, mean_v), middles, slopes, CELLS, strict=True):
        filled = filled - slope * (at - middle) * n / 2
    return filled


def _fit(cells: FloatArray, degree: tuple[int, int]) -> FloatArray:
    """Fit a tensor Chebyshev series to heights at the middles of cells."""
    along_range, along_yaw = (_fitting(n, terms) for n, terms in zip(cells.shape, degree, strict=True))
    return solvers.product(solvers.product(along_range, cells), along_yaw.T)


def _continued(values: FloatArray, known: BoolArray) -> FloatArray:
    """Fill unknown values with the mean of neighbours, outwards from known ones."""
    values, known = values.copy(), known.copy()
    while known.any() and not known.all():
        around, number = np.zeros_like(values), np.zeros_like(values)
        for axis in (0, 1):
            for way in (slice(1, None), slice(None, -1)):
                other = slice(None, -1) if way.start else slice(1, None)
                into, out = ((way, slice(None)), (other, slice(None))) if axis == 0 else (
                    (slice(None), way), (slice(None), other)
                )  # fmt: skip
                around[into] += np.where(known[out], values[out], 0.0)
                number[into] += known[out]
        new = ~known & (number > 0)
        values[new] = around[new] / number[new]
        known |= new
    return values


@lru_cache
def _fitting(n: int, degree: int) -> FloatArray:
    """Matrix (degree + 1, n) from values at the middles of n cells to a Chebyshev series; read-only.

    Least squares with weights 1 / sqrt(1 - u^2), under which errors at the ends are no larger than amid.
    """
    middles = (2 * np.arange(n) + 1) / n - 1
    weights = (1 - middles**2) ** -0.25
    terms = np.asarray(chebyshev.chebvander(middles, degree).T, np.float64) * weights
    matrix = solvers.least_squares(terms, np.diag(weights))
    matrix.flags.writeable = False
    return matrix


def turns_of(raised: Geometry, smooth: Geometry, epoch_range: FloatArray, yaw: FloatArray) -> FloatArray:
    """Yaw, rad, between targets on a raised ground (n_range, n_yaw) and those of equal dwell on the smooth one.

    They have the same range, and the same place in a beam about its axis at the middle of the dwell. By Newton's steps.
    """
    collection = smooth.collection
    first, last = raised.beam.dwell_at(yaw, epoch_range[:, None])
    time = np.clip((first + last) / 2, collection.time[0], collection.time[-1])

    def offset(geometry: Geometry, turn: FloatArray) -> FloatArray:
        at = epoch_range[:, None], yaw + turn
        (x, y), z, beam = geometry.ground_axes(*at), geometry.level(*at), geometry.beam
        return beam.at_times(time, lambda pulses: beam.offset(x, y, pulses, z))

    turn, step = np.zeros(time.shape), (collection.beam_width or 0.0) * TURN_STEP
    wanted = offset(raised, turn)
    for _ in range(TURN_STEPS):
        here, ahead = offset(smooth, turn), offset(smooth, turn + step)
        slope = (ahead - here) / step
        move = (wanted - here) / np.where(np.abs(slope) > LEAST_TURN, slope, np.inf)
        turn = turn + np.clip(move, -MOST_TURN, MOST_TURN)
    return turn
