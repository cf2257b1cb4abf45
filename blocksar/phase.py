"""Phase multiplication and fractional delays: the compiled inner loops that every step shares.

Phases are handed over in cycles, in float64; whole cycles are taken out there, and only the remainder, at
most half a cycle, goes to a float32 polynomial for sine and cosine (error below 7e-7, 1.4e-7 rms). Written plainly,
`numpy.exp(1j * phase)` takes fifty times longer than these loops.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from blocksar.parameters import ComplexArray, FloatArray

Float32Array = NDArray[np.float32]

STRIP = 256  # samples in flight: the float64 scratch of a strip stays in the first-level cache


def _fit_even(function: Any, degree: int) -> tuple[float, ...]:
    """Power coefficients in x^2 of an even function on |x| <= 1/2, by Chebyshev interpolation."""
    series = chebyshev.Chebyshev.interpolate(lambda s: function(np.sqrt(s)), degree, domain=[0.0, 0.25])
    return tuple(float(c) for c in series.convert(kind=np.polynomial.Polynomial, domain=[-1, 1], window=[-1, 1]).coef)


_S = _fit_even(lambda x: np.where(x > 1e-9, np.sin(2 * np.pi * x) / np.maximum(x, 1e-9), 2 * np.pi), 6)
_C = _fit_even(lambda x: np.cos(2 * np.pi * x), 7)
_S0, _S1, _S2, _S3, _S4, _S5, _S6 = (np.float32(c) for c in _S)
_C0, _C1, _C2, _C3, _C4, _C5, _C6, _C7 = (np.float32(c) for c in _C)


@njit(inline="always")
def sine(x: Any) -> Any:
    """sin(2 pi x) in float32, |x| <= 1/2."""
    s = x * x
    return x * (_S0 + s * (_S1 + s * (_S2 + s * (_S3 + s * (_S4 + s * (_S5 + s * _S6))))))


@njit(inline="always")
def cosine(x: Any) -> Any:
    """cos(2 pi x) in float32, |x| <= 1/2."""
    s = x * x
    return _C0 + s * (_C1 + s * (_C2 + s * (_C3 + s * (_C4 + s * (_C5 + s * (_C6 + s * _C7))))))


MAX_ORDER = 9


def rotate_polynomial(values: ComplexArray, coefficients: FloatArray, z: FloatArray) -> None:
    """values[r, i] *= exp(2j pi sum_k coefficients[r, k] z[i]^k), in place.

    Parameters
    ----------
    values : (n_row, n) complex64, C-contiguous
    coefficients : (n_row, order + 1) float64
        Cycles; order at most 9.
    z : (n,) float64
    """
    if coefficients.shape[1] > MAX_ORDER + 1:
        raise ValueError(f"order {coefficients.shape[1] - 1} > {MAX_ORDER}")
    # A fixed order lets the compiler keep the coefficients in registers and vectorise over samples.
    padded = np.zeros((coefficients.shape[0], MAX_ORDER + 1))
    padded[:, : coefficients.shape[1]] = coefficients
    _rotate_polynomial(values, padded, z)


@njit(cache=True, nogil=True, fastmath={"contract", "nsz"})
def _rotate_polynomial(values: ComplexArray, coefficients: FloatArray, z: FloatArray) -> None:
    n_row, n = values.shape
    for r in range(n_row):
        c0, c1, c2, c3 = coefficients[r, 0], coefficients[r, 1], coefficients[r, 2], coefficients[r, 3]
        c4, c5, c6 = coefficients[r, 4], coefficients[r, 5], coefficients[r, 6]
        c7, c8, c9 = coefficients[r, 7], coefficients[r, 8], coefficients[r, 9]
        for i in range(n):
            u = z[i]
            cycles = c0 + u * (c1 + u * (c2 + u * (c3 + u * (c4 + u * (c5 + u * (c6 + u * (c7 + u * (c8 + u * c9))))))))
            x = np.float32(cycles - np.rint(cycles))
            cos, sin = cosine(x), sine(x)
            v = values[r, i]
            values[r, i] = complex(v.real * cos - v.imag * sin, v.real * sin + v.imag * cos)


@njit(cache=True, nogil=True, fastmath={"contract", "nsz"})
def rotate_outer(values: ComplexArray, factor: FloatArray, cycles: FloatArray) -> None:
    """values[r, i] *= exp(2j pi factor[r] cycles[i]), in place: a phase that scales with frequency.

    Parameters
    ----------
    values : (n_row, n) complex64
    factor : (n_row,) float64
    cycles : (n,) float64
    """
    n_row, n = values.shape
    for r in range(n_row):
        f = factor[r]
        for i in range(n):
            whole = f * cycles[i]
            x = np.float32(whole - np.rint(whole))
            cos, sin = cosine(x), sine(x)
            v = values[r, i]
            values[r, i] = complex(v.real * cos - v.imag * sin, v.real * sin + v.imag * cos)


def interpolation_taps(n_tap: int, *, occupancy: float, n_phase: int = 256) -> Float32Array:
    """Least-squares taps for band-limited interpolation at any fraction of a sample.

    For each fraction p / n_phase the taps minimise the mean square error over frequencies
    |f| <= occupancy / 2 (cycles a sample): a small normal system of sinc values. At the same cost they err
    less than a Kaiser-windowed sinc, the more so the lower the occupancy.

    Parameters
    ----------
    n_tap : int
        Even.
    occupancy : float
        Part of the sampling rate that the signal fills, below 1.

    Returns
    -------
    (n_phase + 1, n_tap) float32
        Row p interpolates at position p / n_phase between samples n_tap / 2 - 1 and n_tap / 2 of its window.
    """
    k = np.arange(n_tap) - (n_tap // 2 - 1)
    gram = np.sinc(occupancy * (k[:, None] - k[None, :])) + 1e-9 * np.eye(n_tap)
    fraction = np.arange(n_phase + 1) / n_phase
    right = np.sinc(occupancy * (fraction[None, :] - k[:, None]))
    return np.ascontiguousarray(np.linalg.solve(gram, right).T, dtype=np.float32)


def interpolation_error(n_tap: int, occupancy: float) -> float:
    """Root mean square relative error of these taps over the occupied band, at the worst fraction."""
    taps = interpolation_taps(n_tap, occupancy=occupancy, n_phase=2)[1].astype(np.float64)
    k = np.arange(n_tap) - (n_tap // 2 - 1)
    f = np.linspace(-occupancy / 2, occupancy / 2, 129)
    error = np.exp(2j * np.pi * f[:, None] * k) @ taps - np.exp(1j * np.pi * f)
    return float(np.sqrt(np.mean(np.abs(error) ** 2)))


def taps_needed(occupancy: float, *, error: float, at_most: int = 32) -> int:
    """The fewest even number of taps whose error stays below `error`."""
    for n_tap in range(4, at_most + 1, 2):
        if interpolation_error(n_tap, occupancy) <= error:
            return n_tap
    return at_most


@njit(cache=True, nogil=True, fastmath={"contract", "nsz"})
def stretch_rows(values: ComplexArray, out: ComplexArray, scale: FloatArray, middle: float, taps: Float32Array) -> None:
    """out[r, i] = values[r] at position middle + (i - middle) scale[r]; zero beyond the ends.

    The positions move by almost one sample a step, so over a short strip the window slides evenly and the
    weights change linearly: both loops then run over contiguous samples.

    Parameters
    ----------
    values, out : (n_row, n) complex64
    scale : (n_row,) float64
        Near 1.
    middle : float
        The position that stays.
    taps : (n_phase + 1, n_tap) float32
    """
    n_row, n = values.shape
    n_phase, n_tap = taps.shape[0] - 1, taps.shape[1]
    half = n_tap // 2 - 1
    pad = STRIP + n_tap
    padded = np.zeros(n + 2 * pad, np.complex64)
    real = np.empty(STRIP, np.float32)
    imag = np.empty(STRIP, np.float32)
    for r in range(n_row):
        padded[pad : pad + n] = values[r]
        s = scale[r]
        drift = abs(s - 1.0)
        strip = STRIP if drift * STRIP < 1.0 / 64.0 else max(1, int(1.0 / (64.0 * drift)))
        i = 0
        while i < n:
            position = middle + (i - middle) * s
            whole = int(np.floor(position))
            m = min(strip, n - i)
            # The strip ends where the window would have to jump by a sample against the output.
            fraction = position - whole
            end = fraction + (m - 1) * (s - 1.0)
            if end >= 1.0:
                m = max(1, int((1.0 - fraction) / drift))
            elif end < 0.0:
                m = max(1, int(fraction / drift) + 1)
            end = min(max(fraction + (m - 1) * (s - 1.0), 0.0), 1.0)
            for j in range(m):
                real[j] = np.float32(0.0)
                imag[j] = np.float32(0.0)
            base = whole - half + pad
            if base >= 0 and base + n_tap + m <= n + 2 * pad:
                a, b = fraction * n_phase, end * n_phase
                ia, ib = min(int(a), n_phase - 1), min(int(b), n_phase - 1)
                da, db = np.float32(a - ia), np.float32(b - ib)
                for k in range(n_tap):
                    wa = taps[ia, k] + da * (taps[ia + 1, k] - taps[ia, k])
                    wb = taps[ib, k] + db * (taps[ib + 1, k] - taps[ib, k])
                    slope = (wb - wa) / np.float32(max(m - 1, 1))
                    for j in range(m):
                        v = padded[base + k + j]
                        w = wa + slope * np.float32(j)
                        real[j] += w * v.real
                        imag[j] += w * v.imag
            for j in range(m):
                out[r, i + j] = complex(real[j], imag[j])
            i += m


def compile_kernels() -> None:
    """Compile this module's loops, or load them from numba's cache, by running each on next to nothing."""
    values, one = np.zeros((1, 8), np.complex64), np.ones(1)
    _rotate_polynomial(values, np.zeros((1, MAX_ORDER + 1)), np.zeros(8))
    rotate_outer(values, one, np.zeros(8))
    stretch_rows(values, values.copy(), one, 4.0, interpolation_taps(4, occupancy=0.5))
