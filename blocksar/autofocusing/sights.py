"""Sums over the samples of chips, each with its line of sight, in compiled loops.

Sample m of chip i lies at the collection's sample min(first[i] + m, n_sample - 1), and has the unit vector sight[i, m].
"""

from __future__ import annotations

import math

from numba import types

from blocksar.arrays import FloatArray, IntArray
from blocksar.kernels.loops import REAL_ROWS, UNCHECKED, loop

SIGHTS = types.Array(types.float64, 3, "C", readonly=True)
INDICES = types.Array(types.int64, 1, "C", readonly=True)
SUMS = types.float64[:, ::1]
EXACT = {"nogil": True, **UNCHECKED}  # no contraction: the same bits wherever these are inlined


@loop(SIGHTS, INDICES, REAL_ROWS, SUMS, **EXACT)
def project(sight: FloatArray, first: IntArray, displacement: FloatArray, out: FloatArray) -> None:
    """out[i, m] = sight . displacement at its sample; sight (n_point, n, 3), displacement (n_sample, 3)."""
    n_point, n, last = sight.shape[0], sight.shape[1], displacement.shape[0] - 1
    for i in range(n_point):
        for m in range(n):
            t = min(first[i] + m, last)
            s, d = sight[i, m], displacement[t]
            out[i, m] = s[0] * d[0] + s[1] * d[1] + s[2] * d[2]


@loop(SIGHTS, INDICES, REAL_ROWS, SUMS, **EXACT)
def collect(sight: FloatArray, first: IntArray, values: FloatArray, out: FloatArray) -> None:
    """The transpose of `project`: add sight values[i, m] to out[t] (n_sample, 3)."""
    n_point, n, last = sight.shape[0], sight.shape[1], out.shape[0] - 1
    for i in range(n_point):
        for m in range(n):
            t = min(first[i] + m, last)
            for a in range(3):
                out[t, a] += sight[i, m, a] * values[i, m]


@loop(SIGHTS, INDICES, REAL_ROWS, types.float64[:, :, ::1], **EXACT)
def collect_squares(sight: FloatArray, first: IntArray, weights: FloatArray, out: FloatArray) -> None:
    """Add weights[i, m] sight sight^T to out[t] (n_sample, 3, 3)."""
    n_point, n, last = sight.shape[0], sight.shape[1], out.shape[0] - 1
    for i in range(n_point):
        for m in range(n):
            t = min(first[i] + m, last)
            for a in range(3):
                weighed = weights[i, m] * sight[i, m, a]
                for b in range(3):
                    out[t, a, b] += weighed * sight[i, m, b]


@loop(types.Array(types.float64, 3, "C", readonly=True), INDICES, REAL_ROWS, SUMS, **EXACT)
def add_to_form(squares: FloatArray, knot: IntArray, basis: FloatArray, form: FloatArray) -> None:
    """Add squares[t] (n_sample, 3, 3) to a form (3 size, 3 size) of the coefficients of splines with `Knots.basis`."""
    for t in range(squares.shape[0]):
        for k in range(4):
            for m in range(4):
                share, row, column = basis[t, k] * basis[t, m], 3 * (knot[t] + k), 3 * (knot[t] + m)
                for a in range(3):
                    for b in range(3):
                        form[row + a, column + b] += share * squares[t, a, b]


@loop(SIGHTS, INDICES, REAL_ROWS, INDICES, REAL_ROWS, SUMS, **EXACT)
def flat_parts(
    sight: FloatArray, first: IntArray, weights: FloatArray, knot: IntArray, basis: FloatArray, out: FloatArray
) -> None:
    """Find what coefficients add to a constant and to a line over each chip, each of unit norm with weights[i, m].

    Adds to out (2 n_point, 3 size), for splines with `Knots.basis`. Weights are equal where they are not 0.
    """
    n_point, n, last = sight.shape[0], sight.shape[1], knot.size - 1
    for i in range(n_point):
        total, count, middle, spread = 0.0, 0, 0.0, 0.0
        for m in range(n):
            if weights[i, m] > 0:
                total, count, middle = total + weights[i, m], count + 1, middle + m
        if count < 2:
            continue
        middle /= count
        for m in range(n):
            if weights[i, m] > 0:
                spread += (m - middle) ** 2
        spread = math.sqrt(spread / count)
        for m in range(n):
            if weights[i, m] == 0:
                continue
            t, share = min(first[i] + m, last), weights[i, m] / math.sqrt(total)
            line = share * (m - middle) / spread
            for k in range(4):
                for a in range(3):
                    at = 3 * (knot[t] + k) + a
                    out[2 * i, at] += basis[t, k] * sight[i, m, a] * share
                    out[2 * i + 1, at] += basis[t, k] * sight[i, m, a] * line
