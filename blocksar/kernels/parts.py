"""Parts of an image: what lights them, and the rows of samples that lead from one to its parts; see `hierarchy`."""

from __future__ import annotations

import numpy as np
from numba import types

from blocksar.arrays import FloatArray, IntArray
from blocksar.kernels.loops import COMPILED, REAL_ROWS, loop

_LIGHT = types.Array(types.int64, 2, "A", readonly=True)
_HEIGHTS = types.Array(types.float64, 2, "A", readonly=True)
_INDICES = types.Array(types.int64, 1, "C", readonly=True)
_TABLE = types.Array(types.int64, 2, "C", readonly=True)


@loop(_LIGHT, _LIGHT, _HEIGHTS, _INDICES, _INDICES, types.int64[:, :, ::1], types.float64[:, :, ::1], **COMPILED)
def find_light(
    first: IntArray, last: IntArray, z: FloatArray, rows: IntArray, columns: IntArray, light: IntArray,
    heights: FloatArray,
) -> None:  # fmt: skip
    """Find the pulses that light the parts of an image between rows and columns, and their lowest and highest z.

    Parameters
    ----------
    first, last : (n_row, n_column) int
        Pulses first <= p < last light a pixel.
    z : (n_row, n_column) float
        m
    rows, columns : (n + 1,), (m + 1,) int
        Ends of the parts.
    light : (n, m, 4) int
        Becomes begin, end, first and last: pulses begin <= p < end light some of a part, first <= p < last all of it
        that is lit; the end twice where there are none, and zeros where none light any of it.
    heights : (n, m, 2) float
        m
    """
    for i in range(rows.size - 1):
        for j in range(columns.size - 1):
            begin, end = np.int64(2**62), np.int64(0)
            start, stop = np.int64(0), np.int64(2**62)
            low, high = np.inf, -np.inf
            for r in range(rows[i], rows[i + 1]):
                for c in range(columns[j], columns[j + 1]):
                    a, b = first[r, c], last[r, c]
                    if a < b:
                        begin, end, start, stop = min(begin, a), max(end, b), max(start, a), min(stop, b)
                    low, high = min(low, z[r, c]), max(high, z[r, c])
            if start >= stop:
                start = stop = end
            light[i, j, 0], light[i, j, 1] = min(begin, end), end
            light[i, j, 2], light[i, j, 3] = (start, stop) if end > 0 else (0, 0)
            heights[i, j, 0], heights[i, j, 1] = low, high


@loop(
    REAL_ROWS, types.int64, _INDICES, _TABLE, REAL_ROWS, REAL_ROWS, types.int64[::1], types.int64[::1],
    types.float64[::1], **COMPILED,
)  # fmt: skip
def find_rows(
    position: FloatArray, beyond: int, pulses: IntArray, taken: IntArray, above: FloatArray, below: FloatArray,
    source: IntArray, target: IntArray, turn: FloatArray,
) -> None:  # fmt: skip
    """Find the rows that lead from parts to parts of these, one such part after the other.

    Parameters
    ----------
    position : (n_position, 3) float
        Of the antenna at pulses from -beyond on, m; further ones count as the outermost.
    pulses : (n_row,) int
        Of each row of the parts.
    taken : (n, 6) int
        Of each part, the first of the rows that lead to it, and how many there are; the number of those at their
        beginning that stay edges, and the row that becomes of the first; the same of those at their end.
    above, below : (n, 3) float
        The centre to which these rows are referred, and that of the part, m.
    source, target : (n_taken,) int
        Become the row, and the row that becomes of it; -1 where that is filtered along pulses.
    turn : (n_taken,) float
        Becomes the range of the latter centre over that of the former, m.
    """
    at = 0
    for k in range(taken.shape[0]):
        first, count, early, into, late, behind = taken[k]
        ax, ay, az = above[k, 0], above[k, 1], above[k, 2]
        bx, by, bz = below[k, 0], below[k, 1], below[k, 2]
        for i in range(count):
            p = min(max(pulses[first + i] + beyond, 0), position.shape[0] - 1)
            x, y, z = position[p, 0], position[p, 1], position[p, 2]
            source[at], target[at] = first + i, -1
            if i < early:
                target[at] = into + i
            elif i >= count - late:
                target[at] = behind + i - (count - late)
            turn[at] = np.sqrt((x - bx) ** 2 + (y - by) ** 2 + (z - bz) ** 2) - np.sqrt(
                (x - ax) ** 2 + (y - ay) ** 2 + (z - az) ** 2
            )
            at += 1
