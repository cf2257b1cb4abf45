"""Parts of an image and what pulses see of them: ranges along the track, delays and Dopplers about a part's centre."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise, product

import numpy as np

from blocksar.arrays import FloatArray, IntArray
from blocksar.collection.geometry import Geometry

BORDER = np.array([(x, y, z) for z in (0, 2) for x, y in product((0, 1, 2), repeat=2)])  # of a box: see `Part.border`
BEND_NODES = 256  # pulses at which it is found how Doppler bends over a dwell


class Path:
    """Antenna positions, continued beyond both ends by their mirror image: the tails of filters lie there.

    Mirrored through its end point, a track goes on with the same velocity. Ranges follow the positions as they are,
    bounds the smooth track.

    Parameters
    ----------
    geometry : Geometry

    Attributes
    ----------
    beyond : int
        Pulses by which the track is continued at either end.
    noise : float
        Root mean square of what positions have besides the smooth track, m.
    speed : float
        Largest way of the antenna per pulse, m.
    """

    def __init__(self, geometry: Geometry) -> None:
        collection, track = geometry.collection, geometry.track
        self.beyond = collection.n_pulse - 1
        self._position, self._smooth = (
            np.pad(positions, ((self.beyond, self.beyond), (0, 0)), mode="reflect", reflect_type="odd")
            for positions in (collection.antenna_position, track.position(collection.time))
        )
        self._velocity = np.gradient(self._smooth, axis=0)
        self.noise = float(np.sqrt(np.mean(track.misfit**2)))
        self.speed = float(np.linalg.norm(self._velocity, axis=1).max())

    def _index(self, pulses: IntArray) -> IntArray:
        """Where pulses are kept; beyond what is continued, its ends."""
        return np.clip(pulses + self.beyond, 0, self._position.shape[0] - 1)

    def at(self, pulses: IntArray) -> FloatArray:
        """Positions (n, 3) at pulses (n,), m."""
        return self._position[self._index(pulses)]

    def ranges(self, pulses: IntArray, point: FloatArray) -> FloatArray:
        """Ranges (n,) of a point (3,) at pulses (n,), m."""
        x, y, z = (self.at(pulses) - point).T
        return np.asarray(np.sqrt(x * x + y * y + z * z))

    def reach(self, pulses: IntArray, part: Part) -> tuple[float, FloatArray]:
        """How far a part reaches, seen at pulses (n,).

        Returns
        -------
        away : float
            Largest |R_x - R_c| of points x of its border, m.
        change : (n, k) float
            Change of R_x - R_c from a pulse to the next, of each of them, m.
        """
        kept = self._index(pulses)
        points = np.concatenate([part.centre[None], part.border])
        sight = self._smooth[kept][:, None] - points
        distance = np.sqrt((sight * sight).sum(axis=2))
        rate = (sight * self._velocity[kept][:, None]).sum(axis=2) / distance
        return float(np.abs(distance[:, 1:] - distance[:, :1]).max()), rate[:, 1:] - rate[:, :1]

    def bend(self, low: int, high: int, part: Part) -> float:
        """Largest second derivative of that change over its largest, from pulse low to high, per pulse^2."""
        step = max((high - low) // BEND_NODES, 1)
        change = self.reach(np.arange(low, high + 1, step), part)[1]
        if change.shape[0] < 3:
            return 0.0
        return float(np.abs(np.diff(change, 2, axis=0)).max() / step**2 / np.abs(change).max())


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

    @cached_property
    def _box(self) -> FloatArray:
        """Low end, middle and high end (3, 3) of x, y and z."""
        ends = np.array([(axis.min(), axis.max()) for axis in (self.x, self.y, self.z)])
        return np.stack([ends[:, 0], ends.mean(axis=1), ends[:, 1]])

    @property
    def centre(self) -> FloatArray:
        """The middle (3,) of the box around it, m."""
        return self._box[1]

    @property
    def border(self) -> FloatArray:
        """Corners of the box around it and the middles between them, (k, 3) m: what is farthest from the centre.

        Close by, the nearest point of a side is not one of its ends.
        """
        nodes = BORDER if self.z.ndim else BORDER[:9]  # on a plane its lower half is all of it
        return self._box[nodes, np.arange(3)]

    @property
    def side(self) -> float:
        """The longer side, m."""
        return float(max(abs(self.x[-1] - self.x[0]), abs(self.y[-1] - self.y[0])))

    def lit(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Pulses begin <= p < end that light some of it, and first <= p < last that light all that is lit; or none."""
        lit = self.last > self.first
        if not lit.any():
            return (0, 0), (0, 0)
        some = int(self.first[lit].min()), int(self.last[lit].max())
        whole = int(self.first[lit].max()), int(self.last[lit].min())
        return some, whole if whole[0] < whole[1] else (some[1], some[1])

    def divide(self, side: float) -> Iterator[tuple[slice, slice]]:
        """Rows and columns of its parts of at most `side` m, all about as large."""
        spans = []
        for axis in (self.y, self.x):
            count = min(max(int(np.ceil(abs(axis[-1] - axis[0]) / side)), 1), axis.size)
            ends = [axis.size * i // count for i in range(count + 1)]
            spans.append([slice(a, b) for a, b in pairwise(ends)])
        return ((rows, columns) for rows in spans[0] for columns in spans[1])
