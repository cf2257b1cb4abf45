"""Strips that are longer than one epoch serves: segments along time, each planned about its own middle.

Under a beam about the antenna's axis, a strip may be any number of dwells long, but range histories that are expanded
about one epoch serve a few of them only. Segments overlap by more than the longest dwell: ground in the middle of what
two share has its full dwell in both, and there the seam runs.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from blocksar.collection.beam import aperture, dwell
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.collection.ownership import dwell_margin
from blocksar.collection.region import Owned

GUARD = 0.3  # dwells by which segments overlap besides the dwell, since its ends ring
SLACK = 0.05  # dwells by which a segment's blocks reach beyond its seams
LEAST_LENGTH = 2.5  # overlaps that a segment has at least
GROWTH = 1.5  # of the number of segments, as long as that gains
GRID_POINTS = 33  # along each side of a grid, at which dwells are looked at
POINTS_EACH = 6  # and for each segment besides, to see whether it has ground there

Span = tuple[int, int]  # pulses first <= p < last


def longest_dwell(collection: Collection, grid: Grid) -> float:
    """The longest dwell of ground in a grid that the collection lights, s, as if it went on; 0 if it lights none."""
    geometry = Geometry(collection=collection)
    places = np.linspace(grid.x[0], grid.x[-1], GRID_POINTS), np.linspace(grid.y[0], grid.y[-1], GRID_POINTS)
    first, last = dwell(geometry, *np.meshgrid(*places), uncut=True)
    start, end = aperture(collection)
    lit = (last > start) & (first < end) & (last > first)
    return float(np.where(lit, last - first, 0.0).max())


def cuts(collection: Collection, dwell_time: float) -> Iterator[list[Span]]:
    """Ever more segments of equal length, each time their spans; ends where they would become too short."""
    overlap = math.ceil((1 + GUARD) * dwell_time * collection.prf)
    count, n = 2, collection.n_pulse
    while overlap:
        length = math.ceil((n + (count - 1) * overlap) / count)
        if length < LEAST_LENGTH * overlap:
            return
        firsts = [round(k * (n - length) / (count - 1)) for k in range(count)]
        yield [(first, first + length) for first in firsts]
        count = math.ceil(count * GROWTH)


def within(collection: Collection, spans: Sequence[Span], grid: Grid) -> list[Span]:
    """The segments that see some ground of a grid deepest inside their time."""
    count = GRID_POINTS + POINTS_EACH * len(spans)
    x, y = np.meshgrid(np.linspace(grid.x[0], grid.x[-1], count), np.linspace(grid.y[0], grid.y[-1], count))
    margins = np.array([dwell_margin(Geometry(collection=collection.segment(*span)), x, y) for span in spans])
    seen = margins.max(axis=0) > -1.0
    return [span for k, span in enumerate(spans) if (seen & (margins.argmax(axis=0) == k)).any()]


def owned_by(collection: Collection, spans: Sequence[Span], number: int) -> Owned:
    """Which ground a segment images: what its neighbours see less deep inside their time, and a little beyond."""
    own, *others = (
        Geometry(collection=collection.segment(*spans[k]))
        for k in (number, number - 1, number + 1)
        if 0 <= k < len(spans)
    )

    def owned(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        margin = dwell_margin(own, x, y)
        beyond = [dwell_margin(other, x, y) for other in others]
        with np.errstate(invalid="ignore"):
            return (margin > -1.0) & (margin >= np.max(beyond, axis=0, initial=-np.inf) - SLACK)

    return owned
