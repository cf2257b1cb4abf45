"""Levenberg-Marquardt for the coefficients of the azimuth steps: compiled, since a plan fits hundreds of them.

Unknowns are scaled to the lines' extent in time and Doppler. With v = f + P(z), delayed to y = z - D(v) and resampled
to h = v + R(v), z' = y / h'(v), the level of a line is h + E(z') and its stretch is dz'/dz. P, D, R and E are sums of
powers, z^(order - 1) for each order, whose coefficients are the unknowns, in this order.

The sum of squares has three parts: the level less its weighted mean over each line, times `level_weight`; the stretch
less 1, times `stretch_weight`; and the departure of each unknown from its start, times `pull`. Every sum runs in one
fixed order, so that a plan is the same to the bit in every process.

Order 2 in Doppler and the deramp nearly cancel: the minimum lies at the end of a long, curved valley. Steps follow its
bend by geodesic acceleration (Transtrum and Sethna, arXiv:1201.5885): with v the step of Levenberg-Marquardt and r''
the second derivative of the residuals along it, taken as a difference, the same damped system with r'' for r gives a,
and the step is v + a / 2. No step leads from lines that do not fold, and whose Doppler rate has one sign, to others.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit, types

from blocksar.arrays import FloatArray, IntArray
from blocksar.kernels.loops import PART, loop

POWERS = 6  # of a variable, from 0: orders up to 5, with their derivatives
LEAST_DAMPING, MOST_DAMPING = 1e-14, 1e12
EASE = 10.0  # by which the damping falls after a step that lowers the sum of squares
PROBE = 0.1  # fraction of a step at which its bend is measured
FOLDED = 0.02  # stretch at which a line folds over
MOST_BEND = 1.0  # times v: with a larger a the step is not tried, but shortened
_ROW, _ROWS, _INDICES = types.float64[::1], types.float64[:, ::1], types.int64[::1]
_NAMED: Any = types.NamedTuple  # carries no types
_NUMBERS = types.float64, types.float64, types.int64
OPTIONS: Any = {"nogil": True, "fastmath": {"contract", "nsz", "reassoc"}}


class LevellingProblem(NamedTuple):
    """Lines to level, and the unknowns of the problem.

    Attributes
    ----------
    time, doppler, rate : (n_line, n) float
        The lines, scaled: z, f and df/dz.
    share : (n_line, n) float
        Weights of the mean over a line; their sum over each line is 1.
    level_weight, stretch_weight : (n_line, n) float
    orders : (n_unknown,) int
        Order of each unknown, 2 to 5: of P, of D, of R (to 4), of E.
    ends : (3,) int
        Where the unknowns of D, R and E begin.
    start, pull : (n_unknown,) float
    """

    time: FloatArray
    doppler: FloatArray
    rate: FloatArray
    share: FloatArray
    level_weight: FloatArray
    stretch_weight: FloatArray
    orders: IntArray
    ends: IntArray
    start: FloatArray
    pull: FloatArray


@loop(_NAMED([_ROWS] * 6 + [_INDICES] * 2 + [_ROW] * 2, LevellingProblem), *_NUMBERS, **OPTIONS)
def level_lines(problem: LevellingProblem, damping: float, enough: float, steps: int) -> FloatArray:
    """Find the unknowns that minimise the sum of squares; systems are solved by modified Gram-Schmidt.

    Parameters
    ----------
    problem : Problem
    damping : float
        The first, of squared steps in units of the derivatives' norms.
    enough : float
        Stop when a step lowers the sum of squares by less than this fraction.
    steps : int
        Largest number of steps.

    Returns
    -------
    (n_unknown,) float
    """
    start = problem.start
    n, m = start.size, 2 * problem.time.size + start.size
    sums, vectors = np.empty((2, m)), np.empty((6, n))
    residual, trial = sums[0], sums[1]
    x, at, norm, scale, step, found = vectors[0], vectors[1], vectors[2], vectors[3], vectors[4], vectors[5]
    rows, trial_rows, q, r = np.empty((n, m)), np.empty((n, m)), np.empty((n, m)), np.empty((n, n))
    damped, below = np.empty((n + 1, 2 * n)), np.empty((n, n))
    for i in range(n):
        x[i], at[i], norm[i], scale[i], step[i], found[i] = start[i], start[i], 0.0, 1.0, 0.0, 0.0
    cost, growth, taken, probing, accepted = np.inf, 2.0, 0, False, False
    while True:
        sound = evaluate(problem, at, trial, trial_rows, not probing)
        if probing:
            for k in range(m):
                along = 0.0
                for i in range(n):
                    along += rows[i, k] * step[i] / scale[i]
                trial[k] = 2 / PROBE * ((trial[k] - residual[k]) / PROBE - along)
        else:
            new_cost = _dot(trial, trial)
            if taken == 0 and not new_cost < np.inf:
                break
            if new_cost < cost and (sound or not accepted):
                accepted = sound
                last = taken == steps or cost - new_cost <= enough * new_cost
                cost = new_cost
                for i in range(n):
                    x[i] = at[i]
                if last:
                    break
                residual, trial, rows, trial_rows = trial, residual, trial_rows, rows
                if taken > 0:
                    damping, growth = max(damping / EASE, LEAST_DAMPING), 2.0
                taken += 1
                for i in range(n):
                    norm[i] = max(norm[i], np.sqrt(_dot(rows[i], rows[i])))
                    scale[i] = norm[i] if norm[i] > 0.0 else 1.0
                    for k in range(m):
                        q[i, k] = rows[i, k] / scale[i]
                _orthogonalise(q, r)
            else:
                damping, growth = damping * growth, growth * 2
        while damping <= MOST_DAMPING:
            _solve_damped(q, r, trial if probing else residual, damping, damped, below, found)
            probing = not probing
            if probing:
                for i in range(n):
                    step[i], at[i] = found[i], x[i] + PROBE * found[i] / scale[i]
                break
            if _dot(found, found) <= MOST_BEND**2 * _dot(step, step):
                for i in range(n):
                    at[i] = x[i] + (step[i] + found[i] / 2) / scale[i]
                break
            damping, growth = damping * growth, growth * 2
        if damping > MOST_DAMPING:
            break
    return x


@njit(inline="always", **OPTIONS)
def evaluate(
    problem: LevellingProblem, x: FloatArray, residual: FloatArray, rows: FloatArray, derivatives: bool
) -> bool:  # longer than most: the residuals and their derivatives are checked side by side
    """Compute the residuals (m,) and, on request, their derivatives (n_unknown, m), one row an unknown.

    Returns whether no line folds over and the Doppler rate before the steps in Doppler has one sign.
    """
    time, doppler, rate, share, level_weight, stretch_weight, orders, ends, start, pull = problem
    n_line, count, n = time.shape[0], time.shape[1], x.size
    size = n_line * count
    # Power coefficients of P, D, R and E and of their derivatives. R is a shift, the others are of phases: one order
    # less.
    series = np.empty((11, POWERS))
    for k in range(11):
        for power in range(POWERS):
            series[k, power] = 0.0
    for i in range(n):
        first = 0 if i < ends[0] else 2 if i < ends[1] else 5 if i < ends[2] else 9
        power, factor = orders[i] - (0 if first == 5 else 1), x[i]
        for derivative in range(2 if first in (0, 9) else 3 if first == 2 else 4):
            if power >= 0:
                series[first + derivative, power] += factor
            factor *= power
            power -= 1
    zs, vs, ws = np.empty((POWERS, count)), np.empty((POWERS, count)), np.empty((POWERS, count))
    # By time: level, stretch, slope of the line, slope of h, its derivative, slope of E; derivatives of z and stretch.
    nodes = np.empty((10, count))
    level, stretch, slope, pace, curl, e_slope = nodes[0], nodes[1], nodes[2], nodes[3], nodes[4], nodes[5]
    z_by_v, stretch_by_v, at_level, at_stretch = nodes[6], nodes[7], nodes[8], nodes[9]
    least, low, high = np.inf, np.inf, -np.inf
    for line in range(n_line):
        for k in range(count):
            z0 = time[line, k]
            v = doppler[line, k] + _horner(series[0], z0)
            slope[k] = rate[line, k] + _horner(series[1], z0)
            pace[k], curl[k] = 1 + _horner(series[6], v), _horner(series[7], v)
            z = (z0 - _horner(series[2], v)) / pace[k]
            level[k] = v + _horner(series[5], v) + _horner(series[9], z)
            z_by_v[k] = -(_horner(series[3], v) + z * curl[k]) / pace[k]
            stretch[k] = 1 / pace[k] + z_by_v[k] * slope[k]
            if derivatives:
                twist = _horner(series[4], v) + z_by_v[k] * curl[k] + z * _horner(series[8], v)
                stretch_by_v[k] = -(twist * slope[k] + stretch[k] * curl[k]) / pace[k]
                e_slope[k] = _horner(series[10], z)
                zs[0, k], vs[0, k], ws[0, k] = 1.0, 1.0, 1.0
                for power in range(1, POWERS):
                    zs[power, k], vs[power, k] = zs[power - 1, k] * z0, vs[power - 1, k] * v
                    ws[power, k] = ws[power - 1, k] * z
        mean = _dot(level, share[line])
        first = line * count
        for k in range(count):
            residual[first + k] = level_weight[line, k] * (level[k] - mean)
            residual[size + first + k] = stretch_weight[line, k] * (stretch[k] - 1)
            least, low, high = min(least, stretch[k]), min(low, slope[k]), max(high, slope[k])
        if not derivatives:
            continue
        for i in range(n):
            order = orders[i]
            for k in range(count):
                if i < ends[0]:
                    term, term_slope = zs[order - 1, k], (order - 1) * zs[order - 2, k]
                    at_level[k] = (pace[k] + e_slope[k] * z_by_v[k]) * term
                    at_stretch[k] = stretch_by_v[k] * term + z_by_v[k] * term_slope
                elif i < ends[1]:
                    term, term_slope = vs[order - 1, k], (order - 1) * vs[order - 2, k]
                    at_level[k] = -e_slope[k] / pace[k] * term
                    at_stretch[k] = (term / pace[k] * curl[k] - term_slope) * slope[k] / pace[k]
                elif i < ends[2]:
                    term, term_slope = vs[order, k], order * vs[order - 1, k]
                    term_curl = order * (order - 1) * vs[order - 2, k]
                    z_by_r = -ws[1, k] * term_slope / pace[k]
                    at_level[k] = term + e_slope[k] * z_by_r
                    at_stretch[k] = (
                        -((z_by_r * curl[k] + ws[1, k] * term_curl) * slope[k] + stretch[k] * term_slope) / pace[k]
                    )
                else:
                    at_level[k], at_stretch[k] = ws[order - 1, k], 0.0
            middle = _dot(at_level, share[line])
            for k in range(count):
                rows[i, first + k] = level_weight[line, k] * (at_level[k] - middle)
                rows[i, size + first + k] = stretch_weight[line, k] * at_stretch[k]
    for i in range(n):
        residual[2 * size + i] = pull[i] * (x[i] - start[i])
        for k in range(n):
            rows[i, 2 * size + k] = pull[i] if k == i else 0.0
    return least > FOLDED and low * high > 0.0


@njit(**PART, **OPTIONS)
def _horner(series: FloatArray, value: float) -> float:
    total = 0.0
    for power in range(POWERS - 1, -1, -1):
        total = total * value + series[power]
    return total


@njit(**PART, **OPTIONS)
def _dot(a: FloatArray, b: FloatArray) -> float:
    total = 0.0
    for k in range(a.size):
        total += a[k] * b[k]
    return total


@njit(**PART, **OPTIONS)
def _orthogonalise(q: FloatArray, r: FloatArray) -> None:
    """Orthonormalise the first n rows of q (n, m) in place: q before = r^T q after, r (n, n) upper triangular."""
    n, m = r.shape[0], q.shape[1]
    for i in range(n):
        r[i, i] = np.sqrt(_dot(q[i], q[i]))
        if r[i, i] > 0.0:
            for k in range(m):
                q[i, k] /= r[i, i]
        for j in range(i + 1, n):
            r[i, j] = _dot(q[i], q[j])
            for k in range(m):
                q[j, k] -= r[i, j] * q[i, k]


@njit(inline="always", **OPTIONS)
def _solve_damped(
    q: FloatArray, r: FloatArray, values: FloatArray, damping: float, damped: FloatArray, below: FloatArray,
    x: FloatArray,
) -> None:  # fmt: skip
    """Solve for x that minimises |sum_k x_k (r^T q)_k + values|^2 + damping |x|^2.

    `damped` (n + 1, 2 n) and `below` (n, n) are room for the calculation. Below its diagonal r is not read.
    """
    n = r.shape[0]
    right = damped[n]
    for i in range(n):
        for k in range(2 * n):
            damped[i, k] = 0.0
        right[i], right[n + i] = -_dot(q[i], values), 0.0
        damped[i, n + i] = np.sqrt(damping)
        for k in range(i + 1):
            damped[i, k] = r[k, i]
    _orthogonalise(damped, below)
    for i in range(n):
        x[i] = _dot(damped[i], right)
        for k in range(2 * n):
            right[k] -= x[i] * damped[i, k]
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            x[i] -= below[i, j] * x[j]
        x[i] /= below[i, i]
