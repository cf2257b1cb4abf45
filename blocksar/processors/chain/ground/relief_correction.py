"""Geometric correction on a terrain: from a focused block to calibrated pixels at their own heights.

As on the plane (`correction`), positions and phases are polynomials over a tile of pixels, here in x, y and the
height: of degree 3, 3 and 2. The range from the antenna, whose multiple is the carrier's phase, is computed for each
pixel; what is left is smooth.

A block is fitted on the smooth part of its terrain. A target far above or below it keeps a phase that is quadratic over
its dwell: the bend. It changes as slowly over the ground as the height does, so that the interpolation along Doppler,
a sum over the dwell, takes it out: each pixel has the taps for its own bend.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit, types

from blocksar.arrays import FloatArray, IntArray
from blocksar.collection.grid import spacing
from blocksar.kernels import interpolation
from blocksar.kernels.interpolation import bent_errors
from blocksar.kernels.loops import (
    COMPILED,
    FLOATS_IN,
    NUMBERS_OUT,
    PAIR,
    PART,
    POWERS,
    REAL_ROW,
    REAL_ROWS,
    TILES,
    TUPLE,
    UNCHECKED,
    UNCONTRACTED,
    fixed,
    loop,
    record,
)
from blocksar.kernels.phase import Float32Array
from blocksar.processors.chain.ground.ground_map import GroundMap, ReliefMap
from blocksar.processors.chain.ground.pixel_rows import (
    AXIS_TAPS,
    DOPPLER_UNIT,
    N_PHASE,
    SECTOR,
    AxisTaps,
    Tiles,
    Windows,
    amplitude_of,
    blank_row,
    divide_by_sums,
    find_addresses,
    find_limits,
    left_of,
    phasors_of,
    place_windows,
    sum_windows_bent,
    turn_windows,
    write_row,
)
from blocksar.solvers import least_squares

DEGREE = 3  # of a tile's polynomials in x and y
HEIGHT_DEGREE = 2  # and in the height
QUANTITIES = 7  # row, Doppler, phase, 1 / gain, yaw, dwell time, bend
N_BEND = 96  # steps between the most negative bend and the most positive one
LEAST_BEND = 1e-3  # cycles at the dwell's ends: less is left
FLOAT_ROW = types.Array(types.float32, 1, "C", readonly=True)
NODE_VALUES = types.Array(types.float64, 5, "C", readonly=True)
LEVEL = 1e-3  # m: half the relief of a tile at least


class BentTaps(NamedTuple):
    """Doppler taps for quadratic phases ("bends"), and shorter ones for slight bends.

    Attributes
    ----------
    real, imag : (n,) float32
        Rows of 2 width[0] entries, each tap twice, 2 (N_PHASE + 1) for each of n_bend[0] bends; behind them those of
        2 width[1] entries for the n_bend[1] bends in their middle.
    n_tap, width, n_bend : (int, int)
        Of all bends, and of slight ones: taps, samples that are summed, and number of bends.
    """

    real: Float32Array
    imag: Float32Array
    n_tap: tuple[int, int]
    width: tuple[int, int]
    n_bend: tuple[int, int]


class ReliefTaps(NamedTuple):
    """Taps along both axes for a block on a terrain, with their tables.

    Attributes
    ----------
    in_range : AxisTaps
    bent : BentTaps
    per_bend : float
        Steps between the bends of taps a cycle at the dwell's ends.
    n_doppler : int
        Samples of the block along Doppler, without padding.
    carriers : (2 N_CARRIER, n) float32
        Factors that remove carriers.
    """

    in_range: AxisTaps
    bent: BentTaps
    per_bend: float
    n_doppler: int
    carriers: Float32Array


_BENT = record(BentTaps, FLOAT_ROW, FLOAT_ROW, *[PAIR] * 3)
RELIEF_TAPS = record(ReliefTaps, AXIS_TAPS, _BENT, types.float64, types.int64, FLOATS_IN)
RAISED_TILES = record(Tiles, REAL_ROW, TILES, POWERS, REAL_ROWS)


def bend_scale(ground: GroundMap) -> float:
    """Phase in cycles at the ends of the dwell for a bend of 1 cycle/s^2: the scale of the taps."""
    return (ground.doppler_taps[1] / 2 / ground.doppler.step) ** 2


def bent_taps_of(ground: GroundMap, relief: ReliefMap) -> tuple[BentTaps, float]:
    """Make the taps of a block; also return its largest bend, cycles at the dwell's ends."""
    n_tap, occupancy = ground.doppler_taps
    most = relief.most_bend * bend_scale(ground)
    most = 0.0 if most < LEAST_BEND else most
    # A bend spreads a response over 4 q / occupancy samples on either side.
    reach = int(np.ceil(4 * most / max(occupancy, 0.05)))
    return _bent_taps((min(n_tap + 2 * reach, 32), n_tap), occupancy, most, ground.tap_error), most


@lru_cache(maxsize=8)
def _bent_taps(n_tap: tuple[int, int], occupancy: float, most: float, allowed: float) -> BentTaps:
    """Make taps for bends up to `most`; shorter ones for those slight bends that keep the `allowed` error."""
    bends = np.linspace(-most, most, N_BEND + 1) if most else np.zeros(1)
    width = -(-n_tap[0] // DOPPLER_UNIT) * DOPPLER_UNIT, -(-n_tap[1] // DOPPLER_UNIT) * DOPPLER_UNIT
    slight = bends[:0]
    if width[1] < width[0]:
        error = bent_errors(n_tap[1], bends, occupancy=occupancy)
        slight = bends[error <= max(allowed, error.min())]
    tables = [_table(n, occupancy, some) for n, some in zip(n_tap, (bends, slight), strict=True)]
    real, imag = (fixed(np.concatenate(parts)) for parts in zip(*tables, strict=True))
    return BentTaps(real, imag, n_tap, width, (bends.size, slight.size))


def _table(n_tap: int, occupancy: float, bends: FloatArray) -> list[Float32Array]:
    """Table of real and imaginary taps for some bends, each tap twice, row by row.

    Rows are padded with zeros to whole units: behind the taps, and in the second half of a bend's rows in front, for
    windows at the block's end.
    """
    room, parts = -n_tap % DOPPLER_UNIT, []
    for taps in interpolation.bent_taps(n_tap, bends, occupancy=occupancy, n_phase=N_PHASE):
        early = np.pad(taps, ((0, 0), (0, 0), (0, room)))
        late = np.pad(taps, ((0, 0), (0, 0), (room, 0)))
        parts.append(np.repeat(np.concatenate([early, late], axis=1).ravel(), 2))
    return parts


def locate_on_relief(
    ground: GroundMap, relief: ReliefMap, x: FloatArray, y: FloatArray, z: FloatArray
) -> tuple[FloatArray, ...]:
    """Row and Doppler index, phase (cycles), 1 / gain, relative yaw, dwell time and bend of points (...), m.

    x and y may lack the first axis of z: these points lie above each other.
    The yaw is that of the point of the smooth ground with the same range and place in the beam. The row is without
    (range - origin) / step, the phase without the carrier's. The dwell time is in cycles per Doppler sample, the bend
    in cycles at the dwell's ends.
    """
    epoch_range, turn = ground.geometry.epoch_range(x, y, z), ground.relative_yaw(x, y)
    offset, doppler, cycles, gain, time, bend, beyond = relief(epoch_range, ground.middle_yaw + turn, z)
    if ground.common is not None:
        common, rate, _ = ground.common.evaluate(epoch_range - ground.origin + offset, doppler[..., None])
        cycles, time = cycles + common[..., 0], time - rate[..., 0]
    return (
        (offset - ground.rows.start) / ground.rows.step,
        ground.doppler.position(doppler),
        cycles,
        1 / gain,
        turn + beyond if relief.turns else np.broadcast_to(turn, epoch_range.shape),
        time * ground.doppler.step,
        bend * bend_scale(ground),
    )


@lru_cache(maxsize=4)
def nodes_of(degree: int) -> tuple[FloatArray, FloatArray]:
    """Chebyshev nodes (degree + 1,) in [-1, 1] and the matrix from values there to power coefficients."""
    n = degree + 1
    nodes = np.cos(np.pi * (np.arange(n) + 0.5) / n)[::-1]
    return nodes, least_squares(np.vander(nodes, n, increasing=True).T, np.eye(n))


def tile_polynomials(
    ground: GroundMap, relief: ReliefMap, windows: Sequence[tuple[FloatArray, FloatArray]],
    heights: Sequence[FloatArray | None], side: IntArray, places: IntArray, owner: IntArray,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Polynomials and heights of tiles: of sides `side` (n,), at `places` (n, 3) of the windows `owner` (n,).

    Parameters
    ----------
    windows : sequence of ((n_x,) float, (n_y,) float)
        Their x and y, m.
    heights : sequence of (n_y, n_x) float
        Theirs, m.
    owner : (n,) int
        Ascending.

    Returns
    -------
    (n, 4, 3 * 7 * 4) float
        Coefficients in tile coordinates.
    (n, 2) float
        Middle and half of the heights, m.
    """
    nodes, to_power = nodes_of(DEGREE)
    levels, to_level = nodes_of(HEIGHT_DEGREE)
    origin = np.array([(x[0], spacing(x), y[0], spacing(y)) for x, y in windows])[owner, :, None, None]
    half = (side[:, None, None] - 1) / 2
    px = origin[:, 0] + origin[:, 1] * (places[:, 1, None, None] + half * (1 + nodes[None, None, :]))
    py = origin[:, 2] + origin[:, 3] * (places[:, 0, None, None] + half * (1 + nodes[None, :, None]))
    spans = np.empty((places.shape[0], 2))
    ends = np.searchsorted(owner, np.arange(len(windows) + 1))
    for z, first, end in zip(heights, ends[:-1], ends[1:], strict=True):
        if end > first:
            assert z is not None
            _find_spans(np.ascontiguousarray(z), places[first:end], int(side[first]), spans[first:end])
    pz = spans[:, 0, None, None] + spans[:, 1, None, None] * levels[:, None, None, None]  # (height, n_tile, 1, 1)
    values = np.stack(locate_on_relief(ground, relief, px, py, pz))  # (quantity, height, n_tile, y, x)
    coefficients = np.empty((places.shape[0], nodes.size, levels.size * QUANTITIES * nodes.size))
    _to_powers(values, to_level, to_power, coefficients)
    return coefficients, spans


@loop(NODE_VALUES, REAL_ROWS, REAL_ROWS, types.float64[:, :, ::1], **COMPILED)
def _to_powers(values: FloatArray, to_level: FloatArray, to_power: FloatArray, coefficients: FloatArray) -> None:
    """Convert values (quantity, height, n_tile, y, x) at nodes to power coefficients, by the matrices of `nodes_of`.

    Those of tile t are written to coefficients[t, b, (h * QUANTITIES + q) * (DEGREE + 1) + a], of the powers b of y, h
    of the height and a of x.
    """
    n, n_level = to_power.shape[0], to_level.shape[0]
    level, along = np.empty((n, n)), np.empty((n, n))
    for t in range(values.shape[2]):
        for h in range(n_level):
            for q in range(QUANTITIES):
                for i in range(n):
                    for j in range(n):
                        total = 0.0
                        for m in range(n_level):
                            total += to_level[h, m] * values[q, m, t, i, j]
                        level[i, j] = total
                for i in range(n):
                    for a in range(n):
                        total = 0.0
                        for j in range(n):
                            total += to_power[a, j] * level[i, j]
                        along[i, a] = total
                for b in range(n):
                    for a in range(n):
                        total = 0.0
                        for i in range(n):
                            total += to_power[b, i] * along[i, a]
                        coefficients[t, b, (h * QUANTITIES + q) * n + a] = total


@loop(REAL_ROWS, TILES, types.int64, types.float64[:, ::1], nogil=True)
def _find_spans(z: FloatArray, tiles: IntArray, tile: int, spans: FloatArray) -> None:
    """Middle and half span of the known heights of each tile, m; the half is at least LEVEL."""
    lows, highs = np.empty(tile), np.empty(tile)
    for t in range(tiles.shape[0]):
        j0 = tiles[t, 1]
        n = min(tile, z.shape[1] - j0)
        lows[:], highs[:] = np.inf, -np.inf
        for i in range(tiles[t, 0], min(tiles[t, 0] + tile, z.shape[0])):
            for k in range(n):  # by columns, so that many go at once
                at = z[np.uint64(i), np.uint64(j0) + np.uint64(k)]
                # Comparisons with NaN are false.
                lows[k] = at if at < lows[k] else lows[k]
                highs[k] = at if at > highs[k] else highs[k]
        low, high = np.inf, -np.inf
        for k in range(tile):  # not `min` of arrays: to load that takes longer than a plan
            low, high = min(low, lows[k]), max(high, highs[k])
        if low > high:
            low = high = 0.0
        spans[t, 0], spans[t, 1] = (low + high) / 2, max((high - low) / 2, LEVEL)


@njit(**PART, **UNCONTRACTED)
def _sector(  # type: ignore[no-untyped-def]
    x, first, n, y, z, row, sector, rng, owned,
):  # fmt: skip
    """Compute the epoch ranges of n pixels from x[first] on; `owned` is NaN outside the sector.

    Returns whether any pixel is inside. No operations are contracted, as in `pixel_rows.find_sector`.
    """
    (low_x, low_y), (high_x, high_y), (nx, ny), (px, py, pz) = sector.low, sector.high, sector.nadir, sector.centre
    near, far, n_inside = sector.near, sector.far, 0
    for k in range(n):
        xx, dz = x[np.uint64(first) + np.uint64(k)], z[row, np.uint64(first) + np.uint64(k)] - pz
        r = np.sqrt((xx - px) ** 2 + (y - py) ** 2 + dz * dz)
        between = left_of(low_x, low_y, xx - nx, y - ny) and not left_of(high_x, high_y, xx - nx, y - ny)
        inside = between and r >= near and r < far
        rng[k] = r
        owned[k] = owned[k] if inside else np.nan
        n_inside += 1 if inside else 0
    return n_inside > 0


@njit(**PART, **UNCONTRACTED)
def _ranges(x, first, n, y, z, row, sector, rng, owned):  # type: ignore[no-untyped-def]
    """Compute the epoch ranges of n pixels from x[first] on; `owned` is NaN where the height is unknown.

    For tiles that the block owns as a whole.
    """
    px, py, pz = sector.centre
    for k in range(n):
        xx, dz = x[np.uint64(first) + np.uint64(k)], z[row, np.uint64(first) + np.uint64(k)] - pz
        r = np.sqrt((xx - px) ** 2 + (y - py) ** 2 + dz * dz)
        rng[k] = r
        owned[k] = np.nan if np.isnan(r) else owned[k]


@njit(**PART, **COMPILED, **UNCHECKED)
def _level_heights(tiles, t, z, row, first, n, w) -> None:  # type: ignore[no-untyped-def]
    """Scale the heights of n pixels from z[row, first] on to -1 .. 1 in the span of tile t; NaN becomes 0."""
    middle, per_half = tiles.heights[t, 0], 1 / tiles.heights[t, 1]
    for k in range(n):
        at = (z[row, np.uint64(first) + np.uint64(k)] - middle) * per_half
        w[k] = 0.0 if np.isnan(at) else at


@njit(**PART, **COMPILED, **UNCHECKED)
def _evaluate(tiles, t, v, w, cubics, values) -> None:  # type: ignore[no-untyped-def]
    """Evaluate all quantities for a row of tile t at one v and all u; w has the scaled heights.

    What the square of the height is multiplied by is taken as linear in u: the rest was 2e-6 cycles over hills of
    300 m.
    """
    c, across = tiles.polynomials, tiles.across
    for m in range(cubics.size):
        cubics[m] = c[t, 0, m] + v * (c[t, 1, m] + v * (c[t, 2, m] + v * c[t, 3, m]))
    side = DEGREE + 1
    for q in range(QUANTITIES):
        a, b, d = q * side, (QUANTITIES + q) * side, (2 * QUANTITIES + q) * side
        a0, a1, a2, a3 = cubics[a], cubics[a + 1], cubics[a + 2], cubics[a + 3]
        b0, b1, b2, b3 = cubics[b], cubics[b + 1], cubics[b + 2], cubics[b + 3]
        c0, c1 = cubics[d], cubics[d + 1]
        for k in range(w.size):
            u = across[k]
            level, slope = a0 + u * (a1 + u * (a2 + u * a3)), b0 + u * (b1 + u * (b2 + u * b3))
            values[q, k] = level + w[k] * (slope + w[k] * (c0 + u * c1))


@njit(**PART, **COMPILED)
def _choose_taps(  # type: ignore[no-untyped-def]
    bend, doppler, taps, room, windows, tap_at, tap_step
):
    """Choose the row of taps of each pixel and its length; for slight bends also shift the first sample.

    Fewer taps have the same fractions between samples, and their window is within that of all taps.
    """
    per_bend, (n_bend, n_slight), (width, few_width), n_few = (
        taps.per_bend, taps.bent.n_bend, taps.bent.width, taps.bent.n_tap[1],
    )  # fmt: skip
    doppler_row, first_doppler = windows.doppler_at, windows.first_doppler
    per_phase, first_slight = 2 * (N_PHASE + 1), (n_bend - n_slight) // 2
    all_step, few_step = 2 * width, 2 * few_width
    slight_rows = n_bend * per_phase * all_step
    for k in range(bend.size):
        which = min(max(int(np.rint(bend[k] * per_bend)) + n_bend // 2, 0), n_bend - 1)
        slight, phase = which - first_slight, doppler_row[k]
        start = int(np.floor(doppler[k])) - (n_few // 2 - 1)
        late = start + few_width > room
        early_phase = phase - (N_PHASE + 1) if phase > N_PHASE else phase
        few_phase = early_phase + (N_PHASE + 1 if late else 0)
        few = (slight >= 0) & (slight < n_slight) & (first_doppler[k] >= 0)
        tap_step[k] = few_step if few else all_step
        tap_at[k] = slight_rows + (slight * per_phase + few_phase) * few_step if few else (
            which * per_phase + phase
        ) * all_step  # fmt: skip
        first_few = start - (few_width - n_few) if late else start
        first_doppler[k] = first_few if few else first_doppler[k]


@loop(
    FLOATS_IN, NUMBERS_OUT, RAISED_TILES, REAL_ROW, REAL_ROW, REAL_ROWS, RELIEF_TAPS, SECTOR,
    TUPLE((types.float64,) * 3), **COMPILED,
)  # fmt: skip
def resample_on_relief(  # type: ignore[no-untyped-def]
    floats, numbers, tiles, x, y, z, taps, sector, scales
):
    """Resample the owned pixels of some tiles into `numbers`, real and imaginary parts row by row.

    `scales` has the cycles and the rows a metre, and the range origin, m.
    """
    in_range, bent, across, yaw_step, by_yaw = taps.in_range, taps.bent, tiles.across, sector.yaw_step, sector.weight[0]
    n_row, n_doppler, stride = floats.shape[0], floats.shape[1] // 2, floats.shape[1]
    range_step, tile = in_range.table.shape[1], across.size
    carrier_cycles, per_row, origin = scales
    values = np.empty((QUANTITIES, tile))
    row, doppler, cycles, loss, turn, middle, bend = (
        values[0], values[1], values[2], values[3], values[4], values[5], values[6],
    )  # fmt: skip
    rng, owned, w, cubics = np.empty(tile), np.empty(tile), np.empty(tile), np.empty(tiles.polynomials.shape[2])
    for k in range(tile):  # `np.zeros` takes longer to compile
        rng[k], w[k] = 0.0, 0.0
    places, parts = np.empty((8, tile), np.int64), np.empty((8, tile), np.float32)
    windows = Windows(places[0], places[1], places[2], places[3], places[4], places[5], parts[0], parts[1])
    tap_at, tap_step, own, own_real, own_imag = places[6], places[7], parts[2], parts[3], parts[4]
    amplitude, real, imag = parts[5], parts[6], parts[7]
    for t in range(tiles.places.shape[0]):
        i0, j0, every = tiles.places[t, 0], tiles.places[t, 1], tiles.places[t, 2] != 0
        n = min(tile, x.size - j0)
        for i in range(i0, min(i0 + tile, y.size)):
            start = 2 * (i * x.size + j0)
            for k in range(tile):
                owned[k] = 1.0 if k < n else np.nan
            if every:
                _ranges(x, j0, n, y[i], z, i, sector, rng, owned)
            elif not _sector(x, j0, n, y[i], z, i, sector, rng, owned):
                blank_row(numbers, start, n)
                continue
            _level_heights(tiles, t, z, i, j0, n, w)
            _evaluate(tiles, t, across[i - i0], w, cubics, values)
            for k in range(n):
                away = 0.0 if np.isnan(rng[k]) else rng[k] - origin
                row[k] += away * per_row
                cycles[k] += away * carrier_cycles
            if not every:
                find_limits(turn, sector, rng, owned)
            if sector.weight.shape[0] == 1:
                amplitude_of(turn, sector.yaw_start, 1 / yaw_step, by_yaw, loss, owned, amplitude)
            else:
                divide_by_sums(turn, 1 / yaw_step, sector, rng, loss, owned, amplitude)
            place_windows(
                row, in_range.n_tap, in_range.width, in_range.size, n_row, range_step, windows.first_row,
                windows.range_at, windows.range_part,
            )  # fmt: skip
            place_windows(
                doppler, bent.n_tap[0], bent.width[0], taps.n_doppler, n_doppler, 1, windows.first_doppler,
                windows.doppler_at, windows.doppler_part,
            )  # fmt: skip
            _choose_taps(bend, doppler, taps, n_doppler, windows, tap_at, tap_step)
            find_addresses(windows, stride, amplitude)
            turn_windows(doppler, cycles, middle, 4 * bent.width[0], windows, own)
            phasors_of(own, own_real, own_imag)
            sum_windows_bent(
                floats, stride, windows.at, in_range.table, range_step, in_range.width, windows.range_at,
                windows.range_part, bent.real, bent.imag, tap_at, tap_step, windows.doppler_part, taps.carriers,
                2 * bent.width[0], windows.carrier_at, real, imag,
            )  # fmt: skip
            write_row(numbers, start, n, amplitude, own_real, own_imag, real, imag)
