"""Heights that are given on the Earth, in the scene frame: GeoTIFF files, and the ellipsoid itself."""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.collection.georeference import Georeference, datum_tie
from blocksar.collection.terrain import LEAST, MARGIN, Terrain
from blocksar.constants import TURN
from blocksar.errors import InputError
from blocksar.ingestion.reading import reading
from blocksar.ingestion.terrain.datum import datum_of
from blocksar.ingestion.terrain.frame_grid import MOST_HEIGHTS
from blocksar.ingestion.terrain.nodata import refuse_untagged
from blocksar.ingestion.terrain.remarks import FEET, remarks_on
from blocksar.ingestion.terrain.resampling import STEPS, lattice, resample
from blocksar.places import Location, place
from blocksar.places.place import Place

if TYPE_CHECKING:
    from pyproj import CRS
    from rasterio.io import DatasetReader

ELLIPSOID_SAMPLES = 64  # along each axis: cubic convolution is exact for a paraboloid
METRES = ("", "m", "metre", "metres", "meter", "meters")
REMEDY = "give a GeoTIFF of heights with its coordinate reference system"


def ellipsoid(
    georeference: Georeference, ground_height: float, x: tuple[float, float], y: tuple[float, float]
) -> Terrain:
    """The surface at the height of the frame's plane z = ground_height over WGS 84, at a box."""
    over = georeference.height + ground_height
    step = max(x[1] - x[0], y[1] - y[0]) / ELLIPSOID_SAMPLES
    (x0, n_x), (y0, n_y) = (lattice(box, step) for box in (x, y))
    mesh_x, mesh_y = np.meshgrid(x0 + step * np.arange(n_x), y0 + step * np.arange(n_y))
    z = np.full((n_y, n_x), ground_height)
    for _ in range(STEPS):
        z = z + over - _geodetic(georeference, mesh_x, mesh_y, z)[..., 2]
    return Terrain(x0=x0, dx=step, y0=y0, dy=step, heights=z)


def read_geotiff(
    source: Location, vertical: str | None, georeference: Georeference, x: tuple[float, float], y: tuple[float, float],
    *, refine: bool = True, level: float | None = None,
) -> Terrain:  # fmt: skip
    """Read the heights of a GeoTIFF on a grid of the frame over a box; `refine` as in `resample`.

    They are compared with the scene's plane z = level, m, if it is given, for the terrain's remarks.

    Raises
    ------
    InputError
        If it cannot be read, its CRS or datum is unknown, its heights are not in m, or it lies elsewhere.
    """
    try:
        import rasterio
    except ModuleNotFoundError:
        raise InputError("rasterio is not installed, which GeoTIFF needs; install blocksar[formats]") from None
    from pyproj import CRS

    path = place(source)
    if not path.exists():
        raise InputError(f"{path} does not exist; {REMEDY}")
    with reading(path, damaged="not a GeoTIFF of heights", remedy=REMEDY), rasterio.open(str(path)) as file:
        if file.crs is None:
            raise InputError(
                f"{path} has no coordinate reference system; state it (`rio edit-info --crs EPSG:4326 "
                f"{shlex.quote(str(path))}`, if it is in degrees of WGS 84), or {REMEDY}"
            )
        unit = str(file.units[0] or "").lower()
        if unit not in METRES and unit not in FEET:
            raise InputError(f"{path} has heights in {unit}; convert them to m")
        crs = CRS.from_wkt(file.crs.to_wkt())
        _refuse_untied(crs, georeference, path)
        undulation = datum_of(crs, vertical, str(path)).undulation()
        to_pixel = _pixels_of(file, crs)
        step = _spacing(georeference, to_pixel, x, y)
        posts = _window(file, georeference, to_pixel, x, y, margin=MARGIN * step, label=str(path))
        posts = replace(posts, heights=posts.heights * FEET.get(unit, 1.0))
        refuse_untagged(np.asarray(posts.heights), path)

    def to_file(x: FloatArray, y: FloatArray, z: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        latitude, longitude, height = np.moveaxis(_geodetic(georeference, x, y, z), -1, 0)
        column, row = to_pixel(longitude, latitude)
        return row - posts.row, column - posts.column, height - undulation(longitude, latitude)

    terrain = resample(posts.heights, to_file, step, (x, y), refine=refine)
    if level is None:
        return terrain
    plane = float(to_file(np.array([sum(x) / 2]), np.array([sum(y) / 2]), level)[2][0])
    return replace(terrain, remarks=remarks_on(posts.heights, plane, path, feet=unit in FEET))


def _refuse_untied(crs: CRS, georeference: Georeference, path: Place) -> None:
    """Raise an InputError if PROJ knows no way from a file's datum to WGS 84 where the scene lies.

    A datum without a name, as that of an ellipsoid alone, is taken for WGS 84.
    """
    flat = _flat(crs)
    if flat.datum is None or flat.datum.name.lower().startswith("unknown"):
        return
    if math.isnan(datum_tie(flat, georeference.longitude, georeference.latitude)[0]):
        raise InputError(
            f"{path} is in {crs.name}, whose datum PROJ cannot tie to WGS 84 at longitude "
            f"{georeference.longitude:.4g}, latitude {georeference.latitude:.4g}; transform it to WGS 84 first"
        )


def _flat(crs: CRS) -> CRS:
    """The horizontal part of a CRS."""
    from pyproj import CRS

    return CRS(next((part for part in crs.sub_crs_list if not part.is_vertical), crs)).to_2d()


def _pixels_of(file: DatasetReader, crs: CRS) -> Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
    """Return a function from longitude and latitude to column and row, of pixels' centres.

    Longitudes of the file may go on beyond 180 degrees, or run from 0 to 360.
    """
    from pyproj import Transformer

    flat = _flat(crs)
    to_map = Transformer.from_crs("EPSG:4326", flat, always_xy=True)
    turn = TURN / flat.axis_info[0].unit_conversion_factor if flat.is_geographic else None
    a, b, west, d, e, north_edge = file.transform[:6]
    area, middle = a * e - b * d, (a * file.width + b * file.height) / 2

    def pixels(longitude: FloatArray, latitude: FloatArray) -> tuple[FloatArray, FloatArray]:
        east, north = to_map.transform(longitude, latitude)
        right, up = np.asarray(east, np.float64) - west, np.asarray(north, np.float64) - north_edge
        if turn is not None:
            right = right - turn * np.rint((right - middle) / turn)
        return (e * right - b * up) / area - 0.5, (a * up - d * right) / area - 0.5

    return pixels


def _geodetic(georeference: Georeference, x: FloatArray, y: FloatArray, z: FloatArray | float) -> FloatArray:
    """Latitude, longitude and height (..., 3)."""
    return georeference.to_geodetic(np.stack(np.broadcast_arrays(x, y, z), axis=-1).astype(np.float64))


def _spacing(
    georeference: Georeference,
    to_pixel: Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]],
    x: tuple[float, float],
    y: tuple[float, float],
) -> float:
    """Distance of pixels at the middle of a box, the smaller of the two, m."""
    middle, side = (sum(x) / 2, sum(y) / 2), 10.0
    at = _geodetic(georeference, middle[0] + np.array([0.0, side, 0.0]), middle[1] + np.array([0.0, 0.0, side]), 0.0)
    columns, rows = to_pixel(at[:, 1], at[:, 0])
    if not np.isfinite([columns, rows]).all():
        raise InputError("terrain: its coordinate reference system does not reach the image; give one that covers it")
    # Rows of the Jacobian: pixels per m; the spacing along each pixel axis is one over its gradient.
    gradients = [float(np.hypot(axis[1] - axis[0], axis[2] - axis[0])) / side for axis in (columns, rows)]
    return 1 / max(gradients)


def _window(
    file: DatasetReader,
    georeference: Georeference,
    to_pixel: Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]],
    x: tuple[float, float],
    y: tuple[float, float],
    *,
    margin: float,
    label: str,
) -> Terrain:
    """The file's heights about a box, over column and row."""
    from rasterio.windows import Window

    along = np.linspace(0, 1, 33)
    mesh = np.meshgrid(
        x[0] - margin + (x[1] - x[0] + 2 * margin) * along, y[0] - margin + (y[1] - y[0] + 2 * margin) * along
    )
    bounds = []
    for z in (-1e3, 9e3):  # heights shift a place by as much as z and the vertical differ
        at = _geodetic(georeference, *mesh, z)
        bounds.append(np.stack(to_pixel(at[..., 1], at[..., 0])))
    columns, rows = (np.stack(bounds)[:, axis] for axis in (0, 1))
    low = [int(np.floor(axis.min())) - MARGIN for axis in (columns, rows)]
    high = [int(np.ceil(axis.max())) + MARGIN + 1 for axis in (columns, rows)]
    if not (low[0] < file.width and high[0] > 0 and low[1] < file.height and high[1] > 0):
        remedy = "give one that covers it"
        if file.crs.is_geographic and _exchanged(file, at):
            remedy = "its longitudes and latitudes are exchanged, it seems: write it with longitudes as x"
        raise InputError(f"terrain {label} lies elsewhere: {_extents(file, at)}; {remedy}")
    column, row = (
        min(max(value, 0), max(size - LEAST, 0)) for value, size in zip(low, (file.width, file.height), strict=True)
    )
    width, height = min(high[0], file.width) - column, min(high[1], file.height) - row
    if max(width, LEAST) * max(height, LEAST) > MOST_HEIGHTS:
        raise InputError(f"{label} has more than {MOST_HEIGHTS} heights within the image; give a coarser one")
    part = Window(column, row, max(width, LEAST), max(height, LEAST))
    values = file.read(1, window=part, masked=True).astype(np.float64)
    scale, offset = file.scales[0], file.offsets[0]
    filled = np.ma.filled(values, np.nan) * scale + offset
    return Terrain(x0=0.0, dx=1.0, y0=0.0, dy=1.0, heights=np.ascontiguousarray(filled), row=row, column=column)


def _exchanged(file: DatasetReader, image: FloatArray) -> bool:
    """Whether a file in degrees would cover places of the image (..., 3), latitude first, with its axes exchanged."""
    west, south, east, north = file.bounds
    latitude, longitude = image[..., 0], image[..., 1]
    return bool(((west <= latitude) & (latitude <= east) & (south <= longitude) & (longitude <= north)).any())


def _extents(file: DatasetReader, image: FloatArray) -> str:
    """Longitudes and latitudes of a file, and of the image (..., 3), latitude first, degrees."""
    from rasterio.warp import transform_bounds

    west, south, east, north = transform_bounds(file.crs, "EPSG:4326", *file.bounds)
    own = (float(limit(image[..., axis])) for axis in (1, 0) for limit in (np.min, np.max))
    spans = ((west, east, south, north), tuple(own))
    told = [f"longitude {a:.5g} .. {b:.5g}, latitude {c:.5g} .. {d:.5g} degrees" for a, b, c, d in spans]
    return f"it spans {told[0]}, and the image {told[1]}"
