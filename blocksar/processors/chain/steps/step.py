"""Steps of a chain, and stages: consecutive steps along the same rows that run as one pass.

A step is bound in two stages and frozen after each. `bind` gives it the constants of a block: now it can trace lines.
`sampled` adds the sampling, which lines do not need and which is planned from them: now it can be applied to samples.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby
from typing import ClassVar, Literal, Self

import numpy as np
from numpy.polynomial import chebyshev

from blocksar.arrays import ComplexArray, FloatArray, unrepeated
from blocksar.collection.weighting import AxisTaper
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.kernels import fourier
from blocksar.kernels.fourier import Axis
from blocksar.kernels.operations import Operation
from blocksar.kernels.rows import Layout, Program
from blocksar.processors.chain.steps.dwell_gate import DwellGate
from blocksar.processors.chain.steps.lines import AzimuthPolynomials, Line


@dataclass(frozen=True, kw_only=True, eq=False)
class Sampling:
    """Axes of a block's samples from slab to focused block, and their occupancy.

    Attributes
    ----------
    slab : Axis
        Doppler of the block's part of the recovered spectrum, Hz.
    range_frequency : Axis
        Hz.
    time : Axis
        Slow time from the epoch in which the block's targets are lit, s.
    time_occupancy : float
        Fraction of the sampling rate of `time` that the block's Doppler fills.
    doppler : Axis
        Absolute Doppler of the steps between the transforms, Hz.
    long_time : Axis
        Slow time, extended for the delays of the steps in Doppler, s.
    doppler_occupancy : float
        Fraction of the extended time that samples fill, and so of the sampling of `doppler`.
    rows : Axis
        Ranges less the range origin, m.
    range_occupancy : float
        Fraction of the sampling rate of `rows` that responses fill.
    focused_doppler : Axis
        Doppler of the final transform, Hz.
    gate : DwellGate or None
        None where all targets are lit at the same time.
    summed : (float, float) or None
        First and last slow time that the final transform sums, s; None: all of `long_time`.
    """

    slab: Axis
    range_frequency: Axis
    time: Axis
    time_occupancy: float
    doppler: Axis
    long_time: Axis
    doppler_occupancy: float
    rows: Axis
    range_occupancy: float
    focused_doppler: Axis
    gate: DwellGate | None
    summed: tuple[float, float] | None = None

    @property
    def range_period(self) -> int:
        """Length of the range transform."""
        return round(SPEED_OF_LIGHT / (2 * self.range_frequency.step * self.rows.step))

    @property
    def image_doppler(self) -> Axis:
        """Doppler of the focused block, Hz: coarser than that of the final transform where there is a gate."""
        if self.gate is None:
            return self.focused_doppler
        return fourier.dual(self.long_time, size=self.gate.time.size, centre=self.focused_doppler.centre)

    @property
    def n_buffer_row(self) -> int:
        """Number of rows of a buffer that holds the block at every stage after its slab."""
        return max(self.range_frequency.size, self.rows.size)


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """The phase psi of motion compensation: a Chebyshev series in range of functions of slow time.

    The second derivatives are linear between uniform times, so that value and slope follow exactly.

    Attributes
    ----------
    start, step : float
        Slow time from the epoch, s.
    value, slope, bend : (n, n_term) float
        psi_k (cycles), psi_k' (Hz) and psi_k'' (Hz/s) at those times.
    near, far : float
        Domain of range, m from the origin.
    """

    start: float
    step: float
    value: FloatArray
    slope: FloatArray
    bend: FloatArray
    near: float
    far: float

    @classmethod
    def integrate(
        cls, bend: FloatArray, like: FloatArray, *, start: float, step: float, near: float, far: float
    ) -> Self:
        """Integrate second derivatives (n, n_term), with constant and slope that make the values `like` on average."""
        half_step = step / 2
        slope = np.zeros_like(bend)
        slope[1:] = np.cumsum(half_step * (bend[1:] + bend[:-1]), axis=0)
        value = np.zeros_like(bend)
        value[1:] = np.cumsum(step * slope[:-1] + step**2 / 6 * (2 * bend[:-1] + bend[1:]), axis=0)
        time = step * (np.arange(bend.shape[0]) - (bend.shape[0] - 1) / 2)
        apart = like - value
        mean = apart.mean(axis=0)
        tilt = (apart * time[:, None]).sum(axis=0) / (time * time).sum()
        return cls(
            start=start, step=step, value=value + mean + tilt * time[:, None], slope=slope + tilt, bend=bend,
            near=near, far=far,
        )  # fmt: skip

    @property
    def n_term(self) -> int:
        return self.value.shape[1]

    def terms(self, time: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """psi_k and its first two derivatives, (..., n_term), at slow times of any shape.

        Axes along which the times are repeated (`np.broadcast_to`) have length 1 in the result.
        """
        time = unrepeated(time)
        position = (time - self.start) / self.step
        i = np.clip(np.floor(position), 0, self.value.shape[0] - 2).astype(np.int64)
        t = ((position - i) * self.step)[..., None]
        value, slope, bend = self.value[i], self.slope[i], self.bend[i]
        twist = (self.bend[i + 1] - bend) / self.step
        return (
            value + t * (slope + t * (bend / 2 + t * twist / 6)),
            slope + t * (bend + t * twist / 2),
            bend + t * twist,
        )

    @cached_property
    def at_middle(self) -> Motion:
        """psi of the middle range alone: one term, with the factor 1."""
        sums = ((values * self.middle).sum(axis=1, keepdims=True) for values in (self.value, self.slope, self.bend))
        value, slope, bend = sums
        return replace(self, value=value, slope=slope, bend=bend)

    def factors(self, rng: FloatArray) -> FloatArray:
        """Factors (..., n_term) of each psi_k at ranges (...)."""
        u = (2 * rng - self.near - self.far) / (self.far - self.near)
        return np.asarray(chebyshev.chebvander(u, self.n_term - 1), np.float64).reshape(*np.shape(rng), self.n_term)

    @property
    def middle(self) -> FloatArray:
        """The factors at the middle range, (n_term,)."""
        return self.factors(np.array((self.near + self.far) / 2))


@dataclass(frozen=True, kw_only=True, eq=False)
class Constants:
    """Constants of a block that its steps bind.

    Attributes
    ----------
    carrier : float
        Hz.
    walk : float
        Doppler of the block's middle, Hz on the carrier.
    reference : (n,) float
        k_0 .. k_(n-1) of the range history of the block's centre about the epoch, m/s^n, less the common range that
        recovery removes.
    middle : float
        Middle of the time in which the block's targets are lit, s from the epoch: the keystone scales time about it.
    motion : Motion or None
        What motion compensation removes; None for a polynomial track, whose chain has no such step.
    in_range : AxisTaper or None
        Weighting over range frequency, Hz; None where it is uniform.
    in_time : AxisTaper or None
        Weighting over the pulses of a beam that is not steered, s from the epoch; None where it is uniform.
    polynomials : AzimuthPolynomials or None
        Coefficients of the steps after range compression; None for the steps before, on which they depend.
    """

    carrier: float
    walk: float
    reference: FloatArray
    middle: float = 0.0
    motion: Motion | None = None
    in_range: AxisTaper | None = None
    in_time: AxisTaper | None = None
    polynomials: AzimuthPolynomials | None = None

    @property
    def measured(self) -> Motion:
        """Motion of a measured track, for steps that compensate it.

        Raises
        ------
        ValueError
            If the track is a polynomial.
        """
        if self.motion is None:
            raise ValueError("a chain with motion compensation needs a measured track; leave the step out")
        return self.motion

    @property
    def azimuth(self) -> AzimuthPolynomials:
        """Coefficients of the azimuth steps, for a step that needs them.

        Raises
        ------
        ValueError
            If a chain has such a step before range compression.
        """
        if self.polynomials is None:
            raise ValueError("a step with fitted coefficients stands before range compression; move it behind")
        return self.polynomials


@dataclass(frozen=True, kw_only=True, eq=False)
class Step:
    """One step of a chain: samples to samples, lines to lines.

    Attributes
    ----------
    name : str
    layout : {"rows", "columns"}
        The direction of the step's rows in the block: along slow time and Doppler, or along range.
    fitted : {"time", "doppler", "resampling", "deramp"} or None
        The fitted polynomial that the step applies.
    ends_range_part : bool
        Whether the steps that planning binds to a block's own lines end with the last such step.
    compresses : bool
        Whether it is the range compression, of which a chain has one.
    in_doppler : bool
        Of the range compression: whether it compresses ranges at each Doppler, otherwise at each slow time.
    scales_time : bool
        Whether it scales time with range frequency.
    lengthens_rows : bool
        Whether rows along range are longer while it runs.
    sampling : Sampling or None
        None before `sampled`: the step can trace lines only.
    """

    name: ClassVar[str]
    layout: ClassVar[Layout] = "rows"
    fitted: ClassVar[Literal["time", "doppler", "resampling", "deramp"] | None] = None
    ends_range_part: ClassVar[bool] = False
    compresses: ClassVar[bool] = False
    in_doppler: ClassVar[bool] = False
    scales_time: ClassVar[bool] = False
    lengthens_rows: ClassVar[bool] = False
    sampling: Sampling | None = None

    @classmethod
    def bind(cls, constants: Constants, arriving: Callable[[], Line]) -> Self:
        """Bind the step to the constants of a block, and to arriving lines.

        Parameters
        ----------
        constants : Constants
        arriving : callable
            Returns the lines of the block's targets, (n_range, n_yaw, n), as they arrive at the step.
        """
        return cls()

    def sampled(self, sampling: Sampling) -> Self:
        """Return the step with the block's sampling, which makes it applicable."""
        return replace(self, sampling=sampling)

    def weighed(self, in_time: AxisTaper) -> Self:
        """Return the step with another taper over the pulses; itself if it applies none."""
        return self

    @property
    def axes(self) -> Sampling:
        """Axes of the block's samples.

        Raises
        ------
        ValueError
            If the step has no sampling yet.
        """
        if self.sampling is None:
            raise ValueError(f"{self.name} has no sampling yet: call sampled() first")
        return self.sampling

    @property
    def scales_time_about(self) -> float | None:
        """Time, s from the epoch, about which the step scales time with range frequency; None if it does not."""
        return None

    @property
    def even(self) -> bool:
        """Tell whether the output of the step can be interpolated over the whole axis."""
        return True

    def turns(self, line: Line) -> FloatArray | float:
        """Change of the phase from row to row along arriving lines, cycles/m."""
        return 0.0

    @property
    def source(self) -> Axis:
        """Axis of an input row."""
        raise NotImplementedError

    @property
    def n_row(self) -> int:
        """Number of rows."""
        raise NotImplementedError

    def operations(self) -> list[Operation]:
        """The operations along the step's rows, in order."""
        raise NotImplementedError

    def trace(self, line: Line) -> Line:
        """Lines of targets after the step."""
        raise NotImplementedError

    def apply(self, block: ComplexArray, *, threads: int = 1) -> ComplexArray:
        """Samples of a block after the step: range (or range frequency) by slow time (or Doppler)."""
        return Stage((self,)).apply(block, threads=threads)


class Stage:
    """Consecutive steps along the same rows, run in one pass over the block."""

    def __init__(self, steps: tuple[Step, ...]) -> None:
        self.steps = steps
        self.layout: Layout = steps[0].layout

    @property
    def name(self) -> str:
        return "+".join(step.name for step in self.steps)

    @cached_property
    def program(self) -> Program:
        """Combine all operations of the steps into one program along rows."""
        operations = [operation for step in self.steps for operation in step.operations()]
        return Program(operations, source=self.steps[0].source, n_row=self.steps[0].n_row)

    def apply(self, block: ComplexArray, *, threads: int = 1) -> ComplexArray:
        """Samples of a block after the steps."""
        return self.program.run(block, load=self.layout, store=self.layout, threads=threads)


def stages(chain: Sequence[Step]) -> list[Stage]:
    """Group the steps of a chain into stages: as few passes over the block as the layouts allow."""
    return [Stage(tuple(steps)) for _, steps in groupby(chain, key=lambda step: step.layout)]


def trace(steps: Sequence[Step], line: Line) -> Line:
    """Trace lines through several steps."""
    for step in steps:
        line = step.trace(line)
    return line
