"""An image on a terrain, as the image on a plane that SICD describes.

A pixel of a SICD file on a plane stands for all places of the pixel's range and Doppler (at its centre of aperture),
and readers follow these to the surface that they project to. An image on a terrain has each place of the ground where
it stands instead: x and y are its own, whatever its height. So it is carried to the plane z = ground_height: the pixel
at a place of the plane shows the ground of equal range and Doppler, with the phase that the plane's own range has.
Projected to its height over the ellipsoid it comes to lie at its x and y. It is as sharp as the image on the terrain.

Ground that shares range and Doppler with other ground (layover) is one pixel there; of several places the highest is
taken. The values are interpolated from the complex image (`ground_image`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.polynomial import Chebyshev, Polynomial, polynomial
from numpy.polynomial import polynomial as power

from blocksar.arrays import BoolArray, ComplexArray, FloatArray
from blocksar.collection.beam import aperture
from blocksar.collection.geometry import Geometry
from blocksar.collection.georeference import Georeference
from blocksar.collection.terrain import Terrain
from blocksar.kernels.occlusion import STEPS, block_extremes, find_heights
from blocksar.products.ground_image import GroundImage
from blocksar.runs.finished import STRIP, FinishedRun, Int16Array

MAX_ORDER = 7  # total, in both variables


class Poly2D(NamedTuple):
    """A polynomial in two variables: coefficients (n, n) of u^i v^j, and the largest error of its fit."""

    coefficients: FloatArray
    error: float


def fit_poly2d(u: FloatArray, v: FloatArray, values: FloatArray, accuracy: float) -> Poly2D:
    """Fit values (n,) by least squares with the polynomial of lowest total order that meets `accuracy`.

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
    """The track as a polynomial in ECEF, and its largest distance from the recorded antenna positions.

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
    """A run on a terrain, opened as if it lay on the plane z = ground_height.

    Attributes
    ----------
    run : FinishedRun
        The run itself; `x`, `y` and `geometry` are those of the plane.
    """

    run: FinishedRun | None = None

    @classmethod
    def of(cls, run: FinishedRun) -> PlaneImage:
        """The plane's pixels, as far apart as those of the image, as far as its ground is seen there."""
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
        """Middles of dwells, s, over x and y from the middle of the image, m: those of the ground that is seen."""
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
        """Centres of aperture (...), s, of places (..., 3) of the plane, m."""
        middle = self._middle
        coefficients = self._centre_of_aperture.coefficients
        return np.asarray(polynomial.polyval2d(places[..., 0] - middle[0], places[..., 1] - middle[1], coefficients))

    def ground(self, places: FloatArray) -> FloatArray:
        """The ground (n, 3) of the range and Doppler of places (n, 3) of the plane, m; NaN where there is none."""
        return self._ground(places, self.times(places))

    def read(self, rows: slice, columns: slice) -> ComplexArray:
        """Read pixels of the plane, (rows, columns); NaN where no covered ground has their range and Doppler."""
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
        """0 where a pixel of the plane is covered, else -1, (rows, columns)."""
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
    def _samples(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        heights = np.ascontiguousarray(self.terrain.heights, np.float64)
        return heights, *block_extremes(heights)

    def _ground(self, places: FloatArray, time: FloatArray) -> FloatArray:
        """`ground` at other centres of aperture (n,), s."""
        terrain, geometry = self.terrain, self.on_terrain.geometry
        antenna, velocity = geometry.track.position(time), geometry.track.velocity(time)
        z = np.empty(len(places))
        find_heights(
            *self._samples, np.array([terrain.x[0], terrain.y[0]]), np.array([terrain.dx, terrain.dy]),
            np.ascontiguousarray(places), np.ascontiguousarray(antenna), np.ascontiguousarray(velocity),
            min(terrain.dx, terrain.dy) / STEPS, z,
        )  # fmt: skip
        # From the bilinear ground to the one that the image lies on, by the secant of the clearance over the height.
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
    """Middles of the dwells, s, of points (n, 3); of the whole collection where they are not lit."""
    first, last = geometry.beam.dwell(points[:, 0], points[:, 1])
    edges = aperture(geometry.collection)
    return np.asarray(np.clip(np.where(first < last, (first + last) / 2, sum(edges) / 2), *edges))


def _on_circle(geometry: Geometry, points: FloatArray, time: FloatArray, z: FloatArray | float) -> FloatArray:
    """Places (n, 3) at heights z, m, of the range and Doppler of points (n, 3) at slow times (n,), s."""
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
