"""Phase too fine for splines: the line-of-sight phase of each sample, from the points' strongest range lines.

Once the chips are sharp, each sample's phase can be read off the points themselves: the angle of the sum of their
strongest lines, each turned back by its own phase. That is noise, unless the track really has so fine an error, as a
random walk of the position has. What two halves of the points have in common shows how much of it is real: each band of
frequencies is weighted as by a Wiener filter. In regular patterns other scatterers add the same to the lines of many
points. That changes amplitudes as much as phases, while an error of the track changes phases alone: the common part of
the amplitudes of both halves is subtracted.

`by_least_squares` fits splines to the phases of the points' strongest lines, each weighted by its own variance.

Entropy gives all chips the same weight, however far their points stand out of the clutter, and its prior has to serve
clutter. Once the chips are sharp, a point's phase is known sample by sample, and its accuracy too: the variance that
splines do not explain. A point that stands alone has thousands of times the information of clutter. With these weights,
splines are the estimate of maximum likelihood, with a prior of the track's error in the same units.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blocksar.arrays import BoolArray, Complex128Array, ComplexArray, FloatArray
from blocksar.autofocusing.chips import Chips, mean_sight
from blocksar.autofocusing.information import bending, information, solve, told_within_sides
from blocksar.autofocusing.phase_gradient import centred_rows
from blocksar.autofocusing.track_correction import Knots, intervals, narrowing
from blocksar.kernels.fourier import fft_rows

TURNS = 4  # of points' own phases and the shared one
BANDS = 8  # of frequencies, at most
OFF_END = 3  # from the last band: reference for power beyond the band, not attenuated by the low-pass
LEAST_BINS = 8  # of a band
NEAR_CELLS = np.arange(-64, 65) / 16  # Doppler cells from the brightest of a row in which its own line is looked for
PARTS = 128  # of a row, whose sums tell it: within one, lines so near to each other are alike
WHOLE = 8  # times the Doppler cells: a band that cuts nothing
ALONE = 0.5  # of the power of its line: a point with less does not stand alone
PATTERN = 0.15  # correlation of amplitudes
DOUBT = 3.0  # standard deviations of the halves' common power that are not believed
# Factor of the common amplitude power that is subtracted: phases of weak sums vary more than their amplitudes.
INTERFERENCE = 2.0


class FinePhase(NamedTuple):
    """Phase that both halves of the points confirm, with its expected error.

    Attributes
    ----------
    phase : (n_sample,) float
        rad.
    doubt : (n_sample,) float
        Of the power of the error that is expected, rad.
    beyond : float
        What the phase has beyond its samples, rad rms, as of a random walk, whose power falls with the square of
        frequency: it goes on beyond the samples' rate.
    """

    phase: FloatArray
    doubt: FloatArray
    beyond: float


def shared_samples(chips: Chips, weights: FloatArray) -> FloatArray:
    """Estimate phase, rad, and relative amplitude common to all points in each sample: (n_sample, 2).

    Slow parts of the phase are arbitrary.
    """
    rows = strongest_rows(chips)
    index, n = chips.index, chips.time.size
    shared, amplitude = np.zeros(n), np.ones(n)
    for _ in range(TURNS):
        turned = rows * np.exp(-1j * shared[index])
        own, noise = own_phase(turned, chips)
        share = (weights / np.maximum(noise, 1e-300))[:, None] * np.conj(own)
        values = np.where(chips.told, rows * share, 0)
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
    """Tell whether the amplitudes (n,) of two halves of the points vary together, as by an antenna pattern.

    Then the points of a regular pattern add the same to each other in all lines, phases as well as amplitudes: what the
    halves have in common is no error of the track, which changes phases alone.
    """
    a, b = first - first.mean(), second - second.mean()
    return float((a * b).mean()) > PATTERN * float(np.sqrt((a * a).mean() * (b * b).mean()))


def standing_alone(chips: Chips) -> BoolArray:
    """Mask (n_point,) of the points that hold most of the power of their strongest lines.

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
    """Amplitude of each row with its phase and Doppler, (n_point, n), and the remaining power, (n_point,)."""
    n_point, n = rows.shape
    own, noise = np.zeros((n_point, n), np.complex128), np.ones(n_point)
    valid = chips.told
    for i in range(n_point):
        count, there = int(chips.count[i]), np.flatnonzero(valid[i])
        samples, half = there.size, there.size // 2
        if half < 2:
            continue
        early, late = there[:half], there[samples - half :]
        row = rows[i, :count].astype(np.complex128)
        at, slope = np.arange(count) - (count - 1) / 2, 0.0
        if samples < count:  # a gap has sidelobes in which the next lines would stay
            slopes = 2 * np.pi / count * NEAR_CELLS
            parts = np.arange(0, count, -(-count // PARTS))
            sums, middles = np.add.reduceat(row, parts), np.add.reduceat(at, parts) / np.diff(parts, append=count)
            slope = float(slopes[np.abs((sums * np.exp(-1j * slopes[:, None] * middles)).sum(axis=1)).argmax()])
        flat = row * np.exp(-1j * slope * at)
        for _ in range(3):
            ends = flat[early].sum(), flat[late].sum()
            slope += float(np.angle(ends[1] * np.conj(ends[0])) / (late.mean() - early.mean()))
            line = np.exp(1j * slope * at)
            flat = row * np.conj(line)
        amplitude, power = flat.sum() / samples, float((np.abs(row) ** 2).sum()) / samples
        own[i, :count] = amplitude * line
        noise[i] = max(power - float(np.abs(amplitude) ** 2), 1e-6 * power)
    return own, noise


def believed(first: FloatArray, second: FloatArray) -> FinePhase:
    """Combine two independent estimates (n, 2) of a phase, rad, and relative amplitude by a Wiener filter.

    By a Wiener filter: of a signal S and noise N in each, the mean of both has the power S + N / 2, and half of their
    difference N / 2. That tells S, less what amplitudes have in common. Where it does not stand out of the noise,
    nothing is believed. The error that is left where something is believed is S (N / 2) / (S + N / 2); in the bands
    beyond, where nothing is, it is S itself, since a random walk goes on.
    """
    n = first.shape[0]
    rows = np.stack([first[:, 0], second[:, 0], first[:, 1] - first[:, 1].mean(), second[:, 1] - second[:, 1].mean()])
    spectra = fft_rows(rows.astype(np.complex128), inverse=False)
    middle, apart = (spectra[0] + spectra[1]) / 2, (spectra[0] - spectra[1]) / 2
    mean, differ = np.abs(middle) ** 2, np.abs(apart) ** 2
    shared = (spectra[2] * np.conj(spectra[3])).real
    half = n // 2 + 1
    gain, lost, beyond = np.zeros(n), np.zeros(n), 0.0
    bands = np.array_split(np.arange(half), max(min(BANDS, half // LEAST_BINS), 1))
    for number, band in enumerate(bands):
        power, noise = float(mean[band].mean()), float(differ[band].mean())
        signal = power - noise - INTERFERENCE * max(float(shared[band].mean()), 0.0)
        # Spectral lines, as from regular patterns, get a low weight: use the noise of each frequency.
        chance = float(np.sqrt(2 * (mean[band] * differ[band]).mean() / band.size))
        share = min(signal / power, 1.0) if signal > DOUBT * chance and signal > 0 else 0.0
        gain[band], gain[-band] = share, share
        if share == 0.0 and signal > 0.0 < gain.max():
            lost[band], lost[-band] = signal / power, signal / power
        if number == max(len(bands) - OFF_END, 0):
            beyond = share * power * float(band.mean()) ** 2 / half
    accepted = np.stack([gain * middle, np.sqrt(gain) * apart + np.sqrt(lost) * middle])
    phase, doubt = fft_rows(accepted, inverse=True).real
    return FinePhase(np.asarray(phase), np.asarray(doubt), float(np.sqrt(2 * beyond) / n))


LEAST_COUNT = 8  # samples of a point that counts
FLOOR = 0.03  # rad: errors of points in addition to those seen in their own phases
TOLERANCE = 0.5  # rad: points with such errors have half weight; with larger ones, angles are meaningless
ENTROPY_ERROR = 0.02  # rad rms: of the displacement that is refined


def by_least_squares(chips: Chips, start: FloatArray, before: FloatArray, weights: FloatArray) -> FloatArray:
    """Refine a displacement (n_sample, 3), m, that sharpens chips taken with `before` (n_sample, 3), by least squares.

    Minimises sum_i w_i sum_t (phase_it - k u_it . e(t) - line_i)^2 + the prior of e by Gauss-Newton steps, with
    w_i = weights_i / variance_i. The prior: displacements of `EstimatorSettings.displacement`, and accelerations of
    `EstimatorSettings.roughness` and of what is seen along the line of sight already, since errors are alike in all
    directions. And `start` itself, as far as entropy tells it: not how both sides of a gap fit.
    """
    work, wavenumber, settings = chips.work, chips.work.wavenumber, chips.work.settings
    count = intervals(work)
    narrow = chips.corrected(start).narrowed(narrowing(work, count))
    knots = Knots(work=work, n_interval=count, time=narrow.time)
    wide = Knots(work=work, n_interval=count, time=chips.time)
    seen = roughness(wide, ((before + start) * mean_sight(chips)).sum(axis=1)) * wavenumber
    rough = float(np.hypot(settings.roughness * wavenumber * knots.step**2, seen))
    far = settings.displacement * wavenumber
    prior = knots.size * bending(knots.size) / rough**2 + np.eye(3 * knots.size) / far**2
    believed = knots.size / ENTROPY_ERROR**2 * told_within_sides(narrow, knots, weights / weights.sum())
    whole = wide.fit(before + start) * wavenumber
    coefficients = np.zeros((knots.size, 3))
    for _ in range(TURNS):
        phase = point_phases(narrow.corrected(knots.values(coefficients) / wavenumber))
        share = weights * point_shares(rms(phase, narrow), narrow)
        form, _ = information(narrow, knots, share)
        each = np.where(narrow.told, (share / np.maximum(narrow.told.sum(axis=1), 1))[:, None], 0.0)
        slope = knots.adjoint(narrow.spread(each * phase)).ravel()
        slope -= np.einsum("ij,j->i", prior, (whole + coefficients).ravel())
        slope -= np.einsum("ij,j->i", believed, coefficients.ravel())
        moved = solve(form + believed + prior, slope)
        coefficients = coefficients + moved.reshape(-1, 3)
    return np.asarray(start + wide.values(coefficients) / wavenumber)


def roughness(knots: Knots, values: FloatArray) -> float:
    """Second difference, rms, of the coefficients of splines through values (n,)."""
    return float(np.sqrt((np.diff(knots.fit(values[:, None])[:, 0], 2) ** 2).mean()))


def point_phases(chips: Chips) -> FloatArray:
    """Phase (n_point, n) of each point's strongest line, rad, without its linear trend; 0 where it is not lit."""
    rows = strongest_rows(chips)
    own, _ = own_phase(rows, chips)
    return without_lines(np.asarray(np.angle(rows * np.conj(own)), np.float64), chips)


def without_lines(phase: FloatArray, chips: Chips) -> FloatArray:
    """Subtract from phases (n_point, n) the linear trend of each point; 0 where there are none."""
    out, valid = np.zeros(phase.shape), chips.told
    for i in range(phase.shape[0]):
        at = np.flatnonzero(valid[i])
        if at.size < LEAST_COUNT:
            continue
        u, flat = at - at.mean(), phase[i, at] - phase[i, at].mean()
        out[i, at] = flat - u * (u * flat).sum() / (u * u).sum()
    return out


def rms(phase: FloatArray, chips: Chips) -> FloatArray:
    """Root mean square (n_point,) of phases (n_point, n) that are 0 where there are none, rad."""
    return np.asarray(np.sqrt((phase * phase).sum(axis=1) / np.maximum(chips.told.sum(axis=1), 1)))


def point_shares(errors: FloatArray, chips: Chips) -> FloatArray:
    """Weights (n_point,), rad^-2, of points: samples over variance of phase errors (n_point,); less for outliers."""
    robust, count = 1 / (1 + (errors / TOLERANCE) ** 4), chips.told.sum(axis=1)
    return np.asarray(np.where(count < LEAST_COUNT, 0.0, count * robust / (errors**2 + FLOOR**2)))
