"""Bind a block's steps in three stages, each of which traces lines further, and fit the azimuth coefficients.

    RangePart    steps up to range compression, bound to the block's own lines
    AzimuthPart  steps after it, bound to fitted or closed-form polynomials
    sampled      all steps with the sampling that the traced lines need: they can be applied

Lines do not depend on how time, Doppler and range are sampled, so they pass through the parts before the sampling is
planned. Steps bind their own constants (`Step.bind`), and declare what divides the chain.

FIT of the azimuth coefficients on time-frequency lines; `coefficients` has the papers' formulas. It has two aims for a
block's lines after the last step. They must be level: what remains is phase error. And the steps in Doppler must hardly
stretch them in time: stretching is dispersion, which blurs the sharp ends of a dwell over sqrt(|stretch - 1| / rate)
seconds, and that part of the dwell is lost to the focus. Lines alone do not show this loss, since they are the
stationary phase. Many sets of coefficients level the lines to a milliradian, so the second aim costs nothing of the
first.

The unknowns per range depend on the steps of the chain: a time perturbation of orders 3 and 4 (with a bias chirp of
order 2, tried at a few values), a frequency perturbation of orders 2 to 5, a Doppler resampling of orders 2 to 4, a
deramp of orders 2 to 4.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev

from blocksar import solvers
from blocksar.arrays import FloatArray
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import AxisTaper
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.focusing.chains import Steps
from blocksar.focusing.lines import AzimuthPolynomials, Line, RowPolynomial, row_polynomial
from blocksar.focusing.range_gate import RangeGate
from blocksar.focusing.step import Constants, Motion, Sampling, Step, trace
from blocksar.kernels import fourier
from blocksar.kernels.fourier import Axis
from blocksar.kernels.levelling import LevellingProblem, level_lines
from blocksar.planning.target_lines import middle_line

RANGE_GUARD = 48  # range cells on either side of a sub-block, for side lobes of targets at its ends
BAND_ROOM = 0.08  # of the band, on either side of it, over which a sub-block's range frequencies fall to zero


def plan_range_gate(full: Axis, slab: Axis, line: Line, carrier: float) -> RangeGate:
    """The gate that holds the ranges of lines (n_range, n_yaw) at each Doppler, with room for side lobes."""
    u = (2 * line.doppler - slab.start - (slab.start + slab.extent)) / slab.extent
    centre = middle_line(u.ravel(), line.range.ravel(), order=6)
    spread = line.range - chebyshev.chebval(u, centre)
    # In a Doppler bin the ends of the band belong to other times than the carrier: a smear that SRC removes later.
    edge = max(abs(full.start), abs(full.start + full.extent)) / carrier
    rate = np.maximum(np.abs(line.rate), 1e-3 * np.abs(line.rate).max())
    smear = SPEED_OF_LIGHT / (2 * carrier) * line.doppler**2 / rate * edge
    cell = SPEED_OF_LIGHT / (2 * full.extent)
    low = float((spread - np.abs(smear)).min()) - RANGE_GUARD * cell
    high = float((spread + np.abs(smear)).max()) + RANGE_GUARD * cell
    period = fourier.fast_length((1 + 2 * BAND_ROOM) * full.size)
    step = 1 / (period * full.step)
    size = min(fourier.fast_length((high - low) * 2 / SPEED_OF_LIGHT / step), period)
    middle = round((low + high) / SPEED_OF_LIGHT / step)
    coarse = 1 / (size * step)
    n_frequency = min(math.floor((1 + 2 * BAND_ROOM) * full.extent / coarse), size)
    band_middle = full.start + (full.size - 1) / 2 * full.step
    frequency = Axis(band_middle - (n_frequency - 1) / 2 * coarse, coarse, n_frequency)
    beyond = np.clip(np.abs(frequency.values - band_middle) / full.extent - 0.5, 0, BAND_ROOM) / BAND_ROOM
    ramp = np.clip((np.minimum(np.arange(size), np.arange(size)[::-1]) + 0.5) / (RANGE_GUARD / 2), 0, 1)
    normalised = np.clip((2 * slab.values - 2 * slab.start - slab.extent) / slab.extent, u.min(), u.max())
    return RangeGate(
        slab=slab,
        centre=np.rint(chebyshev.chebval(normalised, centre) * 2 / SPEED_OF_LIGHT / step).astype(np.intp),
        gate=Axis(step * (middle - size // 2), step, size),
        window=np.sin(np.pi / 2 * ramp) ** 2,
        full=full,
        range_frequency=frequency,
        taper=np.cos(np.pi / 2 * beyond) ** 2,
    )


NODES_PER_INTERVAL = 8  # times per interval of the track's spline: linear between them, its bend errs by 0.4 %
RANGE_NODES = 4  # of the Chebyshev series of the line of sight in range


def plan_motion(
    geometry: Geometry, *, near: float, far: float, origin: float, low: float, high: float
) -> Motion | None:
    """The phase for epoch ranges near .. far, m, and yaws low .. high, rad; None for a polynomial track."""
    wobble = geometry.track.wobble
    if wobble is None:
        return None
    collection = geometry.collection
    n = NODES_PER_INTERVAL * wobble.n_interval + 1
    time = np.linspace(collection.time[0], collection.time[-1], n)
    nodes = chebyshev.chebpts1(RANGE_NODES)
    ranges = (near + far) / 2 + (far - near) / 2 * nodes
    beam = geometry.beam.centre_yaw(time, ranges, low, high)
    point, step = geometry.ground_point(ranges[:, None], beam), float(time[1] - time[0])

    def sight(at: FloatArray) -> FloatArray:
        """Unit vectors (n_range, n, 3) at times (n,) to the points that are in the beam's centre at `time`."""
        away = point - geometry.track.base.position(at)
        return np.asarray(away / np.sqrt((away * away).sum(axis=-1, keepdims=True)))

    def series(lengths: FloatArray) -> FloatArray:
        """(n, n_term) Chebyshev series in range of -2 fc / c times lengths (n_range, n, 3), summed over the axes."""
        cycles = -2 * collection.carrier / SPEED_OF_LIGHT * lengths.sum(axis=-1)
        return np.ascontiguousarray(solvers.chebyshev_series(nodes, cycles, RANGE_NODES - 1).T)

    before, now, after = (sight(time + offset) for offset in (-step, 0.0, step))
    turn, bend = (after - before) / (2 * step), (after - 2 * now + before) / step**2
    shift, rate, pull = (wobble(time, derivative) for derivative in range(3))
    return Motion.integrate(
        series(pull * now + 2 * rate * turn + shift * bend),
        series(shift * now),
        start=float(time[0]) - geometry.epoch,
        step=step,
        near=near - origin,
        far=far - origin,
    )


ORDERS = (2, 3, 4)  # of a Doppler resampling and a deramp; without 2, the bias, of a time perturbation
DOPPLER_ORDERS = (*ORDERS, ORDERS[-1] + 1)  # of a frequency perturbation
SERIES_DEGREE = 6  # of the series of each coefficient in range
# A fit stops when a step lowers the cost by less than the fraction ENOUGH, or after MOST_STEPS steps. Order 2 in
# Doppler and the deramp nearly cancel, which makes a long valley; its beginning suffices to choose a kind of chain.
ENOUGH, MOST_STEPS = 1e-7, 200
ROUGHLY_ENOUGH, FEW_STEPS = 1e-4, 40  # a rough fit stops at this relative decrease of the cost, or after these steps
DAMPING, NEAR_DAMPING = 1e-4, 1e-6  # of the first step: at the first range, and from the solution of the one before
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
    """The candidate with biases that bring the range acceleration of the lines to these multiples of its own."""
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
    roughly: bool = False,
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
    roughly : bool
        Stop early: enough to choose the kind of chain.
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
    enough, steps = (ROUGHLY_ENOUGH, FEW_STEPS) if roughly else (ENOUGH, MOST_STEPS)
    damping, pull, solutions = DAMPING, np.zeros(unknowns.size), list[FloatArray]()
    for i in range(ranges.size):
        if i > 1:  # where the two ranges before lead
            x = x + (x - solutions[-2]) * (ranges[i] - ranges[i - 1]) / (ranges[i - 1] - ranges[i - 2])
        x = level_lines(rows.problem(i, unknowns, start=x, pull=pull), damping, enough, steps)
        damping = NEAR_DAMPING
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
        """The end of each group but the last."""
        return [sum(map(len, self[:k])) for k in (1, 2, 3)]

    @property
    def size(self) -> int:
        return sum(map(len, self))


class _Scales(NamedTuple):
    """Half extents of the lines in time (s) and Doppler (Hz)."""

    time: float
    doppler: float


class _Rows(NamedTuple):
    """Lines (n_range, n_yaw, n) as `LevellingProblem` takes those of one range."""

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


class Slab(NamedTuple):
    """A block's part of the recovered spectrum."""

    first_bin: int
    doppler: Axis
    walk: float  # middle of the block's Doppler, Hz on the carrier
    margin: float  # Hz
    band_edge: float  # largest range frequency over the carrier


@dataclass(frozen=True, kw_only=True, eq=False)
class RangePart:
    """The steps up to range compression.

    Attributes
    ----------
    constants : Constants
    steps : tuple of Step
        The last one is the range compression, or the motion compensation that follows it.
    azimuth_kinds : tuple of type
        The kinds of steps that follow, in order.
    """

    constants: Constants
    steps: tuple[Step, ...]
    azimuth_kinds: Steps

    @classmethod
    def bind(cls, kinds: Steps, constants: Constants, line: Line) -> RangePart:
        """Bind the kinds up to range compression; `line` holds the block's lines in the recovered signal."""
        last = max(i for i, kind in enumerate(kinds) if kind.ends_range_part)
        steps: tuple[Step, ...] = ()
        for kind in kinds[: last + 1]:
            steps += (kind.bind(constants, partial(trace, steps, line)),)
        return cls(constants=constants, steps=steps, azimuth_kinds=kinds[last + 1 :])

    def trace(self, line: Line) -> Line:
        """Lines after range compression, from those in the recovered signal."""
        return trace(self.steps, line)

    @property
    def compression(self) -> Step:
        """The range compression."""
        return next(step for step in self.steps if step.compresses)

    @property
    def scales_time_about(self) -> float | None:
        """Time about which a keystone scales slow time with range frequency, s; None without one."""
        return next((about for step in self.steps if (about := step.scales_time_about) is not None), None)

    @property
    def freedom(self) -> FittedSteps:
        """The fitted polynomials that the steps after range compression need."""
        fitted = {kind.fitted for kind in self.azimuth_kinds}
        return FittedSteps("time" in fitted, "doppler" in fitted, "resampling" in fitted)


class Traced(NamedTuple):
    """Lines along the steps after range compression."""

    biased: Line  # before the transform to Doppler
    before_deramp: list[Line]  # after each step up to the deramp
    focused: Line  # after the last step


@dataclass(frozen=True, kw_only=True, eq=False)
class AzimuthPart:
    """The steps after range compression.

    Attributes
    ----------
    range_part : RangePart
    polynomials : AzimuthPolynomials
    steps : tuple of Step
    """

    range_part: RangePart
    polynomials: AzimuthPolynomials
    steps: tuple[Step, ...]

    @classmethod
    def bind(cls, range_part: RangePart, polynomials: AzimuthPolynomials, line: Line) -> AzimuthPart:
        """Bind the steps that follow a range part; `line` holds the block's lines after range compression."""
        constants = replace(range_part.constants, polynomials=polynomials)
        steps: tuple[Step, ...] = ()
        for kind in range_part.azimuth_kinds:
            steps += (kind.bind(constants, partial(trace, steps, line)),)
        return cls(range_part=range_part, polynomials=polynomials, steps=steps)

    def trace(self, line: Line) -> Traced:
        """Lines along the steps, from those after range compression."""
        biased, before = line, []
        for step in self.steps:
            if step.fitted == "deramp":
                break
            line = step.trace(line)
            before.append(line)
            if step.fitted == "time":
                biased = line
        return Traced(biased, before, trace(self.steps[len(before) :], line))

    def turns(self, line: Line) -> FloatArray:
        """By how much all steps turn phases from row to row, cycles/m, along lines after range compression."""
        total = np.zeros(line.time.shape)
        for step in self.steps:
            total = total + step.turns(line)
            line = step.trace(line)
        return total

    def weighed(self, in_time: AxisTaper) -> AzimuthPart:
        """Copy of the steps under another taper over the pulses."""
        part = self.range_part
        steps, constants = tuple(s.weighed(in_time) for s in part.steps), replace(part.constants, in_time=in_time)
        return replace(self, range_part=replace(part, steps=steps, constants=constants))

    def sampled(self, sampling: Sampling) -> tuple[Step, ...]:
        """The whole chain, ready to be applied."""
        return tuple(step.sampled(sampling) for step in (*self.range_part.steps, *self.steps))
