"""The plan of a collection: everything that focusing needs, from metadata alone. No sample is read.

A plan holds the blocks with their Doppler supports, margins, padding and coefficients; where every target focuses and
with which phase; predicted residual phase, side lobes, width and range migration; and the memory of the tasks.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial
from itertools import chain, pairwise
from typing import Literal

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.budget import FIDELITY, image_tap_error
from blocksar.chunks import (
    CHUNK_SAMPLES,
    COLUMN_CHUNK,
    DOPPLER_GROUP,
    GATE_BYTES,
    SIGNAL_BYTES,
    SIGNAL_COLUMNS,
    SPECTRUM_BYTES,
)
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry, over_terrain
from blocksar.collection.grid import Grid
from blocksar.collection.region import Extent, Owned, Region, block_seams, default_grid, grid_extent, plan_region
from blocksar.collection.terrain import Terrain
from blocksar.collection.weighting import UNIFORM, Weighting
from blocksar.constants import MIB, SPEED_OF_LIGHT
from blocksar.errors import InputError, OutsideSwath, PrfTooLow
from blocksar.focusing.chains import steps_of
from blocksar.focusing.method import DEFAULT, Method
from blocksar.focusing.range_gate import RangeGate
from blocksar.focusing.range_steps import Keystone
from blocksar.focusing.recovery import Recovery
from blocksar.planning.block import BlockPlan, plan_block
from blocksar.planning.coefficients import Choice
from blocksar.planning.division import MAX_BLOCKS, find_division
from blocksar.planning.edge_search import find_edges
from blocksar.planning.edges import Edges, plan_edges
from blocksar.planning.memory import MEMORY_SHARE, PROCESS_MEMORY, gating_memory
from blocksar.planning.recovery import plan_recovery
from blocksar.planning.refusal import find_refusal
from blocksar.planning.relief import Relief, Samples, find_relief, sample_terrain
from blocksar.planning.sector import Sector, ground_range
from blocksar.planning.staying import beam_stays
from blocksar.planning.steadiness import PROBED, Gated, first_that, gated_beams
from blocksar.planning.work import Transforms, block_work, fft_work

MOST_BLOCKS = 1000  # that a caller may ask for
MAX_PARTS = 64  # range sub-blocks of a block
WHOLE_WINDOWS, PART_WINDOWS = 2.5, 0.97  # range windows that a whole block, and a range sub-block, may hold


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """How a collection is focused: everything that the tasks need, and the quality to expect.

    Attributes
    ----------
    geometry, grid, region, recovery, method : Geometry, Grid, Region, Recovery, Method
        Track and beam; of the image; what can be imaged; from samples to the spectrum; the chain of steps.
    seams : (n_blocks + 1,) float
        Yaws between which the blocks lie, rad; only blocks that the grid touches are planned.
    parts : int
        Range sub-blocks of every block, 1 for whole blocks; each is a `BlockPlan` of its own.
    fidelity : float
        Coherence with exact back-projection that `auto` keeps where it can.
    weighting : Weighting
        Tapers over band and dwell.
    fade : int
        From `planning.edges`: where positive, the edges of dwells are back-projected.
    stays : bool
        From `planning.staying`: whether all pulses are summed, and those that do not light a pixel taken out.
    gated : Gated
        From `planning.steadiness`: the beam that dwell gates follow.
    refusal : str or None
        Why the geometry cannot be focused, with the figure.
    searched : bool
        Whether `auto` chose the division: where it does not keep the fidelity, none that was tried does.
    """

    geometry: Geometry
    grid: Grid
    region: Region
    recovery: Recovery
    seams: FloatArray
    parts: int
    blocks: tuple[BlockPlan, ...]
    method: Method
    fidelity: float
    weighting: Weighting
    fade: int
    stays: bool
    gated: Gated
    refusal: str | None
    searched: bool = False

    def __repr__(self) -> str:
        return f"<Plan: {self.headline()}>"

    def headline(self) -> str:
        """The plan in half a sentence: blocks, predicted coherence, memory."""
        if self.refusal is not None:
            return f"refused: {self.refusal}"
        divided = f" of {self.parts} range sub-blocks" if self.parts > 1 else ""
        noun = "block" if self.n_blocks == 1 else "blocks"
        return (
            f"{self.n_blocks} {noun}{divided} by {self.method.processor}, {self.grid.shape[1]} x {self.grid.shape[0]} "
            f"pixels, predicted coherence at least {self.coherence:.6f}, {self.memory / MIB:.0f} MiB for each worker"
        )

    @property
    def n_blocks(self) -> int:
        return self.seams.size - 1

    def numbered(self, first: int) -> Plan:
        """The same with its blocks numbered from `first` on, after those of other segments."""
        return replace(self, blocks=tuple(replace(block, index=first + block.index) for block in self.blocks))

    @property
    def spectrum_chunk(self) -> tuple[int, int]:
        """Doppler bins and range frequencies of a chunk of the spectrum; even the last chunks are nearly full."""
        n_bin, n_frequency = self.recovery.doppler.size, self.geometry.collection.n_range_frequency
        column = COLUMN_CHUNK
        while column > 16 and 8 * column * n_bin > SPECTRUM_BYTES:
            column //= 2
        column = _even(n_frequency, column)
        height = _even(n_bin, CHUNK_SAMPLES // column)
        if self.parts > 1:  # a task gates whole chunks in range, in groups of equal size
            height = _even(n_bin, min(height, max(GATE_BYTES // (8 * n_frequency), 1)))
            groups = math.ceil(height / DOPPLER_GROUP)
            height = groups * math.ceil(height / groups)
        return height, column

    @property
    def gate_group(self) -> int:
        """Doppler bins that are gated in range at a time: a whole fraction of a chunk of the spectrum."""
        height = self.spectrum_chunk[0]
        return height // math.ceil(height / DOPPLER_GROUP)

    def gated_bins(self, block: BlockPlan) -> tuple[int, int]:
        """First and last Doppler bin (exclusive) of a sub-block's gated spectrum: its slab, in whole groups."""
        group, n_bin = self.gate_group, self.recovery.doppler.size
        last = block.first_bin + block.n_bin
        return block.first_bin - block.first_bin % group, min(math.ceil(last / group) * group, n_bin)

    def gated_chunk(self, block: BlockPlan) -> tuple[int, int]:
        """Doppler bins and range frequencies of a chunk of a sub-block's gated spectrum."""
        return self.gate_group, _even(block.sampling.range_frequency.size, COLUMN_CHUNK)

    @property
    def column_group(self) -> int:
        """Range frequencies that one task recovers: whole chunks of the spectrum."""
        chunk = self.spectrum_chunk[1]
        n_chunk = SIGNAL_BYTES // (8 * self.recovery.pulses.size * chunk)
        return chunk * max(min(n_chunk, SIGNAL_COLUMNS // chunk), 1)

    @property
    def recovery_memory(self) -> int:
        """Peak memory of a worker that recovers the spectrum, bytes."""
        signal = self.column_group * self.recovery.pulses.size
        return PROCESS_MEMORY + 8 * (2 * signal + 2 * self.spectrum_chunk[1] * self.recovery.doppler.size)

    @property
    def memory(self) -> int:
        """Peak memory of a worker, bytes."""
        return max(self.recovery_memory, self.gating_memory, *(block.memory for block in self.blocks))

    @property
    def gating_memory(self) -> int:
        """Peak memory of a worker that gates sub-blocks in range, bytes; 0 without any."""
        return max(
            (
                gating_memory(gate, n_bin=self.spectrum_chunk[0], n_group=self.gate_group)
                for gate in self._range_gates()
            ),
            default=0,
        )

    def _range_gates(self) -> list[RangeGate]:
        return [block.range_gate for block in self.blocks if block.range_gate is not None]

    @property
    def coherence(self) -> float:
        """The least coherence with exact back-projection that any block predicts."""
        return min(block.prediction.coherence for block in self.blocks)

    @property
    def completed(self) -> bool:
        """Whether the chains' image is completed by back-projection of some pulses."""
        return self.fade > 0 or self.stays

    @property
    def blends(self) -> bool:
        """Whether windows for dwells of several lengths are blended."""
        gates = [block.sampling.gate for block in self.blocks]
        return any(gate is not None and gate.taper is not None for gate in gates)

    @property
    def edge_pulses(self) -> int:
        """Pulses at either end of a dwell that are back-projected; 0 where none are."""
        gates = [block.sampling.gate for block in self.blocks]
        lengths = [gate.length for gate in gates if gate is not None]
        if not self.fade or not lengths:
            return 0
        return math.ceil(max(lengths) * self.geometry.collection.prf / (2 * self.fade))

    def transforms(self) -> list[Transforms]:
        """All FFTs of samples in the plan, in order."""
        frequency = self.geometry.collection.range_frequency
        transforms = [Transforms("recover", frequency.size, n) for n in self.recovery.program(frequency).transforms]
        transforms += self._gate_transforms()
        for block in self.blocks:
            for stage in block.stages:
                transforms += [Transforms(stage.name, stage.program.n_row, n) for n in stage.program.transforms]
        return transforms

    def gate_spans(self) -> list[tuple[int, int]]:
        """First and last Doppler bin (exclusive) that each gating task reads: whole chunks that sub-blocks touch."""
        height, n_bin = self.spectrum_chunk[0], self.recovery.doppler.size
        slabs = [(block.first_bin, block.first_bin + block.n_bin) for block in self.blocks if block.range_gate]
        spans = [(first, min(first + height, n_bin)) for first in range(0, n_bin, height)]
        return [span for span in spans if any(first < span[1] and span[0] < last for first, last in slabs)]

    def _gate_transforms(self) -> list[Transforms]:
        """Those of the range gates: each Doppler bin once to delay, and from there for each sub-block."""
        gates = self._range_gates()
        if not gates:
            return []
        bins = np.zeros(self.recovery.doppler.size, np.bool_)
        for block in self.blocks:
            bins[block.first_bin : block.first_bin + block.n_bin] = True
        to_delay = Transforms(gates[0].name, int(bins.sum()), gates[0].to_delay.period)
        return [to_delay, *(Transforms(gate.name, gate.n_row, gate.gate.size) for gate in gates)]

    def gate_work(self) -> float:
        """Floating-point operations of the range gates' transforms."""
        return sum(each.count * fft_work(each.length) for each in self._gate_transforms())

    def work(self) -> float:
        """Floating-point operations of all transforms and resamplings of the blocks."""
        return self.gate_work() + sum(map(block_work, self.blocks))

    def excess(self, *, migration: bool = True) -> float:
        """The largest excess of any block over what the fidelity allows; see `Prediction.excess`."""
        return max(block.prediction.excess(self.fidelity, migration=migration) for block in self.blocks)

    @property
    def faithful(self) -> bool:
        """Whether all blocks keep the fidelity, and side lobes as close to the ideal ones as it asks for."""
        return self.excess() <= 1.0


def _even(n: int, most: int) -> int:
    """The size of the fewest parts of n that have at most `most`, all but the last alike."""
    return math.ceil(n / math.ceil(n / most))


def plan_collection(
    collection: Collection,
    *,
    blocks: int | Literal["auto"] = "auto",
    parts: int | Literal["auto"] = "auto",
    method: Method = DEFAULT,
    fidelity: float = FIDELITY,
    weighting: Weighting = UNIFORM,
    grid: Grid | None = None,
    owned: Owned | None = None,
    terrain: Terrain | None = None,
    workers: int = 1,
    memory_limit: int | None = None,
) -> Plan:
    """Plan a collection for a method; with `owned`, only the blocks with ground for which it is true.

    `auto` takes the fewest blocks that keep the fidelity, at least one a worker, and the fewest range sub-blocks of
    each that migration needs (`find_division`) and that fit a worker's memory.

    Raises
    ------
    InputError
        If the PRF is too low, the grid is empty or outside the swath, or no number of sub-blocks fits the memory.
    """
    if blocks != "auto" and not 1 <= blocks <= MOST_BLOCKS:
        raise InputError(f"blocks = {blocks}: ask for 1 to {MOST_BLOCKS}, or for 'auto'")
    geometry = Geometry(collection=collection) if terrain is None else over_terrain(collection, terrain)
    region = plan_region(geometry, grid)
    grid = grid or default_grid(geometry, region)
    extent = grid_extent(geometry, region, grid, owned)
    stays = beam_stays(geometry, region, extent)
    if stays:
        gates = [Gated(geometry.collection.unsteered())]
    else:
        gates = gated_beams(geometry, region, fidelity, weighting.azimuth)

    @cache
    def follow(gated: Gated) -> Callable[[float], _Planner]:
        """Planners for edges of several lengths, of a gate that follows a beam."""
        summed = gated.over(geometry)
        recovery = plan_recovery(summed, region, method, stays=stays)
        edges = partial(
            plan_edges, summed, region, fidelity=fidelity, weighting=weighting,
            band=recovery.band[1] - recovery.band[0], keystone=Keystone in steps_of(method),
        )  # fmt: skip
        return cache(lambda times: _Planner(
            geometry=geometry, gated=gated, stays=stays, region=region, recovery=recovery, grid=grid, extent=extent,
            method=method, fidelity=fidelity, weighting=weighting,
            edges=edges(times=max(times, 1.0) if gated.wobbles else times),
        ))  # fmt: skip

    def excess(gated: Gated) -> float:
        try:
            probe = follow(gated)(0.0).plan(PROBED, 1, True)
        except PrfTooLow:
            return math.inf
        except InputError:  # no block of so many holds a point of the grid
            return 0.0
        return probe.excess() if probe.refusal is None else math.inf

    planner = follow(first_that(gates, excess))

    def choose(times: float) -> Plan:
        if blocks == "auto":
            return find_division(
                planner(times).plan, workers=workers, parts=None if parts == "auto" else parts,
                scattered=terrain is not None, jointly=terrain is None and not collection.has_axis,
                exceeds=planner(times).exceeds,
            )  # fmt: skip
        return planner(times).plan(blocks, 1 if parts == "auto" else parts, False)

    times, first = find_edges(lambda times, count, n_parts, probe: planner(times).plan(count, n_parts, probe), choose)
    first = replace(first, searched=blocks == "auto")
    if memory_limit is None or first.refusal is not None:
        return first

    def divide(n_parts: int) -> Plan:
        return replace(planner(times).plan(first.n_blocks, n_parts, False), searched=first.searched)

    return _fewest_parts(divide, first, memory_limit, fixed=parts != "auto")


def _fewest_parts(plan: Callable[[int], Plan], first: Plan, memory_limit: int, *, fixed: bool) -> Plan:
    """The plan with the fewest range sub-blocks that fit a worker's memory."""
    divided, room = first, MEMORY_SHARE * memory_limit
    least = max(divided.recovery_memory, PROCESS_MEMORY)
    if room <= least:
        raise InputError(
            f"memory limit {memory_limit / MIB:.0f} MiB a worker is too low: recovery needs about "
            f"{math.ceil(least / MEMORY_SHARE / MIB)} MiB, however blocks are divided; raise --memory-limit, "
            "or take fewer workers"
        )
    needed = [divided.memory]
    while divided.memory > room:
        if fixed or divided.parts == MAX_PARTS:
            break
        share = (divided.memory - PROCESS_MEMORY) / (room - PROCESS_MEMORY)
        divided = plan(min(max(divided.parts + 1, math.ceil(0.9 * divided.parts * share)), MAX_PARTS))
        needed.append(divided.memory)
        if len(needed) > 2 and needed[-1] > 0.97 * needed[-2]:
            break
    if divided.memory > room:
        raise InputError(
            f"memory limit {memory_limit / MIB:.0f} MiB a worker is too low: {divided.n_blocks} x {divided.parts} "
            f"blocks by angle and range need about {math.ceil(min(needed) / MEMORY_SHARE / MIB)} MiB; raise "
            "--memory-limit, ask for more --blocks, or image a smaller grid"
        )
    return divided


@dataclass(frozen=True, kw_only=True, eq=False)
class _Planner:
    """Plans of one collection for any division of it.

    Attributes
    ----------
    gated : Gated
        The beam that the dwell gate follows; where it stays, one that lights everything.
    stays : bool
        From `planning.staying`.
    planned : dict
        The blocks by (blocks, sub-blocks, index): a plan after its probe plans the rest, and none is planned twice.
    """

    geometry: Geometry
    gated: Gated
    stays: bool
    region: Region
    recovery: Recovery
    grid: Grid
    extent: Extent
    method: Method
    fidelity: float
    weighting: Weighting
    edges: Edges
    planned: dict[tuple[int, int, int], list[BlockPlan]] = field(default_factory=dict)

    @cached_property
    def summed(self) -> Geometry:
        """Under the beam that gates follow."""
        return self.gated.over(self.geometry)

    def plan(self, count: int, n_parts: int, probe: bool) -> Plan:
        """Plan all blocks that the grid touches; a probe plans only the outermost ones and the one in the middle."""
        seams, touched = self._touched(count, probe)
        planned: list[BlockPlan] = []
        for index in touched:
            # Narrow blocks are of one kind: each takes what the one before it chose, if that serves.
            like = planned[-1].choice if planned and count > MAX_BLOCKS else None
            planned += self._plan_index(seams, index, n_parts, like)
        if not planned and probe:  # what it would tell of is not lit
            return self.plan(count, n_parts, False)
        if not planned:
            raise OutsideSwath(f"none of {count} blocks has a lit point of the grid; give it a finer step, or move it")
        return Plan(
            geometry=self.geometry, grid=self.grid, region=self.region, recovery=self.recovery, seams=seams,
            parts=n_parts, blocks=tuple(planned), method=self.method, fidelity=self.fidelity,
            weighting=self.weighting, fade=self.edges.fade, stays=self.stays, gated=self.gated,
            refusal=find_refusal(planned, self.method, self.gated),
        )  # fmt: skip

    def exceeds(self, count: int, n_parts: int, limit: float) -> bool:
        """Whether a block of a probe exceeds the fidelity by more than a limit; none is planned after the first one.

        It begins with the block in the middle, which has the most ground.
        """
        seams, touched = self._touched(count, probe=True)
        middle = len(touched) // 2
        touched = touched[middle : middle + 1] + touched[:middle] + touched[middle + 1 :]
        planned = chain.from_iterable(self._plan_index(seams, index, n_parts, None) for index in touched)
        return any(block.prediction.excess(self.fidelity) > limit for block in planned)

    def _touched(self, count: int, probe: bool) -> tuple[FloatArray, list[int]]:
        """The seams of so many blocks, rad, and the indices of those that the grid touches, for a probe of some."""
        seams = block_seams(self.geometry, self.region, count)
        touched = [i for i in range(count) if seams[i + 1] > self.extent.low and seams[i] <= self.extent.high]
        if probe and touched:
            touched = sorted({touched[0], touched[len(touched) // 2], touched[-1]})
        return seams, touched

    def _plan_index(self, seams: FloatArray, index: int, n_parts: int, neighbour: Choice | None) -> list[BlockPlan]:
        """The range sub-blocks of one of the blocks between seams, which is planned once."""
        key = seams.size - 1, n_parts, index
        if key not in self.planned:
            low, high = float(seams[index]), float(seams[index + 1])
            self.planned[key] = self._plan_angle(index, low, high, n_parts, neighbour)
        return self.planned[key]

    def _plan_angle(
        self, index: int, low: float, high: float, n_parts: int, neighbour: Choice | None
    ) -> list[BlockPlan]:
        """The range sub-blocks of one block; none where the grid has no point, or nothing is lit."""
        near, far = self.region.limits(low, high)
        near, far = max(near, self.extent.near), min(far, self.extent.far)
        # At each yaw ranges are those of the range window, which slants over a wide block: rows go on periodically.
        windows = WHOLE_WINDOWS if n_parts == 1 else PART_WINDOWS * n_parts
        excess = max((far - near) - windows * self.geometry.collection.range_window, 0.0)
        near, far = near + excess / 2, far - excess / 2
        if far < near:
            return []
        # The nine ranges of the fit need some distance between them for meaningful polynomials.
        least = 64 * SPEED_OF_LIGHT / (2 * self.geometry.collection.bandwidth)
        room = max(least - (far - near), 0.0) / 2
        above = self.geometry.epoch_position[2] - self.geometry.collection.ground_height
        edges = np.linspace(max(near - room, (near + above) / 2), far + room, n_parts + 1)
        parts: list[BlockPlan] = []
        for part, (nearest, farthest) in enumerate(pairwise(edges.tolist())):
            relief = self._relief(low, high, nearest, farthest)
            summed, lit = self.summed, self.geometry
            if relief is not None:
                summed, lit = (each.over(None, relief.smooth) for each in (summed, lit))
            sector = Sector(
                geometry=summed, recovery=self.recovery, region=self.region, low=low, high=high, near=nearest,
                far=farthest, weighting=self.weighting, fidelity=self.fidelity, relief=relief,
                tap_error=image_tap_error(self.fidelity), fade=self.edges.fade, gate_parts=self.edges.parts,
                staying=self.geometry if self.stays else None, taper_loss=self.gated.taper_loss,
                wobbling=lit if self.gated.wobbles else None, imaged=(self.extent.low, self.extent.high),
            )  # fmt: skip
            like = parts[-1].choice if parts else neighbour
            number = part if n_parts > 1 else None
            with suppress(OutsideSwath):
                parts.append(plan_block(sector, self.method, index=index, part=number, neighbour=like))
        return parts

    def _relief(self, low: float, high: float, near: float, far: float) -> Relief | None:
        """The relief of a block; None on the plane."""
        if self.geometry.terrain is None:
            return None
        along, level = ground_range(self.geometry, near, far), self.geometry.collection.ground_height
        return find_relief(self._samples, low=low, high=high, along=along, level=level)

    @cached_property
    def _samples(self) -> Samples:
        return sample_terrain(self.geometry, *((float(at[0]), float(at[-1])) for at in (self.grid.x, self.grid.y)))
