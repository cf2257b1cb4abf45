"""Levenberg-Marquardt for the coefficients of the azimuth steps: compiled, since a plan fits hundreds of them.

Unknowns are scaled to the lines' extent in time and Doppler. With v = f + P(z), delayed to y = z - D(v) and resampled
to h = v + R(v), z' = y / h'(v), the level of a line is h + E(z') and its stretch is dz'/dz. P, D, R and E are sums of
powers, z^(order - 1) for each order, whose coefficients are the unknowns, in this order.

The sum of squares has three parts: the level less its weighted mean over each line, times `level_weight`; the stretch
less 1, times `stretch_weight`; and the departure of each unknown from its start, times `pull`. Every sum runs in one
fixed order, so that a plan is the same to the bit in every process.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from blocksar.arrays import FloatArray, IntArray

POWERS = 8  # of a variable, from 0: orders up to 6 with their derivatives
OPTIONS: Any = {"nogil": True, "fastmath": {"contract", "nsz", "reassoc"}}


@njit(cache=True, **OPTIONS)
def level_lines(
    time: FloatArray,
    doppler: FloatArray,
    rate: FloatArray,
    share: FloatArray,
    level_weight: FloatArray,
    stretch_weight: FloatArray,
    orders: IntArray,
    ends: IntArray,
    start: FloatArray,
    pull: FloatArray,
    enough: float,
    steps: int,
) -> FloatArray:
    """The unknowns that minimise the sum of squares, by modified Gram-Schmidt on the damped, scaled system.

    Parameters
    ----------
    time, doppler, rate : (n_line, n) float
        The lines, scaled: z, f and df/dz.
    share : (n_line, n) float
        Weights of the mean over a line; their sum over each line is 1.
    level_weight, stretch_weight : (n_line, n) float
    orders : (n_unknown,) int
        Order of each unknown: of P, of D, of R, of E.
    ends : (3,) int
        Where the unknowns of D, R and E begin.
    start, pull : (n_unknown,) float
    enough : float
        Stop when a step lowers the sum of squares by less than this fraction.
    steps : int
        Largest number of steps.

    Returns
    -------
    (n_unknown,) float
    """
    n, m = start.size, 2 * time.size + start.size
    residual, trial = np.empty(m), np.empty(m)
    rows, trial_rows = np.empty((n, m)), np.empty((n, m))
    q, right = np.empty((n, m + n)), np.empty(m + n)
    x, step, scale = start.copy(), np.zeros(n), np.zeros(n)
    cost, damping, growth, taken = np.inf, 1e-3, 2.0, 0
    while True:
        evaluate(
            time, doppler, rate, share, level_weight, stretch_weight, orders, ends, x + step, start, pull,
            trial, trial_rows,
        )  # fmt: skip
        new_cost = _dot(trial, trial)
        if taken == 0 and not np.isfinite(new_cost):
            return x
        if new_cost < cost:
            last = taken == steps or cost - new_cost <= enough * new_cost
            x, cost = x + step, new_cost
            if last:
                return x
            residual, trial, rows, trial_rows = trial, residual, trial_rows, rows
            if taken > 0:
                damping, growth = max(damping / 5, 1e-14), 2.0
            taken += 1
            for i in range(n):
                scale[i] = max(scale[i], np.sqrt(_dot(rows[i], rows[i])))
        else:
            damping, growth = damping * growth, growth * 2
            if damping > 1e12:
                return x
        for i in range(n):
            size = scale[i] if scale[i] > 0 else 1.0
            for k in range(m):
                q[i, k] = rows[i, k] / size
            for k in range(n):
                q[i, m + k] = np.sqrt(damping) if k == i else 0.0
        for k in range(m + n):
            right[k] = -residual[k] if k < m else 0.0
        _solve(q, right, step)
        for i in range(n):
            step[i] /= scale[i] if scale[i] > 0 else 1.0


@njit(forceinline=True, **OPTIONS)
def evaluate(
    time: FloatArray,
    doppler: FloatArray,
    rate: FloatArray,
    share: FloatArray,
    level_weight: FloatArray,
    stretch_weight: FloatArray,
    orders: IntArray,
    ends: IntArray,
    x: FloatArray,
    start: FloatArray,
    pull: FloatArray,
    residual: FloatArray,
    rows: FloatArray,
) -> None:  # longer than most: the residuals and their derivatives are checked side by side
    """Write the residuals (m,) and their derivatives (n_unknown, m), one row an unknown."""
    n_line, count, n = time.shape[0], time.shape[1], x.size
    size = n_line * count
    zs, vs, ws = np.empty(POWERS), np.empty(POWERS), np.empty(POWERS)
    at_level, at_stretch = np.empty((n, count)), np.empty(n)
    levels = np.empty(count)
    for line in range(n_line):
        mean = 0.0
        for k in range(count):
            z0 = time[line, k]
            _fill(zs, z0)
            v = doppler[line, k] + _sum(zs, x, orders, 0, ends[0], 0, 0)
            slope = rate[line, k] + _sum(zs, x, orders, 0, ends[0], 0, 1)
            _fill(vs, v)
            y = z0 - _sum(vs, x, orders, ends[0], ends[1], 0, 0)
            bend = _sum(vs, x, orders, ends[0], ends[1], 0, 1)
            # R is a shift, the other orders are of phases: one more.
            h = v + _sum(vs, x, orders, ends[1], ends[2], 1, 0)
            pace = 1 + _sum(vs, x, orders, ends[1], ends[2], 1, 1)
            curl = _sum(vs, x, orders, ends[1], ends[2], 1, 2)
            z = y / pace
            _fill(ws, z)
            levels[k] = h + _sum(ws, x, orders, ends[2], n, 0, 0)
            stretch = (1 - bend * slope - z * curl * slope) / pace
            mean += levels[k] * share[line, k]
            residual[size + line * count + k] = stretch_weight[line, k] * (stretch - 1)
            e_slope = _sum(ws, x, orders, ends[2], n, 0, 1)
            d_curl = _sum(vs, x, orders, ends[0], ends[1], 0, 2)
            r_twist = _sum(vs, x, orders, ends[1], ends[2], 1, 3)
            # Derivatives by v and slope, which only P changes, and by the terms of D and R.
            z_by_v = -(bend + z * curl) / pace
            stretch_by_v = -(d_curl * slope + (z_by_v * curl + z * r_twist) * slope + stretch * curl) / pace
            stretch_by_slope = -(bend + z * curl) / pace
            for i in range(ends[0]):
                term, term_slope = _term(zs, orders[i], 0), _term(zs, orders[i], 1)
                at_level[i, k] = (pace + e_slope * z_by_v) * term
                at_stretch[i] = stretch_by_v * term + stretch_by_slope * term_slope
            for i in range(ends[0], ends[1]):
                term, term_slope = _term(vs, orders[i], 0), _term(vs, orders[i], 1)
                at_level[i, k] = -e_slope / pace * term
                at_stretch[i] = (-term_slope * slope + term / pace * curl * slope) / pace
            for i in range(ends[1], ends[2]):
                term, term_slope = _term(vs, orders[i] + 1, 0), _term(vs, orders[i] + 1, 1)
                z_by_r = -z * term_slope / pace
                at_level[i, k] = term + e_slope * z_by_r
                term_curl = _term(vs, orders[i] + 1, 2)
                at_stretch[i] = -(z_by_r * curl * slope + z * term_curl * slope + stretch * term_slope) / pace
            for i in range(ends[2], n):
                at_level[i, k] = _term(ws, orders[i], 0)
                at_stretch[i] = 0.0
            for i in range(n):
                rows[i, size + line * count + k] = stretch_weight[line, k] * at_stretch[i]
        for k in range(count):
            residual[line * count + k] = level_weight[line, k] * (levels[k] - mean)
        for i in range(n):
            middle = _dot(at_level[i], share[line])
            for k in range(count):
                rows[i, line * count + k] = level_weight[line, k] * (at_level[i, k] - middle)
    for i in range(n):
        residual[2 * size + i] = pull[i] * (x[i] - start[i])
        for k in range(n):
            rows[i, 2 * size + k] = pull[i] if k == i else 0.0


@njit(forceinline=True, **OPTIONS)
def _fill(powers: FloatArray, value: float) -> None:
    """1, value, value^2, ..."""
    powers[0] = 1.0
    for k in range(1, powers.size):
        powers[k] = powers[k - 1] * value


@njit(forceinline=True, **OPTIONS)
def _term(powers: FloatArray, order: int, derivative: int) -> float:
    """A derivative of z^(order - 1), from the powers of z."""
    if order - 1 < derivative:
        return 0.0
    factor = 1.0
    for k in range(order - derivative, order):
        factor *= k
    return factor * powers[order - 1 - derivative]


@njit(forceinline=True, **OPTIONS)
def _sum(
    powers: FloatArray, x: FloatArray, orders: IntArray, first: int, end: int, more: int, derivative: int
) -> float:
    """A derivative of the sum of x_i z^(orders_i + more - 1), i = first .. end - 1."""
    total = 0.0
    for i in range(first, end):
        total += x[i] * _term(powers, orders[i] + more, derivative)
    return total


@njit(forceinline=True, **OPTIONS)
def _dot(a: FloatArray, b: FloatArray) -> float:
    total = 0.0
    for k in range(a.size):
        total += a[k] * b[k]
    return total


@njit(forceinline=True, **OPTIONS)
def _solve(q: FloatArray, right: FloatArray, x: FloatArray) -> None:
    """Write the x that minimises |sum_k x_k q_k - right|; the other arrays are overwritten."""
    n, m = q.shape
    r = np.zeros((n, n))
    for i in range(n):
        r[i, i] = np.sqrt(_dot(q[i], q[i]))
        for k in range(m):
            q[i, k] /= r[i, i]
        x[i] = _dot(q[i], right)
        for k in range(m):
            right[k] -= x[i] * q[i, k]
        for j in range(i + 1, n):
            r[i, j] = _dot(q[i], q[j])
            for k in range(m):
                q[j, k] -= r[i, j] * q[i, k]
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            x[i] -= r[i, j] * x[j]
        x[i] /= r[i, i]
