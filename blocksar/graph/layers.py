"""The layers beside an image, which tasks write by its chunks: noise, and on a terrain height and what it does."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from blocksar import stores
from blocksar.arrays import FloatArray
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.collection.terrain import Terrain
from blocksar.focusing.noise import NoiseMap
from blocksar.focusing.terrain_layers import Sight, box_of, by_owner, incidence_angle, reach, visibility
from blocksar.graph.spectrum import Window
from blocksar.kernels.occlusion import UNKNOWN
from blocksar.runs.receipts import Run, write
from blocksar.runs.record import Written


def local_terrain(run: Run, grid: Grid, window: Window) -> Terrain:
    """The part of the run's terrain that some rows and columns of the image need."""
    y, x = grid.y[window[0]], grid.x[window[1]]
    return stores.read_terrain(run.terrain, (float(x[0]), float(x[-1])), (float(y[0]), float(y[-1])))


def heights_of(run: Run, grid: Grid, window: Window) -> FloatArray:
    """The heights of some rows and columns of the image, m."""
    return local_terrain(run, grid, window).on_grid(grid.x[window[1]], grid.y[window[0]])


def sights_of(run: Run, grid: Grid, geometries: Sequence[tuple[int, Geometry]]) -> dict[int, Sight]:
    """The antenna of numbered geometries as an image on the run's terrain sees it."""
    if not geometries:
        return {}
    limits = stores.terrain_limits(run.terrain)
    return {number: Sight.of(geometry, box_of(grid.x, grid.y), limits) for number, geometry in geometries}


@dataclass(frozen=True, eq=False)
class TerrainLayers:
    """Height, local incidence angle and visibility of a run's pixels.

    Attributes
    ----------
    run : Run
    grid : Grid
    sights : dict
        The antenna as seen from the pixels of each block. Without any the image lies on the plane, and nothing is
        written.
    """

    run: Run
    grid: Grid
    sights: Mapping[int, Sight]

    def write(self, window: Window, owner: NDArray[np.int16], height: FloatArray | None = None) -> list[Written]:
        """Write the layers of a chunk of the image; `owner` has the block of each pixel, -1 where not covered.

        `height` is from `heights_of`, if that is at hand.
        """
        if not self.sights:
            return []
        terrain, x, y = local_terrain(self.run, self.grid, window), self.grid.x[window[1]], self.grid.y[window[0]]
        height = terrain.on_grid(x, y) if height is None else height
        incidence = by_owner(self.sights, owner, lambda sight: incidence_angle(terrain, sight, x, y, height), np.nan)
        seen = by_owner(self.sights, owner, lambda sight: self._visibility(sight, window), UNKNOWN)
        layers = {"height": height, "incidence_angle": incidence, "visibility": seen}
        types = {name: variable.dtype for name, variable in stores.ON_TERRAIN.items()}
        return [write(self.run, self.run.image, name, window, layers[name].astype(types[name])) for name in layers]

    def _visibility(self, sight: Sight, window: Window) -> NDArray[np.uint8]:
        """Visibility of a window, with the terrain as far as shadow and layover reach there."""
        limits = stores.terrain_limits(self.run.terrain)
        box = reach(sight, self.grid.x[window[1]], self.grid.y[window[0]], limits)
        return visibility(stores.read_terrain(self.run.terrain, *box), sight, self.grid, window)


def write_noise(
    run: Run, window: Window, owner: NDArray[np.int16], grid: Grid, noises: Mapping[int, NoiseMap]
) -> list[Written]:
    """Write the noise of a chunk of the image where it is covered, by that of blocks; nothing if it is not known."""
    if not noises:
        return []
    values = np.full(owner.shape, np.nan, np.float32)
    for noise in {id(noise): noise for noise in noises.values()}.values():
        own = np.isin(owner, [block for block, of in noises.items() if of is noise])
        np.copyto(values, noise.over(grid.x[window[1]], grid.y[window[0]]), where=own)
    return [write(run, run.image, "noise_equivalent", window, values)]
