"""Work of the transforms and resamplings of a plan, in floating-point operations."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import chain

from blocksar.kernels.operations import Blend, Resample, Stretch, Transform
from blocksar.planning.block import BlockPlan


@dataclass(frozen=True)
class Transforms:
    """FFTs of one length in a stage."""

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
    """Of one FFT."""
    return 5 * length * math.log2(length)
