"""One loop of the estimate: phase gradient, then a polish by minimum entropy."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from blocksar import solvers
from blocksar.arrays import ComplexArray, FloatArray, IntArray
from blocksar.autofocusing.bridging import bridged, refuse_gaps, stitched
from blocksar.autofocusing.chips import ChipPart, Chips, join_chips, mean_sight
from blocksar.autofocusing.fine_phase import believed, by_least_squares, is_pattern, shared_samples, standing_alone
from blocksar.autofocusing.information import bending, factor, information
from blocksar.autofocusing.phase_gradient import (
    LEAST_BAND,
    NARROWING,
    line_of_sight,
    own_errors,
    point_weights,
    strongest_lines,
)
from blocksar.autofocusing.selection import Points
from blocksar.autofocusing.spectral_drift import phase_of_drift
from blocksar.autofocusing.track_correction import Correction, Knots, intervals, narrowing
from blocksar.autofocusing.work import Work
from blocksar.kernels.fourier import fast_length, fft_rows
from blocksar.kernels.groups import GROUP_BYTES, run_groups

MEMORY = 12  # steps whose curvature is kept
ARMIJO = 1e-4
CURVATURE = 0.9  # of the slope may be left after a step
TRIES = 20  # of a step's length


class Minimum(NamedTuple):
    """Minimum of a function: its place, its value, and the number of evaluations."""

    at: FloatArray
    value: float
    evaluations: int


def minimise(
    function: Callable[[FloatArray], tuple[float, FloatArray]],
    start: FloatArray,
    *,
    iterations: int,
    gain: float,
    first_step: float,
) -> Minimum:
    """Minimise a smooth function of (n,) that returns its value and gradient.

    Parameters
    ----------
    iterations : int
        At most.
    gain : float
        Stop when two steps together lower the value by less.
    first_step : float
        Length of the first step, in units of the argument.

    References
    ----------
    Nocedal, Wright, "Numerical Optimization", 2nd edition, algorithms 7.4 and 3.5 (bisection in place of zoom).
    """
    x = start.copy()
    value, slope = function(x)
    count, gains = 1, [np.inf, np.inf]
    pairs: list[tuple[FloatArray, FloatArray]] = []
    for _ in range(iterations):
        way = -_product(slope, pairs)
        down = float((way * slope).sum())
        if not down < 0:
            pairs, way = [], -slope
            down = float((way * slope).sum())
        if down == 0:
            break
        length = 1.0 if pairs else first_step / float(np.sqrt((way * way).sum()))
        low, high = 0.0, np.inf
        for _ in range(TRIES):
            new = x + length * way
            new_value, new_slope = function(new)
            count += 1
            if new_value > value + ARMIJO * length * down:
                high = length
            elif float((new_slope * way).sum()) < CURVATURE * down:
                low = length
            else:
                break
            length = (low + high) / 2 if np.isfinite(high) else 2 * low
        if new_value >= value:
            break
        step, change = new - x, new_slope - slope
        if float((step * change).sum()) > 0:
            pairs = [*pairs[-MEMORY + 1 :], (step, change)]
        gains = [gains[1], value - new_value]
        x, value, slope = new, new_value, new_slope
        if sum(gains) < gain:
            break
    return Minimum(x, value, count)


def _product(slope: FloatArray, pairs: list[tuple[FloatArray, FloatArray]]) -> FloatArray:
    """The approximate inverse Hessian times a slope, from pairs of steps and changes of the slope."""
    q, factors = slope.copy(), []
    for step, change in reversed(pairs):
        factor = float((step * q).sum() / (step * change).sum())
        q -= factor * change
        factors.append(factor)
    if pairs:
        step, change = pairs[-1]
        q *= float((step * change).sum() / (change * change).sum())
    for (step, change), factor in zip(pairs, reversed(factors), strict=True):
        q += (factor - float((change * q).sum() / (step * change).sum())) * step
    return q


TINY = 1e-30
PADDING = 2.0  # Doppler cells for each sample: with |Y|^2 sampled so finely, to move a chip costs nothing


def entropies(values: ComplexArray, phase: FloatArray, threads: int = 1) -> tuple[FloatArray, FloatArray]:
    """Entropy of each chip, and its gradient.

    E = -sum p ln p over range lines and Doppler, p = |Y|^2 / sum |Y|^2, Y the transform of values exp(j phase).
    dE / dphase_t = 2 Im(x_t conj(sum_k (ln p_k + 1) Y_k exp(+2j pi k t / N))) / sum |Y|^2, summed over lines.

    Parameters
    ----------
    values : (n_point, n_line, n) complex64
    phase : (n_point, n) float
        rad.
    threads : int
        The result does not depend on it.

    Returns
    -------
    (n_point,) float, (n_point, n) float
        Nats, and nats per rad.
    """
    n_point, n_line, n = values.shape
    length = fast_length(PADDING * n)
    entropy, gradient = np.zeros(n_point), np.zeros((n_point, n))

    def some(rows: slice) -> None:
        turned = values[rows] * np.exp(1j * phase[rows]).astype(np.complex64)[:, None]
        image = np.zeros((turned.shape[0], n_line, length), np.complex64)
        image[..., :n] = turned
        image = fft_rows(image.reshape(-1, length), inverse=False).reshape(image.shape)
        share = image.real**2
        share += image.imag**2
        total = share.sum(axis=(1, 2), dtype=np.float64)
        positive = total > 0
        scale = np.where(positive, 1 / np.where(positive, total, 1.0), 0.0)
        share *= scale.astype(np.float32)[:, None, None]
        logarithm = share + np.float32(TINY)
        np.log(logarithm, out=logarithm)
        entropy[rows] = -(share * logarithm).sum(axis=(1, 2), dtype=np.float64)
        logarithm += 1
        image *= logarithm
        back = fft_rows(image.reshape(-1, length), inverse=True).reshape(image.shape)[..., :n]
        imaginary = turned.imag * back.real - turned.real * back.imag
        gradient[rows] = imaginary.sum(axis=1, dtype=np.float64) * (2 * length * scale)[:, None]

    many = max(GROUP_BYTES // (8 * n_line * length), 1)
    run_groups(some, [slice(i, min(i + many, n_point)) for i in range(0, n_point, many)], threads)
    return entropy, gradient


GRADIENTS = 8  # iterations of the phase gradient
WIDEST_BAND = 0.45  # of a chip's Doppler cells to either side, in the first of them
DRIFT_BAND = 0.06  # likewise where it starts from the drift of spectra
LEVELS = 3  # splines, each with twice the intervals of the one before
LEAST_LOOPS = 2  # least squares of the first loop are still biased towards the polish
ITERATIONS = 40  # of the polish, for each of them
BY_FAR = 0.3  # nats a chip
GAIN = 1e-5  # nats a chip: two steps of the polish that gain less are the last
SHARPNESS = 4.0  # nats by which a chip's entropy rises for 1 rad^2 of phase error, about
FIRST_STEP = 0.1  # of the polish, in units in which the cost bends by 1
ANCHOR = 1e-2  # nats per rad^2 that moves points, in the units alone: between Doppler cells entropy is not smooth


class Coarse(NamedTuple):
    """First estimate of the displacement (n_sample, 3), m; `rough` if the phase gradient gave far sharper chips."""

    displacement: FloatArray
    rough: bool


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
    weights : (n_point,) float
    start : (size, 3) float
        Coefficients, rad, of the displacement that is polished. The whole is tethered: what chips hardly tell, as a
        constant and a line, stays small.
    threads : int
    """

    chips: Chips
    knots: Knots
    weights: FloatArray
    start: FloatArray
    threads: int = 1

    @cached_property
    def prior(self) -> FloatArray:
        """Quadratic form (size * 3, size * 3) of the roughness prior on the polish, nats per rad^2 of coefficients."""
        rough = self.chips.work.settings.roughness * self.chips.work.wavenumber * self.knots.step**2
        return np.asarray(self.chips.work.settings.prior * bending(self.knots.size) / rough**2)

    @property
    def tether(self) -> float:
        """Weight of the prior on the size of the whole displacement, nats per rad^2 of a coefficient."""
        return self.chips.work.settings.prior / self._far**2 / self.knots.size

    @property
    def _far(self) -> float:
        """Displacement, rad, at which the prior costs `EstimatorSettings.prior`."""
        return self.chips.work.settings.displacement * self.chips.work.wavenumber

    @cached_property
    def units(self) -> FloatArray:
        """Scale from the minimiser's argument to coefficients, rad, (size * 3, size * 3): the Hessian becomes unit."""
        form, flat = information(self.chips, self.knots, self.weights / self.weights.sum())
        return factor(2 * (SHARPNESS * form + ANCHOR * flat + self.prior + self.tether * np.eye(form.shape[0])))

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
        whole = (self.start + coefficients).ravel()
        bent = np.einsum("ij,j->i", self.prior, coefficients.ravel())
        cost = float((coefficients.ravel() * bent).sum() + self.tether * (whole * whole).sum())
        slope += 2 * (bent + self.tether * whole)
        return float((share * entropy).sum()) + cost, np.asarray(np.einsum("ij,i->j", self.units, slope))


def by_phase_gradient(chips: Chips, weights: FloatArray, drift: bool = False) -> FloatArray:
    """Displacement along the mean line of sight (n_sample, 3), m, by phase gradient alone.

    With `drift`, it starts from that of the drift of spectra, and with a band as wide as these tell it.
    """
    narrow = chips.narrowed(chips.work.coarse)
    narrow = replace(narrow, values=strongest_lines(narrow))
    mean = mean_sight(narrow)
    displacement = np.zeros(mean.shape)
    band = int(WIDEST_BAND * narrow.values.shape[2])
    if drift:
        phase = without_line(phase_of_drift(narrow, weights))
        displacement = mean * (phase / narrow.work.wavenumber)[:, None]
        band = int(DRIFT_BAND * narrow.values.shape[2])
    for _ in range(GRADIENTS):
        phase = narrow.work.wavenumber * narrow.los(displacement)
        shared = without_line(line_of_sight(narrow, phase, band, weights))
        displacement += mean * (shared / narrow.work.wavenumber)[:, None]
        band = max(int(NARROWING * band), LEAST_BAND)
    return np.stack([np.interp(chips.time, narrow.time, axis) for axis in displacement.T], axis=1)


def without_line(values: FloatArray) -> FloatArray:
    """Subtract the mean and linear trend of values (n,), which no chip determines."""
    u = np.linspace(-1, 1, values.size)
    flat = values - values.mean()
    return np.asarray(flat - u * (u * flat).sum() / (u * u).sum())


def by_entropy(
    chips: Chips, start: FloatArray, before: FloatArray, weights: FloatArray, threads: int = 1
) -> FloatArray:
    """Polish a displacement (n_sample, 3), m, by minimum entropy with splines of ever more intervals.

    Chips were taken with `before` (n_sample, 3), to which it is added.
    """
    work, finest = chips.work, intervals(chips.work)
    narrow = chips.corrected(start).narrowed(narrowing(work, finest))
    displacement = start
    for level in range(LEVELS - 1, -1, -1):
        count = max(finest >> level, 4)
        wide = Knots(work=work, n_interval=count, time=chips.time)
        knots = Knots(work=work, n_interval=count, time=narrow.time)
        whole = wide.fit(before + displacement) * work.wavenumber
        polish = Polish(chips=narrow, knots=knots, weights=weights, start=whole, threads=threads)
        found = minimise(polish.cost, np.zeros(knots.size * 3), iterations=ITERATIONS, gain=GAIN, first_step=FIRST_STEP)
        moved = polish.coefficients(found.at) / work.wavenumber
        narrow = narrow.corrected(knots.values(moved))
        displacement = displacement + wide.values(moved)
    return displacement


def refined(
    chips: Chips, displacement: FloatArray, before: FloatArray, weights: FloatArray
) -> tuple[FloatArray, float]:
    """Replace the part of a displacement too fine for splines by the part that both halves of the points agree on.

    Parameters
    ----------
    displacement : (n_sample, 3) float
        m, to be added to that with which the chips were taken, `before` (n_sample, 3).

    Returns
    -------
    (n_sample, 3) float, float
        The displacement, and the error that is expected of its fine part, rad rms.
    """
    work, wavenumber = chips.work, chips.work.wavenumber
    knots = Knots(work=work, n_interval=intervals(work), time=chips.time)
    sight = mean_sight(chips)
    smooth = knots.smooth(before + displacement)
    sharp = chips.corrected(smooth - before)  # without accepted fine parts, which halves must not share

    def estimates(weights: FloatArray) -> list[FloatArray]:
        each = [shared_samples(sharp.some(half), weights[half]) for half in halves(chips)]
        return [shared - knots.smooth(shared) for shared in each]

    found = estimates(weights)
    if is_pattern(found[0][:, 1], found[1][:, 1]):
        found = estimates(np.where(standing_alone(chips.corrected(displacement)), weights, 0.0))
    fine = believed(found[0], found[1])
    # Across the mean line of sight, errors are common to all points, and only splines determine them.
    unseen = float(np.sqrt((fine.phase**2).mean())) * spread_of_sights(chips)
    beyond = 0.0 if work.decimation == 1 else fine.beyond
    # Use chips of typical length: at the ends of a collection, where few points are lit, halves differ most.
    doubt = float(np.median(defocus(chips, fine.doubt[chips.index])))
    error = float(np.sqrt(doubt**2 + unseen**2 + beyond**2))
    return smooth + sight * (fine.phase / wavenumber)[:, None] - before, error


def spread_of_sights(chips: Chips) -> float:
    """Rms angle between the points' lines of sight and their mean at the same time, rad."""
    away = np.where(chips.lit[..., None], chips.sight - mean_sight(chips)[chips.index], 0.0)
    return float(np.sqrt((away * away).sum() / max(int(chips.lit.sum()), 1)))


def halves(chips: Chips) -> tuple[IntArray, IntArray]:
    """Divide the points into two disjoint halves with similar dwells."""
    order = np.argsort(2 * chips.first + chips.count, kind="stable")
    return order[0::2], order[1::2]


def coarse_error(chips: Chips, weights: FloatArray, threads: int = 1, corrected: bool = False) -> Coarse:
    """Estimate a first displacement, from the drift of spectra or by the phase gradient alone.

    The drift follows smooth errors only. In a regular pattern of points, phases that are much too rough make chips as
    sharp as the true ones, and deceive the phase gradient: it is taken alone where it is sharper by far, as with a
    random walk of the position. If chips are `corrected` already, none at all comes before both.
    """

    def cost(displacement: FloatArray) -> float:
        return _entropy(chips.corrected(displacement), weights, threads)

    found = [np.zeros(0)] * 2

    def one(number: int) -> None:
        found[number] = by_phase_gradient(chips, weights, drift=number == 0)

    run_groups(one, (0, 1), threads)
    usual = np.zeros_like(found[0]) if corrected else found[0]
    best = min(usual, *found, key=lambda displacement: cost(displacement) + (0.0 if displacement is usual else BY_FAR))
    return Coarse(best, rough=best is found[1])


def shared_error(
    chips: Chips, before: FloatArray, weights: FloatArray, threads: int = 1, *, rough: bool = True
) -> FloatArray:
    """Estimate the displacement (n_sample, 3), m, that sharpens chips taken with that of `before` (n_sample, 3).

    The phase gradient is not tried alone where the error is not `rough`.
    """
    found = (
        coarse_error(chips, weights, threads).displacement if rough else by_phase_gradient(chips, weights, drift=True)
    )
    chips = chips.recentred(found)
    found = stitched(chips, by_entropy(chips, found, before, weights, threads), weights)
    for _ in range(2):
        found = by_least_squares(chips, found, before, weights)
    return bridged(chips, found, before)


def estimate(
    work: Work, points: Points, parts: Sequence[ChipPart], correction: Correction, threads: int = 1
) -> Correction:
    """Run one loop: add the displacement estimated from the chips to the correction with which they were taken.

    Raises
    ------
    Refused
        If pulses are missing over so long a gap that the error cannot be followed.
    """
    before = correction.displacement
    chips = join_chips(work, points, parts, before)
    refuse_gaps(chips)
    weights = correction.weights if correction.weights.size else np.ones(points.x.size)
    first = not correction.history
    coarse = Coarse(np.zeros_like(before), rough=False)
    if first or correction.rough:
        coarse = coarse_error(chips, weights, threads, corrected=not first)
    found = coarse.displacement
    chips = chips.recentred(found)
    found = stitched(chips, by_entropy(chips, found, before, weights, threads), weights)
    found = by_least_squares(chips, found, before, weights)
    found, fine_error = refined(chips, bridged(chips, found, before), before, weights)
    corrected = chips.corrected(found)
    step = phase_step(chips, work.wavenumber * chips.los(found), weights)
    done = len(correction.history) + 1
    figures = {
        "loop": done,
        "step": step,
        "entropy_before": _entropy(chips, weights, threads),
        "entropy_after": _entropy(corrected, weights, threads),
    }
    return Correction(
        displacement=before + found,
        previous=before,
        weights=point_weights(own_errors(corrected)),
        fine_error=fine_error,
        rough=correction.rough or coarse.rough,
        history=(*correction.history, figures),
        finished=(done >= LEAST_LOOPS and step < work.settings.step) or done >= work.settings.loops,
    )


def _entropy(chips: Chips, weights: FloatArray, threads: int) -> float:
    """Mean entropy of chips as they are, nats."""
    narrow = chips.narrowed(chips.work.coarse)
    each, _ = entropies(narrow.values, np.zeros(narrow.index.shape), threads)
    return float((weights * each).sum() / weights.sum())


def phase_step(chips: Chips, phase: FloatArray, weights: FloatArray) -> float:
    """Rms over chips of the part of phases (n_point, n) that defocuses, rad."""
    return float(np.sqrt((weights * defocus(chips, phase) ** 2).sum() / weights.sum()))


def defocus(chips: Chips, phase: FloatArray) -> FloatArray:
    """Rms (n_point,) of phases (n_point, n) over each chip, without what a constant and a ground shift explain."""
    out, valid = np.zeros(phase.shape[0]), chips.told
    for i in range(phase.shape[0]):
        at = np.flatnonzero(valid[i])
        if at.size < 4:
            continue
        sight = chips.sight[i, at, :2].T
        terms = np.concatenate([np.ones((1, at.size)), sight - sight.mean(axis=1, keepdims=True)])
        rest = phase[i, at]
        for term in solvers.orthogonal_basis(terms)[0]:
            rest -= term * (term * rest).sum()
        out[i] = np.sqrt((rest * rest).mean())
    return out
