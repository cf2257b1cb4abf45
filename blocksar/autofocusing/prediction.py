"""The error that is predicted to be left, from what the points tell: of its sources, the root of the sum of squares."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from blocksar import solvers
from blocksar.arrays import BoolArray, FloatArray
from blocksar.autofocusing.bridging import long_gaps, straddling
from blocksar.autofocusing.chips import SHORT_GAP, Chips, missing_runs
from blocksar.autofocusing.correction import Correction, Knots, intervals
from blocksar.autofocusing.estimation import defocus, without_line
from blocksar.autofocusing.fine_phase import point_phases, point_shares, rms, shared_samples
from blocksar.autofocusing.selection import Points
from blocksar.autofocusing.work import FILTER_LENGTH

HALVES_TO_WHOLE = 0.5  # each half has twice the variance of the whole, and their difference four times that
# The power of an octave of the displacement over that of the next: of a random walk of the position, whose spectrum
# falls with the square of frequency, and of one of the velocity, as navigation has it, with the fourth power.
OCTAVE_RATIO = 2.0, 8.0
# What points of a pattern, or of measured ground, do to each other is alike in both halves, in phase as in amplitude,
# where it is seen: alike, if what is added to a point has any phase; in amplitude alone, if its neighbours lie
# symmetrically. A fifth in phase serves patterns of 6 x 6 to 14 x 14 points, clutter and measured ground.
AMPLITUDE_TO_PHASE = 0.2
NEIGHBOURS = 3  # points next to each that are near it
LEAST_COUNT = 8  # samples of a chip that counts


def predicted_error(chips: Chips, points: Points, correction: Correction, halves: Sequence[FloatArray]) -> float:
    """Phase error over a dwell that is expected to be left, rad rms.

    Parameters
    ----------
    chips : Chips
        Of the last loop, taken with `correction.previous`.
    points : Points
        Theirs.
    halves : sequence of (n_sample, 3) float
        Displacements that either half of the points tells, m, added to `correction.previous`.
    """
    settings, last = chips.work.settings, correction.history[-1]
    each = defocus(chips, chips.work.wavenumber * chips.los(halves[0] - halves[1]))
    # Of chips as most are: those at the very ends of a collection would count for all. Beside a gap they are to count.
    usual = float(np.median(each) if far_from_gaps(chips).all() else each.mean())
    # The last two loops are two estimates, too; half of what they differ by is how far each is from their mean.
    unsettled = 0.5 * last["step"] if last["step"] > settings.step else 0.0
    moved = correction.displacement - correction.previous
    sharp = chips.recentred(moved).corrected(moved)
    # As a random walk goes on, but never more than the samples show.
    beyond = correction.fine_error or min(unfollowed(chips, correction, halves), fine_samples(sharp, correction))
    patterns = AMPLITUDE_TO_PHASE * amplitude_in_common(sharp, correction)
    across = told_across_gaps(sharp, correction)
    alike = alike_nearby(sharp, points, correction)
    parts = (HALVES_TO_WHOLE * usual, beyond, unsettled, patterns, across, alike)
    return float(np.sqrt(sum(part**2 for part in parts)))


def alike_nearby(chips: Chips, points: Points, correction: Correction) -> float:
    """Error by what points that lie near each other have alike in their own phases, rad rms over chips.

    Heights that are not known bend the phases of all points of a hill, the air those of all that are seen through it,
    and neighbours of a pattern add the same to each other. The mean of such bends is taken for an error of the track by
    both halves of the points alike. Its variance is sum_ij w_i w_j b_i b_j over points that lie near each other, with
    the shares w that points have in the estimate over a chip's dwell, and the bends b that are left in their phases:
    where points err each for itself, it is about 0, and what is left is in the halves' difference.

    Parameters
    ----------
    chips : Chips
        Corrected, and about their brightest scatterers.
    points : Points
        Theirs.
    """
    phase = point_phases(chips)
    share, bend = correction.weights * point_shares(rms(phase, chips), chips), bends(phase, chips)
    near = np.hypot(points.x[:, None] - points.x, points.y[:, None] - points.y)
    np.fill_diagonal(near, np.inf)
    neighbours = np.argsort(near, axis=1, kind="stable")[:, :NEIGHBOURS]
    last, variances = chips.first + chips.count, []
    for first, end in zip(chips.first, last, strict=True):
        part = share * np.maximum(np.minimum(last, end) - np.maximum(chips.first, first), 0)
        if part.sum() > 0:
            told = part / part.sum() * bend
            variances.append(float((told[:, None] * told[neighbours]).sum()))
    return math.sqrt(max(sum(variances) / max(len(variances), 1), 0.0))


def bends(phase: FloatArray, chips: Chips) -> FloatArray:
    """Parabola in phases (n_point, n) over each dwell: its rms with its sign (n_point,), rad."""
    out = np.zeros(phase.shape[0])
    for i, told in enumerate(chips.told):
        at = np.flatnonzero(told)
        if at.size >= LEAST_COUNT:
            u = at - at.mean()
            parabola = solvers.orthogonal_basis(np.stack([np.ones(at.size), u, u * u]))[0][2]
            out[i] = (parabola * phase[i, at]).sum() / np.sqrt(at.size)
    return out


def told_across_gaps(chips: Chips, correction: Correction) -> float:
    """Error of how both sides of gaps fit, rad rms over all chips, of which few see both sides; 0 without gaps.

    These few alone tell by how much the phase, and its slope, differ from one side to the other; and both halves hold
    on to what the whole has found. By the standard error of the mean of either in the phases that they have left.
    `chips` are corrected, and about their brightest scatterers.
    """
    error = 0.0
    for gap in long_gaps(chips):
        both = np.flatnonzero(straddling(chips, gap) & (correction.weights > 0))
        if both.size < 2:
            continue
        some = chips.some(both)
        phase = point_phases(some)
        weights = correction.weights[both] * point_shares(rms(phase, some), some)  # as in least squares
        weights /= weights.sum()
        left = np.zeros((both.size, 2))
        for i, told in enumerate(some.told):
            at = np.flatnonzero(told)
            u, after = np.linspace(-1, 1, told.size)[at], (some.index[i, at] >= gap.stop).astype(np.float64)
            terms = solvers.orthogonal_basis(np.stack([np.ones(at.size), u, after, after * u]))[0]
            left[i] = (terms[2:] * phase[i, at]).sum(axis=1) / np.sqrt(at.size)
        mean = (weights[:, None] * left).sum(axis=0)
        spread = ((weights[:, None] * (left - mean)) ** 2).sum(axis=0) * both.size / (both.size - 1)
        error += float(spread.sum()) * both.size / chips.first.size
    return float(np.sqrt(error))


def amplitude_in_common(chips: Chips, correction: Correction) -> float:
    """Relative amplitude, rms, that the points share over the dwell of a chip, of the median chip.

    As slow as splines follow, without a line over the dwell. `chips` are corrected, about their brightest scatterers.
    """
    knots = Knots(work=chips.work, n_interval=intervals(chips.work), time=chips.time)
    steady = far_from_gaps(chips)
    amplitude = shared_samples(chips, correction.weights)[:, 1]
    amplitude[~steady] = amplitude[steady].mean()
    slow = knots.smooth(amplitude[:, None])[:, 0] / float(amplitude[chips.index[chips.lit]].mean())
    shared = []
    for first, count in zip(chips.first, chips.count, strict=True):
        dwell = slice(int(first), int(first + count))
        if steady[dwell].sum() >= LEAST_COUNT:
            shared.append(float((without_line(slow[dwell][steady[dwell]]) ** 2).mean()))
    return float(np.sqrt(np.median(shared)))


def far_from_gaps(chips: Chips) -> BoolArray:
    """Find which samples (n_sample,) lie outside the long gaps, and the low-pass of which does not reach into one."""
    far = np.ones(chips.seen.size, bool)
    for run in missing_runs(chips.seen):
        if run.stop - run.start > SHORT_GAP:
            far[max(run.start - FILTER_LENGTH, 0) : run.stop + FILTER_LENGTH] = False
    return far


def fine_samples(chips: Chips, correction: Correction) -> float:
    """Phase of the samples that splines do not follow, rad rms, of the median chip: the error, noise and neighbours.

    `chips` are corrected, about their brightest scatterers.
    """
    knots = Knots(work=chips.work, n_interval=intervals(chips.work), time=chips.time)
    phase = shared_samples(chips, correction.weights)[:, 0]
    fine = phase - knots.smooth(phase[:, None])[:, 0]
    return float(np.median(defocus(chips, fine[chips.index])))


def unfollowed(chips: Chips, correction: Correction, halves: Sequence[FloatArray]) -> float:
    """Error too fine for the splines, rad rms, of the median chip: what is left if nothing so fine is believed.

    From what both halves share of the two finest octaves that splines follow: power falls from octave to octave by the
    same ratio q, and of all beyond there is 1 / (q - 1) of the last one's.
    """
    each: list[list[FloatArray]] = []
    splines = [Knots(work=chips.work, n_interval=intervals(chips.work) // step, time=chips.time) for step in (1, 2, 4)]
    for half in halves:
        finest = splines[0].smooth(correction.previous + half)
        curves = [finest, *(spline.smooth(finest) for spline in splines[1:])]
        each.append([chips.work.wavenumber * chips.los(fine - coarse) for fine, coarse in pairwise(curves)])
    usual = chips.count >= LEAST_COUNT

    def power(one: FloatArray, other: FloatArray) -> float:
        shared = np.where(chips.told, one * other, 0.0).sum(axis=1) / np.maximum(chips.told.sum(axis=1), 1)
        return max(float(np.median(shared[usual])), 0.0)

    last, before = map(power, *each)
    ratio = float(np.clip(before / max(last, 1e-300), *OCTAVE_RATIO))
    return math.sqrt(last / (ratio - 1))
