"""Azimuth steps: perturbation, resampling, deramp, final transform. Each can be applied and traced.

The samples are s(r, t) or s(r, f), one row per range. Every phase is a polynomial along the row with coefficients that
change smoothly with range (`RowPolynomial`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Self

import numpy as np
from numpy.polynomial import chebyshev
from numpy.polynomial import polynomial as power

from blocksar.arrays import ComplexArray, FloatArray, IntArray
from blocksar.budget import AZIMUTH_TAP_ERROR
from blocksar.kernels.fourier import Axis
from blocksar.kernels.interpolation import tap_polynomials, taps_needed
from blocksar.kernels.operations import Blend, Operation, Resample, Transform, Turn, Window
from blocksar.kernels.phase import Phase
from blocksar.processors.chain.steps.dwell_gate import DwellGate
from blocksar.processors.chain.steps.lines import Line, RowPolynomial
from blocksar.processors.chain.steps.step import Constants, Sampling, Step
from blocksar.solvers import through_nodes

GATE_WINDOWS = 17  # windows of the dwell gate over the slopes of a swath
INVERSE_ORDERS = 9, 13, 17, 21  # of the polynomial that inverts a Doppler resampling, of which the first that serves
INVERSE_ERROR, MOST_INVERSE_ERROR = 1e-3, 5e-3  # bins: one that serves, and one that costs as much as interpolation
INVERSE_ROWS = 64  # about, at which it is looked at
PACE_PLACES = 129  # along a row at which the pace of a Doppler resampling is looked at
LEAST_PACE, MOST_PACE = 0.51, 1.96  # samples per sample; `resample_rows` has 1/2 and 2
NEWTON_STEPS = 6  # of the inverse of a Doppler resampling


class _AzimuthStep(Step):
    """A step with rows along azimuth, one per range."""

    @property
    def n_row(self) -> int:
        return self.axes.rows.size


@dataclass(frozen=True, kw_only=True, eq=False)
class AzimuthTransform(_AzimuthStep):
    """Slow time to Doppler, padded in time for the delays of the steps in Doppler.

    Attributes
    ----------
    compressed : bool
        Whether rows are ranges; otherwise they are range frequencies.
    """

    name = "azimuth-fft"
    compressed: bool

    @classmethod
    def bind(cls, constants: Constants, arriving: Callable[[], Line]) -> Self:
        return cls(compressed=constants.polynomials is not None)

    @property
    def n_row(self) -> int:
        return (self.axes.rows if self.compressed else self.axes.range_frequency).size

    @property
    def source(self) -> Axis:
        return self.axes.time

    def operations(self) -> list[Operation]:
        """Rows of time.size samples to rows of doppler.size bins."""
        return [Transform(self.axes.time, self.axes.doppler, inverse=False)]

    def trace(self, line: Line) -> Line:
        return line


@dataclass(frozen=True, kw_only=True, eq=False)
class TimePerturbation(_AzimuthStep):
    """Multiply by exp(2j pi p(t)) before the transform to Doppler.

    Paper B's perturbation: orders 3 and 4 equalise cubic and quartic phases that depend on the target's azimuth. The
    bias chirp (order 2), and the use in the angular-division chain, are additions of this package: the chains then work
    where acceleration cancels the Doppler rate, and with beams that are not steered.
    """

    name = "time-perturbation"
    fitted = "time"
    phases: RowPolynomial

    @classmethod
    def bind(cls, constants: Constants, arriving: Callable[[], Line]) -> Self:
        return cls(phases=constants.azimuth.time)

    @property
    def source(self) -> Axis:
        return self.axes.time

    def operations(self) -> list[Operation]:
        """Rows of time.size samples, one per range."""
        return [_turn(self.phases, self.axes.rows)]

    def trace(self, line: Line) -> Line:
        if self.phases.vanishes:
            return line
        return line.multiply_time(*self.phases.evaluate(_mean_range(line), line.time))

    def turns(self, line: Line) -> FloatArray | float:
        return self.phases.along_range(_mean_range(line), line.time)


@dataclass(frozen=True, kw_only=True, eq=False)
class FrequencyPerturbation(_AzimuthStep):
    """Multiply by exp(2j pi P(f)) in Doppler, so that all targets of a range have one Doppler rate.

    Paper A (26), erratum applied: exp[j pi (alpha f^3 + beta f^4)]; also paper C's high-order phase correction. Fitted
    coefficients have orders 2 to 5.
    """

    name = "frequency-perturbation"
    fitted = "doppler"
    phases: RowPolynomial

    @classmethod
    def bind(cls, constants: Constants, arriving: Callable[[], Line]) -> Self:
        return cls(phases=constants.azimuth.doppler)

    @property
    def source(self) -> Axis:
        return self.axes.doppler

    def operations(self) -> list[Operation]:
        """Rows of doppler.size bins, one per range."""
        return [_turn(self.phases, self.axes.rows)]

    def trace(self, line: Line) -> Line:
        return line.multiply_doppler(*self.phases.evaluate(_mean_range(line), line.doppler))

    def turns(self, line: Line) -> FloatArray | float:
        return self.phases.along_range(_mean_range(line), line.doppler)


@dataclass(frozen=True, kw_only=True, eq=False)
class DopplerResampling(_AzimuthStep):
    """Resample Doppler, f -> h(f) = f + e2 f^2 + e3 f^3, so that all targets of a range have one Doppler rate.

    A line of rate k gets the rate k h'^2: spreading the spectrum by h' contracts the signal by h', about `middle`.
    Paper B's last correction. Its abstract names the operation; the map of lines and the orders are derived here
    (`Line.resample_doppler`). The spectrum is multiplied by 1 / sqrt(h'), so that energy is kept.

    Attributes
    ----------
    shift : RowPolynomial
        h(f) - f, Hz.
    middle : float
        Slow time about which signals contract, s.
    """

    name = "doppler-resampling"
    fitted = "resampling"
    shift: RowPolynomial
    middle: float

    @classmethod
    def bind(cls, constants: Constants, arriving: Callable[[], Line]) -> Self:
        return cls(shift=constants.azimuth.resampling, middle=constants.azimuth.middle)

    @property
    def source(self) -> Axis:
        return self.axes.doppler

    def operations(self) -> list[Operation]:
        """Rows of doppler.size bins, one per range."""
        delay = Phase(np.array([[0.0, self.middle]]), 0.0, 1.0)
        back = Phase(np.array([[0.0, -self.middle]]), 0.0, 1.0)
        filled = self.axes.doppler_occupancy
        taps = tap_polynomials(taps_needed(filled, error=AZIMUTH_TAP_ERROR), occupancy=filled)
        return [Turn(delay), Resample(self.positions, taps), Turn(back)]

    @property
    def positions(self) -> FloatArray:
        """Positions of each row's output bins in its input, in bins: (n_row, order + 1), of `phase.unit`.

        This is the inverse of h, by Newton's method at Chebyshev nodes. A phase of pi d at the end of a row is left
        where it errs by d bins.
        """
        return self._inverse()[0]

    def _inverse(self) -> tuple[FloatArray, float]:
        """Positions of the inverse map, of the lowest sufficient order, and their largest error, bins; not cached."""
        for order in INVERSE_ORDERS:
            nodes = chebyshev.chebpts1(order + 1)
            positions = through_nodes(self.axes.doppler.position(self._origins(nodes, self.axes.rows.values)).T).T
            error = self._error(positions)
            if error <= INVERSE_ERROR:
                break
        return positions, error

    def _origins(self, u: FloatArray, ranges: FloatArray) -> FloatArray:
        """Doppler (n_range, n), Hz, that is resampled to the places u (n,), from -1 to 1 along a row."""
        target = self._doppler(u)
        f = np.broadcast_to(target, (ranges.size, target.size)).copy()
        for _ in range(NEWTON_STEPS):
            offset, slope, _ = self.shift.evaluate(ranges, f)
            f -= (f + offset - target) / (1.0 + slope)
        return f

    def _doppler(self, u: FloatArray) -> FloatArray:
        doppler = self.axes.doppler
        return doppler.start + doppler.step * (doppler.size // 2 + u * (doppler.size / 2))

    def _error(self, positions: FloatArray) -> float:
        """Largest distance, bins, between where h maps positions to and where they should be; over some rows."""
        some = slice(None, None, max(self.n_row // INVERSE_ROWS, 1))
        u, doppler = np.linspace(-1, 1, PACE_PLACES), self.axes.doppler
        f = np.asarray(doppler.start + doppler.step * power.polyval(u, positions[some].T), np.float64)
        offset, _, _ = self.shift.evaluate(self.axes.rows.values[some], f)
        return float(np.abs(f + offset - self._doppler(u)).max() / doppler.step)

    @property
    def even(self) -> bool:
        """Tell whether positions follow the inverse and increase along the whole row, so that interpolation works."""
        positions, error = self._inverse()
        order = np.arange(1, positions.shape[1])
        u = np.linspace(-1, 1, PACE_PLACES)
        powers = order * u[:, None] ** (order - 1) * 2 / self.axes.doppler.size
        pace = (positions[:, None, 1:] * powers).sum(axis=-1)
        return bool(error <= MOST_INVERSE_ERROR and (pace >= LEAST_PACE).all() and (pace <= MOST_PACE).all())

    def trace(self, line: Line) -> Line:
        return line.resample_doppler(*self.shift.evaluate(_mean_range(line), line.doppler), middle=self.middle)


@dataclass(frozen=True, kw_only=True, eq=False)
class Deramp(_AzimuthStep):
    """Return to time and remove the common Doppler rate: multiply by exp(2j pi d(t)), orders 2 to 4 (paper A (31))."""

    name = "deramp"
    fitted = "deramp"
    phases: RowPolynomial

    @classmethod
    def bind(cls, constants: Constants, arriving: Callable[[], Line]) -> Self:
        return cls(phases=constants.azimuth.deramp)

    @property
    def source(self) -> Axis:
        return self.axes.doppler

    def operations(self) -> list[Operation]:
        """Rows of doppler.size bins to rows of long_time.size samples, one per range."""
        return [Transform(self.axes.doppler, self.axes.long_time, inverse=True), _turn(self.phases, self.axes.rows)]

    def trace(self, line: Line) -> Line:
        return line.multiply_time(*self.phases.evaluate(_mean_range(line), line.time))

    def turns(self, line: Line) -> FloatArray | float:
        return self.phases.along_range(_mean_range(line), line.time)


@dataclass(frozen=True, kw_only=True, eq=False)
class DopplerTransform(_AzimuthStep):
    """The final transform: level lines become points in Doppler (paper A (32), over the target's own dwell).

    Along Doppler each target's response has a carrier, the middle of its own dwell (with a gate: the distance from the
    gate's common centre). Interpolation of the image must remove that carrier first, as the geometric correction does.
    A dwell gate (`dwell_gate`) windows time in between. Without one all is summed in which the block's targets are lit.
    """

    name = "doppler-fft"

    @property
    def source(self) -> Axis:
        return self.axes.long_time

    def operations(self) -> list[Operation]:
        """Rows of long_time.size samples to rows of image_doppler.size bins, one per range; focused."""
        axes, gate = self.axes, self.axes.gate
        to_doppler = Transform(axes.long_time, axes.focused_doppler, inverse=False)
        if gate is None:
            return [*self._cut(), to_doppler]
        begin: list[Operation]
        end: list[Operation]
        if gate.taper is None:
            back = Transform(gate.time, axes.image_doppler, inverse=False)
            begin, end = [_windows(gate, "begin", axes), back], [_windows(gate, "end", axes), back]
        else:
            begin, end = [_blend(gate, "begin", axes)], [_blend(gate, "end", axes)]
        return [
            to_doppler,
            _turn(gate.begin, axes.rows),
            Transform(axes.focused_doppler, gate.time, inverse=True),
            *begin,
            _turn(gate.begin, axes.rows, sign=-1.0),
            _turn(gate.end, axes.rows),
            Transform(axes.image_doppler, gate.time, inverse=True),
            *end,
            _turn(gate.end, axes.rows, sign=-1.0),
            _turn(gate.common, axes.rows),
        ]

    def _cut(self) -> list[Operation]:
        """Zero the samples beyond the time that is summed."""
        time, summed = self.axes.long_time.values, self.axes.summed
        if summed is None:
            return []
        inside = (time >= summed[0]) & (time <= summed[1])
        if inside.all():
            return []
        return [Window(inside[None].astype(np.complex64), np.zeros(self.n_row, np.intp))]

    def trace(self, line: Line) -> Line:
        return line


def _turn(phases: RowPolynomial, rows: Axis, *, sign: float = 1.0) -> Turn:
    """Multiplication of each range row by its phase polynomial."""
    return Turn(lambda: Phase(sign * phases.coefficients(rows.values), phases.centre, phases.scale))


def _windows(gate: DwellGate, end: Literal["begin", "end"], axes: Sampling) -> Window:
    """Windows at one end of the dwell, for each range row."""
    slopes, which = _window_slopes(gate, end, axes.rows)

    def windows() -> ComplexArray:
        return np.stack([gate.window(float(each), end) for each in slopes])

    return Window(windows, which)


def _blend(gate: DwellGate, end: Literal["begin", "end"], axes: Sampling) -> Blend:
    """Windows at one end of the dwell under a taper, transformed to Doppler and blended there by length."""
    assert gate.taper is not None
    half = gate.taper.begin if end == "begin" else gate.taper.end
    slopes, which = _window_slopes(gate, end, axes.rows)

    def windows() -> ComplexArray:
        return np.stack([gate.tapered_windows(float(each), end) for each in slopes])

    return Blend(
        transform=Transform(gate.time, axes.image_doppler, inverse=False),
        windows=windows,
        count=len(half.lengths),
        which=which,
        share=half.blending(axes.rows.values),
        centre=half.length.centre,
        scale=half.length.scale,
    )


def _window_slopes(gate: DwellGate, end: Literal["begin", "end"], rows: Axis) -> tuple[FloatArray, IntArray]:
    """Slopes for which windows of one end are made, and the number of that of each range row.

    The slope changes by a tenth over a swath: a window for every range would cost more than the transforms.
    """
    slope = gate.begin_slope if end == "begin" else gate.end_slope
    slopes = slope.coefficients(rows.values)[:, 0]
    window_slopes = np.linspace(slopes.min(), slopes.max(), GATE_WINDOWS)
    return window_slopes, np.abs(window_slopes - slopes[:, None]).argmin(axis=1)


def _mean_range(line: Line) -> FloatArray:
    return np.asarray(line.range.mean(axis=-1))
