"""Geometric correction: a focused block, range by Doppler, to calibrated ground pixels.

The ground map (`GroundMap`) has the position, phase and gain of each ground point's focus. Over a small tile of pixels
each of these is a polynomial of low degree in (x, y), even the carrier's phase. A compiled loop goes through a tile row
by row: short loops over all pixels of the row evaluate the polynomials, find the pixels that the block owns, and turn
positions into windows and weights; then each owned pixel is one weighted sum over its window of the block, with all
weights in vector registers.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from blocksar.arrays import ComplexArray, FloatArray, IntArray
from blocksar.focusing.ground_map import GroundMap, sum_series
from blocksar.kernels import interpolation
from blocksar.kernels.groups import run_groups
from blocksar.kernels.phase import Float32Array
from blocksar.kernels.trigonometry import cosine, sine
from blocksar.solvers import least_squares, product

TILE_DEGREE = 5
TILE_PIXELS = 64
TILE_EXTENT = 150.0  # m: the largest tile over which its polynomials hold to a millicycle
TILE_GROUP = 16  # tiles per call of the compiled loop
N_PHASE = 256  # intervals of a sample in a table of taps
COARSE = 4096  # steps per cycle: a step times a sample's number is exact in float32
DOPPLER_UNIT = 4  # Doppler samples of a vector register, eight floats
RANGE_UNITS = (12,)  # rows of a window that are unrolled: as many as its taps along range, and a few need more
DOPPLER_UNITS = (2, 3)  # vector registers of a window that are unrolled: the loop is compiled for each of these
# Tuples of these lengths, since the length of a tuple is known when the loop is compiled.
TWELVE, TWO, THREE = (0,) * RANGE_UNITS[0], (0,) * DOPPLER_UNITS[0], (0,) * DOPPLER_UNITS[1]


def covers(ground: GroundMap, x: FloatArray, y: FloatArray) -> bool:
    """Whether the block may own any of these pixels; False is certain. Takes a fraction of a millisecond."""
    return _tiles(ground, x, y, _tile_side(ground, x, y)).shape[0] > 0


def correct(
    block: ComplexArray,
    ground: GroundMap,
    *,
    x: FloatArray,
    y: FloatArray,
    threads: int = 1,
    out: ComplexArray | None = None,
) -> ComplexArray:
    """Resample a focused block to ground pixels; NaN for pixels that it does not own.

    Parameters
    ----------
    block : (at least rows.size, at least doppler.size) complex64, C-contiguous
        Focused.
    x : (n_x,) float
        m, uniform.
    y : (n_y,) float
        m, uniform.
    out : (n_y, n_x) complex64, C-contiguous, optional
        Array for the result; its contents are overwritten. Reusing one saves the slow allocation for each chunk.

    Returns
    -------
    (n_y, n_x) complex64
        Calibrated: 1 + 0j at the position of a unit target.
    """
    out = np.empty((y.size, x.size), np.complex64) if out is None else out
    out[...] = np.nan + 1j * np.nan
    tile = _tile_side(ground, x, y)
    tiles = _tiles(ground, x, y, tile)
    if tiles.shape[0] == 0:
        return out
    coefficients = _tile_polynomials(ground, x, y, tiles, tile)
    along_range, along_doppler = _range_window(*ground.range_taps), _doppler_window(*ground.doppler_taps)
    px, py, pz = ground.geometry.epoch_position
    nx, ny = ground.geometry.nadir
    height2 = float((pz - ground.geometry.collection.ground_height) ** 2)
    # The sides of the two seam rays decide on ownership: the neighbouring block computes the same products from the
    # same numbers, so every pixel has exactly one owner.
    rays = np.array([np.cos(ground.low), np.sin(ground.low), np.cos(ground.high), np.sin(ground.high)])
    frame = np.array([nx, ny, px, py, height2, ground.near, ground.far])
    yaw_start = float(ground.yaw_axis[0] - ground.middle_yaw)
    yaw_step = float(ground.yaw_axis[1] - ground.yaw_axis[0])
    weight = 1.0 / np.maximum(ground.lit, 1e-9) / ground.scale
    weight[ground.lit <= 0] = np.nan
    # Arrays sent to a worker are read-only, for which the loop would be compiled again: copy the small ones, and make
    # the block read-only always.
    x, y, near_limit, far_limit = (np.array(values) for values in (x, y, ground.near_limit, ground.far_limit))
    floats = _with_room(block, along_range, along_doppler).view(np.float32)
    floats.flags.writeable = False

    def resample(group: slice) -> None:
        _resample(
            floats, out, tiles[group], coefficients[group], x, y, tile, along_range.taps, along_doppler.taps,
            (along_range.n_tap, along_doppler.n_tap), along_doppler.unit,
            (ground.rows.size, ground.doppler.size), rays, frame, yaw_start, yaw_step, near_limit, far_limit, weight,
        )  # fmt: skip

    # Python threads over groups of tiles, not numba's own: a dask worker may run several tasks in one process.
    run_groups(resample, [slice(i, i + TILE_GROUP) for i in range(0, tiles.shape[0], TILE_GROUP)], threads)
    return out


def _tile_side(ground: GroundMap, x: FloatArray, y: FloatArray) -> int:
    """Pixels along a tile's side."""
    step = max(abs(x[1] - x[0]) if x.size > 1 else 0.0, abs(y[1] - y[0]) if y.size > 1 else 0.0, 1e-6)
    # Tiles overlap the block's edges; a surface must not be evaluated far beyond its domain.
    narrow = ground.geometry.ground_point(
        np.array(max(ground.near, float(ground.near_limit.min()))), np.array(ground.middle_yaw)
    )
    across = (ground.high - ground.low) * float(np.hypot(*(narrow[:2] - ground.geometry.nadir)))
    reach = min(TILE_EXTENT, across / 8, (ground.far - ground.near) / 8)
    return int(np.clip(reach / step, 1, TILE_PIXELS))


def _tiles(ground: GroundMap, x: FloatArray, y: FloatArray, tile: int) -> FloatArray:
    """Tiles with pixels that the block may own: first row, first column, whether it owns all; (n, 3) int64."""
    corners = np.stack(
        np.meshgrid(np.arange(0, y.size, tile), np.arange(0, x.size, tile), indexing="ij"), axis=-1
    ).reshape(-1, 2)
    last_y = np.minimum(corners[:, 0] + tile, y.size) - 1
    last_x = np.minimum(corners[:, 1] + tile, x.size) - 1
    cy, cx = (y[corners[:, 0]] + y[last_y]) / 2, (x[corners[:, 1]] + x[last_x]) / 2
    radius = np.hypot(y[last_y] - y[corners[:, 0]], x[last_x] - x[corners[:, 1]]) / 2 + 1e-6
    rng = ground.geometry.epoch_range(cx, cy)
    turn = ground.relative_yaw(cx, cy)
    distance = np.hypot(cx - ground.geometry.nadir[0], cy - ground.geometry.nadir[1])
    half = (ground.high - ground.low) / 2
    slack = np.arcsin(np.minimum(radius / np.maximum(distance, radius), 1.0))

    def between(near: float, far: float, margin: float) -> FloatArray:
        near, far = max(ground.near, near) - margin * radius, min(ground.far, far) + margin * radius
        return (np.abs(turn) <= half + margin * slack) & (rng >= near) & (rng <= far)

    touched = between(float(ground.near_limit.min()), float(ground.far_limit.max()), 1.0)
    # Twice the radius inside, so that rounding cannot matter.
    all_owned = between(float(ground.near_limit.max()), float(ground.far_limit.min()), -2.0)
    return np.column_stack([corners, all_owned])[touched]


def _tile_polynomials(ground: GroundMap, x: FloatArray, y: FloatArray, tiles: FloatArray, tile: int) -> FloatArray:
    """(n_tile, degree + 1, 6 (degree + 1)) power coefficients in tile coordinates (y, x) in [-1, 1]."""
    nodes, to_power = _tile_nodes()
    dx = x[1] - x[0] if x.size > 1 else 1.0
    dy = y[1] - y[0] if y.size > 1 else 1.0
    half = (tile - 1) / 2
    px = x[0] + dx * (tiles[:, 1, None, None] + half * (1 + nodes[None, None, :]))
    py = y[0] + dy * (tiles[:, 0, None, None] + half * (1 + nodes[None, :, None]))
    px, py = np.broadcast_arrays(px, py)
    values = np.stack(ground.locate(px, py), axis=1)
    coefficients = np.moveaxis(product(product(to_power, values), to_power.T), 1, 2)
    return np.ascontiguousarray(coefficients).reshape(tiles.shape[0], nodes.size, -1)


@lru_cache(maxsize=1)
def _tile_nodes() -> tuple[FloatArray, FloatArray]:
    """Chebyshev nodes (degree + 1,) in [-1, 1] and the matrix from values there to power coefficients."""
    n = TILE_DEGREE + 1
    nodes = np.cos(np.pi * (np.arange(n) + 0.5) / n)[::-1]
    return nodes, least_squares(np.vander(nodes, n, increasing=True).T, np.eye(n))


class _Window(NamedTuple):
    """Taps along one axis, padded to whole registers, and the unrolling of the loop over them.

    Attributes
    ----------
    taps : (2 (N_PHASE + 1), width) float32
        Padded to `width` with zeros behind; in the second half of the rows in front, for windows at the block's end.
    n_tap : int
        Taps without the padding.
    unit : int
        Number of unrolled taps or registers.
    """

    taps: Float32Array
    n_tap: int
    unit: int


def _window(n_tap: int, occupancy: float, units: tuple[int, ...], samples: int) -> _Window:
    """Taps in the fewest groups that hold them, each of the fewest units (one of `units`) of `samples` samples."""
    groups = -(-n_tap // (units[-1] * samples))
    unit = next(n for n in units if groups * n * samples >= n_tap)
    room = groups * unit * samples - n_tap
    taps = interpolation.interpolation_taps(n_tap, occupancy=occupancy, n_phase=N_PHASE)
    sides = np.concatenate([np.pad(taps, ((0, 0), (0, room))), np.pad(taps, ((0, 0), (room, 0)))])
    return _Window(taps=sides, n_tap=n_tap, unit=unit)


@lru_cache(maxsize=8)
def _range_window(n_tap: int, occupancy: float) -> _Window:
    """Taps along range, one row of the block each."""
    return _window(n_tap, occupancy, RANGE_UNITS, 1)


@lru_cache(maxsize=8)
def _doppler_window(n_tap: int, occupancy: float) -> _Window:
    """Taps along Doppler, each twice: for the real and the imaginary part of a sample."""
    window = _window(n_tap, occupancy, DOPPLER_UNITS, DOPPLER_UNIT)
    return window._replace(taps=np.repeat(window.taps, 2, axis=1))


def _with_room(block: ComplexArray, along_range: _Window, along_doppler: _Window) -> ComplexArray:
    """The block, padded with zeros where it is smaller than two windows, so that one fits from either end."""
    needed = 2 * along_range.taps.shape[1], along_doppler.taps.shape[1]
    lacking = [(0, max(n - size, 0)) for n, size in zip(needed, block.shape, strict=True)]
    return np.pad(block, lacking) if np.any(lacking) else np.ascontiguousarray(block)


# The compiled loops. Rows of pixels lie in arrays as long as a tile's side, allocated once per call: for a view made in
# a loop, numba would count references by locked instructions. Indices are unsigned where the compiler could not rule
# out negative ones, for which it would load element by element.


@njit(forceinline=True, nogil=True)
def _left(ray_x: float, ray_y: float, x: float, y: float) -> bool:
    """Whether a point is on a ray or to its left.

    Two products are compared, not their difference with zero: the compiler fuses a difference into a multiply-add,
    which rounds differently for the two neighbours of a seam.
    """
    return ray_x * y >= ray_y * x


@njit(forceinline=True, nogil=True)
def _sector(
    x: FloatArray, first: int, n: int, y: float, rays: FloatArray, frame: FloatArray, rng: FloatArray, owned: FloatArray
) -> bool:
    """Write the epoch ranges of n pixels from x[first] on, and NaN to `owned` outside the rays and ranges.

    Returns whether any pixel is inside. No operations are contracted: vector and scalar loops, and neighbours, must
    agree to the last bit.
    """
    nx, ny, px, py, height2, near, far = frame[0], frame[1], frame[2], frame[3], frame[4], frame[5], frame[6]
    n_inside = 0
    for k in range(n):
        xx = x[np.uint64(first) + np.uint64(k)]
        r = np.sqrt((xx - px) ** 2 + (y - py) ** 2 + height2)
        between = _left(rays[0], rays[1], xx - nx, y - ny) and not _left(rays[2], rays[3], xx - nx, y - ny)
        inside = between and r >= near and r < far
        rng[k] = r
        owned[k] = owned[k] if inside else np.nan
        n_inside += 1 if inside else 0
    return n_inside > 0


@njit(forceinline=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _limit(
    turn: FloatArray, start: float, step: float, near_limit: FloatArray, far_limit: FloatArray, rng: FloatArray,
    owned: FloatArray,
) -> None:  # fmt: skip
    """Write NaN to `owned` for pixels outside the range window at their yaw."""
    for k in range(owned.size):
        place = (turn[k] - start) / step
        i = min(max(int(place), 0), near_limit.size - 2)
        part = min(max(place - i, 0.0), 1.0)
        near = near_limit[i] + part * (near_limit[i + 1] - near_limit[i])
        far = far_limit[i] + part * (far_limit[i + 1] - far_limit[i])
        if rng[k] < near or rng[k] > far:
            owned[k] = np.nan


@njit(forceinline=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _amplitude(
    turn: FloatArray, start: float, step: float, weight: FloatArray, gain: FloatArray, owned: FloatArray,
    amplitude: Float32Array,
) -> None:  # fmt: skip
    """The factor that calibrates a pixel: the weight at the nearest yaw over the gain; NaN where not owned."""
    for k in range(owned.size):
        place = min(max((turn[k] - start) / step, 0.0), weight.size - 1.0)
        amplitude[k] = owned[k] * weight[np.uint64(np.int64(place + 0.5))] / gain[k]


@njit(forceinline=True, nogil=True, fastmath={"contract", "nsz"})
def _along(coefficients: FloatArray, t: int, v: float, along: FloatArray) -> None:
    """Polynomials of tile t at one v: power coefficients in u, quantity by quantity."""
    c = coefficients
    for m in range(along.size):
        inner = c[t, 2, m] + v * (c[t, 3, m] + v * (c[t, 4, m] + v * c[t, 5, m]))
        along[m] = c[t, 0, m] + v * (c[t, 1, m] + v * inner)


@njit(forceinline=True, nogil=True, fastmath={"contract", "nsz"})
def _evaluate(along: FloatArray, q: int, across: FloatArray, values: FloatArray) -> None:
    """Quantity q of a row of pixels, at all u."""
    m = q * (TILE_DEGREE + 1)
    c0, c1, c2, c3, c4, c5 = along[m], along[m + 1], along[m + 2], along[m + 3], along[m + 4], along[m + 5]
    for k in range(across.size):
        u = across[k]
        values[k] = c0 + u * (c1 + u * (c2 + u * (c3 + u * (c4 + u * c5))))


@njit(forceinline=True, nogil=True, fastmath={"contract", "nsz"})
def _place(
    position: FloatArray, n_tap: int, width: int, size: int, room: int, first: IntArray, row: IntArray,
    part: Float32Array,
) -> None:  # fmt: skip
    """First sample of each pixel's window, and its taps: row `row` of the table and the fraction `part` to the next.

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
        row[k] = i + (N_PHASE + 1 if late else 0)
        part[k] = fine - i


@njit(forceinline=True, nogil=True, fastmath={"contract", "nsz"})
def _turns(
    doppler: FloatArray, cycles: FloatArray, middle: FloatArray, first: IntArray, own: Float32Array,
    unit: Float32Array, coarse: Float32Array, fine: Float32Array,
) -> None:  # fmt: skip
    """Phase of each pixel's response along its window, in cycles without whole ones.

    The response has the carrier of its dwell time, exp(2j pi middle (sample - doppler)). The carrier's phase at the
    window's first sample is combined with the pixel's own phase (`own`); from there it advances by coarse + fine per
    sample and by `unit` per register.
    """
    for k in range(middle.size):
        total = middle[k] * (first[k] - doppler[k]) - cycles[k]
        own[k] = total - np.rint(total)
    for k in range(middle.size):
        rest = middle[k] - np.rint(middle[k])
        steps = np.rint(rest * COARSE) / COARSE
        coarse[k] = steps
        fine[k] = rest - steps
        total = DOPPLER_UNIT * rest
        unit[k] = total - np.rint(total)


@njit(forceinline=True, nogil=True, fastmath={"contract", "nsz"})
def _phasors(cycles: Float32Array, real: Float32Array, imag: Float32Array) -> None:
    """exp(2j pi cycles), real and imaginary part."""
    for k in range(cycles.size):
        real[k] = cosine(cycles[k])
        imag[k] = sine(cycles[k])


@njit(forceinline=True, nogil=True, fastmath={"contract", "nsz", "reassoc"})
def _add(total: Any, term: Any) -> Any:
    """total + term, reordered at will: the sum may run in several lanes."""
    return total + term


@njit(forceinline=True, nogil=True, fastmath={"contract", "nsz"})
def _between(taps: Float32Array, at: int, step: int, part: float) -> Any:
    """A tap, interpolated by the fraction `part` to the next row of its table, `step` entries further."""
    return taps[at] + part * (taps[at + step] - taps[at])


@njit(forceinline=True, nogil=True, fastmath={"contract", "nsz"})
def _window_sums(  # type: ignore[no-untyped-def]
    flat, stride, at, range_taps, range_step, range_row, range_part, doppler_taps, doppler_step, doppler_row,
    doppler_part, coarse, fine, unit_real, unit_imag, range_unit, doppler_unit, lanes, weight, real, imag,
):  # fmt: skip
    """real + 1j imag: for each pixel the weighted sum over its window, with the carrier along Doppler removed.

    Real and imaginary parts alternate along a row of the block, eight floats per register. For the sum's real part the
    lanes are multiplied by cos, -sin, cos, .. and for its imaginary part by sin, cos, sin, ..: cosine and sine of each
    lane's phase plus zero or a quarter cycle (`lanes`: sample and quarter of each). Rows are unrolled and the two or
    three registers written out, so that the loop over lanes becomes straight vector code. The loop over lanes stores
    nothing, since the compiler could not rule out that a store changes a later load.
    """
    n_row, n_unit, n_lane = len(range_unit), len(doppler_unit), 2 * DOPPLER_UNIT
    one, two = np.uint64(n_lane), np.uint64(2 * n_lane)
    for k in range(at.size):
        real[k] = np.float32(0.0)
        imag[k] = np.float32(0.0)
    for p0 in range(np.uint64(0), range_step, np.uint64(n_row)):
        for m0 in range(np.uint64(0), doppler_step, np.uint64(n_lane * n_unit)):
            offset = np.float32(m0 // np.uint64(2))
            for k in range(at.size):
                if at[k] < 0:
                    continue
                tap, part = np.uint64(range_row[k]) * range_step + p0, range_part[k]
                for p in range(np.uint64(weight.size)):
                    weight[p] = _between(range_taps, tap + p, range_step, part)
                start = np.uint64(at[k]) + p0 * stride + m0
                tap, part = np.uint64(doppler_row[k]) * doppler_step + m0, doppler_part[k]
                steps, rest, unit_cos, unit_sin = coarse[k], fine[k], unit_real[k], unit_imag[k]
                re, im = np.float32(0.0), np.float32(0.0)
                for lane in range(n_lane):
                    sample = lanes[0, lane] + offset
                    turn = steps * sample + lanes[1, lane]
                    turn = (turn - np.rint(turn)) + rest * sample
                    cos, sin = cosine(turn), sine(turn)
                    # All registers of a row, then the next row: these sums do not depend on each other.
                    first, second, third = np.float32(0.0), np.float32(0.0), np.float32(0.0)
                    m = start + np.uint64(lane)
                    for p in range(n_row):
                        first += weight[p] * flat[m]
                        second += weight[p] * flat[m + one]
                        if n_unit == 3:
                            third += weight[p] * flat[m + two]
                        m += stride
                    m = tap + np.uint64(lane)
                    first *= _between(doppler_taps, m, doppler_step, part)
                    re, im = _add(re, first * cos), _add(im, first * sin)
                    cos, sin = cos * unit_cos - sin * unit_sin, sin * unit_cos + cos * unit_sin
                    second *= _between(doppler_taps, m + one, doppler_step, part)
                    re, im = _add(re, second * cos), _add(im, second * sin)
                    if n_unit == 3:
                        cos, sin = cos * unit_cos - sin * unit_sin, sin * unit_cos + cos * unit_sin
                        third *= _between(doppler_taps, m + two, doppler_step, part)
                        re, im = _add(re, third * cos), _add(im, third * sin)
                real[k] += re
                imag[k] += im


@njit(cache=True, nogil=True, fastmath={"contract", "nsz"})
def _resample(  # type: ignore[no-untyped-def]
    floats, out, tiles, coefficients, x, y, tile, range_table, doppler_table, n_taps, n_register, sizes,
    rays, frame, yaw_start, yaw_step, near_limit, far_limit, weight,
):  # fmt: skip
    """Write the owned pixels of some tiles to `out`, row by row."""
    n_row, n_doppler = floats.shape[0], floats.shape[1] // 2
    flat, stride = floats.reshape(-1), np.uint64(floats.shape[1])
    range_taps, range_width = range_table.reshape(-1), range_table.shape[1]
    doppler_taps, doppler_width = doppler_table.reshape(-1), doppler_table.shape[1] // 2
    range_step, doppler_step = np.uint64(range_width), np.uint64(2 * doppler_width)
    range_weight, lanes = np.empty(len(TWELVE), np.float32), np.empty((2, 2 * DOPPLER_UNIT), np.float32)
    for m in range(2 * DOPPLER_UNIT):
        lanes[0, m], lanes[1, m] = m // 2, 0.25 * (m % 2)
    across, along = np.arange(tile) / max((tile - 1) / 2, 0.5) - 1.0, np.empty(coefficients.shape[2])
    row, doppler, cycles, gain = np.empty(tile), np.empty(tile), np.empty(tile), np.empty(tile)
    turn, middle, rng, owned = np.empty(tile), np.empty(tile), np.empty(tile), np.empty(tile)
    first_row, range_row, at = np.empty(tile, np.int64), np.empty(tile, np.int64), np.empty(tile, np.int64)
    first_doppler, doppler_row = np.empty(tile, np.int64), np.empty(tile, np.int64)
    parts = np.empty((13, tile), np.float32)
    range_part, doppler_part, own, unit, coarse, fine = parts[0], parts[1], parts[2], parts[3], parts[4], parts[5]
    own_real, own_imag, unit_real, unit_imag = parts[6], parts[7], parts[8], parts[9]
    amplitude, real, imag = parts[10], parts[11], parts[12]
    for t in range(tiles.shape[0]):
        i0, j0, every = tiles[t, 0], tiles[t, 1], tiles[t, 2] != 0
        n = min(tile, out.shape[1] - j0)
        for i in range(i0, min(i0 + tile, out.shape[0])):
            for k in range(tile):
                owned[k] = 1.0 if k < n else np.nan
            if not every and not _sector(x, j0, n, y[i], rays, frame, rng, owned):
                continue
            _along(coefficients, t, across[i - i0], along)
            _evaluate(along, 0, across, row)
            _evaluate(along, 1, across, doppler)
            _evaluate(along, 2, across, cycles)
            _evaluate(along, 3, across, gain)
            _evaluate(along, 4, across, turn)
            _evaluate(along, 5, across, middle)
            if not every:
                _limit(turn, yaw_start, yaw_step, near_limit, far_limit, rng, owned)
            _amplitude(turn, yaw_start, yaw_step, weight, gain, owned, amplitude)
            _place(row, n_taps[0], range_width, sizes[0], n_row, first_row, range_row, range_part)
            _place(doppler, n_taps[1], doppler_width, sizes[1], n_doppler, first_doppler, doppler_row, doppler_part)
            _turns(doppler, cycles, middle, first_doppler, own, unit, coarse, fine)
            _phasors(own, own_real, own_imag)
            _phasors(unit, unit_real, unit_imag)
            for k in range(tile):
                outside = np.isnan(amplitude[k]) or first_row[k] < 0 or first_doppler[k] < 0
                at[k] = -1 if outside else first_row[k] * floats.shape[1] + 2 * first_doppler[k]
            if n_register == len(TWO):
                _window_sums(
                    flat, stride, at, range_taps, range_step, range_row, range_part, doppler_taps, doppler_step,
                    doppler_row, doppler_part, coarse, fine, unit_real, unit_imag, TWELVE, TWO, lanes,
                    range_weight, real, imag,
                )  # fmt: skip
            else:
                _window_sums(
                    flat, stride, at, range_taps, range_step, range_row, range_part, doppler_taps, doppler_step,
                    doppler_row, doppler_part, coarse, fine, unit_real, unit_imag, TWELVE, THREE, lanes,
                    range_weight, real, imag,
                )  # fmt: skip
            for k in range(n):
                if at[k] >= 0:
                    c, s = amplitude[k] * own_real[k], amplitude[k] * own_imag[k]
                    out[i, j0 + k] = complex(real[k] * c - imag[k] * s, real[k] * s + imag[k] * c)


def compile_kernels() -> None:
    """Compile this module's loops, or load them from numba's cache, by a run on minimal arrays."""
    line = np.zeros(2)
    sum_series(np.zeros((1, 1)), line, line, line)
    floats = np.zeros((1, 2), np.float32)
    floats.flags.writeable = False
    tiles, table = np.zeros((0, 3), np.int64), np.zeros((2, 2), np.float32)
    _resample(
        floats, np.zeros((1, 1), np.complex64), tiles, np.zeros((0, 6, 36)), line, line, 1, table, table,
        (2, 2), len(TWO), (1, 1), np.zeros(4), np.zeros(7), 0.0, 1.0, line, line, line,
    )  # fmt: skip
