"""Phase rotation and corner turns: compiled inner loops that all steps use.

Phases are polynomials along a row, in cycles, in float64; whole cycles are removed there, and only the remainder,
at most half a cycle, goes to a float32 polynomial for sine and cosine (error below 4e-7, 1e-7 rms). The plain
`numpy.exp(1j * phase)` takes a hundred times longer than these loops.

The loops process LANES samples at a time, with the vector type of `lanes`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import comb
from typing import Any

import numpy as np
from numba import njit, types
from numpy.polynomial import polynomial
from numpy.typing import NDArray

from blocksar import solvers
from blocksar.arrays import ComplexArray, FloatArray, IntArray
from blocksar.kernels.fourier import Axis
from blocksar.kernels.lanes import (
    LANES,
    cosine,
    horner,
    load,
    load_imag,
    load_real,
    prefetch,
    remainder,
    sine,
    store_complex,
)
from blocksar.kernels.loops import COMPILED, PART, REAL_ROW, REAL_ROWS, SAMPLES_IN, SAMPLES_OUT, loop

Float32Array = NDArray[np.float32]

MAX_ORDER = 9
AHEAD = 32  # rows by which columns are prefetched: their stride is too long for the CPU's own prefetcher
CACHE_LINE = 8  # complex64 samples


@dataclass(frozen=True, eq=False)
class Phase:
    """A phase in cycles, a polynomial along each row: sum_k coefficients[row, k] ((v - centre) / scale)^k.

    coefficients are (n_row, order + 1), or (1, order + 1) where all rows share them; order at most 9.
    """

    coefficients: FloatArray
    centre: float
    scale: float

    def cycles(self, values: FloatArray) -> FloatArray:
        """Evaluate the phase at values (n,): (n_row, n)."""
        z = (values - self.centre) / self.scale
        return np.asarray(polynomial.polyval(z, self.coefficients.T))

    def along(self, axis: Axis) -> FloatArray:
        """Coefficients in the normalised index of an axis, (index - size // 2) / (size / 2)."""
        offset, ratio = (axis.centre - self.centre) / self.scale, axis.step * axis.size / 2 / self.scale
        order = self.coefficients.shape[1] - 1
        shift = np.zeros((order + 1, order + 1))
        for k in range(order + 1):
            for j in range(k + 1):
                shift[k, j] = comb(k, j) * offset ** (k - j) * ratio**j
        return solvers.product(self.coefficients, shift)


@lru_cache(maxsize=32)
def unit(n: int) -> FloatArray:
    """Normalised index of n samples, (i - n // 2) / (n / 2), (n,) float64; read-only."""
    values = np.asarray((np.arange(n) - n // 2) * (2.0 / n))
    values.flags.writeable = False
    return values


def as_coefficients(coefficients: FloatArray) -> FloatArray:
    """Check the order, and convert to the contiguous float64 of the loops.

    Raises
    ------
    ValueError
        If the order is above MAX_ORDER.
    """
    if coefficients.shape[1] - 1 > MAX_ORDER:
        raise ValueError(f"order {coefficients.shape[1] - 1} > {MAX_ORDER}")
    return np.ascontiguousarray(coefficients, np.float64)


@njit(**PART, **COMPILED)
def _turn(row: Any, out: Any, i: Any, cycles: Any) -> None:
    """Rotate LANES samples from index i on by `cycles`."""
    part = remainder(cycles)
    cos, sin = cosine(part), sine(part)
    real, imag = load_real(row, i), load_imag(row, i)
    store_complex(out, i, real * cos - imag * sin, real * sin + imag * cos)


@njit(**PART, **COMPILED)
def _rest(values: Any) -> Any:
    """Samples of a row after its last whole vector, padded with zeros."""
    rest = np.empty(LANES, values.dtype)  # np.zeros would be compiled for each type
    count = values.size % LANES
    for k in range(count, LANES):
        rest[k] = 0.0
    for k in range(count):
        rest[k] = values[values.size - count + k]
    return rest


@loop(SAMPLES_IN, SAMPLES_OUT, REAL_ROW, REAL_ROWS, **COMPILED)
def _rotate(values: ComplexArray, out: ComplexArray, u: FloatArray, coefficients: FloatArray) -> None:
    n = u.size
    whole, order = n - n % LANES, coefficients.shape[1] - 1
    u_rest = _rest(u)
    for r in range(values.shape[0]):
        row, result, c = values[r, :n], out[r, :n], coefficients[r]
        for i in range(0, whole, LANES):
            _turn(row, result, i, horner(c, order, load(u, i)))
        if whole < n:
            rest = _rest(row)
            _turn(rest, rest, 0, horner(c, order, load(u_rest, 0)))
            for i in range(whole, n):
                result[i] = rest[i - whole]


def rotate(values: ComplexArray, n: int, coefficients: FloatArray, out: ComplexArray | None = None) -> None:
    """Rotate row r: out[r, i] = values[r, i] exp(2j pi sum_k coefficients[r, k] u_i^k), u_i = (i - n // 2) / (n / 2).

    Parameters
    ----------
    values : (n_row, at least n) complex64, C-contiguous
    coefficients : (n_row, order + 1) float64
        Cycles; order at most 9.
    out : (n_row, at least n) complex64, C-contiguous, optional
        By default `values` itself.

    Raises
    ------
    ValueError
        If the order is too high, there is not one row of coefficients per row of values, or an array is too small.
    """
    out = values if out is None else out
    if coefficients.shape[0] != values.shape[0]:
        raise ValueError(f"{coefficients.shape=} but {values.shape=}")
    if out.shape[0] < values.shape[0] or min(values.shape[1], out.shape[1]) < n:
        raise ValueError(f"{values.shape=} and {out.shape=}, but {n=}")
    _rotate(values, out, unit(n), as_coefficients(coefficients))


@loop(SAMPLES_IN, SAMPLES_OUT, REAL_ROW, REAL_ROWS, REAL_ROW, REAL_ROW, **COMPILED)
def rotate_scaled(
    values: ComplexArray,
    out: ComplexArray,
    u: FloatArray,
    coefficients: FloatArray,
    factor: FloatArray,
    cycles: FloatArray,
) -> None:
    """Rotate as `rotate`, with factor[r] cycles[i] added: an arbitrary phase along the row, scaled by row.

    Parameters
    ----------
    values, out : (n_row, at least n) complex64, C-contiguous
        May be the same array.
    u : (n,) float64
        `unit(n)`.
    coefficients : (n_row, 2) float64
    factor : (n_row,) float64
    cycles : (n,) float64
    """
    n = u.size
    whole = n - n % LANES
    u_rest, cycles_rest = _rest(u), _rest(cycles)
    for r in range(values.shape[0]):
        row, result, c, f = values[r, :n], out[r, :n], coefficients[r], factor[r]
        for i in range(0, whole, LANES):
            _turn(row, result, i, f * load(cycles, i) + (c[0] + c[1] * load(u, i)))
        if whole < n:
            rest = _rest(row)
            _turn(rest, rest, 0, f * load(cycles_rest, 0) + (c[0] + c[1] * load(u_rest, 0)))
            for i in range(whole, n):
                result[i] = rest[i - whole]


@loop(SAMPLES_OUT, SAMPLES_IN, types.Array(types.int64, 1, "C", readonly=True), **COMPILED)
def multiply_windows(values: ComplexArray, windows: ComplexArray, which: IntArray) -> None:
    """Apply windows: values[r, i] *= windows[which[r], i], in place.

    Parameters
    ----------
    values : (n_row, at least n) complex64, C-contiguous
    windows : (n_window, n) complex64
    which : (n_row,) int64
    """
    n = windows.shape[1]
    whole = n - n % LANES
    for r in range(values.shape[0]):
        row, window = values[r, :n], windows[which[r]]
        for i in range(0, whole, LANES):
            _multiply(row, window, i)
        if whole < n:
            rest = _rest(row)
            _multiply(rest, _rest(window), 0)
            for i in range(whole, n):
                row[i] = rest[i - whole]


@njit(**PART, **COMPILED)
def _multiply(row: Any, window: Any, i: Any) -> None:
    """Multiply LANES samples from index i on by those of the window, in place."""
    real, imag, a, b = load_real(row, i), load_imag(row, i), load_real(window, i), load_imag(window, i)
    store_complex(row, i, real * a - imag * b, real * b + imag * a)


@loop(types.Array(types.complex64, 2, "A", readonly=True), types.int64, SAMPLES_OUT, **COMPILED)
def gather_columns(values: ComplexArray, first: int, out: ComplexArray) -> None:
    """Copy columns to rows, whole cache lines at a time: out[c, i] = values[i, first + c]."""
    count = out.shape[0]
    for i in range(values.shape[0]):
        for c in range(0, count, CACHE_LINE):
            prefetch(values, i + AHEAD, first + c)
        prefetch(values, i + AHEAD, first + count - 1)
        for c in range(count):
            out[c, i] = values[i, first + c]


@loop(SAMPLES_IN, types.int64, types.int64, SAMPLES_OUT, **COMPILED)
def scatter_columns(values: ComplexArray, n: int, first: int, out: ComplexArray) -> None:
    """Copy rows back to columns: out[i, first + c] = values[c, i], i < n."""
    count = values.shape[0]
    for i in range(n):
        for c in range(0, count, CACHE_LINE):
            prefetch(out, i + AHEAD, first + c)
        prefetch(out, i + AHEAD, first + count - 1)
        for c in range(count):
            out[i, first + c] = values[c, i]
