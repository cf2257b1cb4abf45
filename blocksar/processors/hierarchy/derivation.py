"""Hierarchical back-projection: small parts of the image from data decimated to their bandwidth.

With c the centre of a part and R_c(p) its exact range at pulse p, the phase history referred to c is

    d_c(p, f) = S(p, f) exp(+4j pi (fc + f) / c0 (R_c(p) - reference_range(p)))

and the image at a point x of the part is

    image(x) = sum_p sum_f w(x, p) W(f) d_c(p, f) K_x(p, f),   K_x(p, f) = exp(+4j pi (fc + f) / c0 (R_x(p) - R_c(p))).

K_x is smooth. Along f it is a delay of 2 |R_x - R_c| / c0 <= 2 e_r / c0, and along p its Doppler is
2 (fc + f) / c0 |d/dt (R_x - R_c)| <= e_d, where e_r and e_d are the largest over the part; beyond e_d the spectrum of
K_x falls as an Airy function does (`airy_reach`). So the sum is the same after
a low-pass filter over d_c that passes such delays and Dopplers: what the filter takes away is orthogonal to K_x. What
is left can be decimated, and a sum over the decimated samples is the same sum, as long as nothing of the product's
spectrum folds onto zero: a filter for decimation by D that passes e / D stops (1 - e) / D (`kernels.decimation`).

The part is then divided; each child refers the decimated data to its own centre and decimates again, and so on. The
last parts, of some dozen pixels, are back-projected from what is left, some dozen pulses, by the loop of exact
back-projection (`kernels.projection`): N^2 log N operations. Nothing is expanded about a mean track or a centre
frequency, and nothing is interpolated but the last range profiles. Wobble of the track is common to x and c; only its
difference counts.

Pulses may be cut off, missing (zero) or weighted before the filter, as long as its tails are kept. Of a part, the
*interior* pulses light all of it, the *edge* pulses some of it. The interior goes down the hierarchy decimated in both
directions, edges in range frequency only. Going down, edge pulses that light all of a child are filtered to the child's
interior grid and added there: all is linear. In the last parts each pixel takes its own edge pulses, at their full
rate, so that dwells end exactly where they do in exact back-projection (`Beam.passes`). A taper over the
beam is a weight in the last sum, whose own bandwidth is added to e_d.

Errors are those of the filters, `Levels.attenuation` below all that the data hold, and of the interpolation of the last
range profiles (`profiles.spline_error`).

References
----------
McCorkle, Rofheart, "An order N^2 log(N) backprojector algorithm for focusing wide-angle wide-bandwidth arbitrary-motion
synthetic aperture radar", SPIE 2747, 1996.
Oh, McClellan, "Multi-resolution mixed-radix quadtree SAR image focusing algorithms", 2001: errors of quadtrees.
Basu, Bresler, "O(N^2 log2 N) filtered backprojection reconstruction algorithm for tomography", IEEE Trans. Image
Processing 9(10), 2000.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise, product
from typing import NamedTuple

import numpy as np

from blocksar.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from blocksar.collection.geometry import Geometry
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.kernels.decimation import Decimation, padded
from blocksar.kernels.device import CPU, Device
from blocksar.kernels.fourier import fast_length
from blocksar.kernels.groups import Scratch, run_groups
from blocksar.kernels.parts import find_light, find_rows

BORDER = np.array([(x, y, z) for z in (0, 2) for x, y in product((0, 1, 2), repeat=2)])  # of a box: see `Part.border`
BEND_NODES = 256  # pulses at which it is found how Doppler bends over a dwell


class Path:
    """Antenna positions, continued beyond both ends by their mirror image: the tails of filters lie there.

    Mirrored through its end point, a track goes on with the same velocity. Ranges follow the positions as they are,
    bounds the smooth track.

    Parameters
    ----------
    geometry : Geometry

    Attributes
    ----------
    beyond : int
        Pulses by which the track is continued at either end.
    noise : float
        Root mean square of what positions have besides the smooth track, m.
    speed : float
        Largest way of the antenna per pulse, m.
    """

    def __init__(self, geometry: Geometry) -> None:
        collection, track = geometry.collection, geometry.track
        self.beyond = collection.n_pulse - 1
        self._position, self._smooth = (
            np.pad(positions, ((self.beyond, self.beyond), (0, 0)), mode="reflect", reflect_type="odd")
            for positions in (collection.antenna_position, track.position(collection.time))
        )
        self._velocity = np.gradient(self._smooth, axis=0)
        self.noise = float(np.sqrt(np.mean(track.misfit**2)))
        self.speed = float(np.linalg.norm(self._velocity, axis=1).max())

    def _index(self, pulses: IntArray) -> IntArray:
        """Index of pulses in the extended track, clipped at its ends."""
        return np.clip(pulses + self.beyond, 0, self._position.shape[0] - 1)

    @property
    def positions(self) -> tuple[FloatArray, int]:
        """All positions (n, 3), m, and how many of them precede pulse 0."""
        return self._position, self.beyond

    def at(self, pulses: IntArray) -> FloatArray:
        """Positions (n, 3) at pulses (n,), m."""
        return self._position[self._index(pulses)]

    def ranges(self, pulses: IntArray, points: FloatArray) -> FloatArray:
        """Ranges (n,) of points (n, 3) or (3,) at pulses (n,), m."""
        x, y, z = (self.at(pulses) - points).T
        return np.asarray(np.sqrt(x * x + y * y + z * z))

    def reach(self, pulses: IntArray, parts: Parts) -> tuple[float, float, FloatArray]:
        """How far parts (n) reach, each seen at pulses (n, m).

        Returns
        -------
        away : float
            Largest |R_x - R_c| of points x of their borders, m.
        fastest : float
            Its largest change from a pulse to the next, m.
        change : (n, m, k) float
            That of each point of a border.
        """
        kept = self._index(pulses)
        points = np.concatenate([parts.centre[:, None], parts.border], axis=1)
        sight = self._smooth[kept][:, :, None] - points[:, None]
        distance = np.sqrt(np.einsum("...i,...i", sight, sight))
        rate = np.einsum("...ki,...i->...k", sight, self._velocity[kept]) / distance
        change = rate[..., 1:] - rate[..., :1]
        away = np.abs(distance[..., 1:] - distance[..., :1]).max(initial=0)
        return float(away), float(np.abs(change).max(initial=0)), change

    def bend(self, part: Parts) -> float:
        """Largest second derivative of the change over the largest change of a part, per pulse^2."""
        low, high = part.some[0].tolist()
        step = max((high - low) // BEND_NODES, 1)
        _, fastest, change = self.reach(np.arange(low, high + 1, step)[None], part)
        if change.shape[1] < 3:
            return 0.0
        return float(np.abs(np.diff(change, 2, axis=1)).max() / step**2 / fastest)


@dataclass(frozen=True, kw_only=True, eq=False)
class Parts:
    """Parts (n) of the image, as frames are planned by them: each is a box, and what lights it.

    Attributes
    ----------
    low, high : (n, 3) float
        Their ends, m, scene frame.
    some : (n, 2) int
        Pulses begin <= p < end of one pass of the beam that light some of a part; equal where there are none.
    whole : (n, 2) int
        Pulses first <= p < last that light all of it that is lit at all; the end of `some` where there are none.
    windows : (n, 4) int
        Rows from the first to before the second, columns from the third to before the fourth.
    parent : (n,) int
        The part of which each is one, by its number.
    """

    low: FloatArray
    high: FloatArray
    some: IntArray
    whole: IntArray
    windows: IntArray
    parent: IntArray

    @staticmethod
    def joined(parts: Sequence[Parts]) -> Parts:
        """The one that holds all of some, of which any is lit."""
        low, high, some, whole, windows = (
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("low", "high", "some", "whole", "windows")
        )
        lit = some[:, 0] < some[:, 1]
        if not lit.any():
            lit[:] = True
        span = np.array([[some[lit, 0].min(), some[lit, 1].max()]])
        first, last = whole[lit, 0].max(), whole[lit, 1].min()
        return Parts(
            low=low.min(axis=0)[None], high=high.max(axis=0)[None], some=span, windows=windows[:1],
            whole=np.array([[first, last]]) if first < last else span[:, [1, 1]], parent=np.zeros(1, np.int64),
        )  # fmt: skip

    def some_of(self, chosen: BoolArray) -> Parts:
        """Some of them."""
        return Parts(**{name: values[chosen] for name, values in vars(self).items()})

    @property
    def centre(self) -> FloatArray:
        """The middles (n, 3) of the boxes, m."""
        return (self.low + self.high) / 2

    @property
    def border(self) -> FloatArray:
        """Corners of the boxes and the middles between them, (n, k, 3) m: what is farthest from the centre.

        Close by, the nearest point of a side is not one of its ends.
        """
        nodes = BORDER if (self.low[:, 2] < self.high[:, 2]).any() else BORDER[:9]  # of level parts half is all
        return self.low[:, None] + (self.high - self.low)[:, None] * (nodes / 2)


@dataclass(frozen=True, kw_only=True, eq=False)
class Part:
    """Pixels, and the pulses first <= p < last of one pass of the beam that light them.

    Attributes
    ----------
    x, y : (n_column,), (n_row,) float
        m, scene frame.
    z : (n_row, n_column) float
        m
    first, last : (n_row, n_column) int
    """

    x: FloatArray
    y: FloatArray
    z: FloatArray
    first: IntArray
    last: IntArray

    def within(self, window: tuple[slice, slice]) -> Part:
        """The part of some rows and columns."""
        rows, columns = window
        ends = {"first": self.first[window], "last": self.last[window]}
        return Part(x=self.x[columns], y=self.y[rows], z=self.z[window], **ends)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.y.size, self.x.size

    @property
    def side(self) -> float:
        """The longer side, m."""
        return float(max(abs(self.x[-1] - self.x[0]), abs(self.y[-1] - self.y[0])))

    @cached_property
    def whole(self) -> Parts:
        """As one of `Parts`; lit or not."""
        return self.levels([])[0]

    def lit(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Pulses begin <= p < end that light some of it, and first <= p < last that light all that is lit; or none."""
        (begin, end), (first, last) = self.whole.some[0].tolist(), self.whole.whole[0].tolist()
        return (begin, end), (first, last)

    def levels(self, sides: Sequence[float]) -> list[Parts]:
        """All of it, lit or not, and level by level its lit parts of at most about so many m a side."""
        steps = list(zip(*(_steps(axis, sides) for axis in (self.y, self.x)), strict=True))
        alike = [all(np.array_equal(*each) for each in zip(*two, strict=True)) for two in pairwise(steps)]
        levels: list[Parts] = []
        above, numbers = steps[0], np.zeros((1, 1), np.int64)
        for rows, columns in [steps[0], *(step for step, same in zip(steps[1:], alike, strict=True) if not same)]:
            shape = rows.size - 1, columns.size - 1
            light, heights = np.empty((*shape, 4), np.int64), np.empty((*shape, 2))
            find_light(self.first, self.last, self.z, rows, columns, light, heights)
            kept = (light[..., 1] > 0) | (not levels)
            ends = np.stack(np.broadcast_arrays(rows[:-1, None], rows[1:, None], columns[:-1], columns[1:]), axis=-1)
            windows, light, heights = ends[kept], light[kept], heights[kept]
            x, y = np.sort(self.x[windows[:, 2:] - [0, 1]]), np.sort(self.y[windows[:, :2] - [0, 1]])
            within = (np.searchsorted(each, windows[:, k], "right") - 1 for each, k in zip(above, (0, 2), strict=True))
            parent = numbers[tuple(within)]
            above, numbers = (rows, columns), np.cumsum(kept).reshape(shape) - 1
            low, high = (np.stack([x[:, k], y[:, k], heights[:, k]], axis=1) for k in (0, 1))
            levels.append(
                Parts(low=low, high=high, some=light[:, :2], whole=light[:, 2:], windows=windows, parent=parent)
            )
        return levels

    def divide(self, side: float) -> Iterator[tuple[slice, slice]]:
        """Rows and columns of its parts of at most about `side` m."""
        spans = [[slice(a, b) for a, b in pairwise(_steps(axis, [side])[-1].tolist())] for axis in (self.y, self.x)]
        return ((rows, columns) for rows in spans[0] for columns in spans[1])


def _steps(axis: FloatArray, sides: Sequence[float]) -> list[IntArray]:
    """Ends of all of an axis, and of its parts of at most about so many m, level by level, each a part of one above.

    The parts of one are about as large, and of many pixels whole groups of ALIKE.
    """
    steps = [np.array([0, axis.size])]
    for side in sides:
        ends = [0]
        for a, b in pairwise(steps[-1].tolist()):
            count = min(max(int(np.ceil(abs(axis[b - 1] - axis[a]) / side)), 1), b - a)
            each = a + (b - a) * np.arange(1, count + 1) // count
            if b - a >= 2 * ALIKE * count:
                each[:-1] = (each[:-1] + ALIKE // 2) // ALIKE * ALIKE
            ends += each.tolist()
        steps.append(np.array(ends))
    return steps


ALIKE = 4  # pixels, of which groups are summed
MOST = 1 << 16  # largest factor of a decimation
LOOKS = 24  # pulses at which it is found how far a part reaches
REACHED = 1.02  # times the largest delay and Doppler on a part's border: those of other points of it


@dataclass(frozen=True)
class Levels:
    """Levels of the division into parts, and accuracy of filters and interpolation.

    Attributes
    ----------
    sides : tuple of float
        Largest sides of parts, m, level by level; the last parts are back-projected.
    attenuation : float
        Of the filters, dB.
    edge : float
        e: largest pass edge of a filter, at the new rate; below 1/2.
    upsampling : int
        Bins of the last range profiles per range cell.
    """

    sides: tuple[float, ...]
    attenuation: float
    edge: float
    upsampling: int

    def bins(self, columns: int) -> int:
        """Bins of the last range profiles of so many range frequencies: an even number."""
        return 2 * fast_length(-(-self.upsampling * columns // 2))


@dataclass(frozen=True, kw_only=True, eq=False)
class Frames:
    """Samples that are left of a phase history for parts (n), each referred to the centre of one.

    Rows are those of one part after the other, of each in the order of time: edges before the interior, the interior,
    edges after it. The edges of a part are all pulses that light some of it but those inside, each a row.

    Attributes
    ----------
    centre : (n, 3) float
        m
    some, inside : (n, 2) int
        The pulses first <= p < last that light some of a part, and those that its interior stands for; where it has no
        interior, the end of the former.
    at, size : (n,) int
        The interior: pulses at, at + stride, ..., `size` of them.
    stride : int
    start, step, columns : float, float, int
        Range frequency of the first column, and spacing, Hz.
    bend : float
        How Doppler bends over the dwell, per pulse^2: see `Path.bend`.
    reach : float
        Largest |R_x - R_c| of the parts, m.
    """

    centre: FloatArray
    some: IntArray
    inside: IntArray
    at: IntArray
    size: IntArray
    stride: int
    start: float
    step: float
    columns: int
    bend: float
    reach: float = np.inf

    @cached_property
    def before(self) -> IntArray:
        """Edges (n,) before the interior."""
        return np.asarray(self.inside[:, 0] - self.some[:, 0])

    @cached_property
    def after(self) -> IntArray:
        """Edges (n,) after the interior."""
        return np.asarray(self.some[:, 1] - self.inside[:, 1])

    @cached_property
    def ends(self) -> IntArray:
        """Rows of each part, and where they begin and the last ends: (n + 1,)."""
        return np.concatenate([[0], np.cumsum(self.before + self.size + self.after)])

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return int(self.ends[-1]), self.columns

    @cached_property
    def part(self) -> IntArray:
        """The part of each row."""
        return np.repeat(np.arange(self.at.size), np.diff(self.ends))

    @cached_property
    def pulses(self) -> IntArray:
        """The pulse of each row; of the interior's tails also beyond the collection."""
        k = self.part
        row = np.arange(k.size) - self.ends[k]
        inner, late = row - self.before[k], row - (self.before + self.size)[k]
        early = self.some[k, 0] + row
        return np.where(
            inner < 0, early, np.where(late < 0, self.at[k] + self.stride * inner, self.inside[k, 1] + late)
        )


class Echoes(NamedTuple):
    """The samples (n_row, n_column) complex64 of frames."""

    frames: Frames
    rows: ComplexArray


class Filters(NamedTuple):
    """Filters that lead from the samples of parts to those of parts of these.

    Attributes
    ----------
    across : Decimation
        Along range frequencies.
    single, further : Decimation
        Along pulses: from single ones, and from those of interiors.
    """

    across: Decimation
    single: Decimation
    further: Decimation


def airy_reach(attenuation: float) -> float:
    """Excess s of a smooth phase's spectrum beyond its largest Doppler: exp(-2/3 s^(3/2)) = -attenuation dB.

    About the time at which Doppler is largest, nu(t) = nu_0 - gamma t^2 / 2, and the spectrum of exp(2j pi int nu dt)
    at nu is an Airy function, Ai(2 pi (nu - nu_0) / (pi gamma)^(1/3)), which falls as that exponential.
    """
    return float((1.5 * attenuation * np.log(10) / 20) ** (2 / 3))


class Hierarchy:
    """Decimation of a phase history level by level: frames are planned by `enter` and `descend`, samples follow.

    Parameters
    ----------
    geometry : Geometry
    levels : Levels
    waves : float
        Largest frequency of the weights over a dwell, cycles per dwell.
    path : Path, optional
        Of this geometry.
    device : Device
        Which has the samples.
    """

    def __init__(
        self, geometry: Geometry, levels: Levels, *, waves: float = 0.0, path: Path | None = None, device: Device = CPU
    ) -> None:
        self.device = device
        self.collection, self.levels, self.waves = geometry.collection, levels, waves
        self.path = path or Path(geometry)
        highest = self.collection.carrier + self.collection.range_frequency[-1]
        self._cycles = 2 * highest / SPEED_OF_LIGHT  # per m
        self._airy = airy_reach(levels.attenuation)

    # ---------------------------------------------------------------- frames

    def recorded(self, pulses: tuple[int, int]) -> Frames:
        """The samples of the collection, at pulses begin <= p < end."""
        collection, ends = self.collection, np.array([pulses])
        none = np.zeros(1, np.int64)
        return Frames(
            centre=np.zeros((1, 3)), some=ends, inside=ends[:, [1, 1]], at=none, size=none, stride=1, bend=0.0,
            start=float(collection.range_frequency[0]), step=collection.range_frequency_step,
            columns=collection.n_range_frequency,
        )  # fmt: skip

    def enter(self, part: Parts) -> tuple[Filters, Frames] | None:
        """From the samples of the collection to a part; None if no pulse lights it."""
        begin, end = part.some[0].tolist()
        if begin == end:
            return None
        return self.descend(replace(self.recorded((begin, end)), bend=self.path.bend(part)), part)

    def descend(self, frames: Frames, parts: Parts) -> tuple[Filters, Frames]:
        """Derive the decimated samples of lit parts from those of the parts that they are parts of.

        They have the filters in common: those for the largest delay and Doppler of any. An interior begins where
        decimation pays; a part of one that has an interior has one.
        """
        owner, stride = parts.parent, frames.stride
        had, held, over = frames.size[owner] > 0, frames.inside[owner], frames.some[owner]
        some = np.clip(parts.some, over[:, :1], over[:, 1:])
        inside = np.clip(parts.whole, some[:, :1], some[:, 1:])
        near = np.stack([np.minimum(inside[:, 0], held[:, 0]), np.maximum(inside[:, 1], held[:, 1])], axis=1)
        inside = np.where(had[:, None], near, inside)
        grid = np.stack([frames.at[owner], (frames.at + stride * (frames.size - 1))[owner]], axis=1)
        ends = np.where(had[:, None], grid, some)
        looks = np.linspace(np.minimum(ends[:, 0], some[:, 0]), np.maximum(ends[:, 1], some[:, 1] - 1), LOOKS, axis=1)
        reach, fastest, _ = self.path.reach(np.rint(looks).astype(np.int64), parts)
        lit = inside[:, 1] - inside[:, 0]
        single = self._along_pulses(fastest, frames, int(lit.max()))
        further = Decimation(single.factor // stride, single.edge, self.levels.attenuation)
        fewer = (lit + 2 * single.half - 1) // single.factor + 1  # as `Decimation.span` counts
        inner = had | ((lit > 0) & (single.factor > 1) & (fewer < lit))
        inside = np.where(inner[:, None], inside, some[:, 1:])
        tail = further.half * stride
        low, high = inside[:, 0] - single.half, inside[:, 1] - 1 + single.half
        at = np.where(had, grid[:, 0], low)
        low = np.where(had, np.minimum(low, grid[:, 0] - tail), low)
        high = np.where(had, np.maximum(high, grid[:, 1] + tail), high)
        if inner.any():
            far = np.stack([low, high], axis=1)[inner]
            reach = max(reach, self.path.reach(far, parts.some_of(inner))[0])
        at -= (at - low) // single.factor * single.factor
        across = self._along_range(reach, frames)
        columns, first = across.span(frames.columns)
        left = Frames(
            centre=parts.centre, some=some, inside=inside, at=at, stride=single.factor, bend=frames.bend, reach=reach,
            size=np.where(inner, (high - at) // single.factor + 1, 0), columns=padded(columns),
            start=frames.start + first * frames.step, step=frames.step * across.factor,
        )  # fmt: skip
        return Filters(across, single, further), left

    def _along_range(self, reach: float, frames: Frames) -> Decimation:
        """The filter along range frequencies, for ranges up to `reach` m from the centre's."""
        rate = REACHED * 2 / SPEED_OF_LIGHT * reach * frames.step
        chosen = self._filter(rate, 1)
        return chosen if chosen.span(frames.columns)[0] < frames.columns else self._filter(rate, 1, most=1)

    def _along_pulses(self, fastest: float, frames: Frames, n: int) -> Decimation:
        """The filter along single pulses, n at most, for ranges that change by `fastest` m from one to the next.

        Its factor is a multiple of the interiors' stride; it is that where a larger one gains nothing, or where noise
        of the positions would be lost with the Dopplers that are stopped.
        """
        n, stride = max(n, 1), frames.stride
        doppler = REACHED * self._cycles * fastest
        beyond = self._airy * float(np.cbrt(np.pi * frames.bend * doppler)) / (2 * np.pi)
        rate = doppler + beyond + self.waves / n
        chosen = self._filter(rate, stride)
        noise = 2 * np.pi * self._cycles * self.path.noise * fastest / self.path.speed  # rad
        gains = chosen.span(n)[0] < n or frames.size.any()
        if gains and chosen.half <= self.path.beyond and noise**2 < 10 ** (-self.levels.attenuation / 10):
            return chosen
        return self._filter(rate, stride, most=stride)

    def _filter(self, rate: float, stride: int, most: int = MOST) -> Decimation:
        """Design a filter that passes `rate` cycles a sample and decimates by a multiple of `stride`."""
        factor = max(min(int(self.levels.edge / max(rate, 1e-9)), most) // stride, 1) * stride
        return Decimation(factor, 0.0 if factor == 1 else rate * factor, self.levels.attenuation)

    # ---------------------------------------------------------------- samples

    def gather(self, part: Parts, blocks: Iterable[tuple[IntArray, ComplexArray]]) -> Echoes | None:
        """Refer samples to a part and decimate them, block by block; None if no pulse lights it.

        Parameters
        ----------
        part : Parts
        blocks : iterable of ((n,) int, (n, n_range_frequency) complex64)
            The pulses that light some of the part, each block of consecutive ones, in ascending order; samples zero
            where they are missing.
        """
        if (entered := self.enter(part)) is None:
            return None
        filters, left = entered
        out, scratch = self._empty(left, Scratch(self.device.empty), 0), Scratch(self.device.empty)
        for pulses, samples in blocks:
            turn = self.path.ranges(pulses, part.centre[0]) - self.collection.reference_range[pulses]
            block = self.recorded((int(pulses[0]), int(pulses[-1]) + 1))
            self._pass_down(samples, block, filters, left, slice(0, 1), part.parent, out, scratch, turn)
        return Echoes(left, out)

    def divide(self, echoes: Echoes, parts: Parts, scratch: Scratch, level: int = 0, threads: int = 1) -> Echoes:
        """Refer echoes to lit parts of their parts, and decimate them: groups of parts side by side in threads.

        The result takes the memory that `scratch` has for the level.
        """
        frames, rows = echoes
        filters, left = self.descend(frames, parts)
        out, owner = self._empty(left, scratch, level), parts.parent
        held = np.where(frames.size > 0, np.diff(frames.inside)[:, 0] - frames.size, 0)  # fewer rows than pulses
        taken = np.diff(left.some)[:, 0] - held[owner]

        def work(some: slice) -> None:
            self._pass_down(rows, frames, filters, left, some, owner[some], out, scratch)

        run_groups(work, part_groups(taken, left.columns, self.device.group_bytes), threads)
        return Echoes(left, out)

    def _empty(self, frames: Frames, scratch: Scratch, level: int) -> ComplexArray:
        out = scratch.array(("rows", level), frames.shape)
        out[:] = 0
        return out

    def _pass_down(
        self, rows: ComplexArray, frames: Frames, filters: Filters, left: Frames, some: slice, owner: IntArray,
        out: ComplexArray, scratch: Scratch, turn: FloatArray | None = None,
    ) -> None:  # fmt: skip
        """Refer rows of frames to some parts, whose ranges are larger by `turn` m, and add them to their samples.

        Of a part's rows, which are turned and filtered along frequency, those that stay edges are copied, and the other
        edges and the interior are filtered to its interior. Of frames that have but some of the pulses, as a block of
        the collection's, all that they have is added; from them to others `turn` is given.
        """
        known, had = frames.some[owner], frames.size[owner] > 0
        begin, end = np.clip(left.some[some], known[:, :1], known[:, 1:]).T
        start, stop = np.clip(left.inside[some].T, begin, end)
        # Without an interior of the part above, it is as if it had an empty one where that of the part begins.
        held, held_until = np.where(had, frames.inside[owner].T, start)
        inner = np.where(had, frames.size[owner], 0)
        first, into = frames.ends[owner] + begin - known[:, 0], left.ends[some] + left.before[some]
        early, middle, late = start - begin, held - begin, end - stop
        count = middle + inner + end - held_until
        behind = into + left.size[some] + stop - left.inside[some, 1]
        taken = np.stack([first, count, early, left.ends[some] + begin - left.some[some, 0], late, behind], axis=1)
        source, target = np.empty((2, int(count.sum())), np.int64)
        found = np.empty(source.size)
        position, beyond = self.path.positions
        find_rows(
            position, beyond, frames.pulses, taken, frames.centre[owner], left.centre[some], source, target, found
        )
        others = scratch.array("turned", (source.size, left.columns))
        scale = 2 / SPEED_OF_LIGHT * (found if turn is None else turn)
        device, low = self.device, self.collection.carrier + frames.start
        device.turn_and_decimate(rows, source, scale * low, scale * frames.step, filters.across, target, out, others)
        at = np.cumsum(count) - count
        for decimation, row, number, lead in (
            (filters.further, middle, inner, (left.at[some] - frames.at[owner]) // frames.stride),
            (filters.single, early, held - start, left.at[some] - start),
            (filters.single, middle + inner, stop - held_until, left.at[some] - held_until),
        ):
            runs = np.stack([at + row, number, into, lead, left.size[some]], axis=1)[number > 0]
            if runs.size:
                device.add_decimated(others, runs, decimation, out)


def part_groups(rows: IntArray, columns: int, most: int) -> list[slice]:
    """Groups of parts with so many rows each, of about `most` bytes, or of one part."""
    group = np.cumsum(rows) * 8 * columns // most
    starts = np.unique(np.concatenate([[0], np.flatnonzero(np.diff(group)) + 1, [rows.size]])).tolist()
    return [slice(a, b) for a, b in pairwise(starts)]
