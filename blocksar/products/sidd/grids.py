"""The pixels of a SIDD file: where they lie on the Earth, and what they hold."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from blocksar.arrays import FloatArray
from blocksar.collection.georeference import Georeference
from blocksar.products.map_pixels import MapPixels, parse_crs
from blocksar.products.pixels import Pixels
from blocksar.products.sicd.layout import Layout, lay_out

ARCSECONDS = 3600.0  # in a degree
Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class Grid(ABC):
    """Rows and columns of a file.

    Attributes
    ----------
    pixels : Pixels
        What they show.
    frame : Georeference
    """

    pixels: Pixels
    frame: Georeference

    @property
    @abstractmethod
    def raster(self) -> Pixels | MapPixels:
        """Source of the values, by rows from south to north."""

    @property
    @abstractmethod
    def shape(self) -> tuple[int, int]: ...

    @property
    def reference(self) -> FloatArray:
        """Row and column of the reference point, a pixel in the middle."""
        return np.array(self.shape, np.float64) // 2

    @abstractmethod
    def upright(self, file: Bytes) -> Bytes:
        """The file's array, as a view by rows of `raster`."""

    @abstractmethod
    def at(self, points: FloatArray) -> FloatArray:
        """Rows and columns (n, 2) of the ground at scene points (n, 3), m."""

    @abstractmethod
    def place(self, pixels: FloatArray) -> FloatArray:
        """Scene points (n, 3), m, that the standard gives to rows and columns (n, 2)."""

    @abstractmethod
    def projection(self) -> tuple[str, dict[str, Any]]:
        """Name and content of the projection in Measurement, but TimeCOAPoly."""

    def steps(self) -> FloatArray:
        """From a row and from a column to the next at the reference point, m in x and y, (2, 2)."""
        points = self.place(self.reference + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
        return (points[1:] - points[0])[:, :2]


@dataclass(frozen=True)
class PlaneGrid(Grid):
    """The image's own pixels, on the plane."""

    @property
    def raster(self) -> Pixels:
        return self.pixels

    @cached_property
    def layout(self) -> Layout:
        return lay_out(self.pixels.source, self.pixels)

    @property
    def shape(self) -> tuple[int, int]:
        return self.layout.shape

    def upright(self, file: Bytes) -> Bytes:
        turned = file[:: int(self.layout.row.sum()), :: int(self.layout.column.sum())]
        return turned.T if self.layout.row_axis == 1 else turned

    def at(self, points: FloatArray) -> FloatArray:
        offset = (points - self.layout.first)[:, :2]
        return np.stack([offset @ self.layout.row, offset @ self.layout.column], axis=1) / self.layout.spacing

    def place(self, pixels: FloatArray) -> FloatArray:
        return self.layout.point(*pixels.T)

    def projection(self) -> tuple[str, dict[str, Any]]:
        row, column = (np.array([*along, 0.0]) @ self.frame.axes for along in (self.layout.row, self.layout.column))
        return "PlaneProjection", {
            "ReferencePoint": {
                "ECEF": self.frame.to_ecef(self.place(self.reference[None])[0]),
                "Point": self.reference,
            },
            "SampleSpacing": np.array(self.layout.spacing),
            "ProductPlane": {"RowUnitVector": row, "ColUnitVector": column},
        }


@dataclass(frozen=True)
class GeographicGrid(Grid):
    """Longitude and latitude, at the height of each pixel's ground; rows run south."""

    @cached_property
    def raster(self) -> MapPixels:
        # Longitudes from half a turn before the origin's on, which the image does not reach: none of them jumps.
        crs = parse_crs(f"+proj=longlat +datum=WGS84 +lon_wrap={self.frame.longitude!r} +type=crs")
        return MapPixels.over(self.pixels, crs, self.frame)

    @property
    def shape(self) -> tuple[int, int]:
        return self.raster.y.size, self.raster.x.size

    def upright(self, file: Bytes) -> Bytes:
        return file[::-1]

    def at(self, points: FloatArray) -> FloatArray:
        latitude, longitude, _ = self.frame.to_geodetic(points).T
        dx, dy = self.raster.spacing
        longitude = longitude + 360 * np.rint((self.raster.x.mean() - longitude) / 360)
        return np.stack([(self.raster.y[-1] - latitude) / dy, (longitude - self.raster.x[0]) / dx], axis=1)

    def place(self, pixels: FloatArray) -> FloatArray:
        (dx, dy), height = self.raster.spacing, self.frame.height + self.pixels.source.ground_height
        latitude, longitude = self.raster.y[-1] - pixels[:, 0] * dy, self.raster.x[0] + pixels[:, 1] * dx
        return self.frame.from_geodetic(np.stack([latitude, longitude, np.full(latitude.shape, height)], axis=1))

    def projection(self) -> tuple[str, dict[str, Any]]:
        dx, dy = self.raster.spacing
        return "GeographicProjection", {
            "ReferencePoint": {
                "ECEF": self.frame.to_ecef(self.place(self.reference[None])[0]),
                "Point": self.reference,
            },
            "SampleSpacing": np.array([dy, dx]) * ARCSECONDS,
        }


def grid_of(pixels: Pixels, frame: Georeference) -> Grid:
    """The grid of the file: that of the image on the plane, longitude and latitude on a terrain."""
    return (PlaneGrid if pixels.source.geometry.terrain is None else GeographicGrid)(pixels, frame)
