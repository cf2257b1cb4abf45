"""Overviews of a GeoTIFF: each level has half as many rows and columns, and what the product holds of the mean there.

Means are of what was measured, before it is coded: power for amplitude and decibels, whose own means say nothing. A
cell of level k is the mean of all covered pixels among the 2^k x 2^k that it stands for; not that of the means of the
level above, which at the edge of what is covered would count some pixels more than others. Complex pixels, whose mean
is no image, and flags have those of the north-western corner of each cell.

GDAL knows no such mean of decibels. So each level is a file of its own, which a VRT names as the overview of the
pixels, and GDAL copies them all into one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

NEAREST = ("complex", "visibility")  # contents without a mean
AT_ONCE = 1 << 18  # pixels of the full image

State = NDArray[Any]  # (1, rows, columns): pixels; (2, rows, columns): sums of what is covered, and how many


def sizes_of(width: int, height: int, tile: int) -> list[tuple[int, int]]:
    """Columns and rows of the levels, until one tile holds all.

    Examples
    --------
    >>> sizes_of(1300, 600, 512)
    [(650, 300), (325, 150)]
    """
    sizes = []
    while max(width, height) > tile:
        width, height = -(-width // 2), -(-height // 2)
        sizes.append((width, height))
    return sizes


class Level:
    """A level of overviews, written from north to south as the rows above it come in."""

    def __init__(self, write: Callable[[int, NDArray[Any]], None], below: Level | None) -> None:
        """`write` takes the number of a row and rows of what was measured."""
        self._write, self._below, self._row = write, below, 0
        self._held: State | None = None

    def take(self, rows: State) -> None:
        """Take rows of the level above; an odd one is held until the next comes."""
        rows = rows if self._held is None else np.concatenate([self._held, rows], axis=1)
        whole = rows.shape[1] // 2 * 2
        self._held = rows[:, whole:]
        self._put(rows[:, :whole])

    def end(self) -> None:
        """Write what is held, and end the levels below."""
        if self._held is not None:
            self._put(self._held)
        if self._below is not None:
            self._below.end()

    def _put(self, rows: State) -> None:
        if not rows.shape[1]:
            return
        halved = _halved(rows)
        self._write(self._row, _values(halved))
        self._row += halved.shape[1]
        if self._below is not None:
            self._below.take(halved)


def feed(first: Level, measured: NDArray[Any], *, nearest: bool) -> None:
    """Give the first level rows (rows, columns), from north to south, of what was measured; NaN where not covered."""
    step = max(AT_ONCE // measured.shape[1], 1)
    for start in range(0, len(measured), step):
        rows = measured[start : start + step]
        if nearest:
            first.take(rows[None])
        else:
            covered = ~np.isnan(rows)
            first.take(np.stack([np.where(covered, rows, 0), covered]).astype(np.float64))


def _halved(rows: State) -> State:
    """Sums over cells of 2 x 2, less at the end of an odd number; pixels of their first corner."""
    if len(rows) == 1:
        return rows[:, ::2, ::2]
    pairs = np.add.reduceat(rows, np.arange(0, rows.shape[1], 2), axis=1)
    return np.asarray(np.add.reduceat(pairs, np.arange(0, rows.shape[2], 2), axis=2))


def _values(rows: State) -> NDArray[Any]:
    if len(rows) == 1:
        return np.asarray(rows[0])
    total, count = rows
    return np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0).astype(np.float32)
