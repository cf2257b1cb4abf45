"""A block's chain in three frozen stages: range part, azimuth part, sampled chain. Each traces lines further.

    RangePart    steps up to range compression, bound to the block's own lines
    AzimuthPart  steps after it, bound to fitted or closed-form polynomials
    sampled      all steps with the sampling that the traced lines need: they can be applied

Lines do not depend on how time, Doppler and range are sampled, so they pass through the parts before the sampling is
planned. Steps bind their own constants (`Step.bind`), and declare what divides the chain.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.collection.weighting import AxisTaper
from blocksar.focusing.chains import Steps
from blocksar.focusing.lines import AzimuthPolynomials, Line
from blocksar.focusing.sampling import Sampling
from blocksar.focusing.step import Constants, Step, trace
from blocksar.kernels.fourier import Axis
from blocksar.planning.fitting import Freedom


class Slab(NamedTuple):
    """A block's part of the recovered spectrum."""

    first_bin: int
    doppler: Axis
    walk: float  # middle of the block's Doppler, Hz on the carrier
    margin: float  # Hz
    band_edge: float  # largest range frequency over the carrier


@dataclass(frozen=True, kw_only=True, eq=False)
class RangePart:
    """The steps up to range compression.

    Attributes
    ----------
    constants : Constants
    steps : tuple of Step
        The last one is the range compression, or the motion compensation that follows it.
    azimuth_kinds : tuple of type
        The kinds of steps that follow, in order.
    """

    constants: Constants
    steps: tuple[Step, ...]
    azimuth_kinds: Steps

    @classmethod
    def bind(cls, kinds: Steps, constants: Constants, line: Line) -> RangePart:
        """Bind the kinds up to range compression; `line` holds the block's lines in the recovered signal."""
        last = max(i for i, kind in enumerate(kinds) if kind.ends_range_part)
        steps: tuple[Step, ...] = ()
        for kind in kinds[: last + 1]:
            steps += (kind.bind(constants, partial(trace, steps, line)),)
        return cls(constants=constants, steps=steps, azimuth_kinds=kinds[last + 1 :])

    def trace(self, line: Line) -> Line:
        """Lines after range compression, from those in the recovered signal."""
        return trace(self.steps, line)

    @property
    def compression(self) -> Step:
        """The range compression."""
        return next(step for step in self.steps if step.compresses)

    @property
    def scales_time_about(self) -> float | None:
        """Time about which a keystone scales slow time with range frequency, s; None without one."""
        return next((about for step in self.steps if (about := step.scales_time_about) is not None), None)

    @property
    def freedom(self) -> Freedom:
        """The fitted polynomials that the steps after range compression need."""
        fitted = {kind.fitted for kind in self.azimuth_kinds}
        return Freedom("time" in fitted, "doppler" in fitted, "resampling" in fitted)


class Traced(NamedTuple):
    """Lines along the steps after range compression."""

    biased: Line  # before the transform to Doppler
    before_deramp: list[Line]  # after each step up to the deramp
    focused: Line  # after the last step


@dataclass(frozen=True, kw_only=True, eq=False)
class AzimuthPart:
    """The steps after range compression.

    Attributes
    ----------
    range_part : RangePart
    polynomials : AzimuthPolynomials
    steps : tuple of Step
    """

    range_part: RangePart
    polynomials: AzimuthPolynomials
    steps: tuple[Step, ...]

    @classmethod
    def bind(cls, range_part: RangePart, polynomials: AzimuthPolynomials, line: Line) -> AzimuthPart:
        """Bind the steps that follow a range part; `line` holds the block's lines after range compression."""
        constants = replace(range_part.constants, polynomials=polynomials)
        steps: tuple[Step, ...] = ()
        for kind in range_part.azimuth_kinds:
            steps += (kind.bind(constants, partial(trace, steps, line)),)
        return cls(range_part=range_part, polynomials=polynomials, steps=steps)

    def trace(self, line: Line) -> Traced:
        """Lines along the steps, from those after range compression."""
        biased, before = line, []
        for step in self.steps:
            if step.fitted == "deramp":
                break
            line = step.trace(line)
            before.append(line)
            if step.fitted == "time":
                biased = line
        return Traced(biased, before, trace(self.steps[len(before) :], line))

    def turns(self, line: Line) -> FloatArray:
        """By how much all steps turn phases from row to row, cycles/m, along lines after range compression."""
        total = np.zeros(line.time.shape)
        for step in self.steps:
            total = total + step.turns(line)
            line = step.trace(line)
        return total

    def weighed(self, in_time: AxisTaper) -> AzimuthPart:
        """The same steps under another taper over the pulses."""
        steps = tuple(s.weighed(in_time) for s in self.range_part.steps)
        return replace(self, range_part=replace(self.range_part, steps=steps))

    def sampled(self, sampling: Sampling) -> tuple[Step, ...]:
        """The whole chain, ready to be applied."""
        return tuple(step.sampled(sampling) for step in (*self.range_part.steps, *self.steps))
