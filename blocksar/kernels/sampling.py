"""Values of a two-dimensional grid of samples at scattered places between them, compiled."""

from __future__ import annotations

from functools import cache

import numpy as np
from numba import types

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.kernels.loops import loop
from blocksar.kernels.signatures import COMPILED, REAL_ROW, REAL_ROWS, SAMPLES_IN

HALF_TAPS = 8  # on either side
PHASES = 512  # intervals of a sample in the table of taps, between which taps are linear: error 4e-6
ATTENUATION = 60.0  # dB, of what lies beyond the band of 0.39 cycles a sample


@cache
def kaiser_taps() -> FloatArray:
    """Taps (PHASES + 2, 2 HALF_TAPS) of a sinc under a Kaiser window; row p is for p / PHASES beyond a sample.

    The error is 1e-3 of the strongest sample for wavenumbers up to 0.38 cycles a sample (an oversampling of 1.3).
    """
    from scipy.special import i0  # slow to import, and only products in other grids need it

    beta = 0.1102 * (ATTENUATION - 8.7)  # Kaiser's own formula
    offset = np.arange(1 - HALF_TAPS, HALF_TAPS + 1) - np.arange(PHASES + 2)[:, None] / PHASES
    window = i0(beta * np.sqrt(np.maximum(1 - (offset / HALF_TAPS) ** 2, 0))) / i0(beta)
    taps = np.sinc(offset) * window
    return np.asarray(taps / taps.sum(axis=1, keepdims=True))


def sample_places(values: ComplexArray, *, row: FloatArray, column: FloatArray) -> ComplexArray:
    """Interpolate a band-limited grid of samples, with its band about frequency zero.

    Parameters
    ----------
    values : (n_row, n_column) complex64
        0 where missing; so it is taken for 0 beyond its edges, too.
    row, column : (n,) float
        Places, in samples; finite.

    Returns
    -------
    (n,) complex64
    """
    out = np.empty(row.shape, np.complex64)
    _sample(np.ascontiguousarray(values, np.complex64), row, column, kaiser_taps(), out)
    return out


@loop(SAMPLES_IN, REAL_ROW, REAL_ROW, REAL_ROWS, types.complex64[::1], **COMPILED)
def _sample(values: ComplexArray, row: FloatArray, column: FloatArray, taps: FloatArray, out: ComplexArray) -> None:
    """out[k] = sum_ij tap_i(row[k]) tap_j(column[k]) values[i, j]."""
    count = taps.shape[1]
    weights = np.empty((2, count))
    for k in range(row.size):
        first = np.empty(2, np.int64)
        for axis in range(2):
            at = row[k] if axis == 0 else column[k]
            whole = int(np.floor(at))
            phase = (at - whole) * PHASES
            p = int(phase)
            part = phase - p
            first[axis] = whole + 1 - count // 2
            for i in range(count):
                weights[axis, i] = taps[p, i] + part * (taps[p + 1, i] - taps[p, i])
        real, imag = 0.0, 0.0
        for i in range(max(0, -first[0]), min(count, values.shape[0] - first[0])):
            line_real, line_imag = 0.0, 0.0
            for j in range(max(0, -first[1]), min(count, values.shape[1] - first[1])):
                value, weight = values[first[0] + i, first[1] + j], weights[1, j]
                line_real += weight * value.real
                line_imag += weight * value.imag
            real += weights[0, i] * line_real
            imag += weights[0, i] * line_imag
        out[k] = complex(np.float32(real), np.float32(imag))
