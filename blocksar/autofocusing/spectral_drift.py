"""Drift of spectra: the line-of-sight velocity of the error, from the power that moves along Doppler.

The spectra of a chip over short windows of time all show the same scatterers, moved along Doppler by the error's
line-of-sight velocity. They are compared without their phases, so that neither many equal scatterers in a line nor
errors of many radians between windows matter, which stop the phase gradient. The resolution is coarse: a start for it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blocksar.arrays import Complex128Array, ComplexArray, FloatArray, IntArray
from blocksar.autofocusing.chips import Chips
from blocksar.autofocusing.phase_gradient import strongest_lines
from blocksar.kernels.fourier import fast_length, fft_rows

PADDING = 4.0  # cells of a spectrum for each sample of its window
TURNS = 6  # of spectra in common and their shifts
SETTLED = 0.05  # cells: shifts that change by less are final
STEP = 2.5  # cells from window to window by an acceleration of `Settings.acceleration`
REACH = 8  # cells from window to window, at most


class Spectra(NamedTuple):
    """Amplitude spectra of chips over short windows, transformed along Doppler.

    values : (n_pair, n_cell) complex
        Of a point and a window that it is lit over, ordered by points.
    point, window : (n_pair,) int
    middle : (n_window,) float
        Samples of the collection at which windows lie.
    """

    values: ComplexArray
    point: IntArray
    window: IntArray
    middle: FloatArray


def phase_of_drift(chips: Chips, weights: FloatArray) -> FloatArray:
    """Phase (n_sample,), rad, that the chips share, from the drift of their spectra; its line is arbitrary.

    Windows are as long as `Work.short`. The spectra of each chip are shifted so that they fit the sum of its others:
    the shifts, one a window, and the sums are found in turns. The shifts change slowly from window to window: with
    equal scatterers at equal distances spectra fit one another in many ways.

    Parameters
    ----------
    weights : (n_point,) float
    """
    spectra = short_spectra(chips, weights)
    n_window, n_cell = spectra.middle.size, spectra.values.shape[1]
    if np.unique(spectra.window).size < 2:
        return np.zeros(chips.time.size)
    frequency = (np.arange(n_cell) + n_cell // 2) % n_cell - n_cell // 2
    shift = np.zeros(n_window)
    for _ in range(TURNS):
        turned = spectra.values * np.exp(2j * np.pi / n_cell * shift[spectra.window][:, None] * frequency)
        others = np.repeat(*_sums(turned, spectra.point), axis=0) - turned
        order = np.argsort(spectra.window, kind="stable")
        product, counts = _sums((spectra.values * np.conj(others))[order], spectra.window[order])
        product[:, 0] = 0
        there = np.unique(spectra.window)
        fit = fft_rows(product, inverse=True).real / counts[:, None]
        found = np.interp(np.arange(n_window), there, _beside(fit, smooth_path(fit)))
        found -= found.mean()
        moved, shift = float(np.abs(found - shift).max()), found
        if moved < SETTLED:
            break
    rate = np.interp(np.arange(chips.time.size), spectra.middle, shift) * (2 * np.pi / n_cell)
    return np.asarray(np.cumsum(rate))


def short_spectra(chips: Chips, weights: FloatArray) -> Spectra:
    """Spectra of the strongest lines over windows that overlap by a half; chips count by `weights` (n_point,)."""
    work = chips.work
    samples = max(work.geometry.collection.n_pulse // chips.time.size, 1)
    size = max(work.short // samples, 8)
    starts = np.arange(0, max(chips.time.size - size, 0) + 1, size // 2)
    lines, n_cell = strongest_lines(chips), fast_length(PADDING * size)
    taper = np.hanning(size + 2)[1:-1].astype(np.float32)
    values, point, window = [], [], []
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
        values.append(amplitude)
        point += [i] * lit.size
        window += lit.tolist()
    joined = np.concatenate(values) if values else np.zeros((0, n_cell))
    return Spectra(
        values=fft_rows(joined.astype(np.complex64), inverse=False),
        point=np.array(point, np.int64),
        window=np.array(window, np.int64),
        middle=np.asarray(starts + (size - 1) / 2, np.float64),
    )


def _sums(values: ComplexArray | Complex128Array, group: IntArray) -> tuple[Complex128Array, IntArray]:
    """Sums of rows (n, m) with equal numbers `group` (n,), ascending, and how many there are of each."""
    _, first, counts = np.unique(group, return_index=True, return_counts=True)
    return np.add.reduceat(values.astype(np.complex128), first, axis=0), counts


def smooth_path(fit: FloatArray) -> IntArray:
    """The periodic cells (n,), one in each row of `fit` (n, m), with the largest sum and the smallest steps.

    A step of STEP cells costs as much as the spread of `fit`. By dynamic programming (Viterbi).
    """
    n, m = fit.shape
    scale = max(float(np.sqrt((fit * fit).mean())), 1e-300)
    reach = np.arange(-REACH, REACH + 1)
    total, back = fit[0] / scale, np.zeros((n, m), np.int64)
    for k in range(1, n):
        ways = np.stack([np.roll(total, step) - (step / STEP) ** 2 for step in reach])
        back[k] = ways.argmax(axis=0)
        total = ways.max(axis=0) + fit[k] / scale
    path = np.zeros(n, np.int64)
    path[-1] = total.argmax()
    for k in range(n - 1, 0, -1):
        path[k - 1] = (path[k] - reach[back[k, path[k]]]) % m
    return path


def _beside(values: FloatArray, cell: IntArray) -> FloatArray:
    """Shifts (n,), in cells, of the highest places of periodic rows (n, m) at `cell` (n,), by parabolas; continuous."""
    n_row, n = values.shape
    row = np.arange(n_row)
    before, at, after = values[row, cell - 1], values[row, cell], values[row, (cell + 1) % n]
    bend = before - 2 * at + after
    finer = np.where(bend < 0, np.clip((before - after) / np.where(bend < 0, 2 * bend, 1.0), -0.5, 0.5), 0.0)
    return np.asarray(np.unwrap(cell.astype(np.float64), period=n) + finer)
