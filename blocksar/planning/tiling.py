"""Division of the work: an image into chunks and patches, samples into groups of columns."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.chunks import IMAGE_CHUNK, SIGNAL_BYTES, TILE
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Level
from blocksar.collection.grid import Grid
from blocksar.processors.chain.ground.correction import touched
from blocksar.processors.chain.ground.ground_map import GroundMap


def image_chunk(grid: Grid) -> tuple[int, int]:
    """Rows and columns of a chunk of the image."""
    return min(IMAGE_CHUNK, grid.shape[0]), min(IMAGE_CHUNK, grid.shape[1])


def chunks_of(grid: Grid) -> list[tuple[FloatArray, FloatArray]]:
    """x (n_x,) and y (n_y,), m, of each chunk of the image, row by row."""
    n_y, n_x = image_chunk(grid)
    return [
        (grid.x[column : column + n_x], grid.y[row : row + n_y])
        for row in range(0, grid.shape[0], n_y)
        for column in range(0, grid.shape[1], n_x)
    ]


def units_of(grid: Grid, chunks: tuple[int, int]) -> list[list[tuple[slice, slice]]]:
    """Windows of each unit of `chunks` rows and columns of image chunks: one window for each chunk."""
    spans = [
        [slice(first, min(first + step, n)) for first in range(0, n, step)]
        for n, step in zip(grid.shape, image_chunk(grid), strict=True)
    ]
    rows, columns = (
        [each[first : first + number] for first in range(0, len(each), number)]
        for each, number in zip(spans, chunks, strict=True)
    )
    return [[(row, column) for row in some for column in others] for some in rows for others in columns]


def window_around(windows: Sequence[tuple[slice, slice]]) -> tuple[slice, slice]:
    """Bounding window of some windows."""
    spans = [slice(min(w[k].start for w in windows), max(w[k].stop for w in windows)) for k in (0, 1)]
    return spans[0], spans[1]


def chunk_window(cell: tuple[int, int], grid: Grid) -> tuple[slice, slice]:
    """Rows and columns of an output chunk, given by its row and column."""
    side = image_chunk(grid)
    y, x = cell[0] * side[0], cell[1] * side[1]
    return slice(y, min(y + side[0], grid.shape[0])), slice(x, min(x + side[1], grid.shape[1]))


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


def inspection_width(collection: Collection) -> int:
    """Number of range frequencies that one task inspects."""
    return min(max(SIGNAL_BYTES // (8 * collection.n_pulse), 1), TILE[1])
