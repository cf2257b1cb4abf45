"""Parts of an image and what pulses see of them: ranges along the track, delays and Dopplers about a part's centre."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from blocksar.arrays import FloatArray, IntArray
from blocksar.collection.collection import Collection

VELOCITY_PULSES = 4  # on either side of a pulse, over which the antenna's velocity is taken


class Path:
    """Antenna positions, continued beyond both ends by their mirror image, with the filters' tails in mind.

    Mirrored through its end point, a track goes on with the same velocity.

    Parameters
    ----------
    collection : Collection
    """

    def __init__(self, collection: Collection) -> None:
        self.beyond = collection.n_pulse - 1  # pulses by which it is continued at either end
        self._position = np.pad(
            collection.antenna_position, ((self.beyond, self.beyond), (0, 0)), mode="reflect", reflect_type="odd"
        )

    def at(self, pulses: IntArray) -> FloatArray:
        """Positions (n, 3) at pulses (n,), m; beyond what is continued, those of its ends."""
        return self._position[np.clip(pulses + self.beyond, 0, self._position.shape[0] - 1)]

    def ranges(self, pulses: IntArray, point: FloatArray) -> FloatArray:
        """Ranges (n,) of a point (3,) at pulses (n,), m."""
        x, y, z = (self.at(pulses) - point).T
        return np.asarray(np.sqrt(x * x + y * y + z * z))

    def reach(self, pulses: IntArray, centre: FloatArray, corners: FloatArray) -> tuple[float, float]:
        """Largest |R_x - R_c| of corners x (k, 3), m, at pulses (n,), and its largest change per pulse, m."""
        position, last = self.at(pulses), self._position.shape[0] - 1 - self.beyond
        before = np.maximum(pulses - VELOCITY_PULSES, -self.beyond)
        after = np.minimum(pulses + VELOCITY_PULSES, last)
        velocity = (self.at(after) - self.at(before)) / (after - before)[:, None]
        away = change = 0.0
        sight = position - centre
        distance = np.sqrt((sight * sight).sum(axis=1))
        rate = (sight * velocity).sum(axis=1) / distance
        for corner in corners:
            sight = position - corner
            other = np.sqrt((sight * sight).sum(axis=1))
            away = max(away, float(np.abs(other - distance).max()))
            change = max(change, float(np.abs((sight * velocity).sum(axis=1) / other - rate).max()))
        return away, change


@dataclass(frozen=True, kw_only=True, eq=False)
class Part:
    """Pixels, and the pulses first <= p < last of one pass of the beam that light them.

    Attributes
    ----------
    x, y : (n_column,), (n_row,) float
        m, scene frame.
    z : (n_row, n_column) float, or of no dimension
        m, absolute.
    first, last : (n_row, n_column) int
    """

    x: FloatArray
    y: FloatArray
    z: FloatArray
    first: IntArray
    last: IntArray

    def within(self, window: tuple[slice, slice]) -> Part:
        """The part of some rows and columns."""
        rows, columns = window
        z = self.z[window] if self.z.ndim else self.z
        return Part(x=self.x[columns], y=self.y[rows], z=z, first=self.first[window], last=self.last[window])

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.y.size, self.x.size

    @property
    def centre(self) -> FloatArray:
        """The middle (3,) of the box around it, m."""
        return self.corners.mean(axis=0)

    @property
    def corners(self) -> FloatArray:
        """Corners (k, 3) of the box around it, m."""
        ends = [self.x[[0, -1]], self.y[[0, -1]], np.unique([self.z.min(), self.z.max()])]
        return np.stack([axis.ravel() for axis in np.meshgrid(*ends)], axis=1)

    @property
    def side(self) -> float:
        """The longer side, m."""
        return float(max(abs(self.x[-1] - self.x[0]), abs(self.y[-1] - self.y[0])))

    def lit(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Pulses begin <= p < end that light some of it, and first <= p < last that light all of it; or none."""
        lit = self.last > self.first
        if not lit.any():
            return (0, 0), (0, 0)
        some = int(self.first[lit].min()), int(self.last[lit].max())
        whole = int(self.first.max()), int(self.last.min())
        return some, whole if lit.all() and whole[0] < whole[1] else (some[1], some[1])

    def divide(self, side: float) -> Iterator[tuple[slice, slice]]:
        """Rows and columns of its parts of at most `side` m, all about as large."""
        spans = []
        for axis in (self.y, self.x):
            count = min(max(int(np.ceil(abs(axis[-1] - axis[0]) / side)), 1), axis.size)
            ends = [axis.size * i // count for i in range(count + 1)]
            spans.append([slice(a, b) for a, b in zip(ends[:-1], ends[1:], strict=True)])
        return ((rows, columns) for rows in spans[0] for columns in spans[1])
