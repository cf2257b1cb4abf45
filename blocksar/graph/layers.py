"""The layers beside an image, which tasks write by its chunks: noise, and on a terrain height and what it does."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from blocksar import stores
from blocksar.arrays import FloatArray
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.collection.terrain import Terrain
from blocksar.focusing.noise import NoiseMap
from blocksar.focusing.terrain_layers import (
    Sight,
    box_of,
    by_owner,
    heights_and_angles,
    heights_on_grid,
    reach,
    visibility,
)
from blocksar.graph.alike import AlikeChunks
from blocksar.graph.spectrum import Window
from blocksar.kernels.occlusion import UNKNOWN
from blocksar.runs.receipts import Run, write
from blocksar.runs.record import Written


def local_terrain(run: Run, grid: Grid, window: Window) -> Terrain:
    """The part of the run's terrain that some rows and columns of the image need."""
    y, x = grid.y[window[0]], grid.x[window[1]]
    return stores.read_terrain(run.terrain, (float(x[0]), float(x[-1])), (float(y[0]), float(y[-1])))


def sights_of(run: Run, grid: Grid, geometries: Sequence[tuple[int, Geometry]]) -> dict[int, Sight]:
    """The antenna of numbered geometries as an image on the run's terrain sees it."""
    if not geometries:
        return {}
    limits = stores.StoredTerrain(run.terrain).limits
    return {number: Sight.of(geometry, box_of(grid.x, grid.y), limits) for number, geometry in geometries}


class GroundHeights:
    """Heights of a run's pixels, by windows; it is not for several threads at once.

    Parameters
    ----------
    run : Run
    grid : Grid
    on_terrain : bool
        False: the image lies on the plane, and nothing is read.
    """

    def __init__(self, run: Run, grid: Grid, *, on_terrain: bool) -> None:
        self._grid, self._stored = grid, stores.StoredTerrain(run.terrain) if on_terrain else None

    def over(self, window: Window) -> FloatArray | None:
        """Heights (n_y, n_x), m, of some rows and columns of the image; None on the plane."""
        if self._stored is None:
            return None
        y, x = self._grid.y[window[0]], self._grid.x[window[1]]
        return heights_on_grid(self._stored.read(*box_of(x, y)), x, y)


class _Surfaces(NamedTuple):
    """Heights of a window's pixels, m, incidence angles by sight, rad, and the terrain within its reach."""

    height: FloatArray
    angles: Mapping[int, NDArray[np.float32]]
    around: Terrain


class TerrainLayers:
    """Height, local incidence angle and visibility of a run's pixels; not for several threads at once.

    Parameters
    ----------
    run : Run
    grid : Grid
    sights : dict
        The antenna as seen from the pixels of each block. Without any the image lies on the plane, and there are no
        layers.

    Attributes
    ----------
    heights : GroundHeights
    """

    def __init__(self, run: Run, grid: Grid, sights: Mapping[int, Sight]) -> None:
        self._grid, self._sights = grid, sights
        self.heights = GroundHeights(run, grid, on_terrain=bool(sights))
        self._found: tuple[Window, _Surfaces] | None = None
        self._stored = self._around = stores.StoredTerrain(run.terrain) if sights else None
        if sights and (run.surroundings / "zarr.json").exists():
            self._around = stores.StoredTerrain(run.surroundings)

    def over(self, window: Window, owner: NDArray[np.int16] | int) -> dict[str, NDArray[Any]]:
        """The layers of some rows and columns of the image, by name.

        `owner` has the block of each pixel, -1 where not covered, or is the block of all of them. Shadow and layover
        reach as far as the terrain about the image is known.
        """
        if self._stored is None:
            return {}
        if self._found is None or self._found[0] != window:
            self._found = window, self._surfaces(window)
        height, angles, around = self._found[1]
        incidence = by_owner(self._sights, owner, lambda sight: angles[id(sight)], np.nan)
        seen = by_owner(self._sights, owner, lambda sight: visibility(around, sight, self._grid, window), UNKNOWN)
        layers = {"height": height, "incidence_angle": incidence, "visibility": seen}
        return {name: layers[name].astype(of.dtype, copy=False) for name, of in stores.ON_TERRAIN.items()}

    def heights_of_covered(self, window: Window) -> FloatArray:
        """Heights (n_y, n_x), m, of a window whose layers are asked for next: what both need is found once."""
        self._found = window, self._surfaces(window)
        return self._found[1].height

    def _surfaces(self, window: Window) -> _Surfaces:
        assert self._stored is not None and self._around is not None
        y, x = self._grid.y[window[0]], self._grid.x[window[1]]
        boxes, seen_by = [box_of(x, y)], {id(sight): sight for sight in self._sights.values()}
        for sight in seen_by.values():
            boxes.append(reach(sight, x, y, self._around.limits))
        (x0, x1, y0, y1) = (np.array(boxes)[:, axis, end] for axis in (0, 1) for end in (0, 1))
        around = self._around.read((float(x0.min()), float(x1.max())), (float(y0.min()), float(y1.max())))
        terrain = around if self._around is self._stored else self._stored.read(*boxes[0])
        found = {number: heights_and_angles(terrain, sight, x, y) for number, sight in seen_by.items()}
        height = next(iter(found.values()))[0]
        return _Surfaces(height, {number: angle for number, (_, angle) in found.items()}, around)


def write_layers(alike: AlikeChunks, window: Window, layers: Mapping[str, NDArray[Any]]) -> list[Written]:
    """Write layers of a chunk of the image, given by name."""
    return [alike.write(name, window, values) for name, values in layers.items()]


def write_noise(
    run: Run,
    window: Window,
    owner: NDArray[np.int16],
    grid: Grid,
    noises: Mapping[int, NoiseMap],
    height: FloatArray | None,
) -> list[Written]:
    """Write the noise of a chunk of the image where it is covered, by that of blocks; nothing if it is not known.

    `height` (n_y, n_x) has z of the pixels, m, on a terrain.
    """
    if not noises:
        return []
    values = np.full(owner.shape, np.nan, np.float32)
    for noise in {id(noise): noise for noise in noises.values()}.values():
        own = np.isin(owner, [block for block, of in noises.items() if of is noise])
        np.copyto(values, noise.over(grid.x[window[1]], grid.y[window[0]], height), where=own)
    return [write(run, run.image, "noise_equivalent", window, values)]
