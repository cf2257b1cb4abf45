"""Least squares: splines through the phases of the points' strongest lines, each weighed by its own variance.

Entropy counts all chips alike, whatever their points stand out of; and its prior has to serve clutter. Once the chips
are sharp, a point's phase is known sample by sample, and how well: the variance of what the splines do not explain. A
point that stands alone tells thousands of times more than clutter. Weighed so, splines are the estimate of maximum
likelihood, with a prior of the track's error in the same units.
"""

from __future__ import annotations

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.autofocusing.chips import Chips, mean_sight
from blocksar.autofocusing.correction import Knots, intervals, narrowing
from blocksar.autofocusing.fine_phase import own_phase, strongest_rows
from blocksar.autofocusing.information import bending, information, solve, told_within_sides

TURNS = 4  # of phases and splines
LEAST_COUNT = 8  # samples of a point that counts
FLOOR = 0.03  # rad: errors that points have besides what is seen in their own phases
TOLERANCE = 0.5  # rad: points with such errors count half; with larger ones, angles tell nothing
ENTROPY_ERROR = 0.02  # rad rms: of the displacement that is refined


def by_least_squares(chips: Chips, start: FloatArray, before: FloatArray, weights: FloatArray) -> FloatArray:
    """Refine a displacement (n_sample, 3), m, that makes chips sharp which were taken with `before` (n_sample, 3).

    Minimises sum_i w_i sum_t (phase_it - k u_it . e(t) - line_i)^2 + the prior of e by Gauss-Newton steps, with
    w_i = weights_i / variance_i. The prior: displacements of `Settings.displacement`, and accelerations of
    `Settings.roughness` and of what is seen along the line of sight already, since errors are alike in all directions.
    And `start` itself, as far as entropy tells it: not how both sides of a gap fit.
    """
    work, wavenumber, settings = chips.work, chips.work.wavenumber, chips.work.settings
    count = intervals(work)
    narrow = chips.corrected(start).narrowed(narrowing(work, count))
    knots = Knots(work=work, n_interval=count, time=narrow.time)
    wide = Knots(work=work, n_interval=count, time=chips.time)
    seen = roughness(wide, ((before + start) * mean_sight(chips)).sum(axis=1)) * wavenumber
    rough = float(np.hypot(settings.roughness * wavenumber * knots.step**2, seen))
    far = settings.displacement * wavenumber
    prior = knots.size * bending(knots.size) / rough**2 + np.eye(3 * knots.size) / far**2
    believed = knots.size / ENTROPY_ERROR**2 * told_within_sides(narrow, knots, weights / weights.sum())
    whole = wide.fit(before + start) * wavenumber
    coefficients = np.zeros((knots.size, 3))
    for _ in range(TURNS):
        phase = point_phases(narrow.corrected(knots.values(coefficients) / wavenumber))
        share = weights * point_shares(rms(phase, narrow), narrow)
        told, _ = information(narrow, knots, share)
        each = np.where(narrow.told, (share / np.maximum(narrow.told.sum(axis=1), 1))[:, None], 0.0)
        slope = knots.adjoint(narrow.spread(each * phase)).ravel()
        slope -= np.einsum("ij,j->i", prior, (whole + coefficients).ravel())
        slope -= np.einsum("ij,j->i", believed, coefficients.ravel())
        moved = solve(told + believed + prior, slope)
        coefficients = coefficients + moved.reshape(-1, 3)
    return np.asarray(start + wide.values(coefficients) / wavenumber)


def roughness(knots: Knots, values: FloatArray) -> float:
    """Second difference, rms, of the coefficients of splines through values (n,)."""
    return float(np.sqrt((np.diff(knots.fit(values[:, None])[:, 0], 2) ** 2).mean()))


def point_phases(chips: Chips) -> FloatArray:
    """Phase (n_point, n) of each point's strongest line, rad, less a line of its own; 0 where it is not lit."""
    rows = strongest_rows(chips)
    own, _ = own_phase(rows, chips)
    return without_lines(np.asarray(np.angle(rows * np.conj(own)), np.float64), chips)


def without_lines(phase: FloatArray, chips: Chips) -> FloatArray:
    """Phases (n_point, n) less the line through each point's; 0 where there are none."""
    out, told = np.zeros(phase.shape), chips.told
    for i in range(phase.shape[0]):
        at = np.flatnonzero(told[i])
        if at.size < LEAST_COUNT:
            continue
        u, flat = at - at.mean(), phase[i, at] - phase[i, at].mean()
        out[i, at] = flat - u * (u * flat).sum() / (u * u).sum()
    return out


def rms(phase: FloatArray, chips: Chips) -> FloatArray:
    """Root mean square (n_point,) of phases (n_point, n) that are 0 where there are none, rad."""
    return np.asarray(np.sqrt((phase * phase).sum(axis=1) / np.maximum(chips.told.sum(axis=1), 1)))


def point_shares(errors: FloatArray, chips: Chips) -> FloatArray:
    """Samples over variance (n_point,), rad^-2, of points with phase errors (n_point,), rad; less for outliers."""
    robust, count = 1 / (1 + (errors / TOLERANCE) ** 4), chips.told.sum(axis=1)
    return np.asarray(np.where(count < LEAST_COUNT, 0.0, count * robust / (errors**2 + FLOOR**2)))
