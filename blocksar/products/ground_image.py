"""The complex image of a run at any place of its ground.

Pixels turn with the carrier, 4 pi fc / c R, by many turns from one to the next. Before they are interpolated, the phase
of the carrier at the middle of the dwell is taken off each, with R of its own place and height; the phase at the new
place is put back afterwards. What is left is band-limited. That middle is of one place for all of a part of the image;
where dwells move on so fast that other places of it are left beyond the band of the interpolation, it is divided.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from blocksar.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from blocksar.collection.geometry import Geometry
from blocksar.constants import SPEED_OF_LIGHT, TURN
from blocksar.kernels.posts import HALF_TAPS, sample_places
from blocksar.products.sicd.layout import centre_time, find_support, lines_of_sight
from blocksar.runs.finished import FinishedRun

BAND = 0.39  # cycles a sample, that the interpolation passes
ROOM = 0.02  # cycles a sample, beyond a band that is wider than that
LEAST_PIXELS = 16  # a side of a part that is divided


@dataclass(frozen=True, eq=False)
class GroundImage:
    """The image of a run, to be read between its pixels."""

    source: FinishedRun

    def nearest(self, x: FloatArray, y: FloatArray) -> tuple[IntArray, IntArray]:
        """Row and column of the pixels nearest to places x, y (...), m; they may lie outside the image."""
        at = self._indices(x, y)
        return np.rint(at[0]).astype(np.int64), np.rint(at[1]).astype(np.int64)

    def covered(self, x: FloatArray, y: FloatArray) -> BoolArray:
        """Whether the pixels nearest to places x, y (...), m, near one another, are covered."""
        row, column = self.nearest(x, y)
        inside = (row >= 0) & (row < self.source.y.size) & (column >= 0) & (column < self.source.x.size)
        if not inside.any():
            return inside
        rows, columns = (slice(int(at[inside].min()), int(at[inside].max()) + 1) for at in (row, column))
        block = self.source.read_block(rows, columns)
        inside[inside] = block[row[inside] - rows.start, column[inside] - columns.start] >= 0
        return inside

    def at(self, x: FloatArray, y: FloatArray, *, carried_to: FloatArray | None = None) -> ComplexArray:
        """The image (...) at places x, y (...), m, near one another; NaN where it is not covered.

        The carrier is that of the places, or of other points (..., 3) of the same range and Doppler, m.
        """
        out = np.full(x.shape, np.nan, np.complex64)
        seen = self.covered(x, y)
        if not seen.any():
            return out
        if (halves := self._halves(x, y, seen)) is not None:
            for half in halves:
                out[half] = self.at(x[half], y[half], carried_to=None if carried_to is None else carried_to[half])
            return out
        row, column = self._indices(x[seen], y[seen])
        rows, columns = _around(row, self.source.y.size), _around(column, self.source.x.size)
        middle = float(x[seen].mean()), float(y[seen].mean())
        geometry = self.source.geometry_at(*middle)
        carrier = _Carrier.about(geometry, *middle)
        pixels = self.source.read(rows, columns)
        own = carrier.turns(self.source.x[columns], self.source.y[rows][:, None])
        level = np.where(np.isfinite(pixels) & np.isfinite(own), pixels, 0) * _phasor(-np.nan_to_num(own))
        found = sample_places(level, row=row - rows.start, column=column - columns.start)
        if carried_to is None:
            out[seen] = found * _phasor(carrier.turns(x[seen], y[seen]))
        else:
            out[seen] = found * _phasor(carrier.turns_at(carried_to[seen]))
        return out

    def _halves(self, x: FloatArray, y: FloatArray, seen: BoolArray) -> tuple[BoolArray, BoolArray] | None:
        """Two halves of places, masks (...), if the carrier of their middle leaves some beyond the band; else None."""
        spacing, low, high = np.array(self.source.spacing), [], []
        for axis in (x[seen], y[seen]):
            low.append(float(axis.min()))
            high.append(float(axis.max()))
        pixels = (np.array(high) - low) / spacing
        if pixels.max() < LEAST_PIXELS:
            return None
        middle = float(x[seen].mean()), float(y[seen].mean())
        geometry = self.source.geometry_at(*middle)
        time = _Carrier.about(geometry, *middle).time
        worst, wanted = 0.0, BAND
        for corner in ((low[0], low[1]), (high[0], low[1]), (low[0], high[1]), (high[0], high[1])):
            point = _on_ground(geometry, *corner)
            support = find_support(geometry, point).frequencies
            at = np.array([time, centre_time(geometry, point)])
            carriers = 2 * geometry.collection.carrier / SPEED_OF_LIGHT * lines_of_sight(geometry, point, at)[:, :2]
            used, own = (float(np.abs((support - carrier) * spacing).max()) for carrier in carriers)
            worst, wanted = max(worst, used), max(wanted, own + ROOM)
        if worst <= wanted:
            return None
        longer = int(np.argmax(pixels))
        first = np.asarray((x, y)[longer] < (low[longer] + high[longer]) / 2)
        return first, ~first

    def _indices(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Fractional row and column of places, m."""
        dx, dy = self.source.spacing
        return (y - self.source.y[0]) / dy, (x - self.source.x[0]) / dx


@dataclass(frozen=True, eq=False)
class _Carrier:
    """The phase of the carrier at one slow time, over the ground."""

    geometry: Geometry
    time: float
    origin: float

    @classmethod
    def about(cls, geometry: Geometry, x: float, y: float) -> _Carrier:
        """Carrier at the middle of the dwell of a place x, y, m, where its phase vanishes."""
        point = _on_ground(geometry, x, y)
        time = centre_time(geometry, point)
        return cls(geometry, time, float(geometry.range_history(point, np.array(time))[0]))

    def turns(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """2 fc / c (R - R0), turns, of ground places x, y (broadcast), m; NaN where the ground has no height."""
        return self.turns_at(self.geometry.on_ground(x, y))

    def turns_at(self, points: FloatArray) -> FloatArray:
        """Turns of the carrier at points (..., 3), m."""
        distance = self.geometry.range_history(points, np.array(self.time))[0]
        return 2 * self.geometry.collection.carrier / SPEED_OF_LIGHT * (distance - self.origin)


def _on_ground(geometry: Geometry, x: float, y: float) -> FloatArray:
    """The ground point (3,) at x, y, m; at the mean height where its own is not known."""
    return np.nan_to_num(geometry.on_ground(np.array(x), np.array(y)), nan=geometry.collection.ground_height)


def _phasor(turns: FloatArray) -> ComplexArray:
    phase = (TURN * (turns - np.rint(turns))).astype(np.float32)
    return np.asarray(np.cos(phase) + 1j * np.sin(phase), np.complex64)


def _around(index: FloatArray, size: int) -> slice:
    """The samples that places in samples (n,) take."""
    first = max(int(np.floor(index.min())) - HALF_TAPS + 1, 0)
    return slice(first, min(int(np.floor(index.max())) + HALF_TAPS + 1, size))
