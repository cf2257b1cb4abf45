"""Geometric correction: from a focused block, range by Doppler, to calibrated ground pixels.

The ground map (`GroundMap`) has the position, phase and gain of each ground point's focus. Over a small tile of pixels
each of these is a polynomial of low degree in (x, y), even the carrier's phase. A compiled loop goes through a tile row
by row: short loops over all pixels of the row evaluate the polynomials, find the pixels that the block owns, and turn
positions into windows and weights; then each owned pixel is one weighted sum over its window of the block, with all
weights in vector registers.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import types

from blocksar.arrays import ComplexArray, FloatArray, IntArray
from blocksar.collection.grid import spacing
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.kernels import interpolation
from blocksar.kernels.groups import run_groups
from blocksar.kernels.lanes import FEW
from blocksar.kernels.loops import COMPILED, FLOATS_IN, NUMBERS_OUT, POWERS, REAL_ROW, TILES, fixed, loop, record
from blocksar.kernels.phase import Float32Array
from blocksar.processors.chain.ground.ground_map import GroundMap, tile_extent
from blocksar.processors.chain.ground.pixel_rows import (
    AXIS_TAPS,
    DOPPLER_UNIT,
    N_CARRIER,
    N_PHASE,
    RANGE_UNIT,
    SECTOR,
    TILE_DEGREE,
    AxisTaps,
    OwnedSector,
    Tiles,
    Windows,
    along_row,
    amplitude_of,
    blank_row,
    divide_by_sums,
    evaluate_row,
    find_addresses,
    find_limits,
    find_sector,
    phasors_of,
    place_across,
    place_windows,
    sum_windows,
    turn_windows,
    write_row,
)
from blocksar.processors.chain.ground.relief_correction import (
    ReliefTaps,
    bent_taps_of,
    nodes_of,
    resample_on_relief,
    tile_polynomials,
)
from blocksar.solvers import product

TILE_PIXELS = 128
MANY_ABSENT = 64  # tiles of a window without owned pixels, from which on all of it is cleared
TILE_GROUP = 16  # tiles per call of the compiled loop


class WindowTaps(NamedTuple):
    """Interpolation taps along both axes, and factors from `_carriers` that remove carriers."""

    in_range: AxisTaps
    in_doppler: AxisTaps
    carriers: Float32Array


TAPS = record(WindowTaps, AXIS_TAPS, AXIS_TAPS, FLOATS_IN)
FLAT_TILES = record(Tiles, REAL_ROW, TILES, POWERS, types.none)


def touched(ground: GroundMap, *, x: FloatArray, y: FloatArray, side: tuple[int, int]) -> IntArray:
    """First row and column of each tile of side[0] x side[1] pixels of which the block may own any, (n, 2).

    It owns none of the others; of those near its edge it may own none.
    """
    places, _ = _owned(ground, [(x, y)], [side])
    return places[:, :2]


def correct(
    block: ComplexArray,
    ground: GroundMap,
    *,
    x: FloatArray,
    y: FloatArray,
    z: FloatArray | None = None,
    tiles: Tiles | None = None,
    threads: int = 1,
    out: ComplexArray | None = None,
) -> ComplexArray:
    """Resample a focused block to ground pixels; NaN for pixels that it does not own, or without a height.

    Parameters
    ----------
    block : (at least rows.size, at least doppler.size) complex64, C-contiguous
        Focused.
    x : (n_x,) float
        m, uniform.
    y : (n_y,) float
        m, uniform.
    z : (n_y, n_x) float, optional
        Heights, m, which a ground map with relief needs; NaN where unknown.
    tiles : Tiles, optional
        Those of this window, from `tiles_of`, which finds them for many windows in less time. Default: found here.
    out : (n_y, n_x) complex64, C-contiguous, optional
        Array for the result; its contents are overwritten. Reusing one saves the slow allocation for each chunk.

    Returns
    -------
    (n_y, n_x) complex64
        Calibrated: 1 + 0j at the position of a unit target. NaN also where a pattern in elevation is too small, see
        `pattern_sums.LEAST_ELEVATION`.
    """
    out = _correct(block, ground, x=x, y=y, z=z, tiles=tiles, threads=threads, out=out)
    if ground.geometry.collection.elevation_pattern is not None:
        _divide_by_elevation(out, ground, x=x, y=y, threads=threads)
    return out


def _divide_by_elevation(image: ComplexArray, ground: GroundMap, *, x: FloatArray, y: FloatArray, threads: int) -> None:
    """Divide pixels (n_y, n_x) in place by the mean of the pattern in elevation; NaN where that is too small.

    On the plane: plans on a terrain take no such pattern.
    """

    def divide(rows: slice) -> None:
        part = image[rows]
        row, column = np.nonzero(np.isfinite(part.real))
        if not row.size:
            return
        at = x[column], y[rows][row]
        means = ground.elevation_means(*at)
        dark = means.dark(ground.geometry)
        shares = np.where(dark, 1.0, means.weighed * ground.tilted_gain(*at, means.tilt)).astype(np.float32)
        part[row, column] = np.where(dark, complex(np.nan, np.nan), part[row, column] / shares)

    run_groups(divide, [slice(i, i + TILE_PIXELS) for i in range(0, y.size, TILE_PIXELS)], threads)


def _correct(
    block: ComplexArray, ground: GroundMap, *, x: FloatArray, y: FloatArray, z: FloatArray | None,
    tiles: Tiles | None, threads: int, out: ComplexArray | None = None,
) -> ComplexArray:  # fmt: skip
    """Resample as `correct` does, without a pattern in elevation."""
    out = np.empty((y.size, x.size), np.complex64) if out is None else out
    tiles = tiles or tiles_of(ground, [(x, y)], [z])[0]
    places = tiles.places
    _blank_others(out, places, tiles.across.size)
    if places.shape[0] == 0:
        return out
    numbers = out.view(np.float32).reshape(-1)
    x, y = np.ascontiguousarray(x), np.ascontiguousarray(y)  # a loop is compiled for one layout of its arrays
    n_range, n_doppler = ground.range_taps[0], ground.doppler.size
    width = -(-n_range // RANGE_UNIT) * RANGE_UNIT
    in_range = AxisTaps(fixed(_range_taps(*ground.range_taps)), n_range, width, ground.rows.size)
    height = ground.geometry.epoch_position[2]
    if (relief := ground.relief) is None:
        table = fixed(_doppler_taps(*ground.doppler_taps))
        widest, sector = table.shape[1] // 2, _sector_of(ground, (height - ground.levels[0]) ** 2)
        in_doppler = AxisTaps(table, ground.doppler_taps[0], widest, n_doppler)
        taps = WindowTaps(in_range, in_doppler, fixed(_carriers(widest)))

        def resample(group: slice) -> None:
            _resample(floats, numbers, tiles.some(group), x, y, taps, sector)

    else:
        assert z is not None and tiles.heights is not None
        z, (bent, most) = np.ascontiguousarray(z), bent_taps_of(ground, relief)
        widest, sector = bent.width[0], _sector_of(ground, height)
        per_bend = float((bent.n_bend[0] - 1) / (2 * most)) if most else 0.0
        bent_taps = ReliefTaps(in_range, bent, per_bend, n_doppler, fixed(_carriers(widest)))
        carrier = -2 * ground.geometry.collection.carrier / SPEED_OF_LIGHT
        scales = carrier, 1 / ground.rows.step, ground.origin

        def resample(group: slice) -> None:
            resample_on_relief(floats, numbers, tiles.some(group), x, y, z, bent_taps, sector, scales)

    floats = _with_room(block, width, widest).view(np.float32)
    # Python threads over groups of tiles, not numba's own: a dask worker may run several tasks in one process.
    run_groups(resample, [slice(i, i + TILE_GROUP) for i in range(0, places.shape[0], TILE_GROUP)], threads)
    return out


def _sector_of(ground: GroundMap, depth: float) -> OwnedSector:
    """Describe the sector that a block owns; `depth` is the last of the phase centre's coordinates.

    The sides of the two seam rays decide on ownership: the neighbouring block computes the same products from the same
    numbers, so every pixel has exactly one owner.
    """
    low, high = ((float(np.cos(yaw)), float(np.sin(yaw))) for yaw in (ground.low, ground.high))
    nx, ny = ground.geometry.nadir
    px, py, _ = ground.geometry.epoch_position
    limits = (ground.near_limit, ground.far_limit, ground.weight)
    return OwnedSector(
        low, high, (float(nx), float(ny)), (float(px), float(py), float(depth)), float(ground.near),
        float(ground.far), float(ground.least_lit), float(ground.yaw_axis[0] - ground.middle_yaw),
        float(ground.yaw_axis[1] - ground.yaw_axis[0]), *(fixed(np.ascontiguousarray(each)) for each in limits),
    )  # fmt: skip


def _blank_others(out: ComplexArray, places: IntArray, side: int) -> None:
    """Set tiles that are not among `places`, (n, 3) as in `Tiles`, to NaN."""
    n_row, n_column = -(-out.shape[0] // side), -(-out.shape[1] // side)
    if places.shape[0] == n_row * n_column:
        return
    if n_row * n_column - places.shape[0] > MANY_ABSENT:
        out[...] = np.nan + 1j * np.nan
        return
    absent = np.ones((n_row, n_column), np.bool_)
    absent[places[:, 0] // side, places[:, 1] // side] = False
    for row, column in np.argwhere(absent) * side:
        out[row : row + side, column : column + side] = np.nan + 1j * np.nan


def tiles_of(
    ground: GroundMap,
    windows: Sequence[tuple[FloatArray, FloatArray]],
    heights: Sequence[FloatArray | None],
) -> list[Tiles]:
    """Make the tiles of some windows, each given by its x (n_x,) and y (n_y,), m, uniform.

    `heights`, each (n_y, n_x), m, are those of the windows, which a ground map with relief needs; None without.
    """
    sides = _tile_sides(ground, windows)
    places, owner = _owned(ground, windows, [(side, side) for side in sides])
    side, spans = np.array(sides)[owner], None
    if (relief := ground.relief) is not None:
        polynomials, spans = tile_polynomials(ground, relief, windows, heights, side, places, owner)
    else:
        if ground.lit.ndim > 1:
            places[:, 2] = 0  # so that the range of every pixel is at hand
        polynomials = _plane_polynomials(ground, windows, side, places, owner)
    ends = np.searchsorted(owner, np.arange(len(windows) + 1))
    return [
        Tiles(place_across(one), places[first:end], polynomials[first:end], None if spans is None else spans[first:end])
        for one, first, end in zip(sides, ends[:-1], ends[1:], strict=True)
    ]


def _tile_sides(ground: GroundMap, windows: Sequence[tuple[FloatArray, FloatArray]]) -> list[int]:
    """Pixels along the side of the tiles of each window."""
    near = max(ground.near, float(ground.near_limit.min()))
    reach, _ = tile_extent(ground.geometry, ground.low, ground.high, near, ground.far)
    steps = [max(abs(spacing(x)), abs(spacing(y))) for x, y in windows]
    return [int(np.clip(reach / step, 1, TILE_PIXELS)) if step else 1 for step in steps]


def _owned(
    ground: GroundMap, windows: Sequence[tuple[FloatArray, FloatArray]], sides: Sequence[tuple[int, int]]
) -> tuple[IntArray, IntArray]:
    """Tiles of some windows with pixels that the block may own, (n, 3) as in `Tiles`, and the window of each, (n,).

    `sides` has the rows and columns of the tiles of each window.
    """
    corners, ends = [], []
    for (x, y), side in zip(windows, sides, strict=True):
        row, column = (part.ravel() for part in np.mgrid[0 : y.size : side[0], 0 : x.size : side[1]])
        last_y, last_x = np.minimum(row + side[0], y.size) - 1, np.minimum(column + side[1], x.size) - 1
        corners.append((row, column))
        ends.append((y[row], y[last_y], x[column], x[last_x]))
    owner = np.repeat(np.arange(len(windows)), [row.size for row, _ in corners])
    first_y, last_y, first_x, last_x = (np.concatenate(part) for part in zip(*ends, strict=True))
    cy, cx = (first_y + last_y) / 2, (first_x + last_x) / 2
    radius = np.hypot(last_y - first_y, last_x - first_x) / 2 + 1e-6
    lowest, highest = ground.levels
    rng, nearest = (ground.geometry.epoch_range(cx, cy, level) for level in (lowest, highest))
    turn = ground.relative_yaw(cx, cy)
    distance = np.hypot(cx - ground.geometry.nadir[0], cy - ground.geometry.nadir[1])
    half = (ground.high - ground.low) / 2
    slack = np.arcsin(np.minimum(radius / np.maximum(distance, radius), 1.0))

    def between(near: float, far: float, margin: float, least: FloatArray, greatest: FloatArray) -> FloatArray:
        near, far = max(ground.near, near) - margin * radius, min(ground.far, far) + margin * radius
        return (np.abs(turn) <= half + margin * slack) & (greatest >= near) & (least <= far)

    touched = between(float(ground.near_limit.min()), float(ground.far_limit.max()), 1.0, nearest, rng)
    # Twice the radius inside, so that rounding cannot matter.
    every = between(float(ground.near_limit.max()), float(ground.far_limit.min()), -2.0, rng, nearest)
    rows, columns = (np.concatenate(part) for part in zip(*corners, strict=True))
    places = np.column_stack([rows, columns, every]).astype(np.int64)
    return np.ascontiguousarray(places[touched]), owner[touched]


def _plane_polynomials(
    ground: GroundMap, windows: Sequence[tuple[FloatArray, FloatArray]], side: IntArray, places: IntArray,
    owner: IntArray,
) -> FloatArray:  # fmt: skip
    """Polynomials of tiles, as in `Tiles`: of sides `side` (n,), at `places` (n, 3) of the windows `owner` (n,)."""
    nodes, to_power = nodes_of(TILE_DEGREE)
    origin = np.array([(x[0], spacing(x), y[0], spacing(y)) for x, y in windows])[owner, :, None, None]
    half = (side[:, None, None] - 1) / 2
    px = origin[:, 0] + origin[:, 1] * (places[:, 1, None, None] + half * (1 + nodes[None, None, :]))
    py = origin[:, 2] + origin[:, 3] * (places[:, 0, None, None] + half * (1 + nodes[None, :, None]))
    px, py = np.broadcast_arrays(px, py)
    values = np.stack(ground.locate(px, py), axis=1)
    coefficients = np.moveaxis(product(product(to_power, values), to_power.T), 1, 2)
    return np.ascontiguousarray(coefficients).reshape(places.shape[0], nodes.size, values.shape[1] * nodes.size)


def _window(n_tap: int, occupancy: float, unit: int) -> Float32Array:
    """Taps padded with zeros to whole units, (2 (N_PHASE + 1), width).

    The zeros are behind the taps; in the second half of the rows in front, for windows at the block's end.
    """
    room = -n_tap % unit
    taps = interpolation.interpolation_taps(n_tap, occupancy=occupancy, n_phase=N_PHASE)
    return np.concatenate([np.pad(taps, ((0, 0), (0, room))), np.pad(taps, ((0, 0), (room, 0)))])


@lru_cache(maxsize=8)
def _range_taps(n_tap: int, occupancy: float) -> Float32Array:
    """Taps along range, one row of the block each; the last unit of a row of the table is padded to a register."""
    return np.pad(_window(n_tap, occupancy, RANGE_UNIT), ((0, 0), (0, FEW - RANGE_UNIT)))


@lru_cache(maxsize=8)
def _doppler_taps(n_tap: int, occupancy: float) -> Float32Array:
    """Taps along Doppler, each twice: for the real and the imaginary part of a sample."""
    return np.repeat(_window(n_tap, occupancy, DOPPLER_UNIT), 2, axis=1)


@lru_cache(maxsize=8)
def _carriers(n_sample: int) -> Float32Array:
    """Factors (2 N_CARRIER, 2 n_sample) that remove a carrier from the samples of a row of the block.

    Real and imaginary parts of samples alternate. Row 2 q has cos, -sin, cos, .. of the carrier q / N_CARRIER, for the
    real part of a sum, and row 2 q + 1 has sin, cos, sin, .. for its imaginary part.
    """
    turn = np.outer(np.arange(N_CARRIER) / N_CARRIER, np.arange(n_sample))
    factor = np.exp(2j * np.pi * turn)
    rows = np.stack([factor.conj(), 1j * factor.conj()], axis=1).reshape(2 * N_CARRIER, n_sample)
    return rows.astype(np.complex64).view(np.float32)


def _with_room(block: ComplexArray, n_row: int, n_doppler: int) -> ComplexArray:
    """Pad a block with zeros to at least two windows along each axis, so that one fits from either end."""
    needed = 2 * n_row, 2 * n_doppler
    lacking = [(0, max(n - size, 0)) for n, size in zip(needed, block.shape, strict=True)]
    return np.pad(block, lacking) if np.any(lacking) else np.ascontiguousarray(block)


@loop(FLOATS_IN, NUMBERS_OUT, FLAT_TILES, REAL_ROW, REAL_ROW, TAPS, SECTOR, **COMPILED)
def _resample(  # type: ignore[no-untyped-def]
    floats, numbers, tiles, x, y, taps, sector
):
    """Resample the owned pixels of some tiles into `numbers`, real and imaginary parts row by row."""
    in_range, in_doppler, across, yaw_step, by_yaw = (
        taps.in_range, taps.in_doppler, tiles.across, sector.yaw_step, sector.weight[0],
    )  # fmt: skip
    n_row, n_doppler, stride = floats.shape[0], floats.shape[1] // 2, floats.shape[1]
    range_step, doppler_step = in_range.table.shape[1], in_doppler.table.shape[1]
    tile, along = across.size, np.empty(tiles.polynomials.shape[2])
    values = np.empty((6, tile))
    row, doppler, cycles, loss, turn, middle = values[0], values[1], values[2], values[3], values[4], values[5]
    rng, owned = np.empty(tile), np.empty(tile)
    places, parts = np.empty((6, tile), np.int64), np.empty((8, tile), np.float32)
    windows = Windows(places[0], places[1], places[2], places[3], places[4], places[5], parts[0], parts[1])
    own, own_real, own_imag, amplitude, real, imag = parts[2], parts[3], parts[4], parts[5], parts[6], parts[7]
    for t in range(tiles.places.shape[0]):
        i0, j0, every = tiles.places[t, 0], tiles.places[t, 1], tiles.places[t, 2] != 0
        n = min(tile, x.size - j0)
        for i in range(i0, min(i0 + tile, y.size)):
            for k in range(tile):
                owned[k] = 1.0 if k < n else np.nan
            start = 2 * (i * x.size + j0)
            if not every and not find_sector(x, j0, n, y[i], sector, rng, owned):
                blank_row(numbers, start, n)
                continue
            along_row(tiles.polynomials, t, across[i - i0], along)
            evaluate_row(along, across, values)
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
                doppler, in_doppler.n_tap, in_doppler.width, in_doppler.size, n_doppler, doppler_step,
                windows.first_doppler, windows.doppler_at, windows.doppler_part,
            )  # fmt: skip
            turn_windows(doppler, cycles, middle, 2 * doppler_step, windows, own)
            phasors_of(own, own_real, own_imag)
            find_addresses(windows, stride, amplitude)
            sum_windows(floats, windows, in_range, in_doppler, taps.carriers, real, imag)
            write_row(numbers, start, n, amplitude, own_real, own_imag, real, imag)
