"""The power about a chip that its errors may come from, and what a comparison of the chip then says.

A processor spreads an error of the power 2 (1 - g) of each target about its place, with g the coherence that is
predicted for clutter of even power. Where the ground about a chip is brighter, its error is larger than that of the
chip's own echoes. How an error is spread is not known; but if it falls with the distance along x and along y, its power
over distance is a mixture of boxes about the target. So the error of a pixel is 2 (1 - g) times at most the largest
mean power M of any box about it, and the error of a chip of mean power P relative to that is the one that is predicted

    1 / c^2 - 1 <= (1 / g^2 - 1) reach / P,    reach = mean of M over the chip, at least P,

with c the coherence of the chip, whose error does not depend on its echoes. `referred` solves this for g.
"""

from __future__ import annotations

import math
from itertools import product

import numpy as np

from blocksar.arrays import FloatArray

CELL = 8  # pixels along the side of the cells whose powers are averaged
SIDES = (3, 7, 15, 31, 63)  # cells along the sides of boxes: the least are wide enough for speckle to even out


def power_within_reach(power: FloatArray, rows: slice, columns: slice) -> float:
    """Mean over a chip of the largest mean power of any box about its pixels.

    Parameters
    ----------
    power : (n_y, n_x) float
        |pixels|^2 of a chip and its surroundings; NaN where not covered.
    rows, columns : slice
        The chip among them.
    """
    covered = np.isfinite(power)
    filled, share = _cells(np.where(covered, power, 0.0)), _cells(covered.astype(np.float64))
    largest = np.zeros(filled.shape)
    for sides in product(SIDES, SIDES):
        weight = _boxes(share, sides)
        np.maximum(largest, _boxes(filled, sides) / np.maximum(weight, 1e-12), out=largest, where=weight > 1e-12)
    chip = (slice(span.start // CELL, -(-span.stop // CELL)) for span in (rows, columns))
    return float(largest[tuple(chip)].mean())


def referred(coherence: float, ratio: float) -> float:
    """Coherence of a chip as if its power were that within reach, `ratio` times its own.

    Examples
    --------
    >>> round(referred(0.98, 30.0), 5), referred(0.9993, 1.0)
    (0.99931, 0.9993)
    """
    ratio = max(ratio, 1.0)
    return 1 / math.sqrt(1 + (1 / coherence**2 - 1) / ratio) if coherence > 0 and ratio > 1 else coherence


def _cells(values: FloatArray) -> FloatArray:
    """Sums over cells of CELL x CELL pixels, fewer at the ends."""
    rows, columns = (np.arange(0, size, CELL) for size in values.shape)
    return np.asarray(np.add.reduceat(np.add.reduceat(values, rows, axis=0), columns, axis=1))


def _boxes(values: FloatArray, sides: tuple[int, int]) -> FloatArray:
    """Sums over boxes of `sides` cells, an odd number, about each cell; less at the ends."""
    for axis, side in enumerate(sides):
        total = np.cumsum(np.insert(values, 0, 0.0, axis=axis), axis=axis)
        index, last = np.arange(values.shape[axis]), values.shape[axis]
        high, low = np.minimum(index + side // 2 + 1, last), np.maximum(index - side // 2, 0)
        values = total.take(high, axis=axis) - total.take(low, axis=axis)
    return values
