"""Interpolation of heights between the posts of a grid, at scattered places; compiled.

A height is the value of the polynomial of degree 5 through six posts along each axis, which errs by the sixth
derivative of the ground. Where one of the 6 x 6 is unknown, or beyond the grid, it is that of cubic convolution (Keys,
IEEE Trans. ASSP 29(6), 1981), with the posts that are lacking extrapolated along a parabola through known ones. A place
is unknown if one of the four posts about it is.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numba import njit, types
from numpy.typing import NDArray

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.kernels.loops import COMPILED, PART, REAL_ROW, REAL_ROWS, SAMPLES_IN, loop

HALF_TAPS = 8  # on either side
PHASES = 512  # intervals of a sample in the table of taps, between which taps are linear: error 4e-6
ATTENUATION = 60.0  # dB, beyond the band of 0.39 cycles a sample


@cache
def kaiser_taps() -> FloatArray:
    """Taps (PHASES + 2, 2 HALF_TAPS) of a Kaiser-windowed sinc; row p is p / PHASES beyond a sample.

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
    """Interpolate: out[k] = sum_ij tap_i(row[k]) tap_j(column[k]) values[i, j]."""
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


EXACT: dict[str, Any] = {"nogil": True, "error_model": "numpy"}  # no operations are contracted


def heights_between(posts: FloatArray, filled: FloatArray, *, row: FloatArray, column: FloatArray) -> FloatArray:
    """Interpolate heights (n,), m, at places (n,) in posts; NaN where unknown.

    Parameters
    ----------
    posts : (n_row, n_column) float
        m, NaN where unknown; at least 2 x 2.
    filled : (n_row + 2, n_column + 2) float
        `continued` of them.
    row, column : (n,) float
        NaN where there is none.
    """
    out = np.empty(row.shape)
    _interpolate(*map(np.ascontiguousarray, (posts, filled, row, column)), out)
    return out


def continued(posts: FloatArray) -> FloatArray:
    """Extend posts by one on every side, (n_row + 2, n_column + 2), extrapolating from known ones."""
    filled = np.pad(posts, 1, constant_values=np.nan)
    for _ in range(2):  # along sides, then across corners
        rim = np.pad(filled, 3, constant_values=np.nan)
        n_row, n_column = filled.shape

        def beside(way: tuple[int, int], k: int, of: NDArray[Any] = rim) -> FloatArray:
            return of[3 + k * way[0] : 3 + k * way[0] + n_row, 3 + k * way[1] : 3 + k * way[1] + n_column]  # noqa: B023

        total, count = np.zeros(filled.shape), np.zeros(filled.shape)
        for way in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            a, b, c = (beside(way, k) for k in (1, 2, 3))
            line = np.where(np.isnan(b), a, 2 * a - b)
            guess = np.where(np.isnan(b + c), line, 3 * a - 3 * b + c)
            total += np.where(np.isnan(guess), 0.0, guess)
            count += ~np.isnan(guess)
        with np.errstate(invalid="ignore"):
            filled = np.where(np.isnan(filled), total / count, filled)
    return np.ascontiguousarray(filled)


@njit(**PART, **EXACT)
def _sextic(u: float, taps: Any) -> None:
    """Weights of the posts -2 .. 3 at a fraction u between posts 0 and 1."""
    a, b, c, d, e = u + 2, u + 1, u - 1, u - 2, u - 3
    taps[0] = -b * u * c * d * e / 120
    taps[1] = a * u * c * d * e / 24
    taps[2] = -a * b * c * d * e / 12
    taps[3] = a * b * u * d * e / 12
    taps[4] = -a * b * u * c * e / 24
    taps[5] = a * b * u * c * d / 120


@njit(**PART, **EXACT)
def _cubic(u: float, taps: Any) -> None:
    """Cubic weights of the posts -1 .. 2 at a fraction u between posts 0 and 1."""
    taps[0] = ((-0.5 * u + 1.0) * u - 0.5) * u
    taps[1] = (1.5 * u - 2.5) * u * u + 1.0
    taps[2] = ((-1.5 * u + 2.0) * u + 0.5) * u
    taps[3] = (0.5 * u - 0.5) * u * u


@njit(**PART, **EXACT)
def _sum(posts: FloatArray, row: int, column: int, down: Any, along: Any, n: int) -> float:
    total = 0.0
    for i in range(n):
        part = 0.0
        for j in range(n):
            part += along[j] * posts[row + i, column + j]
        total += down[i] * part
    return total


@loop(REAL_ROWS, REAL_ROWS, REAL_ROW, REAL_ROW, types.float64[::1], **EXACT)
def _interpolate(posts: FloatArray, filled: FloatArray, row: FloatArray, column: FloatArray, out: FloatArray) -> None:
    """Interpolate at places; `filled` is `continued` posts."""
    n_row, n_column = posts.shape
    down, along = np.empty(6), np.empty(6)
    for k in range(row.size):
        out[k] = np.nan
        if not (0 <= row[k] <= n_row - 1 and 0 <= column[k] <= n_column - 1):
            continue
        i, j = min(int(row[k]), n_row - 2), min(int(column[k]), n_column - 2)
        u, v = row[k] - i, column[k] - j
        if np.isnan(posts[i, j] + posts[i, j + 1] + posts[i + 1, j] + posts[i + 1, j + 1]):
            continue
        if 2 <= i < n_row - 3 and 2 <= j < n_column - 3:
            _sextic(u, down)
            _sextic(v, along)
            out[k] = _sum(posts, i - 2, j - 2, down, along, 6)
        if np.isnan(out[k]):
            _cubic(u, down)
            _cubic(v, along)
            out[k] = _sum(filled, i, j, down, along, 4)
