"""Range steps: range gate, residual range walk, keystone, RCMC with SRC in time or in Doppler.

Each can be applied and traced.

Between recovery and range compression the samples are S(f, t), one row a range frequency, with the phase
exp(-4j pi (fc + f) / c rho(t)), rho the target's range less the origin and less the unified walk.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from numpy.polynomial import chebyshev
from numpy.polynomial import polynomial as power
from numpy.typing import NDArray

from blocksar.arrays import FloatArray
from blocksar.budget import AZIMUTH_TAP_ERROR
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.focusing.lines import Line
from blocksar.focusing.step import Constants, Step
from blocksar.kernels import interpolation, phase, solvers
from blocksar.kernels.fourier import Axis
from blocksar.kernels.operations import Operation, Stretch, Transform, Turn, Window
from blocksar.kernels.phase import Phase

MOST_REACH = 1.2  # of the Doppler over which a reference line is known: beyond it its curvature stays constant
PACE_ORDER = 4  # of the pace along Doppler of the lines whose range curvature is corrected there
RATE_FLOOR = 1e-3  # of the largest Doppler rate
PACE_FLOOR = 0.05  # of the largest Doppler: at zero Doppler nothing walks, and any pace would do


class _FrequencyStep(Step):
    """A step whose rows lie along azimuth, one a range frequency."""

    @property
    def n_row(self) -> int:
        return self.axes.range_frequency.size


@dataclass(frozen=True, kw_only=True, eq=False)
class RangeGate(Step):
    """Keep some ranges of a block's slab, on as many fewer range frequencies: a block in range sub-blocks.

    At each Doppler bin the targets of a sub-block lie in an interval of range, whose centre moves along Doppler with
    their range walk. Range frequency goes to delay, about that centre; what lies beyond the gate is dropped, and what
    is left goes back to range frequency, over the same band in coarser steps.

    Attributes
    ----------
    slab : Axis
        Doppler bins, Hz.
    centre : (slab.size,) float
        Of the gate at each bin, m from the range origin.
    gate : Axis
        Delays from the centre that are kept, s.
    window : (gate.size,) float
        1, and falling to 0 at the ends.
    full, range_frequency : Axis
        Before and after, Hz.
    """

    name = "range-gate"
    layout = "columns"
    slab: Axis
    centre: FloatArray
    gate: Axis
    window: FloatArray
    full: Axis
    range_frequency: Axis

    @property
    def source(self) -> Axis:
        return self.full

    @property
    def n_row(self) -> int:
        return self.slab.size

    def operations(self) -> list[Operation]:
        """Rows of full.size to rows of range_frequency.size range frequencies, one a Doppler bin."""
        delay = 2 / SPEED_OF_LIGHT * self.centre
        shift = np.stack([np.zeros_like(delay), delay], axis=1)
        return [
            Turn(Phase(shift, 0.0, 1.0)),
            Transform(self.full, self.gate, inverse=True),
            Window(self.window[None].astype(np.complex64), np.zeros(self.n_row, np.intp)),
            Transform(self.gate, self.range_frequency, inverse=False),
            Turn(Phase(-shift, 0.0, 1.0)),
        ]

    def trace(self, line: Line) -> Line:
        return line


@dataclass(frozen=True, kw_only=True, eq=False)
class ResidualRangeWalk(_FrequencyStep):
    """Return a block's slab of Doppler to time, less the walk of the block's centre (paper A (16)).

    Multiplies by exp(-2j pi walk (fc + f) / fc t), which is (16) with
    walk = -2 / lambda (k_10,i - k_10). The slab's bins are read as if centred on zero: that is the walk on
    the carrier but for a fraction of a bin, and the phase left for each row is tiny.

    Attributes
    ----------
    walk : float
        Hz on the carrier.
    carrier : float
        Hz.
    """

    name = "residual-walk"
    walk: float
    carrier: float

    @classmethod
    def bind(cls, constants: Constants, arriving: Callable[[], Line]) -> Self:
        return cls(walk=constants.walk, carrier=constants.carrier)

    @property
    def source(self) -> Axis:
        return self.axes.slab

    def operations(self) -> list[Operation]:
        """Rows of slab.size Doppler bins to rows of time.size samples, one a range frequency."""
        slab = self.axes.slab
        moved = round(self.walk / slab.step) * slab.step
        source = Axis(slab.start - moved, slab.step, slab.size)
        factor = self.walk * (1 + self.axes.range_frequency.values / self.carrier) - moved
        walk = np.stack([np.zeros_like(factor), -factor], axis=1)
        return [Transform(source, self.axes.time, inverse=True), Turn(Phase(walk, 0.0, 1.0))]

    def trace(self, line: Line) -> Line:
        turned = line.multiply_time(-self.walk * line.time, np.array(-self.walk), np.array(0.0))
        return turned.shift_range(SPEED_OF_LIGHT / (2 * self.carrier) * self.walk * line.time)


@dataclass(frozen=True, kw_only=True, eq=False)
class Keystone(_FrequencyStep):
    """Rescale slow time at each range frequency so that any linear range walk cancels (paper A (17)).

    S_out(f, t) = fc / (fc + f) S(f, t fc / (fc + f)): the factor, which the paper leaves out, keeps the sum over slow
    time, so that all range frequencies weigh the same, as in back-projection. On the carrier nothing moves; a
    target's apparent range becomes rho - t rho', without the walk.
    """

    name = "keystone"
    carrier: float

    @classmethod
    def bind(cls, constants: Constants, arriving: Callable[[], Line]) -> Self:
        return cls(carrier=constants.carrier)

    @property
    def source(self) -> Axis:
        return self.axes.time

    def operations(self) -> list[Operation]:
        """Rows of time.size samples, one a range frequency; zero where the input has no data."""
        scale = self.carrier / (self.carrier + self.axes.range_frequency.values)
        middle, filled = float(self.axes.time.position(np.array(0.0))), self.axes.time_occupancy
        taps = interpolation.taps_needed(filled, error=AZIMUTH_TAP_ERROR)
        return [Stretch(scale, middle, interpolation.tap_polynomials(taps, occupancy=filled))]

    def trace(self, line: Line) -> Line:
        return line.shift_range(SPEED_OF_LIGHT / (2 * self.carrier) * line.doppler * line.time)


@dataclass(frozen=True, kw_only=True, eq=False)
class Compression(Step):
    """Correct range migration and its coupling, then transform to range: every chain has one of these.

    Attributes
    ----------
    carrier : float
        Hz.
    in_doppler : bool
        Whether ranges are compressed at each Doppler; at each slow time otherwise.
    """

    layout = "columns"
    in_doppler: ClassVar[bool] = False
    carrier: float

    @property
    def source(self) -> Axis:
        return self.axes.range_frequency

    @property
    def columns(self) -> Axis:
        """Slow time or Doppler at which ranges are compressed."""
        return self.axes.doppler if self.in_doppler else self.axes.time

    @property
    def n_row(self) -> int:
        return self.columns.size

    def correction(self) -> Phase:
        """What to multiply by: a phase along range frequency, one a time or Doppler."""
        raise NotImplementedError

    def operations(self) -> list[Operation]:
        """Rows of range_frequency.size samples to rows.size ranges, one a time or Doppler: the block's columns."""
        return [Turn(self.correction()), self._to_range]

    @property
    def _to_range(self) -> Transform:
        # Two-way delay is the dual of range frequency; rows are delays in units of range.
        rows = self.axes.rows
        delay = Axis(rows.start * 2 / SPEED_OF_LIGHT, rows.step * 2 / SPEED_OF_LIGHT, rows.size)
        return Transform(self.axes.range_frequency, delay, inverse=True)

    @property
    def period(self) -> int:
        """Length of the range transform."""
        return self._to_range.period

    def interpolated(self, function: Callable[[FloatArray], FloatArray]) -> Phase:
        """Cycles (n, n_row) at ratios (n,) of frequency to carrier, as polynomials along range frequency.

        Through Chebyshev's nodes, which is exact to the phase's order.
        """
        f = self.axes.range_frequency
        centre, scale = f.centre, f.step * f.size / 2
        nodes = chebyshev.chebpts1(phase.MAX_ORDER + 1)
        cycles = function(1 + (centre + scale * nodes) / self.carrier)
        return Phase(_trimmed(solvers.through_nodes(cycles).T), centre, scale)


@dataclass(frozen=True, kw_only=True, eq=False)
class RangeCompression(Compression):
    """RCMC and SRC by one reference, then the transform to range (paper A (18)-(23), errata applied).

    Multiplies by exp{4j pi fc / c sum_n ((1 + f / fc)^(1-n) - 1) k_n t^n}, n >= 2: exact in f, where (22)
    expands to second order in f / fc. The carrier's phase stays as it is.

    Attributes
    ----------
    reference : (n,) float
        k_0 .. k_(n-1) of the reference target's range about the epoch, m/s^n.
    """

    name = "rcmc-src"
    reference: FloatArray

    @classmethod
    def bind(cls, constants: Constants, arriving: Callable[[], Line]) -> Self:
        return cls(carrier=constants.carrier, reference=constants.reference)

    def correction(self) -> Phase:
        order = np.arange(2, self.reference.size)
        wandered = self.reference[2:] * self.columns.values[:, None] ** order
        to_cycles = 2 * self.carrier / SPEED_OF_LIGHT
        return self.interpolated(lambda ratio: to_cycles * (ratio[:, None] ** (1 - order) - 1) @ wandered.T)

    def trace(self, line: Line) -> Line:
        return line.shift_range(self._along(line.time, np.arange(self.reference.size) - 1.0))

    def _along(self, time: FloatArray, factor: NDArray[Any]) -> FloatArray:
        """sum_n factor_n k_n t^n, n >= 2, m."""
        return np.asarray(power.polyval(time, np.concatenate([[0.0, 0.0], factor[2:] * self.reference[2:]])))


@dataclass(frozen=True, kw_only=True, eq=False)
class TimeDomainCompression(RangeCompression):
    """RCMC by one reference with no keystone before it (paper A, Figure 11 a-c): a rival of the chain with one.

    Multiplies by exp{4j pi f / c sum_n k_n t^n}, n >= 2. A target's own range walk, which its yaw makes differ from
    the reference's, stays. There is no SRC: without keystone nothing couples.
    """

    name = "time-domain-rcmc"

    def correction(self) -> Phase:
        wandered = self._along(self.columns.values, np.ones(self.reference.size))
        return Phase(np.stack([np.zeros_like(wandered), 2 / SPEED_OF_LIGHT * wandered], axis=1), 0.0, 1.0)

    def trace(self, line: Line) -> Line:
        return line.shift_range(-self._along(line.time, np.ones(self.reference.size)))


@dataclass(frozen=True, kw_only=True, eq=False)
class DopplerCompression(Compression):
    """Range curvature correction, SRC and range compression in the 2-D frequency domain (paper C (4), (5)).

    On a straight track of speed v, let a target be R0 away when the centre of a beam squinted by theta0 from broadside
    crosses it, at slow time x / v:

        R(t) = sqrt(R0^2 + (v t - x)^2 - 2 R0 (v t - x) sin theta0).

    Range-walk correction (3) leaves exp{-4j pi (fc + f) / c [R(t) + v t sin theta0]}. By stationary phase its transform
    over t has, but for a quarter turn, the phase of (4),

        -4 pi R0 cos(theta0) sqrt{((fc + f) / c)^2 - (w / 2v)^2} - (2 pi / v) w (R0 sin theta0 + x),
        w = fa + f_dc + 2 v sin(theta0) f / c: the Doppler ahead of (3), f_dc = 2 v sin(theta0) / lambda.

    The root, with g = (fa + f_dc) / 2v, is Phi_0 + Phi_1 f + Phi_2 f^2 + ..:

        Phi_0 = sqrt(fc^2 / c^2 - g^2)                        azimuth modulation
        Phi_1 = (fc / c - g sin theta0) / (c Phi_0)           range curvature: c Phi_1 = cos theta0 at fa = 0
        Phi_2 = -fa^2 / (8 v^2 c^2 Phi_0^3)                   SRC: none at fa = 0, where (3) has undone the coupling

    (4) is right as printed, and so is the sign of (3). Only the change of Phi_1 with fa may be compensated, or the
    reference's range would go too. Then a target comes to lie at R' = R0 + x sin theta0: those of one output range
    differ in R0, hence in Doppler rate, which is what the correction in azimuth is for (`closed_form`).

    All of it follows from one function. A target's history on the carrier has a spectrum of phase Psi(fa), and at the
    frequency f, as every phase scales with 1 + f / fc and with it the Doppler,

        Psi(f, fa) = (1 + f / fc) Psi(fa / (1 + f / fc)).

    What is multiplied by is the conjugate of Psi(f, fa) - Psi(fa) of a reference, exact in f where (4) expands to f^2.
    So any track will do: Psi'' = -dt/df is read from the lines of the block's targets, `pace`. For the straight track
    that is (4).

    Attributes
    ----------
    pace : (n,) float
        q_0 .. q_(n-1): d t / d f along the reference's line is sum_k q_k (f / half)^k, s/Hz.
    half : float
        Hz.
    """

    name = "range-curvature+src"
    in_doppler = True
    pace: FloatArray
    half: float

    @classmethod
    def bind(cls, constants: Constants, arriving: Callable[[], Line]) -> Self:
        """With the pace of the arriving lines, by least squares, weighed by the range walk that an error makes."""
        line = arriving()
        half = float(np.abs(line.doppler).max())
        z = (line.doppler / half).ravel()
        weight = np.abs(z) + PACE_FLOOR
        # Where acceleration cancels the Doppler rate there is no pace to follow: the plan will say what that costs.
        pace = (line.rate / np.maximum(line.rate**2, (RATE_FLOOR * np.abs(line.rate).max()) ** 2)).ravel()
        fitted = solvers.least_squares(weight * z ** np.arange(PACE_ORDER + 1)[:, None], weight * pace)
        return cls(carrier=constants.carrier, pace=fitted, half=half)

    def correction(self) -> Phase:
        doppler = self._known(self.columns.values)

        def coupling(ratio: FloatArray) -> FloatArray:
            return self._spectrum(doppler) - ratio[:, None] * self._spectrum(doppler / ratio[:, None])

        return self.interpolated(coupling)

    def _known(self, doppler: FloatArray) -> FloatArray:
        return np.clip(doppler, -MOST_REACH * self.half, MOST_REACH * self.half)

    def _spectrum(self, doppler: FloatArray) -> FloatArray:
        """Psi(f), the phase of the reference's spectrum on the carrier, cycles: minus its pace integrated twice."""
        k = np.arange(self.pace.size)
        series = np.concatenate([[0.0, 0.0], -self.pace / ((k + 1) * (k + 2))])
        return np.asarray(power.polyval(doppler / self.half, series) * self.half**2)

    def curvature(self, doppler: FloatArray) -> FloatArray:
        """Range that the reference has wandered by where its line passes a Doppler, m."""
        series = np.concatenate([[0.0, 0.0], self.pace / (np.arange(self.pace.size) + 2)])
        wandered = power.polyval(self._known(doppler) / self.half, series) * self.half**2
        return np.asarray(-SPEED_OF_LIGHT / (2 * self.carrier) * wandered)

    def trace(self, line: Line) -> Line:
        return line.shift_range(-self.curvature(line.doppler))


def _trimmed(coefficients: FloatArray) -> FloatArray:
    """Without the highest orders that stay below a ten millionth of a cycle."""
    size = np.abs(coefficients).max(axis=0)
    tail = np.cumsum(size[::-1])[::-1]
    return coefficients[:, : max(int(np.count_nonzero(tail > 1e-7)), 1)]
