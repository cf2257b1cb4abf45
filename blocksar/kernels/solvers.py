"""Small solvers with the same bits in every process: least squares, Levenberg-Marquardt, interpolation."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.polynomial import chebyshev

from blocksar.arrays import FloatArray

# A fit is done when a step gains less than this part of the cost, or after so many steps. Order 2 in Doppler and the
# deramp nearly cancel, which makes a long valley; to choose a kind of chain its beginning tells enough.
ENOUGH, MOST_STEPS = 1e-7, 200


def levenberg_marquardt(
    faults: Callable[[FloatArray], FloatArray],
    jacobian: Callable[[FloatArray], FloatArray],
    start: FloatArray,
    *,
    enough: float = ENOUGH,
    steps: int = MOST_STEPS,
) -> FloatArray:
    """Minimise the sum of squares of `faults`; the same bits every time.

    Library solvers (MINPACK, LAPACK) round differently as their work arrays happen to lie in memory, and a plan
    made anew, to resume a run, has to be the plan that the run began with. Here every sum runs in numpy's own
    order, and the few unknowns are solved for by modified Gram-Schmidt on the damped, column-scaled system.

    Parameters
    ----------
    faults : callable
        (n,) to (m,).
    jacobian : callable
        (n,) to (n, m): one row an unknown.
    enough : float
        Part of the cost: who gains less by a step is done.
    steps : int
        At most.
    """
    x, damping, growth = start, 1e-3, 2.0
    fault = faults(x)
    cost = float((fault * fault).sum())
    scale = np.zeros(x.size)
    for _ in range(steps):
        rows = jacobian(x)
        scale = np.maximum(scale, np.sqrt((rows * rows).sum(axis=1)))
        size = np.where(scale > 0, scale, 1.0)
        while True:
            step = _damped_step(rows / size[:, None], fault, damping) / size
            tried = faults(x + step)
            tried_cost = float((tried * tried).sum())
            if tried_cost < cost:
                break
            damping, growth = damping * growth, growth * 2
            if damping > 1e12:
                return x
        gained = cost - tried_cost
        x, fault, cost = x + step, tried, tried_cost
        damping, growth = max(damping / 5, 1e-14), 2.0
        if gained <= enough * cost:
            break
    return x


def least_squares(terms: FloatArray, values: FloatArray) -> FloatArray:
    """x of least |sum_k x_k terms_k - values|, terms (n, m) and values (m,): the same bits every time, as above."""
    return _damped_step(terms, -values, 0.0)


def _damped_step(rows: FloatArray, fault: FloatArray, damping: float) -> FloatArray:
    """Least squares of rows^T step = -fault, with sqrt(damping) step = 0 below it."""
    n = rows.shape[0]
    q = np.concatenate([rows, np.sqrt(damping) * np.eye(n)], axis=1)
    right = np.concatenate([-fault, np.zeros(n)])
    r, projected = np.zeros((n, n)), np.zeros(n)
    for i in range(n):
        r[i, i] = np.sqrt((q[i] * q[i]).sum())
        q[i] /= r[i, i]
        projected[i] = (q[i] * right).sum()
        right = right - projected[i] * q[i]
        r[i, i + 1 :] = (q[i] * q[i + 1 :]).sum(axis=1)
        q[i + 1 :] -= r[i, i + 1 :, None] * q[i]
    step = np.zeros(n)
    for i in range(n - 1, -1, -1):
        step[i] = (projected[i] - (r[i, i + 1 :] * step[i + 1 :]).sum()) / r[i, i]
    return step


def through_nodes(values: FloatArray) -> FloatArray:
    """Power coefficients (n, ...) of the polynomial through values (n, ...) at Chebyshev's nodes, `chebpts1(n)`.

    Sum by sum, and not by a matrix product or a solver: their last bits depend on where operands lie in memory, and a
    task that is done again has to give the same bytes.
    """
    n = values.shape[0]
    nodes = chebyshev.chebpts1(n)
    found = np.zeros_like(values)
    for j in range(n):
        along = np.polynomial.chebyshev.Chebyshev.basis(j)
        share = np.zeros(values.shape[1:])
        for node, value in zip(nodes, values, strict=True):
            share = share + along(node) * value
        for order, coefficient in enumerate(chebyshev.cheb2poly(along.coef)):
            found[order] += coefficient * (1 if j == 0 else 2) / n * share
    return found
