"""The tasks that run the stages of a block on its samples."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from blocksar.arrays import ComplexArray
from blocksar.errors import ProcessingError
from blocksar.planning.tiling import chunk_spans
from blocksar.processors.chain.planning.block import BlockPlan
from blocksar.processors.chain.steps.step import Stage
from blocksar.processors.chain.tasks.spectrum import SpectrumChunks, read_ahead
from blocksar.runs.receipts import Run


@dataclass
class BlockSamples:
    """Samples of a block between two tasks, and the seconds of each step so far."""

    values: ComplexArray | None
    seconds: dict[str, float]

    def take(self) -> ComplexArray:
        """Hand over the array for in-place work, in the shape that the previous stage left; a second call fails.

        Raises
        ------
        ProcessingError
            If the array was handed over before.
        """
        values, self.values = self.values, None
        if values is None:
            raise ProcessingError("the samples of a block were used by two tasks")
        # An array that was sent by another worker is read-only.
        return values if values.flags.writeable else values.copy()


def read_slab(run: Run, unit: str, block: BlockPlan, stage: Stage, spectrum: SpectrumChunks) -> BlockSamples:
    """Run the first stage of a block, reading its part of the spectrum by chunks of columns."""
    started, reading = time.perf_counter(), 0.0
    program, bins = stage.program, slice(block.first_bin, block.first_bin + block.n_bin)
    out = np.empty((block.sampling.n_buffer_row, program.target.size), np.complex64)
    parts = [(bins, slice(a, b)) for a, b in chunk_spans(0, program.n_row, spectrum.chunk[1])]
    for region, part, waited in read_ahead(spectrum, parts):
        reading += waited
        program.run(part, out=out, first=region[1].start, load="columns", threads=run.threads)
    return BlockSamples(out, {"read-slab": reading, stage.name: time.perf_counter() - started - reading})


def run_stage(run: Run, unit: str, samples: BlockSamples, block: BlockPlan, stage: Stage) -> BlockSamples:
    """Run a stage on a block, in place if the result fits: no other task uses the input."""
    started = time.perf_counter()
    values, program = samples.take(), stage.program
    if stage.layout == "columns":
        program.run(
            values[: program.source.size], out=values[: program.target.size],
            load="columns", store="columns", threads=run.threads,
        )  # fmt: skip
        result = values
    else:
        out: ComplexArray | None = values if program.target.size <= values.shape[1] else None
        # The later stages need a buffer where rows become longer.
        inner = out is None and stage.steps[-1].name != block.chain[-1].name
        if inner:
            out = np.empty((block.sampling.n_buffer_row, program.target.size), np.complex64)
        result = program.run(values[: program.n_row], out=out, threads=run.threads)
    return BlockSamples(result, samples.seconds | {stage.name: time.perf_counter() - started})
