"""Beams about the antenna's own axis: angles off the beam's centre, and when a point passes the beam.

With u the unit vector from the antenna to a point, the point lies by

    offset = asin(u . beam_axis) - beam_steering

off the beam's centre, and is lit while |offset| <= beam_width / 2. A fixed beam is stripmap, a slow turn sliding
spotlight, a fast one TOPS. When a point is lit depends on its range as well as on its yaw.

A point's offset mostly rises or falls throughout, so that its edges are found by bisection. Under a beam that stays on
a spot it may turn back: once, which divides the pulses into two parts to be bisected; or more often, and then every
pulse is looked at. The beam is taken to be smooth over a fraction 1 / NODES of the collection.

Points x, y lie at heights z, m; without, on the plane z = ground_height.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blocksar.arrays import BoolArray, FloatArray, IntArray
from blocksar.collection.collection import Collection

NODES = 32  # parts of the collection at whose ends offsets are compared, to see whether they turn back
TOGETHER = 4096  # points whose offsets there are computed at a time: they stay in the cache
SCANNED = 1 << 18  # offsets computed at a time where every pulse is looked at
REACH = 64  # the part of the collection, 1 / REACH, whose slope continues an offset beyond the collection's ends
LEAST_SLOPE = 1e-12  # rad/s
Height = FloatArray | float


class Points(NamedTuple):
    """Places x, y (n,) and z (n,) or one for all, m."""

    x: FloatArray
    y: FloatArray
    z: Height

    @classmethod
    def of(cls, collection: Collection, x: FloatArray, y: FloatArray, z: Height | None) -> Points:
        """Points at heights z; None: on the plane."""
        return cls(x, y, collection.ground_height if z is None else z)

    def some(self, which: IntArray | BoolArray) -> Points:
        """The points at some indices."""
        return Points(self.x[which], self.y[which], self.z[which] if isinstance(self.z, np.ndarray) else self.z)

    def offsets(self, collection: Collection, pulses: slice | IntArray) -> FloatArray:
        """Offsets (n, n_pulse) at some pulses, rad."""
        z = self.z[:, None] if isinstance(self.z, np.ndarray) else self.z
        return axis_offset(collection, self.x[:, None], self.y[:, None], pulses, z)


def axis_offset(
    collection: Collection, x: FloatArray, y: FloatArray, pulses: slice | IntArray | int, z: Height | None = None
) -> FloatArray:
    """Angle of points x, y, z (m) off the beam's centre at pulses, rad; points and pulses are broadcast."""
    assert collection.beam_axis is not None and collection.beam_steering is not None
    px, py, pz = np.moveaxis(collection.antenna_position[pulses], -1, 0)
    ax, ay, az = np.moveaxis(collection.beam_axis[pulses], -1, 0)
    dx, dy, dz = x - px, y - py, (collection.ground_height if z is None else z) - pz
    sine = (dx * ax + dy * ay + dz * az) / np.sqrt(dx * dx + dy * dy + dz * dz)
    return np.asarray(np.arcsin(np.clip(sine, -1.0, 1.0)) - collection.beam_steering[pulses])


def axis_passes(
    collection: Collection, x: FloatArray, y: FloatArray, z: Height | None = None, *, width: float | None = None
) -> tuple[IntArray, IntArray]:
    """Pulses first <= p < last that light points x, y, z (n,), m: exactly those with |offset| <= beam_width / 2.

    Or half of another `width`, rad. Several passes where the beam turns back or wobbles, leaves a point and comes to it
    again: (n_pass, n), in the order of time. Those that a point lacks are empty, at the end of the one before; so a
    point that is never lit has 0 and 0.
    """
    points, half = Points.of(collection, x, y, z), _half(collection) if width is None else width / 2
    steady, apart = collection.steady
    if steady is collection:
        return _in_order(_steady_passes(collection, points, half))
    # What the steady beam lights by more than the two lie apart is lit, and outside of that nothing is.
    low, high = (_in_order(_steady_passes(steady, points, level)) for level in (max(half - apart, 0.0), half + apart))
    passes = _Passes(x.size)
    once = np.flatnonzero((high[0][1:] >= high[1][1:]).all(axis=0) & (low[0][1:] >= low[1][1:]).all(axis=0))
    doubtful = np.maximum(low[0][0] - high[0][0], high[1][0] - low[1][0])
    by_length = once[np.argsort(doubtful[once], kind="stable")]
    for group in np.split(by_length, range(TOGETHER, once.size, TOGETHER)):
        longest = max(int(doubtful[group].max(initial=0)), 1)
        rows = max(SCANNED // (2 * longest), 1)
        for some in np.split(group, range(rows, group.size, rows)):
            ends = (each[0][some] for each in (*high, *low))
            passes.add(some, *_look_near_ends(collection, points.some(some), half, *ends))
    often = np.ones(x.size, np.bool_)
    often[once] = False
    _scan(collection, points, half, np.flatnonzero(often), passes)
    return _in_order(passes)


class _Passes:
    """Passes of n points that are found one after the other."""

    def __init__(self, n: int) -> None:
        self.ends = [(np.zeros(n, np.int64), np.zeros(n, np.int64))]

    def __getitem__(self, number: int) -> tuple[IntArray, IntArray]:
        while number >= len(self.ends):
            self.ends.append((np.zeros_like(self.ends[0][0]), np.zeros_like(self.ends[0][0])))
        return self.ends[number]

    def add(self, some: IntArray, lit: BoolArray, pulses: IntArray) -> None:
        """Those of some points (n,), lit from each of pulses (n, m) to the next, or not."""
        none = np.zeros((some.size, 1), np.bool_)
        changes = np.concatenate([none, lit], axis=1) != np.concatenate([lit, none], axis=1)
        at, rows = np.concatenate([pulses, pulses[:, -1:] + 1], axis=1), np.arange(some.size)
        for number in range(int(changes.sum(axis=1).max(initial=0)) // 2):
            for of_pass in self[number]:
                change = changes.argmax(axis=1)
                of_pass[some] = np.where(changes[rows, change], at[rows, change], 0)
                changes[rows, change] = False


def _in_order(passes: _Passes) -> tuple[IntArray, IntArray]:
    """Ends (n_pass, n) of passes: those that a point lacks at the end of the one before."""
    found = list(passes.ends)
    while len(found) > 1 and (found[-1][0] >= found[-1][1]).all():
        found.pop()
    firsts, lasts = (np.stack([of_pass[end] for of_pass in found]) for end in (0, 1))
    empty = firsts >= lasts
    lasts = np.maximum.accumulate(np.where(empty, 0, lasts))
    return np.where(empty, lasts, firsts), lasts


def _steady_passes(collection: Collection, points: Points, half: float) -> _Passes:
    """Passes of points of which |offset| <= half, rad, where offsets rise and fall but few times."""
    n, passes = collection.n_pulse, _Passes(points.x.size)
    turning, rising = _turning(collection, points)
    once = np.flatnonzero(turning >= 0)
    if once.size:
        at, sign = points.some(once), np.where(rising[once], 1.0, -1.0)
        middle = np.where(turning[once] > 0, turning[once], n)
        before = _passage(collection, at, half, np.zeros_like(middle), middle, sign)
        after = _passage(collection, at, half, middle, np.full_like(middle, n), -sign)
        joined = (before[0] == before[1]) | (after[0] == after[1]) | (before[1] == after[0])
        first = np.where(before[0] == before[1], after[0], before[0])
        last = np.where(after[0] == after[1], before[1], after[1])
        passes[0][0][once], passes[0][1][once] = first, np.where(joined, last, before[1])
        passes[1][0][once], passes[1][1][once] = np.where(joined, 0, after)
    _scan(collection, points, half, np.flatnonzero(turning < 0), passes)
    return passes


def _scan(collection: Collection, points: Points, half: float, some: IntArray, passes: _Passes) -> None:
    """Look at every pulse of some of the points."""
    n = collection.n_pulse
    rows = max(SCANNED // n, 1)
    for few in np.split(some, range(rows, some.size, rows)):
        lit = np.abs(points.some(few).offsets(collection, slice(None))) <= half
        passes.add(few, lit, np.broadcast_to(np.arange(n), lit.shape))


def _look_near_ends(
    collection: Collection, points: Points, half: float, first: IntArray, last: IntArray, low: IntArray, high: IntArray
) -> tuple[BoolArray, IntArray]:
    """Whether points (n,) are lit from each of pulses (n, m) to the next, both, looking at some of them only.

    Points are lit at low <= p < high, and nowhere but at first <= p < last; where low == high, perhaps nowhere.
    """
    sure = low < high
    low, high = np.where(sure, low, last), np.where(sure, high, last)
    before, after = int((low - first).max(initial=0)), int((last - high).max(initial=0))
    begin = low[:, None] + np.arange(-before, 0)
    end = high[:, None] + np.arange(after + 1)
    looked = np.concatenate([begin, end], axis=1)
    at = np.clip(looked, 0, collection.n_pulse - 1)
    z = points.z[:, None] if isinstance(points.z, np.ndarray) else points.z
    lit = np.abs(axis_offset(collection, points.x[:, None], points.y[:, None], at, z)) <= half
    lit &= (first[:, None] <= looked) & (looked < last[:, None])
    inside = sure | (lit[:, before - 1] if before else False)  # where nothing is sure, as at the last pulse looked at
    return (
        np.concatenate([lit[:, :before], inside[:, None], lit[:, before:]], axis=1),
        np.concatenate([begin, low[:, None], end], axis=1),
    )


def axis_dwell(
    collection: Collection, x: FloatArray, y: FloatArray, z: Height | None = None, *, uncut: bool
) -> tuple[FloatArray, FloatArray]:
    """Times at which points x, y, z (n,), m, enter and leave the beam, s, as a continuous function of time.

    Of the steady beam where it wobbles. Between pulses, offsets are interpolated linearly; beyond the ends of the
    collection they go on with their slope there. Without `uncut`, times are limited to the collection; the first is not
    before the last where a point is never lit. Where offsets turn back, times are those of pulses. NaN where x, y or z
    is.
    """
    collection = collection.steady[0]
    points = Points.of(collection, x, y, z)
    known = np.isfinite(x) & np.isfinite(y) & np.isfinite(points.z)
    if not known.all():
        first, last = np.full(x.shape, np.nan), np.full(x.shape, np.nan)
        first[known], last[known] = axis_dwell(collection, *points.some(known), uncut=uncut)
        return first, last
    time, half_pulse = collection.time, collection.pulse_interval / 2
    turning, rising = _turning(collection, points)
    sign = np.where(rising, 1.0, -1.0)
    first, last = (_edge_times(collection, points, sign, level) for level in (-_half(collection), _half(collection)))
    bent = np.flatnonzero(turning != 0)
    if bent.size:
        passes = axis_passes(collection, *points.some(bent))
        begin, end = passes[0][0], passes[1][-1]
        lit, at_turn = end > begin, time[np.maximum(turning[bent], 0)]
        first[bent] = np.where(lit, time[np.minimum(begin, collection.n_pulse - 1)] - half_pulse, at_turn)
        last[bent] = np.where(lit, time[end - 1] + half_pulse, at_turn)
    if uncut:
        return first, last
    return np.maximum(first, time[0] - half_pulse), np.minimum(last, time[-1] + half_pulse)


def axis_passing(
    collection: Collection, x: FloatArray, y: FloatArray, place: float, z: Height | None = None
) -> FloatArray:
    """Times at which points x, y, z (n,), m, are at a place in the beam, s: -1 where they enter, 1 where they leave it.

    As `axis_dwell`, as if the collection did not cut dwells; in proportion where offsets turn back. From the nearer end
    of the dwell, a place is half as far as in proportion to half as far again; near the ends a third to three times.
    """
    collection = collection.steady[0]
    points = Points.of(collection, x, y, z)
    first, last = axis_dwell(collection, *points, uncut=True)
    middle, half = (first + last) / 2, (last - first) / 2
    known = np.flatnonzero(np.isfinite(middle))
    turning, rising = _turning(collection, points.some(known))
    some = known[turning == 0]
    sign = np.where(rising[turning == 0], 1.0, -1.0)
    found = _edge_times(collection, points.some(some), sign, place * _half(collection))
    away = np.full(x.shape, place)
    toward, apart = (1.0 if place >= 0 else -1.0), 1 - abs(place)
    limits = toward * (1 - apart * 1.5 * (1 + place**2)), toward * (1 - apart / (2 + place**2))
    away[some] = np.clip((found - middle[some]) / half[some], min(limits), max(limits))
    return np.asarray(middle + away * half)


def _half(collection: Collection) -> float:
    return (collection.beam_width or 0.0) / 2


def _turning(collection: Collection, points: Points) -> tuple[IntArray, BoolArray]:
    """The pulse at which the offset of each point (n,) turns back, and whether it rises before that.

    The pulse is 0 where it never turns, -1 where it does so more than once.
    """
    nodes = np.unique(np.linspace(0, collection.n_pulse - 1, NODES + 1).round().astype(np.int64))
    groups = np.split(np.arange(points.x.size), range(TOGETHER, points.x.size, TOGETHER))
    rising = np.concatenate([np.diff(points.some(group).offsets(collection, nodes)) > 0 for group in groups])
    changes = rising[:, 1:] != rising[:, :-1]
    count, where = changes.sum(axis=1), changes.argmax(axis=1)
    turning = np.where(count > 1, -1, 0).astype(np.int64)
    some = np.flatnonzero(count == 1)
    once = points.some(some)
    low, high = nodes[where[some]], nodes[where[some] + 2]
    while (low < high).any():
        middle = np.minimum((low + high) // 2, collection.n_pulse - 2)
        step = _at(collection, once, middle + 1) > _at(collection, once, middle)
        as_before = step == rising[some, 0]
        low, high = np.where(as_before & (low < high), middle + 1, low), np.where(as_before, high, middle)
    turning[some] = low
    return turning, rising[:, 0]


def _at(collection: Collection, points: Points, pulses: IntArray) -> FloatArray:
    """Offsets of points (n,) at a pulse each (n,)."""
    return axis_offset(collection, points.x, points.y, pulses, points.z)


def _first_pulse(
    collection: Collection,
    points: Points,
    low: IntArray,
    high: IntArray,
    sign: FloatArray,
    level: float,
    *,
    beyond: bool,
) -> IntArray:
    """First of the pulses low <= p < high at which sign offset reaches the level, or is `beyond` it; high if none."""
    while (low < high).any():
        middle = np.minimum((low + high) // 2, collection.n_pulse - 1)
        value = sign * _at(collection, points, middle)
        reached = value > level if beyond else value >= level
        low, high = np.where((low < high) & ~reached, middle + 1, low), np.where((low < high) & reached, middle, high)
    return low


def _passage(
    collection: Collection,
    points: Points,
    half: float,
    low: IntArray,
    high: IntArray,
    sign: FloatArray,
) -> tuple[IntArray, IntArray]:
    """The pulses with |offset| <= half among low <= p < high, over which sign offset rises."""
    first = _first_pulse(collection, points, low, high, sign, -half, beyond=False)
    return first, _first_pulse(collection, points, first, high, sign, half, beyond=True)


def _edge_times(collection: Collection, points: Points, sign: FloatArray, level: float) -> FloatArray:
    """Times at which sign offset, which rises, passes the level, s."""
    n, time = collection.n_pulse, collection.time
    zeros = np.zeros(sign.size, np.int64)
    after = _first_pulse(collection, points, zeros, zeros + n, sign, level, beyond=False)
    reach = max(n // REACH, 1)
    # Two pulses whose chord is followed: neighbours inside the collection, further apart beyond its ends.
    left = np.where(after == 0, 0, np.where(after == n, n - 1 - reach, after - 1))
    right = np.where(after == 0, reach, np.where(after == n, n - 1, np.minimum(after, n - 1)))
    begin, end = sign * _at(collection, points, left), sign * _at(collection, points, right)
    slope = np.maximum((end - begin) / (time[right] - time[left]), LEAST_SLOPE)
    late = after == n
    return np.where(late, time[right] + (level - end) / slope, time[left] + (level - begin) / slope)
