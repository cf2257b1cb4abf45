"""The ground of a scene as a `Terrain`: from a file of heights, or hills.

Shadow: the terrain may lie between a scatterer and the antenna, so that pulses do not reach the scatterer.

A scatterer is hidden from a pulse if the ray from it to the antenna's place at that pulse passes below the terrain,
which is bilinear between its samples here, as in the layer `visibility` of images. Rays are followed for some pulses of
each dwell only, so close to each other that in between a ray moves over the terrain by less than half a sample; where a
scatterer is hidden from one of them and not from the next, the pulse at which that changes is found by bisection. So
each pulse is right, but for a scatterer that appears and disappears again within such an interval.

The terrain hides where it is known: a scene asks for it as far towards the antenna as `reach_of_shadow` says.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, ValidationInfo, model_validator

from blocksar.arrays import BoolArray, FloatArray, IntArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.georeference import Georeference
from blocksar.collection.terrain import MARGIN, Terrain
from blocksar.constants import TURN
from blocksar.errors import InputError
from blocksar.kernels.occlusion import STEPS, HeightGrid, find_shadow
from blocksar.readers.heights import Ground
from blocksar.readers.terrain_earth import Box, ellipsoid, read_around
from blocksar.simulation.scene_fields import Positive, Table

RAYS = 1 << 18  # that are followed at a time
ROOM = 1.0  # dwells of margin on either side, as a raised point's dwell differs from the plane's

Rays = Callable[[IntArray, IntArray], BoolArray]  # of scatterers and pulses: whether they are hidden


@dataclass(frozen=True, eq=False)
class Shadow:
    """Shadow: the pulses that do not reach scatterers because of the terrain.

    Attributes
    ----------
    hidden : (n,) bool
        From the first pulses of each dwell.
    index, pulse : (m,) int
        Scatterers, ascending, and the pulses from which on they are not what they were before.
    """

    hidden: BoolArray
    index: IntArray
    pulse: IntArray

    def at(self, pulse: int, first: int, last: int) -> BoolArray:
        """Mask (last - first,) of the scatterers first <= i < last that a pulse does not reach."""
        a, b = np.searchsorted(self.index, [first, last])
        changed = self.index[a:b][self.pulse[a:b] <= pulse] - first
        return self.hidden[first:last] ^ (np.bincount(changed, minlength=last - first) % 2 == 1)


def cast_shadow(
    collection: Collection, terrain: Terrain, x: FloatArray, y: FloatArray, z: FloatArray, *, threads: int = 1
) -> Shadow | None:
    """Find the pulses that terrain hides from scatterers (n,) at x, y, z, m; None if it hides none within dwells.

    Parameters
    ----------
    collection : Collection
        With the antenna's places as they really were.
    terrain : Terrain
    threads : int
        Number of threads; the result does not depend on it.
    """
    terrain = terrain.thinned()
    rays = _rays(collection, terrain, x, y, z)
    first, last = _tested(collection, x, y)
    nodes = int((last - first).max()) // _pulses_between(collection, terrain) + 2
    size = max(RAYS // nodes, 1)
    groups = [np.arange(start, min(start + size, x.size)) for start in range(0, x.size, size)]
    with ThreadPoolExecutor(threads) as pool:
        parts = list(pool.map(lambda group: _changes(rays, group, first[group], last[group], nodes), groups))
    hidden, index, pulse = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return Shadow(hidden, index, pulse) if hidden.any() or index.size else None


def reach_of_shadow(
    track: FloatArray, x: tuple[float, float], y: tuple[float, float], limits: tuple[float, float]
) -> Box:
    """Box, m, of the terrain that can hide ground in a box from the antenna: where rays pass below the highest place.

    Parameters
    ----------
    track : (n, 3) float
        Places of the antenna, m.
    x, y : (float, float)
        The box of the ground, from .. to, m.
    limits : (float, float)
        Lowest and highest height of the whole terrain, m.
    """
    above = np.maximum(track[:, 2] - limits[0], 1.0)
    share = np.minimum((limits[1] - limits[0]) / above, 1.0)[:, None]  # of the way to below the antenna
    ends = [at + share * (track[:, axis, None] - at) for axis, at in ((0, np.array(x)), (1, np.array(y)))]
    low, high = ([float(pick(end)) for end in ends] for pick in (np.min, np.max))
    return (min(x[0], low[0]), max(x[1], high[0])), (min(y[0], low[1]), max(y[1], high[1]))


def _rays(collection: Collection, terrain: Terrain, x: FloatArray, y: FloatArray, z: FloatArray) -> Rays:
    """Make a function of scatterers (k,) and pulses (k,) that traces their rays and tells which are hidden."""
    grid = HeightGrid.of(terrain.heights, terrain.dx, terrain.dy)
    columns, rows = (x - terrain.x0) / terrain.dx - terrain.column, (y - terrain.y0) / terrain.dy - terrain.row

    def hidden(which: IntArray, pulses: IntArray) -> BoolArray:
        sight = collection.antenna_position[pulses] - np.stack([x[which], y[which], np.zeros(which.size)], axis=1)
        found = np.empty(which.size, np.bool_)
        find_shadow(grid, columns[which], rows[which], z[which], sight, found)
        return found

    return hidden


def _pulses_between(collection: Collection, terrain: Terrain) -> int:
    """Number of pulses during which a ray moves by less than half a sample over the terrain.

    At the horizontal distance s from its point, of d to the antenna, a ray moves by s / d of what the antenna does. It
    is above all of the terrain from s = relief d / height on, with the antenna's height over the highest point.
    """
    track = collection.antenna_position
    above, relief = float(track[:, 2].min()) - terrain.limits[1], terrain.limits[1] - terrain.limits[0]
    moved = float(np.sqrt((np.diff(track, axis=0) ** 2).sum(axis=1)).max()) * relief
    most = min(terrain.dx, terrain.dy) / STEPS * max(above, 0.0)
    return int(max(most / moved, 1.0)) if most < collection.n_pulse * moved else collection.n_pulse


def _tested(collection: Collection, x: FloatArray, y: FloatArray) -> tuple[IntArray, IntArray]:
    """First and last pulse at which each scatterer may be lit: its dwell with a margin."""
    end = collection.n_pulse - 1
    width, beam = collection.beam_width, collection.beam_azimuth
    round_about = not collection.has_axis and width is not None and abs(beam[-1] - beam[0]) + width >= TURN
    if width is None or round_about:
        return np.zeros(x.size, np.int64), np.full(x.size, end)
    firsts, lasts = Geometry(collection=collection).beam.passes(x, y)
    first, last = firsts[0], lasts[-1]
    room = np.ceil(ROOM * (last - first)).astype(np.int64)
    return np.clip(first - room, 0, end), np.clip(last + room, 0, end)


def _changes(
    rays: Rays, group: IntArray, first: IntArray, last: IntArray, nodes: int
) -> tuple[BoolArray, IntArray, IntArray]:
    """Find `hidden`, `index` and `pulse` of `Shadow` for some scatterers by bisection between `nodes` pulses each."""
    pulses = np.rint(first[:, None] + (last - first)[:, None] * np.linspace(0, 1, nodes)).astype(np.int64)
    hidden = rays(np.repeat(group, nodes), pulses.ravel()).reshape(pulses.shape)
    row, column = np.nonzero(hidden[:, 1:] != hidden[:, :-1])
    before, after, start = pulses[row, column], pulses[row, column + 1], hidden[row, column]
    while (open_ := np.flatnonzero(after - before > 1)).size:
        middle = (before[open_] + after[open_]) // 2
        same = rays(group[row[open_]], middle) == start[open_]
        before[open_[same]], after[open_[~same]] = middle[same], middle[~same]
    return hidden[:, 0], group[row], after


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
        """Ground that the hills stand on."""
        return Ground(terrain=self.file, surface=self.surface, vertical=self.vertical)

    @property
    def needs_earth(self) -> str:
        """Names of keys that need a georeference; empty if there are none."""
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
    """Terrain over the box of points, m; hills stand on the plane z = `plane`, or on WGS 84 at that height.

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
    """Terrain that may hide a box, over which `terrain` lies, from antenna positions (n, 3), m.

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
    """Sample the hills over a box."""
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
