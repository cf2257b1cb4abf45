"""The heights of an image on a terrain, which tasks read by windows and write by chunks."""

from __future__ import annotations

import numpy as np

from blocksar import stores
from blocksar.arrays import FloatArray
from blocksar.collection.grid import Grid
from blocksar.collection.terrain import Terrain
from blocksar.graph.spectrum import Window
from blocksar.runs.receipts import Run, write
from blocksar.runs.record import Written


def local_terrain(run: Run, grid: Grid, window: Window) -> Terrain:
    """The part of the run's terrain that some rows and columns of the image need."""
    y, x = grid.y[window[0]], grid.x[window[1]]
    return stores.read_terrain(run.terrain, (float(x[0]), float(x[-1])), (float(y[0]), float(y[-1])))


def heights_of(run: Run, grid: Grid, window: Window) -> FloatArray:
    """The heights of some rows and columns of the image, m."""
    return local_terrain(run, grid, window).on_grid(grid.x[window[1]], grid.y[window[0]])


def write_height(run: Run, window: Window, height: FloatArray | None) -> list[Written]:
    """Write the heights of a chunk of the image; nothing on the plane."""
    return [] if height is None else [write(run, run.image, "height", window, height.astype(np.float32))]
