"""Division of an image for hierarchical back-projection, and its cost: levels, error, time and memory.

The error of an image is that of its filters and of the last interpolation. A filter of attenuation A errs in its pass
band and leaves of what it stops 10^(-A / 10) of the power at most. Over the pass band it errs by half of that on
average, and what is stopped is far below: an image whose samples have passed n filters has an error power of

    n / 2 10^(-A / 10) + spline_error(upsampling)^2

of all that its data hold. Each term has SHARE of what the fidelity allows, or of ERROR where that is less. The
coherence of an image with an error power e, which is not coherent with it, is (1 + e)^(-1/2).

What levels there are, and how large the last parts, is chosen by the predicted time: the filters of each level, and the
sums over what is left, are counted with the frames of `processors.hierarchy.derivation`, which plan what samples
follow.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import product

import numpy as np

from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.collection.weighting import Weighting
from blocksar.imaging.profiles import spline_error
from blocksar.kernels.groups import GPU_PART_BYTES, PART_BYTES
from blocksar.planning import effort
from blocksar.planning.tiling import image_chunk, units_of
from blocksar.processors.hierarchy.derivation import Filters, Frames, Hierarchy, Levels, Part, Path
from blocksar.processors.hierarchy.memory import hierarchical_gpu_memory, hierarchical_memory
from blocksar.processors.hierarchy.parts import MOST_WINDOWS, dwell_waves, leave_outside

ERROR = 1e-5  # error power that no image exceeds: less costs hardly any time, and dark places show it
SHARE = 0.4  # of what is allowed: some places of an image err by 1 dB more than its mean
EDGE = 0.34  # e of the filters: higher ones have long tails, lower ones leave more samples
RATIOS = (4.0, 6.0)  # of the sides of a level and the next; a further level costs more than it saves
UPSAMPLINGS = range(2, 25)
NODES = 3  # along a part's side, at which its lit pulses are found
DIVISIONS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)  # of the image along either side, into units of work
PLACES = (0.1, 0.3, 0.5, 0.7, 0.9)  # of the image, along either side, at which costs are found
FEW = 3  # every third place, by which divisions are ranked
PROFILES = 2  # arrays of range profiles at once: transformed in place, and with margins
GPU_PROFILES = 3  # besides, on a GPU: transformed out of place, with work areas of two lengths

Pair = tuple[float, float]  # m along x and y


@dataclass(frozen=True, kw_only=True)
class Rates:
    """Times of elementary work, s, of one thread where `graph.machine.pace` is 1, or of a GPU.

    Attributes
    ----------
    turn : float
        Per sample whose phase is turned.
    tap : float
        Per sample and tap, along either axis.
    part : float
        Per part, besides, once for each level.
    profile : float
        Per bin of a range profile.
    update : float
        Per pixel and pulse.
    pixel : float
        Per pixel: which pulses light it, its place in a group, weights, normalisation and writing.
    last_sides : tuple of int
        Of last parts that are tried, pixels.
    read : float
        Per sample read, by a CPU.
    """

    turn: float
    tap: float
    part: float
    profile: float
    update: float
    pixel: float
    last_sides: tuple[int, ...]
    read: float = 0.55e-9


RATES = {
    "cpu": Rates(
        turn=0.65e-9,
        tap=0.07e-9,
        part=25e-6,
        profile=2.9e-9,
        update=1.5e-9,
        pixel=120e-9,
        last_sides=(24, 32, 48, 64, 96, 128, 192),
    ),
    "gpu": Rates(
        turn=2e-11,
        tap=2e-12,
        part=1e-2,
        profile=2e-11,
        update=6e-12,
        pixel=4e-7,
        last_sides=(128, 192, 256, 384, 512, 1024),
    ),
}


def planned_error(levels: Levels, *, stages: int) -> float:
    """Error power of an image relative to its own, after `stages` filters along either axis."""
    filters = stages * 10 ** (-levels.attenuation / 10)  # two axes, half of the largest error each
    return filters + spline_error(upsampling=levels.upsampling) ** 2


def coherence_of(error: float) -> float:
    """Coherence of two images that differ by an error power."""
    return (1 + error) ** -0.5


def levels_for(fidelity: float, sides: tuple[float, ...], *, stages: int) -> Levels:
    """Choose levels whose error power is at most 1 - fidelity, or ERROR if that is less."""
    allowed = SHARE * min(1 - fidelity, ERROR)
    attenuation = 10 * math.log10(stages / allowed)
    upsampling = next((n for n in UPSAMPLINGS if spline_error(upsampling=n) ** 2 <= allowed), UPSAMPLINGS[-1])
    return Levels(sides=sides, attenuation=attenuation, edge=EDGE, upsampling=upsampling)


@dataclass(frozen=True, kw_only=True, eq=False)
class Cost:
    """Cost of a unit: a part of the image that one task forms from one reading of the samples.

    Attributes
    ----------
    seconds : float
        Of one thread, where the pace is 1.
    samples : int
        That are kept at once: see `Ladders.cost`; with a group of the rows that lead to a level, which are filtered
        along frequency only, or of the last level's range profiles.
    on_gpu : int
        The same on a GPU, which turns all rows of a group before it filters them.
    """

    seconds: float
    samples: int
    on_gpu: int


def parts_at(geometry: Geometry, places: Sequence[Pair], side: Pair) -> list[Part]:
    """Parts of a size (m along x and y) about places, as their borders see the beam."""
    x, y = (
        centre[:, None] + size / 2 * np.linspace(-1, 1, NODES)
        for centre, size in zip(np.array(places).T, side, strict=True)
    )
    mesh = np.broadcast_arrays(x[:, None, :], y[:, :, None])
    ends, (z, _) = np.stack(geometry.beam.passes(*mesh)), geometry.known_height(*mesh)
    longest = (ends[1] - ends[0]).sum(axis=(2, 3)).argmax(axis=0)
    parts = []
    for number, one in enumerate(longest):
        first, last = ends[:, one, number]
        parts.append(Part(x=x[number], y=y[number], z=z[number], first=first, last=last))
        leave_outside(geometry, parts[-1])
    return parts


class Ladders:
    """Costs of units divided along ladders of sides, at one place of the image.

    Parameters
    ----------
    hierarchy : Hierarchy
    geometry : Geometry
    grid : Grid
    rates : Rates
    part : callable
        The part about a place, of a size: see `parts_at`.
    """

    def __init__(
        self, hierarchy: Hierarchy, geometry: Geometry, grid: Grid, rates: Rates, part: Callable[[Pair, Pair], Part]
    ) -> None:
        self.hierarchy, self.geometry, self.grid, self.rates, self.part = hierarchy, geometry, grid, rates, part
        # Frequencies of the taper over the beam, whose sums the image is divided by.
        self.gains = effort.GAINS if geometry.collection.has_pattern or hierarchy.waves else 0.0

    def cost(self, place: Pair, singles: Sequence[Pair], levels: Sequence[Pair]) -> Cost | None:
        """Cost of a unit at a place; None where nothing lights it.

        Of `singles`, which begin with the unit and end with its windows, the samples of one are kept at a time, and of
        `levels`, into whose parts these are divided, those of all parts of a window: of one and the next.
        """
        part = self.part(place, singles[0])
        entered = self.hierarchy.enter(part.whole)
        if entered is None:
            return None
        n_frequency, (filters, frames) = self.geometry.collection.n_range_frequency, entered
        lit = int(np.diff(frames.some[0])[0])
        seconds = self.rates.read * lit * n_frequency + self._filtering(filters, frames, lit, 0, n_frequency)
        single, both, work, on_gpu = math.prod(frames.shape), [0, 0], 0, 0.0
        parts, area = 1.0, singles[0][0] * singles[0][1]
        for number, (width, height) in enumerate([*singles[1:], *levels], 1 - len(singles)):
            part = self.part(place, (width, height))
            (begin, end), (known, until) = part.lit()[0], frames.some[0].tolist()
            # Between the few places that are looked at, a part may be lit when its parent is not.
            if not max(begin, known) < min(end, until):
                return None
            filters, left = self.hierarchy.descend(frames, part.whole)
            parts, interior = area / (width * height), int(frames.size[0])
            held = frames.inside[0] if interior else left.inside[0, :1].repeat(2)
            edges = int(held[0] - left.some[0, 0] + left.some[0, 1] - held[1])
            seconds += parts * (self.rates.part + self._filtering(filters, left, edges, interior, frames.columns))
            if number < 0:
                single += math.prod(left.shape)
            else:
                alike = math.ceil(singles[-1][0] * singles[-1][1] / (width * height))
                both[number % 2] = max(both[number % 2], alike * math.prod(left.shape))
            rows = interior + edges
            work = max(work, rows * left.columns, PART_BYTES // 8)
            on_gpu = max(on_gpu, max(rows * left.columns, GPU_PART_BYTES // 8) * (1 + frames.columns / left.columns))
            frames = left
        rows, bins = frames.shape[0], self.hierarchy.levels.bins(frames.columns)
        work = max(work, PROFILES * max(rows * bins, PART_BYTES // 8))
        on_gpu = max(on_gpu, (PROFILES + GPU_PROFILES) * max(rows * bins, GPU_PART_BYTES // 8))
        seconds += parts * (self.rates.profile * rows * bins + self._last(frames, part, [*singles, *levels][-1]))
        kept = single + sum(both)
        return Cost(seconds=seconds, samples=kept + work, on_gpu=kept + math.ceil(on_gpu))

    def _last(self, frames: Frames, part: Part, side: tuple[float, float]) -> float:
        """Seconds to back-project a last part from the range profiles of what is left."""
        pixels = max(side[0] / self.grid.dx, 1) * max(side[1] / self.grid.dy, 1)
        lit = float((part.last - part.first).mean())
        each = int(frames.size[0]) + lit - float(np.diff(frames.inside[0])[0])
        pixel = self.rates.pixel + self.rates.update * max(each, 1) + self.gains * lit
        return self.rates.part + pixels * pixel

    def _filtering(self, filters: Filters, left: Frames, edges: int, interior: int, columns: int) -> float:
        """Seconds to turn and filter rows of `columns` samples, so many edges and of the interior, to a frame."""
        across = 2 * filters.across.half if filters.across.factor > 1 else 0
        rows = edges + interior
        seconds = rows * (self.rates.turn * columns + self.rates.tap * left.columns * across)
        taps = 0.0
        if interior:
            taps += interior * (2 * filters.further.half + 1) / filters.further.factor
        if left.size[0]:
            single = max(edges - int(left.before[0] + left.after[0]), 0)
            taps += single * (2 * filters.single.half + 1) / filters.single.factor
        return seconds + self.rates.tap * taps * left.columns


def _halved(unit: tuple[int, int], chunk: tuple[int, int]) -> list[tuple[int, int]]:
    """Rows and columns of a unit, of the halves that `form_windows` makes, and of its windows."""
    steps, now = [unit], unit
    while math.ceil(now[0] / chunk[0]) * math.ceil(now[1] / chunk[1]) > MOST_WINDOWS:
        axis = int(now[1] > now[0])
        half = math.ceil(now[axis] / 2)
        now = (half, now[1]) if axis == 0 else (now[0], half)
        steps.append(now)
    window = min(now[0], chunk[0]), min(now[1], chunk[1])
    return [*steps, window] if window != now else steps


@dataclass(frozen=True, kw_only=True, eq=False)
class Division:
    """Division of an image at all levels, with its cost.

    Attributes
    ----------
    chunks : tuple of int
        Rows and columns of chunks of the image in a unit.
    levels : Levels
    seconds : float
        Of one thread for all units, where the pace is 1.
    memory : int
        Of a task, bytes.
    on_gpu : int
        Of the GPU, bytes; 0 without one.
    stages : int
        Filters, along either axis, between the samples and the last parts.
    """

    chunks: tuple[int, int]
    levels: Levels
    seconds: float
    memory: int
    on_gpu: int
    stages: int

    @property
    def error(self) -> float:
        """Error power of the image relative to the total power in its data."""
        return planned_error(self.levels, stages=self.stages)


def divide(
    geometry: Geometry, grid: Grid, *, fidelity: float, weighting: Weighting, workers: int, memory_limit: float,
    device: str = "cpu",
) -> Division:  # fmt: skip
    """Find the division with the least predicted time for `workers` of one thread, within their memory, bytes.

    Divisions are ranked by what they cost at a few places; the chosen one is known at all. Where none fits, it is the
    one that takes the least memory.
    """
    trial = _Trial(geometry, grid, fidelity, weighting, device)
    units = trial.unit_sizes()
    ladder = trial.best_ladder(units[0])

    def time(each: Division) -> float:
        units = len(units_of(grid, each.chunks))
        return math.ceil(units / workers) * each.seconds / units

    found = sorted((trial.division(unit, ladder, trial.places[::FEW]) for unit in units), key=time)
    for each in (each for each in found if each.memory <= memory_limit):
        whole = trial.division(each.chunks, ladder, trial.places)
        if whole.memory <= memory_limit:
            return whole
    return trial.division(min(found, key=lambda each: each.memory).chunks, ladder, trial.places)


class _Trial:
    """Search over divisions of an image by cost."""

    def __init__(self, geometry: Geometry, grid: Grid, fidelity: float, weighting: Weighting, device: str) -> None:
        self.geometry, self.grid, self.fidelity, self.device = geometry, grid, fidelity, device
        self.chunk, self.waves, self.path = image_chunk(grid), dwell_waves(geometry, weighting), Path(geometry)
        self.levels = cache(partial(levels_for, fidelity, ()))
        # Ladders and units have most of their parts in common, and some of their costs.
        self.parts: dict[tuple[Pair, Pair], Part] = {}
        self.costs: dict[tuple[Pair, tuple[Pair, ...], tuple[Pair, ...]], Cost | None] = {}
        nodes = sorted(product(PLACES, PLACES), key=lambda node: math.hypot(node[0] - 0.5, node[1] - 0.5))
        self.places = [(grid.x0 + u * grid.dx * grid.shape[1], grid.y0 + v * grid.dy * grid.shape[0]) for u, v in nodes]

    def unit_sizes(self) -> list[tuple[int, int]]:
        """Sizes of units to try, in chunks along rows and columns."""
        return _unit_sizes(
            self.grid, [math.ceil(n / side) for n, side in zip(self.grid.shape, self.chunk, strict=True)]
        )

    def best_ladder(self, division: tuple[int, int]) -> tuple[float, int]:
        """Best ratio of sides and last side, pixels, for units of a size, at a lit place."""
        ladders = list(product(RATIOS, RATES[self.device].last_sides))
        return min(ladders, key=lambda each: self.division(division, each, self.places, first_lit=True).seconds)

    def division(
        self, division: tuple[int, int], ladder: tuple[float, int], places: Sequence[tuple[float, float]],
        *, first_lit: bool = False,
    ) -> Division:  # fmt: skip
        """Evaluate the division into units of a size by its costs at places, or at the first lit one."""
        grid, geometry, rates = self.grid, self.geometry, RATES[self.device]
        unit = tuple(min(c * side, n) for c, side, n in zip(division, self.chunk, grid.shape, strict=True))
        sides = [(columns * grid.dx, rows * grid.dy) for rows, columns in _halved((unit[0], unit[1]), self.chunk)]
        ratio, last = ladder
        below = _ladder(sides[-1], (last * grid.dx, last * grid.dy), ratio)
        stages = len(sides) + len(below)
        levels = replace(self.levels(stages=stages), sides=tuple(max(side) for side in below))
        unlit = Cost(seconds=rates.pixel * unit[0] * unit[1], samples=0, on_gpu=0)
        each_place = (self._cost(place, tuple(sides), tuple(below)) for place in places)
        if first_lit:
            costs = [next((cost for cost in each_place if cost is not None), unlit)]
        else:
            costs = [cost or unlit for cost in each_place]
        area = grid.shape[0] * grid.shape[1] / (unit[0] * unit[1])
        samples, most = max(cost.samples for cost in costs), max(cost.on_gpu for cost in costs)
        gpu = self.device == "gpu"
        return Division(
            chunks=division, levels=levels, seconds=area * float(np.mean([cost.seconds for cost in costs])),
            memory=hierarchical_memory(geometry.collection, samples, self.chunk, on_gpu=gpu),
            on_gpu=hierarchical_gpu_memory(geometry.collection, most, self.chunk) if gpu else 0,
            stages=stages,
        )  # fmt: skip

    def _find_parts(self, places: Sequence[Pair], sides: Sequence[Pair]) -> None:
        """Find the parts of some sizes about places that are not known yet, those of a size together."""
        for side in sides:
            if missing := [place for place in places if (place, side) not in self.parts]:
                found = parts_at(self.geometry, missing, side)
                self.parts.update(zip(((place, side) for place in missing), found, strict=True))

    def _part(self, place: Pair, side: Pair) -> Part:
        self._find_parts([place], [side])
        return self.parts[place, side]

    def _cost(self, place: Pair, singles: tuple[Pair, ...], levels: tuple[Pair, ...]) -> Cost | None:
        """Return `Ladders.cost` of a ladder at a place, which is found once."""
        if (place, singles, levels) not in self.costs:
            accuracy = self.levels(stages=len(singles) + len(levels))
            hierarchy = Hierarchy(self.geometry, accuracy, waves=self.waves, path=self.path)
            ladders = Ladders(hierarchy, self.geometry, self.grid, RATES[self.device], self._part)
            self.costs[place, singles, levels] = ladders.cost(place, singles, levels)
        return self.costs[place, singles, levels]


def _unit_sizes(grid: Grid, counts: list[int]) -> list[tuple[int, int]]:
    """Sizes of a unit in chunks along rows and columns, from the whole image to single chunks, nearly square."""
    sizes: list[tuple[int, int]] = []
    for number in DIVISIONS:
        high = abs(grid.dy) * grid.shape[0] / (abs(grid.dx) * grid.shape[1])
        along = max(round(number * math.sqrt(high)), 1), max(round(number / math.sqrt(high)), 1)
        size = math.ceil(counts[0] / along[0]), math.ceil(counts[1] / along[1])
        if size not in sizes:
            sizes.append(size)
    return sizes


def _ladder(window: tuple[float, float], last: tuple[float, float], ratio: float) -> list[tuple[float, float]]:
    """Sides of the levels below a window, down to the last parts."""
    span = max(w / s for w, s in zip(window, last, strict=True))
    if span <= 1:
        return []
    steps = max(round(math.log(span) / math.log(ratio)), 1)
    return [
        (min(window[0], last[0] * span ** (1 - k / steps)), min(window[1], last[1] * span ** (1 - k / steps)))
        for k in range(1, steps + 1)
    ]
