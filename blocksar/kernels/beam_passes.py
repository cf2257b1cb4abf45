"""Which pulses of a beam about the antenna's axis light points, compiled.

With s the sine of the angle between the line of sight and the plane normal to the axis, a point is lit at a pulse while
steering - half <= asin(s) <= steering + half. Sines are compared instead: of both limits there is one for each pulse.
No operations are contracted, so that a point is lit or not whichever loop asks.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit, types

from blocksar.arrays import BoolArray, FloatArray, IntArray
from blocksar.kernels.loops import loop
from blocksar.kernels.signatures import PART, REAL_ROW, REAL_ROWS, UNCHECKED, UNCONTRACTED

EXACT: dict[str, Any] = {**UNCONTRACTED, **UNCHECKED}
INDICES = types.Array(types.int64, 1, "C", readonly=True)
FLAGS = types.Array(types.bool_, 1, "C", readonly=True)
PULSES, PASSES = types.int64[::1], types.int64[:, ::1]
PLACES = (REAL_ROW, REAL_ROW, REAL_ROW)
NO_SINE = 2.0  # a limit that no sine reaches


class Limits(NamedTuple):
    """Sines (n_pulse,) at both edges of a beam: a point is lit while low <= s <= high."""

    low: FloatArray
    high: FloatArray

    @classmethod
    def of(cls, steering: FloatArray, half: float) -> Limits:
        """Those `half` before and behind the beam's centre, rad, which may be negative."""
        return cls(*(_sine_of(steering + way * half) for way in (-1.0, 1.0)))


def _sine_of(angle: FloatArray) -> FloatArray:
    """Sines that other sines are compared with as their angles, in -pi / 2 .. pi / 2, are with these."""
    beyond = np.abs(angle) > np.pi / 2
    return np.ascontiguousarray(np.where(beyond, np.copysign(NO_SINE, angle), np.sin(angle)))


@njit(**PART, **EXACT)
def _sides(rows: FloatArray, p: int, x: float, y: float, z: float) -> tuple[float, float]:
    """Way ahead of the plane and range of a point at a pulse, whose quotient is s.

    `rows` (6, n_pulse) has the antenna's position, m, and the beam's axis.
    """
    dx, dy, dz = x - rows[0, p], y - rows[1, p], z - rows[2, p]
    return dx * rows[3, p] + dy * rows[4, p] + dz * rows[5, p], np.sqrt(dx * dx + dy * dy + dz * dz)


@njit(**PART, **EXACT)
def _offset(rows: FloatArray, steering: FloatArray, p: int, x: float, y: float, z: float) -> float:
    ahead, distance = _sides(rows, p, x, y, z)
    return math.asin(min(max(ahead / distance, -1.0), 1.0)) - steering[p]


@njit(**PART, **EXACT)
def _first(
    rows: FloatArray, rises: bool, least: FloatArray, most: FloatArray, beyond: bool, low: int, high: int, x: float,
    y: float, z: float,
) -> int:  # fmt: skip
    """First of the pulses low <= p < high at which s reaches `least` where it rises, or else `most`; high if none.

    `beyond`: exceeds them.
    """
    while low < high:
        middle = (low + high) // 2
        ahead, distance = _sides(rows, middle, x, y, z)
        if rises:
            limit = least[middle] * distance
            reached = ahead > limit if beyond else ahead >= limit
        else:
            limit = most[middle] * distance
            reached = ahead < limit if beyond else ahead <= limit
        low, high = (low, middle) if reached else (middle + 1, high)
    return low


@loop(REAL_ROWS, *PLACES, FLAGS, REAL_ROW, REAL_ROW, PULSES, **EXACT)
def find_first(
    rows: FloatArray, x: FloatArray, y: FloatArray, z: FloatArray, rises: BoolArray, least: FloatArray,
    most: FloatArray, found: IntArray,
) -> None:  # fmt: skip
    """First pulse at which s of each point, which rises or falls throughout, reaches `least`, or `most` where it falls.

    Parameters
    ----------
    rows : (6, n_pulse) float
        Position of the antenna, m, and axis of the beam.
    x, y, z : (n,) float
        m
    rises : (n,) bool
    least, most : (n_pulse,) float
    found : (n,) int
        Written; n_pulse where there is none.
    """
    for k in range(x.size):
        found[k] = _first(rows, rises[k], least, most, False, 0, rows.shape[1], x[k], y[k], z[k])


@loop(REAL_ROWS, REAL_ROW, INDICES, *PLACES, PULSES, types.bool_[::1], **EXACT)
def find_turning(
    rows: FloatArray, steering: FloatArray, nodes: IntArray, x: FloatArray, y: FloatArray, z: FloatArray,
    turning: IntArray, rises: BoolArray,
) -> None:  # fmt: skip
    """The pulse at which the offset of each point turns back, and whether it rises before that.

    The pulse is 0 where it never turns, -1 where it does so more than once, between the pulses `nodes` at least.
    """
    for k in range(x.size):
        count, where, up, first = 0, 0, False, False
        last = _offset(rows, steering, nodes[0], x[k], y[k], z[k])
        for i in range(1, nodes.size):
            offset = _offset(rows, steering, nodes[i], x[k], y[k], z[k])
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
                middle = min((low + high) // 2, rows.shape[1] - 2)
                step = _offset(rows, steering, middle + 1, x[k], y[k], z[k]) > _offset(
                    rows, steering, middle, x[k], y[k], z[k]
                )
                low, high = (middle + 1, high) if step == first else (low, middle)
            turning[k] = low


@loop(REAL_ROWS, REAL_ROW, REAL_ROW, *PLACES, INDICES, FLAGS, PASSES, PASSES, **EXACT)
def find_passages(
    rows: FloatArray, low: FloatArray, high: FloatArray, x: FloatArray, y: FloatArray, z: FloatArray,
    turning: IntArray, rises: BoolArray, firsts: IntArray, lasts: IntArray,
) -> None:  # fmt: skip
    """Write the passes (2, n) of points whose offsets turn back once at most, as `find_turning` has them.

    Pulses first <= p < last are lit, of sines low <= s <= high. Those of other points are left as they are.
    """
    n = rows.shape[1]
    for k in range(x.size):
        if turning[k] < 0:
            continue
        middle = turning[k] if turning[k] > 0 else n
        a = _first(rows, rises[k], low, high, False, 0, middle, x[k], y[k], z[k])
        b = _first(rows, rises[k], high, low, True, a, middle, x[k], y[k], z[k])
        c = _first(rows, not rises[k], low, high, False, middle, n, x[k], y[k], z[k])
        d = _first(rows, not rises[k], high, low, True, c, n, x[k], y[k], z[k])
        if a == b or c in (b, d):  # one pass
            firsts[0, k], lasts[0, k] = c if a == b else a, b if c == d else d
            firsts[1, k] = lasts[1, k] = 0
        else:
            firsts[0, k], lasts[0, k], firsts[1, k], lasts[1, k] = a, b, c, d


@njit(**PART, **EXACT)
def _light(
    rows: FloatArray, low: FloatArray, high: FloatArray, start: int, end: int, x: float, y: float, z: float, lit: Any
) -> None:
    for p in range(start, end):
        ahead, distance = _sides(rows, p, x, y, z)
        lit[p] = (ahead >= low[p] * distance) & (ahead <= high[p] * distance)


@loop(REAL_ROWS, REAL_ROW, REAL_ROW, *PLACES, *[INDICES] * 4, PASSES, PASSES, **EXACT)
def find_all_passes(
    rows: FloatArray, low: FloatArray, high: FloatArray, x: FloatArray, y: FloatArray, z: FloatArray, start: IntArray,
    end: IntArray, sure: IntArray, unsure: IntArray, firsts: IntArray, lasts: IntArray,
) -> int:  # fmt: skip
    """Write the passes (m, n) of points, looking at all pulses start <= p < end of each but those that are surely lit.

    Those are sure <= p < unsure, perhaps none. At other pulses it is dark. Returns the largest number of passes of a
    point: if that is above m, some are not written. Passes that a point lacks are 0 and 0.
    """
    most, lit = 0, np.empty(rows.shape[1], np.uint8)
    for k in range(x.size):
        a, b, c, d = start[k], end[k], sure[k], unsure[k]
        if c < d:
            _light(rows, low, high, a, c, x[k], y[k], z[k], lit)
            _light(rows, low, high, d, b, x[k], y[k], z[k], lit)
        else:
            c = d = b
            _light(rows, low, high, a, b, x[k], y[k], z[k], lit)
        for m in range(firsts.shape[0]):
            firsts[m, k] = lasts[m, k] = 0
        count, before = 0, False
        p = a
        while p <= b:
            now = (p == c and c < d) or (p < b and lit[p] != 0)
            if now and not before:
                if count < firsts.shape[0]:
                    firsts[count, k] = p
            elif before and not now:
                if count < firsts.shape[0]:
                    lasts[count, k] = p
                count += 1
            before = now
            p = d if p == c and c < d else p + 1
        most = max(most, count)
    return most
