"""Chips: deramped range lines about each point over its lit pulses, low-passed and decimated in slow time.

Compiled loops project displacements on the lines of sight of all samples, and sum back.

Sample m of chip i lies at the collection's sample min(first[i] + m, n_sample - 1), and has the unit vector sight[i, m].
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import types

from blocksar.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from blocksar.autofocusing import range_lines
from blocksar.autofocusing.selection import Points
from blocksar.autofocusing.track_correction import between_samples
from blocksar.autofocusing.work import Work, low_pass
from blocksar.kernels.fourier import fast_length, fft_rows
from blocksar.kernels.groups import run_groups
from blocksar.kernels.loops import REAL_ROWS, UNCHECKED, fixed, loop
from blocksar.solvers import combination, vertex

SIGHTS = types.Array(types.float64, 3, "C", readonly=True)
INDICES = types.Array(types.int64, 1, "C", readonly=True)
SUMS = types.float64[:, ::1]
EXACT = {"nogil": True, **UNCHECKED}  # no contraction: the same bits wherever these are inlined


@loop(SIGHTS, INDICES, REAL_ROWS, SUMS, **EXACT)
def project(sight: FloatArray, first: IntArray, displacement: FloatArray, out: FloatArray) -> None:
    """Project displacements (n_sample, 3) on sight (n_point, n, 3): out[i, m] = sight . displacement at its sample."""
    n_point, n, last = sight.shape[0], sight.shape[1], displacement.shape[0] - 1
    for i in range(n_point):
        for m in range(n):
            t = min(first[i] + m, last)
            s, d = sight[i, m], displacement[t]
            out[i, m] = s[0] * d[0] + s[1] * d[1] + s[2] * d[2]


@loop(SIGHTS, INDICES, REAL_ROWS, SUMS, **EXACT)
def collect(sight: FloatArray, first: IntArray, values: FloatArray, out: FloatArray) -> None:
    """The transpose of `project`: add sight values[i, m] to out[t] (n_sample, 3)."""
    n_point, n, last = sight.shape[0], sight.shape[1], out.shape[0] - 1
    for i in range(n_point):
        for m in range(n):
            t = min(first[i] + m, last)
            for a in range(3):
                out[t, a] += sight[i, m, a] * values[i, m]


@loop(SIGHTS, INDICES, REAL_ROWS, types.float64[:, :, ::1], **EXACT)
def collect_squares(sight: FloatArray, first: IntArray, weights: FloatArray, out: FloatArray) -> None:
    """Add weights[i, m] sight sight^T to out[t] (n_sample, 3, 3)."""
    n_point, n, last = sight.shape[0], sight.shape[1], out.shape[0] - 1
    for i in range(n_point):
        for m in range(n):
            t = min(first[i] + m, last)
            for a in range(3):
                weighed = weights[i, m] * sight[i, m, a]
                for b in range(3):
                    out[t, a, b] += weighed * sight[i, m, b]


@loop(types.Array(types.float64, 3, "C", readonly=True), INDICES, REAL_ROWS, SUMS, **EXACT)
def add_to_form(squares: FloatArray, knot: IntArray, basis: FloatArray, form: FloatArray) -> None:
    """Add squares[t] (n_sample, 3, 3) to a form (3 size, 3 size) of the coefficients of splines with `Knots.basis`."""
    for t in range(squares.shape[0]):
        for k in range(4):
            for m in range(4):
                share, row, column = basis[t, k] * basis[t, m], 3 * (knot[t] + k), 3 * (knot[t] + m)
                for a in range(3):
                    for b in range(3):
                        form[row + a, column + b] += share * squares[t, a, b]


@loop(SIGHTS, INDICES, REAL_ROWS, INDICES, REAL_ROWS, SUMS, **EXACT)
def flat_parts(
    sight: FloatArray, first: IntArray, weights: FloatArray, knot: IntArray, basis: FloatArray, out: FloatArray
) -> None:
    """Rows of spline coefficients that add a constant, or a line, to a chip: unit norm under weights[i, m].

    Adds to out (2 n_point, 3 size), for splines with `Knots.basis`. Weights are equal where they are not 0.
    """
    n_point, n, last = sight.shape[0], sight.shape[1], knot.size - 1
    for i in range(n_point):
        total, count, middle, spread = 0.0, 0, 0.0, 0.0
        for m in range(n):
            if weights[i, m] > 0:
                total, count, middle = total + weights[i, m], count + 1, middle + m
        if count < 2:
            continue
        middle /= count
        for m in range(n):
            if weights[i, m] > 0:
                spread += (m - middle) ** 2
        spread = math.sqrt(spread / count)
        for m in range(n):
            if weights[i, m] == 0:
                continue
            t, share = min(first[i] + m, last), weights[i, m] / math.sqrt(total)
            line = share * (m - middle) / spread
            for k in range(4):
                for a in range(3):
                    at = 3 * (knot[t] + k) + a
                    out[2 * i, at] += basis[t, k] * sight[i, m, a] * share
                    out[2 * i + 1, at] += basis[t, k] * sight[i, m, a] * line


POINTS_AT_ONCE = 4  # that a thread takes
SHORT_GAP = 4  # samples that are missing in a row, and are filled
NEAR = 0.5  # of the speeds that a narrowed chip keeps: scatterers that move so fast count a quarter
PLACE_PADDING = 2.0  # Doppler cells for each sample, between which the brightest is interpolated


@dataclass(frozen=True, kw_only=True, eq=False)
class ChipPart:
    """Contribution of a block of pulses to the chips.

    Attributes
    ----------
    start : int
        First sample of the collection's `Work.sample_times`.
    values : (n_point, n, n_line) complex64
    seen : (n,) int
        Pulses in reach of the low-pass, missing ones not counted.
    """

    start: int
    values: ComplexArray
    seen: IntArray


@dataclass(frozen=True, kw_only=True, eq=False)
class Chips:
    """Chips of all points, each over its own samples.

    Attributes
    ----------
    work : Work
    time : (n_sample,) float
        Slow times of samples over the whole collection, s.
    values : (n_point, n_line, n) complex64
        Rows along slow time; zero from `count` on.
    first, count : (n_point,) int
        Samples of a chip: first <= m < first + count.
    sight : (n_point, n, 3) float
        Unit vectors from the antenna to the point.
    distance : (n_point, n) float
        From the antenna to the point, m.
    seen : (n_sample,) bool
        Samples that are not missing.
    """

    work: Work
    time: FloatArray
    values: ComplexArray
    first: IntArray
    count: IntArray
    sight: FloatArray
    distance: FloatArray
    seen: BoolArray

    @property
    def index(self) -> IntArray:
        """Samples of the collection (n_point, n); the last one where a chip has ended."""
        n = self.values.shape[2]
        return np.minimum(self.first[:, None] + np.arange(n), self.time.size - 1)

    def some(self, which: IntArray) -> Chips:
        """The chips of some points."""
        parts = {name: getattr(self, name)[which] for name in ("values", "first", "count", "sight", "distance")}
        return replace(self, **parts)

    def corrected(self, displacement: FloatArray) -> Chips:
        """The chips with a displacement (n_sample, 3) of the antenna, m, corrected by phase alone."""
        turn = np.exp(-1j * self.work.wavenumber * self.los(displacement)).astype(np.complex64)
        return replace(self, values=self.values * turn[:, None])

    def los(self, displacement: FloatArray) -> FloatArray:
        """Project a displacement (n_sample, 3) on the line of sight of each chip: (n_point, n)."""
        out = np.empty(self.sight.shape[:2])
        project(self.sight, self.first, displacement, out)
        return out

    def spread(self, values: FloatArray) -> FloatArray:
        """The transpose of `los`: (n_sample, 3) of (n_point, n)."""
        out = np.zeros((self.time.size, 3))
        collect(self.sight, self.first, values, out)
        return out

    @property
    def lit(self) -> BoolArray:
        """Mask (n_point, n) of the samples that lie within the chips' dwells."""
        return np.asarray(np.arange(self.values.shape[2]) < self.count[:, None])

    @property
    def told(self) -> BoolArray:
        """Mask (n_point, n) of the samples that are lit and not missing."""
        return np.asarray(self.lit & self.seen[self.index])

    def narrowed(self, factor: int) -> Chips:
        """Chips low-passed to 1 / factor of their Doppler band, and decimated by that."""
        if factor == 1:
            return self
        weights = low_pass(factor).astype(np.float32)
        ahead = (weights.size - factor) // 2
        first = -(-self.first // factor)
        count = np.maximum((self.first + self.count) // factor - first, 0)
        n = fast_length(int(count.max()))
        values = np.zeros((*self.values.shape[:2], n), np.complex64)
        range_lines.decimate(self.values, first * factor - ahead - self.first, count, weights, factor, values)
        n_sample = self.time.size // factor
        middle = np.arange(n_sample) * float(factor) + (factor - 1) / 2
        time = np.interp(middle, np.arange(self.time.size), self.time)
        index = np.minimum(first[:, None] + np.arange(n), n_sample - 1) * factor + factor // 2 - self.first[:, None]
        index = np.clip(index, 0, self.values.shape[2] - 1)
        sight, distance = (
            np.take_along_axis(array, at, axis=1)
            for array, at in ((self.sight, index[..., None]), (self.distance, index))
        )
        seen: BoolArray = np.asarray(self.seen[: n_sample * factor].reshape(n_sample, factor).any(axis=1))
        return replace(
            self, time=time, values=values, first=first, count=count, sight=sight, distance=distance, seen=seen
        )

    def recentred(self, displacement: FloatArray) -> Chips:
        """The chips about their brightest scatterers: the phase of these' own ranges removed instead of the points'.

        A scatterer that lies aside of its point has a phase with more than a constant and a line, which would otherwise
        be taken for an error of the track. Where it lies is seen with a displacement (n_sample, 3), m, corrected.
        """
        away = brightest_places(self.corrected(displacement))
        vector = self.sight * self.distance[..., None] + np.pad(away, ((0, 0), (0, 1)))[:, None]
        distance = np.sqrt((vector * vector).sum(axis=2))
        turn = np.exp(1j * self.work.wavenumber * (distance - self.distance)).astype(np.complex64)
        return replace(self, values=self.values * turn[:, None], sight=vector / distance[..., None], distance=distance)


def take_chips(
    signal: ComplexArray, work: Work, points: Points, displacement: FloatArray, pulses: slice, threads: int = 1
) -> ChipPart:
    """Take the contribution of a block of pulses to the chips, along a corrected track.

    The lines lie at exact ranges from the corrected positions, with the phase of these ranges removed: a perfect track
    leaves a point with constant phase, an error e that of -k u . e, where u is the unit vector to the point.

    Parameters
    ----------
    signal : (n, n_range_frequency) complex64
        Samples of these pulses; NaN counts as zero.
    displacement : (n_sample, 3) float
        Of the antenna from its stated positions, m.
    pulses : slice
        One of `work.blocks`.
    """
    collection, settings, d = work.geometry.collection, work.settings, work.decimation
    profiles = range_lines.range_profiles(signal, collection, threads)
    position = collection.antenna_position[pulses] + between_samples(work, displacement, collection.time[pulses])
    taps = low_pass(d)
    ahead = (taps.size - d) // 2
    start = max((pulses.start + ahead - taps.size) // d + 1, 0)
    stop = min((pulses.stop - 1 + ahead) // d + 1, work.n_sample)
    out = np.zeros((points.x.size, max(stop - start, 0), settings.lines), np.complex64)
    lit = np.stack([np.clip(p - pulses.start, 0, pulses.stop - pulses.start) for p in (points.first, points.last)], 1)
    place = np.stack([points.x, points.y, points.z], axis=1)

    decimating = range_lines.DecimatingFilter(fixed(taps), d, ahead + pulses.start - d * start)

    def one(rows: slice) -> None:
        sight = place[rows, None] - position
        held = np.sqrt((sight * sight).sum(axis=2)) - collection.reference_range[pulses]
        range_lines.take_chips(
            profiles.values, held / profiles.spacing, held * (work.wavenumber / (2 * np.pi)), lit[rows],
            range_lines.taps(), settings.line_spacing * work.cell / profiles.spacing, decimating, out[rows],
        )  # fmt: skip

    n = points.x.size
    run_groups(one, [slice(i, min(i + POINTS_AT_ONCE, n)) for i in range(0, n, POINTS_AT_ONCE)], threads)
    there: BoolArray = np.asarray(~np.isnan(signal).all(axis=1))
    reached = d * np.arange(start, max(stop, start))[:, None] - ahead + np.arange(taps.size) - pulses.start
    inside = (reached >= 0) & (reached < there.size)
    seen = (inside & there[np.clip(reached, 0, there.size - 1)]).sum(axis=1)
    return ChipPart(start=start, values=out, seen=seen)


def join_chips(work: Work, points: Points, parts: Sequence[ChipPart], displacement: FloatArray) -> Chips:
    """Put the parts of all blocks together, each point's over the samples that are lit."""
    d, collection = work.decimation, work.geometry.collection
    lit_first = np.ceil((points.first - (d - 1) / 2) / d).astype(np.int64).clip(0)
    lit_last = (np.floor((points.last - 1 - (d - 1) / 2) / d).astype(np.int64) + 1).clip(max=work.n_sample)
    count = np.maximum(lit_last - lit_first, 0)
    n = fast_length(int(count.max()))
    values = np.zeros((points.x.size, work.settings.lines, n), np.complex64)
    seen = np.zeros(work.n_sample, bool)
    for part in parts:
        stop = part.start + part.values.shape[1]
        seen[part.start : stop] |= part.seen > 0
        for i in range(points.x.size):
            low, high = max(part.start, int(lit_first[i])), min(stop, int(lit_last[i]))
            if low < high:
                into = slice(low - int(lit_first[i]), high - int(lit_first[i]))
                values[i, :, into] += part.values[i, low - part.start : high - part.start].T
    for gap in gaps(seen):
        for i in range(points.x.size):
            fill(values[i], gap.start - int(lit_first[i]), gap.stop - int(lit_first[i]), int(count[i]))
    at = work.sample_pulses
    pulse = np.arange(float(collection.n_pulse))
    position = np.stack([np.interp(at, pulse, axis) for axis in collection.antenna_position.T], axis=1)
    position += displacement
    index = np.minimum(lit_first[:, None] + np.arange(n), work.n_sample - 1)
    place = np.stack([points.x, points.y, points.z], axis=1)
    sight = place[:, None] - position[index]
    distance = np.sqrt((sight * sight).sum(axis=2))
    sight /= distance[..., None]
    return Chips(
        work=work, time=work.sample_times, values=values, first=lit_first, count=count, sight=sight, distance=distance,
        seen=seen,
    )  # fmt: skip


def missing_runs(seen: BoolArray) -> list[slice]:
    """Runs of samples that are missing."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], ~seen, [0]]).astype(int)))
    return [slice(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def gaps(seen: BoolArray) -> list[slice]:
    """Return the runs of missing samples that are short enough to be filled."""
    return [run for run in missing_runs(seen) if run.stop - run.start <= SHORT_GAP]


def fill(lines: ComplexArray, first: int, last: int, count: int) -> None:
    """Fill the missing samples first <= m < last of lines (n_line, n) in place, by linear interpolation."""
    if first < 1 or last >= count:
        return
    share = ((np.arange(first, last) - (first - 1)) / (last - first + 1)).astype(np.float32)
    lines[:, first:last] = lines[:, first - 1 : first] * (1 - share) + lines[:, last : last + 1] * share


def mean_sight(chips: Chips) -> FloatArray:
    """Mean unit vector (n_sample, 3) from the antenna to the points that are lit; 0 where none is."""
    mean = chips.spread(chips.lit.astype(np.float64))
    return np.asarray(mean / np.maximum(np.sqrt((mean * mean).sum(axis=1, keepdims=True)), 1e-300))


def brightest_places(chips: Chips) -> FloatArray:
    """Ground offset (n_point, 2), m, of the brightest scatterer of each chip from its point.

    Its line tells the range, and its Doppler the range rate. 0 where they tell no place within the chip. What lies near
    counts more: the points of a regular pattern are to be different ones.
    """
    work, (n_point, n_line, n) = chips.work, chips.values.shape
    interval = float(chips.time[-1] - chips.time[0]) / (chips.time.size - 1)
    away = np.zeros((n_point, 2))
    length = fast_length(PLACE_PADDING * n)
    reach = n_line / 2 * work.settings.line_spacing * work.cell
    for i in range(n_point):
        padded = np.zeros((n_line, length), np.complex64)
        padded[:, :n] = chips.values[i]
        power = np.abs(fft_rows(padded, inverse=False)) ** 2 * _nearness(work, length, interval)
        line, cell = np.unravel_index(int(power.argmax()), power.shape)
        fraction = vertex(power[max(line - 1, 0) : line + 2, cell])
        finer = vertex(power[line, [cell - 1, cell, (cell + 1) % length]])
        rate = 2 * np.pi * ((cell + finer + length / 2) % length - length / 2) / (length * interval)
        offset = (line + fraction - n_line // 2) * work.settings.line_spacing * work.cell
        middle = min(max(int(chips.count[i]) // 2, 1), n - 2)
        sight, turned = chips.sight[i, middle, :2], chips.sight[i, middle + 1, :2] - chips.sight[i, middle - 1, :2]
        along = np.stack([sight, turned / (2 * interval)])
        moved = combination(along[:, 0], along[:, 1], np.array([offset, -rate / work.wavenumber]))
        if power.max() > 0 and np.isfinite(moved).all() and abs((moved * sight).sum()) < reach:
            away[i] = moved
    return away


def _nearness(work: Work, length: int, interval: float) -> FloatArray:
    """Weights (length,) of the Doppler cells of samples at an interval, s: less for scatterers far from the point."""
    cell = (np.arange(length) + length // 2) % length - length // 2
    speed = cell * (2 * np.pi / (length * interval * work.wavenumber))
    return np.asarray(1 / (1 + (speed / (NEAR * work.settings.narrow_speed)) ** 2) ** 2)
