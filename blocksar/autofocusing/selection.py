"""Prominent points: places whose power stands out in images of short apertures.

A short aperture has so coarse a resolution that the track's error does not blur it. Its deramped lines, over all
ranges and a few yaws, are transformed along slow time: a coarse image of all that the beam lights.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blocksar import texts
from blocksar.arrays import ComplexArray, FloatArray, IntArray
from blocksar.autofocusing.range_lines import range_profiles, take_lines, taps
from blocksar.autofocusing.work import Work
from blocksar.errors import InputError
from blocksar.kernels.fourier import fft_rows
from blocksar.kernels.groups import row_groups, run_groups
from blocksar.solvers import newton

RANGE_STEP = 0.75  # range cells between lines
DOPPLER_SHARE = 0.8  # of the PRF that lines about one yaw may fill
CELLS = (6, 8)  # parts of a coarse image along range and Doppler; its brightest sample in each may become a point
SIDELOBES = 1e-4  # of the brightest sample's power: fainter ones may be its side lobes
RANGE_SIDELOBES = 2.0  # times those of a band without a taper: fainter samples may be side lobes of brighter ones
MAIN_LOBE = 2.0  # Doppler cells of a short aperture: within them a sample has its sidelobes in range
FALSE = 0.01  # maxima of noise that may be taken for points that stand out of it, in all of a search
STEPS = 3  # of Newton's method, from the plane to a place on it
UNEVEN_STEPS = 12  # to one on a terrain, whose slopes change
YAWS = 65  # at which the beam's edges are looked for
NEAR = 2.5  # range cells, and Doppler cells of a short aperture, within which candidates are the same point
APART = 0.5  # of the width of a chip, narrowed in Doppler: closer points carry the same information
REGIONS = (4, 8)  # parts of the scene in range and yaw
CAP = 2.0  # times the even share: points of one part, at most
ACROSS = 12  # points that see both sides of a gap, if available: only they determine how the sides fit
BESIDE = 1 / 16  # of a dwell: that they see on either side, at least


@dataclass(frozen=True, kw_only=True, eq=False)
class Bright:
    """Bright samples of a coarse image.

    Attributes
    ----------
    x, y, prominence : (n,) float
        As of `Candidates`; NaN where a terrain has no such place.
    power : (n,) float
        Of the sample.
    distance, rate : (n,) float
        Range, m, and phase rate of it, rad/s, in the middle of the aperture.
    """

    x: FloatArray
    y: FloatArray
    prominence: FloatArray
    power: FloatArray
    distance: FloatArray
    rate: FloatArray


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidates:
    """Bright places in the image of one short aperture.

    Attributes
    ----------
    x, y : (n,) float
        m, scene frame; of points on the ground.
    prominence : (n,) float
        Power over the median of its surroundings.
    middle : (1,) or (0,) float
        Pulse in the middle of the aperture; none where all its samples are missing.
    seen : (2,) or (0,) int
        Pulses of the aperture that have samples: first <= p < last.
    cells : (1,) or (0,) int
        Samples of the coarse images that were looked through.
    """

    x: FloatArray
    y: FloatArray
    prominence: FloatArray
    middle: FloatArray
    seen: IntArray
    cells: IntArray


@dataclass(frozen=True, kw_only=True, eq=False)
class Points:
    """The selected points.

    Attributes
    ----------
    x, y, z : (n,) float
        m, scene frame.
    first, last : (n,) int
        Pulses that light them: first <= p < last.
    distinct : (n,) bool
        Whether they stand out of noise, and of clutter of many scatterers a coarse cell, of which others may be maxima;
        see `stands_out`. Empty for points that were not searched for.
    """

    x: FloatArray
    y: FloatArray
    z: FloatArray
    first: IntArray
    last: IntArray
    distinct: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))


class Refused(InputError):
    """Error: the samples do not determine the track's error; the sentence has the figures."""


def find_candidates(signal: ComplexArray, work: Work, pulses: slice, threads: int = 1) -> Candidates:
    """Find the brightest places in the coarse image of a short aperture.

    Parameters
    ----------
    signal : (n, n_range_frequency) complex64
        Samples of these pulses.
    work : Work
    pulses : slice
        One of `work.apertures`.
    """
    collection = work.geometry.collection
    there = np.flatnonzero(~np.isnan(signal).all(axis=1))
    middle = np.full(min(there.size, 1), (pulses.start + pulses.stop) / 2)
    seen = pulses.start + (there[[0, -1]] + np.array([0, 1]) if there.size else there)
    yaws = _lit_yaws(work, pulses)
    if yaws is None:
        none = np.empty(0)
        return Candidates(x=none, y=none, prominence=none, middle=middle, seen=seen, cells=np.empty(0, np.int64))
    low, high = yaws
    near, far = work.region.limits(low, high)
    ranges = np.arange(near, far, RANGE_STEP * work.cell)
    ends = work.plane.ground_point(np.full(2, (near + far) / 2), np.array([low, high]))
    doppler = [_seen(work, ends, at)[1] for at in (pulses.start, pulses.stop - 1)]
    span = float(max(np.ptp(d) for d in doppler)) / 2 / np.pi
    seconds = (pulses.stop - pulses.start) * collection.pulse_interval
    widest = min(DOPPLER_SHARE * collection.prf, work.wavenumber / np.pi * work.cell / seconds)
    count = max(math.ceil(span / widest), 1)
    edges = np.linspace(low, high, count + 1)
    profiles = range_profiles(signal, collection, threads)
    found, cells = [], 0
    for k in range(count):
        yaw = (edges[k] + edges[k + 1]) / 2
        ground = work.plane.ground_point(ranges, np.full(ranges.size, yaw))
        power = _coarse_image(work, pulses, profiles.values, profiles.spacing, ground, threads)
        found.append(_brightest(work, pulses, power, ground, span / count))
        cells += power.size
    bright = Bright(**{name: np.concatenate([getattr(b, name) for b in found]) for name in vars(found[0])})
    good = np.isfinite(bright.x) & ~_range_sidelobes(bright, work, pulses)
    return Candidates(
        x=bright.x[good], y=bright.y[good], prominence=bright.prominence[good], middle=middle, seen=seen,
        cells=np.array([cells]),
    )  # fmt: skip


def _lit_yaws(work: Work, pulses: slice) -> tuple[float, float] | None:
    """First and last yaw of the region that the middle one of some pulses lights, rad."""
    yaw = np.linspace(work.region.yaw[0], work.region.yaw[-1], YAWS * 8 if work.geometry.collection.steered else 2)
    near, far = work.region.at(yaw)
    x, y = work.plane.ground_axes(np.stack([near, (near + far) / 2, far]), yaw)
    middle = (pulses.start + pulses.stop) // 2
    lit = np.flatnonzero(work.plane.beam.is_lit(x, y, slice(middle, middle + 1))[..., 0].any(axis=0))
    return (float(yaw[lit[0]]), float(yaw[lit[-1]])) if lit.size > 1 else None


def _seen(work: Work, point: FloatArray, pulse: int) -> tuple[FloatArray, FloatArray]:
    """Range of points (n, 3) at a pulse, m, and rate of their phase, rad/s."""
    collection = work.geometry.collection
    pulse = min(max(pulse, 1), collection.n_pulse - 2)
    distance = [_distance(work, point, slice(p, p + 1))[:, 0] for p in (pulse - 1, pulse, pulse + 1)]
    return distance[1], work.wavenumber * (distance[2] - distance[0]) / (2 * collection.pulse_interval)


def _distance(work: Work, point: FloatArray, pulses: slice) -> FloatArray:
    """Range (n, n_pulse) of points (n, 3), m."""
    position, (x, y, z) = work.geometry.collection.antenna_position[pulses], point.T[..., None]
    return np.asarray(np.sqrt((position[:, 0] - x) ** 2 + (position[:, 1] - y) ** 2 + (position[:, 2] - z) ** 2))


def _coarse_image(
    work: Work, pulses: slice, profiles: ComplexArray, spacing: float, ground: FloatArray, threads: int
) -> FloatArray:
    """Power (n_range, n) over Doppler relative to that of ground points (n_range, 3), one for each range."""
    n = pulses.stop - pulses.start
    power, window = np.zeros((ground.shape[0], n)), np.hanning(n + 2)[1:-1].astype(np.float32)
    reference = work.geometry.collection.reference_range[pulses]

    def one(rows: slice) -> None:
        held = _distance(work, ground[rows], pulses) - reference
        lines = np.empty(held.shape, np.complex64)
        take_lines(profiles, held / spacing, held * (work.wavenumber / (2 * np.pi)), taps(), lines)
        lines *= window
        power[rows] = np.abs(fft_rows(lines, inverse=False)) ** 2

    run_groups(one, row_groups(0, ground.shape[0], 4 * n), threads)
    return power


def _range_sidelobes(bright: Bright, work: Work, pulses: slice) -> NDArray[np.bool_]:
    """Mask of bright samples (n,) that may be range side lobes of brighter ones of the same Doppler."""
    n = work.geometry.collection.n_range_frequency
    cells = np.abs(bright.distance[:, None] - bright.distance) / work.cell
    apart = np.abs(bright.rate[:, None] - bright.rate) / (2 * np.pi) / _doppler_cell(work, pulses)
    with np.errstate(divide="ignore"):
        level = RANGE_SIDELOBES / (n * np.sin(np.pi * cells / n)) ** 2
    level[(cells < 1) | (apart > MAIN_LOBE)] = 0
    return np.asarray((bright.power[:, None] < level * bright.power).any(axis=1))


def _doppler_cell(work: Work, pulses: slice) -> float:
    """Doppler between samples of a coarse image, Hz."""
    return work.geometry.collection.prf / (pulses.stop - pulses.start)


def _brightest(work: Work, pulses: slice, power: FloatArray, ground: FloatArray, span: float) -> Bright:
    """Find the brightest sample in each part of a coarse image whose Doppler spans +- span / 2, Hz."""
    n = power.shape[1]
    step = _doppler_cell(work, pulses)
    reach = min(int(span / 2 / step) + 1, (n - 1) // 2)
    shifts = np.arange(-reach, reach + 1)
    power = power[:, shifts % n]
    rows, columns, prominence, brightest = [], [], [], []
    floor = SIDELOBES * float(power.max())
    for part in np.array_split(np.arange(power.shape[0]), min(CELLS[0], power.shape[0])):
        for cut in np.array_split(np.arange(shifts.size), min(CELLS[1], shifts.size)):
            values = power[part[0] : part[-1] + 1, cut[0] : cut[-1] + 1]
            typical = max(float(np.median(values)), floor)
            row, column = np.unravel_index(int(np.argmax(values)), values.shape)
            if typical > 0:
                rows.append(part[0] + row)
                columns.append(shifts[cut[0] + column])
                prominence.append(float(values[row, column]) / typical)
                brightest.append(float(values[row, column]))
    x, y = ground[np.array(rows, np.int64), :2].T
    distance, there = _seen(work, work.plane.on_ground(x, y), (pulses.start + pulses.stop) // 2)
    rate = there - np.array(columns) * step * 2 * np.pi
    x, y = _located(work, pulses, x, y, distance, rate)
    return Bright(x=x, y=y, prominence=np.array(prominence), power=np.array(brightest), distance=distance, rate=rate)


def _located(
    work: Work, pulses: slice, x: FloatArray, y: FloatArray, wanted: FloatArray, goal: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Solve for ground points (n,) with ranges `wanted`, m, and phase rates `goal`, rad/s, from points nearby.

    On a terrain they stand on it, and are NaN where it has none such.
    """
    middle = (pulses.start + pulses.stop) // 2
    uneven = work.geometry.terrain is not None

    def seen(at: FloatArray) -> FloatArray:
        return np.stack(_seen(work, work.geometry.on_ground(at[0], at[1]), middle))

    at = np.stack([x, y])
    x, y = newton(seen, np.stack([wanted, goal]), at, steps=UNEVEN_STEPS if uneven else STEPS)
    if uneven:
        x = np.where(np.abs(wanted - seen(np.stack([x, y]))[0]) < work.cell, x, np.nan)  # steep slopes: not found
    return x, y


class Chosen(NamedTuple):
    """The channel that determines the track best, by its number, and its points."""

    channel: int
    points: Points


def select_points(channels: Sequence[Sequence[Candidates]], work: Work) -> Chosen:
    """Select the points that stand out in most of the short apertures that see them, spread over the scene.

    Of several channels, which have one track, those of the one whose points tell most of it: the sum of their scores,
    the logarithm of their power over that of their surroundings. It is what points that err independently tell of a
    phase, in nats; a single bright one does not decide it. Of equals, the first.

    Parameters
    ----------
    channels : sequence of sequences of Candidates
        Of each channel, those of `work.apertures`, in their order.

    Raises
    ------
    Refused
        If no channel has as many as `EstimatorSettings.least_points`.
    """
    places, totals = [], []
    for candidates in channels:
        x, y, prominence = (np.concatenate([getattr(c, name) for c in candidates]) for name in ("x", "y", "prominence"))
        middles = np.concatenate([c.middle for c in candidates])
        gaps = gaps_between([c.seen for c in candidates], work)
        selected, score = best_points(x, y, prominence, middles, gaps, work) if x.size else ([], np.zeros(0))
        distinct = stands_out(prominence[selected], int(sum(c.cells.sum() for c in candidates)))
        places.append((x[selected], y[selected], distinct))
        totals.append(float(score[selected].sum()) if len(selected) >= work.settings.least_points else -1.0)
    if max(totals) < 0:
        most = max(x.size for x, _, _ in places)
        of = "" if len(channels) == 1 else ", in the channel that has most of them"
        raise Refused(
            f"the scene has {texts.count(most, 'prominent point')}{of}, but the track's error is told from at least "
            f"{work.settings.least_points}; give a larger --grid, or focus the phase history as it is"
        )
    channel = totals.index(max(totals))
    x, y, distinct = places[channel]
    first, last = work.geometry.beam.longest_pass(x, y)
    z = np.broadcast_to(work.geometry.height(x, y), x.shape).copy()
    return Chosen(channel, Points(x=x, y=y, z=z, first=first, last=last, distinct=distinct))


def stands_out(prominence: FloatArray, cells: int) -> NDArray[np.bool_]:
    """Mask of prominences (n,) too high for noise: with probability FALSE, noise exceeds it in any of `cells`.

    The power of a cell of noise is distributed exponentially: with probability 2^-p it is over p times its median. So
    is that of clutter of many scatterers a cell.
    """
    return np.asarray(prominence > math.log2(max(cells, 1) / FALSE))


def gaps_between(seen: Sequence[IntArray], work: Work) -> list[slice]:
    """Find gaps, as slices of pulses, from the valid pulses of each short aperture (`Candidates.seen`)."""
    missing = np.zeros(work.geometry.collection.n_pulse, bool)
    for aperture, pulses in zip(work.apertures, seen, strict=True):
        missing[aperture] = True
        missing[slice(*pulses) if pulses.size else slice(0)] = False
    there = [(int(first), int(last)) for first, last in sorted(tuple(p) for p in seen if p.size)]
    between = [slice(a[1], b[0]) for a, b in pairwise(there)]
    return [gap for gap in between if missing[gap].any()]


def best_points(
    x: FloatArray, y: FloatArray, prominence: FloatArray, middles: FloatArray, gaps: Sequence[slice], work: Work
) -> tuple[list[int], FloatArray]:
    """Indices of the selected candidates, and scores of all; repeated sightings of one point add to its score.

    The score is a mean over the short apertures that light the point; those in a gap, not among `middles`, see nothing.
    """
    epoch, yaw = work.geometry.epoch_range(x, y), work.geometry.yaw(x, y)
    cell_range, cell_yaw = work.cell, _yaw_cell(work)
    first, last = work.geometry.beam.longest_pass(x, y)
    centres = np.sort(middles)
    seen_by = np.searchsorted(centres, last) - np.searchsorted(centres, first)
    order = np.argsort(-prominence, kind="stable")
    taken, score = np.zeros(x.size, bool), np.zeros(x.size)
    for i in order:
        if taken[i]:
            continue
        same = (np.abs(epoch - epoch[i]) < NEAR * cell_range) & (np.abs(yaw - yaw[i]) < NEAR * cell_yaw) & ~taken
        taken |= same
        score[i] = np.log(np.maximum(prominence[same], 1)).sum() / max(int(seen_by[i]), 1)
    score = np.where(last - first >= work.dwell // 4, score, 0.0)
    selected = _spread(score, epoch, yaw, work, cell_yaw)
    for gap in gaps:
        both = np.minimum(gap.start - first, last - gap.stop) >= BESIDE * work.dwell
        if both[selected].sum() < ACROSS:
            across = _spread(np.where(both, score, 0.0), epoch, yaw, work, cell_yaw)[:ACROSS]
            selected = _spread(score, epoch, yaw, work, cell_yaw, across)
    return selected, score


def _yaw_cell(work: Work) -> float:
    """Yaw of a Doppler cell of a short aperture, rad."""
    yaw = np.array([-5e-5, 5e-5]) + (work.region.yaw[0] + work.region.yaw[-1]) / 2
    near, far = work.region.at(yaw)
    point = work.plane.ground_point((near + far) / 2, yaw)
    rate = _seen(work, point, work.geometry.collection.n_pulse // 2)[1]
    per_yaw = abs(float(rate[1] - rate[0])) / 1e-4 / (2 * np.pi)
    return work.geometry.collection.prf / work.short / max(per_yaw, 1e-12)


def _spread(
    score: FloatArray, epoch: FloatArray, yaw: FloatArray, work: Work, cell_yaw: float, before: Sequence[int] = ()
) -> list[int]:
    """Select the best points: apart from each other, with a cap for each part of the scene. Returns their indices.

    Those `before` come first.
    """
    settings = work.settings
    part_range = (REGIONS[0] * (epoch - epoch.min()) / max(float(np.ptp(epoch)), 1e-9)).astype(int)
    part_yaw = (REGIONS[1] * (yaw - yaw.min()) / max(float(np.ptp(yaw)), 1e-9)).astype(int)
    part = np.minimum(part_range, REGIONS[0] - 1) * REGIONS[1] + np.minimum(part_yaw, REGIONS[1] - 1)
    cap = math.ceil(CAP * settings.points / (REGIONS[0] * REGIONS[1]))
    wide = APART * settings.lines * settings.line_spacing * work.cell
    seconds = work.short * work.geometry.collection.pulse_interval
    across = APART * settings.narrow_speed * work.wavenumber / np.pi * seconds * cell_yaw
    selected = list(before)
    count = np.bincount(part[selected], minlength=REGIONS[0] * REGIONS[1])
    for i in np.argsort(-score, kind="stable"):
        if score[i] <= 0 or len(selected) == settings.points:
            break
        near = np.array(selected, np.int64)
        crowded = ((np.abs(epoch[near] - epoch[i]) < wide) & (np.abs(yaw[near] - yaw[i]) < across)).any()
        if count[part[i]] < cap and not crowded:
            selected.append(int(i))
            count[part[i]] += 1
    return selected
