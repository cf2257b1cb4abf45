"""The plan of a collection: everything that focusing needs, from metadata alone. No sample is read.

A plan holds the blocks with their Doppler supports, margins, padding and coefficients; where every target focuses and
with which phase; predicted residual phase, side lobes, width and range migration; and the memory of the tasks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.chunks import (
    CHUNK_SAMPLES,
    COLUMN_CHUNK,
    DOPPLER_GROUP,
    GATE_BYTES,
    SIGNAL_BYTES,
    SIGNAL_COLUMNS,
    SPECTRUM_BYTES,
)
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.collection.region import Region
from blocksar.collection.weighting import Weighting
from blocksar.imaging.method import Method
from blocksar.kernels.operations import Blend, Resample, Stretch, Transform
from blocksar.planning.memory import PROCESS_MEMORY
from blocksar.processors.chain.planning.block import BlockPlan
from blocksar.processors.chain.planning.worker_memory import gating_memory, thread_memory
from blocksar.processors.chain.steps.range_gate import RangeGate
from blocksar.processors.chain.steps.recovery import Recovery
from blocksar.texts import size_text


@dataclass(frozen=True)
class Transforms:
    """Number of FFTs of one length in a stage."""

    stage: str
    count: int
    length: int


def block_work(block: BlockPlan) -> float:
    """Floating-point operations of the transforms and resamplings of a block's own steps."""
    total = 0.0
    for step in chain.from_iterable(stage.steps for stage in block.stages):
        for operation in step.operations():
            if isinstance(operation, Transform):
                total += step.n_row * fft_work(operation.period)
            elif isinstance(operation, Blend):
                total += operation.count * step.n_row * fft_work(operation.transform.period)
            elif isinstance(operation, Stretch | Resample):
                total += step.n_row * 4 * step.source.size * operation.taps.shape[1]
    return total


def fft_work(length: int) -> float:
    """Floating-point operations of one FFT."""
    return 5 * length * math.log2(length)


LOOKED_AT = 64  # points along a side of a grid at which full dwells are looked for


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """Plan of a collection: everything that the tasks need, and the expected quality.

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
    away : float
        From `processors.chain.dwells.steadiness`: angle between the beam and the smoothed one that dwell gates follow,
        rad; 0: none.
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
    refusal: str | None
    away: float = 0.0
    searched: bool = False

    def __repr__(self) -> str:
        return f"<Plan: {self.headline()}>"

    def headline(self) -> str:
        """Summary of the plan on one line: blocks, predicted coherence, memory."""
        if self.refusal is not None:
            return f"refused: {self.refusal}"
        divided = f" of {self.parts} range sub-blocks" if self.parts > 1 else ""
        noun = "block" if self.n_blocks == 1 else "blocks"
        return (
            f"{self.n_blocks} {noun}{divided} by {self.method.processor}, {self.grid.shape[1]} x {self.grid.shape[0]} "
            f"pixels, predicted coherence at least {self.coherence:.6f}, {size_text(self.memory)} for each worker"
        )

    @property
    def n_blocks(self) -> int:
        return self.seams.size - 1

    def numbered(self, first: int) -> Plan:
        """Copy with its blocks numbered from `first` on, after those of other segments."""
        return replace(self, blocks=tuple(replace(block, index=first + block.index) for block in self.blocks))

    @cached_property
    def full_dwell_share(self) -> float:
        """Share of the grid's points with full dwell, for which the predicted coherence holds."""
        x, y = (axis[:: math.ceil(axis.size / LOOKED_AT)] for axis in (self.grid.x, self.grid.y))
        return float(np.mean(self.geometry.beam.has_full_dwell(x, y[:, None])))

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
        """Number of Doppler bins gated in range at a time: a whole fraction of a spectrum chunk."""
        height = self.spectrum_chunk[0]
        return height // math.ceil(height / DOPPLER_GROUP)

    def gated_bins(self, block: BlockPlan) -> tuple[int, int]:
        """First and last Doppler bin (exclusive) of a sub-block's gated spectrum: its slab, in whole groups."""
        group, n_bin = self.gate_group, self.recovery.doppler.size
        last = block.first_bin + block.n_bin
        return block.first_bin - block.first_bin % group, min(math.ceil(last / group) * group, n_bin)

    def gated_chunk(self, block: BlockPlan) -> tuple[int, int]:
        """Shape of a chunk of a sub-block's gated spectrum: Doppler bins, range frequencies."""
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
        """Peak memory of a worker of one thread, bytes."""
        return max(self.recovery_memory, self.gating_memory, *(block.memory for block in self.blocks))

    def memory_of(self, threads: int) -> int:
        """Peak memory of a worker of so many threads, bytes."""
        longest = max(max(block.sampling.long_time.size, block.sampling.range_period) for block in self.blocks)
        return self.memory + (threads - 1) * thread_memory(longest)

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
        """Least predicted coherence with exact back-projection of any block."""
        return min(block.prediction.coherence for block in self.blocks)

    @property
    def blends(self) -> bool:
        """Tell whether windows for dwells of several lengths are blended."""
        gates = [block.sampling.gate for block in self.blocks]
        return any(gate is not None and gate.taper is not None for gate in gates)

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
        """Transforms of the range gates: each Doppler bin once to delay, and from there for each sub-block."""
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

    def gated_samples(self) -> int:
        """Samples that the range gates write."""
        return sum(each.count * each.length for each in self._gate_transforms()[1:])

    def work(self) -> float:
        """Floating-point operations of all transforms and resamplings of the blocks."""
        return self.gate_work() + sum(map(block_work, self.blocks))

    def excess(self) -> float:
        """Largest excess of any block over the limits of the fidelity; see `Prediction.excess`."""
        return max(block.prediction.excess(self.fidelity) for block in self.blocks)

    @property
    def faithful(self) -> bool:
        """Tell whether all blocks keep the fidelity, including its limit on side lobes."""
        return self.excess() <= 1.0


def _even(n: int, most: int) -> int:
    """Size of the fewest equal parts of n with at most `most` each."""
    return math.ceil(n / math.ceil(n / most))
