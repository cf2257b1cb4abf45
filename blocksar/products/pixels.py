"""Pixels of a raster product, on the image's own grid or on that of a map.

*A map.* The centre of a pixel of the map has a longitude and a latitude. The vertical there, the normal of the
ellipsoid, is a straight line in the scene frame, with x and y linear in z; it meets the ground where z = height(x, y),
which is found by iteration. There the image is read. So heights are respected, and positions are exact.

Complex pixels and power of single pixels come from band-limited interpolation of the complex image, whose carrier turns
with place and height (`plane_image`); GDAL's own resampling knows neither. Cells of looks are averaged first, and they
and the layers of a terrain are interpolated linearly; heights are the terrain's own; visibility is the nearest pixel's.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from blocksar.arrays import FloatArray
from blocksar.collection.georeference import Georeference, datum_tie
from blocksar.errors import InputError, printable
from blocksar.imaging.terrain_layers import Sight, box_of, by_owner, gamma_factor
from blocksar.kernels.occlusion import UNKNOWN, VISIBLE
from blocksar.measurement.multilooking import checked_looks, decibels, multilook, power_of
from blocksar.products.backscatter import BackscatterRun
from blocksar.products.pictures.overview import overview, stretch
from blocksar.products.plane_image import GroundImage
from blocksar.products.shared_options import Content, Decibels, Scale
from blocksar.runs.finished import STRIP, FinishedRun

if TYPE_CHECKING:
    from pyproj import CRS

# ---------------------------------------------------------------- the image's own grid

LAYERS = {"height": "height", "incidence": "incidence_angle", "visibility": "visibility"}  # in image.zarr, on a terrain
CONTENTS: tuple[Content, ...] = get_args(Content)
SCALES: tuple[Scale, ...] = get_args(Scale)
STRETCHED = 1000  # cells along the longer side of the overview that determines the range in dB


@dataclass(frozen=True, eq=False)
class Pixels:
    """Pixels of an image, or the mean power of cells of `looks` pixels.

    Attributes
    ----------
    source : FinishedRun
        The image.
    content : str
        "amplitude": the root of the power; "power": |image|^2; "db": 10 log10 of it; "complex": the image itself. On a
        terrain also "height", m; "incidence", local angle, rad; "visibility", 0 visible, 1 layover, 2 shadow; "gamma":
        the power times `gamma_factor` of `imaging.terrain_layers`, which removes what slopes do to it, so that level
        ground keeps its power; NaN in layover and shadow.
    looks : (int, int)
        Pixels along y and along x in a cell, whose power is averaged.
    scale : str, optional
        Type of whole numbers in which dB are stored: 1 at the lower end of `limits`, the largest number at the upper
        end, 0 where not covered.
    limits : (float, float)
        dB; only with `scale`.
    """

    source: FinishedRun
    content: Content
    looks: tuple[int, int] = (1, 1)
    scale: Scale | None = None
    limits: tuple[float, float] = (0.0, 0.0)

    @cached_property
    def x(self) -> FloatArray:
        """Centres of the pixels, m."""
        return _middles(self.source.x, self.looks[1])

    @cached_property
    def y(self) -> FloatArray:
        return _middles(self.source.y, self.looks[0])

    @property
    def spacing(self) -> tuple[float, float]:
        """Distance between pixels in x and in y, m."""
        dx, dy = self.source.spacing
        return dx * self.looks[1], dy * self.looks[0]

    @property
    def dtype(self) -> str:
        return self.scale or {"complex": "complex64", "visibility": "uint8"}.get(self.content, "float32")

    @property
    def nodata(self) -> float:
        """Value that marks a pixel as not covered."""
        if self.content == "visibility":
            return UNKNOWN
        return np.nan if self.scale is None else 0

    @property
    def linear(self) -> bool:
        """Whether single pixels are interpolated as they are: layers, and power that slopes change."""
        of_slopes = isinstance(self.source, BackscatterRun) and self.source.geometry.terrain is not None
        return self.content in ("visibility", "incidence", "gamma") or of_slopes

    @property
    def step(self) -> float:
        """Difference in dB between consecutive integer values."""
        assert self.scale is not None
        return (self.limits[1] - self.limits[0]) / (np.iinfo(self.scale).max - 1)

    @property
    def offset(self) -> float:
        """Level in dB that the value 0 corresponds to."""
        return self.limits[0] - self.step

    def strips(self) -> Iterator[slice]:
        """Divide the rows into parts of bounded size."""
        if self.looks == (1, 1):
            yield from self.source.strips(0)
            return
        step = max(STRIP // (self.source.x.size * self.looks[0]), 1)
        for first in range(0, self.y.size, step):
            yield slice(first, min(first + step, self.y.size))

    def measured(self, rows: slice) -> NDArray[Any]:
        """Read whole rows of the quantity that `coded` converts: power, complex pixels, or a layer."""
        if self.content in LAYERS:
            layer = self.source.read_layer(LAYERS[self.content], rows, slice(None))
            layer[self.source.read_block(rows, slice(None)) < 0] = self.nodata
            return layer
        side = self.looks[0]
        part = slice(rows.start * side, rows.stop * side)
        pixels = self.source.read(part, slice(None))
        if self.content == "complex":
            return pixels
        power = power_of(pixels)
        if self.content == "gamma":
            power = power * self._gamma_factor(part)
        return multilook(power, self.looks)

    def coded(self, values: NDArray[Any]) -> NDArray[Any]:
        """Convert measured values to the product's values."""
        if self.content == "db":
            return self._scaled(decibels(values))
        return np.sqrt(values) if self.content == "amplitude" else values

    @cached_property
    def _sights(self) -> list[Sight]:
        """Views of the antenna on the pixels, one for each segment."""
        source, terrain = self.source, self.source.geometry.terrain
        assert terrain is not None
        box = box_of(source.x, source.y)
        return [Sight.of(geometry, box, terrain.limits) for geometry in source.segments or (source.geometry,)]

    def _gamma_factor(self, rows: slice) -> NDArray[np.float32]:
        """Power factors of whole rows that normalise for slope; NaN in layover and shadow."""
        terrain = self.source.geometry.terrain
        assert terrain is not None
        owner = self.source.read_block(rows, slice(None))
        sights = {int(block): self._sights[self.source.segment_of(int(block))] for block in np.unique(owner)}
        factor = by_owner(
            sights, owner, lambda sight: gamma_factor(terrain, sight, self.source.x, self.source.y[rows]), np.nan
        ).astype(np.float32)
        factor[self.source.read_layer("visibility", rows, slice(None)) != VISIBLE] = np.nan
        return factor

    def _scaled(self, values: NDArray[np.float32]) -> NDArray[Any]:
        if self.scale is None:
            return values
        most = np.iinfo(self.scale).max
        number = np.clip(np.rint((values - self.offset) / self.step), 1, most)
        return np.where(np.isnan(values), 0, number).astype(self.scale)


def _middles(axis: FloatArray, side: int) -> FloatArray:
    """Centres of whole cells of `side` pixels along an axis, m."""
    if side == 1:
        return axis
    n = axis.size // side
    return axis[: n * side].reshape(n, side).mean(axis=1)


def pixels_of(
    source: FinishedRun,
    *,
    content: Content | None,
    looks: tuple[int, int],
    scale: Scale | None,
    limits: Decibels | None,
) -> Pixels:
    """Check the requested pixels, and choose the range in dB if one is needed and not given.

    Raises
    ------
    InputError
        If the content, the looks or the scale are none, or do not go together.
    """
    content = content or ("db" if scale else "amplitude")
    if content not in CONTENTS:
        raise InputError(f"content = {content!r}: give one of {', '.join(CONTENTS)}")
    looks = checked_looks(looks, (source.y.size, source.x.size))
    if content in LAYERS or content == "gamma":
        source.check_layer(LAYERS.get(content, "visibility"))
    if content in LAYERS and looks != (1, 1):
        raise InputError(f"content = {content!r} has no looks: it is no power; leave looks out")
    if content == "complex" and looks != (1, 1):
        raise InputError("content = 'complex' has no looks: the mean of complex pixels is no image; take power")
    if scale is not None and scale not in SCALES:
        raise InputError(f"scale = {scale!r}: give one of {', '.join(SCALES)}")
    if scale is not None and content != "db":
        raise InputError(f"scale = {scale!r} stores dB, but the content is {content}; take content db")
    if limits is not None and scale is None:
        raise InputError("a range in dB serves to scale pixels to whole numbers; give a scale, such as uint8, too")
    if scale is not None and limits is None:
        limits = _stretched(source)
    return Pixels(source, content, looks, scale, limits or (0.0, 0.0))


def _stretched(source: FinishedRun) -> tuple[float, float]:
    reduced = overview(source.read, source.x, source.y, max_pixels=STRETCHED, looks="mean")
    with np.errstate(divide="ignore"):
        low, high = stretch(10 * np.log10(reduced.power))
    return float(np.floor(low)), float(np.ceil(high))


# ---------------------------------------------------------------- the grid of a map

TILE = 256  # columns that are interpolated at a time
MAP_STRIP = 1 << 21  # pixels that are read at a time
MESH = 16  # pixels between places whose verticals are computed; between them they are interpolated
STEPS = 3  # of the iteration for the height: each leaves the ground's slope times the angle between vertical and z
SIDE = 65  # places along each side of an image, from which the map's limits are found
MARGIN = 3.0  # degrees beyond its area of use in which a CRS is still taken
UTM_ENDS = -80.0, 84.0  # degrees of latitude, beyond which maps are polar stereographic
ABOUT_A_POLE = 89.99  # degrees of latitude, beyond which longitudes turn over an image
TORN = 10.0  # diagonals of the image, by which its map is longer where the CRS breaks in between
MOST = 1 << 33  # pixels


def parse_crs(text: Any) -> CRS:
    """Parse a coordinate reference system such as EPSG:32616, projected or geographic.

    Raises
    ------
    InputError
        If it is none, or another kind.
    """
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    remedy = "give a projected one, such as EPSG:32616 (UTM zone 16 north), or EPSG:4326"
    try:
        crs = CRS.from_user_input(text)
    except CRSError:
        raise InputError(f"crs = {printable(str(text))[:80]!r} is no coordinate reference system; {remedy}") from None
    if not (crs.is_projected or crs.is_geographic) or len(crs.axis_info) != 2:
        raise InputError(f"crs = {printable(str(text))[:80]!r} is {crs.type_name}; {remedy}")
    return crs


class Verticals(NamedTuple):
    """Vertical lines at places of a map: x and y at z = 0, m, and their change with z."""

    x: FloatArray
    y: FloatArray
    slope_x: FloatArray
    slope_y: FloatArray

    def at(self, z: FloatArray | float) -> tuple[FloatArray, FloatArray]:
        """x and y, m, at heights z, m."""
        return self.x + z * self.slope_x, self.y + z * self.slope_y


@dataclass(frozen=True, eq=False)
class MapPixels:
    """Pixels of a map made from those of an image; north is up, as far as the CRS permits.

    Attributes
    ----------
    of : Pixels
        What the map shows.
    crs : CRS
    frame : Georeference
    x, y : (n,) float
        Middles of columns and rows in the CRS, ascending: easting and northing, or longitude and latitude.
    spacing : (float, float)
        Distance between pixels along the axes of the CRS, in its units.
    """

    of: Pixels
    crs: CRS
    frame: Georeference
    x: FloatArray
    y: FloatArray
    spacing: tuple[float, float]

    @classmethod
    def over(cls, pixels: Pixels, crs: CRS, frame: Georeference) -> MapPixels:
        """Make the map that contains an image, at its finest spacing, on whole multiples of it.

        Raises
        ------
        InputError
            If the image lies outside the area in which the CRS may be used, or across a break of it.
        """
        x, y = (np.linspace(axis[0], axis[-1], SIDE) for axis in (pixels.x, pixels.y))
        points = pixels.source.geometry.on_ground(*np.meshgrid(x, y))
        points[~np.isfinite(points[..., 2]), 2] = pixels.source.ground_height
        _check_area(crs, frame, points[SIDE // 2, SIDE // 2])
        places = frame.project(crs, points)
        if not np.isfinite(places).all():
            raise InputError(f"{crs.name} has no place for all of the image; give another crs")
        steps = _steps(crs, frame, points[SIDE // 2, SIDE // 2], min(pixels.spacing))
        axes, longest = [], TORN * np.hypot(np.ptp(x), np.ptp(y)) / min(pixels.spacing)
        for axis, step in enumerate(steps):
            low, high = places[..., axis].min(), places[..., axis].max()
            if high - low > longest * step:
                latitude, longitude, _ = frame.to_geodetic(points[SIDE // 2, SIDE // 2]).tolist()
                raise InputError(
                    f"{crs.name} tears the image apart, as longitudes do at 180 degrees and at the poles: give a "
                    f"projection that suits the place; {suitable_crs(longitude, latitude)}"
                )
            first = np.floor(low / step)
            axes.append(step * (first + 0.5 + np.arange(int(np.ceil(high / step) - first))))
        if axes[0].size * axes[1].size > MOST:
            raise InputError(
                f"{crs.name} would need {axes[0].size} x {axes[1].size} pixels; give a projection that suits the "
                "place, or a crop"
            )
        return cls(pixels, crs, frame, axes[0], axes[1], steps)

    @property
    def content(self) -> Content:
        return self.of.content

    def strips(self) -> Iterator[slice]:
        """Divide the rows into parts of bounded size."""
        step = min(max(MAP_STRIP // self.x.size, MESH), TILE)
        for first in range(0, self.y.size, step):
            yield slice(first, min(first + step, self.y.size))

    def measured(self, rows: slice) -> NDArray[Any]:
        """Compute whole rows, (rows, x.size), of the quantity that `coded` converts."""
        x, y = self.ground(self.x, self.y[rows])
        if self.content == "height":
            terrain = self.of.source.geometry.terrain
            assert terrain is not None
            return np.where(GroundImage(self.of.source).covered(x, y), terrain(x, y), np.nan).astype(np.float32)
        if self.of.linear or self.of.looks != (1, 1):
            return self._linear(x, y)
        complex_pixels, image = self.content == "complex", GroundImage(self.of.source)
        out = np.empty(x.shape, np.complex64 if complex_pixels else np.float32)
        for first in range(0, self.x.size, TILE):
            part = np.s_[:, first : first + TILE]
            found = image.at(x[part], y[part])
            out[part] = found if complex_pixels else power_of(found)
        return out

    def coded(self, values: NDArray[Any]) -> NDArray[Any]:
        """Convert measured values to the product's values."""
        return self.of.coded(values)

    def ground(self, east: FloatArray, north: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Ground x and y, m, at columns east (n,) and rows north (m,) of the map: (m, n) each."""
        verticals, level = self._verticals(east, north), self.of.source.ground_height
        terrain = self.of.source.geometry.terrain
        x, y = verticals.at(level)
        if terrain is None:
            return x, y
        for _ in range(STEPS):
            z = terrain(x, y)
            x, y = verticals.at(np.where(np.isfinite(z), z, level))
        return x, y

    @cached_property
    def datum_tie(self) -> tuple[float, str]:
        """Accuracy of the datum at the middle of the image; see `georeference.datum_tie`."""
        x, y = ((axis[0] + axis[-1]) / 2 for axis in (self.of.x, self.of.y))
        latitude, longitude, _ = self.frame.to_geodetic(np.array([x, y, self.of.source.ground_height]))
        return datum_tie(self.crs, float(longitude), float(latitude))

    @cached_property
    def error(self) -> float:
        """Largest ground distance, m, between pixels and their exact places, over some pixels."""
        worst = 0.0
        for rows in np.array_split(self.y, min(5, self.y.size)):
            east, north = self.x[:: max(self.x.size // 41, 1)], rows[:1]
            x, y = self.ground(east, north)
            points = self.of.source.geometry.on_ground(x, y)
            points[~np.isfinite(points[..., 2]), 2] = self.of.source.ground_height
            found = self.frame.project(self.crs, points) - np.stack(np.meshgrid(east, north), axis=-1)
            metres = np.abs(found) / self.spacing * min(self.of.spacing)
            worst = max(worst, float(metres.max()))
        return worst

    def _verticals(self, east: FloatArray, north: FloatArray) -> Verticals:
        """Interpolate the verticals of all pixels from a mesh."""
        from pyproj import Transformer

        to_earth = Transformer.from_crs(self.crs, "EPSG:4326", always_xy=True)
        nodes = [np.linspace(axis[0], axis[-1], max(axis.size // MESH, 1) + 1) for axis in (east, north)]
        columns, rows = np.meshgrid(*nodes)
        longitude, latitude = to_earth.transform(columns, rows)
        height = self.frame.height + self.of.source.ground_height
        low, high = (
            self.frame.from_geodetic(np.stack([latitude, longitude, np.full(latitude.shape, over)], axis=-1))
            for over in (height - 500.0, height + 500.0)
        )
        slope = (high - low)[..., :2] / (high - low)[..., 2:]
        base = low[..., :2] - low[..., 2:] * slope
        fields = (base[..., 0], base[..., 1], slope[..., 0], slope[..., 1])
        weights = [_between(axis, along) for axis, along in zip((east, north), nodes, strict=True)]
        return Verticals(*(_bilinear(field, *weights) for field in fields))

    def _linear(self, x: FloatArray, y: FloatArray) -> NDArray[Any]:
        """Interpolate the image's pixels linearly; flags are taken from the nearest."""
        pixels, nearest = self.of, self.content == "visibility"
        row, column = ((at - axis[0]) / (axis[-1] - axis[0]) * (axis.size - 1)
                       for at, axis in ((y, pixels.y), (x, pixels.x)))  # fmt: skip
        out = np.full(x.shape, UNKNOWN if nearest else np.nan, np.uint8 if nearest else np.float32)
        seen = (row > -0.5) & (row < pixels.y.size - 0.5) & (column > -0.5) & (column < pixels.x.size - 0.5)
        if not seen.any():
            return out
        row, column = (np.clip(at[seen], 0, n - 1) for at, n in ((row, pixels.y.size), (column, pixels.x.size)))
        rows = slice(int(np.floor(row.min())), int(np.floor(row.max())) + 2)
        part = pixels.measured(slice(rows.start, min(rows.stop, pixels.y.size)))
        row = row - rows.start
        if nearest:
            out[seen] = part[np.rint(row).astype(int), np.rint(column).astype(int)]
            return out
        i, j = (np.minimum(at.astype(int), n - 2) for at, n in ((row, part.shape[0]), (column, part.shape[1])))
        v, u = row - i, column - j
        total = np.zeros(row.size)
        for di, dj, weight in ((0, 0, (1 - v) * (1 - u)), (0, 1, (1 - v) * u), (1, 0, v * (1 - u)), (1, 1, v * u)):
            total += np.where(weight > 0, part[i + di, j + dj] * weight, 0.0)
        out[seen] = total
        return out


def _check_area(crs: CRS, frame: Georeference, point: FloatArray) -> None:
    area, (latitude, longitude, _) = crs.area_of_use, frame.to_geodetic(point)
    if crs.is_geographic and abs(latitude) > ABOUT_A_POLE:
        raise InputError(f"{crs.name} has no even pixels about a pole; {suitable_crs(longitude, latitude)}")
    if area is None:
        return
    width = (area.east - area.west) % 360 or 360.0
    across = (longitude - area.west + MARGIN) % 360
    if across <= width + 2 * MARGIN and area.south - MARGIN <= latitude <= area.north + MARGIN:
        return
    raise InputError(
        f"{crs.name} is for longitudes {area.west:g} .. {area.east:g} and latitudes {area.south:g} .. {area.north:g}, "
        f"and the image lies at {longitude:.4f}, {latitude:.4f}; {suitable_crs(longitude, latitude)}"
    )


def suitable_crs(longitude: float, latitude: float) -> str:
    """Suggest a projection for a place, degrees: UTM, or polar stereographic beyond its limits."""
    if not UTM_ENDS[0] <= latitude <= UTM_ENDS[1]:
        ups, other = ("EPSG:5041", "EPSG:3413") if latitude > 0 else ("EPSG:5042", "EPSG:3031")
        return f"polar stereographic there is {ups}, or {other}"
    zone = int((longitude + 180) // 6) % 60 + 1
    return f"UTM there is EPSG:{32600 + zone + (100 if latitude < 0 else 0)}"


def _steps(crs: CRS, frame: Georeference, point: FloatArray, spacing: float) -> tuple[float, float]:
    """Steps along the axes of a CRS, in its units, that equal a spacing on the ground, m."""
    from pyproj import Transformer

    to_earth = Transformer.from_crs(crs, "EPSG:4326", always_xy=True)
    east, north = frame.project(crs, point)
    height, unit = frame.to_geodetic(point)[2], 1e-5 if crs.is_geographic else 1.0
    longitude, latitude = to_earth.transform(east + unit * np.array([0.0, 1, 0]), north + unit * np.array([0.0, 0, 1]))
    at = frame.from_geodetic(np.stack([latitude, longitude, np.full(3, height)], axis=-1))
    return tuple(float(spacing * unit / np.linalg.norm(at[k] - at[0])) for k in (1, 2))  # type: ignore[return-value]


def _between(axis: FloatArray, nodes: FloatArray) -> tuple[NDArray[np.intp], FloatArray]:
    """Index of the node before each place, and the fraction of the step beyond it."""
    step = float(nodes[1] - nodes[0]) or 1.0
    at = (axis - nodes[0]) / step
    before = np.clip(np.floor(at), 0, nodes.size - 2).astype(np.intp)
    return before, at - before


def _bilinear(
    field: FloatArray, columns: tuple[NDArray[np.intp], FloatArray], rows: tuple[NDArray[np.intp], FloatArray]
) -> FloatArray:
    (j, u), (i, v) = columns, rows
    along = field[i] + v[:, None] * (field[i + 1] - field[i])
    return np.asarray(along[:, j] + u * (along[:, j + 1] - along[:, j]))
