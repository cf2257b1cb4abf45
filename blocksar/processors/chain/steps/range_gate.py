"""The range gate of a range sub-block, and one transform to delay for the gates of all sub-blocks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from blocksar.arrays import FloatArray, IntArray
from blocksar.kernels.fourier import Axis
from blocksar.kernels.operations import Cut, Operation, Transform, Turn, Window
from blocksar.kernels.phase import Phase
from blocksar.kernels.rows import Program
from blocksar.processors.chain.steps.lines import Line
from blocksar.processors.chain.steps.step import Step


@dataclass(frozen=True, kw_only=True, eq=False)
class RangeGate(Step):
    """Keep some ranges of a block's slab, on fewer range frequencies, for a range sub-block.

    At each Doppler bin the targets of a sub-block lie in an interval of range, whose centre moves along Doppler with
    their range walk. Range frequency is transformed to delay, delays beyond the gate are dropped, and the rest is
    transformed back to range frequency in coarser steps. All gates of a collection have the same
    delays, whole multiples of `gate.step`: a Doppler bin is transformed once for all of them.

    What is cut off in delay smears the spectrum, so that its sharp ends reach beyond the band, by about the inverse of
    the window's ramps. The gate keeps range frequencies beyond the band, with a weight that falls smoothly to zero. A
    pixel sums the samples of a pulse at all delays, under a kernel that is the transform of these weights: it falls off
    fast, and the gate cuts nothing of it, while the sum is that over the band. Without them the kernel would fall off
    as the inverse of the delay, as side lobes of the band's sharp ends do; -29 dB would be lost at the gate's ends.

    Attributes
    ----------
    slab : Axis
        Doppler bins, Hz.
    centre : (slab.size,) int
        Delay of the gate's centre from the range origin at each bin, in steps of `gate`.
    gate : Axis
        Delays from the centre within the gate, s: whole multiples of the step.
    window : (gate.size,) float
        1 inside, falling to 0 at the ends.
    full, range_frequency : Axis
        Range frequencies before and after the gate, Hz.
    taper : (range_frequency.size,) float
        1 in the band, falling to 0 beyond it.
    """

    name = "range-gate"
    layout = "columns"
    slab: Axis
    centre: IntArray
    gate: Axis
    window: FloatArray
    full: Axis
    range_frequency: Axis
    taper: FloatArray

    @property
    def source(self) -> Axis:
        return self.full

    @property
    def n_row(self) -> int:
        return self.slab.size

    def within(self, first: int, last: int) -> Self:
        """The gate at the bins first .. last - 1 of the slab."""
        return replace(self, slab=self.slab.part(first, last - first), centre=self.centre[first:last])

    @property
    def to_delay(self) -> Transform:
        """Transform from range frequency to all delays; these are periodic, so that a gate may wrap."""
        period = round(1 / (self.full.step * self.gate.step))
        return Transform(Axis(0.0, self.full.step, self.full.size), Axis(0.0, self.gate.step, period), inverse=True)

    @cached_property
    def from_delay(self) -> Program:
        """Program from rows of all delays to rows of range_frequency.size range frequencies, one per Doppler bin."""
        return Program(self._from_delay(), source=self.to_delay.target, n_row=self.n_row)

    def _from_delay(self) -> list[Operation]:
        delay = self.gate.step * self.centre
        first = self.centre + round(self.gate.start / self.gate.step)
        start, every = self.full.start, np.zeros(self.n_row, np.intp)
        band = np.stack([start * delay, np.full_like(delay, start)], axis=1)
        return [
            Cut(first, self.gate),
            Turn(Phase(band, 0.0, 1.0)),  # range frequency was counted from the start of the band
            Window(self.window[None].astype(np.complex64), every),
            Transform(self.gate, self.range_frequency, inverse=False),
            Window(self.taper[None].astype(np.complex64), every),
            Turn(Phase(np.stack([np.zeros_like(delay), -delay], axis=1), 0.0, 1.0)),
        ]

    def operations(self) -> list[Operation]:
        """Rows of full.size to rows of range_frequency.size range frequencies, one per Doppler bin."""
        return [self.to_delay, *self._from_delay()]

    def trace(self, line: Line) -> Line:
        return line
