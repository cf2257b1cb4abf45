"""Azimuth steps: perturbation, deramp, final transform. Each can be applied and traced.

The samples are s(r, t) or s(r, f), one row a range; every phase is a polynomial along the row whose
coefficients change smoothly with range (`RowPhase`).
"""

from __future__ import annotations

from dataclasses import dataclass

from blocksar import fourier, phase
from blocksar.fourier import Axis
from blocksar.lines import Line, RowPhase
from blocksar.parameters import ComplexArray


def _rotation(phases: RowPhase, rows: Axis, along: Axis, *, sign: float = 1.0) -> fourier.RowWork:
    coefficients = sign * phases.coefficients(rows.values)
    z = phases.variable(along.values)

    def rotate(values: ComplexArray, which: slice) -> None:
        phase.rotate_polynomial(values, coefficients[which], z)

    return rotate


def _mean_range(line: Line):  # type: ignore[no-untyped-def]
    return line.range.mean(axis=-1)


@dataclass(frozen=True, kw_only=True, eq=False)
class Perturbation:
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

    def apply(self, block: ComplexArray, *, threads: int) -> ComplexArray:
        """(n_row, time.size) in time to (n_row, doppler.size) in Doppler; padded in time."""
        before = _rotation(self.time_phase, self.rows, self.time) if self.time_phase.series.any() else None
        after = _rotation(self.doppler_phase, self.rows, self.doppler)
        return fourier.transform(
            block, self.time, self.doppler, inverse=False, threads=threads, before=before, after=after
        )

    def trace(self, line: Line) -> Line:
        row = _mean_range(line)
        line = line.multiply_time(*self.time_phase.evaluate(row, line.time))
        return line.multiply_doppler(*self.doppler_phase.evaluate(row, line.doppler))


@dataclass(frozen=True, kw_only=True, eq=False)
class Deramp:
    """Back to time; multiply by exp(2j pi d(t)): the block's common Doppler rate, orders 2 to 4 (paper A (31))."""

    name = "deramp"
    doppler: Axis
    time: Axis
    rows: Axis
    phases: RowPhase

    def apply(self, block: ComplexArray, *, threads: int) -> ComplexArray:
        """(n_row, doppler.size) in Doppler to (n_row, time.size) in time."""
        after = _rotation(self.phases, self.rows, self.time)
        return fourier.transform(block, self.doppler, self.time, inverse=True, threads=threads, after=after)

    def trace(self, line: Line) -> Line:
        return line.multiply_time(*self.phases.evaluate(_mean_range(line), line.time))


@dataclass(frozen=True, kw_only=True, eq=False)
class DopplerTransform:
    """The final transform: level lines become points in Doppler (paper A (32), with the target's own dwell).

    Each target's spectrum stays centred on its own dwell, not on t = 0: whoever interpolates the image has to
    take out that carrier first, as the geometric correction does.
    """

    name = "doppler-fft"
    time: Axis
    doppler: Axis

    def apply(self, block: ComplexArray, *, threads: int) -> ComplexArray:
        """(n_row, time.size) in time to (n_row, doppler.size), focused."""
        return fourier.to_doppler(block, self.time, self.doppler, threads=threads)

    def trace(self, line: Line) -> Line:
        return line
