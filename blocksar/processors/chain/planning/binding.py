"""Binding of a block's steps in three stages, each of which traces lines further.

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
from numpy.polynomial import chebyshev

from blocksar import solvers
from blocksar.arrays import FloatArray
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import AxisTaper
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.kernels.fourier import Axis
from blocksar.processors.chain.planning.fitting import FittedSteps
from blocksar.processors.chain.steps.chains import Steps
from blocksar.processors.chain.steps.lines import AzimuthPolynomials, Line
from blocksar.processors.chain.steps.step import Constants, Motion, Sampling, Step, trace

TIMES_PER_INTERVAL = 8  # times per interval of the track's spline: linear between them, its bend errs by 0.4 %
RANGE_NODES = 4  # of the Chebyshev series of the line of sight in range


def plan_motion(
    geometry: Geometry, *, near: float, far: float, origin: float, low: float, high: float
) -> Motion | None:
    """Phase of the track's wobble for epoch ranges near .. far, m, and yaws low .. high, rad; None without one."""
    wobble = geometry.track.wobble
    if wobble is None:
        return None
    collection = geometry.collection
    n = TIMES_PER_INTERVAL * wobble.n_interval + 1
    time = np.linspace(collection.time[0], collection.time[-1], n)
    nodes = chebyshev.chebpts1(RANGE_NODES)
    ranges = (near + far) / 2 + (far - near) / 2 * nodes
    beam = geometry.beam.centre_yaw(time, ranges, low, high)
    point, step = geometry.ground_point(ranges[:, None], beam), float(time[1] - time[0])

    def sight(at: FloatArray) -> FloatArray:
        """Unit vectors (n_range, n, 3) at times (n,) to the points in the beam's centre at `time`."""
        away = point - geometry.track.base.position(at)
        return np.asarray(away / np.sqrt((away * away).sum(axis=-1, keepdims=True)))

    def series(lengths: FloatArray) -> FloatArray:
        """Chebyshev series in range (n, n_term) of the phase -2 fc / c lengths (n_range, n, 3), axes summed."""
        cycles = -2 * collection.carrier / SPEED_OF_LIGHT * lengths.sum(axis=-1)
        return np.ascontiguousarray(solvers.chebyshev_series(nodes, cycles, RANGE_NODES - 1).T)

    before, now, after = (sight(time + offset) for offset in (-step, 0.0, step))
    turn, bend = (after - before) / (2 * step), (after - 2 * now + before) / step**2
    shift, rate, pull = (wobble(time, derivative) for derivative in range(3))
    return Motion.integrate(
        series(pull * now + 2 * rate * turn + shift * bend),
        series(shift * now),
        start=float(time[0]) - geometry.epoch,
        step=step,
        near=near - origin,
        far=far - origin,
    )


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
    def freedom(self) -> FittedSteps:
        """Kinds of polynomials to fit in the steps after range compression."""
        fitted = {kind.fitted for kind in self.azimuth_kinds}
        return FittedSteps("time" in fitted, "doppler" in fitted, "resampling" in fitted)


class Traced(NamedTuple):
    """Lines at several stages after range compression."""

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
        """Change of phase from row to row by all steps, cycles/m, along lines after range compression."""
        total = np.zeros(line.time.shape)
        for step in self.steps:
            total = total + step.turns(line)
            line = step.trace(line)
        return total

    def weighed(self, in_time: AxisTaper) -> AzimuthPart:
        """Copy of the steps under another taper over the pulses."""
        part = self.range_part
        steps, constants = tuple(s.weighed(in_time) for s in part.steps), replace(part.constants, in_time=in_time)
        return replace(self, range_part=replace(part, steps=steps, constants=constants))

    def sampled(self, sampling: Sampling) -> tuple[Step, ...]:
        """Return the whole chain with its sampling."""
        return tuple(step.sampled(sampling) for step in (*self.range_part.steps, *self.steps))
