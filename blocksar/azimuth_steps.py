"""Azimuth steps: perturbation, deramp, final transform. Each can be applied and traced.

The samples are s(r, t) or s(r, f), one row a range; every phase is a polynomial along the row whose
coefficients change smoothly with range (`RowPhase`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import fresnel

from blocksar import fourier
from blocksar.fourier import Axis
from blocksar.lines import Line, RowPhase
from blocksar.parameters import ComplexArray, FloatArray
from blocksar.phase import Phase
from blocksar.rows import Operation, Transform, Turn, Window
from blocksar.steps import Step

GATE_WINDOWS = 17


def _turn(phases: RowPhase, rows: Axis, *, sign: float = 1.0) -> Turn:
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
class Perturbation(_AzimuthStep):
    """Perturb in time, transform to Doppler, perturb there (paper A (26), orders 3 and up; time: physics).

    exp(2j pi p(t)) ahead of the transform is this package's addition: it lets the chain work where
    acceleration cancels the Doppler rate, and on beams that are not steered. The frequency perturbation
    exp(2j pi P(f)) is (26), erratum applied: exp[j pi (alpha f^3 + beta f^4)].
    """

    name = "perturbation"
    time: Axis
    doppler: Axis
    rows: Axis
    time_phase: RowPhase
    doppler_phase: RowPhase

    @property
    def source(self) -> Axis:
        return self.time

    def operations(self) -> list[Operation]:
        """Rows of time.size samples to rows of doppler.size bins, one a range; padded in time."""
        return [
            _turn(self.time_phase, self.rows),
            Transform(self.time, self.doppler, inverse=False),
            _turn(self.doppler_phase, self.rows),
        ]

    def trace(self, line: Line) -> Line:
        row = _mean_range(line)
        line = line.multiply_time(*self.time_phase.evaluate(row, line.time))
        return line.multiply_doppler(*self.doppler_phase.evaluate(row, line.doppler))


@dataclass(frozen=True, kw_only=True, eq=False)
class Deramp(_AzimuthStep):
    """Back to time; multiply by exp(2j pi d(t)): the block's common Doppler rate, orders 2 to 4 (paper A (31))."""

    name = "deramp"
    doppler: Axis
    time: Axis
    rows: Axis
    phases: RowPhase

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
    phase : RowPhase
        psi(r, f), cycles.
    common : RowPhase
        The same, one for all rows: stays taken out, so that the image can be sampled coarsely in Doppler.
    slope : RowPhase
        Of one coefficient: c'(r), s/Hz.
    length : float
        Of the dwell after all steps, s.
    time : Axis
        About 0; what is kept.
    """

    phase: RowPhase
    common: RowPhase
    slope: RowPhase
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
