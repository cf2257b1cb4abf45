"""Smooth functions of ground range and yaw: tensor Chebyshev series."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit, types

from blocksar import solvers
from blocksar.arrays import FloatArray
from blocksar.kernels.loops import COMPILED, PART, REAL_ROW, REAL_ROWS, loop

SERIES = types.Array(types.float64, 4, "C", readonly=True)


@dataclass(frozen=True, kw_only=True)
class GroundRange:
    """Coordinate from `near` to `far`, m: ground range G = sqrt(R^2 - h^2) of an antenna at `height` h, m.

    Where a target lies on the ground, thus its Doppler and its whole history, is smooth in G. In R it is not where the
    ground comes close to the nadir: dG/dR = R / G grows without bound there, and a series in R of degree n leaves an
    error of about (x - sqrt(x^2 - 1))^n with x = (far + near - 2 h) / (far - near), 2^-n where the nadir is a quarter
    of half a swath away.
    """

    near: float
    far: float
    height: float

    def place(self, epoch_range: FloatArray) -> FloatArray:
        """Scale epoch ranges to -1 at `near` .. 1 at `far`, linear in ground range."""
        near, far = (float(self.on_ground(np.array(end))) for end in (self.near, self.far))
        return (2 * self.on_ground(epoch_range) - near - far) / (far - near)

    def nodes(self, count: int) -> FloatArray:
        """Epoch ranges (count,), m, at the nodes `solvers.end_nodes`."""
        near, far = (float(self.on_ground(np.array(end))) for end in (self.near, self.far))
        nodes = np.hypot(self.height, near + (far - near) * (1 + solvers.end_nodes(count)) / 2)
        nodes[[0, -1]] = self.near, self.far
        return nodes

    def on_ground(self, epoch_range: FloatArray) -> FloatArray:
        """Convert epoch ranges to ground ranges, m."""
        return np.sqrt(np.maximum(epoch_range**2 - self.height**2, 0.0))


@dataclass(frozen=True, kw_only=True, eq=False)
class Surface:
    """A smooth function of ground range and yaw from `low` to `high`, rad: a tensor Chebyshev series."""

    series: FloatArray
    along: GroundRange
    low: float
    high: float

    def __call__(self, epoch_range: FloatArray, yaw: FloatArray) -> FloatArray:
        """Evaluate at epoch ranges, m, and yaws, rad, broadcast."""
        return self.at(self.along.place(epoch_range), self.across(yaw))

    def across(self, yaw: FloatArray) -> FloatArray:
        """Scale yaws to -1 at `low` .. 1 at `high`."""
        return (2 * yaw - self.low - self.high) / (self.high - self.low)

    def at(self, u: FloatArray, v: FloatArray) -> FloatArray:
        """Evaluate at scaled ground ranges and yaws, -1 .. 1, broadcast."""
        u, v = np.broadcast_arrays(u, v)
        values = np.empty(u.size)
        sum_series(np.array(self.series, order="C"), u.ravel(), v.ravel(), values)
        return values.reshape(u.shape)


def fit_surface(values: FloatArray, *, along: GroundRange, yaw: FloatArray, degree: tuple[int, int]) -> Surface:
    """Fit the tensor series of values (n_range, n_yaw) at `along.nodes` and at yaws spaced as `solvers.end_nodes`."""
    in_range = solvers.node_series(values, min(degree[0], values.shape[0] - 1))
    series = solvers.node_series(in_range.T, min(degree[1], yaw.size - 1)).T
    return Surface(series=series, along=along, low=float(yaw[0]), high=float(yaw[-1]))


@loop(REAL_ROWS, REAL_ROW, REAL_ROW, types.float64[::1], **COMPILED)
def sum_series(series: FloatArray, u: FloatArray, v: FloatArray, values: FloatArray) -> None:
    """values[k] = sum_ij series[i, j] T_i(u[k]) T_j(v[k]), a strip of points at a time so that the T stay in cache."""
    strip = 64
    tu, tv = np.empty((max(series.shape[0], 2), strip)), np.empty((max(series.shape[1], 2), strip))
    total, inner = np.empty(strip), np.empty(strip)
    for first in range(0, u.size, strip):
        n = min(strip, u.size - first)
        _chebyshev(u[first : first + n], tu)
        _chebyshev(v[first : first + n], tv)
        for k in range(strip):
            total[k] = 0.0
        for j in range(series.shape[1]):
            for k in range(strip):
                inner[k] = 0.0
            for i in range(series.shape[0]):
                c = series[i, j]
                for k in range(strip):
                    inner[k] += c * tu[i, k]
            for k in range(strip):
                total[k] += inner[k] * tv[j, k]
        for k in range(n):
            values[first + k] = total[k]


@loop(SERIES, REAL_ROWS, REAL_ROW, REAL_ROWS, types.float64[:, :, ::1], **COMPILED)
def sum_layers(series: FloatArray, u: FloatArray, v: FloatArray, w: FloatArray, values: FloatArray) -> None:
    """values[q, l, k] = sum_hij series[q, h, i, j] T_h(w[l, k]) T_i(u[l, k]) T_j(v[k]), a strip of points at a time."""
    strip, n_level = 64, u.shape[0]
    n_layer, n_u, n_v = max(series.shape[1], 2), max(series.shape[2], 2), max(series.shape[3], 2)
    tw, tu = np.empty((n_level, n_layer, strip)), np.empty((n_level, n_u, strip))
    tv, inner = np.empty((n_v, strip)), np.empty(strip)
    total, part = np.empty((n_level, strip)), np.empty((n_level, strip))
    for first in range(0, v.size, strip):
        n = min(strip, v.size - first)
        _chebyshev(v[first : first + n], tv)
        for level in range(n_level):
            _chebyshev(u[level, first : first + n], tu[level])
            _chebyshev(w[level, first : first + n], tw[level])
        for q in range(series.shape[0]):
            _clear(total)
            for h in range(series.shape[1]):
                _clear(part)
                for i in range(series.shape[2]):
                    _sum_terms(series, q, h, i, tv, inner)
                    for level in range(n_level):
                        for k in range(strip):
                            part[level, k] += inner[k] * tu[level, i, k]
                for level in range(n_level):
                    for k in range(strip):
                        total[level, k] += part[level, k] * tw[level, h, k]
            for level in range(n_level):
                for k in range(n):
                    values[q, level, first + k] = total[level, k]


@njit(**PART, **COMPILED)
def _clear(rows: FloatArray) -> None:
    for i in range(rows.shape[0]):
        for k in range(rows.shape[1]):
            rows[i, k] = 0.0


@njit(**PART, **COMPILED)
def _sum_terms(series: FloatArray, q: int, h: int, i: int, tv: FloatArray, inner: FloatArray) -> None:
    """inner[k] = sum_j series[q, h, i, j] tv[j, k], in this order; four terms at a time, which stay in registers."""
    n_term = series.shape[3]
    for k in range(inner.size):
        inner[k] = 0.0
    whole = n_term - n_term % 4
    for j in range(0, whole, 4):
        a, b, c, d = series[q, h, i, j], series[q, h, i, j + 1], series[q, h, i, j + 2], series[q, h, i, j + 3]
        for k in range(inner.size):
            inner[k] = (((inner[k] + a * tv[j, k]) + b * tv[j + 1, k]) + c * tv[j + 2, k]) + d * tv[j + 3, k]
    for j in range(whole, n_term):
        a = series[q, h, i, j]
        for k in range(inner.size):
            inner[k] += a * tv[j, k]


@njit(**PART, **COMPILED)
def _chebyshev(u: FloatArray, t: FloatArray) -> None:
    """Chebyshev polynomials t[i, k] = T_i(u[k]) in all rows of t, at least two; zeros beyond the end of u."""
    for i in range(t.shape[0]):
        for k in range(t.shape[1]):
            t[i, k] = 0.0
    for k in range(u.size):
        t[0, k] = 1.0
        t[1, k] = u[k]
    for i in range(2, t.shape[0]):
        for k in range(u.size):
            t[i, k] = 2 * u[k] * t[i - 1, k] - t[i - 2, k]
