"""What is too fine for the splines: the line-of-sight phase of each sample, from the points' strongest lines.

Once the chips are sharp, each sample's phase can be read off the points themselves: the angle of the sum of their
strongest lines, each turned back by its own phase. That is noise, unless the track really has so fine an error, as a
random walk of the position has. What two halves of the points have in common tells how much of it to believe: each
band of frequencies is weighed as a Wiener filter would.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blocksar.arrays import BoolArray, Complex128Array, ComplexArray, FloatArray
from blocksar.autofocusing.chips import Chips
from blocksar.autofocusing.phase_gradient import centred_rows
from blocksar.kernels.fourier import fft_rows

TURNS = 4  # of points' own phases and the shared one
BANDS = 8  # of frequencies, at most
OFF_END = 3  # from the last band: the one from which power beyond is told, not dimmed by the chips' low-pass
LEAST_BINS = 8  # of a band
WHOLE = 8  # times the Doppler cells: a band that cuts nothing
ALONE = 0.5  # of the power of its line: a point with less does not stand alone
PATTERN = 0.15  # correlation of amplitudes
DOUBT = 3.0  # standard deviations of the halves' common power in noise that are not believed


class FinePhase(NamedTuple):
    """A phase (n_sample,), rad; the error that is expected of it, and what it has beyond its samples, rad rms.

    The latter as of a random walk, whose power falls with the square of frequency: it goes on beyond the samples' rate.
    """

    phase: FloatArray
    error: float
    beyond: float


def shared_samples(chips: Chips, weights: FloatArray) -> FloatArray:
    """Phase, rad, and relative amplitude that the points share in each sample, (n_sample, 2).

    Slow parts of the phase are arbitrary.
    """
    rows = strongest_rows(chips)
    index, n = chips.index, chips.time.size
    shared, amplitude = np.zeros(n), np.ones(n)
    for _ in range(TURNS):
        turned = rows * np.exp(-1j * shared[index])
        own, noise = own_phase(turned, chips)
        share = (weights / np.maximum(noise, 1e-300))[:, None] * np.conj(own)
        values = np.where(chips.lit, rows * share, 0)
        total = np.bincount(index.ravel(), values.real.ravel(), minlength=n) + 1j * np.bincount(
            index.ravel(), values.imag.ravel(), minlength=n
        )
        shared = np.where(total == 0, 0.0, np.angle(total))
        expected = np.bincount(index.ravel(), np.abs(share * own).ravel(), minlength=n)
        amplitude = np.abs(total) / np.maximum(expected, 1e-300)
    there = np.flatnonzero(total)
    if not there.size:
        return np.stack([np.zeros(n), np.ones(n)], axis=1)
    at = np.arange(n)  # across gaps, straight lines
    return np.stack([np.interp(at, there, np.unwrap(shared[there])), np.interp(at, there, amplitude[there])], axis=1)


def is_pattern(first: FloatArray, second: FloatArray) -> bool:
    """Whether amplitudes (n,) of two halves of the points change together.

    Then the points of a regular pattern add the same to each other in all lines, phases as well as amplitudes: what the
    halves have in common is no error of the track, which changes phases alone.
    """
    a, b = first - first.mean(), second - second.mean()
    return float((a * b).mean()) > PATTERN * float(np.sqrt((a * a).mean() * (b * b).mean()))


def standing_alone(chips: Chips) -> BoolArray:
    """Which points (n_point,) have most of the power of their strongest lines.

    The others share these with more points.
    """
    own, noise = own_phase(strongest_rows(chips), chips)
    power = (np.abs(own) ** 2).max(axis=1)
    return np.asarray(power > ALONE * (power + noise))


def strongest_rows(chips: Chips) -> ComplexArray:
    """The strongest line of each chip, centred on its brightest Doppler, with all of its band, (n_point, n)."""
    energy = (np.abs(chips.values) ** 2).sum(axis=2, dtype=np.float64)
    strongest = energy.argmax(axis=1)
    lines = np.ascontiguousarray(chips.values[np.arange(strongest.size), strongest])
    return centred_rows(lines, chips.count, WHOLE * lines.shape[1], blur=1)[0]


def own_phase(rows: ComplexArray, chips: Chips) -> tuple[Complex128Array, FloatArray]:
    """Each row's amplitude with its own phase and Doppler (n_point, n), and its power besides, (n_point,)."""
    n_point, n = rows.shape
    own, noise = np.zeros((n_point, n), np.complex128), np.ones(n_point)
    for i in range(n_point):
        count = int(chips.count[i])
        if count < 4:
            continue
        row = rows[i, :count].astype(np.complex128)
        at, slope, flat = np.arange(count) - (count - 1) / 2, 0.0, row
        for _ in range(3):
            ends = flat[: count // 2].sum(), flat[count - count // 2 :].sum()
            slope += float(np.angle(ends[1] * np.conj(ends[0]))) / (count - count // 2)
            line = np.exp(1j * slope * at)
            flat = row * np.conj(line)
        amplitude = flat.mean()
        own[i, :count] = amplitude * line
        noise[i] = max(
            float((np.abs(row) ** 2).mean() - np.abs(amplitude) ** 2), 1e-6 * float((np.abs(row) ** 2).mean())
        )
    return own, noise


def believed(first: FloatArray, second: FloatArray) -> FinePhase:
    """What two independent estimates (n,), rad, of a phase have in common, by a Wiener filter.

    Of a signal S and noise N in each, the mean of both has the power S + N / 2, and the product of one with the other
    tells S. Where S does not stand out of the product's own noise, nothing is believed. The error that is left where
    something is believed is S (N / 2) / (S + N / 2).
    """
    n = first.size
    spectra = fft_rows(np.stack([first, second]).astype(np.complex128), inverse=False)
    common = (spectra[0] * np.conj(spectra[1])).real
    mean = np.abs(spectra.sum(axis=0) / 2) ** 2
    half = n // 2 + 1
    gain, error, beyond = np.zeros(n), 0.0, 0.0
    bands = np.array_split(np.arange(half), max(min(BANDS, half // LEAST_BINS), 1))
    for number, band in enumerate(bands):
        signal, power = float(common[band].mean()), float(mean[band].mean())
        noise = max(power - signal, 0.0)
        share = signal / power if power > 0 and signal > DOUBT * noise * np.sqrt(2 / band.size) else 0.0
        share = min(max(share, 0.0), 1.0)
        gain[band], gain[-band] = share, share
        error += band.size * share * noise
        if number == max(len(bands) - OFF_END, 0):
            beyond = share * power * float(band.mean()) ** 2 / half
    phase = fft_rows((spectra.sum(axis=0, keepdims=True) / 2 * gain), inverse=True)[0].real
    return FinePhase(np.asarray(phase), float(np.sqrt(2 * error) / n), float(np.sqrt(2 * beyond) / n))
