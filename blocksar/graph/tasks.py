"""The tasks that run on workers: each reads stores, writes whole chunks, and returns a receipt or samples."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import wraps
from typing import NamedTuple, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from blocksar import stores
from blocksar.arrays import ComplexArray, FloatArray
from blocksar.chunks import BACKPROJECTION_CHUNK, TILED_CHUNKS, WRITES_AT_ONCE
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.collection.ownership import margins_over
from blocksar.collection.weighting import Weighting
from blocksar.errors import InputError, ProcessingError
from blocksar.focusing.backprojection import form_image
from blocksar.focusing.correction import Tiles, correct, tiles_of
from blocksar.focusing.ground_map import GroundMap
from blocksar.focusing.noise import NoiseMap
from blocksar.focusing.step import Stage
from blocksar.focusing.terrain_layers import Sight
from blocksar.graph.alike import AlikeChunks
from blocksar.graph.edges import Edges, by_yaw, read_valid
from blocksar.graph.layers import (
    GroundHeights,
    TerrainLayers,
    local_terrain,
    sights_of,
    strips_of,
    write_layers,
    write_noise,
)
from blocksar.graph.segments import Merged
from blocksar.graph.spectrum import SpectrumChunks, Window, chunk_spans, read_ahead
from blocksar.graph.writing import WritesBehind
from blocksar.inspection.samples import Inspection
from blocksar.kernels import buffers
from blocksar.places.place import Place
from blocksar.places.posix import resource
from blocksar.planning.block import BlockPlan
from blocksar.planning.tiling import chunk_window, image_chunk, patch_window, touched_chunks
from blocksar.runs.receipts import Run, write
from blocksar.runs.record import Receipt, Written

P = ParamSpec("P")
R = TypeVar("R")


class Projected(NamedTuple):
    """A collection to be back-projected."""

    source: stores.PhaseHistory
    geometry: Geometry
    inspection: Inspection
    noise: NoiseMap | None
    number: int
    collection: int | None


def peak_memory() -> int:
    """Return the peak memory of this process since its start, bytes.

    Linux's high-water mark, where there is one: getrusage also counts the memory of the parent at the fork.
    """
    with suppress(OSError), open("/proc/self/status", encoding="ascii") as status:
        for line in status:
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def sign(run: Run, receipt: Receipt, started: float) -> Receipt:
    """Add the peak memory to a receipt, and sign it."""
    return run.sign(replace(receipt, peak_memory=peak_memory()), started)


def naming_failures(describe: Callable[..., str]) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorate a task to name its step and block in errors; `describe` derives both from the task's arguments."""

    def decorate(task: Callable[P, R]) -> Callable[P, R]:
        @wraps(task)
        def run(*args: P.args, **kwargs: P.kwargs) -> R:
            try:
                return task(*args, **kwargs)
            except Exception as error:
                kind = "" if isinstance(error, InputError | ProcessingError) else f"{type(error).__name__}: "
                raise ProcessingError(f"{describe(*args)} failed: {kind}{error}") from error

        return run

    return decorate


@dataclass
class Samples:
    """The samples of a block between two tasks, and the seconds of each step so far."""

    values: ComplexArray | None
    seconds: dict[str, float]

    def take(self) -> ComplexArray:
        """Hand the array over for in-place work, of the shape that the stage before left; a second call fails.

        Raises
        ------
        ProcessingError
            If the array was handed over before.
        """
        values, self.values = self.values, None
        if values is None:
            raise ProcessingError("the samples of a block were used by two tasks")
        # An array that was sent by another worker is read-only.
        return values if values.flags.writeable else values.copy()


@naming_failures(lambda run, block, stage, *_: f"read-slab+{stage.name} of block {block.name}")
def read_slab(run: Run, block: BlockPlan, stage: Stage, spectrum: SpectrumChunks) -> Samples:
    """Run a block's first stage on its part of the spectrum, which is read by chunks' columns."""
    started, reading = time.perf_counter(), 0.0
    program, bins = stage.program, slice(block.first_bin, block.first_bin + block.n_bin)
    out = buffers.empty((block.sampling.n_buffer_row, program.target.size))
    parts = [(bins, slice(a, b)) for a, b in chunk_spans(0, program.n_row, spectrum.chunk[1])]
    for region, part, waited in read_ahead(spectrum, parts):
        reading += waited
        program.run(part, out=out, first=region[1].start, load="columns", threads=run.threads)
    return Samples(out, {"read-slab": reading, stage.name: time.perf_counter() - started - reading})


@naming_failures(lambda run, block, stage, *_: f"{stage.name} of block {block.name}")
def run_stage(run: Run, block: BlockPlan, stage: Stage, samples: Samples) -> Samples:
    """Run a stage on a block, in place where the result fits: no other task uses the input."""
    started = time.perf_counter()
    values, program = samples.take(), stage.program
    if stage.layout == "columns":
        program.run(
            values[: program.source.size], out=values[: program.target.size],
            load="columns", store="columns", threads=run.threads,
        )  # fmt: skip
        result = values
    else:
        out: ComplexArray | None = values if program.target.size <= values.shape[1] else None
        # The later stages need a buffer where rows become longer.
        inner = out is None and stage.steps[-1].name != block.chain[-1].name
        if inner:
            out = buffers.empty((block.sampling.n_buffer_row, program.target.size))
        result = program.run(values[: program.n_row], out=out, threads=run.threads)
    return Samples(result, samples.seconds | {stage.name: time.perf_counter() - started})


@dataclass(frozen=True, kw_only=True, eq=False)
class Patch:
    """Where a focused block goes.

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
    edges : Edges or None
        Edges of dwells that are added to the pixels.
    sight : Sight or None
        On a terrain: `own` chunks get their layers with their pixels; None: later.
    """

    ground: GroundMap
    grid: Grid
    own: frozenset[tuple[int, int]]
    noise: NoiseMap | None
    edges: Edges | None
    sight: Sight | None


@naming_failures(lambda run, unit, block, *_: f"geometric-correction of block {block.name}")
def write_patch(run: Run, unit: str, block: BlockPlan, samples: Samples, patch: Patch) -> Receipt:
    """Correct a focused block geometrically, and write its patch in chunks of the image's grid.

    Chunks are written by other threads while the next ones are computed.
    """
    started = time.perf_counter()
    ground, grid, edges, sight = patch.ground, patch.grid, patch.edges, patch.sight
    origin, side = patch_window(ground, grid)[:2], image_chunk(grid)
    layers = TerrainLayers(run, grid, {} if sight is None else {block.index: sight})
    heights, alike = GroundHeights(run, grid, on_terrain=ground.relief is not None), AlikeChunks(run)
    writer = _PatchWriter(run=run, block=block, grid=grid, origin=origin, noise=patch.noise, alike=alike)
    assert samples.values is not None
    chunks = [np.empty(side[0] * side[1], np.complex64) for _ in range(WRITES_AT_ONCE + 1)]
    with WritesBehind(len(chunks)) as behind:
        cells = touched_chunks(ground, grid)
        kept = None if edges is None else edges.profiles(ground, threads=run.threads)
        batches = _batches(cells if edges is None else by_yaw(cells, ground, grid), grid, heights, layers, patch.own)
        for cell, z, tiles in _tiled(batches, ground, grid):
            chunk, window = chunks[behind.turn()], chunk_window(cell, grid)
            shape = (window[0].stop - window[0].start, window[1].stop - window[1].start)
            out = chunk[: shape[0] * shape[1]].reshape(shape)
            x, y = grid.x[window[1]], grid.y[window[0]]
            merged = cell not in patch.own
            pixels = correct(samples.values, ground, x=x, y=y, z=z, tiles=tiles, threads=run.threads, out=out)
            if edges is not None and kept is not None:
                edges.add(pixels, kept, ground, window, grid, height=z, threads=run.threads)
            if (owner := _owner(pixels, block.index)) is None:
                continue
            behind.submit(writer.write, pixels, owner, window, z, merged=merged)
            if sight is not None and not merged:
                behind.submit(write_layers, alike, window, layers.over(window, owner))
    seconds = samples.seconds | {"geometric-correction": time.perf_counter() - started}
    # The receipt covers the whole block: the tasks before this one have no receipts.
    receipt = Receipt(unit=unit, stage="focus", written=behind.written, origin=origin, steps=seconds)
    return sign(run, receipt, started - sum(samples.seconds.values()))


class Batch(NamedTuple):
    """Output chunks of which much is found at once, and the heights of each, m; None on the plane."""

    cells: Sequence[tuple[int, int]]
    heights: Sequence[FloatArray | None]


def _batches(
    cells: Sequence[tuple[int, int]],
    grid: Grid,
    heights: GroundHeights,
    layers: TerrainLayers,
    own: frozenset[tuple[int, int]],
) -> Iterator[Batch]:
    """Divide the chunks of a patch: on the plane into some that are not too many, on a terrain into strips."""
    if not heights.on_terrain:
        for first in range(0, len(cells), TILED_CHUNKS):
            some = cells[first : first + TILED_CHUNKS]
            yield Batch(some, [None] * len(some))
        return
    for some, strip in strips_of(cells, grid):
        # Chunks that get their layers at once need the same things of the terrain for these.
        if own.isdisjoint(some) or not layers.sights:
            yield Batch(some, [heights.over((strip.rows, columns)) for columns in strip.columns])
        else:
            layers.begin(strip)
            yield Batch(some, [layers.heights_of((strip.rows, columns)) for columns in strip.columns])


def _tiled(
    batches: Iterator[Batch], ground: GroundMap, grid: Grid
) -> Iterator[tuple[tuple[int, int], FloatArray | None, Tiles]]:
    """Output chunks, heights and tiles, which are found for the chunks of a batch at once."""
    for cells, heights in batches:
        windows = [chunk_window(cell, grid) for cell in cells]
        tiles = tiles_of(ground, [(grid.x[x], grid.y[y]) for y, x in windows], heights)
        yield from zip(cells, heights, tiles, strict=True)


def _owner(pixels: ComplexArray, block: int) -> NDArray[np.int16] | int | None:
    """The block that each pixel comes from, as layers take it; None if none is covered."""
    covered = np.isfinite(pixels.real)
    if covered.all():
        return block
    return np.where(covered, np.int16(block), np.int16(-1)) if covered.any() else None


def shifted(window: Window, origin: Sequence[int]) -> Window:
    """The same window, counted from another first row and column."""
    (rows, columns), (y, x) = window, origin
    return slice(rows.start - y, rows.stop - y), slice(columns.start - x, columns.stop - x)


@dataclass(frozen=True, kw_only=True)
class _PatchWriter:
    """Writes the chunks of a block's patch, and the image's where no other block touches them.

    Attributes
    ----------
    origin : (first row, first column)
        Of the patch in the image.
    noise : NoiseMap or None
        The block's noise, where it is known.
    """

    run: Run
    block: BlockPlan
    grid: Grid
    origin: tuple[int, int]
    noise: NoiseMap | None
    alike: AlikeChunks

    def write(
        self,
        pixels: ComplexArray,
        owner: NDArray[np.int16] | int,
        window: Window,
        height: FloatArray | None,
        *,
        merged: bool,
    ) -> list[Written]:
        """Write the pixels (n_y, n_x) of `window` of the image; only to the patch if the mosaic merges them.

        `owner` is as `_owner` has it; `height` (n_y, n_x) the pixels' z, m, or None on the plane.
        """
        run, index = self.run, self.block.index
        patch, part = run.patch(self.block.name), shifted(window, self.origin)
        written = write(run, patch, "image", part, pixels)
        if merged:
            return [written]
        of = {} if run.collection is None else {index: run.collection}
        noises = {} if self.noise is None else {index: self.noise}
        owners = np.asarray(owner, np.int16)
        return [
            written,
            *write_image(run, window, pixels, owners, of, (patch, part), written.checksum, self.alike),
            *write_noise(run, window, np.broadcast_to(owners, pixels.shape), self.grid, noises, height),
        ]


def write_image(
    run: Run,
    window: Window,
    pixels: ComplexArray,
    owner: NDArray[np.int16],
    collections: Mapping[int, int],
    patch: tuple[Place, Window] | None,
    checksum: str,
    alike: AlikeChunks,
) -> list[Written]:
    """Write a chunk of the image (n_y, n_x), and its owners: of each pixel, or one of no dimension for all.

    A chunk that equals that of a patch, whose checksum is given, shares its storage where that is possible.
    """
    if patch is not None and stores.share_region(run.image, "image", window, source=patch[0], source_region=patch[1]):
        span = tuple((part.start, part.stop) for part in window)
        image = Written(run.name_of(run.image), "image", span, checksum)
    else:
        image = write(run, run.image, "image", window, pixels)
    return [image, *write_owner(alike, window, owner, collections)]


def write_owner(
    alike: AlikeChunks, window: Window, owner: NDArray[np.int16], collections: Mapping[int, int]
) -> list[Written]:
    """Write the block that each pixel of a chunk comes from, `owner` as for `write_image`, and its collection.

    `collections` has that of each block; empty where runs have one only.
    """
    written = [alike.write("block", window, owner)]
    if collections:
        numbers = np.full(owner.shape, -1, np.int16)
        for block, collection in collections.items():
            numbers[owner == block] = collection
        written.append(alike.write("collection", window, numbers))
    return written


@naming_failures(lambda run, unit, *_: f"layers of {unit}")
def add_layers(
    run: Run, unit: str, cells: Mapping[tuple[int, int], int | None], grid: Grid, sights: Mapping[int, Sight]
) -> Receipt:
    """Write the layers of output chunks on a terrain, given by row and column, whose image and owners are written.

    `cells` has the block that all pixels of a chunk come from, or None where the owners are read. Chunks are written by
    other threads while the next ones are computed.
    """
    started = time.perf_counter()
    layers, alike = TerrainLayers(run, grid, sights), AlikeChunks(run)
    with WritesBehind() as behind:
        for some, strip in strips_of(list(cells), grid):
            layers.begin(strip)
            for cell, columns in zip(some, strip.columns, strict=True):
                behind.turn()
                window, block = (strip.rows, columns), cells[cell]
                owner = stores.read_region(run.image, "block", window, cached=False) if block is None else block
                behind.submit(write_layers, alike, window, layers.over(window, owner))
    return sign(run, Receipt(unit=unit, stage="mosaic", written=behind.written), started)


def back_project_chunk(
    run: Run,
    unit: str,
    sources: Sequence[Projected],
    cell: tuple[int, int],
    grid: Grid,
    weighting: Weighting,
    on_terrain: bool = False,
) -> Receipt:
    """Form one output chunk by exact back-projection; reads only the pulses that light it, and the terrain there."""
    started = time.perf_counter()
    window = chunk_window(cell, grid)
    terrain = local_terrain(run, grid, window) if on_terrain else None
    sources = [source._replace(geometry=source.geometry.over(terrain)) for source in sources]
    image = _project(run, sources[0], window, grid, weighting)
    owner = np.where(np.isfinite(image.real), 0, -1).astype(np.int16)
    if len(sources) > 1:
        merged = Merged(owner.shape)
        for number, source in enumerate(sources):
            other = _project(run, source, window, grid, weighting) if number else image
            margins = margins_over(source.geometry, grid.x[window[1]], grid.y[window[0]])
            np.copyto(image, other, where=merged.choose(source.number, np.isfinite(other.real), margins))
        owner = merged.taken
    parts = []
    if (owner >= 0).any():
        collections = {source.number: source.collection for source in sources if source.collection is not None}
        noises = {source.number: source.noise for source in sources if source.noise is not None}
        seen = [(source.number, source.geometry) for source in sources if on_terrain]
        layers, alike = TerrainLayers(run, grid, sights_of(run, grid, seen)), AlikeChunks(run)
        parts = [
            write(run, run.image, "image", window, image),
            *write_owner(alike, window, owner, collections),
            *write_noise(run, window, owner, grid, noises, layers.heights.over(window) if noises else None),
            *write_layers(alike, window, layers.over(window, owner)),
        ]
    return sign(run, Receipt(unit=unit, stage="backprojection", written=tuple(parts)), started)


def _project(run: Run, source: Projected, window: Window, grid: Grid, weighting: Weighting) -> ComplexArray:
    """Form one output chunk of one collection."""
    rows, columns = window

    def read(pulses: slice) -> ComplexArray:
        return read_valid(source.source, source.inspection, pulses)

    image = np.full((rows.stop - rows.start, columns.stop - columns.start), np.nan + 1j * np.nan, np.complex64)
    for i in range(0, image.shape[0], BACKPROJECTION_CHUNK):
        for j in range(0, image.shape[1], BACKPROJECTION_CHUNK):
            part = (slice(i, i + BACKPROJECTION_CHUNK), slice(j, j + BACKPROJECTION_CHUNK))
            image[part] = form_image(
                read, source.geometry, grid.x[columns][part[1]], grid.y[rows][part[0]], threads=run.threads,
                weighting=weighting,
            )  # fmt: skip
    return image
