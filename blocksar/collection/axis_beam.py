"""Beams about the antenna's own axis: angles off the beam's centre, and when a point passes the beam.

With u the unit vector from the antenna to a point, the point lies by

    offset = asin(u . beam_axis) - beam_steering

off the beam's centre, and is lit while |offset| <= beam_width / 2. A fixed beam is stripmap, a slow turn sliding
spotlight, a fast one TOPS. When a point is lit depends on its range as well as on its yaw.

A point's offset mostly rises or falls throughout, so that its edges are found by bisection. Under a beam that stays on
a spot it may turn back: once, which divides the pulses into two parts to be bisected; or more often, and then every
pulse is looked at. The beam is taken to be smooth over a fraction 1 / NODES of the collection.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blocksar.arrays import BoolArray, FloatArray, IntArray
from blocksar.collection.collection import Collection
from blocksar.errors import InputError

NODES = 32  # parts of the collection at whose ends offsets are compared, to see whether they turn back
SCANNED = 1 << 22  # offsets computed at a time where every pulse is looked at
REACH = 64  # the part of the collection, 1 / REACH, whose slope continues an offset beyond the collection's ends
LEAST_SLOPE = 1e-12  # rad/s


class Spans(NamedTuple):
    """Pulses first <= p < last that light each of some points (n,), equal where none does; and whether it is twice."""

    first: IntArray
    last: IntArray
    twice: BoolArray


def axis_offset(collection: Collection, x: FloatArray, y: FloatArray, pulses: slice | IntArray | int) -> FloatArray:
    """Angle of ground points x, y (m) off the beam's centre at pulses, rad; points and pulses are broadcast."""
    assert collection.beam_axis is not None and collection.beam_steering is not None
    px, py, pz = np.moveaxis(collection.antenna_position[pulses], -1, 0)
    ax, ay, az = np.moveaxis(collection.beam_axis[pulses], -1, 0)
    dx, dy, dz = x - px, y - py, collection.ground_height - pz
    sine = (dx * ax + dy * ay + dz * az) / np.sqrt(dx * dx + dy * dy + dz * dz)
    return np.asarray(np.arcsin(np.clip(sine, -1.0, 1.0)) - collection.beam_steering[pulses])


def axis_spans(collection: Collection, x: FloatArray, y: FloatArray) -> Spans:
    """The lit pulses of points x, y (n,), m: exactly those with |offset| <= beam_width / 2.

    Where a point is lit twice, from the first lit pulse to the last.
    """
    n = collection.n_pulse
    turning, rising = _turning(collection, x, y)
    first, last = np.zeros(x.size, np.int64), np.zeros(x.size, np.int64)
    twice = np.zeros(x.size, np.bool_)
    once = np.flatnonzero(turning >= 0)
    if once.size:
        at, sign = (x[once], y[once]), np.where(rising[once], 1.0, -1.0)
        middle = np.where(turning[once] > 0, turning[once], n)
        before = _passage(collection, at, np.zeros_like(middle), middle, sign)
        after = _passage(collection, at, middle, np.full_like(middle, n), -sign)
        none_before, none_after = before[0] == before[1], after[0] == after[1]
        first[once] = np.where(none_before, after[0], before[0])
        last[once] = np.where(none_after, before[1], after[1])
        twice[once] = ~none_before & ~none_after & (before[1] != after[0])
    often = np.flatnonzero(turning < 0)
    rows = max(SCANNED // n, 1)
    for some in np.split(often, range(rows, often.size, rows)):
        lit = np.abs(axis_offset(collection, x[some, None], y[some, None], slice(None))) <= _half(collection)
        any_ = lit.any(axis=1)
        first[some] = np.where(any_, lit.argmax(axis=1), 0)
        last[some] = np.where(any_, n - lit[:, ::-1].argmax(axis=1), 0)
        twice[some] = lit.sum(axis=1) < last[some] - first[some]
    never = first >= last
    first[never], last[never] = 0, 0
    return Spans(first, last, twice)


def refuse_twice(collection: Collection, x: FloatArray, y: FloatArray, twice: BoolArray) -> None:
    """Raise an InputError if any of some points (n,) is lit twice."""
    if twice.any():
        where = int(twice.argmax())
        raise InputError(
            f"beam_steering turns so that {np.count_nonzero(twice)} points, such as x = {x[where]:.6g}, y = "
            f"{y[where]:.6g} m, are lit twice in {collection.n_pulse} pulses; cut the collection, or image a smaller "
            "grid"
        )


def axis_dwell(collection: Collection, x: FloatArray, y: FloatArray, *, uncut: bool) -> tuple[FloatArray, FloatArray]:
    """Times at which points x, y (n,), m, enter and leave the beam, s, as a continuous function of time.

    Between pulses, offsets are interpolated linearly; beyond the ends of the collection they go on with their slope
    there. Without `uncut`, times are limited to the collection; the first is not before the last where a point is
    never lit. Where offsets turn back, times are those of pulses. NaN where x or y is.
    """
    known = np.isfinite(x) & np.isfinite(y)
    if not known.all():
        first, last = np.full(x.shape, np.nan), np.full(x.shape, np.nan)
        first[known], last[known] = axis_dwell(collection, x[known], y[known], uncut=uncut)
        return first, last
    time, half_pulse = collection.time, collection.pulse_interval / 2
    turning, rising = _turning(collection, x, y)
    sign = np.where(rising, 1.0, -1.0)
    first, last = (_edge_times(collection, (x, y), sign, level) for level in (-_half(collection), _half(collection)))
    bent = np.flatnonzero(turning != 0)
    if bent.size:
        spans = axis_spans(collection, x[bent], y[bent])
        lit, at_turn = spans.last > spans.first, time[np.maximum(turning[bent], 0)]
        first[bent] = np.where(lit, time[spans.first] - half_pulse, at_turn)
        last[bent] = np.where(lit, time[spans.last - 1] + half_pulse, at_turn)
    if uncut:
        return first, last
    return np.maximum(first, time[0] - half_pulse), np.minimum(last, time[-1] + half_pulse)


def axis_passing(collection: Collection, x: FloatArray, y: FloatArray, place: float) -> FloatArray:
    """Times at which points x, y (n,), m, are at a place in the beam, s: -1 where they enter, 1 where they leave it.

    As `axis_dwell`, as if the collection did not cut dwells; in proportion where offsets turn back, and at most half as
    far from the middle of the dwell again as in proportion.
    """
    first, last = axis_dwell(collection, x, y, uncut=True)
    middle, half = (first + last) / 2, (last - first) / 2
    known = np.flatnonzero(np.isfinite(middle))
    turning, rising = _turning(collection, x[known], y[known])
    some = known[turning == 0]
    sign = np.where(rising[turning == 0], 1.0, -1.0)
    found = _edge_times(collection, (x[some], y[some]), sign, place * _half(collection))
    away = np.full(x.shape, place)
    spread = (1 - abs(place)) / 2
    away[some] = np.clip((found - middle[some]) / half[some], place - spread, place + spread)
    return np.asarray(middle + away * half)


def _half(collection: Collection) -> float:
    return (collection.beam_width or 0.0) / 2


def _turning(collection: Collection, x: FloatArray, y: FloatArray) -> tuple[IntArray, BoolArray]:
    """The pulse at which the offset of each point (n,) turns back, and whether it rises before that.

    The pulse is 0 where it never turns, -1 where it does so more than once.
    """
    nodes = np.unique(np.linspace(0, collection.n_pulse - 1, NODES + 1).round().astype(np.int64))
    rising = np.diff(axis_offset(collection, x[:, None], y[:, None], nodes)) > 0
    changes = rising[:, 1:] != rising[:, :-1]
    count, where = changes.sum(axis=1), changes.argmax(axis=1)
    turning = np.where(count > 1, -1, 0).astype(np.int64)
    some = np.flatnonzero(count == 1)
    low, high = nodes[where[some]], nodes[where[some] + 2]
    while (low < high).any():
        middle = np.minimum((low + high) // 2, collection.n_pulse - 2)
        step = _at(collection, (x[some], y[some]), middle + 1) > _at(collection, (x[some], y[some]), middle)
        as_before = step == rising[some, 0]
        low, high = np.where(as_before & (low < high), middle + 1, low), np.where(as_before, high, middle)
    turning[some] = low
    return turning, rising[:, 0]


def _at(collection: Collection, points: tuple[FloatArray, FloatArray], pulses: IntArray) -> FloatArray:
    """Offsets of points (n,) at a pulse each (n,)."""
    return axis_offset(collection, *points, pulses)


def _first_pulse(
    collection: Collection,
    points: tuple[FloatArray, FloatArray],
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
    points: tuple[FloatArray, FloatArray],
    low: IntArray,
    high: IntArray,
    sign: FloatArray,
) -> tuple[IntArray, IntArray]:
    """The lit pulses among low <= p < high, over which sign offset rises."""
    half = _half(collection)
    first = _first_pulse(collection, points, low, high, sign, -half, beyond=False)
    return first, _first_pulse(collection, points, first, high, sign, half, beyond=True)


def _edge_times(
    collection: Collection, points: tuple[FloatArray, FloatArray], sign: FloatArray, level: float
) -> FloatArray:
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
