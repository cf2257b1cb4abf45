"""Edges of dwells, summed pulse by pulse: what a chain fades out at the ends of dwells is back-projected.

The ends of a dwell are where a chain and back-projection differ most. Back-projection ends it at a whole pulse, which
no smooth window does, and the keystone moves the ends over the band, by +-(t - m) B / (2 fc). Both change the image by
pulses at the very ends only. So the sum over the dwell is divided:

    sum w(v) y = sum w(v) s(v) y  +  sum w(v) (1 - s(v)) y,
    s = sin^2(pi n (1 - |v|) / 2) for 1 - |v| < 1 / n, else 1,

with v = 2 offset / beam_width from -1 to 1 and y the echo of a pulse at the pixel's range, its phase removed. The
chain's dwell gate makes the first sum, whose ends fade out: s is smooth over several pulses, and a moved end changes
little. The second one has a few pulses at either end, and is exact. The number n = `fade` is planned
(`planning.edges`); without it chains sum whole dwells.

Under a beam that wobbles, the chain's gate follows a steadier one. Pulses of the true dwell that its dwell lacks are
added besides, and those that it has too many are taken out, both back-projected.

Under a beam that stays on its ground, as in a spotlight, most of it is lit by all pulses, and dwells end at no smooth
function of range and Doppler that a gate could follow. Chains then sum all pulses (`planning.staying`), and those that
do not light a pixel, near the edge of what the beam lights, are back-projected and taken out again (`take_unlit`); or
those that do, where they are fewer.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

import numpy as np

from blocksar.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from blocksar.collection.beam import beam_offset, inner_interval, lit_passes
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import Taper, Weighting
from blocksar.constants import MIB
from blocksar.focusing.backprojection import ReadPulses, accumulate, image_memory, lit_pulses
from blocksar.focusing.pattern_sums import add_gains
from blocksar.focusing.profiles import UPSAMPLING, Profiles, profile_axis, profile_bins, range_profiles

Cells = TypeVar("Cells", BoolArray, FloatArray)

CELL = 16  # pixels along a side, that are looked at together
OFFSET_NODES = 65  # pulses at which a beam that stays is compared with the ground
OFFSET_ROOM = 1e-3  # of half a beam, by which offsets may differ between them
EDGE_UPSAMPLING = 3  # bins per range cell of edges that fade, few pulses of many: the spline's error is -51 dB of them
TOGETHER = 32  # pulses whose profiles are formed together
KEPT_BYTES = 64 * MIB  # of profiles that are kept: the pulses at both edges of a chunk of the image
BAND = 128  # rows of pixels together whose dwells are compared with those of a wobbling beam
SHORT = 0.25  # of the longest dwell: those below, of a wobbling beam, have no smooth sums of weights
EDGE_STEP = 16  # pixels between those of which the length of an edge is found
EDGE_ROOM = 2  # pulses by which edges may be longer between them


class KeptProfiles:
    """Range profiles of a collection's pulses, of which those used last are kept: neighbouring pixels need the same.

    Parameters
    ----------
    read : callable
        Returns the samples (n, n_range_frequency) complex64 of a slice of pulses; NaN samples are missing.
    collection : Collection
    taper : Taper
        Weighting along range frequency.
    upsampling : int
        Bins per range cell.
    threads : int
        The result does not depend on it.
    """

    def __init__(
        self, read: ReadPulses, collection: Collection, taper: Taper, *, upsampling: int = UPSAMPLING, threads: int = 1
    ) -> None:
        self._read, self._collection, self._taper, self._threads = read, collection, taper, threads
        self._upsampling = upsampling
        self._n_kept = kept_pulses(collection, upsampling) // TOGETHER
        self._values = np.empty((self._n_kept * TOGETHER, profile_bins(collection, upsampling)), np.complex64)
        self._valid = np.zeros(collection.n_pulse)
        self._kept: OrderedDict[int, int] = OrderedDict()  # groups of pulses, and where they are, by last use

    def of(self, wanted: BoolArray) -> Iterator[Profiles]:
        """Profiles of consecutive pulses that hold all that are `wanted` (n_pulse,), as many as are kept at once."""
        some = np.flatnonzero(wanted)
        while some.size:
            first = int(some[0])
            end = first - first % TOGETHER + self._n_kept * TOGETHER
            inside = some[some < end]
            yield self._profiles(slice(first, int(inside[-1]) + 1))
            some = some[inside.size :]

    def _profiles(self, pulses: slice) -> Profiles:
        groups = range(pulses.start // TOGETHER, -(-pulses.stop // TOGETHER))
        for group in groups:
            if group in self._kept:
                self._kept.move_to_end(group)
        for group in groups:
            if group not in self._kept:
                self._form(group)
        numbers = np.arange(pulses.start, pulses.stop)
        first = np.array([self._kept[group] for group in groups]) * TOGETHER
        centre, spacing = profile_axis(self._collection, self._upsampling)
        return Profiles(
            values=self._values, rows=first[numbers // TOGETHER - groups[0]] + numbers % TOGETHER, pulses=pulses,
            valid=self._valid[pulses], centre=centre, spacing=spacing,
        )  # fmt: skip

    def _form(self, group: int) -> None:
        """Form the profiles of a group of pulses in place of those that were not used for longest."""
        place = len(self._kept) if len(self._kept) < self._n_kept else self._kept.popitem(last=False)[1]
        pulses = slice(group * TOGETHER, min((group + 1) * TOGETHER, self._collection.n_pulse))
        formed = range_profiles(
            self._read(pulses), collection=self._collection, pulses=pulses, threads=self._threads, taper=self._taper,
            upsampling=self._upsampling,
        )  # fmt: skip
        rows = slice(place * TOGETHER, place * TOGETHER + formed.values.shape[0])
        self._values[rows], self._valid[pulses] = formed.values, formed.valid
        self._kept[group] = place


def edge_profiles(
    read: ReadPulses, collection: Collection, weighting: Weighting, *, fade: int, threads: int = 1
) -> KeptProfiles:
    """Those that `add_edges` and, where `fade` is 0, `take_unlit` need."""
    upsampling = EDGE_UPSAMPLING if fade else UPSAMPLING
    return KeptProfiles(read, collection, weighting.range, upsampling=upsampling, threads=threads)


def add_edges(
    image: ComplexArray,
    profiles: KeptProfiles,
    geometry: Geometry,
    *,
    x: FloatArray,
    y: FloatArray,
    lit: FloatArray,
    valid: FloatArray,
    fade: int,
    weighting: Weighting,
    height: FloatArray | None = None,
    threads: int = 1,
    wobbling: Geometry | None = None,
) -> None:
    """Add to an image, in place, the part of each dwell that the chain's gate fades out.

    With its edges a dwell has whole pulses. Where all have equal weights it is divided by their number, as `lit` may
    count parts of pulses.

    Parameters
    ----------
    image : (n_y, n_x) complex64
        From the chain, divided by `lit`; NaN where it owns no pixel.
    profiles : KeptProfiles
        From `edge_profiles`.
    geometry : Geometry
        With a steered beam.
    x, y : (n_x,), (n_y,) float
        m, scene frame.
    lit : (n_y, n_x) float
        Sum of the weights w, times the antenna's pattern, over each pixel's lit valid pulses: the image's denominator.
    valid : (n_pulse,) float
        The fraction of each pulse's samples that is there.
    fade : int
        n, positive.
    weighting : Weighting
    height : (n_y, n_x) float, optional
        z of the pixels, m; NaN where it is unknown, and the image as well. None: they lie on the plane.
    threads : int
        The result does not depend on it.
    wobbling : Geometry, optional
        With the true beam, where that of `geometry` is a steadier one (`planning.steadiness`).
    """
    owned = np.isfinite(image.real) & (lit > 0)
    rows, columns = (np.flatnonzero(owned.any(axis=axis)) for axis in (1, 0))
    if not rows.size:
        return
    part = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    image, lit, owned = image[part], lit[part], owned[part]
    mesh_x, mesh_y = np.meshgrid(np.asarray(x, np.float64)[part[1]], np.asarray(y, np.float64)[part[0]])
    z = None if height is None else np.where(owned, height[part], geometry.collection.ground_height)
    edges = _edges(geometry, mesh_x, mesh_y, z, owned, fade)
    total = _sum_edges(profiles, geometry, mesh_x, mesh_y, edges, weighting, z=z, threads=threads, fade=fade)
    (first, _), (_, last) = edges
    before = np.concatenate([[0.0], np.cumsum(valid)])
    whole = before[last] - before[first]
    if wobbling is not None:
        for band in (slice(k, k + BAND) for k in range(0, owned.shape[0], BAND)):
            of_band = _departures(
                profiles, geometry, wobbling, mesh_x[band], mesh_y[band], None if z is None else z[band], owned[band],
                weighting, gated=(first[band], last[band]), before=before, threads=threads,
            )  # fmt: skip
            total[band] += of_band[0]
            whole[band] += of_band[1]
    dark, summed = whole <= 0, lit
    if weighting.azimuth.uniform and not geometry.collection.has_pattern:
        summed = np.where(dark, lit, whole)
    elif wobbling is not None:
        short = owned & ~dark & (whole < SHORT * float((last - first).max()))
        summed = lit.copy()
        of_short = None if z is None else z[short]
        passes = lit_passes(wobbling, mesh_x[short], mesh_y[short], of_short)
        summed[short] = _sum_weights(wobbling, mesh_x[short], mesh_y[short], of_short, passes, valid, weighting)
        summed = np.where(summed > 0, summed, lit)
    if summed is not lit:
        image *= np.where(owned, lit / np.where(owned, summed, 1.0), 1.0).astype(np.float32)
        lit = summed
    image += total / np.where(owned, lit, 1.0).astype(np.float32)
    if wobbling is not None:
        image[owned & dark] = complex(np.nan, np.nan)


def _sum_weights(
    geometry: Geometry, x: FloatArray, y: FloatArray, z: FloatArray | None, passes: tuple[IntArray, IntArray],
    valid: FloatArray, weighting: Weighting,
) -> FloatArray:  # fmt: skip
    """Sum of weights times the antenna's pattern over the valid pulses of passes (n_pass, n), pulse by pulse."""
    total, over = np.zeros((1, x.size)), None if z is None else (z - geometry.collection.ground_height)[None]
    for first, last in zip(*passes, strict=True):
        add_gains(
            total, geometry, x[None], y[None], over, first=first[None], last=last[None],
            pulses=slice(0, geometry.collection.n_pulse), valid=valid, taper=weighting.azimuth,
        )  # fmt: skip
    return total[0]


def _departures(
    profiles: KeptProfiles, geometry: Geometry, wobbling: Geometry, x: FloatArray, y: FloatArray, z: FloatArray | None,
    owned: BoolArray, weighting: Weighting, *, gated: tuple[IntArray, IntArray], before: FloatArray, threads: int,
) -> tuple[ComplexArray, FloatArray]:  # fmt: skip
    """Sum over the pulses that light pixels but are not `gated`, less those the other way round; and their number.

    `before` (n_pulse + 1,) has the number of valid pulses before each.
    """
    passes = lit_passes(wobbling, x, y, z)
    total, number = np.zeros(x.shape, np.complex64), np.zeros(x.shape)
    first, last = gated
    for sign, lighting, found in ((1, wobbling, _beyond(*passes, first, last)), (-1, geometry, _gaps(*passes, *gated))):
        for begin, end in found:
            stop = np.where(owned, np.maximum(begin, end), begin)
            some = [(begin, stop)]
            total += sign * _sum_edges(profiles, lighting, x, y, some, weighting, z=z, threads=threads)
            number += sign * (before[stop] - before[begin])
    return total, number


def _beyond(firsts: IntArray, lasts: IntArray, first: IntArray, last: IntArray) -> Iterator[tuple[IntArray, IntArray]]:
    """Begins and ends of what passes (n_pass, ...) have before a first pulse, and from a last one on."""
    for begin, end in zip(firsts, lasts, strict=True):
        yield begin, np.minimum(end, first)
        yield np.minimum(np.maximum(begin, last), end), end


def _gaps(firsts: IntArray, lasts: IntArray, first: IntArray, last: IntArray) -> Iterator[tuple[IntArray, IntArray]]:
    """Begins and ends of what lies from a first pulse up to a last one, and in none of the passes (n_pass, ...)."""
    for number in range(len(firsts) + 1):
        begin = first if number == 0 else np.clip(lasts[number - 1], first, last)
        yield begin, last if number == len(firsts) else np.minimum(firsts[number], last)


def take_unlit(
    image: ComplexArray,
    profiles: KeptProfiles,
    geometry: Geometry,
    *,
    x: FloatArray,
    y: FloatArray,
    total: Callable[[FloatArray, FloatArray, FloatArray | None], FloatArray],
    valid: FloatArray,
    weighting: Weighting,
    height: FloatArray | None = None,
    threads: int = 1,
) -> None:
    """Take out of an image, in place, the pulses that do not light each pixel, under a beam that stays on its ground.

    A chain sums all pulses then. Pixels that all of them light stay as they are, those that none does become NaN. Those
    that less than half of them light are back-projected from these.

    Parameters
    ----------
    image : (n_y, n_x) complex64
        From the chain, divided by `total`; NaN where it owns no pixel.
    profiles : KeptProfiles
        From `edge_profiles`.
    geometry : Geometry
        With a beam about its axis.
    x, y : (n_x,), (n_y,) float
        m, scene frame.
    total : callable
        Of points x, y (n,), m, and their z or None: sum of the weights w, times the antenna's pattern, over all valid
        pulses.
    valid : (n_pulse,) float
        The fraction of each pulse's samples that is there.
    weighting : Weighting
    height : (n_y, n_x) float, optional
        As in `add_edges`.
    threads : int
        The result does not depend on it.
    """
    n = geometry.collection.n_pulse
    z = None if height is None else np.where(np.isfinite(height), height, geometry.collection.ground_height)
    doubtful = _find_doubtful(geometry, x, y, z) & np.isfinite(image.real)
    rows, columns = (np.flatnonzero(doubtful.any(axis=axis)) for axis in (1, 0))
    if not rows.size:
        return
    part = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    image, doubtful = image[part], doubtful[part]
    mesh_x, mesh_y = np.meshgrid(np.asarray(x, np.float64)[part[1]], np.asarray(y, np.float64)[part[0]])
    z = None if z is None else z[part]
    some = lit_passes(geometry, mesh_x[doubtful], mesh_y[doubtful], None if z is None else z[doubtful])
    first, last = np.zeros((len(some[0]), *image.shape), np.int64), np.full((len(some[0]), *image.shape), n, np.int64)
    first[1:] = n
    first[:, doubtful], last[:, doubtful] = some
    number = (last - first).sum(axis=0)  # of lit pulses
    cut = number < n
    if not cut.any():
        return
    few = 2 * number < n  # summed by themselves: fewer pulses, and not a small rest of a large sum
    end = np.full((1, *image.shape), n)
    own = np.append(first, end, axis=0), np.append(last, end, axis=0)
    others = np.append(0 * end, last, axis=0), np.append(first, end, axis=0)  # before, between and after the passes
    edges = list(zip(*(np.where(few, *ends) for ends in zip(own, others, strict=True)), strict=True))
    summed = _sum_edges(profiles, geometry, mesh_x, mesh_y, edges, weighting, z=z, threads=threads)
    at_x, at_y, of_cut = mesh_x[cut], mesh_y[cut], None if z is None else z[cut]
    lit = _sum_weights(geometry, at_x, at_y, of_cut, (first[:, cut], last[:, cut]), valid, weighting)
    kept = np.where(few[cut], summed[cut], image[cut] * total(at_x, at_y, of_cut) - summed[cut])
    image[cut] = np.where(lit > 0, kept / np.where(lit > 0, lit, 1.0), complex(np.nan, np.nan))


def _sum_edges(
    kept: KeptProfiles,
    geometry: Geometry,
    x: FloatArray,
    y: FloatArray,
    edges: Sequence[tuple[IntArray, IntArray]],
    weighting: Weighting,
    *,
    threads: int,
    z: FloatArray | None = None,
    fade: int = 0,
) -> ComplexArray:
    """Sum over the pulses from `first` to `last` of all edges of each pixel at x, y, z (n_y, n_x), m; not divided."""
    height = None if z is None else z - geometry.collection.ground_height
    total = np.zeros(x.shape, np.complex64)
    weight = np.zeros(x.shape, np.float32)
    outside = np.zeros(x.shape, np.bool_)
    for first, last in edges:
        for profiles in kept.of(lit_pulses(first, last, geometry.collection.n_pulse)):
            accumulate(
                total, outside, profiles, geometry=geometry, x=x, y=y, first=first, last=last, threads=threads,
                taper=weighting.azimuth, weight=weight, height=height, fade=fade,
            )  # fmt: skip
    return total


def _find_doubtful(geometry: Geometry, x: FloatArray, y: FloatArray, z: FloatArray | None) -> BoolArray:
    """Which pixels (n_y, n_x) some pulse may not light, under a beam about its axis.

    Whole cells of pixels are lit all the time where their middle lies so far inside the beam that none can leave it: a
    point moves by less than its distance over the range.
    """
    collection = geometry.collection
    middles, reach = [], 0.0
    for axis in (x, y):
        firsts = axis[::CELL]
        lasts = axis[np.minimum(np.arange(0, axis.size, CELL) + CELL, axis.size) - 1]
        middles.append((firsts + lasts) / 2)
        reach = math.hypot(reach, float((lasts - firsts).max()) / 2)
    mesh_x, mesh_y = np.meshgrid(*middles)
    level: FloatArray | float = collection.ground_height
    if z is not None:
        level = z[np.ix_(*(np.minimum(np.arange(0, n, CELL) + CELL // 2, n - 1) for n in z.shape))]
        reach = math.hypot(reach, float(np.abs(z - _over_cells(level, z.shape)).max()))
    farthest, nearest = np.zeros(mesh_x.shape), math.inf
    for pulse in np.unique(np.linspace(0, collection.n_pulse - 1, OFFSET_NODES).round().astype(np.int64)).tolist():
        np.maximum(farthest, np.abs(beam_offset(geometry, mesh_x, mesh_y, pulse, level)), out=farthest)
        px, py, pz = collection.antenna_position[pulse]
        nearest = min(nearest, math.sqrt(float(((mesh_x - px) ** 2 + (mesh_y - py) ** 2 + (level - pz) ** 2).min())))
    half, moves = (collection.beam_width or 0.0) / 2, reach / max(nearest - reach, reach)
    cells = farthest >= half * (1 - OFFSET_ROOM) - moves
    return _over_cells(cells, (y.size, x.size))


def _over_cells(values: Cells, shape: tuple[int, ...]) -> Cells:
    """Values of cells at each of their pixels, (n_y, n_x)."""
    return np.repeat(np.repeat(values, CELL, axis=0), CELL, axis=1)[: shape[0], : shape[1]]


def kept_pulses(collection: Collection, upsampling: int) -> int:
    """Pulses whose profiles are kept: whole groups of TOGETHER, two at least, and no more than there are."""
    most = KEPT_BYTES // (8 * profile_bins(collection, upsampling) * TOGETHER)
    return min(max(most, 2), math.ceil(collection.n_pulse / TOGETHER)) * TOGETHER


def edge_memory(n_pixels: int, collection: Collection, *, threads: int = 1) -> int:
    """Upper bound of the memory to add edges to an image of n_pixels, bytes, without the image."""
    kept = max(8 * kept_pulses(collection, n) * profile_bins(collection, n) for n in (UPSAMPLING, EDGE_UPSAMPLING))
    forming = image_memory(n_pixels, collection, threads=threads, pulse_block=TOGETHER)
    finding = 8 * 16 * n_pixels  # lit pulses; those of wobbling beams in bands
    return forming + kept + finding


def _edges(
    geometry: Geometry, x: FloatArray, y: FloatArray, z: FloatArray | None, owned: BoolArray, fade: int
) -> tuple[tuple[IntArray, IntArray], tuple[IntArray, IntArray]]:
    """Pulses first <= p < last that hold the two edges of each pixel's dwell; none for pixels that are not owned.

    They may hold pulses between the edges, whose weight is 0, but none twice: a dwell that the collection's end cuts
    short may lie within one edge.
    """
    first, last = inner_interval(geometry, x, y, 1.0, z)
    at = np.ix_(*(np.unique(np.append(np.arange(0, n, EDGE_STEP), n - 1)) for n in x.shape))
    inner_first, inner_last = inner_interval(geometry, x[at], y[at], 1 - 1 / fade, None if z is None else z[at])
    lengths = np.maximum(inner_first - first[at], last[at] - inner_last)
    lengths = np.where(inner_first < inner_last, lengths, last[at] - first[at])
    length, middle = int(lengths.max()) + EDGE_ROOM, (first + last) // 2
    begin, end = np.minimum(first + length, middle), np.maximum(last - length, middle)
    return (first, np.where(owned, begin, first)), (np.where(owned, end, last), last)
