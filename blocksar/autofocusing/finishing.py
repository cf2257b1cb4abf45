"""The end of an estimate: comparison of two halves of the points, refusal, and the corrected track.

The predicted remaining error is the root of the sum of squares over its sources.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from blocksar import solvers
from blocksar.arrays import BoolArray, ComplexArray, FloatArray
from blocksar.autofocusing.bridging import long_gaps, straddling
from blocksar.autofocusing.chips import SHORT_GAP, ChipPart, Chips, join_chips, mean_sight, missing_runs
from blocksar.autofocusing.estimation import defocus, halves, phase_step, shared_error, without_line
from blocksar.autofocusing.fine_phase import point_phases, point_shares, rms, shared_samples
from blocksar.autofocusing.information import factor, information
from blocksar.autofocusing.selection import Points, Refused
from blocksar.autofocusing.track_correction import Correction, Knots, between_samples, intervals
from blocksar.autofocusing.work import FILTER_LENGTH, Work
from blocksar.kernels.fourier import fft_rows

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
    """Predict the phase error that remains over a dwell, rad rms.

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
    # Use chips of typical length: those at the ends of a collection would dominate. Next to a gap they must count.
    usual = float(np.median(each) if far_from_gaps(chips).all() else each.mean())
    # The last two loops are two estimates as well: each deviates from their mean by half of their difference.
    unsettled = 0.5 * last["step"] if last["step"] > settings.step else 0.0
    moved = correction.displacement - correction.previous
    sharp = chips.recentred(moved).corrected(moved)
    # Extrapolate as a random walk, but never beyond what the samples show.
    beyond = correction.fine_error or min(unfollowed(chips, correction, halves), fine_samples(sharp, correction))
    patterns = AMPLITUDE_TO_PHASE * amplitude_in_common(sharp, correction)
    across = told_across_gaps(sharp, correction)
    common = alike_nearby(sharp, points, correction)
    parts = (HALVES_TO_WHOLE * usual, beyond, unsettled, patterns, across, common)
    return float(np.sqrt(sum(part**2 for part in parts)))


def alike_nearby(chips: Chips, points: Points, correction: Correction) -> float:
    """Error common to points near each other in their own phases, rad rms over chips.

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
            weighted = part / part.sum() * bend
            variances.append(float((weighted[:, None] * weighted[neighbours]).sum()))
    return math.sqrt(max(sum(variances) / max(len(variances), 1), 0.0))


def bends(phase: FloatArray, chips: Chips) -> FloatArray:
    """Rms with sign (n_point,), rad, of the parabola in phases (n_point, n) over each dwell."""
    out = np.zeros(phase.shape[0])
    for i, valid in enumerate(chips.told):
        at = np.flatnonzero(valid)
        if at.size >= LEAST_COUNT:
            u = at - at.mean()
            parabola = solvers.orthogonal_basis(np.stack([np.ones(at.size), u, u * u]))[0][2]
            out[i] = (parabola * phase[i, at]).sum() / np.sqrt(at.size)
    return out


def told_across_gaps(chips: Chips, correction: Correction) -> float:
    """Uncertainty of how the sides of gaps fit together, rad rms over chips; 0 without gaps.

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
        for i, valid in enumerate(some.told):
            at = np.flatnonzero(valid)
            u, after = np.linspace(-1, 1, valid.size)[at], (some.index[i, at] >= gap.stop).astype(np.float64)
            terms = solvers.orthogonal_basis(np.stack([np.ones(at.size), u, after, after * u]))[0]
            left[i] = (terms[2:] * phase[i, at]).sum(axis=1) / np.sqrt(at.size)
        mean = (weights[:, None] * left).sum(axis=0)
        spread = ((weights[:, None] * (left - mean)) ** 2).sum(axis=0) * both.size / (both.size - 1)
        error += float(spread.sum()) * both.size / chips.first.size
    return float(np.sqrt(error))


def amplitude_in_common(chips: Chips, correction: Correction) -> float:
    """Relative amplitude, rms, that all points have in common over a dwell, of the median chip.

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
    """Mask (n_sample,) of samples outside the long gaps whose low-pass does not reach into one."""
    far = np.ones(chips.seen.size, bool)
    for run in missing_runs(chips.seen):
        if run.stop - run.start > SHORT_GAP:
            far[max(run.start - FILTER_LENGTH, 0) : run.stop + FILTER_LENGTH] = False
    return far


def fine_samples(chips: Chips, correction: Correction) -> float:
    """Rms phase of the samples beyond what splines follow, rad, of the median chip: error, noise and neighbours.

    `chips` are corrected, about their brightest scatterers.
    """
    knots = Knots(work=chips.work, n_interval=intervals(chips.work), time=chips.time)
    phase = shared_samples(chips, correction.weights)[:, 0]
    fine = phase - knots.smooth(phase[:, None])[:, 0]
    return float(np.median(defocus(chips, fine[chips.index])))


def unfollowed(chips: Chips, correction: Correction, halves: Sequence[FloatArray]) -> float:
    """Error too fine for the splines, rad rms, of the median chip, if no fine phase is accepted.

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


UNSETTLED = 0.1  # rad rms by which the last loop may change the phases
SLOW = 4  # intervals of the finest spline for one of those that follow slow motion
TURNS = 0.1  # whole turns of the phase that may remain unknown
PICTURES = 6  # points whose chips are kept for pictures


@dataclass(frozen=True, kw_only=True, eq=False)
class Result:
    """The corrected track, and the figures of its estimate.

    Attributes
    ----------
    antenna_position : (n_pulse, 3) float
        Corrected, m.
    time : (n,) float
        Slow times, s, of the next two.
    track_error : (n, 3) float
        Stated minus corrected position, m.
    uncertainty : (n, 3) float
        Standard deviation of that, m. What the samples do not tell at all has `EstimatorSettings.displacement`.
    x, y : (n_picture,) float
        Places of some points, m.
    chips_before, chips_after : (n_picture, n_line, n_doppler) float32
        Their power before and after correction, of a common scale, Doppler ascending.
    figures : dict
        What the attribute `autofocus` of the corrected store says.
    """

    antenna_position: FloatArray
    time: FloatArray
    track_error: FloatArray
    uncertainty: FloatArray
    x: FloatArray
    y: FloatArray
    chips_before: FloatArray
    chips_after: FloatArray
    figures: dict[str, Any]


@dataclass(frozen=True, kw_only=True, eq=False)
class HalfEstimate:
    """Estimate from one half of the points: splines of a displacement (n_sample, 3), m, on `Correction.previous`."""

    displacement: FloatArray


def estimate_half(
    work: Work, points: Points, parts: Sequence[ChipPart], correction: Correction, number: int, threads: int = 1
) -> HalfEstimate:
    """Estimate from half `number`, 0 or 1, of the points, from the beginning; `parts` are those of the last loop."""
    chips = join_chips(work, points, parts, correction.previous)
    half = halves(chips)[number]
    found = shared_error(
        chips.some(half), correction.previous, correction.weights[half], threads, rough=correction.rough
    )
    return HalfEstimate(displacement=Knots(work=work, n_interval=intervals(work), time=chips.time).smooth(found))


def finish(
    work: Work, points: Points, parts: Sequence[ChipPart], correction: Correction, found: Sequence[HalfEstimate]
) -> Result:
    """Compare estimates from both halves of the points, and correct the track.

    Parameters
    ----------
    parts : sequence of ChipPart
        Of the last loop, from which `correction` came.
    found : sequence of HalfEstimate
        Of both halves.

    Raises
    ------
    Refused
        If the halves differ by more than `EstimatorSettings.halves`, that is predicted, the loops have not settled, or
        whole turns of the phase remain unknown.
    """
    chips = join_chips(work, points, parts, correction.previous)
    between = found[0].displacement - found[1].displacement
    apart = phase_step(chips, work.wavenumber * chips.los(between), correction.weights)
    last = correction.history[-1]
    if (turns := unknown_turns(chips, correction.displacement)) > TURNS:
        raise Refused(
            "the samples do not tell the track's error: the points' phase jumps so far from sample to sample that "
            f"some {max(turns, 1):.0f} whole turns of it remain unknown; give a collection with a higher PRF, or focus "
            "the phase history as it is"
        )
    predicted = predicted_error(chips, points, correction, [one.displacement for one in found])
    limit = work.settings.halves
    distinct = int(points.distinct.sum())
    if not (correction.finished and apart <= limit and predicted <= limit and last["step"] <= UNSETTLED):
        few = (
            f"{distinct} of {points.x.size} points {'stands' if distinct == 1 else 'stand'} out of noise and clutter, "
            f"and {work.settings.least_points} tell it as a rule; "
        )
        raise Refused(
            f"the samples do not tell the track's error: {few if distinct < work.settings.least_points else ''}"
            f"two estimates, each from half of {points.x.size} points, "
            f"differ by {apart:.2g} rad rms, the error predicted is {predicted:.2g} rad, and the last loop changed the "
            f"phases by {last['step']:.2g} rad; {limit:g}, {limit:g} and {UNSETTLED:g} are accepted (entropy of the "
            f"chips {correction.history[0]['entropy_before']:.4g} before, {last['entropy_after']:.4g} after); give a "
            "--grid with prominent points, or focus the phase history as it is"
        )
    collection = work.geometry.collection
    moved = between_samples(work, correction.displacement, collection.time)
    before, after, shown = _pictures(chips, correction)
    return Result(
        antenna_position=collection.antenna_position + moved,
        time=work.sample_times,
        track_error=-correction.displacement,
        uncertainty=_uncertainty(chips, correction, predicted),
        x=points.x[shown],
        y=points.y[shown],
        chips_before=before,
        chips_after=after,
        figures={
            "points": int(points.x.size),
            "distinct": distinct,
            "rejected": int((correction.weights < 0.5).sum()),
            "knots": intervals(work) + 1,
            "loops": len(correction.history),
            "halves_apart": apart,
            "predicted_error": predicted,
            "entropy_before": correction.history[0]["entropy_before"],
            "entropy_after": last["entropy_after"],
            "history": list(correction.history),
        },
    )


def unknown_turns(chips: Chips, displacement: FloatArray) -> float:
    """Expected number of steps between samples that exceed half a turn, and are therefore unwrapped wrongly.

    The steps are normally distributed, as those of a random walk: slow motion, which splines follow, is taken out.
    """
    work = chips.work
    knots = Knots(work=work, n_interval=max(intervals(work) // SLOW, 4), time=chips.time)
    seen = work.wavenumber * (displacement * mean_sight(chips)).sum(axis=1)
    step = float(np.std(np.diff(seen - knots.smooth(seen[:, None])[:, 0])))
    return seen.size * math.erfc(np.pi / max(step, 1e-3) / math.sqrt(2))


def _uncertainty(chips: Chips, correction: Correction, predicted: float) -> FloatArray:
    """Standard deviation (n_sample, 3) of the displacement, m."""
    work = chips.work
    knots = Knots(work=work, n_interval=intervals(work), time=chips.time)
    form, _ = information(chips, knots, correction.weights / correction.weights.sum())
    far = work.settings.displacement * work.wavenumber
    precision = form * (knots.size / max(predicted, 1e-3) ** 2) + np.eye(form.shape[0]) / far**2
    root = factor(precision).reshape(knots.size, 3, -1)
    first, basis = knots.basis
    out = np.zeros((chips.time.size, 3))
    for axis in range(3):
        covariance = np.einsum("ij,kj->ik", root[:, axis], root[:, axis])
        for k in range(4):
            for m in range(4):
                out[:, axis] += basis[:, k] * basis[:, m] * covariance[first + k, first + m]
    return np.asarray(np.sqrt(out) / work.wavenumber)


def _pictures(chips: Chips, correction: Correction) -> tuple[FloatArray, FloatArray, list[int]]:
    """Power of some points' chips before and after the correction, and the indices of these points."""
    shown = [int(i) for i in np.argsort(-correction.weights, kind="stable")[:PICTURES]]
    some = chips.some(np.array(shown))

    def power(displacement: FloatArray) -> FloatArray:
        values: ComplexArray = some.corrected(displacement).values
        n = values.shape[2]
        image = fft_rows(values.reshape(-1, n).copy(), inverse=False).reshape(values.shape)
        return np.roll(np.abs(image).astype(np.float64) ** 2, n // 2, axis=2)

    before = power(-correction.previous)
    after = power(correction.displacement - correction.previous)
    scale = np.maximum(after.max(axis=(1, 2), keepdims=True), 1e-300)
    return (before / scale).astype(np.float32), (after / scale).astype(np.float32), shown
