"""Patches of blocks: the chunks of the image that a block touches."""

from __future__ import annotations

import numpy as np

from blocksar.collection.geometry import Level
from blocksar.collection.grid import Grid
from blocksar.planning.tiling import image_chunk
from blocksar.processors.chain.ground.correction import touched
from blocksar.processors.chain.ground.ground_map import GroundMap


def patch_window(ground: GroundMap, grid: Grid) -> tuple[int, int, int, int]:
    """First row, first column, rows and columns of a block's patch: whole image chunks around its sector."""
    yaw = np.linspace(ground.low, ground.high, 257)
    geometry = ground.geometry
    planes, ends = [geometry.over(None, Level(z)) for z in {*ground.levels}], np.array([[ground.near], [ground.far]])
    corners = np.concatenate([plane.ground_point(ends, yaw) for plane in planes])
    side = image_chunk(grid)
    spans = []
    for axis, values, chunk, step in ((1, grid.y, side[0], grid.dy), (0, grid.x, side[1], grid.dx)):
        # Between two samples the outline bulges by less than this.
        bulge = ground.far * (yaw[1] - yaw[0]) ** 2 + step
        low, high = np.nanmin(corners[..., axis]) - bulge, np.nanmax(corners[..., axis]) + bulge
        first = int(np.clip(np.searchsorted(values, low), 0, values.size - 1)) // chunk * chunk
        last = int(np.clip(np.searchsorted(values, high), 1, values.size))
        spans.append((first, min(-(-last // chunk) * chunk, values.size) - first))
    return spans[0][0], spans[1][0], spans[0][1], spans[1][1]


def touched_chunks(ground: GroundMap, grid: Grid) -> list[tuple[int, int]]:
    """Row and column of each image chunk that a block may own pixels of."""
    first_y, first_x, n_y, n_x = patch_window(ground, grid)
    side = image_chunk(grid)
    x, y = grid.x[first_x : first_x + n_x], grid.y[first_y : first_y + n_y]
    first = touched(ground, x=x, y=y, side=side)
    return [(int(first_y + row) // side[0], int(first_x + column) // side[1]) for row, column in first]
