"""The loop of exact back-projection over the pulses that light groups of pixels, compiled: see `projection`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, types
from numpy.typing import NDArray

from blocksar.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from blocksar.kernels.lanes import (
    FEW,
    FIXED_POINT,
    NEAR,
    cosine,
    cosine_and_sine,
    from_half,
    from_whole,
    larger,
    load_few,
    load_near,
    load_triples,
    nearest,
    remainder,
    single,
    smaller,
    spread_few,
    square_root,
    store,
    whole,
    within,
)
from blocksar.kernels.loops import COMPILED, PART, REAL_ROW, REAL_ROWS, loop

CHUNK = 32  # pulses whose profiles, as far as neighbouring pixels read them, stay in the first-level cache
MOST_FILLED = 1.2  # times the pixels of a tile, to fill squares
PULSES = types.int32[::1]
WINDOWS = types.Array(types.int64, 2, "C", readonly=True)
ORIGINS = types.Array(types.int64, 1, "C", readonly=True)
WEIGHTS = types.Array(types.float32, 1, "C", readonly=True)


@njit(inline="always")
def _by_series(
    series: Any, k: Any, square: Any, dx: Any, dy: Any, dz: Any, hilly: Any, bins_per_cycle: Any
) -> tuple[Any, Any]:
    """Phase, in cycles about a whole number, and position in the profile, in bins and fixed point."""
    slope = series[3, k] * square
    if hilly:
        slope = series[7, k] * dz + slope
    away = _series(series[1, k] * dx + (series[2, k] * dy + slope), series[4, k])
    return from_whole(away + series[5, k]), away * bins_per_cycle + series[6, k]


@njit(inline="always")
def _series(z: Any, g: Any) -> Any:
    """The range less that of the centre, by the series of z and q = g z."""
    q = g * z
    return z + z * (q * (((14.0 * q - 5.0) * q + 2.0) * q - 1.0))


@njit(**PART, **COMPILED)
def _see_middle(seen: Any, bins: Any, series: Any, k: Any, j: Any, dx: Any, dy: Any, dz: Any, per_cycle: Any) -> None:
    """Find what the pixels about the middle of a group need of FEW pulses, in `seen` (7, n) and `bins` (n,) from j on.

    The middle lies at (dx, dy, dz) from the tile's centre. In order: its phase, about a whole number of cycles; how far
    it lies from its bin; g and the direction there, in cycles; and what q is of z. The latter follow from those of the
    tile's centre, as the middle is farther away by the factor 1 + t, without t^5.
    """
    x, y, z, g = load_few(series[1], k), load_few(series[2], k), load_few(series[7], k), load_few(series[3], k)
    per_range = load_few(series[4], k)
    away = _series(x * dx + (y * dy + (z * dz + g * (dx * dx + dy * dy + dz * dz))), per_range)
    position = away * per_cycle + load_few(series[6], k)
    store(seen[0], j, from_whole(away + load_few(series[5], k)))
    store(seen[1], j, from_half(position))
    store(bins, j, whole(position))
    t = per_range * (away + away)
    nearer = 1.0 - t * (1.0 - t * (1.0 - t * (1.0 - t)))
    store(seen[2], j, single(g * nearer))
    store(seen[3], j, single((x + (g + g) * dx) * nearer))
    store(seen[4], j, single((y + (g + g) * dy) * nearer))
    store(seen[5], j, single((z + (g + g) * dz) * nearer))
    store(seen[6], j, single(per_range * nearer))


@njit(inline="always")
def _about_middle(dx: Any, dy: Any, dz: Any) -> Any:
    """Offsets from the middle of a group, in float32, and the squares of the distances."""
    ux, uy, uz = single(dx), single(dy), single(dz)
    return ux, uy, uz, ux * ux + uy * uy + uz * uz


@njit(inline="always")
def _by_root(roots: Any, k: Any, dx: Any, dy: Any, dz: Any, hilly: Any) -> Any:
    """Range - reference_range."""
    x, y, up = dx + roots[k, 0], dy + roots[k, 1], spread_few(roots[k, 2])
    if hilly:
        up = (dz + roots[k, 4]) * (dz + roots[k, 4])
    return square_root(x * x + (y * y + up)) - roots[k, 3]


@njit(inline="always")
def _sample(triples: Any, right: Any) -> Any:
    """Real and imaginary part of the quadratic spline at `right` bins from the middle one of three."""
    a, b, c, d, e, f = triples
    half, eighth, three_quarters = np.float32(0.5), np.float32(0.125), np.float32(0.75)
    odd, square = half * right, right * right
    even = half * square + eighth
    before, at, after = even - odd, three_quarters - square, even + odd
    return before * a + at * b + after * c, before * d + at * e + after * f


@njit(inline="always")
def _place(places: Any, k: Any, dx: Any, dy: Any) -> Any:
    """v in the beam."""
    bend = places[k, 3] * dx + places[k, 4] * dy
    return places[k, 0] + (places[k, 1] * dx + places[k, 2] * dy) + bend * dx + places[k, 5] * dy * dy


@njit(inline="always")
def _rise(places: Any, k: Any, dx: Any, dy: Any, dz: Any) -> Any:
    """Term of a series that heights dz over the centre's add."""
    return (places[k, 7] + places[k, 8] * dx + places[k, 9] * dy + places[k, 10] * dz) * dz


@njit(inline="always")
def _taper(v: Any, terms: Any, half_frequency: Any) -> Any:
    """sum_k terms_k cos(2 pi k half_frequency v), by Clenshaw's recurrence; at most |half_frequency v| = 1/2."""
    turned = remainder(v * half_frequency)
    cos = cosine(turned)
    twice = cos + cos
    last, total = cos - cos, cos - cos
    for k in range(terms.size - 1):
        last, total = total, terms[terms.size - 1 - k] + (twice * total - last)
    return terms[0] + (cos * total - last)


@njit(inline="always")
def _added(re: Any, im: Any, a: Any, b: Any, turn: Any) -> Any:
    """The sums with a + 1j b, turned by a phase in cycles."""
    cos, sin = cosine_and_sine(turn)
    return re + a * cos - b * sin, im + a * sin + b * cos


@njit(**PART, **COMPILED)
def _add_to_groups(
    real: Any, imag: Any, weight: Any, farthest: Any, samples: Any, origins: Any, x: Any, y: Any, z: Any, hilly: Any,
    centre_x: Any, centre_y: Any, centre_z: Any, first: Any, last: Any, spans: Any, close: Any, middles: Any,
    start: Any, series: Any, roots: Any, cycles_per_metre: Any, bins_per_metre: Any, half_window: Any, places: Any,
    terms: Any, half_frequency: Any,
) -> None:  # fmt: skip  # longer than most: see its arguments
    """Sum the lit pulses, in ascending order, at the pixels of a tile, in groups of FEW one after the other.

    It takes many arguments, since arrays that inlined functions take have their references counted for every pulse.

    Parameters
    ----------
    real, imag : (n,) float32
        The sums, added to in place.
    weight : (n,) float32
        Rises by the sum of the pulses' weights; unchanged where `terms` is empty.
    farthest : (n,) float
        Rises to |range - reference_range|, m, where a lit pulse needed the square root.
    x, y, z : (n,) float
        m
    hilly : bool
        Whether any z differs from the centre's; otherwise z are not read.
    centre_x, centre_y, centre_z : float
        Of the tile, m.
    first, last : (n,) int32
        Pulses first <= p < last light a pixel.
    spans : (n_group, 2) int64
        Those that light any pixel of a group.
    close : (n_group,) bool
        Groups that are seen from their middle: its range and direction are found in float64, for FEW pulses at a time,
        and those of its pixels from there in float32.
    middles : (3, n_group) float
        m
    start : int
        Pulse p has the column p - start of the tables.

    The others are those of `add_pulses`.
    """
    turns, rights = np.empty(CHUNK * FEW, np.float32), np.empty(CHUNK * FEW, np.float32)
    bins, shares = np.empty(CHUNK * FEW, np.int32), np.empty(CHUNK * FEW, np.float32)
    seen, per_cycle = np.empty((7, CHUNK + FEW), np.float32), bins_per_metre / cycles_per_metre
    weighted = terms.size > 0
    lowest, highest = spans[0, 0], spans[0, 1]
    for group in range(1, spans.shape[0]):
        lowest, highest = min(lowest, spans[group, 0]), max(highest, spans[group, 1])
    for begin in range(lowest, highest, CHUNK):
        for group in range(spans.shape[0]):
            i = group * FEW
            dx, dy = load_few(x, i) - centre_x, load_few(y, i) - centre_y
            dz = dx - dx
            square, lit, unlit = dx * dx + dy * dy, load_few(first, i), load_few(last, i)
            if hilly:
                dz = load_few(z, i) - centre_z
                square = square + dz * dz
            low, high = max(spans[group, 0], begin), min(spans[group, 1], begin + CHUNK)
            if weighted:
                share = load_few(weight, i)
                for p in range(low, high):
                    v = _place(places, p - start, dx, dy)
                    if hilly:
                        v = v + _rise(places, p - start, dx, dy, dz)
                    part = within(_taper(v, terms, half_frequency), lit, p, unlit)
                    store(shares, (p - low) * FEW, part)
                    share = share + part * np.float32(places[p - start, 6])
                store(weight, i, share)
            re, im = load_few(real, i), load_few(imag, i)
            if close[group]:
                mx, my = middles[0, group] - centre_x, middles[1, group] - centre_y
                mz = middles[2, group] - centre_z
                for p in range(low, high, FEW):
                    _see_middle(seen, bins, series, p - start, p - low, mx, my, mz, per_cycle)
                ux, uy, uz, square_u = _about_middle(dx - mx, dy - my, dz - mz)
                for p in range(low, high):
                    j = p - low
                    w = seen[3, j] * ux + (seen[4, j] * uy + seen[2, j] * square_u) + seen[5, j] * uz
                    q = seen[6, j] * w
                    away = w + w * (q * (q + q - np.float32(1.0)))
                    _, turn = nearest(away + seen[0, j])
                    offset, right = nearest(away * np.float32(per_cycle) + seen[1, j])
                    a, b = _sample(load_near(samples, origins[p - start] + bins[j], offset), right)
                    a, b = within(a, lit, p, unlit), within(b, lit, p, unlit)
                    if weighted:
                        a, b = a * load_few(shares, j * FEW), b * load_few(shares, j * FEW)
                    re, im = _added(re, im, a, b, turn)
            else:
                # Two loops: the way from a pulse to its samples is long, and the CPU then looks ahead over more pulses.
                for p in range(low, high):
                    j, k = (p - low) * FEW, p - start
                    if series[0, k] > 0:
                        cycles, position = _by_series(series, k, square, dx, dy, dz, hilly, per_cycle)
                    else:
                        away = _by_root(roots, k, dx, dy, dz, hilly)
                        reached = within(larger(away, 0.0 - away), lit, p, unlit)
                        store(farthest, i, larger(reached, load_few(farthest, i)))
                        cycles = remainder(away * cycles_per_metre)
                        away = smaller(larger(away, -half_window), half_window)
                        position = away * bins_per_metre + (FIXED_POINT + 0.5)
                    store(turns, j, cycles)
                    store(bins, j, whole(position))
                    store(rights, j, from_half(position))
                for p in range(low, high):
                    j = (p - low) * FEW
                    a, b = _sample(load_triples(samples, origins[p - start], bins, j), load_few(rights, j))
                    a, b = within(a, lit, p, unlit), within(b, lit, p, unlit)
                    if weighted:
                        a, b = a * load_few(shares, j), b * load_few(shares, j)
                    re, im = _added(re, im, a, b, load_few(turns, j))
            store(real, i, re)
            store(imag, i, im)


@njit(**PART, **COMPILED)
def _pixel(
    group: int, lane: int, squares: bool, square: int, wide: int, height: int, width: int
) -> tuple[int, int, bool]:
    """Row and column of a lane of a group: of a square of pixels, or of FEW in their order; the last are repeated."""
    if squares:
        r, c = group // wide * square + lane // square, group % wide * square + lane % square
        return min(r, height - 1), min(c, width - 1), r < height and c < width
    i = group * FEW + lane
    at = min(i, height * width - 1)
    return at // width, at % width, i == at


@loop(
    types.complex64[:, :], types.boolean[:, :], types.float32[:, :], types.float64[::1], types.int64,
    *[types.Array(types.float64, 2, "A", readonly=True)] * 3, *[types.Array(types.int64, 2, "A", readonly=True)] * 2,
    WINDOWS, WINDOWS, ORIGINS, REAL_ROWS, REAL_ROWS, ORIGINS, REAL_ROWS, REAL_ROWS, types.float64, types.float64,
    types.float64, types.float64, REAL_ROWS, WEIGHTS, types.float64, **COMPILED,
)  # fmt: skip
def add_pulses(
    image: ComplexArray,
    outside: BoolArray,
    weight: NDArray[np.float32],
    samples: FloatArray,
    square: int,
    x: FloatArray,
    y: FloatArray,
    z: FloatArray,
    first: IntArray,
    last: IntArray,
    windows: IntArray,
    rows: IntArray,
    at: IntArray,
    low: FloatArray,
    high: FloatArray,
    origins: IntArray,
    series: FloatArray,
    roots: FloatArray,
    cycles_per_metre: float,
    bins_per_metre: float,
    half_window: float,
    most_cycles: float,
    places: FloatArray,
    terms: NDArray[np.float32],
    half_frequency: float,
) -> None:
    """Sum the lit pulses, in ascending order, at the pixels of some tiles of the image.

    Tables have a column, or a row, for each pulse of each tile; that of a tile begins at `at`. They are made by
    `projection.pulse_tables` and `projection.place_tables`.

    Parameters
    ----------
    image : (n_row, n_column) complex64
        Added to in place.
    outside : (n_row, n_column) bool
        Set where a lit pulse needed the square root and |range - reference_range| exceeds half_window.
    weight : (n_row, n_column) float32
        Rises by the sum of the pulses' weights; unchanged where `terms` is empty.
    samples : (n_sample,) float64
        Spline coefficients of the profiles, each a complex64 as 64 bits.
    square : int
        Pixels along either side of a group, where squares hold a tile well.
    x, y, z : (n_row, n_column) float
        m
    first, last : (n_row, n_column) int
        Pulses first <= p < last light a pixel.
    windows : (n, 4) int
        Tiles: rows from the first to before the second, columns from the third to before the fourth.
    rows : (n, 2) int
        The pulses that tables have of a tile: all that light any of it.
    at : (n,) int
    low, high : (n, 3) float
        The box around a tile, m.
    origins : (n_table,) int
        The sample of each pulse at its reference range.
    series, roots : (8, n_table), (n_table, 5) float
        For ranges by the series about the tile's centre, and by the square root; FEW more follow those of each tile.
    cycles_per_metre, bins_per_metre : float
        How fast phases and bins go by with range.
    half_window : float
        Largest unambiguous |range - reference_range|, m.
    most_cycles : float
        From the middle of a group, of which float32 has enough of the phase.
    places : (n_table, 7) or (n_table, 11) float
        Polynomials of the pixel's place v in the beam, with the fraction of valid samples in column 6.
    terms : (n_term,) float32
        Of the weight as a function of v; empty without weights.
    half_frequency : float
        Cosines of the weight have k half_frequency v turns.
    """
    for t in range(windows.shape[0]):
        top, left = windows[t, 0], windows[t, 2]
        height, width = windows[t, 1] - top, windows[t, 3] - left
        begin, end, close_by = rows[t, 0], rows[t, 1], True
        for k in range(at[t], at[t] + end - begin):
            close_by = close_by and series[0, k] > 0
        wide, deep = (width + square - 1) // square, (height + square - 1) // square
        squares = wide * deep * square * square <= MOST_FILLED * height * width
        count = wide * deep if squares else (height * width + FEW - 1) // FEW
        n = count * FEW
        place, lit = np.empty((3, n)), np.empty((2, n), np.int32)
        spans, close, middles = np.empty((count, 2), np.int64), np.empty(count, np.bool_), np.empty((3, count))
        sums, farthest = np.zeros((3, n), np.float32), np.zeros(n)
        box = np.empty((2, 3))
        for group in range(count):
            spans[group, 0], spans[group, 1] = end, begin
            box[0], box[1] = np.inf, -np.inf
            for lane in range(FEW):
                r, c, _ = _pixel(group, lane, squares, square, wide, height, width)
                r, c, i = r + top, c + left, group * FEW + lane
                place[0, i], place[1, i], place[2, i] = x[r, c], y[r, c], z[r, c]
                for k in range(3):
                    box[0, k], box[1, k] = min(box[0, k], place[k, i]), max(box[1, k], place[k, i])
                lit[0, i], lit[1, i] = max(first[r, c], begin), min(last[r, c], end)
                if lit[0, i] < lit[1, i]:
                    spans[group, 0] = min(spans[group, 0], lit[0, i])
                    spans[group, 1] = max(spans[group, 1], lit[1, i])
            apart = 0.0
            for k in range(3):
                middles[k, group] = (box[0, k] + box[1, k]) / 2
                apart += ((box[1, k] - box[0, k]) / 2) ** 2
            near = apart * bins_per_metre**2 < (NEAR[1] - 1) ** 2 and apart * cycles_per_metre**2 < most_cycles**2
            close[group] = near and close_by
        hilly = high[t, 2] > low[t, 2]
        centre_x, centre_y = (low[t, 0] + high[t, 0]) / 2, (low[t, 1] + high[t, 1]) / 2
        _add_to_groups(
            sums[0], sums[1], sums[2], farthest, samples, origins, place[0], place[1], place[2], hilly, centre_x,
            centre_y, (low[t, 2] + high[t, 2]) / 2, lit[0], lit[1], spans, close, middles, begin - at[t], series, roots,
            cycles_per_metre, bins_per_metre, half_window, places, terms, half_frequency,
        )  # fmt: skip
        for group in range(count):
            for lane in range(FEW):
                r, c, there = _pixel(group, lane, squares, square, wide, height, width)
                if there:
                    r, c, i = r + top, c + left, group * FEW + lane
                    image[r, c] += complex(sums[0, i], sums[1, i])
                    if terms.size:
                        weight[r, c] += sums[2, i]
                    if farthest[i] > half_window:
                        outside[r, c] = True


@loop(
    types.float32[::1], types.float32[::1], types.float64[::1], REAL_ROW, ORIGINS, *[REAL_ROW] * 3, PULSES, PULSES,
    types.int64[:, ::1], types.int64, REAL_ROWS, types.float64, types.float64, types.float64, **COMPILED,
)  # fmt: skip
def add_bistatic_pulses(
    real: NDArray[np.float32],
    imag: NDArray[np.float32],
    farthest: FloatArray,
    samples: FloatArray,
    origins: IntArray,
    x: FloatArray,
    y: FloatArray,
    z: FloatArray,
    first: NDArray[np.int32],
    last: NDArray[np.int32],
    spans: IntArray,
    start: int,
    antennas: FloatArray,
    cycles_per_metre: float,
    bins_per_metre: float,
    half_window: float,
) -> None:
    """Sum the lit pulses at pixels seen by two antennas: the range is half the sum of two square roots.

    Parameters
    ----------
    real, imag : (n,) float32
        The sums, added to in place; pixels in groups of FEW.
    farthest : (n,) float
        Rises to |range - reference_range| of a lit pulse, m.
    x, y, z : (n,) float
        m
    first, last : (n,) int32
        Pulses first <= p < last light a pixel.
    spans : (n_group, 2) int64
        Those that light any pixel of a group.
    start : int
        Pulse p has the row p - start of `origins` and `antennas`.
    antennas : (n_pulse, 7) float
        x, y and z of the transmitter, then of the receiver, and the reference range, m.
    """
    turns, rights = np.empty(CHUNK * FEW, np.float32), np.empty(CHUNK * FEW, np.float32)
    bins = np.empty(CHUNK * FEW, np.int32)
    for begin in range(start, start + antennas.shape[0], CHUNK):
        for group in range(spans.shape[0]):
            i = group * FEW
            px, py, pz = load_few(x, i), load_few(y, i), load_few(z, i)
            lit, unlit = load_few(first, i), load_few(last, i)
            low, high = max(spans[group, 0], begin), min(spans[group, 1], begin + CHUNK)
            re, im = load_few(real, i), load_few(imag, i)
            for p in range(low, high):
                j, k = (p - low) * FEW, p - start
                dx, dy, dz = px - antennas[k, 0], py - antennas[k, 1], pz - antennas[k, 2]
                there = square_root(dx * dx + (dy * dy + dz * dz))
                dx, dy, dz = px - antennas[k, 3], py - antennas[k, 4], pz - antennas[k, 5]
                away = 0.5 * (there + square_root(dx * dx + (dy * dy + dz * dz))) - antennas[k, 6]
                reached = within(larger(away, 0.0 - away), lit, p, unlit)
                store(farthest, i, larger(reached, load_few(farthest, i)))
                store(turns, j, remainder(away * cycles_per_metre))
                away = smaller(larger(away, -half_window), half_window)
                position = away * bins_per_metre + (FIXED_POINT + 0.5)
                store(bins, j, whole(position))
                store(rights, j, from_half(position))
            for p in range(low, high):
                j = (p - low) * FEW
                a, b = _sample(load_triples(samples, origins[p - start], bins, j), load_few(rights, j))
                a, b = within(a, lit, p, unlit), within(b, lit, p, unlit)
                re, im = _added(re, im, a, b, load_few(turns, j))
            store(real, i, re)
            store(imag, i, im)
