"""Coefficients of the azimuth steps: fitted on time-frequency lines, or in closed form as paper A prints them.

The fit asks two things of a block's lines after perturbation and deramp. They must be level: what is left is
phase error. And the frequency perturbation must hardly stretch them in time: stretching is dispersion,
which blurs the sharp ends of a dwell over sqrt(|stretch - 1| / rate) seconds, and that much of the dwell is
lost to the focus. Lines alone do not show this loss (they are the stationary phase); weighing it in costs
nothing, since many sets of coefficients level the lines to a milliradian.

Unknowns are a time perturbation of orders 3 and 4 (with a bias chirp, order 2, that is tried at a few values), a
frequency perturbation of orders 2 to 5 and a deramp of orders 2 to 4, per range.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import prod
from typing import NamedTuple

import numpy as np
from numpy.polynomial import polynomial as power

from blocksar.geometry import Geometry
from blocksar.lines import Line, RowPhase, row_phase
from blocksar.parameters import FloatArray

DOPPLER_ORDERS = (2, 3, 4, 5)
DERAMP_ORDERS = (2, 3, 4)
TIME_ORDERS = (3, 4)
SERIES_DEGREE = 6  # of the coefficients in range
GOOD_RESIDUAL = 0.02  # rad: below this a cheaper chain is preferred to a better one
GOOD_LOSS = 0.008  # of the dwell, lost at its ends: likewise
ENOUGH = 1e-5  # of the cost: a fit that gains less by a step is done
STRETCH_PRICE = 0.5  # rad of phase error that a stretch of 2 is worth in the fit
TIME_BANDWIDTH = 100.0  # of a target's line: stationary phase and a sharp spectrum need about this much


class AzimuthPhases(NamedTuple):
    """The three phases of the azimuth steps, cycles."""

    time: RowPhase
    doppler: RowPhase
    deramp: RowPhase


@dataclass(frozen=True)
class Candidate:
    """A kind of chain to try: with or without a time perturbation, with a bias chirp in m/s^2."""

    bias: float
    perturb_time: bool


class _Scales(NamedTuple):
    time_centre: float
    time: float
    doppler: float


def end_loss(line: Line, rate: FloatArray) -> FloatArray:
    """Part of each dwell that dispersion takes from its ends: 1.3 sqrt(|stretch - 1| / time-bandwidth).

    `rate` is the lines' rate ahead of the frequency perturbation, Hz/s. The factor was measured on
    single targets against their traced lines.
    """
    duration = line.weight.sum(axis=-1).max()
    ends = np.abs(line.stretch[..., [0, -1]] - 1).max(axis=-1)
    return np.asarray(1.3 * np.sqrt(ends / (np.abs(rate).min(axis=-1) * duration**2)))


def _powers(z: FloatArray, orders: tuple[int, ...]) -> FloatArray:
    """z^(order - 1) for each order: the slopes of z^order / order."""
    powers = _all_powers(z, max(orders, default=1) - 1)
    return np.stack([powers[order - 1] for order in orders]) if orders else np.zeros((0, *z.shape))


def _all_powers(z: FloatArray, highest: int) -> list[FloatArray]:
    """1, z, z z, ...: by multiplication, which takes a tenth of the time of raising to a power."""
    powers = [np.ones_like(z)]
    for _ in range(highest):
        powers.append(powers[-1] * z)
    return powers


def _combine(x: FloatArray, terms: FloatArray) -> FloatArray:
    """sum x_k terms_k, term by term: a BLAS product's last bit depends on where its operands lie in memory."""
    total = np.zeros(terms.shape[1:])
    for coefficient, term in zip(x, terms, strict=True):
        total += coefficient * term
    return total


def _slopes(z: FloatArray, orders: tuple[int, ...], derivative: int) -> FloatArray:
    """Derivatives of `_powers`."""
    powers = _all_powers(z, max(max(orders, default=1) - 1 - derivative, 0))
    rows = [prod(range(order - derivative, order)) * powers[max(order - 1 - derivative, 0)] for order in orders]
    return np.stack(rows) if rows else np.zeros((0, *z.shape))


def _fit_range(
    time: FloatArray,
    doppler: FloatArray,
    rate: FloatArray,
    weight: FloatArray,
    scales: _Scales,
    candidate: Candidate,
    start: FloatArray,
) -> FloatArray:
    """Level the lines (n_yaw, n) of one range; unknowns are scaled to the lines' extent in time and Doppler.

    With v = f / F + P(z), z' = z - D(v), the level is v + E(z') and the stretch 1 - D'(v) (dv/dz): sums of
    powers P, D, E whose coefficients are sought.
    """
    orders = TIME_ORDERS if candidate.perturb_time else ()
    n_time, n_doppler = len(orders), len(DOPPLER_ORDERS)
    split = (n_time, n_time + n_doppler)
    z_in = (time - scales.time_centre) / scales.time
    flat, steep = doppler / scales.doppler, rate * scales.time / scales.doppler
    p_terms, p_slopes = _powers(z_in, orders), _slopes(z_in, orders, 1)
    duration = weight.sum(axis=-1, keepdims=True)
    share = weight / duration
    # The Doppler error over a dwell, times its length, is about the phase error that it makes.
    level_price = 2 * np.pi * scales.doppler * duration * np.sqrt(share)
    stretch_price = STRETCH_PRICE * np.sqrt(share)

    def chain(x: FloatArray) -> tuple[FloatArray, ...]:
        p, d, e = np.split(x, split)
        v = flat + _combine(p, p_terms)
        z = z_in - _combine(d, _powers(v, DOPPLER_ORDERS))
        slope = steep + _combine(p, p_slopes)
        return v, z, slope, _combine(d, _slopes(v, DOPPLER_ORDERS, 1)), e, d

    def centred(values: FloatArray) -> FloatArray:
        return values - (values * share).sum(axis=-1, keepdims=True)

    def faults(x: FloatArray) -> FloatArray:
        v, z, slope, bend, e, _ = chain(x)
        level = v + _combine(e, _powers(z, DERAMP_ORDERS))
        return np.concatenate([(level_price * centred(level)).ravel(), (stretch_price * bend * slope).ravel()])

    def jacobian(x: FloatArray) -> FloatArray:
        v, z, slope, bend, e, d = chain(x)
        e_slope = _combine(e, _slopes(z, DERAMP_ORDERS, 1))
        curl = _combine(d, _slopes(v, DOPPLER_ORDERS, 2))
        v_terms = _powers(v, DOPPLER_ORDERS)
        level = np.concatenate([p_terms * (1 - e_slope * bend), -e_slope * v_terms, _powers(z, DERAMP_ORDERS)])
        stretch = np.zeros_like(level)
        stretch[:n_time] = curl * p_terms * slope + bend * p_slopes
        stretch[split[0] : split[1]] = _slopes(v, DOPPLER_ORDERS, 1) * slope
        rows = np.concatenate([level_price * centred(level), stretch_price * stretch], axis=1)
        return rows.reshape(x.size, -1)

    return levenberg_marquardt(faults, jacobian, start)


def levenberg_marquardt(
    faults: Callable[[FloatArray], FloatArray],
    jacobian: Callable[[FloatArray], FloatArray],
    start: FloatArray,
    *,
    iterations: int = 60,
) -> FloatArray:
    """Minimise the sum of squares of `faults`; the same bits every time.

    Library solvers (MINPACK, LAPACK) round differently as their work arrays happen to lie in memory, and a plan
    made anew, to resume a run, has to be the plan that the run began with. Here every sum runs in numpy's own
    order, and the few unknowns are solved for by modified Gram-Schmidt on the damped, column-scaled system.

    Parameters
    ----------
    faults : callable
        (n,) to (m,).
    jacobian : callable
        (n,) to (n, m): one row an unknown.
    """
    x, damping, growth = start, 1e-3, 2.0
    fault = faults(x)
    cost = float((fault * fault).sum())
    scale = np.zeros(x.size)
    for _ in range(iterations):
        rows = jacobian(x)
        scale = np.maximum(scale, np.sqrt((rows * rows).sum(axis=1)))
        size = np.where(scale > 0, scale, 1.0)
        while True:
            step = _damped_step(rows / size[:, None], fault, damping) / size
            tried = faults(x + step)
            tried_cost = float((tried * tried).sum())
            if tried_cost < cost:
                break
            damping, growth = damping * growth, growth * 2
            if damping > 1e12:
                return x
        gained = cost - tried_cost
        x, fault, cost = x + step, tried, tried_cost
        damping, growth = max(damping / 5, 1e-14), 2.0
        if gained <= ENOUGH * cost:
            break
    return x


def _damped_step(rows: FloatArray, fault: FloatArray, damping: float) -> FloatArray:
    """Least squares of rows^T step = -fault, with sqrt(damping) step = 0 below it."""
    n = rows.shape[0]
    q = np.concatenate([rows, np.sqrt(damping) * np.eye(n)], axis=1)
    right = np.concatenate([-fault, np.zeros(n)])
    r, projected = np.zeros((n, n)), np.zeros(n)
    for i in range(n):
        r[i, i] = np.sqrt((q[i] * q[i]).sum())
        q[i] /= r[i, i]
        projected[i] = (q[i] * right).sum()
        right = right - projected[i] * q[i]
        r[i, i + 1 :] = (q[i] * q[i + 1 :]).sum(axis=1)
        q[i + 1 :] -= r[i, i + 1 :, None] * q[i]
    step = np.zeros(n)
    for i in range(n - 1, -1, -1):
        step[i] = (projected[i] - (r[i, i + 1 :] * step[i + 1 :]).sum()) / r[i, i]
    return step


def fit_phases(line: Line, *, ranges: FloatArray, candidate: Candidate, wavelength: float) -> AzimuthPhases:
    """Fit the three phases so that every line is level.

    Parameters
    ----------
    line : Line
        (n_range, n_yaw, n) after RCMC; row i belongs to apparent range ranges[i].
    ranges : (n_range,) float
        Ascending, m from the origin.
    candidate : Candidate
    wavelength : float
        m.
    """
    time = np.broadcast_to(line.time, line.doppler.shape)
    centre = float((time.min() + time.max()) / 2)
    bias_rate = -4 * candidate.bias / wavelength  # Hz/s: a range acceleration of `bias`
    doppler = line.doppler + bias_rate * (time - centre)
    rate = line.rate + bias_rate
    centres = (doppler.max(axis=(1, 2)) + doppler.min(axis=(1, 2))) / 2
    half = float(np.max(doppler.max(axis=(1, 2)) - centres))
    scales = _Scales(centre, float(np.abs(time - centre).max()), max(half, 1e-3))
    weight = np.broadcast_to(line.weight, line.doppler.shape)
    n_time = len(TIME_ORDERS) if candidate.perturb_time else 0

    n_doppler = len(DOPPLER_ORDERS)
    x = np.zeros(n_time + n_doppler + len(DERAMP_ORDERS))
    slope = np.mean((doppler[0, :, -1] - doppler[0, :, 0]) / (time[0, :, -1] - time[0, :, 0]))
    x[n_time + n_doppler] = -slope * scales.time / scales.doppler
    solutions = []
    for i in range(ranges.size):
        x = _fit_range(time[i], doppler[i] - centres[i], rate[i], weight[i], scales, candidate, x)
        solutions.append(x)
    found = np.stack(solutions)

    area = scales.time * scales.doppler  # cycles in a unit of z z
    n_range = ranges.size
    time_part = np.zeros((n_range, 5))
    time_part[:, 2] = bias_rate * scales.time**2 / 2
    for k in range(n_time):
        time_part[:, TIME_ORDERS[k]] = area * found[:, k] / TIME_ORDERS[k]
    doppler_part = np.zeros((n_range, 6))
    deramp_part = np.zeros((n_range, 5))
    for k, order in enumerate(DOPPLER_ORDERS):
        doppler_part[:, order] = area * found[:, n_time + k] / order
    for k, order in enumerate(DERAMP_ORDERS):
        deramp_part[:, order] = area * found[:, n_time + n_doppler + k] / order
    same = np.full(n_range, centre)
    return AzimuthPhases(
        time=row_phase(time_part, ranges=ranges, centres=same, scale=scales.time, degree=SERIES_DEGREE),
        doppler=row_phase(doppler_part, ranges=ranges, centres=centres, scale=scales.doppler, degree=SERIES_DEGREE),
        deramp=row_phase(deramp_part, ranges=ranges, centres=same, scale=scales.time, degree=SERIES_DEGREE),
    )


def range_series(geometry: Geometry, epoch_range: FloatArray, yaw: FloatArray, *, order: int) -> FloatArray:
    """Taylor coefficients k_n of a target's range about the epoch, (..., order + 1), m/s^n (paper A (1)).

    The squared range is a short polynomial in t; its square root is a power-series recursion, exact to
    machine precision for any polynomial track.
    """
    track = geometry.track
    axis = power.Polynomial([geometry.epoch - track.centre, 1.0]) / track.half
    position = [
        np.polynomial.Chebyshev(column).convert(kind=np.polynomial.Polynomial)(axis).coef
        for column in track.coefficients.T
    ]
    point = geometry.ground_point(epoch_range, yaw)
    squared = np.zeros((*point.shape[:-1], order + 1))
    for i, column in enumerate(position):
        sight = np.zeros((*point.shape[:-1], order + 1))
        kept = min(order + 1, column.size)
        sight[..., :kept] = -column[:kept]
        sight[..., 0] += point[..., i]
        for n in range(order + 1):
            squared[..., n] += (sight[..., : n + 1] * sight[..., n::-1]).sum(axis=-1)
    k = np.zeros_like(squared)
    k[..., 0] = np.sqrt(squared[..., 0])
    for n in range(1, order + 1):
        cross = (k[..., 1:n] * k[..., n - 1 : 0 : -1]).sum(axis=-1)
        k[..., n] = (squared[..., n] - cross) / (2 * k[..., 0])
    return k


def yaw_series(geometry: Geometry, epoch_range: FloatArray, yaw: float, *, order: int, half_width: float) -> FloatArray:
    """k_nm of paper A (2): k_n(R, dtheta) = sum_m k_nm dtheta^m, (n_range, order + 1, 5).

    The yaw dependence is interpolated through Chebyshev points over the block and turned into powers.
    """
    nodes = np.cos(np.pi * (np.arange(9) + 0.5) / 9)
    k = range_series(geometry, epoch_range[:, None], yaw + half_width * nodes, order=order)
    fitted = np.polynomial.chebyshev.chebfit(nodes, np.moveaxis(k, 1, 0).reshape(9, -1), 8)
    to_powers = np.zeros((9, 9))
    for degree in range(9):
        to_powers[degree, : degree + 1] = np.polynomial.chebyshev.cheb2poly(np.eye(9)[degree, : degree + 1])
    powers = (fitted.T @ to_powers)[:, :5] / half_width ** np.arange(5)
    return powers.reshape(epoch_range.size, order + 1, 5)


def closed_form_phases(
    geometry: Geometry, *, epoch_range: FloatArray, ranges: FloatArray, yaw: float, half_width: float, shift: float
) -> AzimuthPhases:
    """Perturbation (30) and deramp (31) of paper A as printed, per range.

    Errata applied: (26) is exp[j pi (alpha f^3 + beta f^4)]. Doppler counts from the block centre at the
    reference range, as (16) leaves it: at other ranges k_1'' is not zero at the block's middle yaw (some 400 Hz
    on Table 1), which (29) neglects.

    Parameters
    ----------
    epoch_range : (n_range,) float
        m.
    ranges : (n_range,) float
        The same less the range origin.
    yaw, half_width : float
        Of the block, rad.
    shift : float
        Unified walk plus residual walk as Doppler on the carrier, Hz: what has been taken out.
    """
    lam = geometry.collection.wavelength
    k = yaw_series(geometry, epoch_range, yaw, order=4, half_width=half_width)
    k11, k12 = k[:, 1, 1], k[:, 1, 2]
    k20, k21, k22 = k[:, 2, 0], k[:, 2, 1], k[:, 2, 2]
    k30, k40 = k[:, 3, 0], k[:, 4, 0]
    alpha = -(lam**2) * k21 / (24 * k11 * k20**2)
    beta = (
        k22 * lam**3 / (96 * k11**2 * k20**2)
        - k21**2 * lam**3 / (48 * k11**2 * k20**3)
        - k12 * k21 * lam**3 / (96 * k11**3 * k20**2)
    )
    zero = np.zeros_like(k20)
    doppler_scale = float(np.abs(2 / lam * k11 * half_width).max())
    time_scale = geometry.collection.pulse_interval * geometry.collection.n_pulse / 2
    doppler_part = np.stack([zero, zero, zero, alpha / 2, beta / 2], axis=1) * doppler_scale ** np.arange(5)
    deramp_part = np.stack(
        [
            zero,
            zero,
            2 * k20 / lam,
            2 * k30 / lam + 32 * k20**3 * alpha / lam**3,
            2 * k40 / lam - 128 * k20**4 * beta / lam**4,
        ],
        axis=1,
    ) * time_scale ** np.arange(5)
    centre = -2 / lam * np.interp(0.0, epoch_range - epoch_range.mean(), k[:, 1, 0]) - shift
    centres = np.full_like(k20, centre)
    nothing = np.zeros((ranges.size, 1))
    return AzimuthPhases(
        time=row_phase(nothing, ranges=ranges, centres=zero, scale=time_scale, degree=0),
        doppler=row_phase(doppler_part, ranges=ranges, centres=centres, scale=doppler_scale, degree=SERIES_DEGREE),
        deramp=row_phase(deramp_part, ranges=ranges, centres=zero, scale=time_scale, degree=SERIES_DEGREE),
    )


def candidates(line: Line, *, wavelength: float) -> list[Candidate]:
    """Chains worth trying, cheapest first: the printed one, a time perturbation, then bias chirps.

    A bias brings the lines' range acceleration to a value, of either sign, that spreads each target's
    own line over TIME_BANDWIDTH or more.
    """
    duration = float(np.max(line.weight.sum(axis=-1)))
    acceleration = float(np.mean(-line.rate * wavelength / 2)) / 2  # k_2, m/s^2
    wanted = TIME_BANDWIDTH * wavelength / (4 * duration**2)
    tried = [Candidate(0.0, False), Candidate(0.0, True)]
    for factor in (1.25, 2.5, 5.0, 8.0):
        targets = sorted((factor * wanted, -factor * wanted), key=lambda k: abs(k - acceleration))
        tried += [Candidate(k - acceleration, True) for k in targets]
    return tried
