"""The end of an estimate: two estimates from disjoint halves of the points, refusal, and the corrected track."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.autofocusing.chips import ChipPart, Chips, join_chips, mean_sight
from blocksar.autofocusing.correction import Correction, Knots, between_samples, intervals
from blocksar.autofocusing.estimation import halves, phase_step, shared_error
from blocksar.autofocusing.information import factor, information
from blocksar.autofocusing.prediction import predicted_error
from blocksar.autofocusing.selection import Points, Refused
from blocksar.autofocusing.work import Work
from blocksar.kernels.fourier import fft_rows

UNSETTLED = 0.1  # rad rms by which the last loop may change the phases
SLOW = 4  # intervals of the finest spline for one of those that follow slow motion
TURNS = 0.1  # whole turns of the phase that may remain unknown
PICTURES = 6  # points whose chips are kept for pictures


@dataclass(frozen=True, kw_only=True, eq=False)
class Result:
    """The corrected track, and what is known of it.

    Attributes
    ----------
    antenna_position : (n_pulse, 3) float
        Corrected, m.
    time : (n,) float
        Slow times, s, of the next two.
    track_error : (n, 3) float
        Stated minus corrected position, m.
    uncertainty : (n, 3) float
        Standard deviation of that, m. What the samples do not tell at all has `Settings.displacement`.
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
        If the halves differ by more than `Settings.halves`, that is predicted, the loops have not settled, or whole
        turns of the phase remain unknown.
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
            f"{distinct} of {points.x.size} points stand out of noise and clutter, and {work.settings.least_points} "
            "tell it as a rule; "
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
    """Steps between samples that are expected to exceed half a turn, and count as whole turns less, of all samples.

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
    told, _ = information(chips, knots, correction.weights / correction.weights.sum())
    far = work.settings.displacement * work.wavenumber
    precision = told * (knots.size / max(predicted, 1e-3) ** 2) + np.eye(told.shape[0]) / far**2
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
    """Power of some points' chips, before any correction and after the last; and which points."""
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
