"""Predicted peak memory of a worker that back-projects, and of its GPU."""

from __future__ import annotations

import math

from blocksar.chunks import BACKPROJECTION_CHUNK
from blocksar.collection.collection import Collection
from blocksar.collection.grid import Grid
from blocksar.planning.memory import GPU_PROCESS_MEMORY, PROCESS_MEMORY, checked_memory
from blocksar.planning.tiling import image_chunk, inspection_width
from blocksar.processors.exact.sums import gpu_memory, image_memory


def checked_back_projection_memory(
    collection: Collection, grid: Grid, threads: int, memory_limit: int, chunks: tuple[int, int] | None = None
) -> int:
    """Peak memory of a worker that back-projects, bytes, if its limit holds it.

    Raises
    ------
    InputError
        If the limit is too low.
    """
    memory = back_projection_memory(collection, grid, threads=threads, chunks=chunks)
    return checked_memory("back-projection", memory, memory_limit)


def back_projection_memory(
    collection: Collection, grid: Grid, *, threads: int, chunks: tuple[int, int] | None = None
) -> int:
    """Peak memory of a worker that inspects and back-projects, bytes; on a GPU to `chunks` at a time."""
    pixels = math.prod(image_chunk(grid))
    part = min(pixels, BACKPROJECTION_CHUNK**2)
    if chunks is not None:
        part = pixels = _box(grid, chunks)
    inspecting = 2 * 8 * inspection_width(collection) * collection.n_pulse  # as an array, and as chunks read
    forming = 3 * 8 * pixels + image_memory(part, collection, threads=threads)  # image, covered part, bytes to write
    return PROCESS_MEMORY + max(inspecting, forming) + (0 if chunks is None else GPU_PROCESS_MEMORY)


def gpu_back_projection_memory(collection: Collection, grid: Grid, chunks: tuple[int, int]) -> int:
    """Peak memory of a GPU that back-projects to `chunks` at a time, bytes."""
    return gpu_memory(_box(grid, chunks), collection)


def _box(grid: Grid, chunks: tuple[int, int]) -> int:
    """Pixels of a box of chunks."""
    return math.prod(min(n, k * side) for n, k, side in zip(grid.shape, chunks, image_chunk(grid), strict=True))
