"""Hierarchical back-projection: small parts of the image from data that hold no more than that part.

With c the centre of a part and R_c(p) its exact range at pulse p, the phase history referred to c is

    d_c(p, f) = S(p, f) exp(+4j pi (fc + f) / c0 (R_c(p) - reference_range(p)))

and the image at a point x of the part is

    image(x) = sum_p sum_f w(x, p) W(f) d_c(p, f) K_x(p, f),   K_x(p, f) = exp(+4j pi (fc + f) / c0 (R_x(p) - R_c(p))).

K_x is smooth. Along f it is a delay of 2 |R_x - R_c| / c0 <= 2 e_r / c0, and along p its Doppler is
2 (fc + f) / c0 |d/dt (R_x - R_c)| <= e_d, where e_r and e_d are the largest over the part. So the sum is the same after
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
rate, so that dwells end exactly where they do in exact back-projection (`collection.beam.lit_passes`). A taper over the
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

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray, IntArray
from blocksar.collection.collection import Collection
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.focusing.parts import Part, Path
from blocksar.kernels.decimation import Decimation, add_decimated, turn_and_decimate

MOST = 1 << 16  # largest factor of a decimation
REACHED = 1.02  # times the largest delay and Doppler of a part's corners: those of other points of it


@dataclass(frozen=True)
class Levels:
    """How parts are divided, and how well filters and interpolation work.

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
class Echoes:
    """What is left of a phase history for a part, referred to its centre.

    Attributes
    ----------
    interior : (n, m) complex64
        Of the pulses that light all of the part, filtered: at the pulses at, at + stride, ...
    at, stride : int
    inside : tuple of int
        The pulses first <= p < last that `interior` stands for; equal, and n is 0, where it stands for none.
    edges : (k, m) complex64
        Of the other pulses that light some of it.
    pulses : (k,) int
        Their numbers, ascending.
    start, step : float
        Range frequency of the first column, and spacing, Hz.
    """

    interior: ComplexArray
    at: int
    stride: int
    inside: tuple[int, int]
    edges: ComplexArray
    pulses: IntArray
    start: float
    step: float

    @property
    def grid(self) -> IntArray:
        """The pulse of each row of `interior`."""
        return self.at + self.stride * np.arange(self.interior.shape[0])


class _Gathering:
    """Pulses of a part that come one after the other: the interior is filtered at once, edges are kept.

    Parameters
    ----------
    inside : tuple of int
        Interior pulses; none if equal.
    filters : Decimation
        From single pulses to the interior's grid.
    low, high : int
        Pulses that the filters reach.
    anchor : int
        A pulse of the grid.
    columns : int
    """

    def __init__(
        self, inside: tuple[int, int], filters: Decimation, low: int, high: int, anchor: int, columns: int
    ) -> None:
        self.inside, self.filters = inside, filters
        self.at = anchor - (anchor - low) // filters.factor * filters.factor
        size = (high - self.at) // filters.factor + 1 if inside[0] < inside[1] else 0
        self.interior = np.zeros((size, columns), np.complex64)
        self.edges: list[ComplexArray] = []
        self.pulses: list[IntArray] = []

    def add(self, values: ComplexArray, pulses: IntArray) -> None:
        """Add rows of ascending pulses: interior ones follow each other without a gap."""
        a, b = np.searchsorted(pulses, self.inside)
        for part in (slice(0, a), slice(b, None)):
            if pulses[part].size:
                self.edges.append(values[part])
                self.pulses.append(pulses[part])
        if a < b:
            add_decimated(values[a:b], self.filters, self.at - int(pulses[a]), self.interior)

    def echoes(self, start: float, step: float) -> Echoes:
        """What has been gathered."""
        columns = self.interior.shape[1]
        return Echoes(
            interior=self.interior, at=self.at, stride=self.filters.factor, inside=self.inside, start=start, step=step,
            edges=np.concatenate([np.zeros((0, columns), np.complex64), *self.edges]),
            pulses=np.concatenate([np.zeros(0, np.int64), *self.pulses]),
        )  # fmt: skip


class Hierarchy:
    """The way of a phase history down the levels.

    Parameters
    ----------
    collection : Collection
    levels : Levels
    waves : float
        Largest frequency of the weights over a dwell, cycles per dwell.
    """

    def __init__(self, collection: Collection, levels: Levels, *, waves: float = 0.0) -> None:
        self.collection, self.levels, self.waves, self.path = collection, levels, waves, Path(collection)
        self._cycles = 2 * (collection.carrier + collection.range_frequency[-1]) / SPEED_OF_LIGHT  # per m

    def range_filter(self, reach: float, step: float, n: int) -> Decimation:
        """The filter along n range frequencies, `step` Hz apart, for ranges up to `reach` m from the centre's."""
        rate = REACHED * 2 / SPEED_OF_LIGHT * reach * step
        chosen = self._filter(rate, 1)
        return chosen if chosen.span(n)[0] < n else self._filter(rate, 1, most=1)

    def pulse_filter(self, change: float, inside: tuple[int, int], stride: int = 1) -> Decimation:
        """The filter along single pulses, for ranges that change by `change` m from one to the next.

        Its factor is a multiple of `stride`; it is that where a larger one gains nothing.
        """
        n = max(inside[1] - inside[0], 1)
        rate = REACHED * self._cycles * change + self.waves / n
        chosen = self._filter(rate, stride)
        gains = chosen.span(n)[0] < (n if stride == 1 else np.inf) and chosen.half <= self.path.beyond
        return chosen if gains else self._filter(rate, stride, most=stride)

    def _filter(self, rate: float, stride: int, most: int = MOST) -> Decimation:
        """The filter that passes `rate` cycles a sample, by a multiple of `stride`."""
        factor = max(min(int(self.levels.edge / max(rate, 1e-9)), most) // stride, 1) * stride
        return Decimation(factor, 0.0 if factor == 1 else rate * factor, self.levels.attenuation)

    def gather(self, part: Part, blocks: Iterable[tuple[IntArray, ComplexArray]], reference: FloatArray) -> Echoes:
        """Refer samples to a part and decimate them, block by block of pulses.

        Parameters
        ----------
        part : Part
        blocks : iterable of ((n,) int, (n, n_range_frequency) complex64)
            Consecutive pulses, ascending, that light some of the part; samples zero where they are missing.
        reference : (n_pulse,) float
            Range whose phase was removed from the samples, m.
        """
        collection = self.collection
        (begin, end), inside = part.lit()
        centre, corners = part.centre, part.corners
        reach, change = self.path.reach(np.arange(begin, end), centre, corners)
        along = self.pulse_filter(change, inside)
        if along.factor > 1:  # once more, with the tails
            reach, change = self.path.reach(np.arange(begin - along.half, end + along.half), centre, corners)
            along = self.pulse_filter(change, inside)
        inside = inside if along.factor > 1 else (end, end)
        start, step = float(collection.range_frequency[0]), collection.range_frequency_step
        across = self.range_filter(reach, step, collection.n_range_frequency)
        gathering: _Gathering | None = None
        for pulses, samples in blocks:
            turn = self.path.ranges(pulses, centre) - reference[pulses]
            values, first = self._turn(samples, turn, start, step, across)
            if gathering is None:
                low, high = inside[0] - along.half, inside[1] - 1 + along.half
                gathering = _Gathering(inside, along, low, high, low, values.shape[1])
            gathering.add(values, pulses)
        assert gathering is not None
        return gathering.echoes(start + first * step, step * across.factor)

    def descend(self, part: Part, echoes: Echoes, child: Part) -> Echoes | None:
        """Refer a part's echoes to one of its parts and decimate them; None if no pulse lights it."""
        (begin, end), inside = child.lit()
        if begin == end:
            return None
        kept = slice(*np.searchsorted(echoes.pulses, (begin, end)))
        pulses, grid = echoes.pulses[kept], echoes.grid
        rows = np.concatenate([grid, pulses])
        stride, n = (echoes.stride, grid.size) if grid.size else (1, 0)
        reach, change = self.path.reach(rows, child.centre, child.corners)
        along = self.pulse_filter(change, inside, stride)
        further = Decimation(along.factor // stride, along.edge, self.levels.attenuation)
        low, high = inside[0] - along.half, inside[1] - 1 + along.half
        if n:
            tail = further.half * stride
            low, high = min(low, int(grid[0]) - tail), max(high, int(grid[-1]) + tail)
        elif along.factor == 1:
            inside = (end, end)
        reach = max(reach, self.path.reach(np.array([low, high]), child.centre, child.corners)[0])
        across = self.range_filter(reach, echoes.step, echoes.edges.shape[1])
        turn = self.path.ranges(rows, child.centre) - self.path.ranges(rows, part.centre)
        interior, first = self._turn(echoes.interior, turn[:n], echoes.start, echoes.step, across)
        edges, first = self._turn(echoes.edges[kept], turn[n:], echoes.start, echoes.step, across)
        anchor = echoes.at if n else low
        gathering = _Gathering(inside, along, low, high, anchor, edges.shape[1])
        if n:
            add_decimated(interior, further, (gathering.at - echoes.at) // stride, gathering.interior)
        # Edges that are interior now are two runs, before and after those that were interior.
        middle = int(np.searchsorted(pulses, echoes.inside[0])) if n else pulses.size
        for run in (slice(0, middle), slice(middle, None)):
            gathering.add(edges[run], pulses[run])
        return gathering.echoes(echoes.start + first * echoes.step, echoes.step * across.factor)

    def _turn(
        self, values: ComplexArray, turn: FloatArray, start: float, step: float, filters: Decimation
    ) -> tuple[ComplexArray, int]:
        """Refer rows to ranges that are larger by `turn` (n,) m, and decimate them."""
        scale = 2 / SPEED_OF_LIGHT
        return turn_and_decimate(values, scale * (self.collection.carrier + start) * turn, scale * step * turn, filters)
