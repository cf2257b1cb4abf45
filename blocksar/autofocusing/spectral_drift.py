"""Drift of spectra: the error's line-of-sight velocity, from the shift of power along Doppler.

The spectra of a chip over short windows of time all show the same scatterers, moved along Doppler by the error's
line-of-sight velocity. They are compared without their phases, so that neither many equal scatterers in a line nor
errors of many radians between windows matter, which stop the phase gradient. The resolution is coarse: a start for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from blocksar.arrays import Complex128Array, ComplexArray, FloatArray, IntArray
from blocksar.autofocusing.chips import Chips
from blocksar.kernels.fourier import fast_length, fft_rows

PADDING = 4.0  # cells of a spectrum for each sample of its window
TURNS = 6  # of spectra in common and their shifts
SETTLED = 0.05  # cells: shifts that change by less are final
STEP = 2.5  # cells from window to window by an acceleration of `EstimatorSettings.acceleration`
REACH = 8  # cells from window to window, at most


class Spectra(NamedTuple):
    """Amplitude spectra of chips over short windows, transformed along Doppler.

    values : sequence of (n, n_cell) complex64
        Of each point, one for each window that it is lit over.
    window : sequence of (n,) int
        These windows' numbers.
    middle : (n_window,) float
        Samples of the collection at which windows lie.
    """

    values: Sequence[ComplexArray]
    window: Sequence[IntArray]
    middle: FloatArray


def phase_of_drift(chips: Chips, weights: FloatArray) -> FloatArray:
    """Estimate the common phase (n_sample,), rad, of chips from the drift of their spectra, up to a line.

    Windows are as long as `Work.short`. The spectra of each chip are shifted so that they fit the sum of its others:
    the shifts, one a window, and the sums are found in turns. The shifts change slowly from window to window: with
    equal scatterers at equal distances spectra fit one another in many ways.

    Parameters
    ----------
    chips : Chips
        With their strongest lines.
    weights : (n_point,) float
    """
    spectra = short_spectra(chips, weights)
    counts = np.bincount(np.concatenate([*spectra.window, np.zeros(0, np.int64)]), minlength=spectra.middle.size)
    there = np.flatnonzero(counts)
    if there.size < 2:
        return np.zeros(chips.time.size)
    n_window, n_cell = counts.size, spectra.values[0].shape[1]
    frequency = (np.arange(n_cell) + n_cell // 2) % n_cell - n_cell // 2
    shift = np.zeros(n_window)
    for _ in range(TURNS):
        product = products_with_others(spectra, np.exp(2j * np.pi / n_cell * shift[:, None] * frequency))[there]
        product[:, 0] = 0
        fit = fft_rows(product, inverse=True).real / counts[there, None]
        found = np.interp(np.arange(n_window), there, _beside(fit, smooth_path(fit)))
        found -= found.mean()
        moved, shift = float(np.abs(found - shift).max()), found
        if moved < SETTLED:
            break
    rate = np.interp(np.arange(chips.time.size), spectra.middle, shift) * (2 * np.pi / n_cell)
    return np.asarray(np.cumsum(rate))


def short_spectra(chips: Chips, weights: FloatArray) -> Spectra:
    """Spectra of chips over windows that overlap by a half; chips count by `weights` (n_point,)."""
    work = chips.work
    samples = max(work.geometry.collection.n_pulse // chips.time.size, 1)
    size = max(work.short // samples, 8)
    starts = np.arange(0, max(chips.time.size - size, 0) + 1, size // 2)
    lines, n_cell = chips.values, fast_length(PADDING * size)
    taper = np.hanning(size + 2)[1:-1].astype(np.float32)
    values, window = [], []
    for i in range(lines.shape[0]):
        lit = np.flatnonzero((starts >= chips.first[i]) & (starts + size <= chips.first[i] + chips.count[i]))
        if lit.size < 2:
            continue
        cut = lines[i][:, (starts[lit] - chips.first[i])[:, None] + np.arange(size)] * taper
        padded = np.zeros((cut.shape[0] * lit.size, n_cell), np.complex64)
        padded[:, :size] = cut.reshape(-1, size)
        power = np.abs(fft_rows(padded, inverse=False)).reshape(-1, lit.size, n_cell) ** 2
        amplitude = np.sqrt(power.sum(axis=0))  # of powers, a few bright windows would tell all
        amplitude *= np.sqrt(weights[i]) / max(float(amplitude.sum(dtype=np.float64)) / lit.size, 1e-30)
        values.append(fft_rows(amplitude.astype(np.complex64), inverse=False))
        window.append(lit)
    return Spectra(values, window, np.asarray(starts + (size - 1) / 2, np.float64))


def products_with_others(spectra: Spectra, turns: Complex128Array) -> Complex128Array:
    """Sum over points of each window's spectrum times the conjugate spectra of the point's other windows.

    Both are (n_window, n_cell); `turns` shift the windows' spectra.
    """
    product = np.zeros(turns.shape, np.complex128)
    for values, window in zip(spectra.values, spectra.window, strict=True):
        turned = values * turns[window]
        product[window] += values * np.conj(turned.sum(axis=0) - turned)
    return product


def smooth_path(fit: FloatArray) -> IntArray:
    """The periodic cells (n,), one in each row of `fit` (n, m), with the largest sum and the smallest steps.

    A step of STEP cells costs as much as the spread of `fit`. By dynamic programming (Viterbi).
    """
    n, m = fit.shape
    scale = max(float(np.sqrt((fit * fit).mean())), 1e-300)
    reach = np.arange(-REACH, REACH + 1)
    before, cost = (np.arange(m) - reach[:, None]) % m, (reach[:, None] / STEP) ** 2
    total = fit / scale
    for k in range(1, n):
        total[k] += (total[k - 1, before] - cost).max(axis=0)
    path = np.zeros(n, np.int64)
    path[-1] = total[-1].argmax()
    for k in range(n - 1, 0, -1):
        ways = before[:, path[k]]
        path[k - 1] = ways[(total[k - 1, ways] - cost[:, 0]).argmax()]
    return path


def _beside(values: FloatArray, cell: IntArray) -> FloatArray:
    """Refine maxima at `cell` (n,) of periodic rows (n, m) by parabolas; return shifts (n,) in cells, unwrapped."""
    n_row, n = values.shape
    row = np.arange(n_row)
    before, at, after = values[row, cell - 1], values[row, cell], values[row, (cell + 1) % n]
    bend = before - 2 * at + after
    finer = np.where(bend < 0, np.clip((before - after) / np.where(bend < 0, 2 * bend, 1.0), -0.5, 0.5), 0.0)
    return np.asarray(np.unwrap(cell.astype(np.float64), period=n) + finer)
