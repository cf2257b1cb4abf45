"""Chirps as files state them: a check of their sign against the samples, and the chirp of a recorded pulse.

*Sign.* A filter matched to the pulse gathers the echo of each place in one sample; that of the opposite chirp spreads
it over twice the pulse. With p the power over range, averaged over pulses that follow each other, so that speckle is
less and what the ground has of bright places is left, the contrast

    c = mean(p^2) / mean(p)^2 - 1

is thus larger under the right sign, unless the ground is even.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blocksar.arrays import ComplexArray
from blocksar.kernels.fourier import chirp_spectrum, fast_length, fft_rows

PULSES = 64  # whose power is averaged
DECIDED = 2.0  # times the contrast of one sign, that of the other
FITS = 0.5  # rad r.m.s., by which a linear chirp's phase may miss a pulse's


def contrasts(
    echo: ComplexArray, *, chirp_rate: float, pulse_width: float, sampling_rate: float
) -> tuple[float, float]:
    """Contrast over range of echoes (n_pulse, n_sample), compressed with the stated chirp, and with the other sign.

    Samples that are not finite count as 0. Both are 0 if there are no echoes.
    """
    size = fast_length(echo.shape[1] + pulse_width * sampling_rate)
    padded = np.zeros((echo.shape[0], size), np.complex64)
    padded[:, : echo.shape[1]] = np.nan_to_num(echo, posinf=0, neginf=0)
    spectrum = fft_rows(padded, inverse=False)
    number = np.arange(size)
    frequency = sampling_rate / size * np.where(number < size // 2, number, number - size).astype(np.float64)
    matched = chirp_spectrum(frequency, chirp_rate=chirp_rate, pulse_width=pulse_width).conj()
    matched = (matched / np.abs(matched).max()).astype(np.complex64)
    found = []
    for spectra in (matched, matched.conj()):
        power = (np.abs(fft_rows(spectrum * spectra, inverse=True)) ** 2).mean(axis=0)[: echo.shape[1]].astype(float)
        mean = float(power.mean())
        found.append(float((power**2).mean()) / mean**2 - 1 if mean else 0.0)
    return found[0], found[1]


class Chirp(NamedTuple):
    """Linear chirp: rate, Hz/s, length, s, and the time from its first sample to the carrier's frequency, s."""

    rate: float
    width: float
    centre: float


def fitted_chirp(pulse: ComplexArray, sampling_rate: float) -> Chirp | None:
    """Fit a linear chirp to a recorded pulse (n,); None if the phase is no parabola.

    The phase of samples is a parabola, weighted by their amplitude: its curvature is the rate, its vertex the centre.
    """
    if pulse.ndim != 1 or pulse.size < 8 or not np.isfinite(pulse).all() or not np.abs(pulse).min() > 0:
        return None
    time, phase = np.arange(pulse.size) / sampling_rate, np.unwrap(np.angle(pulse.astype(np.complex128)))
    bend, slope, start = np.polyfit(time, phase, 2, w=np.abs(pulse)).tolist()
    if bend == 0 or np.std(phase - (bend * time**2 + slope * time + start)) > FITS:
        return None
    return Chirp(rate=bend / np.pi, width=pulse.size / sampling_rate, centre=-slope / (2 * bend))
