"""Choice of a block's coefficients: several kinds of chain are fitted, and the cheapest good one is chosen."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blocksar.arrays import BoolArray, FloatArray
from blocksar.collection.geometry import Geometry
from blocksar.focusing.lines import AzimuthPolynomials, Line, focus
from blocksar.focusing.method import Method
from blocksar.planning import closed_form, fitting
from blocksar.planning.binding import AzimuthPart, RangePart
from blocksar.planning.dwell_ends import full_dwells, smear_room
from blocksar.planning.dwell_weights import beam_moves
from blocksar.planning.fidelity import smear_loss
from blocksar.planning.fitting import RESAMPLING_ORDERS, Candidate

GOOD_RESIDUAL = 0.02  # rad: the most that is good; see `good_residual`
RESIDUAL_SHARE = 0.5  # of the allowed loss that residual phase may take before a better chain is preferred
GOOD_LOSS = 4e-4  # of coherence, at the ends of the dwell: below this a cheaper chain is preferred to a better one
ENOUGH_COST = 1.2  # of a kind of chain: no other is tried
KEPT = 1.5  # times the promised cost: what a fit at all ranges may cost to be taken without a look at others
FINER = (1.4, 1.2, 1.1, 1.05)  # factors by which the spread of the best bias is varied, one after the other


def good_residual(fidelity: float) -> float:
    """The residual phase below which a cheaper chain is preferred to a better one, rad.

    A phase like the Legendre polynomial of order n that peaks at p has the mean square p^2 / (2 n + 1), and half of
    that is lost. With n = 3, which a cheaper chain leaves, RESIDUAL_SHARE of the allowed loss is

        p = sqrt(14 RESIDUAL_SHARE (1 - fidelity)).
    """
    return min(GOOD_RESIDUAL, math.sqrt(14 * RESIDUAL_SHARE * (1 - fidelity)))


class Choice(NamedTuple):
    """A kind of chain, and the cost of its fit."""

    candidate: Candidate
    cost: float


def choose(
    geometry: Geometry,
    line: Line,
    range_part: RangePart,
    method: Method,
    *,
    ranges: FloatArray,
    epoch_range: FloatArray,
    yaws: FloatArray,
    shift: float,
    fidelity: float,
    neighbour: Choice | None,
    resampling: int = len(RESAMPLING_ORDERS),
) -> tuple[AzimuthPolynomials, Choice]:
    """Coefficients by the method: in closed form, or of the cheapest fitted chain whose lines end level and unfolded.

    Parameters
    ----------
    geometry : Geometry
    line : Line
        (n_range, n_yaw, n) after range compression; row i belongs to apparent range ranges[i].
    range_part : RangePart
    method : Method
    ranges : (n_range,) float
        Ascending, m from the range origin.
    epoch_range : (n_range, n_yaw) float
        Epoch ranges of the targets that come to lie there, m.
    yaws : (n_yaw,) float
        rad.
    shift : float
        Doppler that recovery and the range part remove from every line, Hz.
    fidelity : float
        Coherence that is asked for: the higher, the less residual phase is good.
    neighbour : Choice or None
        What a neighbour chose, to be taken if it serves here too.
    resampling : int
        The most orders of a Doppler resampling.
    """
    lam, freedom = geometry.collection.wavelength, range_part.freedom
    if method.coefficients == "closed-form":
        polynomials = closed_form.levelling(
            geometry, freedom, epoch_range=epoch_range, ranges=ranges, yaws=yaws, shift=shift,
            in_doppler=range_part.compression.in_doppler, range_model=method.range_model,
        )  # fmt: skip
        return polynomials, Choice(Candidate(0.0, False), 0.0)
    full, good = full_dwells(line, geometry, epoch_range, yaws), good_residual(fidelity)
    if neighbour is not None and neighbour.candidate.resampling <= resampling:
        polynomials = fitting.fit(line, ranges=ranges, candidate=neighbour.candidate, freedom=freedom, wavelength=lam)
        cost = _cost(polynomials, line, range_part, geometry, full, good)
        if cost <= KEPT * neighbour.cost:
            return polynomials, neighbour
    return _find_cheapest(line, range_part, geometry, ranges=ranges, full=full, good=good, resampling=resampling)


def _find_cheapest(
    line: Line,
    range_part: RangePart,
    geometry: Geometry,
    *,
    ranges: FloatArray,
    full: BoolArray,
    good: float,
    resampling: int,
) -> tuple[AzimuthPolynomials, Choice]:
    """The kind of chain with the least cost, fitted. All kinds are tried roughly, at three ranges.

    Under a steered beam the bias of the best kind is then varied: what the ends lose has a sharp minimum where the
    delays of the steps in Doppler vary least over the block. A kind whose fit at all ranges does not keep what it
    promised is passed over. Where that leaves none, or none that is nearly as cheap as the one that ended the rough
    trial, those are tried that it did not reach.
    """
    wavelength, freedom = geometry.collection.wavelength, range_part.freedom
    rows = np.array([0, ranges.size // 2, ranges.size - 1])
    subset = Line(**{name: _pick(getattr(line, name), rows, ranges.size) for name in Line.__dataclass_fields__})

    def fit(candidate: Candidate) -> AzimuthPolynomials:
        return fitting.fit(line, ranges=ranges, candidate=candidate, freedom=freedom, wavelength=wavelength)

    kinds = [
        replace(kind, resampling=resampling)
        for kind in fitting.candidates(line, wavelength=wavelength, freedom=freedom)
    ]
    if len(kinds) == 1:
        return fit(kinds[0]), Choice(kinds[0], np.inf)
    costs: dict[Candidate, float] = {}

    def cheapest(candidates: list[Candidate]) -> float:
        for candidate in candidates:
            polynomials = fitting.fit(
                subset, ranges=ranges[rows], candidate=candidate, freedom=freedom, wavelength=wavelength, roughly=True
            )
            costs[candidate] = _cost(polynomials, subset, range_part, geometry, full[rows], good)
            if costs[candidate] < ENOUGH_COST:
                break
        return min(costs.values())

    if cheapest(kinds) >= ENOUGH_COST and geometry.collection.steered:
        for factor in FINER:
            best = min(costs, key=costs.__getitem__)
            cheapest(fitting.with_spread(line, best, wavelength=wavelength, factors=(1 / factor, factor)))
    fitted: list[tuple[AzimuthPolynomials, Choice]] = []

    def keeps(candidate: Candidate, promised: float) -> bool:
        polynomials = fit(candidate)
        cost = _cost(polynomials, line, range_part, geometry, full, good)
        fitted.append((polynomials, Choice(candidate, cost)))
        return cost <= KEPT * promised

    def settle() -> None:
        done = {choice.candidate for _, choice in fitted}
        for candidate in sorted((each for each in costs if each not in done), key=costs.__getitem__):
            if fitted and costs[candidate] >= min(choice.cost for _, choice in fitted):
                break
            if keeps(candidate, costs[candidate]):
                break

    settle()
    unseen, least = [kind for kind in kinds if kind not in costs], min(choice.cost for _, choice in fitted)
    if least == np.inf:
        any(keeps(kind, ENOUGH_COST) for kind in unseen)
    elif unseen and least > KEPT * ENOUGH_COST:
        cheapest(unseen)
        settle()
    return min(fitted, key=lambda fit: fit[1].cost)


def _cost(
    polynomials: AzimuthPolynomials,
    line: Line,
    range_part: RangePart,
    geometry: Geometry,
    full: BoolArray,
    good: float,
) -> float:
    """Phase error or loss of coherence above the good ones, times the growth in samples; infinite if lines fold."""
    azimuth = AzimuthPart.bind(range_part, polynomials, line)
    biased, _, traced = azimuth.trace(line)
    spread = biased.rate * line.weight.sum(axis=-1, keepdims=True) ** 2
    if traced.folded or not np.isfinite(traced.time).all() or spread.min() * spread.max() < 0:
        return np.inf
    spots = focus(traced)
    lost = smear_loss(traced, spots, biased.rate, geometry, full) if geometry.collection.steered else 0.0
    fault = max(float(spots.residual.max()) / good, lost / GOOD_LOSS, 1.0)
    room = 0.0 if beam_moves(geometry.collection) else 2 * smear_room(traced, biased.rate)
    growth = max((np.ptp(traced.time) + room) / np.ptp(line.time), 1.0) * max(
        np.ptp(biased.doppler) / np.ptp(line.doppler), 1.0
    )
    return float(fault * growth)


def _pick(values: FloatArray, which: NDArray[np.intp], size: int) -> FloatArray:
    """Some rows of an array (size, ...); arrays that broadcast along rows are returned unchanged."""
    return values[which] if values.shape[0] == size else values
