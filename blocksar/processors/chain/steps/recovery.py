"""Recovery: phase history to unambiguous Doppler spectrum (paper A, section 3.1, (6)-(14)).

Per range frequency: unified range walk (7) and nonlinear derotation (8) in one phase, an FFT, zero-padding in Doppler,
an inverse FFT to the finer time grid, the derotation undone (14), and an FFT to the recovered spectrum. Zero-padding
lengthens: (12) and (13) print B'_a / B_a where B_a / B'_a is meant.

The derotation follows the middle of the lit band at each time, with all its orders (paper A: the beam's centre at the
reference range). It scales with frequency as Doppler does, (fc + f) / fc, so that a wide band needs no higher PRF than
a narrow one.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial import Chebyshev, Polynomial, chebyshev

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.kernels import fourier
from blocksar.kernels.fourier import Axis
from blocksar.kernels.operations import Operation, ScaledTurn, Transform
from blocksar.kernels.rows import Program

GUARD = 1.02  # half apertures from its middle up to which the series of the derotation is trusted


@dataclass(frozen=True, kw_only=True, eq=False)
class CommonRange:
    """Range history that the bulk correction removes from all targets: a Chebyshev series over slow time.

    Departures of a track from a quartic are very nearly the same in the range histories of all targets. The azimuth
    steps, polynomials of low orders, have no terms for them; one phase per pulse removes them.

    Attributes
    ----------
    series : (order + 1,) float
        m, in the scaled variable (t - centre) / half.
    centre, half : float
        s from the epoch.
    """

    series: FloatArray
    centre: float
    half: float

    def at(self, time: FloatArray, derivative: int = 0) -> FloatArray:
        """Range (m), its rate (m/s) or that rate's (m/s^2) at slow times from the epoch."""
        if self.series.size == 1 and derivative:
            return np.zeros(np.shape(time))
        series = chebyshev.chebder(self.series, derivative, scl=1 / self.half)
        return np.asarray(chebyshev.chebval((time - self.centre) / self.half, series), np.float64)

    def taylor(self, order: int) -> FloatArray:
        """Power series about the epoch, (order + 1,), m/s^n: to be subtracted from k_0 .. k_order."""
        powers = self._powers[: order + 1]
        return np.asarray(np.pad(powers, (0, order + 1 - powers.size)), np.float64)

    @cached_property
    def _powers(self) -> FloatArray:
        axis = Polynomial([-self.centre, 1.0]) / self.half
        return np.asarray(Chebyshev(self.series).convert(kind=Polynomial)(axis).coef)


NO_COMMON_RANGE = CommonRange(series=np.zeros(1), centre=0.0, half=1.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Recovery:
    """Constants of a collection's spectrum recovery.

    Attributes
    ----------
    carrier : float
        Hz.
    pulses : Axis
        Slow time of the pulses from the epoch, s.
    padded : int
        Pulses after zero-padding in time: the guard lets the band's sharp ends ring without wrapping.
    origin : float
        Range origin, m: ranges in the chain are counted from it.
    walk : float
        k_10 of the scene's reference, m/s: the unified range walk.
    bulk : (n_pulse,) float
        Cycles on the carrier, per pulse, that turn the stored reference range into origin + walk t + common(t). They
        include the motion that the fitted track lacks.
    derotation : (order + 1,) float
        Chebyshev series over the aperture of the derotation phase, cycles on the carrier.
    doppler : Axis
        Doppler of the recovered spectrum, Hz; unambiguous.
    n_time : int
        Samples in time of the recovered signal, at least as many as Doppler bins. Without a dwell gate, so many that
        echoes from beyond the grid keep their Doppler: their part outside the spectrum is cut off, and does not fold.
    band : tuple of float
        Lowest and highest Doppler of the derotated signal over all that is lit, Hz.
    common : CommonRange
        Range that is removed from all targets alike.
    """

    carrier: float
    pulses: Axis
    padded: int
    origin: float
    walk: float
    bulk: FloatArray
    derotation: FloatArray
    doppler: Axis
    n_time: int
    band: tuple[float, float]
    common: CommonRange = NO_COMMON_RANGE

    @property
    def time(self) -> Axis:
        """Slow time of the recovered signal from the epoch, s, over the padded aperture.

        The padding is on either side, since the keystone moves the early ends of dwells as far as the late ones.
        """
        lead = (self.padded - self.pulses.size) // 2
        start = self.pulses.start - lead * self.pulses.step
        return Axis(start, self.padded * self.pulses.step / self.n_time, self.n_time)

    def derotation_cycles(self, time: FloatArray) -> FloatArray:
        """Phase of the derotation at slow times from the epoch, cycles on the carrier."""
        middle = self.pulses.start + self.pulses.step * (self.pulses.size - 1) / 2
        half = self.pulses.extent / 2
        u = (time - middle) / half
        held = np.clip(u, -GUARD, GUARD)
        rate = chebyshev.chebval(held, chebyshev.chebder(self.derotation))
        # In the guard, where the phase would grow, it continues at the end's rate: ringing there keeps its Doppler.
        return np.asarray(chebyshev.chebval(held, self.derotation) + rate * (u - held))

    def derotation_rate(self, time: FloatArray) -> FloatArray:
        """Doppler that the derotation removes at slow times from the epoch, Hz on the carrier."""
        middle = self.pulses.start + self.pulses.step * (self.pulses.size - 1) / 2
        half = self.pulses.extent / 2
        return np.asarray(chebyshev.chebval((time - middle) / half, chebyshev.chebder(self.derotation)) / half)

    def program(self, range_frequency: FloatArray) -> Program:
        """Recovery of range frequencies (n,), Hz: rows of pulses to rows of Doppler bins, one per frequency."""
        factor = 1 + range_frequency / self.carrier
        pulses, time = self.pulses, self.time
        folded = fourier.dual(pulses, size=self.padded, centre=0.0)
        operations: list[Operation] = [
            ScaledTurn(factor, -(self.bulk + self.derotation_cycles(pulses.values))),
            Transform(pulses, folded, inverse=False),
            # The derotated band is zero-padded to the width of the whole spectrum, for denser samples in time.
            Transform(folded, time, inverse=True),
            ScaledTurn(factor, self.derotation_cycles(time.values)),
            Transform(time, self.doppler, inverse=False),
        ]
        return Program(operations, source=pulses, n_row=factor.size)


def recover_columns(
    signal: ComplexArray,
    *,
    range_frequency: FloatArray,
    recovery: Recovery,
    threads: int = 1,
    out: ComplexArray | None = None,
) -> ComplexArray:
    """Recover the spectrum of some range frequencies.

    Parameters
    ----------
    signal : (n_pulse, n_column) complex64
        Missing samples are zero.
    range_frequency : (n_column,) float
        Hz.
    out : (recovery.doppler.size, n_column) complex64, C-contiguous, optional

    Returns
    -------
    (recovery.doppler.size, n_column) complex64
        Plain sum over pulses: a unit target lit in N pulses has a spectrum of energy N recovery.padded.
    """
    return recovery.program(range_frequency).run(signal, out=out, load="columns", store="columns", threads=threads)
