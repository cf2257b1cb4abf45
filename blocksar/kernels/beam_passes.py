"""Which pulses of a beam about the antenna's axis light points, compiled.

With s the sine of the angle between the line of sight and the plane normal to the axis, a point is lit at a pulse while
steering - half <= asin(s) <= steering + half. Sines are compared instead: of both limits there is one for each pulse.
No operations are contracted, so that a point is lit or not whichever loop asks.
"""

from __future__ import annotations

import math
from typing import Any

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
LOW, HIGH = 6, 7  # columns of a table with the limits of sines
NO_SINE = 2.0  # a limit that no sine reaches
NEARER, ROUNDING = 0.1, 1e-12


def beam_table(position: FloatArray, axis: FloatArray, steering: FloatArray, half: float) -> FloatArray:
    """What the loops need of each pulse, (n_pulse, 8), in one line of the cache.

    Position of the antenna (n_pulse, 3), m; axis of the beam (n_pulse, 3); sines `half` rad before and behind the
    beam's centre, with which those of points are compared as their angles would be. `half` may be negative.
    """
    table = np.empty((steering.size, 8))
    table[:, :3], table[:, 3:6] = position, axis
    for column, way in ((LOW, -1.0), (HIGH, 1.0)):
        angle = steering + way * half
        table[:, column] = np.where(np.abs(angle) > np.pi / 2, np.copysign(NO_SINE, angle), np.sin(angle))
    return table


def largest_steps(table: FloatArray) -> tuple[float, float]:
    """What the antenna moves by from a pulse to the next, m, and what axis and limits change by, at most."""
    steps = np.abs(np.diff(table, axis=0))
    moved, turned = (np.sqrt((part**2).sum(axis=1)).max(initial=0.0) for part in (steps[:, :3], steps[:, 3:LOW]))
    return float(moved), float(turned + steps[:, LOW:].max(initial=0.0))


@njit(**PART, **EXACT)
def _sides(table: FloatArray, p: int, x: float, y: float, z: float) -> tuple[float, float]:
    """Way ahead of the plane and range of a point at a pulse, m, whose quotient is s."""
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
    """First pulse at which s of each point, which rises or falls throughout, reaches the limit behind it.

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
    """The pulse at which the offset of each point turns back, and whether it rises before that.

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


@loop(REAL_ROWS, *PLACES, types.float64, types.float64, PASSES, PASSES, **EXACT)
def find_passes(
    table: FloatArray, x: FloatArray, y: FloatArray, z: FloatArray, moved: float, turned: float, firsts: IntArray,
    lasts: IntArray,
) -> int:  # fmt: skip
    """Write the passes (m, n) of points: pulses first <= p < last, in the order of time, of sines within the limits.

    From pulse to pulse the line of sight turns by no more than what the antenna moves by over the range, and s by that
    and what the axis turns by: all pulses before s can have reached a limit are as the one that was looked at.

    Parameters
    ----------
    table : (n_pulse, 8) float
        From `beam_table`.
    x, y, z : (n,) float
        m; NaN is never lit.
    moved, turned : float
        From `largest_steps`.
    firsts, lasts : (m, n) int
        Passes that a point lacks are 0 and 0.

    Returns
    -------
    int
        The largest number of passes of a point: if that is above m, some are not written.
    """
    most, n = 0, table.shape[0]
    for k in range(x.size):
        for m in range(firsts.shape[0]):
            firsts[m, k] = lasts[m, k] = 0
        count, p, before = 0, 0, False
        while p < n:
            ahead, distance = _sides(table, p, x[k], y[k], z[k])
            if np.isnan(ahead):
                break
            low, high = table[p, LOW], table[p, HIGH]
            now = ahead >= low * distance and ahead <= high * distance
            if now != before:
                if count < firsts.shape[0]:
                    if now:
                        firsts[count, k] = p
                    else:
                        lasts[count, k] = p
                count += 0 if now else 1
            before = now
            s = ahead / distance
            spare = min(s - low, high - s) if now else max(low - s, s - high)
            # Over pulses in which the range changes by a part NEARER at most.
            rate = moved / ((1 - NEARER) * distance) + turned
            steps = min((spare - ROUNDING) / max(rate, ROUNDING), NEARER * distance / max(moved, ROUNDING))
            p += max(int(min(steps, n)), 1)
        if before:
            if count < lasts.shape[0]:
                lasts[count, k] = n
            count += 1
        most = max(most, count)
    return most
