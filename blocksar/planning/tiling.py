"""Division of the work: an image into chunks and windows of them, samples into groups of columns."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

from blocksar.arrays import FloatArray
from blocksar.chunks import IMAGE_CHUNK, SIGNAL_BYTES, TILE
from blocksar.collection.collection import Collection
from blocksar.collection.grid import Grid

Window = tuple[slice, slice]  # rows and columns


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


def inspection_width(collection: Collection) -> int:
    """Number of range frequencies that one task inspects."""
    return min(max(SIGNAL_BYTES // (8 * collection.n_pulse), 1), TILE[1])


def chunk_spans(first: int, last: int, size: int) -> Iterator[tuple[int, int]]:
    """Divide first .. last at multiples of `size`, the borders of a store's chunks."""
    return pairwise(sorted({first, *range(first - first % size + size, last, size), last}))
