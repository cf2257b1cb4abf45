"""Decimating low-pass filters along rows and columns, the former after a rotation of each row's phase.

A filter for decimation by D passes |nu| <= e / D cycles a sample and stops |nu| >= (1 - e) / D, with e < 1/2 the pass
edge at the new rate. What lies between is folded onto itself, outside of the pass band. It is a windowed sinc with
Kaiser's window: for an attenuation of A dB,

    n = (A - 8) / (2.285 dw) + 1 taps,  dw = 2 pi (1 - 2 e) / D,  beta = 0.1102 (A - 8.7) for A > 50,

and passes the pass band within the same error, 10^(-A / 20) at most. Taps add up to D, so that a sum over the decimated
samples, times anything in the pass band, is the sum over all samples.

References
----------
Kaiser, "Nonrecursive digital filter design using the I0-sinh window function", IEEE ISCAS 1974.
Oppenheim, Schafer, *Discrete-Time Signal Processing*, 3rd ed., 7.5.3 and 4.6.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numba import njit, types

from blocksar.arrays import ComplexArray, FloatArray, IntArray
from blocksar.kernels.lanes import (
    FEW,
    LANES,
    cosine,
    load,
    load_few,
    load_imag,
    load_real,
    remainder,
    sine,
    spread_few,
    store,
)  # fmt: skip
from blocksar.kernels.loops import COMPILED, PART, REAL_ROW, SAMPLES_IN, SAMPLES_OUT, loop
from blocksar.kernels.phase import Float32Array

WHOLE = FEW // 2  # decimated rows are made of whole vectors of real numbers
BLOCK = 4 * FEW  # real numbers of a row that are summed in registers
INDICES = types.Array(types.int64, 1, "C", readonly=True)
RUNS = types.Array(types.int64, 2, "C", readonly=True)
_REALS = types.Array(types.float32, 1, "C", readonly=True)
_MATRIX_IN = types.Array(types.float32, 2, "C", readonly=True)


@dataclass(frozen=True)
class Decimation:
    """A filter for decimation by `factor`, which passes |nu| <= edge / factor cycles a sample; no filter for 1.

    Attributes
    ----------
    factor : int
    edge : float
        e, below 1/2.
    attenuation : float
        A, dB.
    """

    factor: int
    edge: float
    attenuation: float

    @property
    def half(self) -> int:
        """Taps on either side of the middle one."""
        if self.factor == 1:
            return 0
        return int(np.ceil((self.attenuation - 8) / (2.285 * 2 * np.pi * (1 - 2 * self.edge) / self.factor) / 2))

    @property
    def taps(self) -> Float32Array:
        """(2 half + 1,) float32, read-only; they add up to the factor."""
        return _taps(self.factor, self.half, self.attenuation)

    def span(self, n: int) -> tuple[int, int]:
        """Number of decimated samples of n samples, tails included, and the position of the first."""
        size = (n + 2 * self.half - 1) // self.factor + 1
        return size, -self.half - ((size - 1) * self.factor - (n - 1 + 2 * self.half)) // 2


@lru_cache(maxsize=64)
def _taps(factor: int, half: int, attenuation: float) -> Float32Array:
    k = np.arange(-half, half + 1)
    beta = 0.1102 * (attenuation - 8.7)
    if attenuation <= 50:
        beta = 0.5842 * max(attenuation - 21, 0.0) ** 0.4 + 0.07886 * max(attenuation - 21, 0.0)
    taps = np.sinc(k / factor) * np.kaiser(2 * half + 1, beta)
    found = np.asarray(taps * (factor / taps.sum()), np.float32)
    found.flags.writeable = False
    return found


@njit(**PART, **COMPILED)
def _turn_row(row: Any, u: Any, first: Any, step: Any, real: Any, imag: Any, lead: Any) -> None:
    """Rotate a row: real[lead + i] + 1j imag[lead + i] = row[i] exp(2j pi (first + step i)); `u` counts samples."""
    n = row.size
    for k in range(0, n if n >= LANES else 0, LANES):
        i = min(k, n - LANES)  # the last vector overlaps the one before
        part = remainder(first + step * load(u, i))
        cos, sin = cosine(part), sine(part)
        a, b = load_real(row, i), load_imag(row, i)
        store(real, lead + i, a * cos - b * sin)
        store(imag, lead + i, a * sin + b * cos)
    for i in range(n if n < LANES else 0):
        turned = first + step * i
        angle = 2 * np.pi * (turned - np.rint(turned))
        cosine_, sine_ = np.float32(np.cos(angle)), np.float32(np.sin(angle))
        real[lead + i] = row[i].real * cosine_ - row[i].imag * sine_
        imag[lead + i] = row[i].real * sine_ + row[i].imag * cosine_


@loop(
    SAMPLES_IN, INDICES, REAL_ROW, REAL_ROW, REAL_ROW, _REALS, types.int64, types.int64, types.float32[:, ::1], INDICES,
    SAMPLES_OUT, SAMPLES_OUT, **COMPILED,
)  # fmt: skip
def _turn_and_decimate(
    values: ComplexArray, source: IntArray, u: FloatArray, first: FloatArray, step: FloatArray, taps: Float32Array,
    factor: int, lead: int, parts: Float32Array, target: IntArray, out: ComplexArray, others: ComplexArray,
) -> None:  # fmt: skip
    """FEW decimated samples are summed at a time, tap by tap; every factor-th sample of a row lies side by side."""
    n_out, real, imag = out.shape[1], parts[0], parts[1]
    length = (n_out + 2 * FEW - 1) // FEW * FEW + taps.size // factor + 1
    phases, sums = np.zeros((2, factor * length), np.float32), np.zeros((2, n_out + 2 * FEW), np.float32)
    x, y, re, im = phases[0], phases[1], sums[0], sums[1]
    places = np.empty(taps.size, np.int64)
    for k in range(taps.size):
        places[k] = k % factor * length + k // factor
    filled = (lead + values.shape[1] + factor - 1) // factor
    for r in range(source.size):
        _turn_row(values[source[r]], u, first[r], step[r], real, imag, lead)
        row = out[target[r]] if target[r] >= 0 else others[r]
        for p in range(factor):
            for m in range(min(filled, length)):
                x[p * length + m], y[p * length + m] = real[m * factor + p], imag[m * factor + p]
        for j in range(0, n_out, 2 * FEW):
            a, b = spread_few(np.float32(0)), spread_few(np.float32(0))
            c, d = spread_few(np.float32(0)), spread_few(np.float32(0))
            if n_out - j > FEW:
                for k in range(taps.size):
                    h, at = taps[k], places[k] + j
                    a = a + h * load_few(x, at)
                    b = b + h * load_few(y, at)
                    c = c + h * load_few(x, at + FEW)
                    d = d + h * load_few(y, at + FEW)
            else:
                for k in range(taps.size):
                    h, at = taps[k], places[k] + j
                    a = a + h * load_few(x, at)
                    b = b + h * load_few(y, at)
            store(re, j, a)
            store(im, j, b)
            store(re, j + FEW, c)
            store(im, j + FEW, d)
        for j in range(n_out):
            row[j] = complex(re[j], im[j])


def turn_and_decimate(
    values: ComplexArray, source: IntArray, first: FloatArray, step: FloatArray, decimation: Decimation,
    target: IntArray, out: ComplexArray, others: ComplexArray,
) -> None:  # fmt: skip
    """Turn row source[r] of samples i by exp(2j pi (first[r] + step[r] i)), then filter and decimate it.

    Parameters
    ----------
    values : (n_row, n) complex64
        Finite; zero where samples are missing.
    source : (k,) int
        A row may be taken several times.
    first, step : (k,) float
        Cycles; phases are computed in float64.
    decimation : Decimation
    target : (k,) int
        The row of `out` that becomes of it; where negative, it is row r of `others`.
    out, others : (..., m) complex64
        m = padded(decimation.span(n)[0]); samples behind the filter's tails are zero.
    """
    n = values.shape[1]
    lead = decimation.half - decimation.span(n)[1]
    parts = np.zeros((2, lead + n + decimation.factor + LANES), np.float32)
    first, step = (np.asarray(cycles - np.rint(cycles), np.float64) for cycles in (first, step))
    u = np.arange(n, dtype=np.float64)
    _turn_and_decimate(
        values, source, u, first, step, decimation.taps, decimation.factor, lead, parts, target, out, others
    )


def padded(n: int) -> int:
    """Columns allocated for n decimated samples: a multiple of WHOLE."""
    return -(-n // WHOLE) * WHOLE


@loop(_MATRIX_IN, RUNS, _REALS, types.int64, types.float32[:, ::1], **COMPILED)
def _add_decimated(rows: Float32Array, runs: IntArray, taps: Float32Array, factor: int, out: Float32Array) -> None:
    m = rows.shape[1]
    source, target = rows.reshape(rows.shape[0] * m), out.reshape(out.shape[0] * m)
    whole = m - m % BLOCK
    for r in range(runs.shape[0]):
        first, n, at, lead, size = runs[r, 0], runs[r, 1], runs[r, 2], runs[r, 3] - taps.size // 2, runs[r, 4]
        # Of the rows of `out` those that reach any row of the run.
        begin_k, end_k = max(-((lead + taps.size - 1) // factor), 0), min((n - 1 - lead) // factor + 1, size)
        for c in range(0, m, BLOCK if whole else FEW):
            wide = c < whole
            for k in range(begin_k, end_k):
                begin = lead + k * factor
                low, high, into = max(0, -begin), min(taps.size, n - begin), (at + k) * m
                begin += first
                if wide:
                    p, q = load_few(target, into + c), load_few(target, into + c + FEW)
                    u, v = load_few(target, into + c + 2 * FEW), load_few(target, into + c + 3 * FEW)
                    for t in range(low, high):
                        h, place = taps[t], (begin + t) * m + c
                        p = p + h * load_few(source, place)
                        q = q + h * load_few(source, place + FEW)
                        u = u + h * load_few(source, place + 2 * FEW)
                        v = v + h * load_few(source, place + 3 * FEW)
                    store(target, into + c, p)
                    store(target, into + c + FEW, q)
                    store(target, into + c + 2 * FEW, u)
                    store(target, into + c + 3 * FEW, v)
                else:
                    for e in range(c, m, FEW):
                        p = load_few(target, into + e)
                        for t in range(low, high):
                            p = p + taps[t] * load_few(source, (begin + t) * m + e)
                        store(target, into + e, p)
            if not wide:
                break


def add_decimated(rows: ComplexArray, runs: IntArray, decimation: Decimation, out: ComplexArray) -> None:
    """Filter and decimate runs of rows along the first axis, and add the results to `out`, in place.

    What belongs together may come in several runs: the filter is linear.

    Parameters
    ----------
    rows : (n_row, m) complex64
        m is a multiple of WHOLE.
    runs : (k, 5) int
        The first row of each, and how many there are; the first row of `out` to which it is added; where that lies, in
        rows of the run, of which the next ones are `decimation.factor` apart; and how many there are.
    decimation : Decimation
    out : (n_out, m) complex64
    """
    _add_decimated(rows.view(np.float32), runs, decimation.taps, decimation.factor, out.view(np.float32))
