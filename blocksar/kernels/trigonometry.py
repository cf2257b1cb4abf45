"""Sine, cosine and polynomial evaluation for compiled loops over vectors of samples."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.polynomial import chebyshev

from blocksar.kernels.lanes import spread
from blocksar.kernels.signatures import COMPILED, PART


def fit_even(function: Any, degree: int, most: float = 0.5) -> tuple[float, ...]:
    """Power coefficients, in x^2, of an even function on |x| <= most, by Chebyshev interpolation."""
    series = chebyshev.Chebyshev.interpolate(lambda s: function(np.sqrt(s)), degree, domain=[0.0, most**2])
    return tuple(float(c) for c in series.convert(kind=np.polynomial.Polynomial, domain=[-1, 1], window=[-1, 1]).coef)


_S = fit_even(lambda x: np.where(x > 1e-9, np.sin(np.pi * x) / np.maximum(x, 1e-9), np.pi), 4)
_C = fit_even(lambda x: np.cos(np.pi * x), 5)
_S0, _S1, _S2, _S3, _S4 = (np.float32(c) for c in _S)
_C0, _C1, _C2, _C3, _C4, _C5 = (np.float32(c) for c in _C)


@njit(inline="always")
def _half_sine(x: Any) -> Any:
    s = x * x
    return x * (_S0 + s * (_S1 + s * (_S2 + s * (_S3 + s * _S4))))


@njit(inline="always")
def _half_cosine(x: Any) -> Any:
    s = x * x
    return _C0 + s * (_C1 + s * (_C2 + s * (_C3 + s * (_C4 + s * _C5))))


# Sine and cosine come from those of half the angle: polynomials for the whole angle have terms that cancel near half a
# cycle, and err twice as much.


@njit(inline="always")
def sine(x: Any) -> Any:
    """sin(2 pi x) in float32, |x| <= 1/2."""
    half = _half_sine(x)
    return (half + half) * _half_cosine(x)


@njit(inline="always")
def cosine(x: Any) -> Any:
    """cos(2 pi x) in float32, |x| <= 1/2."""
    half_sine, half_cosine = _half_sine(x), _half_cosine(x)
    return half_cosine * half_cosine - half_sine * half_sine


@njit(**PART, **COMPILED)
def cosine_and_sine(x: Any) -> Any:
    """Both at the cost of one."""
    half_sine, half_cosine = _half_sine(x), _half_cosine(x)
    return half_cosine * half_cosine - half_sine * half_sine, (half_sine + half_sine) * half_cosine


@njit(**PART, **COMPILED)
def horner(c: Any, order: Any, u: Any) -> Any:
    """sum_k c[k] u^k for the vector u, k up to `order`."""
    value = spread(c[order])
    for k in range(order):
        value = c[order - 1 - k] + u * value
    return value
