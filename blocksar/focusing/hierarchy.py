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

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise, product
from typing import NamedTuple

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray, IntArray
from blocksar.collection.geometry import Geometry
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.kernels.decimation import Decimation, padded
from blocksar.kernels.device import CPU, Device
from blocksar.kernels.groups import Scratch

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

    def at(self, pulses: IntArray) -> FloatArray:
        """Positions (n, 3) at pulses (n,), m."""
        return self._position[self._index(pulses)]

    def ranges(self, pulses: IntArray, point: FloatArray) -> FloatArray:
        """Ranges (n,) of a point (3,) at pulses (n,), m."""
        x, y, z = (self.at(pulses) - point).T
        return np.asarray(np.sqrt(x * x + y * y + z * z))

    def reach(self, pulses: IntArray, part: Part) -> tuple[float, FloatArray]:
        """Extent of a part in range relative to its centre, and its change, seen at pulses (n,).

        Returns
        -------
        away : float
            Largest |R_x - R_c| of points x of its border, m.
        change : (n, k) float
            Change of R_x - R_c from a pulse to the next, of each of them, m.
        """
        index = self._index(pulses)
        points = np.concatenate([part.centre[None], part.border])
        sight = self._smooth[index][:, None] - points
        distance = np.sqrt((sight * sight).sum(axis=2))
        rate = (sight * self._velocity[index][:, None]).sum(axis=2) / distance
        return float(np.abs(distance[:, 1:] - distance[:, :1]).max()), rate[:, 1:] - rate[:, :1]

    def bend(self, low: int, high: int, part: Part) -> float:
        """Largest second derivative of the change from `reach`, relative to the largest change, per pulse^2."""
        step = max((high - low) // BEND_NODES, 1)
        change = self.reach(np.arange(low, high + 1, step), part)[1]
        if change.shape[0] < 3:
            return 0.0
        return float(np.abs(np.diff(change, 2, axis=0)).max() / step**2 / np.abs(change).max())


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

    @cached_property
    def _box(self) -> FloatArray:
        """Corners and middle of the bounding box (3, 3): low end, middle, high end of x, y and z."""
        ends = np.array([(axis.min(), axis.max()) for axis in (self.x, self.y, self.z)])
        return np.stack([ends[:, 0], ends.mean(axis=1), ends[:, 1]])

    @property
    def centre(self) -> FloatArray:
        """Middle (3,) of the bounding box, m."""
        return self._box[1]

    @property
    def border(self) -> FloatArray:
        """Corners and edge middles of the bounding box, (k, 3) m: the places farthest from the centre.

        Close by, the nearest point of a side is not one of its ends.
        """
        nodes = BORDER if self._box[0, 2] < self._box[2, 2] else BORDER[:9]  # of a level part the lower half is all
        return self._box[nodes, np.arange(3)]

    @property
    def side(self) -> float:
        """The longer side, m."""
        return float(max(abs(self.x[-1] - self.x[0]), abs(self.y[-1] - self.y[0])))

    def lit(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Pulses begin <= p < end that light any pixel, and first <= p < last that light all lit ones; or empty."""
        lit = self.last > self.first
        if not lit.any():
            return (0, 0), (0, 0)
        some = int(self.first[lit].min()), int(self.last[lit].max())
        whole = int(self.first[lit].max()), int(self.last[lit].min())
        return some, whole if whole[0] < whole[1] else (some[1], some[1])

    def divide(self, side: float) -> Iterator[tuple[slice, slice]]:
        """Divide into subparts of at most `side` m and similar size; yields rows and columns."""
        spans = []
        for axis in (self.y, self.x):
            count = min(max(int(np.ceil(abs(axis[-1] - axis[0]) / side)), 1), axis.size)
            ends = [axis.size * i // count for i in range(count + 1)]
            spans.append([slice(a, b) for a, b in pairwise(ends)])
        return ((rows, columns) for rows in spans[0] for columns in spans[1])


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


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """Decimated samples of a phase history for a part, referred to its centre: their axes.

    Attributes
    ----------
    at, stride, size : int
        The interior: pulses at, at + stride, ..., `size` of them.
    inside : tuple of int
        The pulses first <= p < last that the interior stands for; equal where it stands for none.
    pulses : (k,) int
        The edges: other pulses that light some of the part, ascending.
    start, step, columns : float, float, int
        Range frequency of the first column, and spacing, Hz.
    bend : float
        How Doppler bends over the dwell, per pulse^2: see `Path.bend`.
    reach : float
        Largest |R_x - R_c| of the part, m.
    """

    at: int
    stride: int
    size: int
    inside: tuple[int, int]
    pulses: IntArray
    start: float
    step: float
    columns: int
    bend: float
    reach: float = np.inf

    @property
    def grid(self) -> IntArray:
        """The pulse of each row of the interior."""
        return self.at + self.stride * np.arange(self.size)

    @property
    def before(self) -> int:
        """Number of the edges that precede the interior."""
        return int(np.searchsorted(self.pulses, self.inside[0])) if self.size else self.pulses.size


class Echoes(NamedTuple):
    """The samples of a frame: interior (size, columns) and edges (k, columns), complex64."""

    frame: Frame
    interior: ComplexArray
    edges: ComplexArray


class Filters(NamedTuple):
    """Filters from the samples of a part to those of a subpart.

    Attributes
    ----------
    across : Decimation
        Along range frequencies.
    single, further : Decimation
        Along pulses: from single ones, and from those of the interior.
    kept : slice
        The edges that light some of it.
    """

    across: Decimation
    single: Decimation
    further: Decimation
    kept: slice


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

    def enter(self, part: Part) -> tuple[Filters, Frame] | None:
        """Filters and frame from the samples of the collection to a part; None if no pulse lights it."""
        (begin, end), _ = part.lit()
        if begin == end:
            return None
        collection = self.collection
        whole = Frame(
            at=0, stride=1, size=0, inside=(end, end), pulses=np.arange(begin, end),
            start=float(collection.range_frequency[0]), step=collection.range_frequency_step,
            columns=collection.n_range_frequency, bend=self.path.bend(begin, end, part),
        )  # fmt: skip
        return self.descend(whole, part)

    def descend(self, frame: Frame, child: Part) -> tuple[Filters, Frame] | None:
        """Derive the decimated samples of a subpart from those of its part; None if no pulse lights it."""
        (begin, end), inside = child.lit()
        if begin == end:
            return None
        edges = slice(*np.searchsorted(frame.pulses, (begin, end)))
        pulses, grid = frame.pulses[edges], frame.grid
        rows = np.concatenate([grid, pulses])
        reach, change = self.path.reach(rows[:: max(rows.size // LOOKS, 1)], child)
        single = self._along_pulses(change, frame, inside)
        further = Decimation(single.factor // frame.stride, single.edge, self.levels.attenuation)
        if single.factor == 1:  # nothing is filtered: all pulses are edges
            inside = end, end
        low, high, at = inside[0] - single.half, inside[1] - 1 + single.half, inside[0] - single.half
        if frame.size:
            tail = further.half * frame.stride
            low, high, at = min(low, int(grid[0]) - tail), max(high, int(grid[-1]) + tail), frame.at
        reach = max(reach, self.path.reach(np.array([low, high]), child)[0])
        across = self._along_range(reach, frame)
        at -= (at - low) // single.factor * single.factor
        columns, first = across.span(frame.columns)
        left = Frame(
            at=at, stride=single.factor, inside=inside, columns=padded(columns), bend=frame.bend, reach=reach,
            size=(high - at) // single.factor + 1 if inside[0] < inside[1] else 0,
            pulses=pulses[(pulses < inside[0]) | (pulses >= inside[1])],
            start=frame.start + first * frame.step, step=frame.step * across.factor,
        )  # fmt: skip
        return Filters(across, single, further, edges), left

    def _along_range(self, reach: float, frame: Frame) -> Decimation:
        """Design the filter along range frequencies for ranges up to `reach` m from the centre's."""
        rate = REACHED * 2 / SPEED_OF_LIGHT * reach * frame.step
        chosen = self._filter(rate, 1)
        return chosen if chosen.span(frame.columns)[0] < frame.columns else self._filter(rate, 1, most=1)

    def _along_pulses(self, change: FloatArray, frame: Frame, inside: tuple[int, int]) -> Decimation:
        """Design the filter along single pulses for ranges that change by `change` m between pulses.

        Its factor is a multiple of the interior's stride; it is that where a larger one gains nothing, or where noise
        of the positions would be lost with the Dopplers that are stopped.
        """
        n, stride = max(inside[1] - inside[0], 1), frame.stride
        fastest = float(np.abs(change).max())
        doppler = REACHED * self._cycles * fastest
        beyond = self._airy * float(np.cbrt(np.pi * frame.bend * doppler)) / (2 * np.pi)
        rate = doppler + beyond + self.waves / n
        chosen = self._filter(rate, stride)
        noise = 2 * np.pi * self._cycles * self.path.noise * fastest / self.path.speed  # rad
        gains = chosen.span(n)[0] < n or frame.size
        if gains and chosen.half <= self.path.beyond and noise**2 < 10 ** (-self.levels.attenuation / 10):
            return chosen
        return self._filter(rate, stride, most=stride)

    def _filter(self, rate: float, stride: int, most: int = MOST) -> Decimation:
        """Design a filter that passes `rate` cycles a sample and decimates by a multiple of `stride`."""
        factor = max(min(int(self.levels.edge / max(rate, 1e-9)), most) // stride, 1) * stride
        return Decimation(factor, 0.0 if factor == 1 else rate * factor, self.levels.attenuation)

    # ---------------------------------------------------------------- samples

    def gather(self, part: Part, blocks: Iterable[tuple[IntArray, ComplexArray]], scratch: Scratch) -> Echoes | None:
        """Refer samples to a part and decimate them block by block; None if no pulse lights it.

        Parameters
        ----------
        part : Part
        blocks : iterable of ((n,) int, (n, n_range_frequency) complex64)
            The pulses that light some of the part, each block of consecutive ones, in ascending order; samples zero
            where they are missing.
        scratch : Scratch
        """
        if (entered := self.enter(part)) is None:
            return None
        filters, frame = entered
        interior, edges = self._empty(frame, Scratch(self.device.empty), 0)
        f = float(self.collection.range_frequency[0]), self.collection.range_frequency_step
        for pulses, samples in blocks:
            turn = self.path.ranges(pulses, part.centre) - self.collection.reference_range[pulses]
            values = self._turned(samples, turn, self.collection.carrier + f[0], f[1], filters, scratch)
            self._add(values, pulses, filters, frame, interior, edges)
        return Echoes(frame, interior, edges)

    def divide(self, part: Part, echoes: Echoes, child: Part, scratch: Scratch, level: int) -> Echoes | None:
        """Refer a part's echoes to a subpart and decimate them; None if no pulse lights it.

        The result takes the memory that `scratch` has for the level.
        """
        frame = echoes.frame
        if (descended := self.descend(frame, child)) is None:
            return None
        filters, left = descended
        pulses, grid, low = frame.pulses[filters.kept], frame.grid, self.collection.carrier + frame.start
        rows = np.concatenate([grid, pulses])
        turn = self.path.ranges(rows, child.centre) - self.path.ranges(rows, part.centre)
        interior, edges = self._empty(left, scratch, level)
        if frame.size:
            values = self._turned(echoes.interior, turn[: frame.size], low, frame.step, filters, scratch)
            self.device.add_decimated(values, filters.further, (left.at - frame.at) // frame.stride, interior)
        values = self._turned(echoes.edges[filters.kept], turn[frame.size :], low, frame.step, filters, scratch)
        # Edges before the interior, and those after it: in each, pulses follow each other without a gap.
        middle = int(np.searchsorted(pulses, frame.inside[0])) if frame.size else pulses.size
        for run in (slice(0, middle), slice(middle, None)):
            self._add(values[run], pulses[run], filters, left, interior, edges)
        return Echoes(left, interior, edges)

    def _empty(self, frame: Frame, scratch: Scratch, level: int) -> tuple[ComplexArray, ComplexArray]:
        interior = scratch.array(("interior", level), (frame.size, frame.columns))
        interior[:] = 0
        return interior, scratch.array(("edges", level), (frame.pulses.size, frame.columns))

    def _add(
        self, values: ComplexArray, pulses: IntArray, filters: Filters, frame: Frame, interior: ComplexArray,
        edges: ComplexArray,
    ) -> None:  # fmt: skip
        """Add rows of consecutive pulses to the interior or the edges of a frame."""
        a, b = np.searchsorted(pulses, frame.inside)
        for some in (slice(0, a), slice(b, None)):
            if pulses[some].size:
                first = int(np.searchsorted(frame.pulses, pulses[some][0]))
                edges[first : first + pulses[some].size] = values[some]
        if a < b:
            self.device.add_decimated(values[a:b], filters.single, frame.at - int(pulses[a]), interior)

    def _turned(
        self, values: ComplexArray, turn: FloatArray, low: float, step: float, filters: Filters, scratch: Scratch
    ) -> ComplexArray:
        """Refer rows to ranges larger by `turn` (n,) m, at frequencies from `low` on, Hz, and decimate them."""
        scale = 2 / SPEED_OF_LIGHT
        across: ComplexArray = self.device.turn_and_decimate(
            values, scale * low * turn, scale * step * turn, filters.across, scratch
        )
        return across
