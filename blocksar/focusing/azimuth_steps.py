"""Azimuth steps: perturbation, resampling, deramp, final transform. Each can be applied and traced.

The samples are s(r, t) or s(r, f), one row a range; every phase is a polynomial along the row whose
coefficients change smoothly with range (`RowPolynomial`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev
from scipy.special import fresnel

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.focusing.lines import Line, RowPolynomial
from blocksar.focusing.step import Step
from blocksar.kernels import fourier
from blocksar.kernels.fourier import Axis
from blocksar.kernels.interpolation import tap_polynomials
from blocksar.kernels.operations import Operation, Resample, Transform, Turn, Window
from blocksar.kernels.phase import Phase
from blocksar.kernels.solvers import through_nodes

GATE_WINDOWS = 17
INVERSE_ORDER = 9  # of the polynomial that inverts a Doppler resampling: to a thousandth of a bin, and far below
NEWTON_STEPS = 6


def _turn(phases: RowPolynomial, rows: Axis, *, sign: float = 1.0) -> Turn:
    return Turn(Phase(sign * phases.coefficients(rows.values), phases.centre, phases.scale))


class _AzimuthStep(Step):
    """Its rows lie along azimuth, one a range."""

    rows: Axis

    @property
    def n_row(self) -> int:
        return self.rows.size


def _mean_range(line: Line) -> FloatArray:
    return np.asarray(line.range.mean(axis=-1))


@dataclass(frozen=True, kw_only=True, eq=False)
class AzimuthTransform(_AzimuthStep):
    """Slow time to Doppler, padded in time for what the steps in Doppler will move there.

    Its rows may be ranges or range frequencies: it does not ask.
    """

    name = "azimuth-fft"
    time: Axis
    doppler: Axis
    rows: Axis

    @property
    def source(self) -> Axis:
        return self.time

    def operations(self) -> list[Operation]:
        """Rows of time.size samples to rows of doppler.size bins."""
        return [Transform(self.time, self.doppler, inverse=False)]

    def trace(self, line: Line) -> Line:
        return line


@dataclass(frozen=True, kw_only=True, eq=False)
class TimePerturbation(_AzimuthStep):
    """Multiply by exp(2j pi p(t)) ahead of the transform to Doppler.

    Paper B's perturbation: orders 3 and 4 make the cubic and quartic phases alike that a target's azimuth gives it.
    With a bias chirp (order 2), and in the angular-division chain, it is this package's addition: the chains then work
    where acceleration cancels the Doppler rate, and on beams that are not steered.
    """

    name = "time-perturbation"
    time: Axis
    rows: Axis
    phases: RowPolynomial

    @property
    def source(self) -> Axis:
        return self.time

    def operations(self) -> list[Operation]:
        """Rows of time.size samples, one a range."""
        return [_turn(self.phases, self.rows)]

    def trace(self, line: Line) -> Line:
        return line.multiply_time(*self.phases.evaluate(_mean_range(line), line.time))


@dataclass(frozen=True, kw_only=True, eq=False)
class FrequencyPerturbation(_AzimuthStep):
    """Multiply by exp(2j pi P(f)) in Doppler, so that all targets of a range come to one Doppler rate.

    Paper A (26), erratum applied: exp[j pi (alpha f^3 + beta f^4)]; paper C's high-order phase correction. Fitted
    coefficients have orders 2 to 5.
    """

    name = "frequency-perturbation"
    doppler: Axis
    rows: Axis
    phases: RowPolynomial

    @property
    def source(self) -> Axis:
        return self.doppler

    def operations(self) -> list[Operation]:
        """Rows of doppler.size bins, one a range."""
        return [_turn(self.phases, self.rows)]

    def trace(self, line: Line) -> Line:
        return line.multiply_doppler(*self.phases.evaluate(_mean_range(line), line.doppler))


@dataclass(frozen=True, kw_only=True, eq=False)
class DopplerResampling(_AzimuthStep):
    """Resample Doppler, f -> h(f) = f + e2 f^2 + e3 f^3, so that all targets of a range come to one Doppler rate.

    A target whose line has the rate k comes out with k h'^2: a spectrum that is spread by h' is a signal contracted
    by h', about `middle`. Paper B's last correction; its abstract names the operation, the map of lines and the
    orders are derived here (`Line.resample_doppler`). The spectrum is multiplied by 1 / sqrt(h'): energy is kept.

    Attributes
    ----------
    shift : RowPolynomial
        h(f) - f, Hz.
    middle : float
        Slow time about which signals contract, s.
    taps : int
    occupancy : float
        Part of the Doppler sampling's time that the signal fills.
    """

    name = "doppler-resampling"
    doppler: Axis
    rows: Axis
    shift: RowPolynomial
    middle: float
    taps: int
    occupancy: float

    @property
    def source(self) -> Axis:
        return self.doppler

    def operations(self) -> list[Operation]:
        """Rows of doppler.size bins, one a range."""
        delay = Phase(np.array([[0.0, self.middle]]), 0.0, 1.0)
        back = Phase(np.array([[0.0, -self.middle]]), 0.0, 1.0)
        taps = tap_polynomials(self.taps, occupancy=self.occupancy)
        return [Turn(delay), Resample(self.positions(), taps), Turn(back)]

    def positions(self) -> FloatArray:
        """Where each row's output bins lie in its input, in bins: (n_row, INVERSE_ORDER + 1), of `phase.unit`.

        The inverse of h, by Newton's method at Chebyshev's nodes.
        """
        nodes = chebyshev.chebpts1(INVERSE_ORDER + 1)
        n, ranges = self.doppler.size, self.rows.values
        wanted = self.doppler.start + self.doppler.step * (n // 2 + nodes * (n / 2))
        f = np.broadcast_to(wanted, (ranges.size, wanted.size)).copy()
        for _ in range(NEWTON_STEPS):
            offset, slope, _ = self.shift.evaluate(ranges, f)
            f -= (f + offset - wanted) / (1.0 + slope)
        return through_nodes(self.doppler.position(f).T).T

    def trace(self, line: Line) -> Line:
        return line.resample_doppler(*self.shift.evaluate(_mean_range(line), line.doppler), middle=self.middle)


@dataclass(frozen=True, kw_only=True, eq=False)
class Deramp(_AzimuthStep):
    """Back to time; multiply by exp(2j pi d(t)): the block's common Doppler rate, orders 2 to 4 (paper A (31))."""

    name = "deramp"
    doppler: Axis
    time: Axis
    rows: Axis
    phases: RowPolynomial

    @property
    def source(self) -> Axis:
        return self.doppler

    def operations(self) -> list[Operation]:
        """Rows of doppler.size bins to rows of time.size samples, one a range."""
        return [Transform(self.doppler, self.time, inverse=True), _turn(self.phases, self.rows)]

    def trace(self, line: Line) -> Line:
        return line.multiply_time(*self.phases.evaluate(_mean_range(line), line.time))


@dataclass(frozen=True, kw_only=True, eq=False)
class DwellGate:
    """Let each Doppler of the image see its own dwell only, as back-projection does; thin out what is left.

    The final transform sums over all of slow time, so the sharp ends of other targets' dwells leave side lobes
    where back-projection, which sums over the pixel's own lit pulses, has none: on clutter that costs 0.005 of
    coherence. Windowing time by rect((t - c(f)) / length) with a centre that moves along Doppler is a
    convolution. With psi' = c it is, exactly where c is linear,

        S(f) -> exp(-2j pi psi) F{ G(t) F^-1{ exp(2j pi psi) S } },
        G(t) = integral of rect((t - u) / length) exp(j pi u^2 / c') / sqrt(j c') du,

    a Fresnel-smoothed rectangle. Between the transforms all targets lie about t = 0, so the last one is short.

    Attributes
    ----------
    phase : RowPolynomial
        psi(r, f), cycles.
    common : RowPolynomial
        The same, one for all rows: stays taken out, so that the image can be sampled coarsely in Doppler.
    slope : RowPolynomial
        Of one coefficient: c'(r), s/Hz.
    length : float
        Of the dwell after all steps, s.
    time : Axis
        About 0; what is kept.
    """

    phase: RowPolynomial
    common: RowPolynomial
    slope: RowPolynomial
    length: float
    time: Axis

    def window(self, slope: float) -> ComplexArray:
        """G over `time`, (time.size,) complex64."""
        scale = np.sqrt(2 / abs(slope))
        upper_sine, upper_cosine = fresnel(scale * (self.time.values + self.length / 2))
        lower_sine, lower_cosine = fresnel(scale * (self.time.values - self.length / 2))
        window = (upper_cosine - lower_cosine + 1j * (upper_sine - lower_sine)) * np.exp(-0.25j * np.pi) / np.sqrt(2)
        return (window if slope > 0 else window.conj()).astype(np.complex64)


@dataclass(frozen=True, kw_only=True, eq=False)
class DopplerTransform(_AzimuthStep):
    """The final transform: level lines become points in Doppler (paper A (32), with the target's own dwell).

    Each target's spectrum stays centred on its own dwell, not on t = 0 (with a gate: on its distance from the
    gate's common centre): whoever interpolates the image has to take out that carrier first, as the geometric
    correction does.
    """

    name = "doppler-fft"
    time: Axis
    doppler: Axis
    rows: Axis
    gate: DwellGate | None

    @property
    def image_doppler(self) -> Axis:
        """Doppler of the result."""
        if self.gate is None:
            return self.doppler
        return fourier.dual(self.time, size=self.gate.time.size, centre=self.doppler.centre)

    @property
    def source(self) -> Axis:
        return self.time

    def operations(self) -> list[Operation]:
        """Rows of time.size samples to rows of image_doppler.size bins, one a range; focused."""
        to_doppler = Transform(self.time, self.doppler, inverse=False)
        if self.gate is None:
            return [to_doppler]
        gate, image = self.gate, self.image_doppler
        slopes = gate.slope.coefficients(self.rows.values)[:, 0]
        # The slope changes by a tenth over a swath: a window for every range would cost more than the transforms.
        known = np.linspace(slopes.min(), slopes.max(), GATE_WINDOWS)
        windows = np.stack([gate.window(float(slope)) for slope in known])
        return [
            to_doppler,
            _turn(gate.phase, self.rows),
            Transform(self.doppler, gate.time, inverse=True),
            Window(windows, np.abs(known - slopes[:, None]).argmin(axis=1)),
            Transform(gate.time, image, inverse=False),
            _turn(gate.phase, self.rows, sign=-1.0),
            _turn(gate.common, self.rows),
        ]

    def trace(self, line: Line) -> Line:
        return line
