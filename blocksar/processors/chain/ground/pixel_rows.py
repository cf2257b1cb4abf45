"""Loops over rows of a tile's pixels: ownership, position in the focused block, and weighted sums.

The geometric corrections on the plane and on a terrain share these compiled loops.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit, types

from blocksar.arrays import FloatArray, IntArray
from blocksar.kernels.lanes import FEW, WEIGHED_ROWS, cosine, load_few, sine, spread_few, totals, weigh_rows
from blocksar.kernels.loops import (
    COMPILED,
    FLOATS_IN,
    PART,
    REAL_ROW,
    REAL_ROWS,
    TUPLE,
    UNCHECKED,
    UNCONTRACTED,
    fixed,
    record,
)
from blocksar.kernels.phase import Float32Array

N_CARRIER = 1024  # carriers along Doppler that are told apart, in steps of 1 / N_CARRIER cycles per sample
N_PHASE = 64  # intervals of a sample in a table of taps; between them taps are interpolated, to 1e-4
RANGE_UNIT = WEIGHED_ROWS
DOPPLER_UNIT = FEW // 2  # Doppler samples of a vector register
TILE_DEGREE = 5

# The compiled loops. Rows of pixels lie in arrays as long as a tile's side, allocated once per call: for a view made in
# a loop, numba would count references by locked instructions. Indices are unsigned where the compiler could not rule
# out negative ones, for which it would load element by element.


class Tiles(NamedTuple):
    """The tiles of a window in which a block may own pixels.

    Attributes
    ----------
    across : (side,) float
        Places of the pixels along a side of each, -1 to 1.
    places : (n, 3) int64
        First row and column, and whether the block owns all pixels, and their ranges are not needed.
    polynomials : (n, TILE_DEGREE + 1, 6 (TILE_DEGREE + 1)) float
        Power coefficients in tile coordinates (y, x) in [-1, 1]; on a terrain as `relief_correction` has them.
    heights : (n, 2) float or None
        On a terrain, middle and half of the heights of each, m.
    """

    across: FloatArray
    places: IntArray
    polynomials: FloatArray
    heights: FloatArray | None

    def moved(self, cells: float) -> Tiles:
        """Copy whose Doppler indices are larger by some cells; only for tiles without a terrain."""
        polynomials = self.polynomials.copy()
        polynomials[:, 0, TILE_DEGREE + 1] += cells
        return self._replace(polynomials=polynomials)

    def some(self, which: slice) -> Tiles:
        """Select some tiles, in the layout of the loops."""
        of_each = (self.places, self.polynomials, self.heights)
        return Tiles(fixed(self.across), *(None if all_ is None else fixed(all_[which]) for all_ in of_each))  # type: ignore[arg-type]


class OwnedSector(NamedTuple):
    """Sector of the ground that a block owns, with its calibration.

    Attributes
    ----------
    low, high : (float, float)
        Directions (x, y) of the first and of the last yaw.
    nadir : (float, float)
        m
    centre : (float, float, float)
        Phase centre at the epoch, m: x, y and on a terrain z; on the plane its squared height over the ground.
    near, far : float
        Epoch ranges, m.
    least : float
        Sum of weights over lit pulses below which a pixel is not in the image.
    yaw_start, yaw_step : float
        First yaw of the limits and weights less the middle one, and the step to the next, rad.
    near_limit, far_limit : (n_yaw,) float
        Ranges of the window at each yaw, m.
    weight : (n_range, n_yaw) float
        Sums of weights over lit pulses, at ranges from near to far; or factors, (1, n_yaw).
    """

    low: tuple[float, float]
    high: tuple[float, float]
    nadir: tuple[float, float]
    centre: tuple[float, float, float]
    near: float
    far: float
    least: float
    yaw_start: float
    yaw_step: float
    near_limit: FloatArray
    far_limit: FloatArray
    weight: FloatArray


class AxisTaps(NamedTuple):
    """Interpolation taps along an axis of the focused block.

    Attributes
    ----------
    table : (2 (N_PHASE + 1), n) float32
        See `correction`.
    n_tap, width : int
        Taps, and samples of a window.
    size : int
        Samples of the block, without padding.
    """

    table: Float32Array
    n_tap: int
    width: int
    size: int


class Windows(NamedTuple):
    """Interpolation windows of a row of pixels (n,) in the focused block.

    Attributes
    ----------
    at : int
        Where each begins among the numbers of the block; -1 where there is none.
    first_row, first_doppler : int
        Its first sample; -1 where the taps are not within the block.
    range_at, doppler_at, range_part, doppler_part : int, float32
        Entries of the tables at which its taps begin, and the fractions to the next rows of the tables.
    carrier_at : int
        The first entry of its carrier.
    """

    at: IntArray
    first_row: IntArray
    first_doppler: IntArray
    range_at: IntArray
    doppler_at: IntArray
    carrier_at: IntArray
    range_part: Float32Array
    doppler_part: Float32Array


_PAIR = TUPLE((types.float64,) * 2)
SECTOR = record(
    OwnedSector, *[_PAIR] * 3, TUPLE((types.float64,) * 3), *[types.float64] * 5, REAL_ROW, REAL_ROW, REAL_ROWS
)
AXIS_TAPS = record(AxisTaps, FLOATS_IN, *[types.int64] * 3)


def place_across(tile: int) -> FloatArray:
    """Positions of pixels along a tile's side, -1 to 1."""
    return np.arange(tile) / max((tile - 1) / 2, 0.5) - 1.0


@njit(**PART, **UNCONTRACTED)
def left_of(ray_x: float, ray_y: float, x: float, y: float) -> bool:
    """Whether a point is on a ray or to its left.

    Two products are compared, not their difference with zero: the compiler fuses a difference into a multiply-add,
    which rounds differently for the two neighbours of a seam.
    """
    return ray_x * y >= ray_y * x


@njit(**PART, **UNCONTRACTED)
def find_sector(
    x: FloatArray, first: int, n: int, y: float, sector: OwnedSector, rng: FloatArray, owned: FloatArray
) -> bool:
    """Write the epoch ranges of n pixels from x[first] on, m, and NaN to `owned` outside the sector; both (n,).

    Returns whether any pixel is inside. No operations are contracted: vector and scalar loops, and neighbours, must
    agree to the last bit.
    """
    (low_x, low_y), (high_x, high_y), (nx, ny), (px, py, height2) = sector.low, sector.high, sector.nadir, sector.centre
    near, far, n_inside = sector.near, sector.far, 0
    for k in range(n):
        xx = x[np.uint64(first) + np.uint64(k)]
        r = np.sqrt((xx - px) ** 2 + (y - py) ** 2 + height2)
        between = left_of(low_x, low_y, xx - nx, y - ny) and not left_of(high_x, high_y, xx - nx, y - ny)
        inside = between and r >= near and r < far
        rng[k] = r
        owned[k] = owned[k] if inside else np.nan
        n_inside += 1 if inside else 0
    return n_inside > 0


@njit(**PART, **COMPILED, **UNCHECKED)
def find_limits(turn: FloatArray, sector: OwnedSector, rng: FloatArray, owned: FloatArray) -> None:
    """Set `owned` to NaN for pixels outside the range window at their yaw."""
    start, step, near_limit, far_limit = sector.yaw_start, sector.yaw_step, sector.near_limit, sector.far_limit
    for k in range(owned.size):
        place = (turn[k] - start) / step
        i = min(max(int(place), 0), near_limit.size - 2)
        part = min(max(place - i, 0.0), 1.0)
        near = near_limit[i] + part * (near_limit[i + 1] - near_limit[i])
        far = far_limit[i] + part * (far_limit[i + 1] - far_limit[i])
        if rng[k] < near or rng[k] > far:
            owned[k] = np.nan


@njit(**PART, **COMPILED, **UNCHECKED)
def amplitude_of(
    turn: FloatArray, start: float, per_step: float, weight: FloatArray, loss: FloatArray, owned: FloatArray,
    amplitude: Float32Array,
) -> None:  # fmt: skip
    """Calibration factor of pixels: weight at the nearest yaw over the gain; NaN where not owned."""
    for k in range(owned.size):
        place = min(max((turn[k] - start) * per_step, 0.0), weight.size - 1.0)
        amplitude[k] = owned[k] * weight[np.uint64(np.int64(place + 0.5))] * loss[k]


@njit(**PART, **COMPILED)
def divide_by_sums(
    turn: FloatArray, per_step: float, sector: OwnedSector, rng: FloatArray, loss: FloatArray, owned: FloatArray,
    amplitude: Float32Array,
) -> None:  # fmt: skip
    """Divide amplitudes by the sector's sums over lit pulses, interpolated linearly in range and yaw.

    NaN where the sum is less than the least.
    """
    start, total, near, far, least = sector.yaw_start, sector.weight, sector.near, sector.far, sector.least
    n_range, n_yaw = total.shape
    for k in range(owned.size):
        place = min(max((turn[k] - start) * per_step, 0.0), n_yaw - 1.0)
        row = min(max((rng[k] - near) / (far - near) * (n_range - 1), 0.0), n_range - 1.0)
        if np.isnan(owned[k]) or np.isnan(place + row):
            amplitude[k] = np.nan
            continue
        i, j = min(int(row), n_range - 2), min(int(place), n_yaw - 2)
        p, q = row - i, place - j
        here = (1 - q) * total[i, j] + q * total[i, j + 1]
        value = (1 - p) * here + p * ((1 - q) * total[i + 1, j] + q * total[i + 1, j + 1])
        amplitude[k] = owned[k] * loss[k] / value if value >= least else np.nan


@njit(**PART, **COMPILED)
def along_row(coefficients: FloatArray, t: int, v: float, along: FloatArray) -> None:
    """Evaluate the polynomials of tile t at one v: power coefficients in u for each quantity."""
    c = coefficients
    for m in range(along.size):
        inner = c[t, 2, m] + v * (c[t, 3, m] + v * (c[t, 4, m] + v * c[t, 5, m]))
        along[m] = c[t, 0, m] + v * (c[t, 1, m] + v * inner)


@njit(**PART, **COMPILED)
def evaluate_row(along: FloatArray, across: FloatArray, values: FloatArray) -> None:
    """Evaluate all quantities (n, u.size) for a row of pixels at all u."""
    for q in range(values.shape[0]):
        m = q * (TILE_DEGREE + 1)
        c0, c1, c2, c3, c4, c5 = along[m], along[m + 1], along[m + 2], along[m + 3], along[m + 4], along[m + 5]
        for k in range(across.size):
            u = across[k]
            values[q, k] = c0 + u * (c1 + u * (c2 + u * (c3 + u * (c4 + u * c5))))


@njit(**PART, **COMPILED)
def place_windows(
    position: FloatArray, n_tap: int, width: int, size: int, room: int, step: int, first: IntArray, taps: IntArray,
    part: Float32Array,
) -> None:  # fmt: skip
    """First sample of each pixel's window, and its taps: from entry `taps` of their table on, whose rows are `step`
    entries long, and the fraction `part` to the next row.

    `first` is -1 where the n_tap taps are not within the `size` samples. The padding to `width` is in front of the taps
    where behind it would exceed `room`.
    """
    for k in range(position.size):
        whole = np.floor(position[k])
        fine = (position[k] - whole) * N_PHASE
        start = int(whole) - (n_tap // 2 - 1)
        i = min(int(fine), N_PHASE - 1)
        late = start + width > room
        inside = start >= 0 and start + n_tap <= size
        first[k] = (start - (width - n_tap) if late else start) if inside else -1
        taps[k] = step * (i + (N_PHASE + 1 if late else 0))
        part[k] = fine - i


@njit(**PART, **COMPILED)
def turn_windows(
    doppler: FloatArray, cycles: FloatArray, middle: FloatArray, step: int, windows: Windows, own: Float32Array
) -> None:
    """Carrier of each pixel's response along its window, and the pixel's phase, cycles without whole ones.

    Of a carrier the table has `step` entries.

    The response has the carrier of its dwell time, exp(2j pi middle (sample - doppler)). It is removed to the nearest
    step of 1 / N_CARRIER, which only shifts the band within that of the taps; whole cycles per sample do not matter.
    The carrier's phase at the window's first sample is part of the pixel's own.
    """
    first, carrier = windows.first_doppler, windows.carrier_at
    for k in range(middle.size):
        steps = np.rint(middle[k] * N_CARRIER)
        carrier[k] = step * (int(steps) & (N_CARRIER - 1))
        total = steps / N_CARRIER * (first[k] - doppler[k]) - cycles[k]
        own[k] = total - np.rint(total)


@njit(**PART, **COMPILED)
def phasors_of(cycles: Float32Array, real: Float32Array, imag: Float32Array) -> None:
    """exp(2j pi cycles), real and imaginary part."""
    for k in range(cycles.size):
        real[k] = cosine(cycles[k])
        imag[k] = sine(cycles[k])


@njit(**PART, **COMPILED)
def find_addresses(windows: Windows, stride: int, amplitude: Float32Array) -> None:
    """Address of each pixel's window in the block's numbers; -1, and no amplitude, where there is none."""
    at, first_row, first_doppler = windows.at, windows.first_row, windows.first_doppler
    for k in range(at.size):
        outside = np.isnan(amplitude[k]) or first_row[k] < 0 or first_doppler[k] < 0
        at[k] = -1 if outside else first_row[k] * stride + 2 * first_doppler[k]
        amplitude[k] = np.nan if outside else amplitude[k]


@njit(**PART, **COMPILED)
def taps_between(taps: Float32Array, at: int, step: int, part: float) -> Any:
    """A register of taps, interpolated by the fraction `part` to the next row of its table, `step` entries further."""
    taps_here = load_few(taps, at)
    return taps_here + part * (load_few(taps, at + step) - taps_here)


@njit(**PART, **COMPILED)
def sum_windows(  # type: ignore[no-untyped-def]
    floats, windows, in_range, in_doppler, carriers, real, imag
):
    """Sum over each pixel's window with weights, and remove the carrier along Doppler: real + 1j imag.

    Real and imaginary parts alternate along a row of the block, eight samples in a register. The rows are summed
    first, with one weight each, then the registers are multiplied by the taps along Doppler and by the carrier.
    """
    range_taps, range_width, doppler_taps = in_range.table, in_range.width, in_doppler.table
    stride, range_step, doppler_step = floats.shape[1], range_taps.shape[1], doppler_taps.shape[1]
    at, carrier_at = windows.at, windows.carrier_at
    range_at, range_part, doppler_at, doppler_part = (
        windows.range_at, windows.range_part, windows.doppler_at, windows.doppler_part,
    )  # fmt: skip
    if range_width == RANGE_UNIT and doppler_step == FEW:  # most blocks: nothing but registers
        for k in range(at.size):
            if at[k] < 0:
                continue
            weights = taps_between(range_taps, range_at[k], range_step, range_part[k])
            column = weigh_rows(floats, at[k], stride, weights)
            column = column * taps_between(doppler_taps, doppler_at[k], FEW, doppler_part[k])
            phasor = carrier_at[k]
            re, im = totals(column * load_few(carriers, phasor), column * load_few(carriers, phasor + FEW))
            real[k], imag[k] = re, im
        return
    for k in range(at.size):
        if at[k] < 0:
            continue
        below, above = spread_few(np.float32(0.0)), spread_few(np.float32(0.0))
        for m in range(0, doppler_step, FEW):
            column = spread_few(np.float32(0.0))
            for p in range(0, range_width, RANGE_UNIT):
                weights = taps_between(range_taps, range_at[k] + p, range_step, range_part[k])
                column = column + weigh_rows(floats, at[k] + p * stride + m, stride, weights)
            column = column * taps_between(doppler_taps, doppler_at[k] + m, doppler_step, doppler_part[k])
            phasor = carrier_at[k] + m
            below = below + column * load_few(carriers, phasor)
            above = above + column * load_few(carriers, phasor + doppler_step)
        re, im = totals(below, above)
        real[k], imag[k] = re, im


@njit(**PART, **COMPILED)
def sum_windows_bent(  # type: ignore[no-untyped-def]
    floats, stride, at, range_taps, range_step, range_width, range_at, range_part, real_taps, imag_taps, tap_at,
    tap_step, doppler_part, carriers, carrier_step, carrier_at, real, imag,
):  # fmt: skip
    """Sum as `sum_windows` with complex taps along Doppler: for each pixel `tap_step` entries from `tap_at` on."""
    # Arrays, not records of them: with these the loop took a fifth longer.
    for k in range(at.size):
        if at[k] < 0:
            continue
        below, above = spread_few(np.float32(0.0)), spread_few(np.float32(0.0))
        for m in range(0, tap_step[k], FEW):
            column = spread_few(np.float32(0.0))
            for p in range(0, range_width, RANGE_UNIT):
                weights = taps_between(range_taps, range_at[k] + p, range_step, range_part[k])
                column = column + weigh_rows(floats, at[k] + p * stride + m, stride, weights)
            taps, phasor = tap_at[k] + m, carrier_at[k] + m
            cos, sin = load_few(carriers, phasor), load_few(carriers, phasor + carrier_step)
            straight = column * taps_between(real_taps, taps, tap_step[k], doppler_part[k])
            bent = column * taps_between(imag_taps, taps, tap_step[k], doppler_part[k])
            below, above = below + straight * cos - bent * sin, above + straight * sin + bent * cos
        re, im = totals(below, above)
        real[k], imag[k] = re, im


@njit(**PART, **COMPILED)
def write_row(numbers, first, n, amplitude, own_real, own_imag, real, imag) -> None:  # type: ignore[no-untyped-def]
    """Write n sums times amplitude and phase to numbers[first : first + 2 n]; NaN without amplitude.

    Real and imaginary parts alternate in `numbers`. `real` and `imag` are overwritten.
    """
    missing = np.float32(np.nan)
    for k in range(amplitude.size):
        c, s = amplitude[k] * own_real[k], amplitude[k] * own_imag[k]
        re, im = real[k] * c - imag[k] * s, real[k] * s + imag[k] * c
        outside = np.isnan(amplitude[k])
        real[k] = missing if outside else re
        imag[k] = missing if outside else im
    for k in range(n):
        numbers[np.uint64(first) + np.uint64(2 * k)] = real[k]
        numbers[np.uint64(first) + np.uint64(2 * k + 1)] = imag[k]


@njit(**PART, **COMPILED)
def blank_row(numbers: Float32Array, first: int, n: int) -> None:
    """Write NaN to n pixels that are not owned: numbers[first : first + 2 n]."""
    for k in range(2 * n):
        numbers[np.uint64(first) + np.uint64(k)] = np.float32(np.nan)
