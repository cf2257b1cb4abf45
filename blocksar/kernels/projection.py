"""Sums of range profiles over pulses, for tiles of pixels: the loop of exact back-projection.

The pixels of a tile lie at offsets (dx, dy) from its centre. A pulse's antenna is at a distance R from the centre, in
the direction (ex, ey, ez). With g = 1 / (2 R),

    z = ex dx + ey dy + g (dx^2 + dy^2),  q = g z,

a pixel's range is R sqrt(1 + 4 q), without approximation, and that is a series with the Catalan numbers,

    range - R = z (1 - q + 2 q^2 - 5 q^3 + 14 q^4 - 42 q^5 + ...).

On a terrain, z has ez dz and g dz^2 besides, with dz the pixel's height above that of the centre.

The loop sums it to 14 q^4, in float64. `series_error` bounds the rest. Where that exceeds SERIES_ERROR, or the tile may
reach beyond the unambiguous window, the loop takes the square root instead. Either way ranges are rounded to a few
1e-16 of R: 1e-10 m at 700 km. Phases are reduced to less than a cycle in fixed point, of 2^-32; sines and cosines, the
weights of the quadratic spline and sums over pulses are float32.

Pixels are summed in groups, squares where they can be. Where a group is so small that its pixels are less than
MOST_CYCLES from its middle, only the middle's range is found as above, FEW pulses at a time, with the direction there;
those of the pixels follow from it by the same series to 2 q^2, in float32, with 1e-4 rad at most of the phase lost.

Under a taper over a steered beam a pulse's weight changes from pixel to pixel (`beam_weights`); tiles are divided until
the polynomial of the place in the beam is precise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit, types
from numpy.typing import NDArray

from blocksar.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from blocksar.kernels.beam_weights import BeamTaper, place_tables
from blocksar.kernels.lanes import (
    FEW,
    FIXED_POINT,
    FIXED_RANGE,
    NEAR,
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
from blocksar.kernels.loops import loop
from blocksar.kernels.phase import Float32Array
from blocksar.kernels.signatures import COMPILED, REAL_ROW, REAL_ROWS
from blocksar.kernels.trigonometry import cosine, cosine_and_sine

SERIES_ERROR = 1e-9  # m
CHUNK = 32  # pulses whose profiles, as far as neighbouring pixels read them, stay in the first-level cache
SQUARE = 4  # pixels, of whose ranges those of a group are as close together as can be
MOST_FILLED = 1.2  # times the pixels of a tile, to fill squares
MOST_CYCLES = 256.0  # from the middle of a group, of which float32 has enough of the phase: 1e-4 rad
SMALL = 4096  # pixels of a tile that is not divided
NEAREST = 1.0  # m: nearer antennas are left to the square root
PULSES = types.int32[::1]
ORIGINS = types.Array(types.int64, 1, "C", readonly=True)
WEIGHTS = types.Array(types.float32, 1, "C", readonly=True)


@dataclass(frozen=True, kw_only=True, eq=False)
class Sights:
    """What a block of pulses sees.

    Attributes
    ----------
    start : int
        The first pulse of the block.
    values : (n_row, n_bin) complex64
        Spline coefficients of the range profiles.
    rows : (n,) int
        The row of each pulse's profile.
    middle : int
        Bin of the reference range.
    bins_per_metre, cycles_per_metre : float
        How fast bins and phases go by with range.
    antenna : (3, n) float
        x, y and height over the ground, m.
    reference_range : (n,) float
        m
    half_window : float
        Largest unambiguous |range - reference_range|, m.
    taper : BeamTaper or None
        None where all pulses have equal weights.
    """

    start: int
    values: ComplexArray
    rows: IntArray
    middle: int
    bins_per_metre: float
    cycles_per_metre: float
    antenna: FloatArray
    reference_range: FloatArray
    half_window: float
    taper: BeamTaper | None = None


def series_error(reach: FloatArray | float, distance: FloatArray | float) -> FloatArray:
    """Largest error of the series at offsets up to `reach` from a point at a distance, m; infinite if it diverges."""
    q = np.asarray(reach / (2 * distance))
    q = q * (1 + q)
    # |z| <= reach (1 + q); each Catalan number is less than four times the one before.
    rest = 42 * q**5 * reach * (1 + q) / np.maximum(1 - 4 * q, 1e-9)
    return np.where(q < 0.25, rest, np.inf)


def project(
    image: ComplexArray,
    outside: BoolArray,
    sights: Sights,
    x: FloatArray,
    y: FloatArray,
    first: IntArray,
    last: IntArray,
    weight: Float32Array,
    height: FloatArray | None = None,
) -> None:
    """Add the pulses first <= p < last of a block to a tile of the image, in place.

    A tile that is too large for the series is divided, down to SMALL pixels; for places in the beam, to one.

    Parameters
    ----------
    image : (n_row, n_column) complex64
    outside : (n_row, n_column) bool
        Set where a lit pulse sees the pixel outside the unambiguous window.
    x, y : (n_row, n_column) float
        m
    first, last : (n_row, n_column) int
        Of the collection's pulses.
    weight : (n_row, n_column) float32
        Rises by the sum of weights under a taper; unchanged without one.
    height : (n_row, n_column) float, optional
        Of the pixels, over the ground that `sights.antenna` is over, m; finite. None: they lie on it.
    """
    size, n_bin, stop = x.size, sights.values.shape[1], sights.start + sights.reference_range.size
    begin, end = max(int(first.min()), sights.start), min(int(last.max()), stop)
    if begin >= end:
        return
    side = _group_side(x.shape)
    place = np.stack([_in_groups(axis, side) for axis in (x, y)])
    lit = np.stack([_in_groups(axis, side) for axis in (first, last)], dtype=np.int32)
    spans = np.clip(np.stack([lit[0].min(axis=1), lit[1].max(axis=1)], axis=1, dtype=np.int64), begin, end)
    pulses = slice(begin - sights.start, end - sights.start)
    low, high = place.min(axis=(1, 2)), place.max(axis=(1, 2))
    centre = (low + high) / 2
    reach, middle, relief = float(np.hypot(*(high - low)) / 2), 0.0, np.empty((0, FEW))
    if height is not None:
        relief = _in_groups(height, side)
        middle = float(relief.min() + relief.max()) / 2
        relief = relief - middle
        reach = float(np.hypot(reach, relief.max()))
    series, roots = pulse_tables(sights, pulses, centre, reach=reach, height=middle)
    over = None if height is None else (middle, float(relief.max()))
    places, precise = place_tables(sights.taper, pulses, low, high, over)
    if (size > SMALL and not series[0, :-FEW].all()) or (size > 1 and not precise):
        for part in _halves(x.shape):
            of_part = None if height is None else height[part]
            project(
                image[part], outside[part], sights, x[part], y[part], first[part], last[part], weight[part], of_part
            )
        return
    middles, close = _middles([*place, relief] if relief.size else [*place], sights)
    close &= bool(series[0, :-FEW].all())
    sums, farthest = np.zeros((3, place[0].size), np.float32), np.zeros(place[0].size)
    terms = np.zeros(0, np.float32) if sights.taper is None else sights.taper.series
    frequency, fade = (0.0, 0) if sights.taper is None else (sights.taper.frequency, sights.taper.fade)
    # A sample is loaded as one number of 64 bits, so that vectors of samples are transposed whole.
    samples, origins = sights.values.reshape(-1).view(np.float64), sights.rows[pulses] * n_bin + sights.middle
    add_pulses(
        *sums, farthest, samples, origins, *(axis.ravel() for axis in place), *centre, *(axis.ravel() for axis in lit),
        spans, close, middles, begin, series, roots, sights.cycles_per_metre, sights.bins_per_metre,
        sights.half_window, places, terms, frequency / 2, fade / 2, relief.ravel(),
    )  # fmt: skip
    if sights.taper is not None:
        weight += _from_groups(sums[2], side, image.shape)
    image.real += _from_groups(sums[0], side, image.shape)
    image.imag += _from_groups(sums[1], side, image.shape)
    if not series[0, :-FEW].all():
        outside |= _from_groups(farthest, side, image.shape) > sights.half_window


def _group_side(shape: tuple[int, ...]) -> tuple[int, int]:
    """Rows and columns of the pixels of a group: a square, or one after the other where squares would add many."""
    filled = math.prod(-(-n // SQUARE) * SQUARE for n in shape)
    return (SQUARE, SQUARE) if filled <= MOST_FILLED * math.prod(shape) else (1, FEW)


def _in_groups(values: NDArray[Any], side: tuple[int, int]) -> NDArray[Any]:
    """Pixels (n_row, n_column) as groups (n, FEW), the last pixels repeated to make them whole."""
    values = values.reshape(1, -1) if side[0] == 1 else values
    fill = [(0, -n % k) for n, k in zip(values.shape, side, strict=True)]
    filled = np.pad(values, fill, mode="edge") if any(after for _, after in fill) else values
    return filled.reshape(filled.shape[0] // side[0], side[0], -1, side[1]).swapaxes(1, 2).reshape(-1, FEW)


def _from_groups(values: NDArray[Any], side: tuple[int, int], shape: tuple[int, ...]) -> NDArray[Any]:
    """Values of the lanes of groups as the pixels (n_row, n_column) of a shape."""
    if side[0] == 1:
        return values[: math.prod(shape)].reshape(shape)
    rows, columns = (-(-n // k) for n, k in zip(shape, side, strict=True))
    pixels = values.reshape(rows, columns, *side).swapaxes(1, 2).reshape(rows * side[0], columns * side[1])
    return pixels[: shape[0], : shape[1]]


def _middles(axes: Sequence[FloatArray], sights: Sights) -> tuple[FloatArray, BoolArray]:
    """The middles of groups whose pixels lie at coordinates (n, FEW), m, each: (3, n) float, the third 0 on a plane.

    And whether their ranges differ by so little that those from the middle may be found in float32, and the samples
    by `load_near`.
    """
    middles, squared = np.zeros((3, axes[0].shape[0])), 0.0
    for middle, axis in zip(middles, axes, strict=False):
        middle[:] = (axis.min(axis=1) + axis.max(axis=1)) / 2
        squared = squared + np.square(axis - middle[:, None]).max(axis=1)
    apart = np.sqrt(squared)
    return middles, (apart * sights.bins_per_metre < NEAR[1] - 1) & (apart * sights.cycles_per_metre < MOST_CYCLES)


def _halves(shape: tuple[int, ...]) -> list[tuple[slice, slice]]:
    """A tile's halves along its longer side."""
    rows, columns = shape
    if rows > columns:
        return [(slice(0, rows // 2), slice(None)), (slice(rows // 2, None), slice(None))]
    return [(slice(None), slice(0, columns // 2)), (slice(None), slice(columns // 2, None))]


def pulse_tables(
    sights: Sights, pulses: slice, centre: FloatArray, *, reach: float, height: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """For each pulse, what the series needs, first whether it may be used; and what the square root needs.

    The last of each is for pixels that lie over or under the centre, which is at a height, m. Of the first table, (8,
    n + FEW), each row is of one kind, and goes on with zeros; the second is (n, 5).
    """
    x, y = centre[:, None] - sights.antenna[:2, pulses]
    up = height - sights.antenna[2, pulses]
    over, reference = up**2, sights.reference_range[pulses]
    distance = np.maximum(np.sqrt(x**2 + y**2 + over), NEAREST)
    away, per_metre = distance - reference, sights.cycles_per_metre
    cycles, scale = per_metre * away, per_metre / distance
    precise = (series_error(reach, distance) < SERIES_ERROR) & (distance > NEAREST)
    inside = (np.abs(away) + 2 * reach < sights.half_window) & (2 * reach * per_metre < FIXED_RANGE / 2)
    series = np.zeros((8, distance.size + FEW))
    of_pulses = series[:, : distance.size]
    of_pulses[0] = precise & inside
    of_pulses[1], of_pulses[2], of_pulses[3] = scale * x, scale * y, scale / 2
    of_pulses[4] = 0.5 / (distance * per_metre)
    of_pulses[5] = cycles - np.rint(cycles) + FIXED_POINT
    of_pulses[6] = away * sights.bins_per_metre + (FIXED_POINT + 0.5)
    of_pulses[7] = scale * up
    return series, np.stack([x, y, over, reference, up], axis=1)


@njit(inline="always")
def _by_series(series: Any, k: Any, slope: Any, dx: Any, dy: Any, bins_per_cycle: Any) -> Any:
    """Phase, in cycles about a whole number, and position in the profile, in bins and fixed point.

    `slope` is the part of z that does not depend on dx and dy to the first order.
    """
    away = _series(series[1, k] * dx + (series[2, k] * dy + slope), series[4, k])
    return from_whole(away + series[5, k]), away * bins_per_cycle + series[6, k]


@njit(inline="always")
def _series(z: Any, g: Any) -> Any:
    """The range less that of the centre, by the series of z and q = g z."""
    q = g * z
    return z + z * (q * (((14.0 * q - 5.0) * q + 2.0) * q - 1.0))


@njit(inline="always")
def _see_middle(seen: Any, bins: Any, series: Any, k: Any, j: Any, dx: Any, dy: Any, dz: Any, per_cycle: Any) -> None:
    """What the pixels about the middle of a group need of FEW pulses, in `seen` (7, n) and `bins` (n,) from j on.

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
def _by_root(roots: Any, k: Any, dx: Any, dy: Any, up: Any) -> Any:
    """Range - reference_range; `up` is the square of the height difference."""
    x, y = dx + roots[k, 0], dy + roots[k, 1]
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
    """What heights dz over the centre's add to it."""
    return (places[k, 7] + places[k, 8] * dx + places[k, 9] * dy + places[k, 10] * dz) * dz


@njit(inline="always")
def _weight(v: Any, terms: Any, half_frequency: Any) -> Any:
    """sum_k terms_k cos(2 pi k half_frequency v), by Clenshaw's recurrence; at most |half_frequency v| = 1/2."""
    turned = remainder(v * half_frequency)
    cos = cosine(turned)
    twice = cos + cos
    last, total = cos - cos, cos - cos
    for k in range(terms.size - 1):
        last, total = total, terms[terms.size - 1 - k] + (twice * total - last)
    return terms[0] + (cos * total - last)


@njit(inline="always")
def _faded(v: Any, terms: Any, half_fade: Any) -> Any:
    """The same times what the fade takes, from the FADE_DEGREE + 1 power coefficients of both."""
    half = remainder(smaller((1.0 - larger(v, 0.0 - v)) * half_fade, 0.5))
    square = half * half
    high = square * terms[6] + (half * terms[5] + terms[4])
    return (half * terms[1] + terms[0]) + square * ((half * terms[3] + terms[2]) + square * high)


@loop(
    types.float32[::1], types.float32[::1], types.float32[::1], types.float64[::1], REAL_ROW, ORIGINS,
    REAL_ROW, REAL_ROW, types.float64, types.float64, PULSES, PULSES, types.int64[:, ::1], types.boolean[::1],
    REAL_ROWS, types.int64, REAL_ROWS, REAL_ROWS, types.float64, types.float64, types.float64, REAL_ROWS, WEIGHTS,
    types.float64, types.float64, REAL_ROW, **COMPILED,
)  # fmt: skip
def add_pulses(
    real: NDArray[np.float32],
    imag: NDArray[np.float32],
    weight: NDArray[np.float32],
    farthest: FloatArray,
    samples: FloatArray,
    origins: IntArray,
    x: FloatArray,
    y: FloatArray,
    centre_x: float,
    centre_y: float,
    first: NDArray[np.int32],
    last: NDArray[np.int32],
    spans: IntArray,
    close: BoolArray,
    middles: FloatArray,
    start: int,
    series: FloatArray,
    roots: FloatArray,
    cycles_per_metre: float,
    bins_per_metre: float,
    half_window: float,
    places: FloatArray,
    terms: NDArray[np.float32],
    half_frequency: float,
    half_fade: float,
    relief: FloatArray,
) -> None:
    """Sum the lit pulses, in ascending order, at pixels (n,).

    With `terms`, each pulse has a weight that depends on the pixel's place in the beam, of which `places` has the
    polynomials and, last, the fraction of valid samples; `weight` rises by their sum.

    `spans` holds the pulses that light any pixel of a group of FEW; tables begin at the pulse `start`, also `origins`,
    which has the sample of each profile at its pulse's reference range. Pixels of `close` groups are seen from their
    middle: its range and direction are found in float64, for FEW pulses at a time, and theirs from that in float32.
    `farthest` rises to |range - reference_range| where a lit pulse needed the square root. `relief` has the heights of
    the pixels over the tile's centre; it is empty on a plane. Weights fade where `half_fade` is positive.
    """
    turns, rights = np.empty(CHUNK * FEW, np.float32), np.empty(CHUNK * FEW, np.float32)
    bins, shares = np.empty(CHUNK * FEW, np.int32), np.empty(CHUNK * FEW, np.float32)
    seen, per_cycle = np.empty((7, CHUNK + FEW), np.float32), bins_per_metre / cycles_per_metre
    hilly, weighted = relief.size > 0, terms.size > 0
    for begin in range(start, start + series.shape[1] - FEW, CHUNK):
        for group in range(spans.shape[0]):
            i = group * FEW
            dx, dy = load_few(x, i) - centre_x, load_few(y, i) - centre_y
            dz = dx
            square, lit, unlit = dx * dx + dy * dy, load_few(first, i), load_few(last, i)
            if hilly:
                dz = load_few(relief, i)
                square = square + dz * dz
            low, high = max(spans[group, 0], begin), min(spans[group, 1], begin + CHUNK)
            if weighted:
                share = load_few(weight, i)
                for p in range(low, high):
                    k = p - start
                    v = _place(places, k, dx, dy)
                    if hilly:
                        v = v + _rise(places, k, dx, dy, dz)
                    v = smaller(larger(v, -1.0), 1.0)
                    part = _faded(v, terms, half_fade) if half_fade > 0 else _weight(v, terms, half_frequency)
                    part = within(part, lit, p, unlit)
                    store(shares, (p - low) * FEW, part)
                    share = share + part * np.float32(places[k, 6])
                store(weight, i, share)
            re, im = load_few(real, i), load_few(imag, i)
            if close[group]:
                mx, my, mz = middles[0, group] - centre_x, middles[1, group] - centre_y, middles[2, group]
                for p in range(low, high, FEW):
                    _see_middle(seen, bins, series, p - start, p - low, mx, my, mz, per_cycle)
                ux, uy = single(dx - mx), single(dy - my)
                uz, square_u = ux, ux * ux + uy * uy
                if hilly:
                    uz = single(dz - mz)
                    square_u = square_u + uz * uz
                for p in range(low, high):
                    j = p - low
                    z = seen[3, j] * ux + (seen[4, j] * uy + seen[2, j] * square_u)
                    if hilly:
                        z = z + seen[5, j] * uz
                    q = seen[6, j] * z
                    away = z + z * (q * (q + q - np.float32(1.0)))
                    _, turn = nearest(away + seen[0, j])
                    offset, right = nearest(away * np.float32(per_cycle) + seen[1, j])
                    a, b = _sample(load_near(samples, origins[p - start] + bins[j], offset), right)
                    a, b = within(a, lit, p, unlit), within(b, lit, p, unlit)
                    cos, sin = cosine_and_sine(turn)
                    if weighted:
                        cos, sin = cos * load_few(shares, j * FEW), sin * load_few(shares, j * FEW)
                    re, im = re + a * cos - b * sin, im + a * sin + b * cos
                store(real, i, re)
                store(imag, i, im)
                continue
            # Two loops, since the way from a pulse to its samples is long: the CPU then looks ahead over more pulses.
            for p in range(low, high):
                j, k = (p - low) * FEW, p - start
                if series[0, k] > 0:
                    slope = series[3, k] * square
                    if hilly:
                        slope = series[7, k] * dz + slope
                    cycles, position = _by_series(series, k, slope, dx, dy, per_cycle)
                else:
                    up = spread_few(roots[k, 2])
                    if hilly:
                        up = (dz + roots[k, 4]) * (dz + roots[k, 4])
                    away = _by_root(roots, k, dx, dy, up)
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
                cos, sin = cosine_and_sine(load_few(turns, j))
                if weighted:
                    cos, sin = cos * load_few(shares, j), sin * load_few(shares, j)
                re, im = re + a * cos - b * sin, im + a * sin + b * cos
            store(real, i, re)
            store(imag, i, im)
