"""The mosaic: output chunks that several blocks touch, merged from their patches."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from functools import partial
from itertools import groupby
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blocksar import stores
from blocksar.arrays import ComplexArray
from blocksar.chunks import READS_AT_ONCE
from blocksar.collection.grid import Grid
from blocksar.errors import ProcessingError
from blocksar.focusing.noise import NoiseMap
from blocksar.focusing.terrain_layers import Sight
from blocksar.graph.alike import AlikeChunks
from blocksar.graph.layers import TerrainLayers, write_layers, write_noise
from blocksar.graph.segments import Margins, Merged
from blocksar.graph.spectrum import Window
from blocksar.graph.tasks import naming_failures, shifted, sign, write_image
from blocksar.graph.writing import WritesBehind, ahead
from blocksar.planning.tiling import chunk_window
from blocksar.runs.receipts import Run
from blocksar.runs.record import Receipt


class PatchChunk(NamedTuple):
    """A block's part of an output chunk.

    Block and its name, first row and column of its patch, checksum of the part; number of its segment, and of its
    collection, None where there is one only.
    """

    block: int
    name: str
    origin: tuple[int, int]
    checksum: str
    segment: int
    collection: int | None


@naming_failures(lambda run, unit, *_: f"mosaic of {unit}")
def merge_chunks(
    run: Run,
    unit: str,
    cells: Mapping[tuple[int, int], Sequence[PatchChunk]],
    grid: Grid,
    margins: Mapping[tuple[int, int], Margins],
    noises: Mapping[int, NoiseMap] | None = None,
    sights: Mapping[int, Sight] | None = None,
) -> Receipt:
    """Merge patches into output chunks of the mosaic, given by row and column of the chunk.

    Where several segments cover some of a chunk, `margins` has theirs; `noises` has those of segments, if known, and
    `sights` those of segments on a terrain.
    """
    started = time.perf_counter()
    every = [part for patches in cells.values() for part in patches]
    layers = TerrainLayers(run, grid, {part.block: sights[part.segment] for part in every} if sights else {})
    alike = AlikeChunks(run)
    pool = ThreadPoolExecutor(READS_AT_ONCE)
    with pool, WritesBehind() as behind:
        coming = _read_ahead(pool, run, cells, grid)
        for cell, patches in cells.items():
            turn = behind.turn()
            window = chunk_window(cell, grid)
            image, owner = _merge(patches, coming, margins[cell])
            alone = patches[0] if len(patches) == 1 else None
            source = None if alone is None else (run.patch(alone.name), shifted(window, alone.origin))
            collections = {part.block: part.collection for part in patches if part.collection is not None}
            of_blocks = {part.block: noises[part.segment] for part in patches} if noises else {}
            height = layers.heights.over(window) if of_blocks else None
            turn.submit(write_image, run, window, image, owner, collections, source, patches[0].checksum, alike)
            turn.submit(write_noise, run, window, owner, grid, of_blocks, height)
            turn.submit(write_layers, alike, window, layers.over(window, owner))
    return sign(run, Receipt(unit=unit, stage="mosaic", written=behind.written), started)


def _read_ahead(
    pool: Executor, run: Run, cells: Mapping[tuple[int, int], Sequence[PatchChunk]], grid: Grid
) -> Iterator[ComplexArray]:
    """The pixels of all parts of output chunks, in their order; a few are read while those before are merged."""
    windows = ((chunk_window(cell, grid), part) for cell, parts in cells.items() for part in parts)
    return ahead(pool, (partial(_read, run, window, part) for window, part in windows), READS_AT_ONCE)


def _read(run: Run, window: Window, part: PatchChunk) -> ComplexArray:
    """Read a block's part of an output chunk.

    Raises
    ------
    ProcessingError
        If it does not have its checksum.
    """
    pixels = stores.read_region(run.patch(part.name), "image", shifted(window, part.origin), cached=False)
    if stores.checksum(pixels) != part.checksum:
        raise ProcessingError(f"the patch of block {part.name} no longer has the checksum of its receipt")
    return pixels


def _merge(
    parts: Sequence[PatchChunk], coming: Iterator[ComplexArray], margins: Margins
) -> tuple[ComplexArray, NDArray[np.int16]]:
    """The pixels of one output chunk, and the block that each comes from.

    The pixels of its parts are the next that are `coming`.
    """
    by_segment = [list(some) for _, some in groupby(parts, key=lambda part: part.segment)]
    image, owner = _lay(by_segment[0], coming)
    if len(by_segment) > 1:
        merged = Merged(owner.shape)
        first = parts[0].segment
        merged.choose(first, owner >= 0, margins[first])
        for some in by_segment[1:]:
            number = some[0].segment
            other, blocks = _lay(some, coming)
            better = merged.choose(number, blocks >= 0, margins[number])
            np.copyto(image, other, where=better)
            np.copyto(owner, blocks, where=better)
    return image, owner


def _lay(parts: Sequence[PatchChunk], coming: Iterator[ComplexArray]) -> tuple[ComplexArray, NDArray[np.int16]]:
    """Lay the patches of a segment beside each other: pixels, and the block that each comes from; later ones win."""
    image = next(coming)
    owner = np.full(image.shape, -1, np.int16)
    for number, part in enumerate(parts):
        pixels = next(coming) if number else image
        covered = np.isfinite(pixels.real)
        np.copyto(owner, part.block, where=covered)
        if number:
            np.copyto(image, pixels, where=covered)
    return image, owner
