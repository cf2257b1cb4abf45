"""Pulses to the moments of their positions: columns of samples that come earlier or later are moved in slow time.

The Doppler frequency of the beam's centre passes through many PRFs. Without it, samples fill less than a PRF, and are
interpolated by a sinc under Kaiser's window. With x[n] the sample at t_n + d, and Phi the phase of the beam's centre,

    y[n] = exp(j Phi(t_n)) sum_k h(k + d / PRI) x[n + k] exp(-j Phi(t_n+k + d)) .
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.kernels.fourier import unit_phasor

HALF = 8  # pulses on either side that a sum takes
WINDOW = 6.0  # Kaiser's beta: errors of -60 dB up to 0.4 PRF
UNMOVED = 1e-4  # of a PRI


@dataclass(frozen=True, kw_only=True, eq=False)
class Resampling:
    """How pulses are resampled.

    Attributes
    ----------
    cycles, doppler : (n_pulse,) float
        Phase of the beam's centre over 2 pi, and its Doppler frequency, Hz.
    late : (n_sample,) float
        d of each column, s.
    interval : float
        PRI, s.
    """

    cycles: FloatArray
    doppler: FloatArray
    late: FloatArray
    interval: float

    @classmethod
    def of(cls, doppler: FloatArray, late: FloatArray, interval: float) -> Resampling:
        steps = interval * (doppler[1:] + doppler[:-1]) / 2
        cycles = np.concatenate([[0.0], np.cumsum(steps)])
        return cls(cycles=cycles, doppler=doppler, late=late, interval=interval)

    def apply(self, read: Callable[[slice], ComplexArray], pulses: slice) -> ComplexArray:
        """Samples of some pulses, of which `read` gives those that are asked for; lost ones stay NaN."""
        shift = self.late / self.interval
        if np.abs(shift).max() < UNMOVED:
            return read(pulses)
        around = slice(max(pulses.start - HALF, 0), min(pulses.stop + HALF, self.cycles.size))
        samples = read(around)
        lost = np.isnan(samples[:, 0].real)
        samples[lost] = 0
        phase = self.cycles[around, None] + np.multiply.outer(self.doppler[around], self.late)
        samples *= unit_phasor(-phase).astype(np.complex64)
        n = pulses.stop - pulses.start
        out = np.zeros((n, samples.shape[1]), np.complex64)
        for k in range(-HALF, HALF + 1):
            low, high = max(pulses.start + k, around.start), min(pulses.stop + k, around.stop)
            if low < high:
                rows = slice(low - k - pulses.start, high - k - pulses.start)
                out[rows] += _weight(k + shift).astype(np.float32) * samples[low - around.start : high - around.start]
        out *= unit_phasor(self.cycles[pulses])[:, None].astype(np.complex64)
        out[lost[pulses.start - around.start :][:n]] = np.nan
        return out


def _weight(place: FloatArray) -> FloatArray:
    """h at places in pulses."""
    within = np.clip(1 - (place / (HALF + 1)) ** 2, 0, None)
    return np.asarray(np.sinc(place) * np.i0(WINDOW * np.sqrt(within)) / np.i0(WINDOW))
