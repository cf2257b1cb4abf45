"""Time-frequency lines of targets, and the effect of operations on them.

To stationary phase, a target's azimuth signal is a line (t, f(t)) in the time-frequency plane. Operations on
samples map lines exactly, so one description of a step serves twice: applied to samples it is the processor, applied
to lines it predicts the processor's effect on any target:

    multiply by exp(2j pi p(t)) in time        f += p'(t)
    multiply by exp(2j pi P(f)) in Doppler     t -= P'(f)
    resample Doppler, f -> h(f)                f = h(f), t = t / h'(f)
    keystone                                   identity on the carrier; rho(t) -> rho - t rho' in range

Phases are in cycles throughout. A line carries its phase and the stretch of time along it. Both give the complex value
at which the target focuses, so geometric correction and calibration follow from the traced line without further
approximation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev

from blocksar import solvers
from blocksar.arrays import ComplexArray, FloatArray

LEAST_STRETCH = 1e-3  # with which a folded line still has a focus: it is refused elsewhere


@dataclass(frozen=True, kw_only=True, eq=False)
class Line:
    """Lines of targets, sampled along their dwells at Gauss-Legendre nodes.

    Attributes
    ----------
    time : (..., n) float
        Slow time from the epoch, s.
    doppler : (..., n) float
        Hz.
    rate : (..., n) float
        d doppler / d time along the line, Hz/s.
    phase : (..., n) float
        Phase of the signal in time, cycles.
    range : (..., n) float
        Apparent range less the range origin, m.
    stretch : (..., n) float
        d time / d (time when the target was lit).
    weight : (..., n) float
        Quadrature weights: seconds of lit time.
    """

    time: FloatArray
    doppler: FloatArray
    rate: FloatArray
    phase: FloatArray
    range: FloatArray
    stretch: FloatArray
    weight: FloatArray

    def multiply_time(self, cycles: FloatArray, rate: FloatArray, curvature: FloatArray) -> Line:
        """Lines after multiplication by exp(2j pi cycles(t)): value, first and second derivative at self.time."""
        return self._with(phase=self.phase + cycles, doppler=self.doppler + rate, rate=self.rate + curvature)

    def multiply_doppler(self, cycles: FloatArray, rate: FloatArray, curvature: FloatArray) -> Line:
        """Lines after multiplication by exp(2j pi cycles(f)) in Doppler: value and derivatives at self.doppler.

        Stationary phase there and back: phase(t') = phase(t) - f t + cycles(f) + f t'; the two quarter
        turns cancel as long as the line is not folded over (dt'/dt > 0).
        """
        time = self.time - rate
        bend = 1.0 - curvature * self.rate
        return self._with(
            time=time,
            phase=self.phase - self.doppler * self.time + cycles + self.doppler * time,
            rate=self.rate / bend,
            stretch=self.stretch * bend,
        )

    def resample_doppler(self, offset: FloatArray, slope: FloatArray, bend: FloatArray, *, middle: float) -> Line:
        """Lines after resampling Doppler f to h(f) = f + offset(f): offset and its derivatives at self.doppler.

        Time contracts about `middle`: the spectrum's phase, psi(f) = phase - f (t - middle), moves with f, so that
        its group delay is t - middle = (t_before - middle) / h'(f). Energy is kept.
        """
        moved, stretched = self.doppler + offset, 1.0 + slope
        before = self.time - middle
        time = before / stretched
        pace = (1.0 - time * bend * self.rate) / stretched
        with np.errstate(divide="ignore", invalid="ignore"):
            rate = stretched * self.rate / pace
        return self._with(
            time=middle + time,
            doppler=moved,
            rate=rate,
            phase=self.phase - self.doppler * before + moved * time,
            stretch=self.stretch * pace,
        )

    def shift_range(self, offset: FloatArray) -> Line:
        """Lines after a shift of range, m."""
        return self._with(range=self.range + offset)

    def _with(self, **changes: FloatArray) -> Line:
        """Copy with some arrays changed, faster than `dataclasses.replace` for small lines."""
        return Line(**{**self.__dict__, **changes})

    def weighed(self, weights: FloatArray) -> Line:
        """Copy of the lines whose quadrature weights are multiplied by a weighting at the nodes."""
        return self._with(weight=self.weight * weights)

    @property
    def folded(self) -> bool:
        """Whether time turns back somewhere along a line, so that stationary phase no longer holds."""
        return bool((self.stretch <= 0.02).any() or not np.isfinite(self.stretch).all())


@dataclass(frozen=True, eq=False)
class Focus:
    """Focus of level lines; arrays (...) of targets, each computed on demand.

    Each line is summed over its dwell at the Doppler where the final transform peaks.

    `doppler` (Hz), `range` (m from the origin) and `time` (s, middle of the dwell after all steps) locate a target.
    `phase` (cycles) and `gain` (sum over the dwell relative to the lit time, near 1) calibrate it. `residual` is the
    largest phase error over the dwell (rad), `quadratic` its quadratic part at the dwell's edge (rad; pi/4 is the usual
    limit), `migration` the extent of its range over the dwell (m).
    """

    line: Line

    @cached_property
    def time(self) -> FloatArray:
        return self._mean(self.line.time)

    @cached_property
    def range(self) -> FloatArray:
        return self._mean(self.line.range)

    @cached_property
    def doppler(self) -> FloatArray:
        return self._middle + self._slope

    @cached_property
    def phase(self) -> FloatArray:
        return np.asarray(self._level[1] + np.angle(self._sum) / (2 * np.pi))

    @cached_property
    def gain(self) -> FloatArray:
        return np.asarray(np.abs(self._sum) / self.line.weight.sum(axis=-1))

    @cached_property
    def residual(self) -> FloatArray:
        return np.asarray(np.abs(self._error).max(axis=-1))

    @cached_property
    def quadratic(self) -> FloatArray:
        # The remaining Doppler rate by regression along the line, over the stretched half dwell.
        tilt = self._mean((self.line.doppler - self.doppler[..., None]) * self._offset) / self._spread
        half = (self.line.weight * self.line.stretch).sum(axis=-1) / 2
        return np.asarray(np.abs(np.pi * tilt * half**2))

    @cached_property
    def migration(self) -> FloatArray:
        return np.asarray(np.ptp(self.line.range, axis=-1))

    @cached_property
    def _weight(self) -> tuple[FloatArray, FloatArray]:
        """Weights along each line, and their sum."""
        with np.errstate(invalid="ignore"):
            # A signal stretched in time by s keeps its energy: its amplitude falls as 1 / sqrt(s), ds = s dt.
            weight = self.line.weight * np.sqrt(np.maximum(self.line.stretch, LEAST_STRETCH))
        return weight, weight.sum(axis=-1)

    def _mean(self, values: FloatArray) -> FloatArray:
        weight, total = self._weight
        return np.asarray((values * weight).sum(axis=-1) / total)

    @cached_property
    def _offset(self) -> FloatArray:
        """Time from the middle of the dwell, s."""
        return self.line.time - self.time[..., None]

    @cached_property
    def _spread(self) -> FloatArray:
        """Mean square time offset, s^2."""
        return np.maximum(self._mean(self._offset**2), 1e-30)

    @cached_property
    def _middle(self) -> FloatArray:
        """Mean Doppler, Hz."""
        return self._mean(self.line.doppler)

    @cached_property
    def _turn(self) -> FloatArray:
        """Phase after removal of the mean Doppler, cycles."""
        return self.line.phase - self._middle[..., None] * self.line.time

    @cached_property
    def _slope(self) -> FloatArray:
        """Difference of the peak of |sum| from the mean Doppler, Hz, by regression of phase on time."""
        return np.asarray(self._mean(self._turn * self._offset) / self._spread)

    @cached_property
    def _level(self) -> tuple[FloatArray, FloatArray]:
        """Phase without its linear part, cycles, and its mean."""
        level = self._turn - self._slope[..., None] * self.line.time
        return level, self._mean(level)

    @cached_property
    def _error(self) -> FloatArray:
        """Phase error along each line, rad."""
        level, phase = self._level
        return np.asarray(2 * np.pi * (level - phase[..., None]))

    @cached_property
    def _sum(self) -> ComplexArray:
        return np.asarray((self._weight[0] * np.exp(1j * self._error)).sum(axis=-1))


def focus(line: Line) -> Focus:
    """Focus levelled lines."""
    return Focus(line)


@dataclass(frozen=True, kw_only=True, eq=False)
class RowPolynomial:
    """A polynomial along a row that changes smoothly from row to row: a phase (cycles), a shift of Doppler (Hz).

    p(r, v) = sum_k c_k(r) z^k with z = (v - centre) / scale, each c_k a Chebyshev series in range r.

    Attributes
    ----------
    series : (n_series, order + 1) float
        Chebyshev coefficients in r of each power's coefficient.
    near, far : float
        Domain of r, m.
    centre, scale : float
        Centre and scale of the variable along the row (s or Hz).
    """

    series: FloatArray
    near: float
    far: float
    centre: float
    scale: float

    def coefficients(self, rng: FloatArray) -> FloatArray:
        """(..., order + 1) power coefficients at ranges of any shape."""
        return np.ascontiguousarray(np.moveaxis(self._terms(np.asarray(rng)), 0, -1))

    def _terms(self, rng: FloatArray) -> FloatArray:
        """`coefficients` with the powers first, (order + 1, ...)."""
        u = np.clip((2 * rng - self.near - self.far) / (self.far - self.near), -1.1, 1.1)
        twice, series = 2 * u, self.series.reshape(*self.series.shape, *(1,) * u.ndim)
        last, total = np.zeros(1), np.zeros((self.series.shape[1], *u.shape))
        for term in series[:0:-1]:  # Clenshaw's recurrence
            last, total = total, term + twice * total - last
        return np.asarray(series[0] + u * total - last)

    @property
    def vanishes(self) -> bool:
        """Whether the polynomial is zero everywhere."""
        return not self.series.any()

    def along_range(self, rng: FloatArray, values: FloatArray) -> FloatArray:
        """Derivative along range, per m, at ranges (...) and values (..., n) along the row."""
        slope = chebyshev.chebder(self.series, axis=0).astype(np.float64) * (2 / (self.far - self.near))
        return replace(self, series=slope).evaluate(rng, values)[0]

    def variable(self, values: FloatArray) -> FloatArray:
        """z at values along the row."""
        return (values - self.centre) / self.scale

    def evaluate(self, rng: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Value and first two derivatives along the row, at ranges (...) and values (..., n)."""
        terms, z = self._terms(np.asarray(rng))[..., None], self.variable(values)
        value, slope, bend = (np.zeros(np.broadcast_shapes(z.shape, terms.shape[1:])) for _ in range(3))
        value += terms[-1]
        for power, term in enumerate(terms[-2::-1]):  # Horner's scheme; terms that are still zero are skipped
            if power > 1:
                bend *= z
            if power > 0:
                bend += slope
                slope *= z
            slope += value
            value *= z
            value += term
        slope /= self.scale
        bend *= 2 / self.scale**2
        return value, slope, bend


def row_polynomial(
    coefficients: FloatArray, *, ranges: FloatArray, centres: FloatArray, scale: float, degree: int
) -> RowPolynomial:
    """Fit a `RowPolynomial` to polynomials at several ranges, each about its own centre.

    Parameters
    ----------
    coefficients : (n_range, order + 1) float
        Coefficients of the powers of z = (v - centres[i]) / scale.
    ranges : (n_range,) float
        m, at Chebyshev nodes that include both ends, `solvers.end_nodes`.
    degree : int
        Largest degree of the series in range.
    """
    centre = float(np.mean(centres))
    order = coefficients.shape[1] - 1
    move = (centre - centres) / scale  # z about its own centre = z about the common one + move
    shifted = coefficients
    if move.any():
        shifted = np.zeros_like(coefficients)
        for k in range(order + 1):
            for j in range(k + 1):
                shifted[:, j] += coefficients[:, k] * math.comb(k, j) * move ** (k - j)
    near, far = float(ranges[0]), float(ranges[-1])
    series = solvers.node_series(shifted, min(degree, ranges.size - 1))
    return RowPolynomial(series=series, near=near, far=far, centre=centre, scale=scale)


class AzimuthPolynomials(NamedTuple):
    """Coefficients of the azimuth steps: phases in time and Doppler (cycles), shift of Doppler (Hz), deramp (cycles).

    The polynomial of a step that the chain lacks is zero. Resampling is about the slow time `middle`, s.
    """

    time: RowPolynomial
    doppler: RowPolynomial
    resampling: RowPolynomial
    deramp: RowPolynomial
    middle: float
