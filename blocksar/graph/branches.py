"""The task that focuses a block whose dwell gate has several parts over the band: their images add up."""

from __future__ import annotations

import numpy as np

from blocksar.arrays import ComplexArray
from blocksar.graph.tasks import Samples, naming_failures, run_stage
from blocksar.kernels import buffers
from blocksar.planning.block import BlockPlan
from blocksar.runs.receipts import Run


@naming_failures(lambda run, block, *_: f"focusing of block {block.name}")
def run_branches(run: Run, block: BlockPlan, samples: Samples) -> Samples:
    """Run all that follows a block's first stage, once for each part of the gate, and add up the images."""
    values, seconds = samples.take(), samples.seconds
    total: ComplexArray | None = None
    branches = block.branches
    for number, stages in enumerate(branches):
        last = number == len(branches) - 1
        part = Samples(values if last else _copied(values), {})
        for stage in stages:
            part = run_stage(run, block, stage, part)
        seconds = {name: seconds.get(name, 0.0) + part.seconds.get(name, 0.0) for name in {**seconds, **part.seconds}}
        image = part.take()[: block.ground.rows.size, : block.ground.doppler.size]  # what is beyond is not defined
        total = image if total is None else np.add(total, image, out=total)
    return Samples(total, seconds)


def _copied(values: ComplexArray) -> ComplexArray:
    copy = buffers.empty(values.shape)
    np.copyto(copy, values)
    return copy
