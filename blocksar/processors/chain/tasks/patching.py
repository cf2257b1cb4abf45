"""Tasks that correct a focused block geometrically, write its patch, and merge patches into the mosaic."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blocksar import stores
from blocksar.arrays import ComplexArray, FloatArray
from blocksar.chunks import READS_AT_ONCE, TILED_CHUNKS
from blocksar.collection.grid import Grid
from blocksar.collection.weighting import Weighting
from blocksar.errors import ProcessingError
from blocksar.imaging.noise import NoiseMap
from blocksar.imaging.recorded_pulses import divide_by_recorded
from blocksar.planning.tiling import Window, chunk_window, image_chunk
from blocksar.processors.chain.ground.correction import correct, tiles_of
from blocksar.processors.chain.ground.ground_map import GroundMap
from blocksar.processors.chain.ground.patches import patch_window, touched_chunks
from blocksar.processors.chain.ground.pixel_rows import Tiles
from blocksar.processors.chain.planning.block import BlockPlan
from blocksar.processors.chain.tasks.blocks import BlockSamples
from blocksar.runs.receipts import Run, write
from blocksar.runs.record import Receipt, Written
from blocksar.tasks.forming import shifted, write_image
from blocksar.tasks.layers import AlikeChunks, GroundHeights, strips_of, write_noise
from blocksar.tasks.segments import Margins, Merged
from blocksar.tasks.writing import ComputeTurn, WritesBehind, ahead, in_threads


class PatchChunk(NamedTuple):
    """Part of a block's patch in an output chunk.

    Block and its name, first row and column of its patch, checksum of the part; number of its segment, and of its
    collection, None where there is one only.
    """

    block: int
    name: str
    origin: tuple[int, int]
    checksum: str
    segment: int
    collection: int | None


def merge_chunks(
    run: Run,
    unit: str,
    cells: Mapping[tuple[int, int], Sequence[PatchChunk]],
    grid: Grid,
    margins: Mapping[tuple[int, int], Margins],
    noises: Mapping[int, NoiseMap] | None = None,
) -> Receipt:
    """Merge patches into output chunks of the mosaic, given by row and column of the chunk.

    Where several segments cover some of a chunk, `margins` has theirs; `noises` has those of segments, if known.
    """
    heights, layer_chunks = GroundHeights(run, grid), AlikeChunks(run)
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
            height = heights.over(window) if of_blocks else None
            turn.submit(write_image, run, window, image, owner, collections, source, patches[0].checksum, layer_chunks)
            turn.submit(write_noise, run, window, owner, grid, of_blocks, height)
    return Receipt(unit=unit, stage="mosaic", written=behind.written)


def _read_ahead(
    pool: ThreadPoolExecutor, run: Run, cells: Mapping[tuple[int, int], Sequence[PatchChunk]], grid: Grid
) -> Iterator[ComplexArray]:
    """Iterate over the pixels of all parts of output chunks in order; a few are read ahead."""
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
    """Merge the parts of an output chunk: its pixels, and the block that each comes from.

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
    """Lay the patches of one segment over each other: pixels and their blocks; later patches overwrite earlier ones."""
    image = next(coming)
    owner = np.full(image.shape, -1, np.int16)
    for number, part in enumerate(parts):
        pixels = next(coming) if number else image
        covered = np.isfinite(pixels.real)
        np.copyto(owner, part.block, where=covered)
        if number:
            np.copyto(image, pixels, where=covered)
    return image, owner


@dataclass(frozen=True, kw_only=True, eq=False)
class Patch:
    """Target of a focused block: ground map, grid, and the chunks that it owns alone.

    Attributes
    ----------
    ground : GroundMap
        From the focused block to the ground.
    grid : Grid
        The image's.
    own : frozenset of (row, column)
        Chunks of the image that no other block touches: they become the image's as they are.
    noise : NoiseMap or None
        The block's noise, where it is known.
    """

    ground: GroundMap
    grid: Grid
    own: frozenset[tuple[int, int]]
    noise: NoiseMap | None


def write_patch(run: Run, unit: str, samples: BlockSamples, block: BlockPlan, patch: Patch) -> Receipt:
    """Correct a focused block geometrically, and write its patch in chunks of the image's grid.

    Chunks are written by other threads while the next ones are computed.
    """
    started = time.perf_counter()
    assert samples.values is not None
    chunks = _PatchChunks(run=run, block=block, values=samples.values, patch=patch)
    with WritesBehind(threads=run.threads) as behind:
        memories = [np.empty(chunks.largest, np.complex64) for _ in range(behind.held)]
        jobs = (partial(chunks.correct, behind.turn(), memories, *each) for each in chunks.tiled())
        for corrected in in_threads(jobs, run.threads):
            if corrected.owner is not None:
                corrected.turn.submit(chunks.write, corrected)
    seconds = samples.seconds | {"geometric-correction": time.perf_counter() - started}
    # The receipt covers the whole block: the tasks before this one have no receipts.
    before = sum(samples.seconds.values())
    return Receipt(
        unit=unit, stage="focus", seconds=before, written=behind.written, origin=chunks.origin, steps=seconds
    )


class _Corrected(NamedTuple):
    """Corrected pixels of a chunk.

    Pixels (n_y, n_x) of a window of the image, their z, m, or None on the plane, and the block that each comes from:
    one for all, or None if none is covered.
    """

    turn: ComputeTurn
    cell: tuple[int, int]
    height: FloatArray | None
    pixels: ComplexArray
    owner: NDArray[np.int16] | int | None


class _PatchChunks:
    """Chunks of a block's patch, and of the image where no other block covers them."""

    def __init__(self, *, run: Run, block: BlockPlan, values: ComplexArray, patch: Patch) -> None:
        self.run, self.block, self.values, self.patch = run, block, values, patch
        self.ground, self.grid = patch.ground, patch.grid
        self.largest = math.prod(image_chunk(self.grid))  # pixels
        self.origin = patch_window(self.ground, self.grid)[:2]  # first row and column in the image
        self.heights = GroundHeights(run, self.grid)
        self.alike = AlikeChunks(run)

    def tiled(self) -> Iterator[tuple[tuple[int, int], FloatArray | None, Tiles]]:
        """Iterate over chunks with heights and tiles, found together for a few chunks, or for a strip."""
        for cells, heights in self._batches():
            windows = [chunk_window(cell, self.grid) for cell in cells]
            tiles = tiles_of(self.ground, [(self.grid.x[x], self.grid.y[y]) for y, x in windows], heights)
            yield from zip(cells, heights, tiles, strict=True)

    def _batches(self) -> Iterator[tuple[Sequence[tuple[int, int]], Sequence[FloatArray | None]]]:
        cells = touched_chunks(self.ground, self.grid)
        if not self.run.on_terrain:
            for first in range(0, len(cells), TILED_CHUNKS):
                some = cells[first : first + TILED_CHUNKS]
                yield some, [None] * len(some)
            return
        for row, strip in strips_of(cells, self.grid):
            yield row, [self.heights.over((strip.rows, columns)) for columns in strip.columns]

    def correct(
        self, turn: ComputeTurn, memories: Sequence[ComplexArray], cell: tuple[int, int], z: FloatArray | None,
        tiles: Tiles,
    ) -> _Corrected:  # fmt: skip
        """Compute the pixels of a chunk, in its turn's buffer."""
        ground, window = self.ground, chunk_window(cell, self.grid)
        x, y = self.grid.x[window[1]], self.grid.y[window[0]]
        out = memories[turn.memory][: y.size * x.size].reshape(y.size, x.size)
        pixels = correct(self.values, ground, x=x, y=y, z=z, tiles=tiles, threads=1, out=out)
        if (recorded := ground.geometry.collection.recorded) is not None and recorded.partial:  # else all are whole
            weighting = Weighting(ground.range_taper, ground.taper)
            divide_by_recorded(pixels, ground.geometry, x, y[:, None], z, weighting=weighting, threads=1)
        covered, index = np.isfinite(pixels.real), self.block.index
        if covered.all():
            return _Corrected(turn, cell, z, pixels, index)
        owner = np.where(covered, np.int16(index), np.int16(-1)) if covered.any() else None
        return _Corrected(turn, cell, z, pixels, owner)

    def write(self, corrected: _Corrected) -> list[Written]:
        """Write a chunk to the patch, and to the image if no other block covers the chunk."""
        _, cell, height, pixels, owner = corrected
        run, index, window = self.run, self.block.index, chunk_window(cell, self.grid)
        patch, part = run.patch(self.block.name), shifted(window, self.origin)
        written = write(run, patch, "image", part, pixels)
        if cell not in self.patch.own:
            return [written]
        of = {} if run.collection is None else {index: run.collection}
        noises = {} if self.patch.noise is None else {index: self.patch.noise}
        owners = np.asarray(owner, np.int16)
        return [
            written,
            *write_image(run, window, pixels, owners, of, (patch, part), written.checksum, self.alike),
            *write_noise(run, window, np.broadcast_to(owners, pixels.shape), self.grid, noises, height),
        ]
