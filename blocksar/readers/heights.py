"""Heights of the ground as a `Terrain` of the scene frame: from files, or of the ellipsoid."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from blocksar import stores
from blocksar.arrays import FloatArray
from blocksar.collection.georeference import Georeference
from blocksar.collection.grid import Grid
from blocksar.collection.surface import Surface
from blocksar.collection.terrain import LEAST, Terrain
from blocksar.errors import InputError, MissingInput
from blocksar.places import Location, place
from blocksar.places.place import Place
from blocksar.readers.reading import reading
from blocksar.readers.terrain_earth import MOST_HEIGHTS, ellipsoid, read_geotiff, refuse_untagged
from blocksar.stores.contract import UNITS
from blocksar.texts import count

if TYPE_CHECKING:
    import xarray as xr

# ---------------------------------------------------------------- zarr or netCDF with `height` (y, x) in the frame

UNIFORM = 1e-4  # of a step: by so much positions may be off a uniform axis
ENCODED = {"scale_factor", "add_offset", "missing_value"}  # attributes of numbers that stand for others
NANS = ("NaN", "AAAAAAAA+H8=", "AADAfw==")  # as an attribute of a store, also as xarray writes it
REMEDY = "give zarr or netCDF with height (y, x) in m, and x and y in m of the scene frame"


def read_frame_grid(source: Location, x: tuple[float, float], y: tuple[float, float]) -> Terrain:
    """Read the part of a file's heights that a box needs, x and y from .. to, m.

    Raises
    ------
    InputError
        If the file cannot be read, has other variables, dimensions or units, uneven axes or untagged numbers that
        stand for no data, or lies elsewhere.
    """
    path = place(source)
    with reading(path, damaged="not a file of heights", remedy=REMEDY):
        terrain = _read_plain(path, x, y)
        terrain = _read_any(path, x, y) if terrain is None else terrain
    refuse_untagged(np.asarray(terrain.heights), path)
    return terrain


def _read_plain(path: Place, x: tuple[float, float], y: tuple[float, float]) -> Terrain | None:
    """Read a zarr store of plain, unencoded heights without loading xarray; None for any other."""
    if "zarr.json" not in path.names():
        return None
    axes = {}
    for name, dims in (("height", ["y", "x"]), ("x", ["x"]), ("y", ["y"])):
        try:
            metadata = stores.read_json(path / name / "zarr.json")
            attributes = metadata["attributes"]
            plain = metadata["dimension_names"] == dims and metadata["data_type"] in ("float32", "float64")
            plain &= not ENCODED & set(attributes) and attributes.get("_FillValue", NANS[0]) in NANS
            plain &= str(attributes.get("units", "m")).lower() in UNITS["m"]
        except (InputError, KeyError, TypeError, AttributeError):
            return None
        if not plain:
            return None
        if name != "height":
            axes[name] = _uniform(np.asarray(stores.read_region(path, name, (slice(None),)), np.float64), name)
    if any(step < 0 for _, step, _ in axes.values()):
        return None
    terrain = _window_of(path, axes, x, y)
    columns, rows = terrain.span(x, y)
    values = np.ascontiguousarray(stores.read_region(path, "height", (rows, columns)), np.float64)
    return replace(terrain, heights=values, row=rows.start, column=columns.start)


def _read_any(path: Place, x: tuple[float, float], y: tuple[float, float]) -> Terrain:
    """Read zarr or netCDF with any encoding, order of axes, and direction."""
    with _opened(path) as dataset:
        if "height" not in dataset or set(dataset["height"].dims) != {"y", "x"}:
            raise InputError(f"{path} has no height (y, x); {REMEDY}")
        height = dataset["height"].transpose("y", "x")
        if height.dtype.kind not in "iuf":
            raise InputError(f"height in {path} is {height.dtype}, no real numbers; {REMEDY}")
        axes = {axis: _axis(height, axis) for axis in ("x", "y")}
        for variable in (height, dataset["x"], dataset["y"]):
            if (unit := str(variable.attrs.get("units", "m")).lower()) not in UNITS["m"]:
                raise InputError(f"{variable.name} in {path} is in {unit}; {REMEDY}")
        if any(step < 0 for _, step, _ in axes.values()):
            height = height.isel({axis: slice(None, None, -1) for axis, (_, step, _) in axes.items() if step < 0})
        terrain = _window_of(path, {axis: _ascending(*axes[axis]) for axis in axes}, x, y)
        columns, rows = terrain.span(x, y)
        values = np.ascontiguousarray(height.isel(y=rows, x=columns).values, np.float64)
    return replace(terrain, heights=values, row=rows.start, column=columns.start)


def _opened(path: Place) -> xr.Dataset:
    """Open zarr, or netCDF of any kind that an installed library reads."""
    import xarray as xr  # slow to load

    if path.names():
        return xr.open_zarr(path.zarr_path(), consolidated=False)
    try:
        return xr.open_dataset(str(path))
    except ValueError as error:
        if "backend" not in str(error):
            raise
        raise InputError(
            f"{path} is no netCDF file that an installed library reads (netCDF 4 needs h5netcdf or netCDF4); {REMEDY}"
        ) from error


def _window_of(
    path: Place, axes: Mapping[str, tuple[float, float, int]], x: tuple[float, float], y: tuple[float, float]
) -> Terrain:
    """Make a terrain of NaN with these ascending axes, after checking that the part for a box can be read."""
    (x0, dx, n_x), (y0, dy, n_y) = axes["x"], axes["y"]
    if n_x < LEAST or n_y < LEAST:
        raise InputError(f"{path} has {n_y} x {n_x} heights (y, x); give at least {LEAST} x {LEAST}")
    check_overlap(path, (x0, x0 + dx * (n_x - 1)), (y0, y0 + dy * (n_y - 1)), x, y)
    terrain = Terrain(x0=x0, dx=dx, y0=y0, dy=dy, heights=np.broadcast_to(np.float64(np.nan), (n_y, n_x)))
    columns, rows = terrain.span(x, y)
    if (rows.stop - rows.start) * (columns.stop - columns.start) > MOST_HEIGHTS:
        raise InputError(f"{path} has more than {MOST_HEIGHTS} heights within the image; give a coarser one")
    return terrain


def _axis(height, axis: str) -> tuple[float, float, int]:  # type: ignore[no-untyped-def]
    """Start, step (m; of either sign) and size of a uniform axis."""
    if axis not in height.coords:
        raise InputError(f"height has no coordinate {axis}; {REMEDY}")
    return _uniform(np.asarray(height[axis].values, np.float64), axis)


def _uniform(values: FloatArray, axis: str) -> tuple[float, float, int]:
    """Start, step (m; of either sign) and size of positions, if they are uniform."""
    if values.size < LEAST or not np.isfinite(values).all():
        raise InputError(
            f"{axis} has {count(values.size, 'place')}, or some that are not finite; give at least {LEAST}"
        )
    step = float(values[-1] - values[0]) / (values.size - 1)
    off = float(np.abs(values - (values[0] + step * np.arange(values.size))).max())
    if step == 0 or off > UNIFORM * abs(step):
        raise InputError(
            f"{axis} is not uniform: positions are up to {off:.3g} m off steps of {step:.6g} m; resample it"
        )
    return float(values[0]), step, values.size


def _ascending(start: float, step: float, size: int) -> tuple[float, float, int]:
    return (start, step, size) if step > 0 else (start + step * (size - 1), -step, size)


def check_overlap(
    source: object, x: tuple[float, float], y: tuple[float, float], grid_x: tuple[float, float],
    grid_y: tuple[float, float],
) -> None:  # fmt: skip
    """Raise an InputError, with figures, if a terrain and the image do not overlap."""
    if x[0] <= grid_x[1] and grid_x[0] <= x[1] and y[0] <= grid_y[1] and grid_y[0] <= y[1]:
        return
    raise InputError(
        f"terrain {source} lies elsewhere: it spans x {x[0]:.6g} .. {x[1]:.6g} m, y {y[0]:.6g} .. {y[1]:.6g} m of the "
        f"scene frame, and the image x {grid_x[0]:.6g} .. {grid_x[1]:.6g} m, y {grid_y[0]:.6g} .. {grid_y[1]:.6g} m; "
        "give one that covers it"
    )


# ---------------------------------------------------------------- the ground that is asked for

GEOTIFF = (".tif", ".tiff", ".vrt")
SURFACE = "surface"  # the attribute of a phase history
UNTOLD = 1e-6  # of the grid: a share without heights that is not worth a note


@dataclass(frozen=True, kw_only=True)
class Ground:
    """Ground as the user states it: a file of heights with its datum, or a surface; None: as the collection states.

    Raises
    ------
    InputError
        If the settings exclude each other.
    """

    terrain: Location | None = None
    surface: Surface | None = None
    vertical: str | None = None

    def __post_init__(self) -> None:
        if self.surface not in (None, *get_args(Surface)):
            raise InputError(f"surface = {self.surface!r} is unknown; give {' or '.join(get_args(Surface))}")
        if self.terrain is not None and self.surface not in (None, "plane"):
            raise InputError(f"surface = {self.surface} and a terrain are both given; leave one of them out")
        if self.vertical is not None and (self.terrain is None or not self.geotiff):
            what = "there is no terrain" if self.terrain is None else "the terrain's heights are z of the scene frame"
            raise InputError(f"vertical = {self.vertical!r}, but {what}; leave --vertical out")

    @property
    def plane(self) -> bool:
        return self.terrain is None and self.surface in (None, "plane")

    def under(self, attrs: Mapping[str, Any]) -> Ground:
        """Copy completed by the attributes of a store, whose `surface` counts if the user names no ground.

        Raises
        ------
        InputError
            If they have another one.
        """
        if self.terrain is not None or self.surface is not None or attrs.get(SURFACE) is None:
            return self
        return replace(self, surface=attrs[SURFACE])

    def describe(self, terrain: Terrain) -> str:
        """Describe a ground that is no plane in one line."""
        low, high = terrain.limits
        what = "ellipsoid WGS 84" if self.terrain is None else f"terrain {self.terrain}"
        return f"{what}: z = {low:.6g} .. {high:.6g} m"

    @property
    def geotiff(self) -> bool:
        return str(self.terrain).lower().endswith(GEOTIFF)

    def read(self, georeference: Georeference | None, ground_height: float, grid: Grid) -> Terrain | None:
        """Read the ground under a grid; None for the plane.

        Raises
        ------
        InputError
            If a file cannot be read, lies elsewhere or has no height under the grid, or there is no georeference
            where one is needed.
        """
        if self.plane:
            return None
        x, y = (float(grid.x[0]), float(grid.x[-1])), (float(grid.y[0]), float(grid.y[-1]))
        if self.terrain is not None and (georeference is not None or not self.geotiff):
            terrain = self.read_box(georeference, x, y, level=ground_height)
        elif georeference is None:
            if self.terrain is not None and not place(self.terrain).exists():
                raise MissingInput(f"terrain {self.terrain} does not exist; check the path")
            what = "surface = ellipsoid" if self.terrain is None else f"terrain {self.terrain}"
            raise InputError(
                f"{what} needs to know where on the Earth the scene lies; put the attribute georeference into the "
                "phase history"
            )
        else:
            terrain = ellipsoid(georeference, ground_height, x, y)
        if covered(terrain, grid) == 0:
            where = f"x {x[0]:.6g} .. {x[1]:.6g} m and y {y[0]:.6g} .. {y[1]:.6g} m"
            raise InputError(
                f"terrain {self.terrain} has no height under the grid, {where}; fill the hole "
                "(rasterio.fill.fillnodata), or give one that has heights there"
            )
        return terrain

    def read_box(
        self, georeference: Georeference | None, x: tuple[float, float], y: tuple[float, float], *, refine: bool = True,
        level: float | None = None,
    ) -> Terrain:  # fmt: skip
        """Read the part of the file about a box, x and y from .. to, m; a GeoTIFF needs the georeference.

        Without `refine` a GeoTIFF's heights are as dense as in the file: enough for what they hide. With the scene's
        plane z = level, m, the terrain has remarks on them.

        Raises
        ------
        InputError
            If the file cannot be read, or lies elsewhere.
        """
        assert self.terrain is not None
        if not self.geotiff:
            return read_frame_grid(self.terrain, x, y)
        assert georeference is not None
        return read_geotiff(self.terrain, self.vertical, georeference, x, y, refine=refine, level=level)


def covered(terrain: Terrain, grid: Grid) -> float:
    """Share of a grid with known heights, from every n-th row and column."""
    x, y = grid.x[:: max(grid.x.size // 512, 1)], grid.y[:: max(grid.y.size // 512, 1)]
    return float(np.isfinite(terrain.on_grid(x, y)).mean())


def terrain_notes(terrain: Terrain, grid: Grid) -> list[str]:
    """Warn of suspicious heights, and of a part of a grid without heights."""
    share = covered(terrain, grid)
    if share >= 1 - UNTOLD:
        return list(terrain.remarks)
    return [
        *terrain.remarks,
        f"the terrain has no height at {100 * (1 - share):.3g} % of the grid (holes, or beyond its edge): these pixels "
        "are not covered",
    ]
