"""Blends of windowed rows: compiled inner loops of `operations.Blend`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, types
from numpy.typing import NDArray

from blocksar.arrays import ComplexArray, FloatArray, IntArray
from blocksar.kernels.lanes import LANES, load, load_imag, load_real, store_complex
from blocksar.kernels.loops import COMPILED, PART, REAL_ROW, REAL_ROWS, SAMPLES_IN, SAMPLES_OUT, loop
from blocksar.kernels.operations import BLEND_BEYOND

SHARES = types.float32[:, ::1]


@loop(
    SAMPLES_IN, types.Array(types.complex64, 3, "C", readonly=True), types.Array(types.int64, 1, "C", readonly=True),
    types.int64, SAMPLES_OUT, **COMPILED,
)  # fmt: skip
def window_rows(values: ComplexArray, windows: ComplexArray, which: IntArray, k: int, out: ComplexArray) -> None:
    """Apply windows to rows: out[r, i] = values[r, i] windows[which[r], k, i].

    Parameters
    ----------
    values : (n_row, n) complex64
    windows : (n_window, count, n) complex64
    which : (n_row,) int64
    k : int
    out : (n_row, n) complex64
        May be `values`.
    """
    n = windows.shape[2]
    whole = n - n % LANES
    for r in range(values.shape[0]):
        row, result, window = values[r], out[r], windows[which[r], k]
        for i in range(0, whole, LANES):
            real, imag = load_real(row, i), load_imag(row, i)
            a, b = load_real(window, i), load_imag(window, i)
            store_complex(result, i, real * a - imag * b, real * b + imag * a)
        for i in range(whole, n):
            result[i] = row[i] * window[i]


@loop(REAL_ROWS, REAL_ROW, SHARES, **COMPILED)
def evaluate_shares(coefficients: FloatArray, z: FloatArray, out: NDArray[np.float32]) -> None:
    """Evaluate polynomials: out[r, i] = sum_k coefficients[r, k] z_i^k, clipped to BLEND_BEYOND.

    Parameters
    ----------
    coefficients : (n_row, order + 1) float
    z : (n,) float
    out : (n_row, n) float32
    """
    value, order = np.empty(z.size), coefficients.shape[1] - 1
    for r in range(coefficients.shape[0]):
        value[:] = coefficients[r, order]
        for k in range(order):
            c = coefficients[r, order - 1 - k]
            for i in range(z.size):
                value[i] = c + z[i] * value[i]
        for i in range(z.size):
            out[r, i] = min(max(value[i], BLEND_BEYOND[0]), BLEND_BEYOND[1])


@njit(**PART, **COMPILED)
def _lagrange(share: Any, k: int, count: int) -> Any:
    """Lagrange polynomial k through 0, 1 / (count - 1), .. 1, at a vector or number of shares."""
    weight, steps = share - share + np.float32(1), np.float32(count - 1)
    for other in range(count):
        if other != k:
            weight = weight * ((share * steps - np.float32(other)) * np.float32(1.0 / (k - other)))
    return weight


@loop(SAMPLES_IN, SHARES, types.int64, types.int64, SAMPLES_OUT, **COMPILED)
def blend_rows(part: ComplexArray, share: NDArray[np.float32], k: int, count: int, total: ComplexArray) -> None:
    """Blend rows: total[r, i] += L_k(share[r, i]) part[r, i], with Lagrange polynomial k of `count` equal steps.

    Parameters
    ----------
    part : (n_row, at least n) complex64
    share : (n_row or 1, n) float32
    k, count : int
        The first part, k = 0, is not added to what `total` holds.
    total : (n_row, n) complex64
        May be `part`.
    """
    n = share.shape[1]
    whole = n - n % LANES
    for r in range(part.shape[0]):
        row, result, at = part[r], total[r], share[r % share.shape[0]]
        for i in range(0, whole, LANES):
            weight = _lagrange(load(at, i), k, count)
            real, imag = weight * load_real(row, i), weight * load_imag(row, i)
            if k > 0:
                real, imag = real + load_real(result, i), imag + load_imag(result, i)
            store_complex(result, i, real, imag)
        for i in range(whole, n):
            value = _lagrange(at[i], k, count) * row[i]
            result[i] = value + result[i] if k > 0 else value
