"""Information of chips about spline coefficients: an approximate Hessian, its factors and solutions.

The forms are positive definite, in hundreds of coefficients: compiled loops compute Cholesky factors and their
inverses.

BLAS is avoided, and sums have one order, so that every process gets the same bits, see `blocksar.solvers`.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numba import types

from blocksar.arrays import FloatArray
from blocksar.autofocusing.chips import Chips, add_to_form, collect_squares, flat_parts, missing_runs
from blocksar.autofocusing.track_correction import Knots
from blocksar.kernels.loops import REAL_ROWS, UNCHECKED, loop

SUMS = types.float64[:, ::1]
EXACT = {"nogil": True, **UNCHECKED}


@loop(REAL_ROWS, SUMS, **EXACT)
def decompose(form: FloatArray, upper: FloatArray) -> None:
    """Write the upper triangular r with r^T r = form, (n, n), over the zeros of `upper`."""
    n = form.shape[0]
    for j in range(n):
        row = upper[j, j:]
        for k in range(n - j):
            row[k] = form[j, j + k]
        for i in range(j):
            share, above = upper[i, j], upper[i, j:]
            for k in range(n - j):
                row[k] -= share * above[k]
        root = math.sqrt(row[0])
        for k in range(n - j):
            row[k] /= root


@loop(REAL_ROWS, SUMS, **EXACT)
def invert(upper: FloatArray, inverse: FloatArray) -> None:
    """Write the inverse of an upper triangular matrix (n, n) over the zeros of `inverse`."""
    n = upper.shape[0]
    for j in range(n - 1, -1, -1):
        inverse[j, j] = 1.0
        for i in range(n - 1, j, -1):
            share, row, below = upper[j, i], inverse[j, i:], inverse[i, i:]
            for k in range(n - i):
                row[k] -= share * below[k]
        for k in range(j, n):
            inverse[j, k] /= upper[j, j]


@loop(REAL_ROWS, SUMS, **EXACT)
def add_squares(rows: FloatArray, form: FloatArray) -> None:
    """Add sum_r rows_r rows_r^T, rows (n_row, n), to a symmetric form (n, n)."""
    n_row, n = rows.shape
    for i in range(n):
        out = form[i, i:]
        for r in range(n_row):
            share, row = rows[r, i], rows[r, i:]
            if share != 0:
                for j in range(n - i):
                    out[j] += share * row[j]
        for j in range(i + 1, n):
            form[j, i] = form[i, j]


class Information(NamedTuple):
    """Quadratic forms of coefficients in rad, ordered as (size, 3): (size * 3, size * 3) each.

    told : sum_i w_i mean_t (u_i . e)^2, less what a constant and a line over each chip's own samples take of it;
    flat : what these take.
    """

    told: FloatArray
    flat: FloatArray


def information(chips: Chips, knots: Knots, weights: FloatArray) -> Information:
    """Compute the information of chips about coefficients, with weights (n_point,)."""
    valid = chips.told
    each = np.where(valid, (weights / np.maximum(valid.sum(axis=1), 1))[:, None], 0.0)
    squares, form = np.zeros((chips.time.size, 3, 3)), np.zeros((3 * knots.size, 3 * knots.size))
    collect_squares(chips.sight, chips.first, each, squares)
    add_to_form(squares, *knots.basis, form)
    rows, flat = np.zeros((2 * weights.size, 3 * knots.size)), np.zeros(form.shape)
    flat_parts(chips.sight, chips.first, each, *knots.basis, rows)
    add_squares(rows, flat)
    return Information(form - flat, flat)


def told_within_sides(chips: Chips, knots: Knots, weights: FloatArray) -> FloatArray:
    """Compute `Information.told` from each side of the gaps alone, without how the sides fit together.

    A constant and a line over the samples of each side are taken off. Without gaps it is all that chips tell.
    """
    sides = missing_runs(~chips.seen)
    if len(sides) < 2:
        return information(chips, knots, weights).told
    form = np.zeros((3 * knots.size, 3 * knots.size))
    for side in sides:
        within = np.zeros(chips.seen.size, bool)
        within[side] = True
        some = replace(chips, seen=within)
        share = some.told.sum(axis=1) / np.maximum(chips.told.sum(axis=1), 1)
        form += information(some, knots, weights * share).told
    return form


def bending(size: int) -> FloatArray:
    """Quadratic form (3 size, 3 size): mean squared second difference of the coefficients of each axis."""
    second = np.zeros((size - 2, size))
    for k, value in enumerate((1.0, -2.0, 1.0)):
        second[np.arange(size - 2), np.arange(size - 2) + k] = value
    one = np.einsum("ri,rj->ij", second, second) / (size - 2)
    return np.asarray(np.einsum("ij,ab->iajb", one, np.eye(3)).reshape(3 * size, 3 * size))


def factor(form: FloatArray) -> FloatArray:
    """The upper triangular inverse factor f of a positive definite form: f f^T = form^-1, (n, n)."""
    upper, inverse = np.zeros(form.shape), np.zeros(form.shape)
    decompose(form, upper)
    invert(upper, inverse)
    return inverse


def solve(form: FloatArray, right: FloatArray) -> FloatArray:
    """form^-1 right (n,), of a positive definite form (n, n)."""
    inverse = factor(form)
    return np.einsum("ij,j->i", inverse, np.einsum("ij,i->j", inverse, right))
