"""Heights on the Earth as z on a grid of the scene frame: GeoTIFF files, and the ellipsoid."""

from __future__ import annotations

import math
import os
import shlex
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

import numpy as np

from blocksar.arrays import BoolArray, FloatArray
from blocksar.collection.georeference import Georeference, datum_tie
from blocksar.collection.terrain import LEAST, MARGIN, Terrain
from blocksar.constants import TURN
from blocksar.errors import InputError
from blocksar.places import Location, place
from blocksar.places.place import Place
from blocksar.readers.reading import reading

if TYPE_CHECKING:
    from pyproj import CRS
    from rasterio.io import DatasetReader

HIGHER = 3000.0  # m: relief about an area that is looked for, above its own highest place
MOST_HEIGHTS = 1 << 27  # of a window: 1 GiB
MOST_AROUND = 1 << 24  # heights of the terrain about an area: of a finer one, less far away

# Fill values that programs use by custom, and impossible heights: the Earth's are -11 km to 9 km, less its curvature.
CUSTOMARY = (-9999.0, 9999.0, -32767.0, -32768.0, 32767.0, 65535.0, -99999.0, 99999.0)
HIGHEST = 1e5  # m

Box = tuple[tuple[float, float], tuple[float, float]]  # x and y, from .. to, m
Limits = tuple[float, float]  # lowest and highest height, m


def refuse_untagged(heights: FloatArray, path: Place) -> None:
    """Refuse heights with a fill value that is not declared: interpolation would spread it.

    Raises
    ------
    InputError
        If one is.
    """
    odd = np.isin(heights, CUSTOMARY) | (np.abs(heights) > HIGHEST)
    if odd.any():
        value, count = float(heights[odd][0]), int(odd.sum())
        raise InputError(
            f"{path} has a height of {value:.6g} m ({count} of the kind), which no ground has: tag the number that "
            "stands for no data (_FillValue, or nodata of a GeoTIFF), or write NaN there"
        )


def read_around(
    terrain: Terrain, own: Box, needed: Callable[[Limits], Box], read: Callable[[Box], Terrain]
) -> Terrain | None:
    """Read the terrain that may shadow or overlay an area from outside; None if `terrain` already contains it.

    Parameters
    ----------
    terrain : Terrain
        What is known of it, over the area.
    own : Box
        The area.
    needed : callable
        The box on which what is seen of the area depends, for a terrain between two heights.
    read : callable
        The terrain over a box, or what there is of it.
    """
    terrain = terrain.thinned()
    low, high = terrain.limits
    around = read(_within(needed((low, high + HIGHER)), own, terrain))
    for _ in range(2):  # with heights as they are there
        around = around.window(*needed(around.limits))
    extents = (terrain.x[0], terrain.x[-1]), (terrain.y[0], terrain.y[-1])
    beyond = (around.x[0], around.x[-1]), (around.y[0], around.y[-1])
    covered = all(a[0] <= b[0] and b[1] <= a[1] for a, b in zip(extents, beyond, strict=True))
    return None if covered else around


def _within(box: Box, own: Box, terrain: Terrain) -> Box:
    """Shrink a box towards the area's until it has at most the permitted number of heights."""
    share = 1.0
    while True:
        drawn = [
            (inner[0] + share * (outer[0] - inner[0]), inner[1] + share * (outer[1] - inner[1]))
            for outer, inner in zip(box, own, strict=True)
        ]
        count = [(side[1] - side[0]) / step for side, step in zip(drawn, (terrain.dx, terrain.dy), strict=True)]
        if share < 0.01 or count[0] * count[1] <= max(MOST_AROUND, terrain.heights.size):
            return drawn[0], drawn[1]
        share *= 0.8


STEPS = 4  # of the iteration for z: each leaves the square of the angle between z and the vertical
STRIP = 1 << 18  # heights that are computed at a time
REFINED = 2  # samples to one of the file's, along each axis: cubic convolution between them adds a hundredth
MOST_REFINED = 1 << 24  # heights: of more, only one to one of the file's
NODE_SPACING = 1000.0  # m, at most, of places at which maps of the Earth are computed; cubic in between
LEAST_NODES = 9  # along each axis
LEVELS = 3  # heights at which they are computed; a parabola in between
ROOM = 100.0  # m, by which these heights reach beyond those of the file
BENT = 1.0  # posts, by which a map may bend between three nodes; one that breaks is computed at every place

# Of a frame's x, y (n,) and z, m: row and column in the file, and the height over the file's datum, m, each (n,).
ToFile = Callable[[FloatArray, FloatArray, float], tuple[FloatArray, FloatArray, FloatArray]]
Maps = list[list[FloatArray]]  # of row, column and height: constant, rate and bend over z


def lattice(side: tuple[float, float], step: float) -> tuple[float, int]:
    """Start, m, and count of multiples of a step that cover a side of a box and MARGIN steps beyond."""
    start = float(np.floor(side[0] / step - MARGIN) * step)
    return start, int(np.ceil((side[1] - start) / step)) + MARGIN + 1


def resample(posts: FloatArray, to_file: ToFile, step: float, box: Box, *, refine: bool) -> Terrain:
    """Resample a file's heights to a grid over a box and MARGIN steps beyond, each point at its own z.

    A height is known where the four posts about its place are (`kernels.posts`).

    Parameters
    ----------
    posts : (n_row, n_column) float
        m over the file's datum; NaN where unknown.
    to_file : callable
    step : float
        Spacing of the posts, m.
    box : ((float, float), (float, float))
        x and y, from .. to, m.
    refine : bool
        Whether to take REFINED heights to a post along each axis, if these are not too many.
    """
    from blocksar.kernels.posts import continued, heights_between  # loads numba, which only GeoTIFF needs

    (x0, n_x), (y0, n_y) = (lattice(side, step) for side in box)
    if n_x * n_y > MOST_HEIGHTS:
        raise InputError(f"terrain: {n_y} x {n_x} heights within the image are too many; give a coarser file")
    times = REFINED if refine and n_x * n_y * REFINED**2 <= MOST_REFINED else 1
    step = step / times
    x, y = (np.asarray(start + step * np.arange(times * (n - 1) + 1)) for start, n in ((x0, n_x), (y0, n_y)))
    known = posts[np.isfinite(posts)]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
    drop = float(to_file(np.array([sum(box[0]) / 2]), np.array([sum(box[1]) / 2]), 0.0)[2][0])
    levels = np.linspace(low - drop - ROOM, high - drop + ROOM, LEVELS)
    maps, filled, z = _mapper(to_file, x, y, levels), continued(posts), np.empty((y.size, x.size))

    def between(row: FloatArray, column: FloatArray) -> FloatArray:
        return heights_between(posts, filled, row=row.ravel(), column=column.ravel()).reshape(row.shape)

    for first in range(0, y.size, max(STRIP // x.size, 1)):
        rows = slice(first, first + max(STRIP // x.size, 1))
        z[rows] = _solve(between, maps(y[rows]), levels)
    return Terrain(x0=x0, dx=step, y0=y0, dy=step, heights=z, refined=times)


def _solve(between: Callable[[FloatArray, FloatArray], FloatArray], maps: Maps, levels: FloatArray) -> FloatArray:
    """Solve for z (n_y, n_x) such that the file has that height at the mapped place; NaN without heights."""
    z = np.full(maps[0][0].shape, levels[1])
    for _ in range(STEPS):
        known = np.where(np.isfinite(z), z, levels[1])
        at = (known - levels[1]) / (levels[2] - levels[1])
        row, column, height = (constant + at * (rate + at * bend) for constant, rate, bend in maps)
        z = known + between(row, column) - height
    return z


def _mapper(to_file: ToFile, x: FloatArray, y: FloatArray, levels: FloatArray) -> Callable[[FloatArray], Maps]:
    """Make a function that evaluates `to_file` for some of the rows y (n_y,), m, by interpolation."""

    def exact(x: FloatArray, y: FloatArray) -> list[list[FloatArray]]:
        mesh = np.meshgrid(x, y)
        values = [to_file(mesh[0].ravel(), mesh[1].ravel(), level) for level in levels.tolist()]
        return [[each[k].reshape(mesh[0].shape) for each in values] for k in range(3)]

    nodes = [_nodes(axis) for axis in (x, y)]
    found = exact(*nodes)
    bends = [np.abs(np.diff(each, 2, axis)).max() for axis in (0, 1) for of in found[:2] for each in of]
    if not max(bends) < BENT:  # where longitudes jump, say; NaN too
        return lambda rows: [_parabola(values) for values in exact(x, rows)]
    (x0, dx), (y0, dy) = ((float(axis[0]), float(axis[1] - axis[0])) for axis in nodes)
    smooth = [[Terrain(x0=x0, dx=dx, y0=y0, dy=dy, heights=each) for each in of] for of in found]
    return lambda rows: [_parabola([each.on_grid(x, rows) for each in of]) for of in smooth]


def _nodes(axis: FloatArray) -> FloatArray:
    """Uniform nodes that extend beyond an axis, so that rounding leaves no place outside."""
    count = max(int(np.ceil((axis[-1] - axis[0]) / NODE_SPACING)) + 1, LEAST_NODES)
    room = 0.01 * (axis[-1] - axis[0]) / count
    return np.linspace(axis[0] - room, axis[-1] + room, count)


def _parabola(values: list[FloatArray]) -> list[FloatArray]:
    """Coefficients 0 .. 2 of the parabola through three values at -1, 0 and 1."""
    low, middle, high = values
    return [middle, (high - low) / 2, (high + low) / 2 - middle]


Undulation = Callable[[FloatArray, FloatArray], FloatArray]  # of longitude and latitude, degrees: m
GRIDS = {"egm96": "us_nga_egm96_15.tif", "egm2008": "us_nga_egm08_25.tif"}  # PROJ's names of its grids
KNOWN_AS = {"egm96": "EGM96", "egm2008": "EGM2008"}  # part of the names of vertical CRSs
DATUM_REMEDY = "say --vertical ellipsoid, egm96 or egm2008"
WHY = "datums differ by up to 100 m"


@dataclass(frozen=True)
class Datum:
    """Vertical datum of heights: "ellipsoid", "egm96" or "egm2008", and a geoid's file, if named."""

    name: str
    grid: str | None = None

    @classmethod
    def parse(cls, text: str) -> Self:
        """Parse "ellipsoid", "egm96", "egm2008", or a geoid with its file, such as "egm2008:FILE".

        Raises
        ------
        InputError
            If it is none of these, or there is no such file.
        """
        name, _, grid = text.partition(":")
        if name != "ellipsoid" and name not in GRIDS:
            raise InputError(f"vertical = {text!r} is unknown; {REMEDY}")
        if name == "ellipsoid" and grid:
            raise InputError(f"vertical = {text!r}: heights over the ellipsoid need no file; leave it out")
        if grid and not os.path.isfile(grid):
            raise InputError(f"vertical = {text!r}: there is no file {grid}; name the geoid's grid, in GTX or GeoTIFF")
        return cls(name, os.path.abspath(grid) if grid else None)

    def undulation(self) -> Undulation:
        """Make the function of the geoid's height over the ellipsoid.

        Raises
        ------
        InputError
            If PROJ does not have the grid: nothing is downloaded.
        """
        if self.name == "ellipsoid":
            return lambda longitude, latitude: np.zeros(np.shape(longitude))
        from pyproj import Transformer
        from pyproj.exceptions import ProjError
        from pyproj.network import set_network_enabled  # type: ignore[attr-defined]

        set_network_enabled(active=False)
        grid = self.grid or GRIDS[self.name]
        try:
            shift = Transformer.from_pipeline(
                "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad "
                f"+step +proj=vgridshift +grids={grid} +multiplier=1 +step +proj=unitconvert +xy_in=rad +xy_out=deg"
            )
        except ProjError as error:
            raise InputError(
                f"vertical = {self.name}: PROJ has no grid {grid}; install it "
                f"(`pyproj sync --file {GRIDS[self.name]}`), or name a file: --vertical {self.name}:FILE"
            ) from error

        def undulation(longitude: FloatArray, latitude: FloatArray) -> FloatArray:
            height = shift.transform(longitude, latitude, np.zeros(np.shape(longitude)))[2]
            return np.where(np.isfinite(height), height, np.nan)

        return undulation


def datum_of(crs: CRS, vertical: str | None, label: str) -> Datum:
    """Choose the datum that the file states, or that the user states.

    Raises
    ------
    InputError
        If neither does, or they differ, or the file's is another one, or not in m upwards.
    """
    stated = _stated(crs, label)
    given = None if vertical is None else Datum.parse(vertical)
    if stated is None and given is None:
        raise InputError(f"{label} does not say what its heights are measured from, and {WHY}; {REMEDY}")
    if stated is not None and given is not None and stated != given.name:
        raise InputError(f"{label} has heights over {stated}, but vertical is {given.name!r}; leave --vertical out")
    return given or Datum(str(stated))


def _stated(crs: CRS, label: str) -> str | None:
    vertical = next((part for part in crs.sub_crs_list if part.is_vertical), None)
    if vertical is None and len(crs.axis_info) < 3:
        return None
    axis = (vertical or crs).axis_info[-1]
    if axis.unit_conversion_factor != 1 or axis.direction != "up":
        raise InputError(f"{label} has heights in {axis.unit_name}, {axis.direction}wards; convert them to m, upwards")
    if vertical is None:
        return "ellipsoid"
    for name, word in KNOWN_AS.items():
        if word in vertical.name.upper().replace(" ", ""):
            return name
    if "ELLIPSOID" in vertical.name.upper():
        return "ellipsoid"
    raise InputError(f"{label} has heights over {vertical.name!r}, which is not supported; convert them, and {REMEDY}")


FAR = 50.0  # m: heights that differ by less from the scene's plane, or from zeros beside them, are not doubted
LIKELY = 0.1  # of the distance from the plane, within which heights are if they are taken for feet
FOOT = 0.3048  # m
FEET = {
    **dict.fromkeys(("ft", "foot", "feet", "international foot"), FOOT),
    **dict.fromkeys(("us-ft", "ftus", "us survey foot", "us survey feet"), 1200 / 3937),
}  # m, by a unit's name


def remarks_on(heights: FloatArray, plane: float, path: Place, *, feet: bool) -> tuple[str, ...]:
    """Warn of suspicious heights (n_row, n_column), m, NaN where unknown.

    Parameters
    ----------
    plane : float
        Height of the scene's plane over the file's datum, m.
    feet : bool
        Whether the file says that they are feet.
    """
    known = np.isfinite(heights)
    zero = heights == 0
    if not known.any():
        return ()
    if (zero | ~known).all():
        if abs(plane) <= FAR:
            return ()
        return (
            f"{path} is exactly 0 m all over the grid, {abs(plane):.0f} m {_side(-plane)} the scene's plane: if "
            "0 stands for no data, give a file that has the heights, or leave --terrain out",
        )
    if (step := _beside(heights, zero)) > FAR:
        return (
            f"{path} is exactly 0 m at {100 * zero.sum() / known.sum():.2g} % of its heights about the grid, beside "
            f"heights of {step:.0f} m: if 0 stands for no data, tag it (`rio edit-info --nodata 0 "
            f"{shlex.quote(str(path))}`)",
        )
    middle = float(np.median(heights[known]))
    off, as_feet = middle - plane, middle * FOOT - plane
    if not feet and abs(off) > FAR and abs(as_feet) < LIKELY * abs(off):
        return (
            f"{path} lies {abs(off):.0f} m {_side(off)} the scene's plane, but {abs(as_feet):.0f} m "
            f"{_side(as_feet)} it if its heights are feet: if they are, tag them (`rio edit-info "
            f"--bidx 1 --units ft {shlex.quote(str(path))}`)",
        )
    return ()


def _side(height: float) -> str:
    return "above" if height > 0 else "below"


def _beside(heights: FloatArray, zero: BoolArray) -> float:
    """Largest |height|, m, next to one that is zero."""
    most = 0.0
    for first, second in ((np.s_[1:, :], np.s_[:-1, :]), (np.s_[:, 1:], np.s_[:, :-1])):
        edge = zero[first] != zero[second]
        if edge.any():
            most = max(most, float(np.nanmax(np.abs(heights[first][edge] + heights[second][edge]), initial=0.0)))
    return most


ELLIPSOID_SAMPLES = 64  # along each axis: cubic convolution is exact for a paraboloid
METRES = ("", "m", "metre", "metres", "meter", "meters")
REMEDY = "give a GeoTIFF of heights with its coordinate reference system"


def ellipsoid(
    georeference: Georeference, ground_height: float, x: tuple[float, float], y: tuple[float, float]
) -> Terrain:
    """Make the terrain of the ellipsoid's surface, raised to the frame's plane z = ground_height, over a box."""
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
    """Return the horizontal part of a CRS."""
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
    """Latitude, longitude (degrees) and height, m, of points x, y, z: (..., 3)."""
    return georeference.to_geodetic(np.stack(np.broadcast_arrays(x, y, z), axis=-1).astype(np.float64))


def _spacing(
    georeference: Georeference,
    to_pixel: Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]],
    x: tuple[float, float],
    y: tuple[float, float],
) -> float:
    """Distance between pixels at the middle of a box, the smaller of the two, m."""
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
    """Read the file's heights around a box, by column and row."""
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
    """Tell whether swapped axes would explain why a file in degrees misses the image (..., 3), latitude first."""
    west, south, east, north = file.bounds
    latitude, longitude = image[..., 0], image[..., 1]
    return bool(((west <= latitude) & (latitude <= east) & (south <= longitude) & (longitude <= north)).any())


def _extents(file: DatasetReader, image: FloatArray) -> str:
    """Describe the extents of a file and of the image (..., 3), latitude first, degrees."""
    from rasterio.warp import transform_bounds

    west, south, east, north = transform_bounds(file.crs, "EPSG:4326", *file.bounds)
    own = (float(limit(image[..., axis])) for axis in (1, 0) for limit in (np.min, np.max))
    spans = ((west, east, south, north), tuple(own))
    extents = [f"longitude {a:.5g} .. {b:.5g}, latitude {c:.5g} .. {d:.5g} degrees" for a, b, c, d in spans]
    return f"it spans {extents[0]}, and the image {extents[1]}"
