"""The processors as lists of steps; a variant is the same list with a step changed or left out.

    angular-division     paper A: keystone, RCMC, frequency perturbation, deramp
    keystone-resampling  paper B: keystone, RCMC, time perturbation, Doppler resampling, deramp
    high-order-phase     paper C: RCMC in the 2-D frequency domain, frequency perturbation, deramp

Only this module knows the order of steps. Planning binds their constants and traces lines through them, the graph
applies them, and both treat all processors alike.

Motion compensation removes the deviation of a measured track from a polynomial, block by block.

Let e(t) be the wobble of a track, `geometry.Track.wobble`, and u_T the unit vector from the antenna to a target. The
signal of the target then has the additional phase +2 fc / c e(t) . u_T(t), in cycles. Removing e . u_b of the beam's
centre leaves e . (u_T - u_b), which is not small where the beam turns: over a dwell u_b moves by a whole beam width. So
the phase that is removed is the one whose second derivative at each time is that of the target that is in the centre of
the beam then,

    psi''(t) = -2 fc / c [e'' . u + 2 e' . u' + e . u''],    u' and u'' those of a fixed target,

integrated twice: every target then keeps its own line of sight at the middle of its own dwell, to first order. The
constant and the slope that the integration leaves open are chosen so that psi follows -2 fc / c e . u on average. What
remains is traced like every other phase. Where the beam is not steered, the target is the centre of the block, and psi
is -2 fc / c e . u itself.

u also depends on range, through the angle of incidence: psi is a short Chebyshev series in range. Its value at the
middle range is removed in the first place, at all range frequencies, with the range shift that belongs to it; the rest
after range compression, row by row.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.imaging.method import Chain, Method
from blocksar.kernels import fourier
from blocksar.kernels.fourier import Axis
from blocksar.kernels.operations import Operation, ScaledTurn, Transform
from blocksar.processors.chain.steps.azimuth_steps import (
    AzimuthTransform,
    Deramp,
    DopplerResampling,
    DopplerTransform,
    FrequencyPerturbation,
    TimePerturbation,
)
from blocksar.processors.chain.steps.lines import Line
from blocksar.processors.chain.steps.range_steps import (
    DopplerCompression,
    Keystone,
    RangeCompression,
    ResidualRangeWalk,
    TimeDomainCompression,
)
from blocksar.processors.chain.steps.step import Constants, Motion, Step


@dataclass(frozen=True, kw_only=True, eq=False)
class MotionCompensation(Step):
    """Remove psi of the block's middle range: multiply by exp(2j pi (1 + f / fc) psi(t))."""

    name = "motion-compensation"
    motion: Motion
    carrier: float

    @classmethod
    def bind(cls, constants: Constants, arriving: Callable[[], Line]) -> Self:
        return cls(motion=constants.measured, carrier=constants.carrier)

    @property
    def source(self) -> Axis:
        return self.axes.time

    @property
    def n_row(self) -> int:
        return self.axes.range_frequency.size

    def operations(self) -> list[Operation]:
        """Rows of time.size samples, one per range frequency."""
        cycles = self.motion.at_middle.terms(self.axes.time.values)[0][..., 0]
        return [ScaledTurn(1 + self.axes.range_frequency.values / self.carrier, cycles)]

    def trace(self, line: Line) -> Line:
        cycles, rate, curvature = (term[..., 0] for term in self.motion.at_middle.terms(line.time))
        turned = line.multiply_time(cycles, rate, curvature)
        return turned.shift_range(-SPEED_OF_LIGHT / (2 * self.carrier) * cycles)


@dataclass(frozen=True, kw_only=True, eq=False)
class RangeMotionCompensation(Step):
    """Remove the part of psi that differs from range to range, after that of the middle range is gone."""

    name = "range-motion-compensation"
    ends_range_part = True
    motion: Motion

    @classmethod
    def bind(cls, constants: Constants, arriving: Callable[[], Line]) -> Self:
        return cls(motion=constants.measured)

    @property
    def source(self) -> Axis:
        return self.axes.time

    @property
    def n_row(self) -> int:
        return self.axes.rows.size

    def operations(self) -> list[Operation]:
        """Rows of time.size samples, one per range."""
        factors = self._factors(self.axes.rows.values)
        terms = self.motion.terms(self.axes.time.values)[0]
        return _turns(factors, terms)

    def trace(self, line: Line) -> Line:
        factors = self._factors(line.range.mean(axis=-1))[..., None, :]
        terms = self.motion.terms(line.time)
        return line.multiply_time(*(np.einsum("...k,...k->...", term, factors) for term in terms))

    def _factors(self, rng: FloatArray) -> FloatArray:
        return self.motion.factors(rng) - self.motion.middle


@dataclass(frozen=True, kw_only=True, eq=False)
class RangeMotionInFrequency(Step):
    """`RangeMotionCompensation` for a chain without slow time after range compression.

    Each pulse is transformed to range, multiplied, and transformed back. Ranges still migrate here: a target that
    migrates by m metres has psi of a range m metres away, which is traced.

    Attributes
    ----------
    middle : float
        Middle of the block's ranges, m from the origin.
    """

    name = "range-motion-compensation"
    lengthens_rows = True
    layout = "columns"
    motion: Motion
    carrier: float
    middle: float

    @classmethod
    def bind(cls, constants: Constants, arriving: Callable[[], Line]) -> Self:
        rng = arriving().range
        return cls(motion=constants.measured, carrier=constants.carrier, middle=float((rng.min() + rng.max()) / 2))

    @property
    def source(self) -> Axis:
        return self.axes.range_frequency

    @property
    def n_row(self) -> int:
        return self.axes.time.size

    def operations(self) -> list[Operation]:
        """Rows of range_frequency.size samples, one per time."""
        frequency = self.axes.range_frequency
        period = fourier.fast_length(frequency.size)
        delay = fourier.dual(frequency, size=period, centre=2 / SPEED_OF_LIGHT * self.middle)
        factors = self._factors(SPEED_OF_LIGHT / 2 * delay.values)[0]
        terms = self.motion.terms(self.axes.time.values)[0]
        return [
            Transform(frequency, delay, inverse=True),
            *_turns(terms, factors),
            Transform(delay, frequency, inverse=False),
        ]

    def trace(self, line: Line) -> Line:
        value, slope, bend = self.motion.terms(line.time)
        factors, along = self._factors(line.range)
        migration = -SPEED_OF_LIGHT / (2 * self.carrier) * line.doppler  # d range / d time, m/s
        return line.multiply_time(
            (value * factors).sum(axis=-1),
            (slope * factors).sum(axis=-1) + (value * along).sum(axis=-1) * migration,
            (bend * factors).sum(axis=-1) + 2 * (slope * along).sum(axis=-1) * migration,
        )

    def _factors(self, rng: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Factors (..., n_term), minus those of the middle range, and their derivatives along range."""
        here = self.motion.factors(rng)
        step = 1e-3 * (self.motion.far - self.motion.near)
        along = (self.motion.factors(rng + step) - self.motion.factors(rng - step)) / (2 * step)
        return here - self.motion.middle, along


def _turns(factors: FloatArray, cycles: FloatArray) -> list[Operation]:
    """Make one phase operation for each term from factors by row (n_row, n_term) and cycles along rows (n, n_term).

    The first term is the same at all ranges: `MotionCompensation` removes it.
    """
    columns = zip(np.ascontiguousarray(factors.T)[1:], np.ascontiguousarray(cycles.T)[1:], strict=True)
    return [ScaledTurn(factor, along) for factor, along in columns]


Steps = tuple[type[Step], ...]

CHAINS: dict[Chain, Steps] = {
    "angular-division": (
        ResidualRangeWalk, MotionCompensation, Keystone, RangeCompression, RangeMotionCompensation,
        TimePerturbation, AzimuthTransform, FrequencyPerturbation, Deramp, DopplerTransform,
    ),
    "keystone-resampling": (
        ResidualRangeWalk, MotionCompensation, Keystone, RangeCompression, RangeMotionCompensation,
        TimePerturbation, AzimuthTransform, DopplerResampling, Deramp, DopplerTransform,
    ),
    "high-order-phase": (
        ResidualRangeWalk, MotionCompensation, RangeMotionInFrequency, AzimuthTransform, DopplerCompression,
        FrequencyPerturbation, Deramp, DopplerTransform,
    ),
}  # fmt: skip


MOTION = (MotionCompensation, RangeMotionCompensation, RangeMotionInFrequency)


def steps_of(method: Method, *, measured: bool = False) -> Steps:
    """Kinds of steps in order; a range sub-block has a range gate before them.

    Only the chain for a measured track, one that is no polynomial, has motion compensation.
    """
    chain = CHAINS[method.processor]
    if not measured:
        chain = tuple(s for s in chain if s not in MOTION)
    if not method.keystone:
        chain = tuple(TimeDomainCompression if s is RangeCompression else s for s in chain if s is not Keystone)
    if method.perturbation == "frequency":
        chain = tuple(FrequencyPerturbation if s is DopplerResampling else s for s in chain)
    if method.perturbation == "none":
        chain = tuple(s for s in chain if s not in (DopplerResampling, FrequencyPerturbation))
    if method.perturbation != "all":
        chain = tuple(s for s in chain if s is not TimePerturbation)
    return chain
