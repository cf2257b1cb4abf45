"""Random samples, and sums in extended precision."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray

N_SCATTERER = 400  # scatterers of clutter: few enough to sum directly
SINGLE = 5e-7  # a complex64 product (1.2e-7) and float32 sine and cosine, accurate to 3.5e-7


def noise(*shape: int, seed: int = 0) -> ComplexArray:
    rng = np.random.default_rng(seed)
    values = (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)).astype(np.complex64)
    values.flags.writeable = False
    return values


def power_sum(coefficients: FloatArray, u: FloatArray) -> np.ndarray:
    """sum_k coefficients[r, k] u^k in extended precision, (n_row, n)."""
    return sum(np.longdouble(c)[:, None] * np.longdouble(u) ** k for k, c in enumerate(coefficients.T))


def largest(values: np.ndarray) -> float:
    return float(np.abs(values).max(initial=0.0))


def clutter(n_pulse: int, n_column: int, *, seed: int = 0) -> ComplexArray:
    rng = np.random.default_rng(seed)
    return rng.standard_normal((n_pulse, 2 * n_column), dtype=np.float32).view(np.complex64)


def derivatives(function: Callable[[float], FloatArray], order: int, step: float) -> FloatArray:
    """Divided derivative f^(order) / order! by central differences on nine points; Vandermonde weights."""
    places = np.arange(-4, 5.0)
    weights = np.linalg.solve(np.vander(places, increasing=True).T, np.eye(9)[order])
    return sum(w * function(p * step) for w, p in zip(weights, places, strict=True)) / step**order
