"""Choice of a block's coefficients: the cheapest sufficient of several fitted kinds of chain, or closed forms.

CLOSED FORMS of the azimuth steps, expanded about the centre of a block, as in the papers.

After range-walk correction and RCMC a target at yaw offset D from the block's centre has the azimuth phase
-(4 pi / lambda) [k_1'' t + k_2 t^2 + k_3 t^3 + k_4 t^4], k_n = k_n0 + k_n1 D + k_n2 D^2 (paper A (2), (21)), which
in the time-frequency plane is the line

    f(t) = f0 + r t + c t^2 + q t^3,    f0 = -(2 / lambda) (k_11 D + k_12 D^2 + ..)
    r = -(4 / lambda) k_2,              c = -(6 / lambda) k_3,              q = -(8 / lambda) k_4.

Where all targets are lit about t = 0, f0 separates them: D = -lambda f0 / (2 k_11) - k_12 lambda^2 f0^2 / (4 k_11^3)
turns yaw series into Doppler series r = r0 + r1 f0 + r2 f0^2, c = c0 + c1 f0, q = q0 + q1 f0.

FREQUENCY PERTURBATION AS PRINTED (paper A (30), (31)). Erratum applied: (26) is exp[j pi (alpha f^3 + beta f^4)].
(28) is of first order in alpha. Since inverse rates add, the second term of beta should have 96 in place of 48. It is
left as printed, so that the residuals are those of the printed formulas.

CONVENTIONAL RANGE MODEL (the reference method of paper A's Table 2 and Figure 14). The paper says: the model is of
fourth order in slow time, range-walk correction displaces targets in range, and the model is fitted to that by
variable substitution, which brings in approximations; the scene is not divided, all other steps are the paper's own,
and the space-variant components of the third-order term remain. The paper does not give the model, it only cites it.
This stand-in is built instead: a target of azimuth coordinate u comes to lie at R' = R + a_1 u + a_2 u^2 + .., and the
substitution is R = R' - a_1 u. The substitution holds to first order in azimuth, so k_n(R', u) is known to first order
only, k_n0 + k_n1 u. Hence the condition D_21 = 0 of (29) alone: alpha as in (30), no beta, third and fourth order
constant. To first order all choices of u, and the polar model, give the same alpha.

DOPPLER RESAMPLING (paper B, of which only the abstract was available; derived here). Time perturbation sets r0, c0 and
q0 and nothing else. Resampling f -> h(f) = f + e2 f^2 + e3 f^3 maps (t, f) to (t / h'(f), h(f)). The middle of every
line stays in time, and there the line becomes, with a, b, g = h'(f0), h''(f0), h'''(f0),

    F(T) = h(f0) + a^2 r T + (a^3 c + 3/2 a^2 b r^2) T^2
           + (a^4 q + 4 a^3 b c r + 2/3 a^3 g r^3 + 2 a^2 b^2 r^3) T^3 + ..

All targets have one slope for h' = sqrt(r0 / r(f0)), to second order in f0

    e2 = -r1 / (4 r0),    e3 = r1^2 / (8 r0^2) - r2 / (6 r0).

The T^2 term then still varies along f0. The constants that make it and the T^3 term constant, to first order, are

    c0 = r0 (8 c1 - 12 r0 r2 + 3 r1^2) / (12 r1)
    q0 = [16 c0 (r1^2 - r0 r2) - 8 c1 r0 r1 + 4 q1 r0 + 4 r0^2 r1 r2 + r0 r1^3] / (8 r1),

whence p3 = (c0 + 6 k_30 / lambda) / 3, p4 = (q0 + 8 k_40 / lambda) / 4. The deramp removes what all lines share:

    d2 = -r0 / 2,  d3 = -(c0 + 3 e2 r0^2) / 3,  d4 = -(q0 + 8 e2 c0 r0 + 8 e2^2 r0^3 + 4 e3 r0^3) / 4.

The time perturbation acts through e2. Where r1 = 0 (looking broadside) it has no effect, and near there it would fold
lines over. It is left out where it would change a slope by more than STEEPEST.

HIGH-ORDER PHASE CORRECTION (paper C, section IV, gives the idea; derived here). exp{2j pi (p3 f^3 + p4 f^4)}
adds -(6 p3 f + 12 p4 f^2) to the inverse of a Doppler rate, and moves the middles of lines to -3 p3 f0^2. There the
deramp's d3 t^3 has the slope -18 d3 p3 f0^2, which p4 has to compensate as well:

    p3 = -r1 / (6 r0^2),    p4 = r1^2 / (24 r0^3) - r2 / (12 r0^2) + c0 r1 / (12 r0^4),

and the deramp is the reversion of the line of D = 0. For the squinted straight track, at constant output range R':
p3 = -R' lambda^2 sin / (12 v^3 cos^4), p4 = -R' lambda^3 (3 + 7 sin^2) / (192 v^4 cos^6), d2 = v^2 cos^2 / (lambda R'),
d3 = v^3 sin cos^2 / (3 lambda R'^2), with sin and cos of the squint theta_0. p3 is alpha / 2 of (30).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blocksar import solvers
from blocksar.arrays import BoolArray, FloatArray
from blocksar.collection.geometry import Geometry
from blocksar.collection.range_series import YAW_NODES, yaw_series
from blocksar.imaging.method import Method, RangeModel
from blocksar.processors.chain.dwells.dwell_ends import full_dwells, smear_loss, smear_room
from blocksar.processors.chain.dwells.dwell_weights import beam_moves
from blocksar.processors.chain.planning import fitting
from blocksar.processors.chain.planning.binding import AzimuthPart, RangePart
from blocksar.processors.chain.planning.fitting import ORDERS, SERIES_DEGREE, ChainKind, FittedSteps
from blocksar.processors.chain.steps.lines import AzimuthPolynomials, Line, RowPolynomial, focus, row_polynomial

STEEPEST = 0.5  # times r0: the largest change of a line's slope by the time perturbation, anywhere along its dwell


class ClosedForm(NamedTuple):
    """Coefficients per range: phases (n_range, 5) in cycles/s^n and cycles/Hz^n, h(f) - f (n_range, 5) in Hz^(1-n)."""

    time: FloatArray
    doppler: FloatArray
    resampling: FloatArray
    deramp: FloatArray


def levelling(
    geometry: Geometry,
    freedom: FittedSteps,
    *,
    epoch_range: FloatArray,
    ranges: FloatArray,
    yaws: FloatArray,
    shift: float,
    in_doppler: bool,
    range_model: RangeModel = "polar",
) -> AzimuthPolynomials:
    """Coefficients of a chain in closed form; its steps determine the form.

    Parameters
    ----------
    epoch_range : (n_range, n_yaw) float
        Epoch ranges of the targets that share each apparent range, m.
    ranges : (n_range,) float
        Those apparent ranges, m from the origin.
    yaws : (n_yaw,) float
        From end to end of the block, rad.
    shift : float
        Unified walk plus residual walk, both removed before: Doppler on the carrier, Hz.
    in_doppler : bool
        Whether range compression was in the 2-D frequency domain, as in paper C.
    """
    lam, collection = geometry.collection.wavelength, geometry.collection
    yaw, half_width = float(yaws[0] + yaws[-1]) / 2, float(yaws[-1] - yaws[0]) / 2
    along = solvers.chebyshev_series((yaws - yaw) / half_width, epoch_range.T, 8)
    at_nodes = np.asarray(np.polynomial.chebyshev.chebval(YAW_NODES, along), dtype=np.float64)
    k = yaw_series(geometry, at_nodes, yaw, order=4, half_width=half_width)
    half_dwell = collection.pulse_interval * collection.n_pulse / 2
    own_centre = -2 / lam * k[:, 1, 0] - shift
    middle = epoch_range.mean(axis=1)
    # (29) counts Doppler from the block's centre at the reference range, as (16) leaves it: at other ranges k_1'' is
    # not zero at the block's middle yaw (some 400 Hz on Table 1). The other forms count from each range's own centre.
    reference = np.full_like(own_centre, np.interp(0.0, middle - middle.mean(), own_centre))
    if freedom.resampling:
        levels, centres = resampled(k, wavelength=lam, half_dwell=half_dwell), own_centre
    elif freedom.doppler and in_doppler:
        levels, centres = corrected(k, wavelength=lam), own_centre
    elif freedom.doppler:
        levels, centres = printed(k, wavelength=lam, beta=range_model == "polar"), reference
    else:
        levels, centres = deramped(k, wavelength=lam), own_centre
    doppler_scale = float(np.abs(2 / lam * k[:, 1, 1] * half_width).max())
    zero, order = np.zeros_like(own_centre), np.arange(5)

    def make_row(coefficients: FloatArray, centres: FloatArray, scale: float) -> RowPolynomial:
        powers = coefficients * scale**order
        return row_polynomial(powers, ranges=ranges, centres=centres, scale=scale, degree=SERIES_DEGREE)

    return AzimuthPolynomials(
        time=make_row(levels.time, zero, half_dwell),
        doppler=make_row(levels.doppler, centres, doppler_scale),
        resampling=make_row(levels.resampling, centres, doppler_scale),
        deramp=make_row(levels.deramp, zero, half_dwell),
        middle=0.0,
    )


def printed(k: FloatArray, *, wavelength: float, beta: bool = True) -> ClosedForm:
    """Frequency perturbation (30) and deramp (31) of paper A; without beta, the paper's reference method.

    Parameters
    ----------
    k : (n_range, >= 5, >= 3) float
        k_nm, m/s^n/rad^m.
    wavelength : float
        m.
    """
    lam, n = wavelength, k.shape[0]
    k11, k12 = k[:, 1, 1], k[:, 1, 2]
    k20, k21, k22 = k[:, 2, 0], k[:, 2, 1], k[:, 2, 2]
    alpha = -(lam**2) * k21 / (24 * k11 * k20**2)
    quartic = (
        k22 * lam**3 / (96 * k11**2 * k20**2)
        - k21**2 * lam**3 / (48 * k11**2 * k20**3)
        - k12 * k21 * lam**3 / (96 * k11**3 * k20**2)
    ) * beta
    deramp = _orders(
        n,
        d2=2 * k20 / lam,
        d3=2 * k[:, 3, 0] / lam + 32 * k20**3 * alpha / lam**3,
        d4=2 * k[:, 4, 0] / lam - 128 * k20**4 * quartic / lam**4,
    )
    return ClosedForm(_orders(n), _orders(n, p3=alpha / 2, p4=quartic / 2), _orders(n), deramp)


def deramped(k: FloatArray, *, wavelength: float) -> ClosedForm:
    """Deramp of the block's centre only."""
    n, to_cycles = k.shape[0], 2 / wavelength
    deramp = _orders(n, d2=to_cycles * k[:, 2, 0], d3=to_cycles * k[:, 3, 0], d4=to_cycles * k[:, 4, 0])
    return ClosedForm(_orders(n), _orders(n), _orders(n), deramp)


def resampled(k: FloatArray, *, wavelength: float, half_dwell: float) -> ClosedForm:
    """Time perturbation, Doppler resampling and deramp of paper B's chain.

    `half_dwell` (s) bounds the change of slope by the time perturbation.
    """
    n, (r0, r1, r2, c0, c1, q0, q1) = k.shape[0], _Rates.of(k, wavelength)
    e2 = -r1 / (4 * r0)
    e3 = r1**2 / (8 * r0**2) - r2 / (6 * r0)
    with np.errstate(divide="ignore", invalid="ignore"):
        c = r0 * (8 * c1 - 12 * r0 * r2 + 3 * r1**2) / (12 * r1)
        q = 16 * c * (r1**2 - r0 * r2) - 8 * c1 * r0 * r1 + 4 * q1 * r0 + 4 * r0**2 * r1 * r2 + r0 * r1**3
        q = q / (8 * r1)
        good = 2 * np.abs(c - c0) * half_dwell + 3 * np.abs(q - q0) * half_dwell**2 <= STEEPEST * np.abs(r0)
    p3, p4 = np.where(good, (c - c0) / 3, 0.0), np.where(good, (q - q0) / 4, 0.0)
    c0, q0 = c0 + 3 * p3, q0 + 4 * p4
    deramp = _orders(
        n,
        d2=-r0 / 2,
        d3=-(c0 + 3 * e2 * r0**2) / 3,
        d4=-(q0 + 8 * e2 * c0 * r0 + 8 * e2**2 * r0**3 + 4 * e3 * r0**3) / 4,
    )
    return ClosedForm(_orders(n, p3=p3, p4=p4), _orders(n), _orders(n, e2=e2, e3=e3), deramp)


def corrected(k: FloatArray, *, wavelength: float) -> ClosedForm:
    """Frequency perturbation and deramp of paper C's chain, consistent to second order in f0."""
    n, (r0, r1, r2, c0, _, q0, _) = k.shape[0], _Rates.of(k, wavelength)
    p3 = -r1 / (6 * r0**2)
    p4 = r1**2 / (24 * r0**3) - r2 / (12 * r0**2) + c0 * r1 / (12 * r0**4)
    a1, a2 = 1 / r0, -c0 / r0**3 - 3 * p3  # t = a1 f + a2 f^2 + a3 f^3: the line of D = 0, perturbed
    a3 = (2 * c0**2 - r0 * q0) / r0**5 - 4 * p4
    deramp = _orders(n, d2=-r0 / 2, d3=a2 / (3 * a1**3), d4=-(2 * a2**2 - a1 * a3) / (4 * a1**5))
    return ClosedForm(_orders(n), _orders(n, p3=p3, p4=p4), _orders(n), deramp)


class _Rates(NamedTuple):
    """Doppler rates of lines as series in their Doppler f0 at t = 0, (n_range,) each."""

    r0: FloatArray
    r1: FloatArray
    r2: FloatArray
    c0: FloatArray
    c1: FloatArray
    q0: FloatArray
    q1: FloatArray

    @classmethod
    def of(cls, k: FloatArray, wavelength: float) -> _Rates:
        to_doppler = -2 / wavelength
        first = 1 / (to_doppler * k[:, 1, 1])  # D = first f0 + second f0^2
        second = -k[:, 1, 2] / (to_doppler**2 * k[:, 1, 1] ** 3)
        return cls(
            r0=2 * to_doppler * k[:, 2, 0],
            r1=2 * to_doppler * k[:, 2, 1] * first,
            r2=2 * to_doppler * (k[:, 2, 1] * second + k[:, 2, 2] * first**2),
            c0=3 * to_doppler * k[:, 3, 0],
            c1=3 * to_doppler * k[:, 3, 1] * first,
            q0=4 * to_doppler * k[:, 4, 0],
            q1=4 * to_doppler * k[:, 4, 1] * first,
        )


def _orders(size: int, **terms: FloatArray) -> FloatArray:
    """Coefficients (size, 5) with the named orders, such as p3=...; the others are zero."""
    coefficients = np.zeros((size, 5))
    for name, values in terms.items():
        coefficients[:, int(name[-1])] = values
    return coefficients


GOOD_RESIDUAL = 0.02  # rad: the most that is good; see `good_residual`
RESIDUAL_SHARE = 0.5  # of the allowed loss that residual phase may take before a better chain is preferred
GOOD_LOSS = 4e-4  # of coherence, at the ends of the dwell: below this a cheaper chain is preferred to a better one
ENOUGH_COST = 1.2  # cost of a kind of chain, or of the fit at all ranges over that at few: below it no other is tried
FINER = (1.4, 1.2, 1.1, 1.05)  # factors by which the spread of the best bias is varied, one after the other


def good_residual(fidelity: float) -> float:
    """Residual phase, rad, below which a cheaper chain is preferred to a better one.

    A phase like the Legendre polynomial of order n that peaks at p has the mean square p^2 / (2 n + 1), and half of
    that is lost. With n = 3, which a cheaper chain leaves, RESIDUAL_SHARE of the allowed loss is

        p = sqrt(14 RESIDUAL_SHARE (1 - fidelity)).
    """
    return min(GOOD_RESIDUAL, math.sqrt(14 * RESIDUAL_SHARE * (1 - fidelity)))


class Choice(NamedTuple):
    """A kind of chain, and the cost of its fit."""

    candidate: ChainKind
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
    resampling: int = len(ORDERS),
) -> tuple[AzimuthPolynomials, Choice]:
    """Choose coefficients by the method: in closed form, or of the cheapest fitted chain with level, unfolded lines.

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
        polynomials = levelling(
            geometry, freedom, epoch_range=epoch_range, ranges=ranges, yaws=yaws, shift=shift,
            in_doppler=range_part.compression.in_doppler, range_model=method.range_model,
        )  # fmt: skip
        return polynomials, Choice(ChainKind(0.0, False), 0.0)
    full, good = full_dwells(line, geometry, epoch_range, yaws), good_residual(fidelity)
    if neighbour is not None and neighbour.candidate.resampling <= resampling:
        polynomials = fitting.fit(line, ranges=ranges, candidate=neighbour.candidate, freedom=freedom, wavelength=lam)
        cost = _cost(polynomials, line, range_part, geometry, full, good)
        if cost <= ENOUGH_COST * neighbour.cost:
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
    """Find the kind of chain with the least cost, and fit it; all kinds are tried at three ranges.

    Under a steered beam the bias of the best kind is then varied: what the ends lose has a sharp minimum where the
    delays of the steps in Doppler vary least over the block. A kind whose fit at all ranges does not keep what it
    promised is passed over. Where that leaves none, or none that is nearly as cheap as the one that ended this
    trial, those are tried that it did not reach.
    """
    wavelength, freedom = geometry.collection.wavelength, range_part.freedom
    rows = np.array([0, ranges.size // 2, ranges.size - 1])
    subset = Line(**{name: _pick(getattr(line, name), rows, ranges.size) for name in Line.__dataclass_fields__})

    def fit(candidate: ChainKind) -> AzimuthPolynomials:
        return fitting.fit(line, ranges=ranges, candidate=candidate, freedom=freedom, wavelength=wavelength)

    kinds = [
        replace(kind, resampling=resampling)
        for kind in fitting.candidates(line, wavelength=wavelength, freedom=freedom)
    ]
    if len(kinds) == 1:
        return fit(kinds[0]), Choice(kinds[0], np.inf)
    costs: dict[ChainKind, float] = {}

    def cheapest(candidates: list[ChainKind]) -> float:
        for candidate in candidates:
            polynomials = fitting.fit(
                subset, ranges=ranges[rows], candidate=candidate, freedom=freedom, wavelength=wavelength
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

    def keeps(candidate: ChainKind, promised: float) -> bool:
        polynomials = fit(candidate)
        cost = _cost(polynomials, line, range_part, geometry, full, good)
        fitted.append((polynomials, Choice(candidate, cost)))
        return cost <= ENOUGH_COST * promised

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
    elif unseen and least > ENOUGH_COST**2:
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
    """Cost of a chain: excess phase error or loss of coherence, times the growth in samples; infinite if lines fold."""
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
    """Select rows of an array (size, ...); arrays that broadcast along rows are returned unchanged."""
    return values[which] if values.shape[0] == size else values
