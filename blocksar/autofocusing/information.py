"""How sharply chips tell the coefficients of a spline: an approximate Hessian, its factors and what follows."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.autofocusing import forms, sights
from blocksar.autofocusing.chips import Chips, missing_runs
from blocksar.autofocusing.correction import Knots


class Information(NamedTuple):
    """Quadratic forms of coefficients in rad, ordered as (size, 3): (size * 3, size * 3) each.

    told : sum_i w_i mean_t (u_i . e)^2, less what a constant and a line over each chip's own samples take of it;
    flat : what these take.
    """

    told: FloatArray
    flat: FloatArray


def information(chips: Chips, knots: Knots, weights: FloatArray) -> Information:
    """Find what chips tell and what not, each chip weighed by one of `weights` (n_point,)."""
    told = chips.told
    each = np.where(told, (weights / np.maximum(told.sum(axis=1), 1))[:, None], 0.0)
    squares, form = np.zeros((chips.time.size, 3, 3)), np.zeros((3 * knots.size, 3 * knots.size))
    sights.collect_squares(chips.sight, chips.first, each, squares)
    sights.add_to_form(squares, *knots.basis, form)
    rows, flat = np.zeros((2 * weights.size, 3 * knots.size)), np.zeros(form.shape)
    sights.flat_parts(chips.sight, chips.first, each, *knots.basis, rows)
    forms.add_squares(rows, flat)
    return Information(form - flat, flat)


def told_within_sides(chips: Chips, knots: Knots, weights: FloatArray) -> FloatArray:
    """`Information.told` of what chips tell on each side of a gap, and not of how both sides fit.

    A constant and a line over the samples of each side are taken off. Without gaps it is all that chips tell.
    """
    sides = missing_runs(~chips.seen)
    if len(sides) < 2:
        return information(chips, knots, weights).told
    told = np.zeros((3 * knots.size, 3 * knots.size))
    for side in sides:
        within = np.zeros(chips.seen.size, bool)
        within[side] = True
        some = replace(chips, seen=within)
        share = some.told.sum(axis=1) / np.maximum(chips.told.sum(axis=1), 1)
        told += information(some, knots, weights * share).told
    return told


def bending(size: int) -> FloatArray:
    """Mean squared second difference of the coefficients of one axis, as a quadratic form (3 size, 3 size)."""
    second = np.zeros((size - 2, size))
    for k, value in enumerate((1.0, -2.0, 1.0)):
        second[np.arange(size - 2), np.arange(size - 2) + k] = value
    one = np.einsum("ri,rj->ij", second, second) / (size - 2)
    return np.asarray(np.einsum("ij,ab->iajb", one, np.eye(3)).reshape(3 * size, 3 * size))


def factor(form: FloatArray) -> FloatArray:
    """The upper triangular inverse factor f of a positive definite form: f f^T = form^-1, (n, n)."""
    upper, inverse = np.zeros(form.shape), np.zeros(form.shape)
    forms.decompose(form, upper)
    forms.invert(upper, inverse)
    return inverse


def solve(form: FloatArray, right: FloatArray) -> FloatArray:
    """form^-1 right (n,), of a positive definite form (n, n)."""
    inverse = factor(form)
    return np.einsum("ij,j->i", inverse, np.einsum("ij,i->j", inverse, right))
