"""Pulses that light a ground point: the one rule, and what follows from it.

A beam that is described by its yaw lights a point while |wrapped(yaw - beam_azimuth)| <= beam_width / 2, where yaw is
the point's angle about the platform's nadir at t = 0. A beam about the antenna's own axis (`axis_beam`) lights it while
|asin(u . beam_axis) - beam_steering| <= beam_width / 2, with u the unit vector from the antenna to the point. Points on
the very edge are lit. A collection whose beam is not steered lights every point with every pulse.

`in_beam` is the first rule for plain angles; compiled loops wrap it by `numba.njit(inline="always")`. Callers that have
positions ask `is_lit`, `lit_passes` and `dwell`; `is_lit` and `lit_passes` compare without tolerance. Callers that work
in the polar frame ask `yaw_interval`, `dwell_at` and `lit_sums`, which allow for the rounding of computed yaws
(`EDGE`). `pulse_weights` are the weights over a dwell, `pattern_gain` is the antenna's pattern.
Points x, y lie on the ground, or at heights z, m, which count under a beam about its axis and in elevation patterns.

Which of several collections, or segments of one, an image's pixel comes from: the one that saw more of its dwell.

The share of a point's dwell that a collection saw is 1 + margin / dwell, with the margin by which the dwell lies inside
the collection's time, below 0 where an end of the collection cuts it. Where several saw all of it, the one with the
larger margin counts, so that a seam runs through the middle of what they share.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from blocksar.arrays import BoolArray, FloatArray, IntArray
from blocksar.collection.axis_beam import Height, axis_dwell, axis_offset, axis_passes, axis_passing
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import FLAT, Taper
from blocksar.constants import TURN
from blocksar.errors import InputError

Angle = TypeVar("Angle", float, FloatArray)
Pulses = slice | IntArray | int

# rad; 3 micrometres at 30 km. The only tolerance, for yaws that were themselves computed from the beam's edge: they
# carry rounding errors (4e-16 at pi, 1e-14 at 100 rad, 1e-11 where coordinates are large) and still count as on it.
STILL = 1e-9  # rad: a beam that turns by less stands still
EDGE = 1e-10
CENTRE_NODES = 65  # yaws between which the centre of a beam about its axis is interpolated


# ---------------------------------------------------------------- angles

NOT_STEERED = "not steered: it lights everything all the time, so that a grid is needed"  # of a beam, for people


def wrapped(angle: Angle) -> Angle:
    """Wrap an angle to [-pi, pi], rad; exactly the input where it lies there already."""
    return angle - TURN * np.rint(angle / TURN)


def turned_near(angle: Angle, centre: float) -> Angle:
    """Turn an angle by whole circles to within pi of `centre`, rad."""
    # Not centre + wrapped(angle - centre): plans depend on this rounding, and must repeat to the bit.
    return centre + np.mod(angle - centre + np.pi, TURN) - np.pi


def in_beam(yaw: FloatArray | float, azimuth: FloatArray | float, half_width: float) -> BoolArray:
    """Whether |wrapped(yaw - azimuth)| <= half_width, for numbers or arrays (broadcast), rad.

    `wrapped` is written out, so that numba compiles this function as it is.
    """
    away = yaw - azimuth
    return np.abs(away - TURN * np.rint(away / TURN)) <= half_width


def beam_at(collection: Collection, pulses: slice) -> tuple[FloatArray, float]:
    """Azimuth of the beam's centre at some pulses (n,), and half its width, rad, as `in_beam` takes them.

    Zeros and infinity where the beam is not steered.
    """
    azimuth = collection.beam_azimuth[pulses]
    if collection.beam_width is None:
        return np.zeros(azimuth.shape), np.inf
    return azimuth, collection.beam_width / 2


# ---------------------------------------------------------------- pulses that light a point


def is_lit(
    geometry: Geometry, x: FloatArray, y: FloatArray, pulses: slice = slice(None), z: Height | None = None
) -> BoolArray:
    """Find which pulses light points x, y (...), m: (..., n_pulse)."""
    if geometry.collection.has_axis:
        px, py, pz = (np.asarray(axis)[..., None] for axis in (x, y, _height(geometry, x, y, z)))
        offset = beam_offset(geometry, px, py, pulses, pz)
        return np.asarray(np.abs(offset) <= (geometry.collection.beam_width or 0.0) / 2)
    return in_beam(geometry.yaw(x, y)[..., None], *beam_at(geometry.collection, pulses))


def lit_passes(geometry: Geometry, x: FloatArray, y: FloatArray, z: Height | None = None) -> tuple[IntArray, IntArray]:
    """The pulses first <= p < last that light each point: exactly those of `is_lit`.

    A point's lit pulses are an interval, but for a beam about its axis that turns back, leaves the point and comes to
    it again: it passes such a point several times.

    Parameters
    ----------
    geometry : Geometry
    x, y : (...) float
        m, scene frame; of one shape.
    z : (...) float, optional
        m; by default that of the ground.

    Returns
    -------
    first, last : (n_pass, ...) int
        In the order of time. Passes that a point lacks are empty, at the end of the one before; both are 0 where a
        point is never lit.

    Raises
    ------
    InputError
        If a beam that is described by its yaw scans all round.
    """
    collection, shape = geometry.collection, np.shape(x)
    if collection.has_axis:
        passes = axis_passes(collection, *_raveled(x, y, _height(geometry, x, y, z)))
        return passes[0].reshape(len(passes[0]), *shape), passes[1].reshape(len(passes[1]), *shape)
    yaw = np.asarray(geometry.yaw(np.asarray(x, np.float64), np.asarray(y, np.float64)))
    if collection.beam_width is not None:
        beam, width = collection.beam_azimuth, collection.beam_width
        scan = abs(beam[-1] - beam[0])
        if scan + width >= TURN:
            raise InputError(
                f"beam_azimuth scans {scan:.4g} rad with a beam_width of {width:.4g} rad, all round: a target would "
                "be lit twice; cut the collection"
            )
    first, last = yaw_interval(collection, yaw.ravel(), tolerance=0.0)
    never = first == last
    first[never], last[never] = 0, 0
    return first.reshape(1, *shape), last.reshape(1, *shape)


def lit_interval(geometry: Geometry, x: FloatArray, y: FloatArray) -> tuple[IntArray, IntArray]:
    """The longest of `lit_passes` of each point: first, last (...); both 0 where it is never lit."""
    passes = np.stack(lit_passes(geometry, x, y))
    longest = (passes[1] - passes[0]).argmax(axis=0)
    first, last = np.take_along_axis(passes, longest[None, None], axis=1)[:, 0]
    return first, last


# ---------------------------------------------------------------- angles off the beam's centre, weights and patterns


def beam_offset(
    geometry: Geometry, x: FloatArray, y: FloatArray, pulses: Pulses, z: Height | None = None
) -> FloatArray:
    """Angle of points x, y (m) off the beam's centre at pulses, rad; points and pulses are broadcast."""
    collection = geometry.collection
    if collection.has_axis:
        return axis_offset(collection, x, y, pulses, _height(geometry, x, y, z))
    return wrapped(geometry.yaw(x, y) - collection.beam_azimuth[pulses])


def pulse_weights(
    geometry: Geometry, x: FloatArray, y: FloatArray, pulses: Pulses, taper: Taper, z: Height | None = None
) -> FloatArray:
    """Weights w of pulses at points x, y (m); points and pulses are broadcast.

    A taper of v = 2 offset / beam_width, or of the pulse's place in the collection where the beam is not steered.
    """
    collection = geometry.collection
    if taper.uniform:
        return np.ones(())
    if collection.beam_width is None:
        return taper.samples(collection.n_pulse)[pulses]
    return taper(2 * beam_offset(geometry, x, y, pulses, z) / collection.beam_width)


def pattern_gain(
    geometry: Geometry, x: FloatArray, y: FloatArray, pulses: Pulses, z: Height | None = None
) -> FloatArray:
    """Two-way amplitude g that the antenna gives points x, y (m) at pulses; points and pulses are broadcast.

    The product of both patterns, linear between their samples; 1 where there is none.
    """
    collection = geometry.collection
    px, py, pz = np.moveaxis(collection.antenna_position[pulses], -1, 0)
    gain = np.ones(np.broadcast_shapes(np.shape(x), np.shape(px)))
    if collection.beam_offset is not None and collection.beam_pattern is not None:
        gain = np.interp(beam_offset(geometry, x, y, pulses, z), collection.beam_offset, collection.beam_pattern)
    if collection.elevation is not None and collection.elevation_pattern is not None:
        down = np.arctan2(pz - _height(geometry, x, y, z), np.sqrt((x - px) ** 2 + (y - py) ** 2))
        gain = gain * np.interp(down, collection.elevation, collection.elevation_pattern)
    return np.asarray(gain)


def dwell_weight(geometry: Geometry, x: FloatArray, y: FloatArray, time: FloatArray, taper: Taper) -> FloatArray:
    """w g of ground points x, y (m) at slow times (s): what they count in the sum to an image; broadcast."""

    def weight(geometry: Geometry, x: FloatArray, y: FloatArray, pulses: IntArray, z: Height | None) -> FloatArray:
        return pulse_weights(geometry, x, y, pulses, taper, z) * pattern_gain(geometry, x, y, pulses, z)

    return at_times(geometry, x, y, time, weight)


def at_times(
    geometry: Geometry,
    x: FloatArray,
    y: FloatArray,
    time: FloatArray,
    value: Callable[[Geometry, FloatArray, FloatArray, IntArray, Height | None], FloatArray],
    z: Height | None = None,
) -> FloatArray:
    """`value` of points and pulses, such as `beam_offset`, at slow times (s), linear between pulses; broadcast."""
    collection = geometry.collection
    position = (time - collection.time[0]) * collection.prf
    before = np.clip(np.floor(position), 0, collection.n_pulse - 2).astype(np.int64)
    part = np.clip(position - before, 0.0, 1.0)
    return np.asarray(value(geometry, x, y, before, z) * (1 - part) + value(geometry, x, y, before + 1, z) * part)


def _height(geometry: Geometry, x: FloatArray, y: FloatArray, z: Height | None) -> Height:
    """Heights z, by default those of the ground at points x, y, broadcast; one number on the plane."""
    if z is not None or geometry.terrain is None:
        return geometry.collection.ground_height if z is None else z
    return geometry.on_ground(x, y)[..., 2]


def _raveled(x: FloatArray, y: FloatArray, z: Height) -> tuple[FloatArray, FloatArray, Height]:
    """Points (n,), whose height may be one number."""
    along_x, along_y = (np.ravel(np.asarray(axis, np.float64)) for axis in (x, y))
    return along_x, along_y, np.ravel(z) if isinstance(z, np.ndarray) else z


def yaw_interval(collection: Collection, yaw: FloatArray, *, tolerance: float) -> tuple[IntArray, IntArray]:
    """first <= p < last of yaws (n,), found by bisection with the very inequality of `in_beam`; equal if never lit.

    `in_beam` wraps each difference; here the turns of all pulses are those of the sweep's middle, so that the
    differences fall (or rise) with the pulse throughout. Both give the same bits where the beam is near the point.
    """
    n = collection.n_pulse
    if collection.beam_width is None:
        return np.zeros(yaw.shape, np.int64), np.full(yaw.shape, n, np.int64)
    beam, half = collection.beam_azimuth, collection.beam_width / 2 + tolerance
    sign = 1.0 if beam[-1] >= beam[0] else -1.0
    turns = TURN * np.rint((yaw - (beam[0] + beam[-1]) / 2) / TURN)

    def ahead(points: IntArray, pulses: IntArray) -> FloatArray:
        return sign * ((yaw[points] - beam[pulses]) - turns[points])

    level = sign * (yaw - turns)
    reached = np.searchsorted(sign * beam, level - half, side="left")
    passed = np.searchsorted(sign * beam, level + half, side="right")
    first = _first_pulse(lambda points, pulses: ahead(points, pulses) <= half, reached, n)
    last = _first_pulse(lambda points, pulses: ahead(points, pulses) < -half, passed, n)
    return first, last


def _first_pulse(holds: Callable[[IntArray, IntArray], BoolArray], guess: IntArray, n: int) -> IntArray:
    """The first of n pulses from which on `holds(points, pulses)` is true, for every point; n if for none.

    `guess` (n_point,) is right but for rounding; only points for which it is wrong are bisected.
    """
    points = np.arange(guess.size)
    early = (guess > 0) & holds(points, np.maximum(guess - 1, 0))
    late = (guess < n) & ~holds(points, np.minimum(guess, n - 1))
    wrong = np.flatnonzero(early | late)
    low, high = np.zeros(wrong.size, np.int64), np.full(wrong.size, n, np.int64)
    while (low < high).any():
        middle = np.minimum((low + high) // 2, n - 1)
        true = holds(wrong, middle)
        low, high = np.where((low < high) & ~true, middle + 1, low), np.where((low < high) & true, middle, high)
    first = guess.astype(np.int64)
    first[wrong] = low
    return first


# ---------------------------------------------------------------- dwells


def aperture(collection: Collection) -> tuple[float, float]:
    """Start and end of the collection, s: a pulse stands for the half interval on either side of it."""
    half_pulse = collection.pulse_interval / 2
    return collection.time[0] - half_pulse, collection.time[-1] + half_pulse


def dwell(
    geometry: Geometry, x: FloatArray, y: FloatArray, *, z: Height | None = None, uncut: bool = False
) -> tuple[FloatArray, FloatArray]:
    """First and last lit slow time of ground points x, y (...), m: see `dwell_at`."""
    if geometry.collection.has_axis:
        return _axis_dwell(geometry, np.asarray(x), np.asarray(y), _height(geometry, x, y, z), uncut=uncut)
    return dwell_at(geometry, geometry.yaw(x, y), np.zeros(1), uncut=uncut)


def dwell_at(
    geometry: Geometry, yaw: FloatArray, epoch_range: FloatArray, *, uncut: bool = False
) -> tuple[FloatArray, FloatArray]:
    """First and last lit slow time of points at yaws (rad) and epoch ranges (m): two arrays, s; start > end if never.

    Under a beam about the antenna's axis, yaws and ranges are broadcast. Otherwise the range does not matter, and the
    arrays have the shape of `yaw`.

    With `uncut`, as if a scanning beam went on beyond the ends of the collection: as it did on average, or about its
    axis as it did there.

    These are the times at which the edges of the beam, taken as a continuous function of time, pass the point. A pulse
    stands for the half interval on either side of it, so N lit pulses dwell for N intervals, give or take one.
    """
    collection = geometry.collection
    if collection.has_axis:
        z = geometry.level(epoch_range, yaw)
        return _axis_dwell(geometry, *geometry.ground_axes(epoch_range, yaw), z, uncut=uncut)
    start, end = aperture(collection)
    yaw = np.asarray(yaw, dtype=np.float64)
    if collection.beam_width is None:
        return np.full(yaw.shape, start), np.full(yaw.shape, end)
    beam, half = collection.beam_azimuth, collection.beam_width / 2
    if abs(beam[-1] - beam[0]) < STILL:
        lit = in_beam(yaw, beam[0], half + EDGE)
        return np.where(lit, start, np.inf), np.where(lit, end, -np.inf)
    yaw = turned_near(yaw, (beam[0] + beam[-1]) / 2)
    sign = 1.0 if beam[-1] > beam[0] else -1.0

    first, last = _times_at(collection, np.stack([yaw - sign * half, yaw + sign * half]))
    return (first, last) if uncut else (np.maximum(first, start), np.minimum(last, end))


def passing_at(geometry: Geometry, yaw: FloatArray, epoch_range: FloatArray, place: float) -> FloatArray:
    """Slow time at which points are at a place in a steered beam, s: -1 where they enter, 1 where they leave it.

    Yaws (rad) and epoch ranges (m) are broadcast; as if the collection did not cut dwells.
    """
    collection = geometry.collection
    if collection.has_axis:
        x, y, z = np.broadcast_arrays(*geometry.ground_axes(epoch_range, yaw), geometry.level(epoch_range, yaw))
        return axis_passing(collection, x.ravel(), y.ravel(), place, z.ravel()).reshape(x.shape)
    beam = collection.beam_azimuth
    turned, sign = turned_near(np.asarray(yaw, np.float64), (beam[0] + beam[-1]) / 2), np.sign(beam[-1] - beam[0])
    times = _times_at(collection, turned + place * sign * (collection.beam_width or 0.0) / 2)
    return np.broadcast_to(times, np.broadcast_shapes(np.shape(yaw), np.shape(epoch_range)))


def _times_at(collection: Collection, level: FloatArray) -> FloatArray:
    """Times (...) at which a beam that scans has azimuths, rad; beyond the collection's ends as it went on average."""
    beam, time = collection.beam_azimuth, collection.time
    sign = 1.0 if beam[-1] > beam[0] else -1.0
    inside = np.interp(sign * level, beam if sign > 0 else -beam, time)
    slope = (time[-1] - time[0]) / (beam[-1] - beam[0])
    return np.asarray(inside + slope * (level - np.clip(level, min(beam[0], beam[-1]), max(beam[0], beam[-1]))))


def _axis_dwell(
    geometry: Geometry, x: FloatArray, y: FloatArray, z: Height, *, uncut: bool
) -> tuple[FloatArray, FloatArray]:
    x, y = np.broadcast_arrays(x, y)
    z = np.broadcast_to(z, x.shape) if isinstance(z, np.ndarray) else z
    first, last = axis_dwell(geometry.collection, *_raveled(x, y, z), uncut=uncut)
    return first.reshape(x.shape), last.reshape(x.shape)


def centre_yaw(
    geometry: Geometry, time: FloatArray, epoch_range: FloatArray | float, low: float, high: float
) -> FloatArray:
    """Yaw of the beam's centre at slow times (n,): the points amid their dwell. The middle if it is not steered.

    Under a beam about its axis (..., n), at epoch ranges (...), m, from `low` to `high`; also there the middle, where
    all points are lit at the same time.
    """
    collection = geometry.collection
    if not collection.steered:
        return np.full(time.size, (low + high) / 2)
    if not collection.has_axis:
        return np.interp(time, collection.time, collection.beam_azimuth)
    yaw = np.linspace(low, high, CENTRE_NODES)
    first, last = dwell_at(geometry, yaw, np.ravel(epoch_range)[:, None], uncut=True)
    rows = []
    for middle in (first + last) / 2:
        steps = np.diff(middle)
        if np.isfinite(middle).all() and ((steps > 0).all() or (steps < 0).all()):
            order = slice(None) if steps[0] > 0 else slice(None, None, -1)
            rows.append(np.interp(time, middle[order], yaw[order]))
        else:
            rows.append(np.full(time.size, (low + high) / 2))
    return np.array(rows).reshape(*np.shape(epoch_range), time.size)


def has_full_dwell(
    geometry: Geometry, x: FloatArray | float, y: FloatArray | float, z: Height | None = None
) -> BoolArray:
    """Whether the whole beam sweeps over targets at x, y (...), m, to within one pulse; true if it is not steered.

    Where the beam stands still: whether it lights them. About its axis: also where it lights them all the time. Targets
    that it leaves and comes to again have none.
    """
    collection = geometry.collection
    if collection.has_axis:
        start, end = aperture(collection)
        x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
        first, last = _axis_dwell(geometry, x, y, _height(geometry, x, y, z), uncut=True)
        whole = (first >= start - collection.pulse_interval) & (last <= end + collection.pulse_interval)
        full = np.asarray((whole & (last > first)) | ((first <= start) & (last >= end)))
        if full.any():
            some = (axis[full] for axis in np.broadcast_arrays(x, y, _height(geometry, x, y, z)))
            passes = lit_passes(geometry.lit_by(collection.steady), *some)
            full[full] = np.count_nonzero(passes[1] > passes[0], axis=0) < 2
        return full
    yaw = geometry.yaw(np.asarray(x), np.asarray(y))
    if collection.beam_width is None:
        return np.ones(yaw.shape, bool)
    beam = collection.beam_azimuth
    low, high = float(beam.min()), float(beam.max())
    if low == high:
        return in_beam(yaw, beam[0], collection.beam_width / 2 + EDGE)
    yaw = turned_near(yaw, (low + high) / 2)
    lowest, highest = full_dwell_yaw(collection)
    pulse = (high - low) / (collection.n_pulse - 1)
    return np.asarray((lowest - pulse <= yaw) & (yaw <= highest + pulse))


# ---------------------------------------------------------------- yaws


def lit_yaw(collection: Collection) -> tuple[float, float]:
    """First and last yaw that a steered beam ever lights, rad."""
    half = (collection.beam_width or 0.0) / 2
    return float(collection.beam_azimuth.min() - half), float(collection.beam_azimuth.max() + half)


def full_dwell_yaw(collection: Collection) -> tuple[float, float]:
    """First and last yaw that the whole of a steered beam sweeps over, rad.

    First > last where the beam turns by less than its width: targets between are then lit all the time.
    """
    half = (collection.beam_width or 0.0) / 2
    return float(collection.beam_azimuth.min() + half), float(collection.beam_azimuth.max() - half)


GAIN_PARTS = 32  # of a dwell, in each of which weights and the antenna's pattern are taken as constant


def lit_pulses(collection: Collection, yaw: FloatArray, valid: FloatArray) -> FloatArray:
    """Number of valid pulses that light points at yaws (n,): sum of `valid` (n_pulse,) over the lit ones.

    `valid` is the fraction of each pulse's samples that is there; 0 for a missing pulse. Yaws on the edge of the beam
    but for rounding (`EDGE`) are lit.
    """
    total = np.concatenate([[0.0], np.cumsum(valid)])
    first, last = yaw_interval(collection, yaw, tolerance=EDGE)
    return np.asarray(total[last] - total[first])


def weighted_pulses(collection: Collection, yaw: FloatArray, valid: FloatArray, taper: Taper) -> FloatArray:
    """Sum of `valid` (n_pulse,) times the taper over the pulses that light points at yaws (n,); see `lit_pulses`."""
    if taper.uniform:
        return lit_pulses(collection, yaw, valid)
    if collection.beam_width is None:
        return np.full(yaw.shape, float((valid * taper.samples(collection.n_pulse)).sum()))
    first, last = yaw_interval(collection, yaw, tolerance=EDGE)
    beam, half = collection.beam_azimuth, collection.beam_width / 2
    middle = float(beam[0] + beam[-1]) / 2
    point, along = wrapped(yaw - middle) / half, (beam - middle) / half
    # Each cosine of the difference is a product of two phasors, so that one running sum serves all points.
    total, (terms, frequency) = np.zeros(yaw.shape), taper.series
    for k, term in enumerate(terms):
        running = np.concatenate([[0.0], np.cumsum(valid * np.exp(-1j * np.pi * frequency * k * along))])
        total += term * (np.exp(1j * np.pi * frequency * k * point) * (running[last] - running[first])).real
    return total


def most_lit_pulses(geometry: Geometry, x: FloatArray, y: FloatArray) -> int:
    """The largest number of pulses that light any one point; under a beam about its axis, any of those at x, y, m."""
    collection = geometry.collection
    if collection.has_axis:
        first, last = dwell(geometry, x, y)
        lasts = (last - first)[np.isfinite(last - first)]  # elsewhere the terrain has no height
        return math.ceil(float(lasts.max(initial=0.0)) * collection.prf)
    return int(lit_pulses(collection, collection.beam_azimuth, np.ones(collection.n_pulse)).max())


def lit_total(
    geometry: Geometry,
    epoch_range: FloatArray,
    yaw: FloatArray,
    valid: FloatArray,
    taper: Taper = FLAT,
) -> FloatArray:
    """Sum of `valid` (n_pulse,) times taper and antenna's pattern over lit pulses: (n_range, n_yaw), at (n,) m and rad.

    Dwells begin and end between pulses here, so that the sum is continuous.
    """
    collection = geometry.collection
    shape = epoch_range.size, yaw.size
    start, _ = aperture(collection)
    first, last = dwell_at(geometry, yaw, epoch_range[:, None])
    begin, stop = (np.broadcast_to(np.clip((t - start) * collection.prf, 0, None), shape) for t in (first, last))
    before, pulse = np.concatenate([[0.0], np.cumsum(valid)]), np.arange(valid.size + 1.0)
    x, y = geometry.ground_axes(epoch_range[:, None], yaw)
    z = geometry.level(epoch_range[:, None], yaw)
    weighed = collection.has_pattern or not taper.uniform
    parts, total = GAIN_PARTS if weighed else 1, np.zeros(shape)
    for part in range(parts):
        low, high = (begin + (stop - begin) * (part + k) / parts for k in (0, 1))
        count = np.interp(high, pulse, before) - np.interp(low, pulse, before)
        if weighed:
            middle = np.clip((low + high) / 2, 0, valid.size - 1).astype(np.int64)
            weight = pulse_weights(geometry, x, y, middle, taper, z)
            count = count * weight * pattern_gain(geometry, x, y, middle, z)
        total += count
    return np.asarray(np.where((last > first) & np.isfinite(x), np.maximum(total, 0.0), 0.0))


NODES = 33  # places along each side of a part of an image at which margins are computed; linear in between


def dwell_margin(geometry: Geometry, x: FloatArray, y: FloatArray) -> FloatArray:
    """Margin by which the dwell of points x, y (...), m, lies inside the collection, over the dwell; see above.

    0 where the beam is not steered, or lights a point all the time; -inf where it never does.
    """
    start, end = aperture(geometry.collection)
    first, last = dwell(geometry, x, y, uncut=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        margin = np.minimum(first - start, end - last) / (last - first)
    margin = np.where((first <= start) & (last >= end), 0.0, margin)
    return np.where(last > first, margin, -np.inf)


def margins_over(geometry: Geometry, x: FloatArray, y: FloatArray) -> FloatArray:
    """Margins at NODES x NODES places of a part of an image with axes x and y, m: (NODES, NODES), rows along y."""
    places = np.linspace(x[0], x[-1], NODES), np.linspace(y[0], y[-1], NODES)
    return dwell_margin(geometry, *np.meshgrid(*places))


def expand(margins: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Margins at all pixels of that part, (n_y, n_x), linear between places; -inf around places that are never lit."""
    with np.errstate(invalid="ignore"):
        for axis, n in enumerate(shape):
            place = np.linspace(0, NODES - 1, n) if n > 1 else np.zeros(1)
            below = np.minimum(place.astype(np.int64), NODES - 2)
            part = (place - below)[:, None] if axis == 0 else place - below
            low, high = np.take(margins, below, axis), np.take(margins, below + 1, axis)
            margins = np.asarray(low * (1 - part) + high * part)
    return np.nan_to_num(margins, nan=-np.inf, posinf=np.inf, neginf=-np.inf)
