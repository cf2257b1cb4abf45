"""Small solvers with bit-identical results in every process: least squares, Levenberg-Marquardt, interpolation."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.polynomial import chebyshev

from blocksar.arrays import FloatArray

# A fit stops when a step lowers the cost by less than the fraction ENOUGH, or after MOST_STEPS steps. Order 2 in
# Doppler and the deramp nearly cancel, which makes a long valley; its beginning suffices to choose a kind of chain.
ENOUGH, MOST_STEPS = 1e-7, 200


def levenberg_marquardt(
    residuals: Callable[[FloatArray], FloatArray],
    jacobian: Callable[[FloatArray], FloatArray],
    start: FloatArray,
    *,
    enough: float = ENOUGH,
    steps: int = MOST_STEPS,
) -> FloatArray:
    """Minimise the sum of squares of `residuals`, with bit-identical results in every run.

    Library solvers (MINPACK, LAPACK) round differently depending on where their work arrays lie in memory, but a plan
    that is recomputed to resume a run has to equal the one that the run began with. Here every sum runs in numpy's own
    order, and the few unknowns are solved for by modified Gram-Schmidt on the damped, column-scaled system.

    Parameters
    ----------
    residuals : callable
        (n,) to (m,).
    jacobian : callable
        (n,) to (n, m): one row per unknown.
    start : (n,) float
        Initial unknowns.
    enough : float
        Stop when a step lowers the cost by less than this fraction.
    steps : int
        Largest number of steps.

    Returns
    -------
    (n,) float
    """
    x, damping, growth = start, 1e-3, 2.0
    residual = residuals(x)
    cost = float((residual * residual).sum())
    scale = np.zeros(x.size)
    for _ in range(steps):
        rows = jacobian(x)
        scale = np.maximum(scale, np.sqrt((rows * rows).sum(axis=1)))
        size = np.where(scale > 0, scale, 1.0)
        while True:
            step = _damped_step(rows / size[:, None], residual, damping) / size
            new_residual = residuals(x + step)
            new_cost = float((new_residual * new_residual).sum())
            if new_cost < cost:
                break
            damping, growth = damping * growth, growth * 2
            if damping > 1e12:
                return x
        gain = cost - new_cost
        x, residual, cost = x + step, new_residual, new_cost
        damping, growth = max(damping / 5, 1e-14), 2.0
        if gain <= enough * cost:
            break
    return x


def least_squares(terms: FloatArray, values: FloatArray) -> FloatArray:
    """The x that minimises |sum_k x_k terms_k - values|, terms (n, m), values (m,); bit-identical, as above."""
    return _damped_step(terms, -values, 0.0)


def _damped_step(rows: FloatArray, residual: FloatArray, damping: float) -> FloatArray:
    """Least-squares solution of rows^T step = -residual, with the rows sqrt(damping) step = 0 appended."""
    n = rows.shape[0]
    q = np.concatenate([rows, np.sqrt(damping) * np.eye(n)], axis=1)
    right = np.concatenate([-residual, np.zeros(n)])
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
    """Power coefficients (n, ...) of the polynomial through values (n, ...) at the Chebyshev nodes, `chebpts1(n)`.

    Computed by explicit sums rather than a matrix product or a solver, whose last bits depend on where operands lie in
    memory: a task that is repeated has to give the same bytes.
    """
    n = values.shape[0]
    nodes = chebyshev.chebpts1(n)
    coefficients = np.zeros_like(values)
    for j in range(n):
        basis = np.polynomial.chebyshev.Chebyshev.basis(j)
        share = np.zeros(values.shape[1:])
        for node, value in zip(nodes, values, strict=True):
            share = share + basis(node) * value
        for order, coefficient in enumerate(chebyshev.cheb2poly(basis.coef)):
            coefficients[order] += coefficient * (1 if j == 0 else 2) / n * share
    return coefficients
