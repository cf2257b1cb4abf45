"""Sums of range profiles over pulses, for tiles of pixels: the loop of exact back-projection.

The pixels of a tile lie at offsets (dx, dy) from its centre. A pulse's antenna is at a distance R from the centre, in
the direction (ex, ey, ez). With g = 1 / (2 R),

    z = ex dx + ey dy + g (dx^2 + dy^2),  q = g z,

a pixel's range is R sqrt(1 + 4 q), without approximation, and that is a series with the Catalan numbers,

    range - R = z (1 - q + 2 q^2 - 5 q^3 + 14 q^4 - 42 q^5 + ...).

Where pixels differ in height, z has ez dz and g dz^2 besides, with dz the pixel's height above that of the centre.

The loop sums it to 14 q^4, in float64. `series_error` bounds the rest. Where that exceeds SERIES_ERROR, or the tile may
reach beyond the unambiguous window, the loop takes the square root instead. Either way ranges are rounded to a few
1e-16 of R: 1e-10 m at 700 km. Phases are reduced to less than a cycle in fixed point, of 2^-32; sines and cosines, the
weights of the quadratic spline and sums over pulses are float32.

Pixels are summed in groups, squares where they can be. Where a group is so small that its pixels are less than
MOST_CYCLES from its middle, only the middle's range is found as above, FEW pulses at a time, with the direction there;
those of the pixels follow from it by the same series to 2 q^2, in float32, with 1e-4 rad at most of the phase lost.

Under a taper over a steered beam a pulse's weight changes from pixel to pixel (below); tiles are divided until
the polynomial of the place in the beam is precise.

Weights of pulses over a tile of pixels, under a taper over a steered beam.

The place v in the beam is a quadratic polynomial over a tile, through 3 x 3 places; tiles are divided until it errs by
less than PLACE_ERROR.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from blocksar.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from blocksar.kernels.lanes import FEW, FIXED_POINT, FIXED_RANGE, NEAR
from blocksar.kernels.phase import Float32Array
from blocksar.kernels.pulse_sums import add_bistatic_pulses, add_pulses
from blocksar.solvers import least_squares, product

PLACE_ERROR = 1e-5  # of a place in the beam, whose half width is 1


@dataclass(frozen=True, kw_only=True, eq=False)
class BeamTaper:
    """Weights of pulses that change from pixel to pixel: sum_k terms_k cos(pi frequency k v).

    Attributes
    ----------
    terms : (n,) float
    frequency : float
    valid : (n,) float
        Fraction of each pulse's samples that are there.
    place : callable
        v (n_point, n) of points x, y, z (n_point,), m, for some pulses of the block: -1 .. 1 where they light them.
    """

    terms: FloatArray
    frequency: float
    valid: FloatArray
    place: Callable[[FloatArray, FloatArray, FloatArray, slice], FloatArray]


def place_tables(taper: BeamTaper | None, pulses: slice, low: FloatArray, high: FloatArray) -> tuple[FloatArray, bool]:
    """For each pulse the polynomial of the place in the beam over a tile from `low` to `high` (3,), m.

    Returns
    -------
    places : (n, 7) or (n, 11) float
        Coefficients of 1, dx, dy, dx^2, dx dy and dy^2, from the tile's centre, and the fraction of valid samples; of a
        tile that is not level those of dz, dx dz, dy dz and dz^2 besides; without a taper none.
    precise : bool
        Whether it errs by less than PLACE_ERROR, where the pulse lights any of the tile.
    """
    if taper is None:
        return np.empty((0, 7)), True
    centre, half = (low + high) / 2, np.maximum((high - low) / 2, 1e-6)
    if high[2] > low[2]:
        return _places_on_relief(taper, pulses, centre, half)
    at = np.linspace(-1, 1, 5)
    u, w = (axis.ravel() for axis in np.meshgrid(at, at))
    exact = taper.place(centre[0] + half[0] * u, centre[1] + half[1] * w, np.full_like(u, centre[2]), pulses)
    grid = exact.reshape(5, 5, -1)[::2, ::2]  # rows along y
    middle, (left, right), (below, above) = grid[1, 1], grid[1, ::2], grid[::2, 1]
    mixed = (grid[2, 2] - grid[2, 0] - grid[0, 2] + grid[0, 0]) / 4
    right, left, above, below = right - middle, middle - left, above - middle, middle - below
    bends = (right - left) / 2, mixed, (above - below) / 2
    places = np.stack([middle, (right + left) / 2, (above + below) / 2, *bends], axis=1)
    fitted = product(places, np.stack([np.ones_like(u), u, w, u * u, u * w, w * w]))
    near = (np.abs(exact) <= 1).any(axis=0)
    precise = bool((np.abs(fitted.T - exact)[:, near] < PLACE_ERROR).all())
    scale = np.array([1.0, half[0], half[1], half[0] ** 2, half[0] * half[1], half[1] ** 2])
    return np.column_stack([places / scale, taper.valid[pulses]]), precise


def _places_on_relief(taper: BeamTaper, pulses: slice, centre: FloatArray, half: FloatArray) -> tuple[FloatArray, bool]:
    """`place_tables` with the height as third coordinate: the quadratic polynomial closest to 3 x 3 x 3 places."""
    nodes = np.array([axis.ravel() for axis in np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3)])
    x, y, z = (c + h * u for c, h, u in zip(centre, half, nodes, strict=True))
    exact = taper.place(x, y, z, pulses)
    exponents = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (2, 0, 0), (1, 1, 0), (0, 2, 0), (0, 0, 1), (1, 0, 1),
                          (0, 1, 1), (0, 0, 2)])  # fmt: skip
    terms = np.prod(nodes.T[:, None, :] ** exponents, axis=-1)
    places = least_squares(terms.T, exact.T).T
    near = (np.abs(exact) <= 1).any(axis=0)
    precise = bool((np.abs(product(terms, places.T) - exact)[:, near] < PLACE_ERROR).all())
    places = places / np.prod(half**exponents, axis=-1)
    table = np.column_stack([places[:, :6], taper.valid[pulses], places[:, 6:]])
    return np.ascontiguousarray(table), precise


UPSAMPLING = {"cpu": 6, "gpu": 10}  # bins of profiles per range cell: the spline errs by -69 and -82 dB
SERIES_ERROR = 1e-9  # m
SQUARE = 4  # pixels, of whose ranges those of a group are as close together as can be
MOST_FILLED = 1.2  # times the pixels of a tile, to fill squares
MOST_CYCLES = 256.0  # from the middle of a group, of which float32 has enough of the phase: 1e-4 rad
SMALL = 4096  # pixels of a tile that is not divided
NEAREST = 1.0  # m: nearer antennas are left to the square root


@dataclass(frozen=True, kw_only=True, eq=False)
class Sights:
    """View of the ground from a block of pulses, and its range profiles.

    Attributes
    ----------
    start : int
        The first pulse of the block.
    values : (n, n_bin) complex64
        Spline coefficients of the range profiles.
    middle : int
        Bin of the reference range.
    bins_per_metre, cycles_per_metre : float
        How fast bins and phases go by with range.
    antenna : (3, n) float
        x, y and z, m.
    receiver : (3, n) float or None
        Of another antenna that receives, m: `antenna` transmits then, and ranges are half the way to both.
    reference_range : (n,) float
        m
    half_window : float
        Largest unambiguous |range - reference_range|, m.
    taper : BeamTaper or None
        None where all pulses have equal weights.
    """

    start: int
    values: ComplexArray
    middle: int
    bins_per_metre: float
    cycles_per_metre: float
    antenna: FloatArray
    reference_range: FloatArray
    half_window: float
    taper: BeamTaper | None = None
    receiver: FloatArray | None = None


class LitPixels(NamedTuple):
    """Pixels (n_row, n_column), and the pulses first <= p < last of the collection that light them.

    Attributes
    ----------
    x, y, z : float
        m, scene frame; finite.
    first, last : int
    """

    x: FloatArray
    y: FloatArray
    z: FloatArray
    first: IntArray
    last: IntArray

    def of(self, part: tuple[slice, slice]) -> LitPixels:
        """Pixels of some rows and columns."""
        return LitPixels(self.x[part], self.y[part], self.z[part], self.first[part], self.last[part])


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
    pixels: LitPixels,
    weight: Float32Array,
) -> None:
    """Add the pulses of a block to the pixels of a tile of the image that they light, in place.

    A tile that is too large for the series is divided, down to SMALL pixels; for places in the beam, to one.

    Parameters
    ----------
    image : (n_row, n_column) complex64
    outside : (n_row, n_column) bool
        Set where a lit pulse sees the pixel outside the unambiguous window.
    pixels : LitPixels
        (n_row, n_column)
    weight : (n_row, n_column) float32
        Rises by the sum of weights under a taper; unchanged without one.
    """
    x, y, z, first, last = pixels
    size, n_bin, stop = x.size, sights.values.shape[1], sights.start + sights.reference_range.size
    begin, end = max(int(first.min()), sights.start), min(int(last.max()), stop)
    if begin >= end:
        return
    side = _group_side(x.shape)
    place = _in_groups(np.stack([x, y, z]), side)
    lit = _in_groups(np.stack([first, last], dtype=np.int32), side)
    spans = np.clip(np.stack([lit[0].min(axis=1), lit[1].max(axis=1)], axis=1, dtype=np.int64), begin, end)
    pulses = slice(begin - sights.start, end - sights.start)
    # A sample is loaded as one number of 64 bits, so that vectors of samples are transposed whole.
    samples, origins = (
        sights.values.reshape(-1).view(np.float64),
        np.arange(pulses.start, pulses.stop) * n_bin + sights.middle,
    )
    if sights.receiver is not None:
        sums, farthest = np.zeros((2, place[0].size), np.float32), np.zeros(place[0].size)
        ends = sights.antenna[:, pulses], sights.receiver[:, pulses], sights.reference_range[None, pulses]
        antennas = np.ascontiguousarray(np.concatenate(ends).T)
        add_bistatic_pulses(
            *sums, farthest, samples, origins, *(axis.ravel() for axis in place), *(axis.ravel() for axis in lit),
            spans, begin, antennas, sights.cycles_per_metre, sights.bins_per_metre, sights.half_window,
        )  # fmt: skip
        image.real += _from_groups(sums[0], side, image.shape)
        image.imag += _from_groups(sums[1], side, image.shape)
        outside |= _from_groups(farthest, side, image.shape) > sights.half_window
        return
    low, high = place.min(axis=(1, 2)), place.max(axis=(1, 2))
    centre = (low + high) / 2
    series, roots = pulse_tables(sights, pulses, centre, reach=float(np.linalg.norm(high - low)) / 2)
    places, precise = place_tables(sights.taper, pulses, low, high)
    if (size > SMALL and not series[0, :-FEW].all()) or (size > 1 and not precise):
        for part in halves(x.shape):
            project(image[part], outside[part], sights, pixels.of(part), weight[part])
        return
    middles, close = _middles(place, sights)
    close &= bool(series[0, :-FEW].all())
    sums, farthest = np.zeros((3, place[0].size), np.float32), np.zeros(place[0].size)
    terms = np.zeros(0, np.float32) if sights.taper is None else sights.taper.terms.astype(np.float32)
    frequency = 0.0 if sights.taper is None else sights.taper.frequency
    add_pulses(
        *sums, farthest, samples, origins, *(axis.ravel() for axis in place), high[2] > low[2], *centre,
        *(axis.ravel() for axis in lit), spans, close, middles, begin, series, roots, sights.cycles_per_metre,
        sights.bins_per_metre, sights.half_window, places, terms, frequency / 2,
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
    """Pixels (k, n_row, n_column) as groups (k, n, FEW), the last pixels repeated to make them whole."""
    k = values.shape[0]
    values = values.reshape(k, 1, -1) if side[0] == 1 else values
    fill = [(0, 0), *((0, -n % each) for n, each in zip(values.shape[1:], side, strict=True))]
    filled = np.pad(values, fill, mode="edge") if any(after for _, after in fill) else values
    return filled.reshape(k, filled.shape[1] // side[0], side[0], -1, side[1]).swapaxes(2, 3).reshape(k, -1, FEW)


def _from_groups(values: NDArray[Any], side: tuple[int, int], shape: tuple[int, ...]) -> NDArray[Any]:
    """Values of the lanes of groups as the pixels (n_row, n_column) of a shape."""
    if side[0] == 1:
        return values[: math.prod(shape)].reshape(shape)
    rows, columns = (-(-n // k) for n, k in zip(shape, side, strict=True))
    pixels = values.reshape(rows, columns, *side).swapaxes(1, 2).reshape(rows * side[0], columns * side[1])
    return pixels[: shape[0], : shape[1]]


def _middles(place: FloatArray, sights: Sights) -> tuple[FloatArray, BoolArray]:
    """The middles (3, n) float of groups whose pixels lie at `place` (3, n, FEW), m.

    And whether their ranges differ by so little that those from the middle may be found in float32, and the samples
    by `load_near`.
    """
    middles = (place.min(axis=2) + place.max(axis=2)) / 2
    apart = np.sqrt(np.square(place - middles[..., None]).max(axis=2).sum(axis=0))
    return middles, (apart * sights.bins_per_metre < NEAR[1] - 1) & (apart * sights.cycles_per_metre < MOST_CYCLES)


def halves(shape: tuple[int, ...]) -> list[tuple[slice, slice]]:
    """A tile's halves along its longer side."""
    rows, columns = shape
    if rows > columns:
        return [(slice(0, rows // 2), slice(None)), (slice(rows // 2, None), slice(None))]
    return [(slice(None), slice(0, columns // 2)), (slice(None), slice(columns // 2, None))]


def pulse_tables(sights: Sights, pulses: slice, centre: FloatArray, *, reach: float) -> tuple[FloatArray, FloatArray]:
    """For each pulse, what the series needs, first whether it may be used; and what the square root needs.

    The last of each is for pixels that lie over or under the centre (3,), m. Of the first table, (8, n + FEW), each row
    is of one kind, and goes on with zeros; the second is (n, 5).
    """
    x, y, up = centre[:, None] - sights.antenna[:, pulses]
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
