"""What a step of a chain is, and how steps that follow each other along the same rows run as one."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from itertools import groupby

from blocksar.arrays import ComplexArray
from blocksar.focusing.lines import Line
from blocksar.kernels.fourier import Axis
from blocksar.kernels.operations import Operation
from blocksar.kernels.rows import Layout, Program


class Step:
    """One step of a chain: samples to samples, lines to lines, constants bound while planning.

    Attributes
    ----------
    name : str
    layout : {"rows", "columns"}
        Which way of the block the step's own rows lie: along slow time and Doppler, or along range.
    """

    name: str
    layout: Layout = "rows"

    @property
    def source(self) -> Axis:
        """Of a row that goes in."""
        raise NotImplementedError

    @property
    def n_row(self) -> int:
        raise NotImplementedError

    def operations(self) -> list[Operation]:
        """What the step does along its rows, in order."""
        raise NotImplementedError

    def trace(self, line: Line) -> Line:
        """What it does to the lines of targets."""
        raise NotImplementedError

    def apply(self, block: ComplexArray, *, threads: int = 1) -> ComplexArray:
        """What it does to the samples of a block, range (or range frequency) by slow time (or Doppler)."""
        return Stage((self,)).apply(block, threads=threads)


class Stage:
    """Consecutive steps along the same rows, run together: no block of samples is made between them."""

    def __init__(self, steps: tuple[Step, ...]) -> None:
        self.steps = steps
        self.layout: Layout = steps[0].layout

    @property
    def name(self) -> str:
        return "+".join(step.name for step in self.steps)

    @cached_property
    def program(self) -> Program:
        operations = [operation for step in self.steps for operation in step.operations()]
        return Program(operations, source=self.steps[0].source, n_row=self.steps[0].n_row)

    def apply(self, block: ComplexArray, *, threads: int = 1) -> ComplexArray:
        return self.program.run(block, load=self.layout, store=self.layout, threads=threads)


def stages(chain: Sequence[Step]) -> list[Stage]:
    """A chain in as few passes over the block as its steps' layouts allow."""
    return [Stage(tuple(steps)) for _, steps in groupby(chain, key=lambda step: step.layout)]
