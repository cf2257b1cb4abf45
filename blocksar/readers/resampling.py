"""Resampling of pulses: from uneven to uniform times, and to the pulses and frequencies that an area needs.

*Uneven times.* Once the range to the scene's centre is removed, the echoes of a scene fill a limited Doppler band, |nu|
<= band / 2. Of all weighted sums of the pulses at times t_m nearest to a time t, the one used here has the least mean
square error over echoes spread evenly over that band:

    w = (K + SOFTNESS I)^-1 k,    K_mn = sinc(band (t_m - t_n)),    k_m = sinc(band (t_m - t)),

sinc(x) = sin(pi x) / (pi x). The weights are computed for each pulse from the times of its neighbours. For an echo of
Doppler nu the error of the sum, relative to the echo's amplitude, is exactly

    e(nu) = |sum_m w_m exp(2j pi nu (t_m - t)) - 1|.

Its largest value over the band is a bound for every echo of the scene, and so for every sum of them in a pixel. Pulses
for which it exceeds MOST_ERROR become missing pulses: beside gaps, and at the ends, where there are neighbours on one
side only.

*An area* needs the pulses that light it, and of these and of frequencies every n-th. With R(n) the distance of the
antenna at pulse n from a point p of the area and R_c(n) that from its middle, samples times exp(4j pi f/c (R_c -
reference_range)) are sigma exp(-4j pi f/c (R - R_c)) of p: over frequencies an oscillation of the delay 2 (R - R_c)/c,
over pulses one of the Doppler frequency -2 f/c d(R - R_c)/dt. The area's corners, and those of its prisms ROOM above
and below the ground, bound both. What lies beyond is stopped by low-pass filters (`LowPass`), first over frequencies,
then over pulses, and as many samples are left out as the bounds allow. The samples kept have the antenna's positions at
their own pulses and R_c as their reference range, so that phases are exact: nothing is interpolated. Under a steered
beam as many pulses are kept as hold all that it lights at once, since that is what processing takes it to light.

*Low-pass filters* keep every n-th sample: the band that they keep comes out as it is, and nothing folds onto it.
Samples x(t_m) hold echoes exp(2j pi nu t_m): those wanted, |nu| <= band / 2, and others. Every n-th is kept,
y(t_k) = sum_m w_m x(t_m), so that frequencies which differ by rate = 1 / (n dt) become one: whatever lies beyond
rate - band / 2 falls onto what is wanted and has to be stopped. What lies between may come through, since it falls
beside it. Of all weights those have the least square error

    integral over |nu| <= band/2 of |H - 1|^2 + integral over rate - band/2 <= |nu| <= 1/(2 dt) of |H|^2,
    H(nu) = sum_m w_m exp(2j pi nu (t_m - t_k)),

which solve (P + S + SOFTNESS I) w = p with P_mn = band sinc(band (t_m - t_n)), p_m = band sinc(band (t_m - t_k)) and
S_mn = 2 s sinc(2 s (t_m - t_n)) at s = 1/(2 dt) less the same at s = rate - band/2. Near the ends of the samples, and
where some are missing, the same equations use those that there are. The largest |H - 1| and |H| over both bands are
computed, and bound the error of every echo; where they exceed MOST_ERROR nothing is kept, nor where echoes between the
two bands would grow by more than MOST_GROWTH, or noise by more than MOST_GAIN.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from blocksar.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.sampling import refuse_departures
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError

# ---------------------------------------------------------------- uneven times

NEIGHBOURS = 64  # pulses in a sum
SOFTNESS = 1e-8  # keeps weights small where the band leaves them undetermined, and errors above 1e-4
MOST_ERROR = 0.05  # of an echo's amplitude, -26 dB
MOST_GAIN = 2.0  # of receiver noise, in amplitude
OCCUPIED = 0.9  # of the mean PRF: the widest Doppler band; beyond it, sums of so few pulses are too inaccurate
GROUP = 256  # pulses whose weights are computed at a time


@dataclass(frozen=True, kw_only=True, eq=False)
class Resampling:
    """Weights that turn uneven pulses into uniform ones.

    Attributes
    ----------
    first : (n_out,) int
        First of the consecutive uneven pulses that are summed.
    weights : (n_out, n_neighbour) float
    bound : (n_out,) float
        Largest error of any echo within the band, relative to its amplitude.
    spread : (n_out,) float
        Root mean square error over the band.
    good : (n_out,) bool
        False where the pulse is missing: its neighbours do not determine it.
    """

    first: IntArray
    weights: FloatArray
    bound: FloatArray
    spread: FloatArray
    good: BoolArray

    def part(self, pulses: slice) -> Resampling:
        """Select the weights of some uniform pulses."""
        return Resampling(**{name: getattr(self, name)[pulses] for name in self.__dataclass_fields__})

    def inputs(self, pulses: slice) -> slice:
        """Uneven pulses that these uniform ones are computed from."""
        first = self.first[pulses]
        return slice(int(first.min()), int(first.max()) + self.weights.shape[1])

    def apply(self, signal: ComplexArray, pulses: slice) -> ComplexArray:
        """Compute some of the uniform pulses.

        Parameters
        ----------
        signal : (n, n_column) complex64
            The uneven pulses `inputs(pulses)`.
        pulses : slice
            Of the uniform pulses.

        Returns
        -------
        (n_out, n_column) complex64
            Rows of NaN where `good` is False.
        """
        start, count = self.inputs(pulses).start, self.weights.shape[1]
        out = np.full((self.first[pulses].size, signal.shape[1]), complex(np.nan, np.nan), np.complex64)
        rows = zip(self.first[pulses], self.weights[pulses], self.good[pulses], strict=True)
        for row, (first, weights, good) in enumerate(rows):
            if good:
                out[row] = weights @ signal[first - start : first - start + count]
        return out


def plan_resampling(time: FloatArray, uniform: FloatArray, *, band: float) -> Resampling:
    """Compute weights and errors from the times alone.

    Parameters
    ----------
    time : (n,) float
        Times of the pulses, s, ascending.
    uniform : (n_out,) float
        Times of the uniform pulses, s, ascending.
    band : float
        Width of the Doppler band that echoes fill, centred at zero, Hz.

    Raises
    ------
    ValueError
        If times do not ascend or `band` is not above zero.
    """
    if not (np.diff(time) > 0).all() or not (np.diff(uniform) > 0).all():
        raise ValueError("time and uniform must ascend")
    if not band > 0:
        raise ValueError(f"{band=} must be above 0 Hz")
    count = min(NEIGHBOURS, time.size)
    first = np.clip(np.searchsorted(time, uniform) - count // 2, 0, time.size - count)
    doppler = np.linspace(0, band / 2, 2 * count + 1)  # the error is an even function of Doppler
    weights, bound, spread = np.empty((uniform.size, count)), np.empty(uniform.size), np.empty(uniform.size)
    for start in range(0, uniform.size, GROUP):
        group = slice(start, start + GROUP)
        lag = time[first[group, None] + np.arange(count)] - uniform[group, None]
        covariance = np.sinc(band * (lag[:, :, None] - lag[:, None, :])) + SOFTNESS * np.eye(count)
        solved = np.linalg.solve(covariance, np.sinc(band * lag)[:, :, None])[:, :, 0]
        cycles = lag[:, :, None] * doppler
        phase = 2 * np.pi * (cycles - np.rint(cycles))
        real = np.einsum("ik,ikd->id", solved, np.cos(phase)) - 1
        error = np.hypot(real, np.einsum("ik,ikd->id", solved, np.sin(phase)))
        weights[group], bound[group] = solved, error.max(axis=1)
        spread[group] = np.sqrt((error**2).mean(axis=1))
    gain = np.sqrt((weights**2).sum(axis=1))
    good = (bound <= MOST_ERROR) & (gain <= MOST_GAIN)
    return Resampling(first=first, weights=weights, bound=bound, spread=spread, good=good)


# ---------------------------------------------------------------- low-pass filters

SPARE = 1.5  # rate kept over the band wanted: the share between them is where the filter falls off
TAPS = 16  # samples in a sum, for each that is left out: -77 dB over both bands
MOST_GROWTH = 8.0  # of echoes between the bands, which do not fold onto what is wanted, in sums at the ends
TOGETHER = 16  # sums that are computed at once: more would multiply more zeros


def steps_of(band: float, rate: float) -> int:
    """Largest decimation that a band allows, for samples at `rate` per unit."""
    return max(int(rate / (SPARE * band)), 1) if band > 0 else 1


@dataclass(frozen=True, kw_only=True, eq=False)
class LowPass:
    """Decimating low-pass filter: sums of consecutive samples.

    Attributes
    ----------
    places : (n_out,) int
        The sample whose place each sum takes.
    first : (n_out,) int
        First sample that is summed.
    weights : (n_kind, n_tap) float
        Of the different sums.
    kind : (n_out,) int
        Which of them each is.
    good : (n_out,) bool
        False where the samples that there are do not determine it.
    error : float
        Largest error of an echo in a sum that is good, relative to the echo.
    """

    places: IntArray
    first: IntArray
    weights: FloatArray
    kind: IntArray
    good: BoolArray
    error: float

    def part(self, some: slice) -> LowPass:
        """Select some of the sums."""
        return LowPass(
            places=self.places[some], first=self.first[some], weights=self.weights, kind=self.kind[some],
            good=self.good[some], error=self.error,
        )  # fmt: skip

    def inputs(self, some: slice) -> slice:
        """Samples that some of the sums are computed from."""
        return slice(int(self.first[some].min()), int(self.first[some].max()) + self.weights.shape[1])

    def matrix(self, some: slice) -> ComplexArray:
        """Weights of some sums over `inputs`, (n_out, n_in) complex64."""
        inputs = self.inputs(some)
        out = np.zeros((self.first[some].size, inputs.stop - inputs.start), np.complex64)
        for row, (first, kind) in enumerate(zip(self.first[some] - inputs.start, self.kind[some], strict=True)):
            out[row, first : first + self.weights.shape[1]] = self.weights[kind]
        return out

    def along_rows(self, samples: ComplexArray) -> ComplexArray:
        """Filter the last axis of (n_row, n_in) samples: (n_row, n_out).

        Groups of sums with the same weights are one product of matrices: many small ones keep waiting for each other's
        threads.
        """
        out = np.empty((samples.shape[0], self.places.size), np.complex64)
        usual = self.kind[self.places.size // 2]
        every = groups(self.places.size)
        regular = [some for some in every if some.stop - some.start == TOGETHER and (self.kind[some] == usual).all()]
        if len(regular) < 2 or regular[-1].stop - regular[0].start > TOGETHER * len(regular):
            regular = []
        for some in [each for each in every if each not in regular]:
            out[:, some] = samples[:, self.inputs(some)] @ self.matrix(some).T
        if regular:
            first, second = (self.inputs(some) for some in regular[:2])
            windows = sliding_window_view(samples[:, first.start :], first.stop - first.start, axis=1)
            windows = windows[:, :: second.start - first.start][:, : len(regular)]
            sums = windows.reshape(-1, first.stop - first.start) @ self.matrix(regular[0]).T
            out[:, regular[0].start : regular[-1].stop] = sums.reshape(samples.shape[0], -1)
        return out

    def over_rows(self, read: Callable[[slice], ComplexArray], some: slice) -> ComplexArray:
        """Filter rows from `read`, each read once and in order: some of the sums, NaN where they are not good.

        Rows that are missing are NaN.
        """
        rows = np.empty((0, 0), np.complex64)
        start = stop = self.inputs(some).start
        parts = []
        for own in groups(self.places[some].size):
            sums = slice(some.start + own.start, some.start + own.stop)
            inputs = self.inputs(sums)
            rows, start = rows[inputs.start - start :], inputs.start
            if inputs.stop > stop:
                fresh = np.nan_to_num(read(slice(max(stop, start), inputs.stop)), copy=False)
                rows, stop = np.concatenate([rows, fresh]) if rows.size else fresh, inputs.stop
            parts.append(self.matrix(sums) @ rows)
        out = np.concatenate(parts)
        out[~self.good[some]] = complex(np.nan, np.nan)
        return out


def groups(count: int) -> list[slice]:
    """Divide `count` into slices of at most TOGETHER."""
    return [slice(first, min(first + TOGETHER, count)) for first in range(0, count, TOGETHER)]


def plan_lowpass(size: int, steps: int, band: float, present: BoolArray | None = None) -> LowPass:
    """Compute weights and errors of sums at every `steps`-th of `size` samples, around the middle.

    Parameters
    ----------
    size : int
    steps : int
    band : float
        Width of what is wanted about zero, cycles a sample.
    present : (size,) bool, optional
        Which samples there are; default: all.
    """
    there = np.ones(size, bool) if present is None else present
    places = np.arange((size - 1) % steps // 2, size, steps)
    taps = min(TAPS * steps | 1, size)
    first = np.clip(places - taps // 2, 0, size - taps)
    of_offset: dict[int, _Equations] = {}
    known: dict[bytes, int] = {}
    kind = np.empty(places.size, np.int64)
    weights: list[FloatArray] = []
    errors: list[float] = []
    growths: list[float] = []
    for k, offset in enumerate((places - first).tolist()):
        use = there[first[k] : first[k] + taps]
        key = bytes(np.packbits(use)) + offset.to_bytes(8)
        if key not in known:
            if offset not in of_offset:
                of_offset[offset] = _Equations(np.arange(taps) - offset, steps, band)
            known[key] = len(weights)
            row, worst, growth = of_offset[offset].solve(use)
            weights.append(row)
            errors.append(worst)
            growths.append(growth)
        kind[k] = known[key]
    error = np.asarray(errors)[kind]
    good = (error <= MOST_ERROR) & (np.asarray(growths)[kind] <= MOST_GROWTH)
    good &= np.linalg.norm(weights, axis=1)[kind] <= MOST_GAIN
    return LowPass(
        places=places, first=first, weights=np.asarray(weights), kind=kind, good=good,
        error=float(error[good].max(initial=0.0)),
    )  # fmt: skip


class _Equations:
    """Equations for filter weights at some lags, and frequency responses to find their errors."""

    def __init__(self, lag: IntArray, steps: int, band: float) -> None:
        def ideal(width: float, lag: IntArray) -> FloatArray:
            return np.asarray(width * np.sinc(width * lag))

        apart, stop = lag[:, None] - lag, 1 / steps - band / 2
        self.wanted = ideal(band, lag)
        self.normal = ideal(band, apart) + ideal(1.0, apart) - ideal(2 * stop, apart) + SOFTNESS * np.eye(lag.size)
        bands = [(0, band / 2, lag.size), (stop, 0.5, 2 * lag.size), (band / 2, stop, lag.size)]
        frequency = np.concatenate([np.linspace(*each) for each in bands])
        self.response = np.exp(2j * np.pi * frequency[:, None] * lag)
        self.between = slice(3 * lag.size, None)
        self.ideal = np.repeat([1.0, 0.0], [lag.size, 2 * lag.size])
        self.alone = lag == 0 if steps == 1 else None  # then nothing folds

    def solve(self, use: BoolArray) -> tuple[FloatArray, float, float]:
        """Solve for weights, zero for unused samples; also the largest error, and |H| between the bands."""
        weights = np.zeros(use.size)
        if self.alone is not None:
            weights[self.alone] = 1.0
            return weights, 0.0 if use[self.alone].all() else np.inf, 1.0
        weights[use] = np.linalg.solve(self.normal[np.ix_(use, use)], self.wanted[use])
        response = self.response @ weights
        error = np.abs(response[: self.ideal.size] - self.ideal)
        return weights, float(error.max()), float(np.abs(response[self.between]).max())


Area = tuple[tuple[float, float], tuple[float, float]]  # x and y, from .. to, m in the scene frame


# ---------------------------------------------------------------- areas

ROOM = 50.0  # m by which the ground of an area may lie off the plane
PLACES = 9  # along each side, at which the lit pulses of the area are found
LEAST = 256  # pulses, and frequencies, that are left at least: one or two at either end have no sum that is good
PART = 64  # pulses whose frequencies are filtered at a time


@dataclass(frozen=True, kw_only=True, eq=False)
class AreaCut:
    """Reduction of a collection's samples to those of an area.

    Attributes
    ----------
    collection : Collection
        Of what is kept; it counts time from its middle pulse.
    first : int
        First pulse of the original that is used.
    pulses, frequencies : LowPass
        Pulses are counted from `first`.
    kept : (slice, slice)
        Sums of the two that are kept: those at the ends are not good.
    shift : (n_pulse,) float or None
        Reference range of the area less that of the samples, m, from `first` on; None: it stays.
    later : float
        By how much its slow time 0 lies later, s.
    message : str
    """

    collection: Collection
    first: int
    pulses: LowPass
    frequencies: LowPass
    kept: tuple[slice, slice]
    shift: FloatArray | None
    later: float
    message: str

    def reader(self, read: Callable[[slice], ComplexArray], frequency: FloatArray) -> Callable[[slice], ComplexArray]:
        """Make a function that reads pulses of the area, from one that reads pulses of the collection.

        `frequency` (n,) are those of the original, Hz, absolute.
        """

        def part(pulses: slice) -> ComplexArray:
            block = read(slice(self.first + pulses.start, self.first + pulses.stop))
            if self.shift is not None:
                block = block * _phasors(2 / SPEED_OF_LIGHT * self.shift[pulses, None], frequency)
            return self.frequencies.along_rows(block)[:, self.kept[1]]

        def rows(pulses: slice) -> ComplexArray:
            starts = range(pulses.start, pulses.stop, PART)
            return np.concatenate([part(slice(start, min(start + PART, pulses.stop))) for start in starts])

        def read_kept(pulses: slice) -> ComplexArray:
            first = self.kept[0].start
            return self.pulses.over_rows(rows, slice(first + pulses.start, first + pulses.stop))

        return read_kept


def _phasors(rate: FloatArray, frequency: FloatArray) -> ComplexArray:
    """exp(2j pi rate frequency), (n_row, n) complex64, of rates (n_row, 1), s, and uniform frequencies (n,), Hz.

    Products of two tables, of every width-th frequency and of the steps between: of the exact ones, to rounding.
    """
    width = math.isqrt(frequency.size) + 1
    steps = (frequency[-1] - frequency[0]) / max(frequency.size - 1, 1) * np.arange(width)
    coarse, fine = (
        np.exp(2j * np.pi * (cycles - np.rint(cycles))).astype(np.complex64)
        for cycles in (rate * frequency[::width], rate * steps)
    )
    return (coarse[:, :, None] * fine[:, None, :]).reshape(rate.shape[0], -1)[:, : frequency.size]


def plan_cut(collection: Collection, area: Area, present: BoolArray) -> AreaCut:
    """Plan the reduction of a collection to an area; `present` (n_pulse,) marks pulses that are not missing.

    Raises
    ------
    InputError
        If the beam lights nothing of the area, its echoes were not recorded, or too few pulses are left.
    """
    shown = f"--area {area[0][0]:g}:{area[0][1]:g},{area[1][0]:g}:{area[1][1]:g}"
    refuse_departures("--area", collection.departures, "take all pulses and range frequencies")
    by_yaw = collection.steered and not collection.has_axis  # its angles are about the nadir at t = 0, which stays
    lit = slice(0, collection.n_pulse) if by_yaw else _lit(collection, area, shown)
    frequency, step = collection.carrier + collection.range_frequency, collection.range_frequency_step
    away, rate = _extents(collection, area, lit)
    band = 4 * float(frequency[-1]) / SPEED_OF_LIGHT * max(rate, _beam_rate(collection))
    delays = 4 * away / SPEED_OF_LIGHT
    steps = [
        min(steps_of(width, sampled), max(size // LEAST, 1))
        for width, sampled, size in ((band, collection.prf, lit.stop - lit.start), (delays, 1 / step, frequency.size))
    ]
    asked, lit = lit, _with_room(lit, steps[0], collection.n_pulse)
    antenna = collection.antenna_position[lit]
    centre = np.array([sum(area[0]) / 2, sum(area[1]) / 2, collection.ground_height])
    reference = np.linalg.norm(antenna - centre, axis=1)
    shift = reference - collection.reference_range[lit]
    half = collection.range_window / 2
    if float(np.abs(shift).min()) - away > half:
        raise InputError(
            f"{shown} lies {np.abs(shift).min():.6g} m in range from the middle of what was recorded, which reaches "
            f"{half:.6g} m; give an area that it covers"
        )
    pulses = plan_lowpass(len(antenna), steps[0], band / collection.prf, present[lit])
    frequencies = plan_lowpass(frequency.size, steps[1], delays * step)
    within = (asked.start - lit.start - steps[0], asked.stop - lit.start + steps[0])
    selected = _good(pulses, shown, within), _good(frequencies, shown)
    at, f = pulses.places[selected[0]], frequency[frequencies.places[selected[1]]]
    changed = max(steps) > 1
    carrier = float(f[0] + f[-1]) / 2
    time = collection.time[lit][at]
    later = 0.0 if by_yaw else float(time[time.size // 2])
    own = {
        name: values[lit][at]
        for name in ("antenna_position", "beam_azimuth", "beam_axis", "beam_steering")
        if (values := getattr(collection, name)) is not None
    }
    new = replace(
        collection, carrier=carrier, time=time - later, range_frequency=f - carrier,
        reference_range=(reference if changed else collection.reference_range[lit])[at], **own,
    )  # fmt: skip
    message = (
        f"{shown}: {_of_pulses(asked, collection.n_pulse)}; of these {_every(steps[0], 'pulse')} ({new.prf:.6g} Hz for "
        f"{band:.4g} Hz of Doppler), {_every(steps[1], 'frequency')} (a range window of {new.range_window:.6g} m for "
        f"{2 * away:.4g} m); echoes change by at most {max(pulses.error, frequencies.error):.2g} of themselves, those "
        f"from beyond fall to as much; ground to {ROOM:g} m off the plane stays"
    )
    return AreaCut(
        collection=new, first=lit.start, pulses=pulses, frequencies=frequencies, kept=selected,
        shift=shift if changed else None, later=later, message=message,
    )  # fmt: skip


def _lit(collection: Collection, area: Area, shown: str) -> slice:
    """Pulses from the first to the last that lights any place of the area."""
    x, y = np.meshgrid(*(np.linspace(*side, PLACES) for side in area))
    first, last = Geometry(collection=collection).beam.passes(x, y)
    lit = last > first
    if not lit.any():
        raise InputError(f"{shown} is lit at no time; give an area that the beam passes")
    return slice(int(first[lit].min()), int(last[lit].max()))


def _extents(collection: Collection, area: Area, lit: slice) -> tuple[float, float]:
    """Largest |R - R_c|, m, and |d(R - R_c)/dt|, m/s, of points in an area and ROOM above and below it."""
    antenna, time, ground = collection.antenna_position[lit], collection.time[lit], collection.ground_height
    middle = np.linalg.norm(antenna - [sum(area[0]) / 2, sum(area[1]) / 2, ground], axis=1)
    away = rate = 0.0
    for x, y, z in product(*(np.linspace(*side, 3) for side in (*area, (ground - ROOM, ground + ROOM)))):
        difference = np.linalg.norm(antenna - [x, y, z], axis=1) - middle
        away = max(away, float(np.abs(difference).max()))
        rate = max(rate, float(np.abs(np.gradient(difference, time)).max()))
    return away, rate


def _beam_rate(collection: Collection) -> float:
    """Bound on |dR/dt|, m/s, between the middle and the edge of the beam, whose whole width processing uses."""
    if collection.beam_width is None:
        return 0.0
    speed = np.linalg.norm(np.gradient(collection.antenna_position, collection.time, axis=0), axis=1).max()
    return float(speed) * (collection.lit_width or collection.beam_width) / 2


def _with_room(lit: slice, steps: int, total: int) -> slice:
    """Extend lit pulses on either side by those that filters at the ends need, as far as there are any."""
    room = TAPS * steps // 2 if steps > 1 else 0
    return slice(max(lit.start - room, 0), min(lit.stop + room, total))


def _good(filtered: LowPass, shown: str, within: tuple[float, float] = (-np.inf, np.inf)) -> slice:
    """Sums from the first to the last good one, at places within an interval."""
    inside = (filtered.places > within[0]) & (filtered.places < within[1])
    good = np.flatnonzero(filtered.good & inside)
    if good.size < 8:
        raise InputError(
            f"{shown} leaves {good.size} of {filtered.good.size} pulses or frequencies; at least 8 are needed: give a "
            "larger one"
        )
    return slice(int(good[0]), int(good[-1]) + 1)


def _of_pulses(lit: slice, total: int) -> str:
    return f"pulses {lit.start} .. {lit.stop - 1} of {total} light it" if lit.stop - lit.start < total else "all pulses"


def _every(steps: int, what: str) -> str:
    return f"every {what}" if steps == 1 else f"one {what} of {steps}"
