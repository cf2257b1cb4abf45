"""Small linear algebra with bit-identical results in every process: least squares, series, and roots in the plane.

BLAS and LAPACK, and with them `numpy.linalg`, `chebfit` and the operator @, round differently depending on where their
operands lie in memory. But a plan that is computed again to resume a run has to equal the one with which the run began,
and a task that is repeated has to give the same bytes. So whatever leads to a plan or to an image is computed here, in
numpy's own sums, whose order depends on shapes alone. The systems have a few dozen unknowns at most.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def product(a: FloatArray, b: FloatArray) -> FloatArray:
    """The matrix product of a (..., n, m) and b (..., m, k): (..., n, k)."""
    return np.einsum("...ij,...jk->...ik", a, b)


def least_squares(terms: FloatArray, values: FloatArray, *, damping: float = 0.0) -> FloatArray:
    """The x that minimises |sum_k x_k terms_k - values|^2 + damping |x|^2, by modified Gram-Schmidt.

    Parameters
    ----------
    terms : (n, m) float
        Linearly independent, unless damped.
    values : (m,) or (..., m) float

    Returns
    -------
    (n,) or (n, ...) float
    """
    if not damping:
        return _solve(terms.copy(), values)
    n = terms.shape[0]
    damped = np.concatenate([terms, np.sqrt(damping) * np.eye(n)], axis=1)
    return _solve(damped, np.concatenate([values, np.zeros((*values.shape[:-1], n))], axis=-1))


def chebyshev_series(u: FloatArray, values: FloatArray, degree: int) -> FloatArray:
    """Least-squares Chebyshev series of values (m, ...) at u (m,) in [-1, 1]: (degree + 1, ...)."""
    return least_squares(
        np.asarray(chebyshev.chebvander(u, degree).T, np.float64), np.moveaxis(np.asarray(values, np.float64), 0, -1)
    )


@lru_cache(maxsize=64)
def end_nodes(n: int) -> FloatArray:
    """The n Chebyshev nodes that include both ends, ascending from -1 to 1; read-only."""
    nodes = -np.cos(np.pi * np.arange(n) / (n - 1))
    nodes.flags.writeable = False
    return nodes


def node_series(values: FloatArray, degree: int) -> FloatArray:
    """Chebyshev series (degree + 1, ...), degree < n, of values (n, ...) at `end_nodes(n)`.

    The series through all values, cut off at the degree: least squares in which each end counts half.
    """
    return np.einsum("ij,j...->i...", _node_weights(values.shape[0], degree), values)


@lru_cache(maxsize=64)
def _node_weights(n: int, degree: int) -> FloatArray:
    """Weights (degree + 1, n) by which `node_series` multiplies values at nodes."""
    weights = np.asarray(chebyshev.chebvander(end_nodes(n), degree).T, np.float64) * 2 / (n - 1)
    weights[:, [0, -1]] /= 2
    weights[0] /= 2
    if degree == n - 1:
        weights[-1] /= 2
    return weights


@lru_cache(maxsize=16)
def gauss_legendre(n: int) -> tuple[FloatArray, FloatArray]:
    """Nodes in (-1, 1), ascending, and weights (n,) of Gauss-Legendre quadrature, by Newton's method; read-only."""
    nodes = -np.cos(np.pi * (np.arange(1, n + 1) - 0.25) / (n + 0.5))
    slope = np.ones(n)
    for _ in range(6):
        before, value = np.ones(n), nodes.copy()
        for k in range(2, n + 1):
            before, value = value, ((2 * k - 1) * nodes * value - (k - 1) * before) / k
        slope = n * (nodes * value - before) / (nodes * nodes - 1)
        nodes = nodes - value / slope
    weights = 2 / ((1 - nodes * nodes) * slope * slope)
    nodes.flags.writeable = weights.flags.writeable = False
    return nodes, weights


def legendre_series(n: int, degree: int) -> FloatArray:
    """The matrix from values at the n Gauss-Legendre nodes to the Legendre series up to a degree, (degree + 1, n)."""
    nodes, weights = gauss_legendre(n)
    terms = np.polynomial.legendre.legvander(nodes, degree).T
    return np.asarray((2 * np.arange(degree + 1)[:, None] + 1) / 2 * terms * weights)


def orthogonal_basis(terms: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Orthonormal rows q (n, m) and upper triangular r (n, n) with terms_k = sum_(i <= k) r_ik q_i, terms (n, m)."""
    q, n = terms.copy(), terms.shape[0]
    r = np.zeros((n, n))
    for _ in range(2):  # twice is enough for orthogonality to rounding
        again = np.eye(n)
        for i in range(n):
            again[i, i] = np.sqrt((q[i] * q[i]).sum())
            q[i] /= again[i, i]
            again[i, i + 1 :] = (q[i] * q[i + 1 :]).sum(axis=1)
            q[i + 1 :] -= again[i, i + 1 :, None] * q[i]
        r = product(again, r) if r.any() else again
    return q, r


def back_substitute(r: FloatArray, right: FloatArray) -> FloatArray:
    """The x (n, ...) with r x = right, for an upper triangular r (n, n) and right (n, ...)."""
    x = right.copy()
    for i in range(r.shape[0] - 1, -1, -1):
        x[i] /= r[i, i]
        x[:i] -= r[:i, i].reshape(-1, *(1,) * (x.ndim - 1)) * x[i]
    return x


def through_nodes(values: FloatArray) -> FloatArray:
    """Power coefficients (n, ...) of the polynomial through values (n, ...) at the Chebyshev nodes, `chebpts1(n)`."""
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


def _solve(q: FloatArray, right: FloatArray) -> FloatArray:
    """Solve least squares as `least_squares` does, overwriting the terms q.

    The right side is made orthogonal along with them, which keeps the solution stable without a second pass.
    """
    n = q.shape[0]
    r, projected = np.zeros((n, n)), np.zeros((n, *right.shape[:-1]))
    products = np.empty_like(q)  # room for them, which would come from new memory each time
    for i in range(n):
        row, rest, room = q[i], q[i + 1 :], products[i + 1 :]
        r[i, i] = np.sqrt(np.add.reduce(np.multiply(row, row, out=products[i])))
        row /= r[i, i]
        projected[i] = np.add.reduce(row * right, axis=-1)
        right = right - projected[i, ..., None] * row
        r[i, i + 1 :] = np.add.reduce(np.multiply(row, rest, out=room), axis=1)
        rest -= np.multiply(r[i, i + 1 :, None], row, out=room)
    return back_substitute(r, projected)


def combination(first: FloatArray, second: FloatArray, wanted: FloatArray) -> FloatArray:
    """The a (2, ...) with a_0 first + a_1 second = wanted, all (2, ...): not finite where the two are parallel."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(
            np.stack([
                wanted[0] * second[1] - wanted[1] * second[0], wanted[1] * first[0] - wanted[0] * first[1],
            ]) / (first[0] * second[1] - second[0] * first[1])
        )  # fmt: skip


def newton(
    function: Callable[[FloatArray], FloatArray],
    wanted: FloatArray,
    at: FloatArray,
    *,
    steps: int,
    longest: float = np.inf,
) -> FloatArray:
    """Points (2, ...) of the plane where a function has the values wanted, by Newton's method from points `at`.

    Slopes are taken over 1, as of a place in metres. Not finite where the function's slopes become parallel; where it
    has no such values, anywhere.

    Parameters
    ----------
    function : (2, ...) to (2, ...)
    wanted, at : (2, ...) float
    steps : int
    longest : float
        No step goes further along an axis.

    Examples
    --------
    >>> polar = lambda at: np.stack([np.hypot(*at), np.arctan2(at[1], at[0])])
    >>> newton(polar, np.array([5.0, 0.5]), np.array([3.0, 3.0]), steps=30).round(3)
    array([4.388, 2.397])
    """
    for _ in range(steps):
        here = function(at)
        by_first, by_second = (function(np.stack([at[0] + one, at[1] + (1 - one)])) - here for one in (1, 0))
        at = at + np.clip(combination(by_first, by_second, wanted - here), -longest, longest)
    return at


def vertex(values: FloatArray) -> float:
    """Offset of a parabola's maximum through three values from the middle one, in steps; 0 for fewer values."""
    if values.size < 3:
        return 0.0
    bend = float(values[0]) - 2 * float(values[1]) + float(values[2])
    return float(np.clip((float(values[0]) - float(values[2])) / (2 * bend), -0.5, 0.5)) if bend < 0 else 0.0
