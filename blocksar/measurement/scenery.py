"""Figures of an image without a list of targets: bright points, an area's looks and level, floor, ambiguities."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter

from blocksar.arrays import FloatArray
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import CUT_WIDTHS, Weighting
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.kernels.phase import Float32Array
from blocksar.measurement.axes import ResponseAxes, response_axes
from blocksar.measurement.multilooking import power_of
from blocksar.measurement.response import ReadChip
from blocksar.solvers import newton

PROMINENT = 100.0  # times the median power about it: in clutter alone one cell of 1e30 is
APART = 0.1  # of a point's power: what else lies within its cuts stays below, beyond the main lobe
MAIN_LOBE = 1.6  # widths from the peak
TRIED = 20  # times as many local maxima as points are looked at
FLOOR_CELL = 16  # pixels along the side of the cells whose mean power makes the floor
FLOOR_SHARE = 0.01  # of the cells, the darkest, that lie below the floor
GROUND_STEPS = 12  # of Newton's method
GHOST_WIDTHS = 3.0  # within which an ambiguity is looked for, since it is defocused

GeometryAt = Callable[[float, float], Geometry]
Strips = Iterable[slice]


class BrightPoint(NamedTuple):
    """An isolated bright pixel: place, m, power, and its prominence, the power over the median about it."""

    x: float
    y: float
    power: float
    prominence: float


class Area(NamedTuple):
    """The power of an area's covered pixels: their number, mean, and equivalent number of looks, mean^2 / variance."""

    pixels: int
    mean: float
    looks: float


def find_bright(
    read: ReadChip,
    x: FloatArray,
    y: FloatArray,
    strips: Strips,
    geometry_at: GeometryAt,
    weighting: Weighting,
    count: int,
) -> list[BrightPoint]:
    """Find the brightest pixels (at most `count`) above all others within 10 widths along the response's axes.

    Beyond the main lobe nothing within comes up to a tenth of their power, and the median within is less than a
    hundredth of it. The image is read by strips of rows.
    """
    middle = float(x[x.size // 2]), float(y[y.size // 2])
    half = _window(response_axes(geometry_at(*middle), *middle, weighting), x, y)
    best: list[tuple[float, int, int]] = []
    for rows in strips:
        first = max(rows.start - half[0], 0)
        power = np.nan_to_num(power_of(read(slice(first, min(rows.stop + half[0], y.size)), slice(None))))
        top = maximum_filter(power, size=(2 * half[0] + 1, 2 * half[1] + 1), mode="constant")
        own = slice(rows.start - first, rows.stop - first)
        row, column = np.nonzero((power[own] == top[own]) & (power[own] > 0))
        values = power[own][row, column]
        for k in np.argsort(values)[::-1][: TRIED * count]:
            heapq.heappush(best, (float(values[k]), int(row[k]) + rows.start, int(column[k])))
        best = heapq.nlargest(TRIED * count, best)
        heapq.heapify(best)
    found = []
    for value, row_, column_ in sorted(best, reverse=True):
        place = float(x[column_]), float(y[row_])
        axes = response_axes(geometry_at(*place), *place, weighting)
        prominence = 0.0 if axes is None else _prominence(read, x, y, (row_, column_), axes)
        if prominence >= PROMINENT:
            found.append(BrightPoint(*place, value, prominence))
        if len(found) == count:
            break
    return found


def _window(axes: ResponseAxes | None, x: FloatArray, y: FloatArray) -> tuple[int, int]:
    """Half sizes, in rows and columns, of the window about a point that holds its cuts."""
    if axes is None:
        return 8, 8
    reach = CUT_WIDTHS * np.maximum(
        axes.range_width * np.abs(axes.range_direction), axes.azimuth_width * np.abs(axes.azimuth_direction)
    )
    return tuple(  # type: ignore[return-value]
        int(np.clip(extent / abs(axis[1] - axis[0]), 1, (axis.size - 1) // 2 or 1))
        for extent, axis in zip(reach[::-1], (y, x), strict=True)
    )


def _prominence(read: ReadChip, x: FloatArray, y: FloatArray, at: tuple[int, int], axes: ResponseAxes) -> float:
    """Power of a pixel over the median about it; 0 where it is not isolated or the pixels about it are not covered."""
    half = _window(axes, x, y)
    parts = [slice(max(i - h, 0), i + h + 1) for i, h in zip(at, half, strict=True)]
    power = power_of(read(*parts))
    peak = float(power[at[0] - parts[0].start, at[1] - parts[1].start])
    dx, dy = np.meshgrid(x[parts[1]] - x[at[1]], y[parts[0]] - y[at[0]])
    along_range, along_azimuth = axes.own_offset(dx, dy)
    beyond = (np.abs(along_range) > MAIN_LOBE * axes.range_width) | (
        np.abs(along_azimuth) > MAIN_LOBE * axes.azimuth_width
    )
    others = power[beyond]
    if not others.size or not np.isfinite(power).all() or others.max() > APART * peak:
        return 0.0
    return peak / max(float(np.median(others)), 1e-30)


def measure_area(read: ReadChip, strips: Strips) -> Area:
    """Mean power and equivalent number of looks of the covered pixels, read by strips of rows."""
    pixels, total, squares = 0, 0.0, 0.0
    for rows in strips:
        power = power_of(read(rows, slice(None)))
        power = power[np.isfinite(power)].astype(np.float64)
        pixels, total, squares = pixels + power.size, total + float(power.sum()), squares + float((power**2).sum())
    mean = total / pixels if pixels else math.nan
    variance = squares / pixels - mean**2 if pixels > 1 else math.nan
    return Area(pixels, mean, mean**2 / variance if variance > 0 else math.nan)


def noise_floor(read: ReadChip, strips: Strips) -> float:
    """Noise floor: mean power that 1 % of all cells of 16 x 16 covered pixels stay below; NaN if there are none."""
    means: list[FloatArray] = []
    for rows in strips:
        power = power_of(read(rows, slice(None)))
        n_y, n_x = (n // FLOOR_CELL for n in power.shape)
        cells = power[: n_y * FLOOR_CELL, : n_x * FLOOR_CELL].reshape(n_y, FLOOR_CELL, n_x, FLOOR_CELL)
        mean = cells.mean(axis=(1, 3), dtype=np.float64)
        means.append(mean[np.isfinite(mean)])
    every = np.concatenate(means) if means else np.zeros(0)
    return float(np.quantile(every, FLOOR_SHARE)) if every.size else math.nan


def ambiguity_place(geometry: Geometry, x: float, y: float, order: float) -> tuple[float, float] | None:
    """Where the azimuth ambiguity of a point at x, y (m) lies, m: at its range, with a Doppler off by `order` PRFs.

    Both hold at the middle of the point's dwell. Its ghost lies about there, defocused. None if the point is not lit,
    or there is no such place.
    """
    collection = geometry.collection
    start, end = (float(edge) for edge in geometry.beam.dwell(np.array(x), np.array(y)))
    if not start < end:
        return None
    time = np.array((start + end) / 2)
    distance, rate = geometry.range_history(geometry.on_ground(np.array(x), np.array(y)), time)
    rate = rate - order * collection.prf * SPEED_OF_LIGHT / (2 * collection.carrier)
    return ground_place(geometry, (x, y), time, np.array([distance, rate]), longest=float(distance))


def ground_place(
    geometry: Geometry, near: tuple[float, float], time: FloatArray, wanted: FloatArray, *, longest: float
) -> tuple[float, float] | None:
    """Solve for the ground place near another (m) with a range (m) and range rate (m/s) at a time; None if nowhere.

    It is looked for in steps of `longest` at most, m.
    """

    def seen(at: FloatArray) -> FloatArray:
        return np.array(geometry.range_history(geometry.on_ground(at[0], at[1]), time))

    at = newton(seen, wanted, np.array(near), steps=GROUND_STEPS, longest=longest)
    return (float(at[0]), float(at[1])) if (np.abs(seen(at) - wanted) < 1e-3).all() else None


def strongest_about(
    read: ReadChip, x: FloatArray, y: FloatArray, place: tuple[float, float], axes: ResponseAxes
) -> float | None:
    """The largest power within a few widths of a place, m; None where the image does not cover it."""
    reach = GHOST_WIDTHS * (
        axes.range_width * np.abs(axes.range_direction) + axes.azimuth_width * np.abs(axes.azimuth_direction)
    )
    columns, rows = (
        np.flatnonzero(np.abs(axis - at) <= max(extent, abs(axis[1] - axis[0])))
        for axis, at, extent in zip((x, y), place, reach, strict=True)
    )
    if not (columns.size and rows.size):
        return None
    power: Float32Array = power_of(read(slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)))
    return float(np.nanmax(power)) if np.isfinite(power).any() else None
