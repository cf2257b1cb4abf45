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

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from blocksar.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from blocksar.kernels.lanes import FEW, FIXED_POINT, FIXED_RANGE
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
        v (k, n) of points x, y, z (k, n), m, each for one of the pulses (n,) of the block: -1 .. 1 where it lights
        them.
    """

    terms: FloatArray
    frequency: float
    valid: FloatArray
    place: Callable[[FloatArray, FloatArray, FloatArray, IntArray], FloatArray]

    def of(self, pulses: slice) -> BeamTaper:
        """Take some pulses of the block."""

        def place(x: FloatArray, y: FloatArray, z: FloatArray, some: IntArray) -> FloatArray:
            return self.place(x, y, z, some + pulses.start)

        return replace(self, valid=self.valid[pulses], place=place)


@dataclass(frozen=True, kw_only=True, eq=False)
class Tiles:
    """Tiles (n) of pixels, and the pulses of a block that light them.

    Attributes
    ----------
    windows : (n, 4) int
        Rows from the first to before the second, columns from the third to before the fourth.
    low, high : (n, 3) float
        The box around each, m.
    rows : (n, 2) int
        Pulses first <= p < last: all that light any of it.
    """

    windows: IntArray
    low: FloatArray
    high: FloatArray
    rows: IntArray

    @staticmethod
    def of(pixels: LitPixels, windows: Sequence[tuple[slice, slice]], pulses: tuple[int, int]) -> Tiles:
        """Tiles of pixels (n_row, n_column), as far as any of some pulses begin <= p < end lights them."""
        some, low, high, rows = [], [], [], []
        for window in windows:
            x, y, z, first, last = pixels.of(window)
            begin, end = max(int(first.min()), pulses[0]), min(int(last.max()), pulses[1])
            if begin < end:
                some.append([window[0].start, window[0].stop, window[1].start, window[1].stop])
                low.append([x.min(), y.min(), z.min()])
                high.append([x.max(), y.max(), z.max()])
                rows.append([begin, end])
        ends = (np.array(each, np.int64).reshape(-1, n) for each, n in ((some, 4), (rows, 2)))
        windows_, rows_ = ends
        return Tiles(windows=windows_, low=np.array(low).reshape(-1, 3), high=np.array(high).reshape(-1, 3), rows=rows_)

    def some(self, chosen: slice | BoolArray) -> Tiles:
        """Some of them."""
        return Tiles(windows=self.windows[chosen], low=self.low[chosen], high=self.high[chosen], rows=self.rows[chosen])

    def slices(self) -> list[tuple[slice, slice]]:
        """Rows and columns of each."""
        return [(slice(a, b), slice(c, d)) for a, b, c, d in self.windows.tolist()]

    @property
    def pixels(self) -> IntArray:
        """The number of pixels (n,) of each."""
        ends = self.windows
        return np.asarray((ends[:, 1] - ends[:, 0]) * (ends[:, 3] - ends[:, 2]))


def place_tables(
    taper: BeamTaper | None, pulses: IntArray, tile: IntArray, low: FloatArray, high: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """The polynomials of the place in the beam over tiles from `low` to `high` (n_tile, 3), m.

    Parameters
    ----------
    taper : BeamTaper or None
    pulses, tile : (n,) int
        Pulses of the block, and the tile over which each is seen.

    Returns
    -------
    places : (n, 7) or (n, 11) float
        Coefficients of 1, dx, dy, dx^2, dx dy and dy^2, from the tile's centre, and the fraction of valid samples; of
        tiles that are not level those of dz, dx dz, dy dz and dz^2 besides; without a taper none.
    precise : (n,) bool
        Whether it errs by less than PLACE_ERROR, or the pulse lights nothing of the tile.
    """
    if taper is None:
        return np.empty((0, 7)), np.ones(pulses.size, np.bool_)
    centre, half = ((low + high) / 2)[tile], np.maximum((high - low) / 2, 1e-6)[tile]
    relief = bool((high[:, 2] > low[:, 2]).any())
    at = np.linspace(-1, 1, 3 if relief else 5)
    nodes = np.array([axis.ravel() for axis in np.meshgrid(at, at, at if relief else [0.0])])
    x, y, z = (centre[:, k] + half[:, k] * nodes[k][:, None] for k in range(3))
    exact = taper.place(x, y, z, pulses)
    exponents = EXPONENTS if relief else EXPONENTS[:6]
    terms = np.prod(nodes.T[:, None, :] ** exponents, axis=-1)
    places = least_squares(terms.T, exact.T).T
    near = (np.abs(exact) <= 1).any(axis=0)
    precise = np.asarray(~near | (np.abs(product(terms, places.T) - exact) < PLACE_ERROR).all(axis=0))
    places = places / np.prod(half[:, None, :] ** exponents, axis=-1)
    table = np.column_stack([places[:, :6], taper.valid[pulses], places[:, 6:]])
    return np.ascontiguousarray(table), precise


# Of dx, dy and dz in the terms of a polynomial of the place in the beam.
EXPONENTS = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (2, 0, 0), (1, 1, 0), (0, 2, 0), (0, 0, 1), (1, 0, 1), (0, 1, 1),
                      (0, 0, 2)])  # fmt: skip
UPSAMPLING = {"cpu": 6, "gpu": 10}  # bins of profiles per range cell: the spline errs by -69 and -82 dB
SERIES_ERROR = 1e-9  # m
SQUARE = 4  # pixels, of whose ranges those of a group are as close together as can be
MOST_CYCLES = 256.0  # from the middle of a group, of which float32 has enough of the phase: 1e-4 rad
SMALL = 4096  # pixels of a tile that is not divided
NEAREST = 1.0  # m: nearer antennas are left to the square root


@dataclass(frozen=True, kw_only=True, eq=False)
class Sights:
    """View of the ground from a block of pulses, and its range profiles.

    Attributes
    ----------
    start : int
        The first pulse, or row, of the block.
    values : (n, n_bin) complex64
        Spline coefficients of the range profiles.
    middle : int
        Bin of the reference range.
    bins_per_metre, cycles_per_metre : float
        How fast bins and phases go by with range.
    antenna : (n, 3) float
        x, y and z, m.
    receiver : (n, 3) float or None
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

    def of(self, pulses: slice, values: ComplexArray) -> Sights:
        """The view from some of the pulses of the collection, with their profiles (n, n_bin)."""
        return replace(
            self, start=self.start + pulses.start, values=values, antenna=self.antenna[pulses],
            reference_range=self.reference_range[pulses], taper=self.taper and self.taper.of(pulses),
            receiver=None if self.receiver is None else self.receiver[pulses],
        )  # fmt: skip


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
    tiles: Tiles,
) -> None:
    """Add the pulses of a block to the pixels of tiles of the image that they light, in place.

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
    tiles : Tiles
    """
    if not tiles.rows.size:
        return
    if sights.receiver is not None:
        _project_bistatic(image, outside, sights, sights.receiver, pixels, tiles)
        return
    count, n_bin = tiles.rows[:, 1] - tiles.rows[:, 0], sights.values.shape[1]
    # The tables of a tile go on by FEW pulses, of which nothing is used.
    at = np.cumsum(count + FEW) - count - FEW
    tile = np.repeat(np.arange(count.size), count + FEW)
    pulses = np.arange(tile.size) - at[tile] + (tiles.rows[:, 0] - sights.start)[tile]
    pulses = np.minimum(pulses, (tiles.rows[:, 1] - 1 - sights.start)[tile])
    series, roots = pulse_tables(sights, pulses, tile, tiles.low, tiles.high)
    places, precise = place_tables(sights.taper, pulses, tile, tiles.low, tiles.high)
    held, precise = (np.logical_and.reduceat(each, at) for each in (series[0] > 0, precise))
    divided = (~held & (tiles.pixels > SMALL)) | (~precise & (tiles.pixels > 1))
    if divided.any():
        parts = [part for tile in tiles.some(divided).slices() for part in halves(tile)]
        block = sights.start, sights.start + sights.reference_range.size
        for some in (tiles.some(~divided), Tiles.of(pixels, parts, block)):
            project(image, outside, sights, pixels, weight, some)
        return
    terms = np.zeros(0, np.float32) if sights.taper is None else sights.taper.terms.astype(np.float32)
    frequency = 0.0 if sights.taper is None else sights.taper.frequency
    add_pulses(
        # A sample is loaded as one number of 64 bits, so that vectors of samples are transposed whole.
        image, outside, weight, sights.values.reshape(-1).view(np.float64), SQUARE, *pixels, tiles.windows, tiles.rows,
        at, tiles.low, tiles.high, pulses * n_bin + sights.middle, series, roots, sights.cycles_per_metre,
        sights.bins_per_metre, sights.half_window, MOST_CYCLES, places, terms, frequency / 2,
    )  # fmt: skip


def _project_bistatic(
    image: ComplexArray, outside: BoolArray, sights: Sights, receiver: FloatArray, pixels: LitPixels, tiles: Tiles
) -> None:
    """Add pulses of two antennas to the pixels of tiles; pixels go in groups of FEW, the last of which is repeated."""
    n_bin, samples = sights.values.shape[1], sights.values.reshape(-1).view(np.float64)
    antennas = np.column_stack([sights.antenna, receiver, sights.reference_range])
    for window, (begin, end) in zip(tiles.slices(), tiles.rows.tolist(), strict=True):
        x, y, z, first, last = (axis.ravel() for axis in pixels.of(window))
        chosen = np.minimum(np.arange(-(-x.size // FEW) * FEW), x.size - 1)
        place = [np.ascontiguousarray(axis[chosen], np.float64) for axis in (x, y, z)]
        lit = [np.clip(axis[chosen], begin, end).astype(np.int32) for axis in (first, last)]
        spans = np.column_stack([lit[0].reshape(-1, FEW).min(axis=1), lit[1].reshape(-1, FEW).max(axis=1)])
        rows = slice(begin - sights.start, end - sights.start)
        sums, farthest = np.zeros((2, chosen.size), np.float32), np.zeros(chosen.size)
        add_bistatic_pulses(
            *sums, farthest, samples, np.arange(rows.start, rows.stop) * n_bin + sights.middle, *place, *lit,
            spans.astype(np.int64), begin, np.ascontiguousarray(antennas[rows]), sights.cycles_per_metre,
            sights.bins_per_metre, sights.half_window,
        )  # fmt: skip
        shape = image[window].shape
        image[window] += (sums[0] + 1j * sums[1])[: x.size].reshape(shape).astype(np.complex64)
        outside[window] |= (farthest > sights.half_window)[: x.size].reshape(shape)


def halves(tile: tuple[slice, slice]) -> list[tuple[slice, slice]]:
    """A tile's halves along its longer side."""
    rows, columns = tile
    if rows.stop - rows.start > columns.stop - columns.start:
        middle = (rows.start + rows.stop) // 2
        return [(slice(rows.start, middle), columns), (slice(middle, rows.stop), columns)]
    middle = (columns.start + columns.stop) // 2
    return [(rows, slice(columns.start, middle)), (rows, slice(middle, columns.stop))]


def pulse_tables(
    sights: Sights, pulses: IntArray, tile: IntArray, low: FloatArray, high: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """For each of the pulses (n,), what the series needs, first whether it may be used; and what the square root needs.

    Each is seen from the centre of one of the tiles from `low` to `high` (n_tile, 3), m. The last of each table is for
    pixels that lie over or under the centre. Of the first, (8, n), each row is of one kind; the second is (n, 5).
    """
    centre, reach = (low + high) / 2, np.sqrt(np.square(high - low).sum(axis=1))[tile] / 2
    x, y, up = centre.T[:, tile] - sights.antenna[pulses].T
    over, reference = up**2, sights.reference_range[pulses]
    distance = np.maximum(np.sqrt(x**2 + y**2 + over), NEAREST)
    away, per_metre = distance - reference, sights.cycles_per_metre
    cycles, scale = per_metre * away, per_metre / distance
    precise = (series_error(reach, distance) < SERIES_ERROR) & (distance > NEAREST)
    inside = (np.abs(away) + 2 * reach < sights.half_window) & (2 * reach * per_metre < FIXED_RANGE / 2)
    series = np.stack([
        precise & inside, scale * x, scale * y, scale / 2, 0.5 / (distance * per_metre),
        cycles - np.rint(cycles) + FIXED_POINT, away * sights.bins_per_metre + (FIXED_POINT + 0.5), scale * up,
    ])  # fmt: skip
    return series, np.stack([x, y, over, reference, up], axis=1)
