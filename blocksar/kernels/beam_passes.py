"""Compiled search for the pulses at which a beam about the antenna's axis lights points.

With s the sine of the angle between the line of sight and the plane normal to the axis, a point is lit at a pulse while
steering - half <= asin(s) <= steering + half. Sines are compared instead: of both limits there is one for each pulse.
No operations are contracted, so that a point is lit or not whichever loop asks.

An antenna that looks to one side of its track lights points there alone: `keep_side` cuts passes to the pulses at which
a point lies on that side.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit, types

from blocksar.arrays import BoolArray, FloatArray, IntArray
from blocksar.kernels.loops import PART, REAL_ROW, REAL_ROWS, UNCHECKED, UNCONTRACTED, fixed, loop, record

EXACT: dict[str, Any] = {**UNCONTRACTED, **UNCHECKED}
INDICES = types.Array(types.int64, 1, "C", readonly=True)
FLAGS = types.Array(types.bool_, 1, "C", readonly=True)
PULSES, PASSES = types.int64[::1], types.int64[:, ::1]
PLACES = (REAL_ROW, REAL_ROW, REAL_ROW)
LOW, HIGH = 6, 7  # columns of a table with the limits of sines
NO_SINE = 2.0  # a limit that no sine reaches
NEARER, ROUNDING = 0.1, 1e-12
GROUP = 16  # points that are looked at together
MOST_SPANS, MOST_DOUBTFUL = 64, 2048  # spans, and pulses of all of them: with more, each point is looked at by itself


def beam_table(position: FloatArray, axis: FloatArray, steering: FloatArray, half: float) -> FloatArray:
    """Table for the loops, (n_pulse, 8): for each pulse, one line of the cache.

    Position of the antenna (n_pulse, 3), m; axis of the beam (n_pulse, 3); sines `half` rad before and behind the
    beam's centre, with which those of points are compared as their angles would be. `half` may be negative.
    """
    table = np.empty((steering.size, 8))
    table[:, :3], table[:, 3:6] = position, axis
    for column, way in ((LOW, -1.0), (HIGH, 1.0)):
        angle = steering + way * half
        table[:, column] = np.where(np.abs(angle) > np.pi / 2, np.copysign(NO_SINE, angle), np.sin(angle))
    return table


class MovingBeam(NamedTuple):
    """A beam by pulse, with bounds on its change.

    Attributes
    ----------
    table : (n_pulse, 8) float
        From `beam_table`.
    moved, turned : float
        What the antenna moves by from a pulse to the next, m, and what axis and limits change by, at most.
    """

    table: FloatArray
    moved: float
    turned: float

    @classmethod
    def of(cls, table: FloatArray) -> MovingBeam:
        """Compute the largest steps of a table."""
        steps = np.abs(np.diff(table, axis=0))
        moved, turned = (np.sqrt((part**2).sum(axis=1)).max(initial=0.0) for part in (steps[:, :3], steps[:, 3:LOW]))
        return cls(fixed(table), float(moved), float(turned + steps[:, LOW:].max(initial=0.0)))


class Doubtful(NamedTuple):
    """Pulses at which points near a place may be lit or not: see `_find_doubtful`.

    Attributes
    ----------
    low, high : (n_pulse,) float
        The limits less s of the place, at these pulses.
    spans : (n_span, 3) int
    """

    low: FloatArray
    high: FloatArray
    spans: IntArray


class FoundPasses(NamedTuple):
    """Pulses first <= p < last, (m, n): of pass m of point n."""

    firsts: IntArray
    lasts: IntArray


class LitSide(NamedTuple):
    """Side of its vertical plane that an antenna lights, by pulse, with bounds on the plane's change.

    Attributes
    ----------
    table : (n_pulse, 4) float
        Place of the antenna, m, and the unit vector towards the lit side, both level; 0 where either side is lit.
    moved, turned : float
        What the antenna moves by from a pulse to the next, m, and what the vector changes by, at most.
    """

    table: FloatArray
    moved: float
    turned: float

    @classmethod
    def of(cls, position: FloatArray, towards: FloatArray) -> LitSide:
        """Find the largest steps of positions (n_pulse, 3), m, and vectors towards the lit side (n_pulse, 2)."""
        table = np.column_stack([position[:, :2], towards])
        steps = np.diff(table, axis=0)
        moved, turned = (float(np.hypot(*part.T).max(initial=0.0)) for part in (steps[:, :2], steps[:, 2:]))
        return cls(fixed(table), moved, turned)


SIDE = record(LitSide, REAL_ROWS, types.float64, types.float64)
BEAM, FOUND = record(MovingBeam, REAL_ROWS, types.float64, types.float64), record(FoundPasses, PASSES, PASSES)


@njit(**PART, **EXACT)
def _sides(table: FloatArray, p: int, x: float, y: float, z: float) -> tuple[float, float]:
    """Distance ahead of the plane and range of a point at a pulse, m; s is their quotient."""
    dx, dy, dz = x - table[p, 0], y - table[p, 1], z - table[p, 2]
    return dx * table[p, 3] + dy * table[p, 4] + dz * table[p, 5], np.sqrt(dx * dx + dy * dy + dz * dz)


@njit(**PART, **EXACT)
def _offset(table: FloatArray, steering: FloatArray, p: int, x: float, y: float, z: float) -> float:
    ahead, distance = _sides(table, p, x, y, z)
    return math.asin(min(max(ahead / distance, -1.0), 1.0)) - steering[p]


@loop(REAL_ROWS, *PLACES, FLAGS, PULSES, **EXACT)
def find_first(
    table: FloatArray, x: FloatArray, y: FloatArray, z: FloatArray, rises: BoolArray, found: IntArray
) -> None:
    """First pulse at which the monotonic s of each point reaches the limit in its direction.

    Parameters
    ----------
    table : (n_pulse, 8) float
        From `beam_table`. Where s rises the limit is the high one, else the low one.
    x, y, z : (n,) float
        m
    rises : (n,) bool
    found : (n,) int
        Written; n_pulse where there is none.
    """
    for k in range(x.size):
        low, high = 0, table.shape[0]
        while low < high:
            middle = (low + high) // 2
            ahead, distance = _sides(table, middle, x[k], y[k], z[k])
            high_limit, low_limit = table[middle, HIGH] * distance, table[middle, LOW] * distance
            reached = ahead >= high_limit if rises[k] else ahead <= low_limit
            low, high = (low, middle) if reached else (middle + 1, high)
        found[k] = low


@loop(REAL_ROWS, REAL_ROW, INDICES, *PLACES, PULSES, types.bool_[::1], **EXACT)
def find_turning(
    table: FloatArray, steering: FloatArray, nodes: IntArray, x: FloatArray, y: FloatArray, z: FloatArray,
    turning: IntArray, rises: BoolArray,
) -> None:  # fmt: skip
    """Pulse at which the offset of each point reverses, and whether it rises before.

    The pulse is 0 where it never turns, -1 where it does so more than once, between the pulses `nodes` at least.
    """
    for k in range(x.size):
        count, where, up, first = 0, 0, False, False
        last = _offset(table, steering, nodes[0], x[k], y[k], z[k])
        for i in range(1, nodes.size):
            offset = _offset(table, steering, nodes[i], x[k], y[k], z[k])
            rising = offset > last
            if i == 1:
                first = rising
            elif rising != up:
                count += 1
                where = i - 2
            up, last = rising, offset
        rises[k], turning[k] = first, -1 if count > 1 else 0
        if count == 1:
            low, high = nodes[where], nodes[where + 2]
            while low < high:
                middle = min((low + high) // 2, table.shape[0] - 2)
                step = _offset(table, steering, middle + 1, x[k], y[k], z[k]) > _offset(
                    table, steering, middle, x[k], y[k], z[k]
                )
                low, high = (middle + 1, high) if step == first else (low, middle)
            turning[k] = low


@njit(**PART, **EXACT)
def _note(found: FoundPasses, k: int, count: int, p: int, lit: bool) -> int:
    """Record that point k becomes lit, or unlit, at pulse p, if there is room; return the number of ended passes."""
    if count < found.firsts.shape[0]:
        if lit:
            found.firsts[count, k] = p
        else:
            found.lasts[count, k] = p
    return count + (0 if lit else 1)


@njit(**PART, **EXACT)
def _is_lit(table: FloatArray, p: int, x: float, y: float, z: float) -> bool:
    ahead, distance = _sides(table, p, x, y, z)
    return ahead >= table[p, LOW] * distance and ahead <= table[p, HIGH] * distance


@njit(**PART, **EXACT)
def _march(beam: MovingBeam, k: int, x: float, y: float, z: float, found: FoundPasses) -> int:
    """Write the passes of point k; return their number.

    From pulse to pulse the line of sight turns by no more than what the antenna moves by over the range, and s by that
    and what the axis turns by: all pulses before s can have reached a limit are as the one that was looked at.
    """
    table, moved, turned = beam.table, beam.moved, beam.turned
    n, count, p, before = table.shape[0], 0, 0, False
    while p < n:
        ahead, distance = _sides(table, p, x, y, z)
        if np.isnan(ahead):
            break
        low, high = table[p, LOW], table[p, HIGH]
        now = ahead >= low * distance and ahead <= high * distance
        if now != before:
            count = _note(found, k, count, p, now)
        before = now
        s = ahead / distance
        spare = min(s - low, high - s) if now else max(low - s, s - high)
        # Over pulses in which the range changes by a part NEARER at most.
        rate = moved / ((1 - NEARER) * distance) + turned
        steps = min((spare - ROUNDING) / max(rate, ROUNDING), NEARER * distance / max(moved, ROUNDING))
        p += max(int(min(steps, n)), 1)
    return _note(found, k, count, n, False) if before else count


@njit(**PART, **EXACT)
def _find_doubtful(beam: MovingBeam, x: float, y: float, z: float, reach: float, doubtful: Doubtful) -> int:
    """Find spans of pulses at which points up to `reach` from a place may be lit; return their number, or -1.

    Each span has its first pulse, its end, and whether all points are lit from there on: 1 or 0. They are dark before
    the first span, and a span may be empty. -1 where there are too many.

    By a way `reach` to a point the line of sight turns, and s changes, by no more than that over the shorter range.
    """
    table, moved, turned = beam.table, beam.moved, beam.turned
    low, high, spans = doubtful.low, doubtful.high, doubtful.spans
    n, count, number, p, lit, inside_span = table.shape[0], 0, 0, 0, False, False
    while p < n:
        ahead, distance = _sides(table, p, x, y, z)
        nearest = (1 - NEARER) * distance - reach  # over pulses in which the range changes by a part NEARER at most
        if not nearest > 0 or count == spans.shape[0] or number == MOST_DOUBTFUL:
            return -1
        s, margin = ahead / distance, reach / nearest + ROUNDING
        low_limit, high_limit = table[p, LOW], table[p, HIGH]
        now = s >= low_limit and s <= high_limit
        spare = min(s - low_limit, high_limit - s) if now else max(low_limit - s, s - high_limit)
        if spare > margin:
            if inside_span or now != lit:
                if not inside_span:
                    spans[count, 0] = p
                spans[count, 1], spans[count, 2] = p, 1 if now else 0
                count, lit, inside_span = count + 1, now, False
            rate = moved / nearest + turned
            steps = min((spare - margin) / max(rate, ROUNDING), NEARER * distance / max(moved, ROUNDING))
            p += max(int(min(steps, n)), 1)
        else:
            if not inside_span:
                spans[count, 0] = p
            low[p], high[p] = low_limit - s, high_limit - s
            number, inside_span, p = number + 1, True, p + 1
    if inside_span:
        spans[count, 1] = n
    return count + (1 if inside_span else 0)


@njit(**PART, **EXACT)
def _pass_spans(
    beam: MovingBeam, k: int, x: float, y: float, z: float, reach: float, doubtful: Doubtful, n_span: int,
    found: FoundPasses,
) -> int:  # fmt: skip
    """Find the passes of point k from the spans of `_find_doubtful` for a place up to `reach` away; their number.

    What s of the point has more than that of the place changes slowly: from pulse to pulse both lines of sight turn
    alike but for 3 moved reach / range^2, and the axis turns what is between them by turned reach / range. So it is
    computed once a span, and pulses are looked at where that leaves a doubt.
    """
    table, moved, turned = beam.table, beam.moved, beam.turned
    low, high, spans = doubtful.low, doubtful.high, doubtful.spans
    count, lit, n = 0, False, table.shape[0]
    for m in range(n_span):
        a, b = spans[m, 0], spans[m, 1]
        if b > a:
            middle = (a + b) // 2
            ahead, distance = _sides(table, middle, x, y, z)
            more, nearest = ahead / distance - (table[middle, LOW] - low[middle]), (1 - NEARER) * distance - reach
            slack = np.inf
            if moved * (b - a) <= NEARER * distance and nearest > 0:
                slack = (b - a) * reach / nearest * (3 * moved / nearest + turned) + ROUNDING
            doubts, inside, changes, last = 0, 0, 0, np.uint64(a)
            for i in range(a, b):
                p = np.uint64(i)
                under, over = low[p] - more, high[p] - more
                now, before = under <= 0 and over >= 0, low[last] - more <= 0 and high[last] - more >= 0
                doubts += 1 if abs(under) <= slack or abs(over) <= slack else 0
                inside, changes, last = inside + (1 if now else 0), changes + (1 if now != before else 0), p
            if doubts == 0 and changes <= 1:
                first = low[a] - more <= 0 and high[a] - more >= 0
                if first != lit:
                    count, lit = _note(found, k, count, a, first), first
                if changes:
                    count = _note(found, k, count, a + (inside if first else b - a - inside), not first)
                    lit = not first
            else:
                for i in range(a, b):
                    under, over = low[i] - more, high[i] - more
                    now = under <= 0 and over >= 0
                    if abs(under) <= slack or abs(over) <= slack:
                        now = _is_lit(table, i, x, y, z)
                    if now != lit:
                        count, lit = _note(found, k, count, i, now), now
        if b < n and (spans[m, 2] != 0) != lit:
            lit = spans[m, 2] != 0
            count = _note(found, k, count, b, lit)
    return _note(found, k, count, n, False) if lit else count


@loop(BEAM, *PLACES, FOUND, **EXACT)
def find_passes(beam: MovingBeam, x: FloatArray, y: FloatArray, z: FloatArray, found: FoundPasses) -> int:
    """Find passes (m, n) of points in order of time: pulses first <= p < last with s within the limits.

    Points that follow each other are looked at together where they lie close to each other.

    Parameters
    ----------
    beam : MovingBeam
    x, y, z : (n,) float
        m; NaN is never lit.
    found : FoundPasses
        Written. Passes that a point lacks are 0 and 0.

    Returns
    -------
    int
        The largest number of passes of a point: if that is above m, some are not written.
    """
    most, n_pulse, firsts, lasts = 0, beam.table.shape[0], found.firsts, found.lasts
    doubtful = Doubtful(np.empty(n_pulse), np.empty(n_pulse), np.empty((MOST_SPANS, 3), np.int64))
    for m in range(firsts.shape[0]):
        for k in range(x.size):
            firsts[m, k] = lasts[m, k] = 0
    for begin in range(0, x.size, GROUP):
        end = min(begin + GROUP, x.size)
        mean_x, mean_y, mean_z = 0.0, 0.0, 0.0
        for k in range(begin, end):
            mean_x, mean_y, mean_z = mean_x + x[k], mean_y + y[k], mean_z + z[k]
        mean_x, mean_y, mean_z = mean_x / (end - begin), mean_y / (end - begin), mean_z / (end - begin)
        square = 0.0
        for k in range(begin, end):
            square = max(square, (x[k] - mean_x) ** 2 + (y[k] - mean_y) ** 2 + (z[k] - mean_z) ** 2)
        reach = np.sqrt(square)
        n_span = -1
        if not np.isnan(mean_x + mean_y + mean_z):
            n_span = _find_doubtful(beam, mean_x, mean_y, mean_z, reach, doubtful)
        for k in range(begin, end):
            if n_span < 0:
                count = _march(beam, k, x[k], y[k], z[k], found)
            else:
                count = _pass_spans(beam, k, x[k], y[k], z[k], reach, doubtful, n_span, found)
            most = max(most, count)
    return most


@loop(SIDE, REAL_ROW, REAL_ROW, FOUND, FOUND, **EXACT)
def keep_side(side: LitSide, x: FloatArray, y: FloatArray, passes: FoundPasses, found: FoundPasses) -> int:
    """Limit passes of points to pulses at which these lie on the lit side of the antenna, in order of time.

    A point at a level distance d from the antenna is off its plane by what changes by no more than moved + turned d
    from pulse to pulse: all pulses before it can have reached the plane are as the one that was looked at.

    Parameters
    ----------
    side : LitSide
    x, y : (n,) float
        m
    passes : FoundPasses
    found : FoundPasses
        Written. Passes that a point lacks are 0 and 0.

    Returns
    -------
    int
        The largest number of passes of a point: if that is above those of `found`, some are not written.
    """
    table, moved, turned = side.table, side.moved, side.turned
    most = 0
    for k in range(x.size):
        count = 0
        for m in range(found.firsts.shape[0]):
            found.firsts[m, k] = found.lasts[m, k] = 0
        for m in range(passes.firsts.shape[0]):
            p, end, before = passes.firsts[m, k], passes.lasts[m, k], False
            while p < end:
                dx, dy = x[k] - table[p, 0], y[k] - table[p, 1]
                off = dx * table[p, 2] + dy * table[p, 3]
                now = off >= 0
                if now != before:
                    count = _note(found, k, count, p, now)
                before = now
                rate = max(moved + turned * np.sqrt(dx * dx + dy * dy), ROUNDING)
                p += max(int(min((1 - ROUNDING) * abs(off) / rate, end)), 1)
            if before:
                count = _note(found, k, count, end, False)
        most = max(most, count)
    return most
