"""Positive definite forms of hundreds of coefficients: Cholesky factors and their inverses, in compiled loops.

Without BLAS, and with sums in one order, so that every process gets the same bits, see `blocksar.solvers`.
"""

from __future__ import annotations

import math

from numba import types

from blocksar.arrays import FloatArray
from blocksar.kernels.loops import REAL_ROWS, UNCHECKED, loop

SUMS = types.float64[:, ::1]
EXACT = {"nogil": True, **UNCHECKED}


@loop(REAL_ROWS, SUMS, **EXACT)
def decompose(form: FloatArray, upper: FloatArray) -> None:
    """Write the upper triangular r with r^T r = form, (n, n), over the zeros of `upper`."""
    n = form.shape[0]
    for j in range(n):
        row = upper[j, j:]
        for k in range(n - j):
            row[k] = form[j, j + k]
        for i in range(j):
            share, above = upper[i, j], upper[i, j:]
            for k in range(n - j):
                row[k] -= share * above[k]
        root = math.sqrt(row[0])
        for k in range(n - j):
            row[k] /= root


@loop(REAL_ROWS, SUMS, **EXACT)
def invert(upper: FloatArray, inverse: FloatArray) -> None:
    """Write the inverse of an upper triangular matrix (n, n) over the zeros of `inverse`."""
    n = upper.shape[0]
    for j in range(n - 1, -1, -1):
        inverse[j, j] = 1.0
        for i in range(n - 1, j, -1):
            share, row, below = upper[j, i], inverse[j, i:], inverse[i, i:]
            for k in range(n - i):
                row[k] -= share * below[k]
        for k in range(j, n):
            inverse[j, k] /= upper[j, j]


@loop(REAL_ROWS, SUMS, **EXACT)
def add_squares(rows: FloatArray, form: FloatArray) -> None:
    """Add sum_r rows_r rows_r^T, rows (n_row, n), to a symmetric form (n, n)."""
    n_row, n = rows.shape
    for i in range(n):
        out = form[i, i:]
        for r in range(n_row):
            share, row = rows[r, i], rows[r, i:]
            if share != 0:
                for j in range(n - i):
                    out[j] += share * row[j]
        for j in range(i + 1, n):
            form[j, i] = form[i, j]
