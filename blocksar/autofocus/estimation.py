"""One loop of the estimate: phase gradient, then a polish by minimum entropy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.autofocus.chips import ChipPart, Chips, join_chips
from blocksar.autofocus.correction import Correction, Knots, intervals
from blocksar.autofocus.entropy import entropies
from blocksar.autofocus.information import bending, factor, information
from blocksar.autofocus.minimising import minimise
from blocksar.autofocus.phase_gradient import LEAST_BAND, NARROWING, line_of_sight
from blocksar.autofocus.robust import own_errors, point_weights
from blocksar.autofocus.selection import Points
from blocksar.autofocus.work import FILTER_BAND, Work

GRADIENTS = 6  # iterations of the phase gradient
LEVELS = 3  # splines, each with twice the intervals of the one before
ITERATIONS = 40  # of the polish, for each of them
GAIN = 1e-5  # nats a chip: two steps of the polish that gain less are the last
SHARPNESS = 4.0  # nats by which a chip's entropy rises for 1 rad^2 of phase error, about
ANCHOR = 1e-2  # nats per rad^2 that moves points, in the units alone: between Doppler cells entropy is not smooth


@dataclass(frozen=True, kw_only=True, eq=False)
class Polish:
    """The cost of a spline: mean entropy of the chips plus the smoothness prior.

    Coefficients are counted in rad, that is times the wavenumber, and in units in which the cost bends alike in all
    directions, about: otherwise displacements across the line of sight, which hardly matter, would take thousands of
    iterations.

    Attributes
    ----------
    chips : Chips
    knots : Knots
        At the chips' times.
    base : (size, 3) float
        Coefficients, rad, that are corrected already: the prior is about the sum.
    weights : (n_point,) float
    threads : int
    """

    chips: Chips
    knots: Knots
    base: FloatArray
    weights: FloatArray
    threads: int = 1

    @cached_property
    def prior(self) -> FloatArray:
        """Cost of coefficients, nats per rad^2, as a quadratic form (size * 3, size * 3).

        Nothing for a constant and a line of each axis: chips hardly tell them, and must not be moved in vain.
        """
        settings, wavenumber, size = self.chips.work.settings, self.chips.work.wavenumber, self.knots.size
        rough = settings.roughness * wavenumber * self.knots.step**2
        line = np.linspace(-1, 1, size)
        flat = np.stack([np.full(size, 1 / np.sqrt(size)), line / np.sqrt((line * line).sum())])
        inner = np.eye(size) - np.einsum("ri,rj->ij", flat, flat)
        far = np.einsum("ij,ab->iajb", inner, np.eye(3)).reshape(3 * size, 3 * size) / size
        return np.asarray(settings.prior * (bending(size) / rough**2 + far / self._far**2))

    @property
    def _far(self) -> float:
        """Displacement that costs `Settings.prior`, rad."""
        return self.chips.work.settings.displacement * self.chips.work.wavenumber

    @cached_property
    def units(self) -> FloatArray:
        """Coefficients, rad, of each unit of the argument, (size * 3, size * 3)."""
        told, flat = information(self.chips, self.knots, self.weights / self.weights.sum())
        loose = self.chips.work.settings.prior / self._far**2 / self.knots.size * np.eye(told.shape[0])
        return factor(2 * (SHARPNESS * told + ANCHOR * flat + self.prior + loose))

    def coefficients(self, argument: FloatArray) -> FloatArray:
        """Coefficients (size, 3), rad, at an argument (size * 3,)."""
        return np.asarray(np.einsum("ij,j->i", self.units, argument).reshape(-1, 3))

    def cost(self, argument: FloatArray) -> tuple[float, FloatArray]:
        """Cost, nats, and its gradient, at an argument (size * 3,)."""
        coefficients = self.coefficients(argument)
        phase = -self.chips.los(self.knots.values(coefficients))
        entropy, gradient = entropies(self.chips.values, phase, self.threads)
        share = self.weights / self.weights.sum()
        slope = self.knots.adjoint(-self.chips.spread(gradient * share[:, None])).ravel()
        whole = (self.base + coefficients).ravel()
        bent = np.einsum("ij,j->i", self.prior, whole)
        value = float((share * entropy).sum() + (whole * bent).sum())
        return value, np.asarray(np.einsum("ij,i->j", self.units, slope + 2 * bent))


def by_phase_gradient(chips: Chips, weights: FloatArray) -> FloatArray:
    """Coefficients of splines along the mean line of sight, m, by phase gradient alone, (size, 3)."""
    work, n_interval = chips.work, intervals(chips.work)
    knots = Knots(work=work, n_interval=n_interval, time=chips.time)
    mean = chips.spread(chips.lit.astype(np.float64))
    mean /= np.maximum(np.sqrt((mean * mean).sum(axis=1, keepdims=True)), 1e-300)
    coefficients = np.zeros((knots.size, 3))
    band = int(0.45 * chips.values.shape[2])
    for _ in range(GRADIENTS):
        phase = work.wavenumber * chips.los(knots.values(coefficients))
        shared = line_of_sight(chips, phase, band, n_interval, weights)
        coefficients += _without_line(knots.fit(mean * (shared / work.wavenumber)[:, None]))
        band = max(int(NARROWING * band), LEAST_BAND)
    return coefficients


def _without_line(coefficients: FloatArray) -> FloatArray:
    """Without their mean line: no chip tells it."""
    u = np.linspace(-1, 1, coefficients.shape[0])[:, None]
    flat = coefficients - coefficients.mean(axis=0)
    return np.asarray(flat - u * (u * flat).sum(axis=0) / (u * u).sum())


def by_entropy(
    chips: Chips, coefficients: FloatArray, before: FloatArray, weights: FloatArray, threads: int = 1
) -> FloatArray:
    """Polish coefficients (size, 3), m, by minimum entropy, with ever more intervals.

    The chips were taken with coefficients `before` (size, 3), m, in place.
    """
    work, finest = chips.work, intervals(chips.work)
    wide = Knots(work=work, n_interval=finest, time=chips.time)
    chips = chips.corrected(wide.values(coefficients)).narrowed(_narrowing(work, finest))
    total, wide_narrow = coefficients, Knots(work=work, n_interval=finest, time=chips.time)
    for level in range(LEVELS - 1, -1, -1):
        knots = Knots(work=work, n_interval=max(finest >> level, 4), time=chips.time)
        base = knots.fit(wide_narrow.values(before + total)) * work.wavenumber
        polish = Polish(chips=chips, knots=knots, base=base, weights=weights, threads=threads)
        start = np.zeros(knots.size * 3)
        found = minimise(polish.cost, start, iterations=ITERATIONS, gain=GAIN, first_step=0.1)
        moved = polish.coefficients(found.at) / work.wavenumber
        chips = chips.corrected(knots.values(moved))
        total = total + wide.fit(Knots(work=work, n_interval=knots.n_interval, time=wide.time).values(moved))
    return total


def _narrowing(work: Work, n_interval: int) -> int:
    """By how much chips are decimated for the polish."""
    rate = work.settings.narrow_speed * work.wavenumber / np.pi / FILTER_BAND  # Hz
    by_speed = int(work.geometry.collection.prf / work.decimation / rate)
    return max(min(by_speed, work.n_sample // (2 * n_interval)), 1)


def shared_error(
    chips: Chips, before: FloatArray, weights: FloatArray, threads: int = 1
) -> FloatArray:
    """Coefficients (size, 3), m, of the displacement that sharpens chips that were taken with those `before`."""
    return by_entropy(chips, by_phase_gradient(chips, weights), before, weights, threads)


def estimate(
    work: Work, points: Points, parts: Sequence[ChipPart], correction: Correction, threads: int = 1
) -> Correction:
    """One loop: what the chips tell, added to the correction with which they were taken."""
    chips = join_chips(work, points, parts, correction)
    weights = correction.weights if correction.weights.size else np.ones(points.x.size)
    found = shared_error(chips, correction.coefficients, weights, threads)
    knots = Knots(work=work, n_interval=intervals(work), time=chips.time)
    corrected = chips.corrected(knots.values(found))
    before, after = (entropies(part.values, np.zeros(chips.index.shape), threads)[0] for part in (chips, corrected))
    step = phase_step(chips, work.wavenumber * chips.los(knots.values(found)), weights)
    done = len(correction.history) + 1
    figures = {
        "loop": done,
        "step": step,
        "entropy_before": float((weights * before).sum() / weights.sum()),
        "entropy_after": float((weights * after).sum() / weights.sum()),
    }
    return Correction(
        coefficients=correction.coefficients + found,
        weights=point_weights(own_errors(corrected)),
        history=(*correction.history, figures),
        finished=step < work.settings.step or done >= work.settings.loops,
        previous=correction.coefficients,
    )


def phase_step(chips: Chips, phase: FloatArray, weights: FloatArray) -> float:
    """Phases (n_point, n) that defocus: rms over chips without each one's mean line, rad."""
    total = 0.0
    for i in range(phase.shape[0]):
        values = phase[i, : chips.count[i]]
        u = np.linspace(-1, 1, values.size)
        values = values - values.mean()
        values = values - u * (u * values).sum() / (u * u).sum()
        total += weights[i] * float((values * values).mean())
    return float(np.sqrt(total / weights.sum()))
