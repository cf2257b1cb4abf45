"""Range profiles of pulses, which back-projection interpolates at the range of each pixel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray, IntArray
from blocksar.collection.collection import Collection
from blocksar.collection.weighting import FLAT, Taper
from blocksar.kernels.device import CPU, Device
from blocksar.kernels.fourier import Axis, fast_length, unit_phasor
from blocksar.kernels.lanes import FEW, FIXED_RANGE
from blocksar.kernels.nonuniform import sum_phasors
from blocksar.kernels.operations import Transform

UPSAMPLING = CPU.upsampling  # bins per range cell
MARGIN = FEW + 1  # bins on either side of the range window that are loaded with those that the spline uses


@dataclass(frozen=True, kw_only=True, eq=False)
class Profiles:
    """Upsampled range profiles of some pulses, ready for the quadratic spline.

    Attributes
    ----------
    values : (n_row, n_bin) complex64
        Spline coefficients: bin b is at R - reference_range = (b - centre) * spacing. The phase of the middle
        frequency, exp(4j pi (fc + f_middle) / c (R - reference_range)), is removed: it varies too fast to interpolate.
    valid : (n,) int or float
        Number of samples of each pulse that are not NaN; under a weighting in range, or of frequencies that are not
        uniform, the sum of their weights over the mean weight.
    pulses : slice
        The pulses of the collection.
    centre : int
        Bin of the reference range.
    spacing : float
        Spacing of the bins, m.
    """

    values: ComplexArray
    valid: IntArray | FloatArray
    pulses: slice
    centre: int
    spacing: float

    def at(self, rows: IntArray, offset: FloatArray) -> ComplexArray:
        """Evaluate the quadratic spline of profiles at a few places; beyond the bins, the outermost are used.

        Parameters
        ----------
        rows : (n,) int
        offset : (n, m) float
            R - reference_range, m.

        Returns
        -------
        (n, m) complex64
        """
        place = np.clip(offset / self.spacing + self.centre, 1, self.values.shape[1] - 2)
        nearest = np.floor(place + 0.5).astype(np.int64)
        u, row = (place - nearest).astype(np.float32), rows[:, None]
        before, here, after = (self.values[row, nearest + shift] for shift in (-1, 0, 1))
        return np.asarray(0.5 * (0.5 - u) ** 2 * before + (0.75 - u**2) * here + 0.5 * (0.5 + u) ** 2 * after)


def range_profiles(
    signal: ComplexArray,
    *,
    collection: Collection,
    pulses: slice,
    threads: int,
    taper: Taper = FLAT,
    upsampling: int = UPSAMPLING,
    device: Device = CPU,
) -> Profiles:
    """Form range profiles: mean over frequency of signal exp(4j pi (f - f_middle) d / c), d = R - reference_range.

    The zero-padded samples are divided by the frequency response of the quadratic spline, sinc(f / f_bins)^3. The
    spline through the transformed bins then has the exact level over the band; spectral images are its only error.
    Frequencies that are not uniform are weighed by their shares of the band, and transformed where they lie.

    Parameters
    ----------
    signal : (n, n_range_frequency) complex64
        Not changed. NaN samples count as missing.
    collection : Collection
    pulses : slice
        n pulses of the collection.
    threads : int
        The result does not depend on it.
    taper : Taper
        Weighting along range frequency.
    upsampling : int
        Bins per range cell.
    device : Device
        Where the values are.

    Returns
    -------
    Profiles

    Raises
    ------
    ValueError
        If the shapes disagree.

    References
    ----------
    Unser, "Splines: a perfect fit for signal and image processing", IEEE Signal Processing Magazine 16(6), 1999.
    """
    n, period = collection.n_range_frequency, _period(collection, upsampling)
    if period // 2 + MARGIN >= FIXED_RANGE:
        raise ValueError(f"{n} range frequencies make {period} bins; at most {2 * FIXED_RANGE:.0f} can be addressed")
    if signal.shape != (pulses.stop - pulses.start, n):
        raise ValueError(f"{signal.shape=} but {pulses=} of {n} range frequencies")
    if not collection.band.even:
        return _uneven_profiles(signal, collection, pulses, threads, taper, upsampling, device)
    step, middle = collection.range_frequency_step, n // 2
    frequency = Axis(-middle * step, step, n)
    delay = Axis(-(period // 2) / (period * step), 1 / (period * step), period)
    before, after = Transform(frequency, delay, inverse=True).phases()
    lead = unit_phasor(before.cycles(frequency.values)[0]) * spline_lead(frequency.values / step, period)
    weights = taper.samples(n)
    weights /= weights.mean()
    if not taper.uniform:
        lead *= weights
    lead = device.put((lead * (period / n)).astype(np.complex64))
    trail = device.put(unit_phasor(after.cycles(delay.values)[0]))
    centre, spacing = profile_axis(collection, upsampling)
    values = device.empty((signal.shape[0], period + 2 * MARGIN), np.complex64)
    signal, over_band = device.put(signal), device.put(weights)
    valid: Any = np.empty(signal.shape[0], np.int64 if taper.uniform else np.float64)

    def work(rows: slice) -> None:
        missing = np.isnan(signal[rows])
        if taper.uniform:
            valid[rows] = n - device.take(np.count_nonzero(missing, axis=1))
        else:
            valid[rows] = n - device.take(np.where(missing, over_band, 0.0).sum(axis=1))
        group = device.empty((rows.stop - rows.start, period), np.complex64)
        np.multiply(signal[rows], lead, out=group[:, :n])
        group[:, :n][missing] = 0
        group[:, n:] = 0
        group = device.fft_rows(group, inverse=True)
        out = values[rows]
        np.multiply(group, trail, out=out[:, MARGIN:-MARGIN])
        # The middle frequency is a sample of the axis: without its phase the profile is periodic in the window.
        out[:, -MARGIN:] = out[:, MARGIN : 2 * MARGIN]
        out[:, :MARGIN] = out[:, -2 * MARGIN : -MARGIN]

    device.run(work, signal.shape[0], period, threads)
    return Profiles(
        values=values,
        valid=valid,
        pulses=pulses,
        centre=centre,
        spacing=spacing,
    )


def _uneven_profiles(
    signal: ComplexArray, collection: Collection, pulses: slice, threads: int, taper: Taper, upsampling: int,
    device: Device,
) -> Profiles:  # fmt: skip
    """`range_profiles` of frequencies that are not uniform; on a CPU, whose values go to the device."""
    n, period = collection.n_range_frequency, _period(collection, upsampling)
    turns = (collection.range_frequency - profile_frequency(collection)) / collection.range_frequency_step
    weights = taper.weights(collection.range_frequency, collection.band)
    weights /= weights.mean()
    lead = weights * spline_lead(turns, period) / n
    centre, spacing = profile_axis(collection, upsampling)
    values = np.empty((signal.shape[0], period + 2 * MARGIN), np.complex64)
    valid = np.empty(signal.shape[0])

    def work(rows: slice) -> None:
        missing = np.isnan(signal[rows])
        valid[rows] = n - np.where(missing, weights, 0.0).sum(axis=1)
        strengths = np.where(missing, 0.0, signal[rows] * lead)
        values[rows] = sum_phasors(strengths, turns / period, values.shape[1])

    CPU.run(work, signal.shape[0], period, threads)
    return Profiles(values=device.put(values), valid=valid, pulses=pulses, centre=centre, spacing=spacing)


def profile_frequency(collection: Collection) -> float:
    """The range frequency whose phase profiles lack, Hz: the middle one, or of uneven ones the middle of the band."""
    f = collection.range_frequency
    return float(f[f.size // 2] if collection.band.even else (f[0] + f[-1]) / 2)


def spline_lead(frequency: FloatArray, period: int) -> FloatArray:
    """Factors (n,) that turn samples at frequencies, cycles per period, into those of the spline's coefficients.

    The inverse of the frequency response of the quadratic spline, sinc(f)^3 at f cycles per bin.
    """
    return np.asarray(1 / np.sinc(frequency / period) ** 3)


def spline_error(*, upsampling: float) -> float:
    """Root mean square relative error of the quadratic spline over a band 1 / upsampling of the sampling rate.

    The spline has images of a frequency f (cycles per bin) at f + k, weaker by (sinc(f + k) / sinc(f))^3.
    """
    f = np.linspace(-0.5, 0.5, 129) / upsampling
    k = np.delete(np.arange(-8, 9), 8)
    images = (np.sinc(f[:, None] + k) / np.sinc(f[:, None])) ** 3
    return float(np.sqrt(np.mean(np.sum(images**2, axis=1))))


def profile_bins(collection: Collection, upsampling: int = UPSAMPLING) -> int:
    """Number of bins of a profile."""
    return _period(collection, upsampling) + 2 * MARGIN


def profile_axis(collection: Collection, upsampling: int = UPSAMPLING) -> tuple[int, float]:
    """The bin of the reference range, and the spacing of bins, m."""
    period = _period(collection, upsampling)
    return period // 2 + MARGIN, collection.range_window / period


def _period(collection: Collection, upsampling: int) -> int:
    """Length of the transform to range profiles."""
    return fast_length(upsampling * collection.n_band)
