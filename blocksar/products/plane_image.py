"""The complex image of a run at any place of its ground; on a terrain also in the plane that SICD describes.

Pixels turn with the carrier, 4 pi fc / c R, by many turns from one to the next. Before they are interpolated, the phase
of the carrier at the middle of the dwell is taken off each, with R of its own place and height; the phase at the new
place is put back afterwards. What is left is band-limited. That middle is of one place for all of a part of the image;
where dwells move on so fast that other places of it are left beyond the band of the interpolation, it is divided.

*The plane.* A pixel of a SICD file on a plane stands for all places of the pixel's range and Doppler (at its centre of
aperture), and readers follow these to the surface that they project to. An image on a terrain has each place of the
ground where it stands instead: x and y are its own, whatever its height. So it is carried to the plane z =
ground_height: the pixel at a place of the plane shows the ground of equal range and Doppler, with the phase that the
plane's own range has. Projected to its height over the ellipsoid it comes to lie at its x and y. It is as sharp as the
image on the terrain.

Ground that shares range and Doppler with other ground (layover) is one pixel there; of several places the highest is
taken. The values are interpolated from the complex image (`GroundImage`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.polynomial import Chebyshev, Polynomial, polynomial
from numpy.polynomial import polynomial as power

from blocksar.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from blocksar.collection.beam import aperture
from blocksar.collection.geometry import Geometry
from blocksar.collection.georeference import Georeference
from blocksar.collection.terrain import Terrain
from blocksar.constants import SPEED_OF_LIGHT, TURN
from blocksar.kernels.occlusion import HeightGrid, find_heights
from blocksar.kernels.posts import HALF_TAPS, sample_places
from blocksar.products.shared_metadata import centre_time, find_support, lines_of_sight
from blocksar.runs.finished import STRIP, FinishedRun, Int16Array

# ---------------------------------------------------------------- places of the ground

BAND = 0.39  # cycles a sample, that the interpolation passes
ROOM = 0.02  # cycles a sample, beyond a band that is wider than that
LEAST_PIXELS = 16  # a side of a part that is divided


@dataclass(frozen=True, eq=False)
class GroundImage:
    """The image of a run, interpolated between its pixels."""

    source: FinishedRun

    def nearest(self, x: FloatArray, y: FloatArray) -> tuple[IntArray, IntArray]:
        """Row and column of the pixels nearest to places x, y (...), m, also outside the image."""
        at = self._indices(x, y)
        return np.rint(at[0]).astype(np.int64), np.rint(at[1]).astype(np.int64)

    def covered(self, x: FloatArray, y: FloatArray) -> BoolArray:
        """Tell whether the pixels nearest to adjacent places x, y (...), m, are covered."""
        row, column = self.nearest(x, y)
        inside = (row >= 0) & (row < self.source.y.size) & (column >= 0) & (column < self.source.x.size)
        if not inside.any():
            return inside
        rows, columns = (slice(int(at[inside].min()), int(at[inside].max()) + 1) for at in (row, column))
        block = self.source.read_block(rows, columns)
        inside[inside] = block[row[inside] - rows.start, column[inside] - columns.start] >= 0
        return inside

    def at(self, x: FloatArray, y: FloatArray, *, carried_to: FloatArray | None = None) -> ComplexArray:
        """Interpolate the image (...) at adjacent places x, y (...), m; NaN where it is not covered.

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
        """Halve places, as masks (...), if one carrier leaves some of them outside the band; else None."""
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
    """Phase of the carrier over the ground at one slow time."""

    geometry: Geometry
    time: float
    origin: float

    @classmethod
    def about(cls, geometry: Geometry, x: float, y: float) -> _Carrier:
        """Make the carrier at the middle of the dwell of a place x, y, m, zero there."""
        point = _on_ground(geometry, x, y)
        time = centre_time(geometry, point)
        return cls(geometry, time, float(geometry.range_history(point, np.array(time))[0]))

    def turns(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Phase 2 fc / c (R - R0), cycles, at ground places x, y (broadcast), m; NaN where the height is unknown."""
        return self.turns_at(self.geometry.on_ground(x, y))

    def turns_at(self, points: FloatArray) -> FloatArray:
        """Phase of the carrier, cycles, at points (..., 3), m."""
        distance = self.geometry.range_history(points, np.array(self.time))[0]
        return 2 * self.geometry.collection.carrier / SPEED_OF_LIGHT * (distance - self.origin)


def _on_ground(geometry: Geometry, x: float, y: float) -> FloatArray:
    """Ground point (3,) at x, y, m; at the mean height if its own is unknown."""
    return np.nan_to_num(geometry.on_ground(np.array(x), np.array(y)), nan=geometry.collection.ground_height)


def _phasor(turns: FloatArray) -> ComplexArray:
    phase = (TURN * (turns - np.rint(turns))).astype(np.float32)
    return np.asarray(np.cos(phase) + 1j * np.sin(phase), np.complex64)


def _around(index: FloatArray, size: int) -> slice:
    """Samples needed to interpolate at places (n,), in samples."""
    first = max(int(np.floor(index.min())) - HALF_TAPS + 1, 0)
    return slice(first, min(int(np.floor(index.max())) + HALF_TAPS + 1, size))


# ---------------------------------------------------------------- the plane of a SICD

MAX_ORDER = 7  # total, in both variables


class Poly2D(NamedTuple):
    """A polynomial in two variables: coefficients (n, n) of u^i v^j, and the largest error of its fit."""

    coefficients: FloatArray
    error: float


def fit_poly2d(u: FloatArray, v: FloatArray, values: FloatArray, accuracy: float) -> Poly2D:
    """Fit values (n,) by the polynomial of lowest total order that meets `accuracy`, by least squares.

    The order ends at MAX_ORDER, or where half as many coefficients as points are needed; `error` tells how well the
    last one fits.

    Parameters
    ----------
    u, v : (n,) float
        Variables: m from the scene centre point, along row and column.
    values : (n,) float
    accuracy : float
        Largest error to accept, in the unit of `values`.
    """
    scale_u, scale_v = max(float(np.abs(u).max()), 1e-9), max(float(np.abs(v).max()), 1e-9)
    for order in range(MAX_ORDER + 1):
        powers = [(i, j) for i in range(order + 1) for j in range(order + 1 - i)]
        basis = np.stack([(u / scale_u) ** i * (v / scale_v) ** j for i, j in powers], axis=1)
        scaled = np.linalg.lstsq(basis, values)[0]
        error = float(np.abs(basis @ scaled - values).max())
        if error <= accuracy or len(powers) * 2 > u.size:
            break
    coefficients = np.zeros((order + 1, order + 1))
    for (i, j), value in zip(powers, scaled, strict=True):
        coefficients[i, j] = value / scale_u**i / scale_v**j
    return Poly2D(coefficients, error)


def arp_polynomial(geometry: Geometry, frame: Georeference) -> tuple[FloatArray, float]:
    """Fit the track by a polynomial in ECEF; also its largest distance from the recorded antenna positions.

    Returns
    -------
    ((order + 1, 3) float, float)
        Coefficients by powers of time since the first pulse, m / s^k; distance, m.
    """
    track, time = geometry.track, geometry.collection.time
    domain = [track.centre - track.half - time[0], track.centre + track.half - time[0]]
    scene = np.zeros_like(track.coefficients)
    for axis, column in enumerate(track.coefficients.T):
        powers = Chebyshev(column, domain=domain).convert(kind=Polynomial, domain=[-1, 1], window=[-1, 1])
        scene[: powers.coef.size, axis] = powers.coef
    ecef = scene @ frame.axes
    ecef[0] += frame.origin
    positions = power.polyval(time - time[0], ecef).T
    misfit = np.linalg.norm(positions - frame.to_ecef(geometry.collection.antenna_position), axis=1)
    return ecef, float(misfit.max())


NODES = 65  # a side of the mesh by which limits and centres of aperture are found
TIME_ACCURACY = 1e-4  # of a dwell, that the polynomial of the centres of aperture may be off
TILE = 256  # pixels a side that are interpolated at a time
REFINEMENTS = 3  # of the height on the terrain between samples


@dataclass(frozen=True, eq=False)
class PlaneImage(FinishedRun):
    """A run on a terrain, presented as an image in the plane z = ground_height.

    Attributes
    ----------
    run : FinishedRun
        The run itself; `x`, `y` and `geometry` are those of the plane.
    """

    run: FinishedRun | None = None

    @classmethod
    def of(cls, run: FinishedRun) -> PlaneImage:
        """Make the plane's grid, at the image's spacing, over all ground that is seen through it."""
        flat = Geometry(collection=run.collection)
        points = _mesh(run, run.x, run.y)
        points = points[np.isfinite(points[:, 2])]
        places = _on_circle(run.geometry, points, _middles(run.geometry, points), run.ground_height)
        axes = []
        for axis, (pixels, step) in enumerate(zip((run.x, run.y), run.spacing, strict=True)):
            low, high = (
                np.rint((limit - pixels[0]) / step) for limit in (places[:, axis].min(), places[:, axis].max())
            )
            axes.append(pixels[0] + step * np.arange(low, high + 1))
        own = {field.name: getattr(run, field.name) for field in fields(FinishedRun)}
        return cls(**{**own, "x": axes[0], "y": axes[1], "geometry": flat, "segments": ()}, run=run)

    @property
    def on_terrain(self) -> FinishedRun:
        assert self.run is not None
        return self.run

    @property
    def terrain(self) -> Terrain:
        terrain = self.on_terrain.geometry.terrain
        assert terrain is not None
        return terrain

    @cached_property
    def _centre_of_aperture(self) -> Poly2D:
        """Fit the middles of dwells, s, of the visible ground over x and y from the middle of the image, m."""
        places = _mesh(self, self.x, self.y)
        ground = self._ground(places, _middles(self.geometry, places))
        seen = np.isfinite(ground[:, 2])
        first, last = self.on_terrain.geometry.beam.dwell(ground[seen, 0], ground[seen, 1])
        lit = first < last
        time = np.clip((first + last)[lit] / 2, *aperture(self.collection))
        u, v = (places[seen][lit, axis] - middle for axis, middle in enumerate(self._middle))
        return fit_poly2d(u, v, time, TIME_ACCURACY * float((last - first)[lit].mean()))

    @property
    def _middle(self) -> tuple[float, float]:
        return float(self.x.mean()), float(self.y.mean())

    @property
    def time_error(self) -> float:
        """Largest error of `times`, s."""
        return self._centre_of_aperture.error

    def times(self, places: FloatArray) -> FloatArray:
        """Centres of aperture (...), s, of places (..., 3) in the plane, m."""
        middle = self._middle
        coefficients = self._centre_of_aperture.coefficients
        return np.asarray(polynomial.polyval2d(places[..., 0] - middle[0], places[..., 1] - middle[1], coefficients))

    def ground(self, places: FloatArray) -> FloatArray:
        """Ground points (n, 3), m, with range and Doppler of places (n, 3) in the plane; NaN where there are none."""
        return self._ground(places, self.times(places))

    def read(self, rows: slice, columns: slice) -> ComplexArray:
        """Read pixels of the plane, (rows, columns); NaN without covered ground of their range and Doppler."""
        x, y = self.x[columns], self.y[rows]
        out, image = np.empty((y.size, x.size), np.complex64), GroundImage(self.on_terrain)
        for i in range(0, y.size, TILE):
            for j in range(0, x.size, TILE):
                places = self._places(x[j : j + TILE], y[i : i + TILE])
                ground = self.ground(places)
                seen = np.isfinite(ground[:, 2])
                values = np.full(seen.size, np.nan, np.complex64)
                if seen.any():
                    values[seen] = image.at(ground[seen, 0], ground[seen, 1], carried_to=places[seen])
                part = out[i : i + TILE, j : j + TILE]
                part[...] = values.reshape(part.shape)
        return out

    def read_block(self, rows: slice, columns: slice) -> Int16Array:
        """Read 0 for covered pixels of the plane and -1 for others, (rows, columns)."""
        places = self._places(self.x[columns], self.y[rows])
        ground = self.ground(places)
        seen: BoolArray = np.isfinite(ground[:, 2])
        if seen.any():
            seen[seen] = GroundImage(self.on_terrain).covered(ground[seen, 0], ground[seen, 1])
        return np.where(seen, 0, -1).astype(np.int16).reshape(self.y[rows].size, self.x[columns].size)

    def strips(self, axis: int) -> Iterator[slice]:
        """Divide the image along rows (axis 0) or columns (1) into parts of bounded size."""
        along, across = (self.y.size, self.x.size) if axis == 0 else (self.x.size, self.y.size)
        step = max(min(STRIP // 4 // across, TILE), 1)
        for first in range(0, along, step):
            yield slice(first, min(first + step, along))

    def noise_levels(self, count: int) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        return self.on_terrain.noise_levels(count)

    def _places(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Places (n, 3) of columns and rows of the plane, m."""
        at_x, at_y = np.meshgrid(x, y)
        return np.stack([at_x.ravel(), at_y.ravel(), np.full(at_x.size, self.ground_height)], axis=1)

    @cached_property
    def _samples(self) -> HeightGrid:
        return HeightGrid.of(self.terrain.heights, self.terrain.dx, self.terrain.dy)

    def _ground(self, places: FloatArray, time: FloatArray) -> FloatArray:
        """Ground points as from `ground`, at other centres of aperture (n,), s."""
        terrain, geometry = self.terrain, self.on_terrain.geometry
        antenna, velocity = geometry.track.position(time), geometry.track.velocity(time)
        z = np.empty(len(places))
        find_heights(
            self._samples, np.array([terrain.x[0], terrain.y[0]]), np.ascontiguousarray(places),
            np.ascontiguousarray(antenna), np.ascontiguousarray(velocity), z,
        )  # fmt: skip
        # Move from the bilinear ground to the image's own, by the secant method on the clearance over height.
        before, at = z - 0.01, _on_circle(geometry, places, time, z - 0.01)
        clear_before = before - terrain(at[:, 0], at[:, 1])
        for _ in range(REFINEMENTS):
            at = _on_circle(geometry, places, time, z)
            clear = z - terrain(at[:, 0], at[:, 1])
            with np.errstate(invalid="ignore", divide="ignore"):
                change = -clear * (z - before) / (clear - clear_before)
            change = np.where(np.isfinite(change), np.clip(change, -terrain.dx, terrain.dx), 0.0)
            before, clear_before, z = z, clear, z + np.where(np.isfinite(clear), change, 0.0)
        at = _on_circle(geometry, places, time, z)
        return np.where(np.isfinite(terrain(at[:, 0], at[:, 1]))[:, None], at, np.nan)


def _mesh(run: FinishedRun, x: FloatArray, y: FloatArray) -> FloatArray:
    """Ground points (n, 3), m, of a mesh over columns and rows."""
    at = np.meshgrid(*(np.linspace(axis[0], axis[-1], NODES) for axis in (x, y)))
    return run.geometry.on_ground(*at).reshape(-1, 3)


def _middles(geometry: Geometry, points: FloatArray) -> FloatArray:
    """Middles of the dwells, s, of points (n, 3); of the whole collection if never lit."""
    first, last = geometry.beam.dwell(points[:, 0], points[:, 1])
    edges = aperture(geometry.collection)
    return np.asarray(np.clip(np.where(first < last, (first + last) / 2, sum(edges) / 2), *edges))


def _on_circle(geometry: Geometry, points: FloatArray, time: FloatArray, z: FloatArray | float) -> FloatArray:
    """Places (n, 3) at heights z, m, with range and Doppler of points (n, 3) at slow times (n,), s."""
    antenna, velocity = geometry.track.position(time), geometry.track.velocity(time)
    sight, level = points - antenna, np.hypot(velocity[:, 0], velocity[:, 1])
    along, across = (
        velocity[:, :2] / level[:, None],
        np.stack([-velocity[:, 1], velocity[:, 0]], axis=1) / level[:, None],
    )
    way = np.sign((sight[:, :2] * across).sum(axis=1))
    down = antenna[:, 2] - z
    ahead = (sight * velocity).sum(axis=1) / level + velocity[:, 2] * down / level
    side = way * np.sqrt(np.maximum((sight**2).sum(axis=1) - down**2 - ahead**2, 0.0))
    xy = antenna[:, :2] + ahead[:, None] * along + side[:, None] * across
    return np.concatenate([xy, np.broadcast_to(z, side.shape)[:, None]], axis=1)
