"""Shadow and layover: terrain points that others hide, or that share range and Doppler with others; compiled.

All three tests march from a point over the terrain until its heights cross a curve that begins at the point, with the
antenna at the height H over it, at the horizontal distances d from it and D across its track:

    shadow          towards the antenna              above  z + s H / d
    layover, near   across the track, to the antenna below  z + H - sqrt(D^2 + H^2 - (D - s)^2)
    layover, far    across the track, away from it   above  z + H - sqrt(D^2 + H^2 - (D + s)^2)

The last two curves are the circle of the point's range in the plane across the track. The terrain is bilinear between
its samples here, and so is the point's own height. Blocks of samples that lie wholly on the other side of a curve are
passed in one step, and so is the way on which the terrain, nowhere steeper than it is, cannot reach the curve.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit, types
from numpy.typing import NDArray

from blocksar.arrays import BoolArray, FloatArray
from blocksar.kernels.loops import PART, REAL_ROW, REAL_ROWS, fixed, loop, record

VISIBLE, LAYOVER, SHADOW, UNKNOWN = 0, 1, 2, 255
BLOCK = 16  # samples a side
STEPS = 2  # of a march, to a sample of the terrain
TOLERANCE = 1e-6  # m: less than this above or below a curve is rounding
MOST_STEPS = 1 << 30  # of a march, passed at once
_SHADOW, _NEAR, _FAR = 0, 1, 2
OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}


class HeightGrid(NamedTuple):
    """Samples of a terrain, with extremes by block.

    Attributes
    ----------
    heights : (n_y, n_x) float
        m.
    low, high : float
        Lowest and highest height of each block of cells between samples, m; inf and -inf if none is known.
    dx, dy : float
        Spacing of the samples, m.
    """

    heights: FloatArray
    low: FloatArray
    high: FloatArray
    dx: float
    dy: float

    @classmethod
    def of(cls, heights: FloatArray, dx: float, dy: float) -> HeightGrid:
        """Compute the extremes of blocks."""
        heights, shape = np.ascontiguousarray(heights, np.float64), [-(-(n - 1) // BLOCK) for n in heights.shape]
        low, high = np.full(shape, np.inf), np.full(shape, -np.inf)
        _find_extremes(heights, low, high)
        return cls(fixed(heights), fixed(low), fixed(high), float(dx), float(dy))


GRID = record(HeightGrid, REAL_ROWS, REAL_ROWS, REAL_ROWS, types.float64, types.float64)


@loop(REAL_ROWS, types.float64[:, ::1], types.float64[:, ::1], **OPTIONS)
def _find_extremes(heights: FloatArray, low: FloatArray, high: FloatArray) -> None:
    for i in range(low.shape[0]):
        for j in range(low.shape[1]):
            for row in range(i * BLOCK, min((i + 1) * BLOCK + 1, heights.shape[0])):
                for column in range(j * BLOCK, min((j + 1) * BLOCK + 1, heights.shape[1])):
                    value = heights[row, column]
                    # Comparisons with NaN are false.
                    low[i, j] = value if value < low[i, j] else low[i, j]
                    high[i, j] = value if value > high[i, j] else high[i, j]


@njit(**PART, **OPTIONS)
def _steepest(heights: FloatArray, dx: float, dy: float) -> float:
    most = 0.0
    for i in range(heights.shape[0] - 1):
        for j in range(heights.shape[1] - 1):
            a, b, c, d = heights[i, j], heights[i, j + 1], heights[i + 1, j], heights[i + 1, j + 1]
            along_x, along_y = max(abs(b - a), abs(d - c)) / dx, max(abs(c - a), abs(d - b)) / dy
            if np.isnan(a + b + c + d):
                return np.inf
            most = max(most, along_x * along_x + along_y * along_y)
    return np.sqrt(most)


@loop(REAL_ROWS, types.float64, types.float64, **OPTIONS)
def steepest_slope(heights: FloatArray, dx: float, dy: float) -> float:
    """An upper bound of the slope of the bilinear terrain (n_y, n_x) in any direction; inf if a height is unknown."""
    return _steepest(heights, dx, dy)


@njit(**PART, **OPTIONS)
def _height(heights: FloatArray, column: float, row: float) -> float:
    """Bilinear height, m, at a position in samples; NaN outside."""
    if not (0 <= column <= heights.shape[1] - 1 and 0 <= row <= heights.shape[0] - 1):
        return np.nan
    i, j = min(int(row), heights.shape[0] - 2), min(int(column), heights.shape[1] - 2)
    v, u = row - i, column - j
    near = heights[i, j] * (1 - u) + heights[i, j + 1] * u
    far = heights[i + 1, j] * (1 - u) + heights[i + 1, j + 1] * u
    return near * (1 - v) + far * v


@njit(**PART, **OPTIONS)
def _leave(at: float, pace: float) -> float:
    """Distance, m, until a position in samples, which changes by `pace` a metre, leaves its block."""
    block = np.floor(at / BLOCK)
    if pace > 0:
        return ((block + 1) * BLOCK - at) / pace
    if pace < 0:
        return (block * BLOCK - at) / pace
    return np.inf


@njit(**PART, **OPTIONS)
def _crosses(
    grid: HeightGrid, limits: tuple[float, float], at: tuple[float, float], pace: tuple[float, float], kind: int,
    z: float, above: float, distance: float, steepest: float,
) -> bool:  # fmt: skip
    """Tell whether the terrain crosses a curve that starts at `at`, column and row, and moves `pace` samples a metre.

    `above` and `distance` are H and d.
    """
    heights, low, high = grid.heights, grid.low, grid.high
    step, (column, row), (along_column, along_row) = min(grid.dx, grid.dy) / STEPS, at, pace
    square = distance * distance + above * above
    # Largest rate, per metre of the way, at which the terrain can approach the curve: curves are least steep where they
    # begin, but the near one where it ends.
    gain = steepest - distance / above if kind == _FAR else steepest - above / distance
    if kind == _NEAR:
        down = z + above - limits[0]
        gain = steepest - np.sqrt(max(square - down * down, 0.0)) / down
    if gain <= 0:
        return False
    n = 1
    while True:
        s = n * step
        if kind == _SHADOW:
            curve = z + s * above / distance
        else:
            flat = distance + s if kind == _FAR else distance - s
            if flat * flat > square:
                return False
            curve = z + above - np.sqrt(square - flat * flat)
        if kind != _FAR and s >= distance:
            return False
        if curve < limits[0] if kind == _NEAR else curve > limits[1]:
            return False
        at_column, at_row = column + s * along_column, row + s * along_row
        if not (0 <= at_column <= heights.shape[1] - 1 and 0 <= at_row <= heights.shape[0] - 1):
            return False
        i = min(int(at_row) // BLOCK, low.shape[0] - 1)
        j = min(int(at_column) // BLOCK, low.shape[1] - 1)
        if curve < low[i, j] if kind == _NEAR else curve > high[i, j]:
            way = min(_leave(at_column, along_column), _leave(at_row, along_row))
            n = max(n + 1, int(np.ceil((s + way) / step)))
            continue
        ground = _height(heights, at_column, at_row)
        clearance = ground - curve if kind == _NEAR else curve - ground
        if clearance < -TOLERANCE:
            return True
        n += max(int(min(clearance / gain / step, MOST_STEPS)), 1) if clearance > 0 else 1


@njit(**PART, **OPTIONS)
def _limits(low: FloatArray, high: FloatArray) -> tuple[float, float]:
    """Lowest and highest height of all blocks, m."""
    lowest, highest = np.inf, -np.inf
    for i in range(low.shape[0]):
        for j in range(low.shape[1]):
            lowest, highest = min(lowest, low[i, j]), max(highest, high[i, j])
    return lowest, highest


@njit(**PART, **OPTIONS)
def _hidden(
    grid: HeightGrid, limits: tuple[float, float], at: tuple[float, float], z: float,
    sight: tuple[float, float, float], steepest: float,
) -> bool:  # fmt: skip
    """Tell whether the terrain crosses the ray from a point at height z to the antenna."""
    distance = np.sqrt(sight[0] * sight[0] + sight[1] * sight[1])
    pace = sight[0] / distance / grid.dx, sight[1] / distance / grid.dy
    return distance > 0 and _crosses(grid, limits, at, pace, _SHADOW, z, sight[2] - z, distance, steepest)


@loop(GRID, REAL_ROW, REAL_ROW, REAL_ROW, REAL_ROWS, types.bool_[::1], **OPTIONS)
def find_shadow(
    grid: HeightGrid, column: FloatArray, row: FloatArray, height: FloatArray, sight: FloatArray, found: BoolArray
) -> None:
    """Find which points on or above a terrain it hides from antennas, as `find_visibility` does.

    Parameters
    ----------
    grid, column, row, sight
        As there.
    height : (n,) float
        Of the points, m; those below the terrain are seen as the terrain there is. Where that is unknown, nothing
        hides.
    found : (n,) bool
        Written.
    """
    limits = _limits(grid.low, grid.high)
    for k in range(column.size):
        z = max(_height(grid.heights, column[k], row[k]), height[k])
        ray = sight[k, 0], sight[k, 1], sight[k, 2]
        found[k] = _hidden(grid, limits, (column[k], row[k]), z, ray, np.inf)


@loop(GRID, REAL_ROW, REAL_ROW, REAL_ROWS, REAL_ROWS, types.uint8[::1], **OPTIONS)
def find_visibility(
    grid: HeightGrid, column: FloatArray, row: FloatArray, sight: FloatArray, across: FloatArray,
    found: NDArray[np.uint8],
) -> None:  # fmt: skip
    """Classify points on a terrain: VISIBLE, LAYOVER, SHADOW, or UNKNOWN where it has no height.

    Parameters
    ----------
    grid : HeightGrid
    column, row : (n,) float
        Points, in samples.
    sight : (n, 3) float
        From the points' places at height 0 to the antenna, m.
    across : (n, 2) float
        Horizontal unit vectors across the track.
    found : (n,) uint8
        Written.
    """
    limits, steepest = _limits(grid.low, grid.high), _steepest(grid.heights, grid.dx, grid.dy)
    for k in range(column.size):
        at = column[k], row[k]
        z = _height(grid.heights, column[k], row[k])
        if np.isnan(z):
            found[k] = UNKNOWN
            continue
        found[k] = VISIBLE
        above = sight[k, 2] - z
        ray = sight[k, 0], sight[k, 1], sight[k, 2]
        if _hidden(grid, limits, at, z, ray, steepest):
            found[k] = SHADOW
            continue
        side = sight[k, 0] * across[k, 0] + sight[k, 1] * across[k, 1]
        way = 1.0 if side > 0 else -1.0
        along_column, along_row = way * across[k, 0] / grid.dx, way * across[k, 1] / grid.dy
        for kind in (_NEAR, _FAR):
            turn = 1.0 if kind == _NEAR else -1.0
            pace = turn * along_column, turn * along_row
            if _crosses(grid, limits, at, pace, kind, z, above, abs(side), steepest):
                found[k] = LAYOVER
                break


@loop(GRID, REAL_ROW, REAL_ROWS, REAL_ROWS, REAL_ROWS, types.float64[::1], **OPTIONS)
def find_heights(
    grid: HeightGrid, first: FloatArray, place: FloatArray, antenna: FloatArray, velocity: FloatArray,
    found: FloatArray,
) -> None:  # fmt: skip
    """Find the highest terrain point with the range and Doppler of each of some places.

    The points of a range and a Doppler lie on a circle about the velocity; from the terrain's top it is followed down
    the side of the place, until it passes below the terrain.

    Parameters
    ----------
    grid : HeightGrid
    first : (2,) float
        x and y of the first sample, m.
    place, antenna, velocity : (n, 3) float
        m, m/s.
    found : (n,) float
        Written: z, m, to a thousandth of a step; NaN where there is none.
    """
    (lowest, highest), step = _limits(grid.low, grid.high), min(grid.dx, grid.dy) / STEPS
    for k in range(place.shape[0]):
        dx, dy, dz = place[k, 0] - antenna[k, 0], place[k, 1] - antenna[k, 1], place[k, 2] - antenna[k, 2]
        vx, vy, vz = velocity[k, 0], velocity[k, 1], velocity[k, 2]
        level = np.sqrt(vx * vx + vy * vy)
        square, along = dx * dx + dy * dy + dz * dz, (dx * vx + dy * vy + dz * vz) / level
        way = 1.0 if dy * vx - dx * vy > 0 else -1.0
        z, above, inside = highest, np.nan, False
        found[k] = np.nan
        span = 0.0
        while z >= lowest - span:
            down = antenna[k, 2] - z
            ahead = along + vz * down / level
            side = np.sqrt(max(square - down * down - ahead * ahead, 0.0))
            x = antenna[k, 0] + (ahead * vx - way * side * vy) / level
            y = antenna[k, 1] + (ahead * vy + way * side * vx) / level
            clearance = z - _height(grid.heights, (x - first[0]) / grid.dx, (y - first[1]) / grid.dy)
            if inside and (clearance <= 0) != (above <= 0):
                found[k] = z + clearance / (clearance - above) * span
                break
            above, inside = clearance, not np.isnan(clearance)
            span = step * max(side, step) / max(abs(down), step)
            z -= span
