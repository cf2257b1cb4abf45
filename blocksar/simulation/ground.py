"""The ground of a scene: a file of heights, or hills, as the `Terrain` that everything stands on."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, ValidationInfo, model_validator

from blocksar.arrays import FloatArray
from blocksar.collection.georeference import Georeference
from blocksar.collection.terrain import MARGIN, Terrain
from blocksar.errors import InputError
from blocksar.ingestion.terrain.earth import ellipsoid
from blocksar.ingestion.terrain.reading import Ground
from blocksar.ingestion.terrain.resampling import Box, read_around
from blocksar.simulation.shadow import reach_of_shadow
from blocksar.simulation.tables import Positive, Table

SAMPLES = 40  # of a hill's width, by default
MOST_SAMPLES = 1 << 26  # of the ground: 512 MiB


class HillTable(Table):
    """A hill: height exp(-4 ln 2 r^2 / width^2) at the distance r from its centre, over the ground plane."""

    x: float = Field(description="scene-frame x of the centre, m")
    y: float = Field(description="scene-frame y of the centre, m")
    height: float = Field(description="height of the top over the ground plane, m; below 0 for a hollow")
    width: Positive = Field(description="width at half the height, m")


class TerrainTable(Table):
    """The height of the ground: a file of heights, or hills."""

    file: str | None = Field(
        None, description="zarr or netCDF with height (y, x), m, or a GeoTIFF; relative to the scene file"
    )
    vertical: str | None = Field(None, description="vertical datum of a GeoTIFF: egm96, egm2008 or ellipsoid")
    hills: Annotated[tuple[HillTable, ...], Field(strict=False)] = Field((), description="hills")
    spacing: Positive | None = Field(
        None, description="spacing of the samples that hills are given by, m; default: a 40th of the least width"
    )
    surface: Literal["plane", "ellipsoid"] = Field(
        "plane", description="what hills stand on: the ground plane, or WGS 84 at its height"
    )

    @model_validator(mode="after")
    def _check(self, info: ValidationInfo) -> Self:
        if self.file is None and not self.hills and self.surface == "plane":
            raise ValueError("neither given: give either file or hills, or surface = 'ellipsoid'")
        if self.file is not None:
            if self.hills:
                raise ValueError("both given: give either file or hills")
            folder = (info.context or {}).get("folder")
            path = Path(self.file) if folder is None else Path(folder) / self.file
            if not os.path.lexists(path):
                raise ValueError(f"file = {self.file!r}: must be a zarr store, a netCDF file or a GeoTIFF")
            object.__setattr__(self, "file", str(path))
        try:
            self.asked  # noqa: B018 - checks that its settings go together
        except InputError as error:
            raise ValueError(str(error).replace("leave --vertical out", "leave vertical out")) from None
        return self

    @property
    def asked(self) -> Ground:
        """Say what is said of the ground beneath hills."""
        return Ground(terrain=self.file, surface=self.surface, vertical=self.vertical)

    @property
    def needs_earth(self) -> str:
        """Find what of it needs to know where on the Earth the frame lies; empty if nothing does."""
        if self.surface == "ellipsoid":
            return "terrain.surface = 'ellipsoid'"
        return f"terrain.file = {self.file!r}" if self.file is not None and self.asked.geotiff else ""


def terrain_of(
    table: TerrainTable,
    plane: float,
    points_x: FloatArray,
    points_y: FloatArray,
    georeference: Georeference | None = None,
) -> Terrain:
    """The ground over the box of points, m; hills stand on the plane z = `plane`, or on WGS 84 at that height.

    Raises
    ------
    InputError
        If the file cannot be read or does not cover the box, or hills need too many samples.
    """
    x, y = ((float(axis.min()), float(axis.max())) for axis in (points_x, points_y))
    if table.file is not None:
        terrain = table.asked.read_box(georeference, x, y)
        corners = terrain(np.array(x)[:, None], np.array(y))
        if not np.isfinite(corners).all() or not np.isfinite(terrain.heights).all():
            raise InputError(
                f"terrain.file = {table.file!r}: must have a height everywhere at x {x[0]:.6g} .. {x[1]:.6g} m, "
                f"y {y[0]:.6g} .. {y[1]:.6g} m, where the scene reaches"
            )
        return terrain
    if not table.hills:
        assert georeference is not None  # checked when read
        return ellipsoid(georeference, plane, x, y)
    return _hills_over(table, plane, (x, y), georeference)


def hiding_terrain(
    table: TerrainTable,
    plane: float,
    terrain: Terrain,
    own: Box,
    track: FloatArray,
    georeference: Georeference | None = None,
) -> Terrain:
    """The ground as far as it hides places of a box, with `terrain`, from places of the antenna (n, 3), m.

    Of a file, as much as it has.
    """
    if table.file is None and not table.hills:
        return terrain

    def read(box: Box) -> Terrain:
        if table.file is not None:
            return table.asked.read_box(georeference, *box, refine=False)
        return _hills_over(table, plane, box, georeference)

    around = read_around(terrain, own, lambda limits: reach_of_shadow(track, *own, limits), read)
    return terrain if around is None else around


def _hills_over(table: TerrainTable, plane: float, box: Box, georeference: Georeference | None) -> Terrain:
    """Samples of hills over a box."""
    x, y = box
    step = table.spacing or min(hill.width for hill in table.hills) / SAMPLES
    sizes = [int(np.ceil((high - low) / step)) + 2 * MARGIN + 2 for low, high in (x, y)]
    if sizes[0] * sizes[1] > MOST_SAMPLES:
        raise InputError(
            f"terrain.spacing = {step:.4g} m makes {sizes[1]} x {sizes[0]} heights, more than {MOST_SAMPLES}; give a "
            "larger one"
        )
    x0, y0 = (np.floor(low / step - MARGIN) * step for low in (x[0], y[0]))
    along_x, along_y = x0 + step * np.arange(sizes[0]), y0 + step * np.arange(sizes[1])
    heights = np.full((sizes[1], sizes[0]), plane)
    if table.surface == "ellipsoid":
        assert georeference is not None
        around = [(float(axis[0]), float(axis[-1])) for axis in (along_x, along_y)]
        heights = ellipsoid(georeference, plane, *around).on_grid(along_x, along_y)
    for hill in table.hills:
        rate = 4 * np.log(2) / hill.width**2
        profiles = (np.exp(-rate * (axis - at) ** 2) for axis, at in ((along_x, hill.x), (along_y, hill.y)))
        of_x, of_y = profiles
        heights += hill.height * of_y[:, None] * of_x
    return Terrain(x0=float(x0), dx=float(step), y0=float(y0), dy=float(step), heights=heights)
