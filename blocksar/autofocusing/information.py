"""How sharply chips tell the coefficients of a spline: an approximate Hessian, its factors and what follows."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blocksar import solvers
from blocksar.arrays import FloatArray
from blocksar.autofocusing.chips import Chips
from blocksar.autofocusing.correction import Knots


class Information(NamedTuple):
    """Quadratic forms of coefficients in rad, ordered as (size, 3): (size * 3, size * 3) each.

    told : sum_i w_i mean_t (u_i . e)^2, less what a constant and a line over each chip's own samples take of it;
    flat : what these take.
    """

    told: FloatArray
    flat: FloatArray


def information(chips: Chips, knots: Knots, weights: FloatArray) -> Information:
    """What chips tell and what not, each chip weighed by one of `weights` (n_point,)."""
    told = chips.told
    each = np.where(told, (weights / np.maximum(told.sum(axis=1), 1))[:, None], 0.0)
    first, basis = knots.basis
    size, index = knots.size, chips.index.ravel()
    total = np.zeros((size * size, 9))
    for a in range(3):
        for b in range(3):
            at = np.bincount(
                index, (each * chips.sight[..., a] * chips.sight[..., b]).ravel(), minlength=chips.time.size
            )
            for k in range(4):
                for m in range(4):
                    key = (first + k) * size + first + m
                    total[:, 3 * a + b] += np.bincount(key, basis[:, k] * basis[:, m] * at, minlength=size * size)
    form = total.reshape(size, size, 3, 3).transpose(0, 2, 1, 3).reshape(3 * size, 3 * size)
    rows = np.concatenate([_flat_parts(chips, knots, i, each[i]) for i in range(weights.size)])
    flat = np.einsum("ri,rj->ij", rows, rows)
    return Information(np.asarray(form - flat), np.asarray(flat))


def _flat_parts(chips: Chips, knots: Knots, point: int, each: FloatArray) -> FloatArray:
    """What the coefficients add to a constant and a line over a chip, each of unit norm: (2, size * 3)."""
    n = int(chips.count[point])
    told = each[:n] > 0
    if told.sum() < 2:
        return np.zeros((2, knots.size * 3))
    line = np.where(told, np.arange(n) - np.flatnonzero(told).mean(), 0.0)
    parts = (told.astype(np.float64), line / np.sqrt((line * line).sum() / told.sum()))
    chosen, rows = chips.first[point] + np.arange(n), []
    for part in parts:
        at = np.zeros((chips.time.size, 3))
        at[chosen] = chips.sight[point, :n] * (part * each[:n])[:, None]
        rows.append(knots.adjoint(at).ravel() / np.sqrt(each[:n].sum()))
    return np.array(rows)


def bending(size: int) -> FloatArray:
    """Mean squared second difference of the coefficients of one axis, as a quadratic form (3 size, 3 size)."""
    second = np.zeros((size - 2, size))
    for k, value in enumerate((1.0, -2.0, 1.0)):
        second[np.arange(size - 2), np.arange(size - 2) + k] = value
    one = np.einsum("ri,rj->ij", second, second) / (size - 2)
    return np.asarray(np.einsum("ij,ab->iajb", one, np.eye(3)).reshape(3 * size, 3 * size))


def cholesky(form: FloatArray) -> FloatArray:
    """The upper triangular r of a positive definite form: r^T r = form, (n, n)."""
    rest, upper = form.copy(), np.zeros_like(form)
    for i in range(form.shape[0]):  # without BLAS: see `solvers`
        upper[i, i:] = rest[i, i:] / np.sqrt(rest[i, i])
        rest[i + 1 :, i + 1 :] -= upper[i, i + 1 :, None] * upper[i, i + 1 :]
    return upper


def factor(form: FloatArray) -> FloatArray:
    """The upper triangular inverse factor f of a positive definite form: f f^T = form^-1, (n, n)."""
    return solvers.back_substitute(cholesky(form), np.eye(form.shape[0]))


def solve(form: FloatArray, right: FloatArray) -> FloatArray:
    """form^-1 right (n,), of a positive definite form (n, n)."""
    upper, forward = cholesky(form), np.zeros(right.size)
    for i in range(right.size):
        forward[i] = (right[i] - (upper[:i, i] * forward[:i]).sum()) / upper[i, i]
    return np.asarray(solvers.back_substitute(upper, forward))
