"""Sums of weights times the antenna's pattern over the lit pulses of pixels: the divisor in back-projection.

`add_gains` sums pulse by pulse, exactly. `mean_elevations` takes the mean of the pattern in elevation at a few pulses
of each dwell. A chain divides by it, pixel by pixel: the pattern bends between its samples and may vanish, which no
series over the ground follows. All processors tell by it which pixels are too dark for an image, see `LEAST_ELEVATION`.

Pixels of a row are computed together, each pulse for all whose dwell may have it. Angles off a direction come from the
sine of their difference, t = sin(a - b), as asin(t) = t P(t^2) with a polynomial for the width of the beam or of the
elevation pattern; angles beyond are of pixels that are not lit, or have the pattern's value at its end.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit, types

from blocksar.arrays import BoolArray, FloatArray, IntArray
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import FLAT, Taper
from blocksar.constants import TURN
from blocksar.kernels.lanes import fit_even
from blocksar.kernels.loops import COMPILED, PART, REAL_ROW, REAL_ROWS, UNCHECKED, fixed, loop, record
from blocksar.kernels.projection import LitPixels

TOGETHER = 32  # pixels of a row
DEGREE = 12  # of P: 2e-12 rad for angles up to WIDEST
LEAST, WIDEST = 0.3, 0.8  # rad off a direction that P serves at least; arc sines of larger ones are computed singly
# Smallest mean of the pattern in elevation over the lit pulses of a pixel, relative to the pattern's peak, of a pixel
# in the image; others are NaN with every processor: they would show their neighbours' side lobes and noise, divided by
# almost nothing.
LEAST_ELEVATION = 0.01  # two-way amplitude: -40 dB
ELEVATIONS = 16  # pulses of a dwell at which the pattern in elevation is looked up for its mean
EVEN = 1e-9  # of the spacing of a pattern's angles, by which they may differ from even ones
_PULSES = types.Array(types.int64, 2, "C", readonly=True)
_PASSES = types.Array(types.int64, 3, "C", readonly=True)
_C0, _C1, _C2, _C3, _C4, _C5, _C6, _C7, _C8 = fit_even(lambda x: np.cos(np.pi * x), 8)


class _Cut(NamedTuple):
    """Pattern along one angle, as tables for compiled loops.

    Attributes
    ----------
    angles, values : (n,) float
        rad, and amplitudes; one for none.
    per_step : float
        Samples a rad where the angles are even, else 0.
    series : (DEGREE + 1,) float
        P; empty where the angles are too large for it.
    limit : float
        Sine of the largest angle that P serves, or 1; sines beyond are taken for it.
    """

    angles: FloatArray
    values: FloatArray
    per_step: float
    series: FloatArray
    limit: float

    @classmethod
    def of(cls, angles: FloatArray | None, values: FloatArray | None, most: float) -> _Cut:
        """Prepare a pattern for angles up to `most`, rad, from its direction; `values` is None without a pattern."""
        most = max(float(most), LEAST)
        series, limit = (_arc_sine(most), float(np.sin(most))) if most <= WIDEST else (np.zeros(0), 1.0)
        if angles is None or values is None:
            return cls(fixed(np.zeros(1)), fixed(np.ones(1)), 0.0, fixed(series), limit)
        step = (angles[-1] - angles[0]) / (angles.size - 1)
        uneven = np.abs(angles - (angles[0] + step * np.arange(angles.size))).max() > EVEN * step
        per_step = 0.0 if uneven else float(1 / step)
        return cls(fixed(np.array(angles)), fixed(np.array(values)), per_step, fixed(series), limit)


@lru_cache(maxsize=8)
def _arc_sine(most: float) -> FloatArray:
    """P (DEGREE + 1,) with asin(t) = t P(t^2) for |asin(t)| <= most; read-only."""
    ratio = fit_even(lambda t: np.where(t > 1e-6, np.arcsin(t) / np.maximum(t, 1e-6), 1.0), DEGREE, np.sin(most))
    return fixed(np.array(ratio))


def add_gains(
    total: FloatArray,
    geometry: Geometry,
    pixels: LitPixels,
    *,
    pulses: slice,
    valid: IntArray | FloatArray,
    taper: Taper = FLAT,
) -> None:
    """Add valid[p] w(pixel, p) g(pixel, p) over the lit pulses of a block, in place.

    w and g are those of `Beam.weights` and `Beam.gain`.

    Parameters
    ----------
    total : (n_row, n_column) float
    pixels : LitPixels
        (n_row, n_column)
    pulses : slice
        The block.
    valid : (n,) int or float
        Number of valid samples of each pulse of the block, or the sum of their weights.
    taper : Taper
        Weighting over a steered beam.
    """
    x, y, z, first, last = pixels
    # Copies: the loop is compiled for one layout of its arrays.
    lit = [np.array(values, np.int64, order="C") for values in (first, last)]
    sums = np.array(total, order="C")
    _add_gains(sums, _Places.of(geometry, x, y, z), *lit, _Patterns.of(geometry, pulses, valid, taper), pulses.start)
    total[...] = sums


class ElevationMeans(NamedTuple):
    """Mean elevation patterns (n_row, n_column) over the lit pulses of pixels; 0 if never lit.

    Attributes
    ----------
    plain : float
        With equal weights.
    weighed : float
        With weights valid[p] w(pixel, p) b(pixel, p), where b is the pattern over the beam; `plain` where these vanish.
    tilt : float
        Mean place in the dwell, from -1 at its begin to 1 at its end, under these weights times the pattern in
        elevation, less that without.
    """

    plain: FloatArray
    weighed: FloatArray
    tilt: FloatArray

    def dark(self, geometry: Geometry) -> BoolArray:
        """Mask of pixels that are too dark for an image (`LEAST_ELEVATION`), or never lit."""
        pattern = geometry.collection.elevation_pattern
        assert pattern is not None
        return np.asarray(~(self.plain >= LEAST_ELEVATION * float(pattern.max())))


def mean_elevations(
    geometry: Geometry,
    x: FloatArray,
    y: FloatArray,
    z: FloatArray,
    *,
    passes: tuple[IntArray, IntArray] | None = None,
    valid: FloatArray | None = None,
    taper: Taper = FLAT,
) -> ElevationMeans:
    """Means of the pattern in elevation at ELEVATIONS pulses that divide each pixel's lit pulses evenly.

    Parameters
    ----------
    geometry : Geometry
        With a pattern in elevation.
    x, y, z : (n_row, n_column) float
        m, scene frame; finite.
    passes : pair of (n_pass, n_row, n_column) int, optional
        The pulses first <= p < last that light each pixel, as from `Beam.passes`; None: all pulses.
    valid : (n_pulse,) float, optional
        The fraction of each pulse's samples that is there; None: all of them.
    taper : Taper
        Weighting over the beam; over the pulses where it is not steered.
    """
    n = geometry.collection.n_pulse
    valid = np.ones(n) if valid is None else valid
    if not (geometry.collection.steered or taper.uniform):
        valid, taper = valid * taper.on(geometry.collection.time, geometry.collection.pulses), FLAT
    if passes is None:
        passes = np.zeros((1, *x.shape), np.int64), np.full((1, *x.shape), n)
    lit = [np.array(values, np.int64, order="C") for values in passes]
    means = ElevationMeans(*np.empty((3, *x.shape)))
    _mean_elevations(means, _Places.of(geometry, x, y, z), *lit, _Patterns.of(geometry, slice(0, n), valid, taper))
    return means


class _Places(NamedTuple):
    """Positions of pixels (n_row, n_column), m, and their yaws, rad, or 0 for beams that do not use these."""

    x: FloatArray
    y: FloatArray
    z: FloatArray
    yaw: FloatArray

    @classmethod
    def of(cls, geometry: Geometry, x: FloatArray, y: FloatArray, z: FloatArray) -> _Places:
        yaw = geometry.yaw(x, y) if geometry.beam.by_yaw else np.zeros(np.shape(x))
        return cls(*(fixed(np.array(values, order="C")) for values in (x, y, z, yaw)))


class _Patterns(NamedTuple):
    """Tables of the patterns, the weighting, and n pulses for the compiled loops.

    Attributes
    ----------
    beam : (n, 10) float
        Of each pulse the antenna's place, the beam's axis, cosine and sine of its steering, its
        azimuth, and the number of valid samples.
    has_axis : bool
        Whether the beam is described by its axis, and not by yaws.
    across, down : _Cut
        The pattern over the beam and that in elevation.
    middle : float
        Of the elevations, rad.
    terms, per_rad : (n_term,) float, float
        The weighting's series, and its cycles a rad off the beam's centre.
    """

    beam: FloatArray
    has_axis: bool
    across: _Cut
    down: _Cut
    middle: float
    terms: FloatArray
    per_rad: float

    @classmethod
    def of(cls, geometry: Geometry, pulses: slice, valid: IntArray | FloatArray, taper: Taper) -> _Patterns:
        collection, n = geometry.collection, pulses.stop - pulses.start
        azimuth, axis, steering = np.zeros(n), np.zeros((n, 3)), np.zeros(n)
        if collection.beam_axis is not None and collection.beam_steering is not None:
            axis, steering = collection.beam_axis[pulses], collection.beam_steering[pulses]
        elif collection.steered:
            azimuth = collection.beam_azimuth[pulses]
        width = collection.beam_width or np.inf
        lowest, highest = (0.0, 0.0) if collection.elevation is None else collection.elevation[[0, -1]].tolist()
        middle = (lowest + highest) / 2
        position, valid = collection.antenna_position[pulses], np.array(valid, np.float64)
        beam = [position, axis, np.cos(steering), np.sin(steering), azimuth, valid]
        terms, frequency = taper.series
        return cls(
            fixed(np.ascontiguousarray(np.column_stack(beam))), collection.has_axis,
            _Cut.of(collection.beam_offset, collection.beam_pattern, width / 2),
            _Cut.of(collection.elevation, collection.elevation_pattern, highest - middle),
            middle, fixed(np.array(terms)), float(frequency / width),
        )  # fmt: skip


_PLACES, _MEANS = record(_Places, *[REAL_ROWS] * 4), record(ElevationMeans, *[types.float64[:, ::1]] * 3)
_CUT = record(_Cut, REAL_ROW, REAL_ROW, types.float64, REAL_ROW, types.float64)
_PATTERNS = record(_Patterns, REAL_ROWS, types.boolean, _CUT, _CUT, types.float64, REAL_ROW, types.float64)


@njit(**PART, **COMPILED, **UNCHECKED)
def _angles(sines: FloatArray, cut: _Cut, n: int) -> None:
    """Arc sines of n values in place; NaN and values beyond the limit are set to the limit."""
    series, limit = cut.series, cut.limit
    for k in range(n):
        t = sines[k] if sines[k] < limit else limit
        sines[k] = t if t > -limit else -limit
    if series.size == 0:
        for k in range(n):
            sines[k] = np.arcsin(sines[k])
        return
    p0, p1, p2, p3, p4, p5, p6 = series[0], series[1], series[2], series[3], series[4], series[5], series[6]
    p7, p8, p9, p10, p11, p12 = series[7], series[8], series[9], series[10], series[11], series[12]
    for k in range(n):
        t = sines[k]
        w = t * t
        high = p6 + w * (p7 + w * (p8 + w * (p9 + w * (p10 + w * (p11 + w * p12)))))
        sines[k] = t * (p0 + w * (p1 + w * (p2 + w * (p3 + w * (p4 + w * (p5 + w * high))))))


@njit(**PART, **COMPILED, **UNCHECKED)
def _multiply(gain: FloatArray, angle: FloatArray, n: int, cut: _Cut) -> None:
    """gain *= the pattern at n angles, linear between its samples and constant beyond the ends, as `np.interp`."""
    angles, values, per_step = cut.angles, cut.values, cut.per_step
    last = values.size - 2
    if per_step > 0:
        for k in range(n):
            place = min(max((angle[k] - angles[0]) * per_step, 0.0), last + 1.0)
            i = np.uint64(min(int(place), last))
            part = place - i
            gain[k] *= values[i] + part * (values[i + np.uint64(1)] - values[i])
        return
    for k in range(n):
        before, after = 0, last + 1  # bisected by hand: to load `searchsorted` takes longer than a plan
        while after - before > 1:
            between = (before + after) // 2
            before, after = (between, after) if angles[between] <= angle[k] else (before, between)
        part = min(max((angle[k] - angles[before]) / (angles[before + 1] - angles[before]), 0.0), 1.0)
        gain[k] *= values[before] + part * (values[before + 1] - values[before])


@njit(**PART, **COMPILED, **UNCHECKED)
def _weigh(gain: FloatArray, angle: FloatArray, n: int, terms: FloatArray, per_rad: float, work: FloatArray) -> None:
    """gain *= sum_k terms_k cos(2 pi k per_rad angle), by Clenshaw's recurrence; at most half a cycle from 0."""
    cosine, weight, after = work[0], work[1], work[2]
    for k in range(n):
        turn = min(max(angle[k] * per_rad, -0.5), 0.5)
        w = turn * turn
        high = _C4 + w * (_C5 + w * (_C6 + w * (_C7 + w * _C8)))
        half = _C0 + w * (_C1 + w * (_C2 + w * (_C3 + w * high)))
        cosine[k], weight[k], after[k] = 2.0 * half * half - 1.0, 0.0, 0.0
    for m in range(terms.size - 1):
        term = terms[terms.size - 1 - m]
        for k in range(n):
            here = term + 2.0 * cosine[k] * weight[k] - after[k]
            after[k], weight[k] = weight[k], here
    for k in range(n):
        gain[k] *= terms[0] + cosine[k] * weight[k] - after[k]


@loop(types.float64[:, ::1], _PLACES, _PULSES, _PULSES, _PATTERNS, types.int64, **COMPILED, **UNCHECKED)
def _add_gains(
    total: FloatArray, places: _Places, first: IntArray, last: IntArray, patterns: _Patterns, start: int
) -> None:
    """Add up the sums of `add_gains`."""
    (x, y, z, yaw), (beam, has_axis, across_beam, down, middle, terms, per_rad) = places, patterns
    has_pattern, n_pulse = across_beam.values.size > 1, beam.shape[0]
    weighed = has_pattern or terms.size > 1
    cos_middle, sin_middle = np.cos(middle), np.sin(middle)
    angle, gain, work = np.empty(TOGETHER), np.empty(TOGETHER), np.empty((3, TOGETHER))
    for row in range(x.shape[0]):
        for begin in range(0, x.shape[1], TOGETHER):
            n = min(TOGETHER, x.shape[1] - begin)
            low, high = n_pulse, 0
            for k in range(n):
                if first[row, begin + k] < last[row, begin + k]:
                    low, high = min(low, first[row, begin + k] - start), max(high, last[row, begin + k] - start)
            for p in range(max(low, 0), min(high, n_pulse)):
                px, py, pz = beam[p, 0], beam[p, 1], beam[p, 2]
                for k in range(n):
                    gain[k] = 1.0
                if weighed and has_axis:
                    ax, ay, az, cos, sin = beam[p, 3], beam[p, 4], beam[p, 5], beam[p, 6], beam[p, 7]
                    for k in range(n):
                        at = np.uint64(begin + k)
                        dx, dy, height = x[row, at] - px, y[row, at] - py, pz - z[row, at]
                        s = (dx * ax + dy * ay - height * az) / np.sqrt(dx * dx + dy * dy + height * height)
                        angle[k] = s * cos - np.sqrt(max(1.0 - s * s, 0.0)) * sin
                    _angles(angle, across_beam, n)
                elif weighed:
                    for k in range(n):
                        offset = yaw[row, np.uint64(begin + k)] - beam[p, 8]
                        angle[k] = offset - TURN * np.rint(offset / TURN)
                if has_pattern:
                    _multiply(gain, angle, n, across_beam)
                if terms.size > 1:
                    _weigh(gain, angle, n, terms, per_rad, work)
                if down.values.size > 1:
                    for k in range(n):
                        at = np.uint64(begin + k)
                        dx, dy, height = x[row, at] - px, y[row, at] - py, pz - z[row, at]
                        ground = dx * dx + dy * dy
                        across = height * cos_middle - np.sqrt(ground) * sin_middle
                        angle[k] = across / np.sqrt(ground + height * height)
                    _angles(angle, down, n)
                    for k in range(n):
                        angle[k] += middle
                    _multiply(gain, angle, n, down)
                valid, q = beam[p, 9], p + start
                for k in range(n):
                    at = np.uint64(begin + k)
                    lit = first[row, at] <= q < last[row, at]
                    total[row, at] += valid * gain[k] if lit else 0.0


@njit(**PART, **COMPILED, **UNCHECKED)
def _choose_pulses(firsts, lasts, row: int, begin: int, n: int, share: float, pulses: IntArray) -> None:  # type: ignore[no-untyped-def]
    """Pulse at a share, 0 .. 1, of the lit pulses of n pixels from `begin` on; -1 if a pixel is not lit."""
    for k in range(n):
        number = 0
        for m in range(firsts.shape[0]):
            number += lasts[m, row, begin + k] - firsts[m, row, begin + k]
        place = int(share * number)
        pulses[k] = -1
        for m in range(firsts.shape[0]):
            first, length = firsts[m, row, begin + k], lasts[m, row, begin + k] - firsts[m, row, begin + k]
            if 0 <= place < length:
                pulses[k] = first + place
            place -= length


@loop(_MEANS, _PLACES, _PASSES, _PASSES, _PATTERNS, **COMPILED, **UNCHECKED)
def _mean_elevations(
    means: ElevationMeans, places: _Places, firsts: IntArray, lasts: IntArray, patterns: _Patterns
) -> None:
    """Compute the means of `mean_elevations`."""
    (x, y, z, yaw), (beam, has_axis, across_beam, down, middle, terms, per_rad) = places, patterns
    plain, weighed, tilt = means
    has_pattern = across_beam.values.size > 1
    by_place, cos_middle, sin_middle = has_pattern or terms.size > 1, np.cos(middle), np.sin(middle)
    pulses, rows = np.empty(TOGETHER, np.int64), np.empty((3, TOGETHER))
    angle, weight, gain = rows[0], rows[1], rows[2]
    sums, work = np.empty((5, TOGETHER)), np.empty((3, TOGETHER))
    for row in range(x.shape[0]):
        for begin in range(0, x.shape[1], TOGETHER):
            n = min(TOGETHER, x.shape[1] - begin)
            sums[:] = 0.0
            for node in range(ELEVATIONS):
                _choose_pulses(firsts, lasts, row, begin, n, (node + 0.5) / ELEVATIONS, pulses)
                for k in range(n):
                    p, at = max(pulses[k], 0), begin + k
                    dx, dy, height = x[row, at] - beam[p, 0], y[row, at] - beam[p, 1], beam[p, 2] - z[row, at]
                    ground = dx * dx + dy * dy
                    across = height * cos_middle - np.sqrt(ground) * sin_middle
                    angle[k], gain[k] = across / np.sqrt(ground + height * height), 1.0
                    weight[k] = 0.0 if pulses[k] < 0 else beam[p, 9]
                _angles(angle, down, n)
                for k in range(n):
                    angle[k] += middle
                _multiply(gain, angle, n, down)
                if by_place:
                    for k in range(n):
                        p, at = max(pulses[k], 0), begin + k
                        dx, dy, height = x[row, at] - beam[p, 0], y[row, at] - beam[p, 1], beam[p, 2] - z[row, at]
                        if has_axis:
                            s = dx * beam[p, 3] + dy * beam[p, 4] - height * beam[p, 5]
                            s /= np.sqrt(dx * dx + dy * dy + height * height)
                            angle[k] = s * beam[p, 6] - np.sqrt(max(1.0 - s * s, 0.0)) * beam[p, 7]
                        else:
                            offset = yaw[row, at] - beam[p, 8]
                            angle[k] = offset - TURN * np.rint(offset / TURN)
                    if has_axis:
                        _angles(angle, across_beam, n)
                    if has_pattern:
                        _multiply(weight, angle, n, across_beam)
                    if terms.size > 1:
                        _weigh(weight, angle, n, terms, per_rad, work)
                place = 2 * (node + 0.5) / ELEVATIONS - 1
                for k in range(n):
                    sums[0, k] += 0.0 if pulses[k] < 0 else gain[k]
                    sums[1, k] += weight[k]
                    sums[2, k] += weight[k] * gain[k]
                    sums[3, k] += weight[k] * place
                    sums[4, k] += weight[k] * gain[k] * place
            for k in range(n):
                at, mean, alone, both = begin + k, sums[0, k] / ELEVATIONS, sums[1, k], sums[2, k]
                plain[row, at], weighed[row, at] = mean, both / alone if alone > 0 else mean
                tilt[row, at] = sums[4, k] / both - sums[3, k] / alone if both > 0 else 0.0
