"""Inner loop of back-projection over the pulses that light groups of pixels, compiled: see `projection`."""

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
from blocksar.kernels.loops import COMPILED, PART, REAL_ROWS, loop

CHUNK = 32  # pulses whose profiles, as far as neighbouring pixels read them, stay in the first-level cache
MOST_FILLED = 1.2  # times the pixels of a tile, to fill squares
WINDOWS = types.Array(types.int64, 2, "C", readonly=True)
ORIGINS = types.Array(types.int64, 1, "C", readonly=True)
WEIGHTS = types.Array(types.float32, 1, "C", readonly=True)


@njit(inline="always")
def _by_series(
    series: Any, k: Any, square: Any, dx: Any, dy: Any, dz: Any, hilly: Any, bins_per_cycle: Any
) -> tuple[Any, Any]:
    """Phase, cycles modulo 1, and position in the profile, bins in fixed point, by the series."""
    slope = series[3, k] * square
    if hilly:
        slope = series[7, k] * dz + slope
    away = _series(series[1, k] * dx + (series[2, k] * dy + slope), series[4, k])
    return from_whole(away + series[5, k]), away * bins_per_cycle + series[6, k]


@njit(inline="always")
def _series(z: Any, g: Any) -> Any:
    """Range relative to that of the centre, by the series of z and q = g z."""
    q = g * z
    return z + z * (q * (((14.0 * q - 5.0) * q + 2.0) * q - 1.0))


@njit(**PART, **COMPILED)
def _see_middle(seen: Any, bins: Any, series: Any, k: Any, j: Any, dx: Any, dy: Any, dz: Any, per_cycle: Any) -> None:
    """Prepare the view of FEW pulses on the pixels about a group's middle, in `seen` (7, n) and `bins` (n,) from j on.

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
    """Offsets from a group's middle in float32, and squared distances."""
    ux, uy, uz = single(dx), single(dy), single(dz)
    return ux, uy, uz, ux * ux + uy * uy + uz * uz


@njit(inline="always")
def _by_root(roots: Any, k: Any, dx: Any, dy: Any, dz: Any, hilly: Any) -> Any:
    """Range minus reference range, by the square root."""
    x, y, up = dx + roots[k, 0], dy + roots[k, 1], spread_few(roots[k, 2])
    if hilly:
        up = (dz + roots[k, 4]) * (dz + roots[k, 4])
    return square_root(x * x + (y * y + up)) - roots[k, 3]


@njit(inline="always")
def _sample(triples: Any, right: Any) -> Any:
    """Quadratic spline at `right` bins from the middle one of three: real and imaginary part."""
    a, b, c, d, e, f = triples
    half, eighth, three_quarters = np.float32(0.5), np.float32(0.125), np.float32(0.75)
    odd, square = half * right, right * right
    even = half * square + eighth
    before, at, after = even - odd, three_quarters - square, even + odd
    return before * a + at * b + after * c, before * d + at * e + after * f


@njit(inline="always")
def _place(places: Any, k: Any, dx: Any, dy: Any) -> Any:
    """Place v in the beam."""
    bend = places[k, 3] * dx + places[k, 4] * dy
    return places[k, 0] + (places[k, 1] * dx + places[k, 2] * dy) + bend * dx + places[k, 5] * dy * dy


@njit(inline="always")
def _rise(places: Any, k: Any, dx: Any, dy: Any, dz: Any) -> Any:
    """Increase of a series by heights dz over the centre's."""
    return (places[k, 7] + places[k, 8] * dx + places[k, 9] * dy + places[k, 10] * dz) * dz


@njit(inline="always")
def _taper(v: Any, terms: Any, half_frequency: Any) -> Any:
    """Evaluate sum_k terms_k cos(2 pi k half_frequency v) by Clenshaw's recurrence; |half_frequency v| <= 1/2."""
    turned = remainder(v * half_frequency)
    cos = cosine(turned)
    twice = cos + cos
    last, total = cos - cos, cos - cos
    for k in range(terms.size - 1):
        last, total = total, terms[terms.size - 1 - k] + (twice * total - last)
    return terms[0] + (cos * total - last)


@njit(inline="always")
def _added(re: Any, im: Any, a: Any, b: Any, turn: Any) -> Any:
    """Add a + 1j b, rotated by a phase in cycles, to the sums."""
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
    for begin in range(spans[:, 0].min(), spans[:, 1].max(), CHUNK):
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
    """`add_pulses` where transmitter and receiver are two antennas: R is half the sum of two square roots.

    Parameters
    ----------
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
