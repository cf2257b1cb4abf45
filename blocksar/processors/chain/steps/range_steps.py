"""Range steps: residual range walk, keystone, RCMC with SRC in time or in Doppler.

Each can be applied and traced. Between recovery and range compression the samples are S(f, t), one row per range
frequency, with the factor exp(-4j pi (fc + f) / c rho(t)), where rho is the target's range less the origin and less the
unified walk.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.polynomial import chebyshev
from numpy.polynomial import polynomial as power
from numpy.typing import NDArray

from blocksar import solvers
from blocksar.arrays import FloatArray
from blocksar.budget import AZIMUTH_TAP_ERROR
from blocksar.collection.weighting import AxisTaper
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.kernels import interpolation, phase
from blocksar.kernels.fourier import Axis
from blocksar.kernels.operations import Operation, Stretch, Transform, Turn, Window
from blocksar.kernels.phase import Phase
from blocksar.processors.chain.steps.lines import Line
from blocksar.processors.chain.steps.step import Constants, Step

MOST_REACH = 1.2  # times the largest Doppler of a reference line: beyond it the range curvature is held constant
PACE_ORDER = 4  # of the polynomial dt/df along Doppler, for the correction of range curvature
RATE_FLOOR = 1e-3  # times the largest Doppler rate
PACE_FLOOR = 0.05  # of the weight at the largest Doppler: at zero Doppler an error of the pace causes no range walk


class _FrequencyStep(Step):
    """A step with rows along azimuth, one per range frequency."""

    @property
    def n_row(self) -> int:
        return self.axes.range_frequency.size


@dataclass(frozen=True, kw_only=True, eq=False)
class ResidualRangeWalk(_FrequencyStep):
    """Return a block's Doppler slab to time, and remove the walk of the block's centre (paper A (16)).

    Multiplies by exp(-2j pi walk (fc + f) / fc t), which is (16) with
    walk = -2 / lambda (k_10,i - k_10). Taking the slab's bins as centred on zero removes the walk on the
    carrier up to a fraction of a bin; the phase that remains for each row is small.

    Attributes
    ----------
    walk : float
        Hz on the carrier.
    carrier : float
        Hz.
    taper : AxisTaper or None
        Weighting over the pulses, applied here, where a sample's time is still that of its pulse at all frequencies.
    """

    name = "residual-walk"
    walk: float
    carrier: float
    taper: AxisTaper | None = None

    @classmethod
    def bind(cls, constants: Constants, arriving: Callable[[], Line]) -> Self:
        return cls(walk=constants.walk, carrier=constants.carrier, taper=constants.in_time)

    def weighed(self, in_time: AxisTaper) -> Self:
        return replace(self, taper=in_time)

    @property
    def source(self) -> Axis:
        return self.axes.slab

    def operations(self) -> list[Operation]:
        """Rows of slab.size Doppler bins to rows of time.size samples, one per range frequency."""
        slab = self.axes.slab
        moved = round(self.walk / slab.step) * slab.step
        source = Axis(slab.start - moved, slab.step, slab.size)
        factor = self.walk * (1 + self.axes.range_frequency.values / self.carrier) - moved
        walk = np.stack([np.zeros_like(factor), -factor], axis=1)
        weights = [] if self.taper is None else [_weigh(self.taper, self.axes.time, self.n_row)]
        return [Transform(source, self.axes.time, inverse=True), *weights, Turn(Phase(walk, 0.0, 1.0))]

    def trace(self, line: Line) -> Line:
        turned = line.multiply_time(-self.walk * line.time, np.array(-self.walk), np.array(0.0))
        return turned.shift_range(SPEED_OF_LIGHT / (2 * self.carrier) * self.walk * line.time)


@dataclass(frozen=True, kw_only=True, eq=False)
class Keystone(_FrequencyStep):
    """Rescale slow time at each range frequency so that any linear range walk cancels (paper A (17)).

    S_out(f, t) = fc / (fc + f) S(f, m + (t - m) fc / (fc + f)). The factor, which the paper omits, preserves the sum
    over slow time, so that all range frequencies have equal weight, as in back-projection. On the carrier nothing
    moves. A target's apparent range becomes rho - (t - m) rho', without the walk. The paper scales time about the
    epoch, m = 0. But the dwell gate cuts all frequencies at one scaled time: about the middle m of the block itself,
    the ends of dwells are displaced least at the ends of the band.

    Attributes
    ----------
    carrier : float
        Hz.
    middle : float
        m, s from the epoch.
    """

    name = "keystone"
    scales_time = True
    carrier: float
    middle: float = 0.0

    @classmethod
    def bind(cls, constants: Constants, arriving: Callable[[], Line]) -> Self:
        return cls(carrier=constants.carrier, middle=constants.middle)

    @property
    def scales_time_about(self) -> float:
        return self.middle

    @property
    def source(self) -> Axis:
        return self.axes.time

    def operations(self) -> list[Operation]:
        """Rows of time.size samples, one per range frequency; zero where the input has no data."""
        scale = self.carrier / (self.carrier + self.axes.range_frequency.values)
        middle, filled = float(self.axes.time.position(np.array(self.middle))), self.axes.time_occupancy
        taps = interpolation.taps_needed(filled, error=AZIMUTH_TAP_ERROR)
        return [Stretch(scale, middle, interpolation.tap_polynomials(taps, occupancy=filled))]

    def trace(self, line: Line) -> Line:
        return line.shift_range(SPEED_OF_LIGHT / (2 * self.carrier) * line.doppler * (line.time - self.middle))


@dataclass(frozen=True, kw_only=True, eq=False)
class Compression(Step):
    """Correct range migration and its coupling, then transform to range: every chain has one such step.

    Attributes
    ----------
    carrier : float
        Hz.
    taper : AxisTaper or None
        Weighting over range frequency.
    """

    layout = "columns"
    ends_range_part = compresses = True
    carrier: float
    taper: AxisTaper | None = None

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
        """Phase to multiply by along range frequency, one row per time or Doppler."""
        raise NotImplementedError

    def operations(self) -> list[Operation]:
        """Rows of range_frequency.size samples to rows.size ranges, one per time or Doppler: the block's columns."""
        weighted = [weights for weights in (self.taper, self._evenness) if weights is not None]
        return [
            Turn(self.correction),
            *(_weigh(weights, self.source, self.n_row) for weights in weighted),
            self._to_range,
        ]

    @property
    def _evenness(self) -> Callable[[FloatArray], FloatArray] | None:
        """Weights at range frequencies, Hz, that compensate those of the correction; None if it has none."""
        return None

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

    def interpolate(self, function: Callable[[FloatArray], FloatArray]) -> Phase:
        """Interpolate a phase, cycles (n, n_row) over (fc + f) / fc (n,), by polynomials in range frequency.

        They pass through Chebyshev nodes, which is exact up to the order of the phase.
        """
        f = self.axes.range_frequency
        centre, scale = f.centre, f.step * f.size / 2
        nodes = chebyshev.chebpts1(phase.MAX_ORDER + 1)
        cycles = function(1 + (centre + scale * nodes) / self.carrier)
        return Phase(_trim(solvers.through_nodes(cycles).T), centre, scale)


@dataclass(frozen=True, kw_only=True, eq=False)
class RangeCompression(Compression):
    """Apply RCMC and SRC by one reference, then transform to range (paper A (18)-(23), errata applied).

    Multiplies by exp{4j pi fc / c sum_n ((1 + f / fc)^(1-n) - 1) k_n (t - m)^n}, n >= 2: exact in f, where (22)
    expands to second order in f / fc. The phase on the carrier is unchanged. The k_n are those about the time m about
    which the keystone has scaled time.

    Attributes
    ----------
    reference : (n,) float
        k_0 .. k_(n-1) of the reference target's range about m, m/s^n.
    middle : float
        m, s from the epoch.
    """

    name = "rcmc-src"
    reference: FloatArray
    middle: float = 0.0

    @classmethod
    def bind(cls, constants: Constants, arriving: Callable[[], Line]) -> Self:
        k, m = constants.reference, constants.middle
        about = [sum(k[n] * math.comb(n, j) * m ** (n - j) for n in range(j, k.size)) for j in range(k.size)]
        reference = np.array(about, np.float64)
        return cls(carrier=constants.carrier, taper=constants.in_range, reference=reference, middle=m)

    def correction(self) -> Phase:
        order = np.arange(2, self.reference.size)
        migration = self.reference[2:] * (self.columns.values[:, None] - self.middle) ** order
        to_cycles = 2 * self.carrier / SPEED_OF_LIGHT
        return self.interpolate(
            lambda ratio: to_cycles * solvers.product(ratio[:, None] ** (1 - order) - 1, migration.T)
        )

    def trace(self, line: Line) -> Line:
        return line.shift_range(self._along(line.time, np.arange(self.reference.size) - 1.0))

    def _along(self, time: FloatArray, factor: NDArray[Any]) -> FloatArray:
        """Sum factor_n k_n (t - m)^n over n >= 2, m."""
        series = np.concatenate([[0.0, 0.0], factor[2:] * self.reference[2:]])
        return np.asarray(power.polyval(time - self.middle, series))


@dataclass(frozen=True, kw_only=True, eq=False)
class TimeDomainCompression(RangeCompression):
    """RCMC by one reference without a keystone before it (paper A, Figure 11 a-c): a variant of the chain with one.

    Multiplies by exp{4j pi f / c sum_n k_n t^n}, n >= 2. The difference between a target's range walk and the
    reference's, due to yaw, remains. There is no SRC: without keystone there is no coupling to correct.
    """

    name = "time-domain-rcmc"

    @classmethod
    def bind(cls, constants: Constants, arriving: Callable[[], Line]) -> Self:
        return cls(carrier=constants.carrier, taper=constants.in_range, reference=constants.reference)

    def correction(self) -> Phase:
        migration = self._along(self.columns.values, np.ones(self.reference.size))
        return Phase(np.stack([np.zeros_like(migration), 2 / SPEED_OF_LIGHT * migration], axis=1), 0.0, 1.0)

    def trace(self, line: Line) -> Line:
        return line.shift_range(-self._along(line.time, np.ones(self.reference.size)))


@dataclass(frozen=True, kw_only=True, eq=False)
class DopplerCompression(Compression):
    """Range curvature correction, SRC and range compression in the 2-D frequency domain (paper C (4), (5)).

    On a straight track of speed v, let a target be at range R0 when the centre of a beam squinted by theta0 from
    broadside crosses it, at slow time x / v:

        R(t) = sqrt(R0^2 + (v t - x)^2 - 2 R0 (v t - x) sin theta0).

    Range-walk correction (3) leaves exp{-4j pi (fc + f) / c [R(t) + v t sin theta0]}. By stationary phase its transform
    over t has, up to a quarter turn, the phase of (4),

        -4 pi R0 cos(theta0) sqrt{((fc + f) / c)^2 - (w / 2v)^2} - (2 pi / v) w (R0 sin theta0 + x),
        w = fa + f_dc + 2 v sin(theta0) f / c: the Doppler before (3), f_dc = 2 v sin(theta0) / lambda.

    The root, with g = (fa + f_dc) / 2v, is Phi_0 + Phi_1 f + Phi_2 f^2 + ..:

        Phi_0 = sqrt(fc^2 / c^2 - g^2)                        azimuth modulation
        Phi_1 = (fc / c - g sin theta0) / (c Phi_0)           range curvature: c Phi_1 = cos theta0 at fa = 0
        Phi_2 = -fa^2 / (8 v^2 c^2 Phi_0^3)                   SRC: none at fa = 0, where (3) has removed the coupling

    (4) is right as printed, and so is the sign of (3). Only the change of Phi_1 with fa may be compensated, otherwise
    the reference's range would be removed too. A target then comes to lie at R' = R0 + x sin theta0. Targets of one
    output range differ in R0 and therefore in Doppler rate, which the correction in azimuth
    equalises (`processors.chain.planning.coefficients`).

    All of this follows from one function. A target's history on the carrier has a spectrum of phase Psi(fa). Phase and
    Doppler scale with 1 + f / fc, so at the frequency f

        Psi(f, fa) = (1 + f / fc) Psi(fa / (1 + f / fc)).

    The step multiplies by the conjugate of Psi(f, fa) - Psi(fa) of a reference, exact in f where (4) expands to f^2.
    This holds for any track: Psi'' = -dt/df, and `pace` = dt/df comes from the lines of the block's targets. For the
    straight track the result is (4).

    A history then lasts 1 + f / fc times as long as on the carrier and has the same energy, so that its sum over slow
    time is sqrt(1 + f / fc) times as large. The step divides by that, which the paper omits: all range frequencies have
    equal weight, as in back-projection.

    Attributes
    ----------
    pace : (n,) float
        q_0 .. q_(n-1), s/Hz: dt/df along the reference's line is sum_k q_k (f / half)^k.
    half : float
        Largest Doppler of the reference's line, Hz.
    """

    name = "range-curvature+src"
    in_doppler = True
    pace: FloatArray
    half: float

    @classmethod
    def bind(cls, constants: Constants, arriving: Callable[[], Line]) -> Self:
        """Bind the pace dt/df of arriving lines, fitted by least squares weighted by the walk that errors cause."""
        line = arriving()
        half = float(np.abs(line.doppler).max())
        z = (line.doppler / half).ravel()
        weight = np.abs(z) + PACE_FLOOR
        # Where acceleration cancels the Doppler rate the pace is infinite: the prediction shows what the floor costs.
        pace = (line.rate / np.maximum(line.rate**2, (RATE_FLOOR * np.abs(line.rate).max()) ** 2)).ravel()
        fitted = solvers.least_squares(weight * z ** np.arange(PACE_ORDER + 1)[:, None], weight * pace)
        return cls(carrier=constants.carrier, taper=constants.in_range, pace=fitted, half=half)

    def correction(self) -> Phase:
        doppler = self._clip(self.columns.values)

        def coupling(ratio: FloatArray) -> FloatArray:
            return self._spectrum(doppler) - ratio[:, None] * self._spectrum(doppler / ratio[:, None])

        return self.interpolate(coupling)

    @property
    def _evenness(self) -> Callable[[FloatArray], FloatArray]:
        return lambda frequency: (1 + frequency / self.carrier) ** -0.5

    def _clip(self, doppler: FloatArray) -> FloatArray:
        """Clip Doppler to the reach of the reference line, Hz."""
        return np.clip(doppler, -MOST_REACH * self.half, MOST_REACH * self.half)

    def _spectrum(self, doppler: FloatArray) -> FloatArray:
        """Phase of the reference's spectrum on the carrier, Psi(f), cycles: minus its pace integrated twice."""
        k = np.arange(self.pace.size)
        series = np.concatenate([[0.0, 0.0], -self.pace / ((k + 1) * (k + 2))])
        return np.asarray(power.polyval(doppler / self.half, series) * self.half**2)

    def curvature(self, doppler: FloatArray) -> FloatArray:
        """Range curvature, m, of the reference where its line passes a Doppler."""
        series = np.concatenate([[0.0, 0.0], self.pace / (np.arange(self.pace.size) + 2)])
        migration = power.polyval(self._clip(doppler) / self.half, series) * self.half**2
        return np.asarray(-SPEED_OF_LIGHT / (2 * self.carrier) * migration)

    def trace(self, line: Line) -> Line:
        return line.shift_range(-self.curvature(line.doppler))


def _weigh(weights: Callable[[FloatArray], FloatArray], axis: Axis, n_row: int) -> Window:
    """Multiplication of all rows by the weights along them."""
    return Window(weights(axis.values)[None].astype(np.complex64), np.zeros(n_row, np.intp))


def _trim(coefficients: FloatArray) -> FloatArray:
    """Drop the highest orders that stay below 1e-7 cycles."""
    size = np.abs(coefficients).max(axis=0)
    tail = np.cumsum(size[::-1])[::-1]
    return coefficients[:, : max(int(np.count_nonzero(tail > 1e-7)), 1)]
