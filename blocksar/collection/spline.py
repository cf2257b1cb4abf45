"""Cubic splines on uniform knots: least-squares fit to samples, and evaluation with derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from blocksar.arrays import FloatArray, IntArray

# Row d, column k: coefficient of s^d, s = 0 .. 1 in an interval, of the k-th of the four basis splines there.
_BASIS = np.array([[1.0, 4.0, 1.0, 0.0], [-3.0, 0.0, 3.0, 0.0], [3.0, -6.0, 3.0, 0.0], [-1.0, 3.0, -3.0, 1.0]]) / 6


@dataclass(frozen=True, kw_only=True, eq=False)
class Spline:
    """A cubic spline with continuous second derivative.

    Attributes
    ----------
    start, step : float
        First knot, and spacing of the knots.
    coefficients : (n_interval + 3, n) float
    """

    start: float
    step: float
    coefficients: FloatArray

    @property
    def n_interval(self) -> int:
        return self.coefficients.shape[0] - 3

    def __call__(self, at: FloatArray, derivative: int = 0) -> FloatArray:
        """Values or derivatives (..., n) at places of any shape; the outermost cubics continue beyond the ends."""
        first, weights = basis(np.asarray(at, np.float64), self.start, self.step, self.n_interval, derivative)
        total = weights[..., 0, None] * self.coefficients[first]
        for k in range(1, 4):
            total = total + weights[..., k, None] * self.coefficients[first + k]
        return total


def fit_spline(at: FloatArray, values: FloatArray, n_interval: int) -> Spline:
    """The least-squares spline of values (m, n) at ascending places (m,), with knots from end to end.

    The normal equations have bands of width four, and are solved by Cholesky's method without BLAS, see `solvers`.
    """
    start, step = float(at[0]), float(at[-1] - at[0]) / n_interval
    first, weights = basis(at, start, step, n_interval, 0)
    return Spline(start=start, step=step, coefficients=solve_normal(first, weights, values, n_interval + 3))


def smoothed(at: FloatArray, values: FloatArray, n_interval: int) -> FloatArray:
    """Least-squares spline of values (m, n), at the same places; the straight line if `n_interval` is 0."""
    if n_interval:
        return fit_spline(at, values, n_interval)(at)
    away = (at - at.mean())[:, None]
    return np.asarray(values.mean(axis=0) + away * ((away * values).sum(axis=0) / (away * away).sum()))


def solve_normal(first: IntArray, weights: FloatArray, values: FloatArray, size: int) -> FloatArray:
    """Least-squares coefficients (size, n) for values (m, n) at places whose `basis` is first (m,), weights (m, 4)."""
    bands = np.zeros((4, size))  # bands[d, i] = gram[i, i + d]
    right = np.zeros((size, values.shape[1]))
    for i in range(4):
        for d in range(4 - i):
            bands[d] += np.bincount(first + i, weights[:, i] * weights[:, i + d], minlength=size)
        for axis in range(values.shape[1]):
            right[:, axis] += np.bincount(first + i, weights[:, i] * values[:, axis], minlength=size)
    bands[0] += 1e-12 * bands[0].max()  # an interval without samples
    return _solve_banded(bands, right)


def basis(at: FloatArray, start: float, step: float, n_interval: int, derivative: int) -> tuple[IntArray, FloatArray]:
    """Index of the first of four basis splines at each place (...), and their weights (..., 4)."""
    position = (at - start) / step
    first = np.clip(np.floor(position), 0, n_interval - 1)
    s = (position - first)[..., None]
    powers = _BASIS
    for _ in range(derivative):
        powers = powers[1:] * np.arange(1, powers.shape[0])[:, None] / step
    weights = np.zeros((*at.shape, 4))
    for row in powers[::-1]:
        weights = weights * s + row
    return first.astype(np.int64), weights


def _solve_banded(bands: FloatArray, right: FloatArray) -> FloatArray:
    """Solve a symmetric positive definite system with upper bands (4, m), right (m, n)."""
    size = bands.shape[1]
    factor, x = bands.copy(), right.copy()  # L^T in bands: factor[d, i] = L[i + d, i]
    for i in range(size):
        factor[0, i] = np.sqrt(factor[0, i])
        reach = min(3, size - 1 - i)
        factor[1 : reach + 1, i] /= factor[0, i]
        x[i] /= factor[0, i]
        for d in range(1, reach + 1):
            x[i + d] -= factor[d, i] * x[i]
            for e in range(d, reach + 1):
                factor[e - d, i + d] -= factor[d, i] * factor[e, i]
    for i in range(size - 1, -1, -1):
        for d in range(1, min(3, size - 1 - i) + 1):
            x[i] -= factor[d, i] * x[i + d]
        x[i] /= factor[0, i]
    return x
