"""Fit of the azimuth steps' coefficients on time-frequency lines; `coefficients` has the papers' formulas.

The fit has two aims for a block's lines after the last step. They must be level: what remains is phase error. And the
steps in Doppler must hardly stretch them in time: stretching is dispersion, which blurs the sharp ends of a dwell over
sqrt(|stretch - 1| / rate) seconds, and that part of the dwell is lost to the focus. Lines alone do not show this loss,
since they are the stationary phase. Many sets of coefficients level the lines to a milliradian, so the second aim costs
nothing of the first.

The unknowns per range depend on the steps of the chain: a time perturbation of orders 3 and 4 (with a bias chirp of
order 2, tried at a few values), a frequency perturbation of orders 2 to 5, a Doppler resampling of orders 2 to 4, a
deramp of orders 2 to 4.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.kernels.levelling import LevellingProblem, level_lines
from blocksar.processors.chain.steps.lines import AzimuthPolynomials, Line, RowPolynomial, row_polynomial

ORDERS = (2, 3, 4)  # of a Doppler resampling and a deramp; without 2, the bias, of a time perturbation
DOPPLER_ORDERS = (*ORDERS, ORDERS[-1] + 1)  # of a frequency perturbation
SERIES_DEGREE = 6  # of the series of each coefficient in range
# A fit stops when a step lowers the cost by less than the fraction ENOUGH, or after MOST_STEPS steps. Order 2 in
# Doppler and the deramp nearly cancel, which makes a long valley; its beginning suffices.
ENOUGH, MOST_STEPS = 1e-5, 200
DAMPING = 1e-4  # of the first step
NEAR = 10.0  # rad: the penalty for a departure of any unknown from where the ranges before lead
SETTLED = 100.0  # rad: the penalty for changing an unknown that an earlier range has settled
STRETCH_WEIGHT = 0.5  # rad of phase error that count as much as a stretch of 2 in the fit
TIME_BANDWIDTH = 100.0  # product of a target's line: stationary phase and a sharp spectrum need about this


class FittedSteps(NamedTuple):
    """Azimuth steps, besides the deramp, whose coefficients are fitted."""

    time: bool
    doppler: bool
    resampling: bool


@dataclass(frozen=True)
class ChainKind:
    """A kind of chain to try: a bias chirp (m/s^2), whether to perturb in time, and orders of a Doppler resampling."""

    bias: float
    perturb_time: bool
    resampling: int = len(ORDERS)


def candidates(line: Line, *, wavelength: float, freedom: FittedSteps) -> list[ChainKind]:
    """Kinds of chain worth trying, cheapest first: the printed one, with a time perturbation, with bias chirps too.

    A bias brings the range acceleration of the lines to a value, of either sign, that spreads each target's own line
    over TIME_BANDWIDTH or more. A chain without the time perturbation has the printed kind only.
    """
    plain = ChainKind(0.0, False)
    if not freedom.time:
        return [plain]
    duration = float(np.max(line.weight.sum(axis=-1)))
    acceleration = _acceleration(line, wavelength)
    least = TIME_BANDWIDTH * wavelength / (4 * duration**2)  # k_2 that gives a target this product, m/s^2
    kinds = [plain, ChainKind(0.0, True)]
    for factor in (1.25, 2.5, 5.0, 8.0):
        targets = sorted((factor * least, -factor * least), key=lambda k: abs(k - acceleration))
        kinds += [ChainKind(k - acceleration, True) for k in targets]
    return kinds


def with_spread(line: Line, candidate: ChainKind, *, wavelength: float, factors: tuple[float, ...]) -> list[ChainKind]:
    """Copies of a kind of chain whose bias scales the range acceleration of lines by each of these factors."""
    if not candidate.perturb_time:
        return []
    acceleration = _acceleration(line, wavelength)
    return [replace(candidate, bias=k * (acceleration + candidate.bias) - acceleration) for k in factors]


def _acceleration(line: Line, wavelength: float) -> float:
    """Half the mean range acceleration of lines, k_2, m/s^2."""
    return float(np.mean(-line.rate * wavelength / 2)) / 2


def fit(
    line: Line,
    *,
    ranges: FloatArray,
    candidate: ChainKind,
    freedom: FittedSteps,
    wavelength: float,
) -> AzimuthPolynomials:
    """Fit the azimuth steps so that every line is level.

    Parameters
    ----------
    line : Line
        (n_range, n_yaw, n) after range compression; row i belongs to apparent range ranges[i].
    ranges : (n_range,) float
        Ascending, m from the origin.
    candidate : ChainKind
    freedom : FittedSteps
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
    scales = _Scales(float(np.abs(time - centre).max()), max(half, 1e-3))
    rows = _Rows.scaled(line, time - centre, doppler - centres[:, None, None], rate, scales)

    unknowns = _Unknowns.of(candidate, freedom)
    x = np.zeros(unknowns.size)
    slope = np.mean((doppler[0, :, -1] - doppler[0, :, 0]) / (time[0, :, -1] - time[0, :, 0]))
    x[unknowns.ends[-1]] = -slope * scales.time / scales.doppler
    pull, solutions = np.zeros(unknowns.size), list[FloatArray]()
    for i in range(ranges.size):
        if i > 1:  # where the two ranges before lead
            x = x + (x - solutions[-2]) * (ranges[i] - ranges[i - 1]) / (ranges[i - 1] - ranges[i - 2])
        x = level_lines(rows.problem(i, unknowns, start=x, pull=pull), DAMPING, ENOUGH, MOST_STEPS)
        # Without a time perturbation, order 2 in Doppler has nearly the effect of the deramp. The first range settles
        # it for all, since coefficients must change smoothly with range.
        pull[:] = NEAR
        if unknowns.doppler and not unknowns.time:
            pull[0] = SETTLED
        solutions.append(x)
    p, d, r, e = np.split(np.stack(solutions), unknowns.ends, axis=1)

    area = scales.time * scales.doppler  # cycles per unit of z^2
    bias = np.full((ranges.size, 1), bias_rate * scales.time**2 / 2)
    same = np.full(ranges.size, centre)

    def make_row(orders: tuple[int, ...], values: FloatArray, centres: FloatArray, scale: float) -> RowPolynomial:
        powers = np.zeros((ranges.size, max(orders, default=0) + 1))
        powers[:, list(orders)] = values
        return row_polynomial(powers, ranges=ranges, centres=centres, scale=scale, degree=SERIES_DEGREE)

    return AzimuthPolynomials(
        time=make_row((2, *unknowns.time), np.hstack([bias, area * p / np.array(unknowns.time)]), same, scales.time),
        doppler=make_row(unknowns.doppler, area * d / np.array(unknowns.doppler), centres, scales.doppler),
        resampling=make_row(unknowns.resampling, scales.doppler * r, centres, scales.doppler),
        deramp=make_row(unknowns.deramp, area * e / np.array(unknowns.deramp), same, scales.time),
        middle=centre,
    )


class _Unknowns(NamedTuple):
    """Orders of the unknowns: phases in time and Doppler, shift of Doppler, deramp."""

    time: tuple[int, ...]
    doppler: tuple[int, ...]
    resampling: tuple[int, ...]
    deramp: tuple[int, ...]

    @classmethod
    def of(cls, candidate: ChainKind, freedom: FittedSteps) -> _Unknowns:
        return cls(
            ORDERS[1:] if candidate.perturb_time else (),
            DOPPLER_ORDERS if freedom.doppler else (),
            ORDERS[: candidate.resampling] if freedom.resampling else (),
            ORDERS,
        )

    @property
    def ends(self) -> list[int]:
        """Ends of the groups of unknowns, without the last."""
        return [sum(map(len, self[:k])) for k in (1, 2, 3)]

    @property
    def size(self) -> int:
        return sum(map(len, self))


class _Scales(NamedTuple):
    """Half extents of the lines in time (s) and Doppler (Hz)."""

    time: float
    doppler: float


class _Rows(NamedTuple):
    """Lines (n_range, n_yaw, n), scaled for `LevellingProblem`, which takes one range at a time."""

    time: FloatArray
    doppler: FloatArray
    rate: FloatArray
    share: FloatArray
    level_weight: FloatArray
    stretch_weight: FloatArray

    @classmethod
    def scaled(cls, line: Line, time: FloatArray, doppler: FloatArray, rate: FloatArray, scales: _Scales) -> _Rows:
        """Scale lines whose time (s) and Doppler (Hz) count from their centres."""
        weight = np.broadcast_to(line.weight, line.doppler.shape)
        duration = weight.sum(axis=-1, keepdims=True)
        share = weight / duration
        root = np.sqrt(share)
        return cls(
            time=time / scales.time,
            doppler=doppler / scales.doppler,
            rate=rate * scales.time / scales.doppler,
            share=share,
            # The Doppler error over a dwell times its length is about the phase error that it causes.
            level_weight=2 * np.pi * scales.doppler * duration * root,
            stretch_weight=STRETCH_WEIGHT * root,
        )

    def problem(self, i: int, unknowns: _Unknowns, *, start: FloatArray, pull: FloatArray) -> LevellingProblem:
        """Level the lines of range i; `pull` (n_unknown,), rad, penalises departures from `start`."""
        return LevellingProblem(
            time=np.ascontiguousarray(self.time[i]),
            doppler=np.ascontiguousarray(self.doppler[i]),
            rate=np.ascontiguousarray(self.rate[i]),
            share=np.ascontiguousarray(self.share[i]),
            level_weight=np.ascontiguousarray(self.level_weight[i]),
            stretch_weight=np.ascontiguousarray(self.stretch_weight[i]),
            orders=np.array([order for orders in unknowns for order in orders], np.int64),
            ends=np.array(unknowns.ends, np.int64),
            start=start,
            pull=pull,
        )
