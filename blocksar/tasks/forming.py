"""The tasks that form chunks of an image straight from samples, and what every task writes of a chunk."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from blocksar import stores
from blocksar.arrays import ComplexArray, FloatArray
from blocksar.collection.beam import margins_over
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.imaging.backprojection import ReadPulses
from blocksar.imaging.noise import NoiseMap
from blocksar.imaging.terrain_layers import Sight
from blocksar.inspection.samples import Inspection, mask_outliers
from blocksar.kernels.halving import halve
from blocksar.places.place import Place
from blocksar.planning.tiling import Window, window_around
from blocksar.runs.receipts import Run, write
from blocksar.runs.record import Receipt, Written
from blocksar.tasks.layers import (
    AlikeChunks,
    GroundHeights,
    TerrainLayers,
    local_terrain,
    strips_of,
    write_layers,
    write_noise,
)
from blocksar.tasks.segments import Merged
from blocksar.tasks.writing import WritesBehind


class Form(Protocol):
    """Function that forms pixels directly from samples; picklable: a function of a module, or a partial of one."""

    def __call__(
        self, read: ReadPulses, geometry: Geometry, x: FloatArray, y: FloatArray, *, threads: int
    ) -> ComplexArray:
        """Form the pixels (n_y, n_x) at x (n_x,) and y (n_y,), m: complex64, 1 + 0j at a target of 1, NaN where none.

        `read` gives the samples (n, n_range_frequency) complex64 of a slice of pulses; missing ones are NaN.
        """
        ...


class FormParts(Protocol):
    """Function that forms several windows of an image in turn; picklable like `Form`."""

    def __call__(
        self, read: ReadPulses, geometry: Geometry, x: FloatArray, y: FloatArray, windows: Sequence[Window], *,
        threads: int,
    ) -> Iterator[tuple[Window, ComplexArray]]:  # fmt: skip
        """Yield the windows of the grid x (n_column,), y (n_row,), m, with pixels, in an order set by them alone."""
        ...


def each_alone(
    read: ReadPulses, geometry: Geometry, x: FloatArray, y: FloatArray, windows: Sequence[Window], *, threads: int,
    form: Form,
) -> Iterator[tuple[Window, ComplexArray]]:  # fmt: skip
    """Form several windows by a function that forms one."""
    for window in windows:
        yield window, form(read, geometry, x[window[1]], y[window[0]], threads=threads)


class PixelSource(NamedTuple):
    """Samples of a collection, and the function that forms pixels from them."""

    source: stores.PhaseHistory
    geometry: Geometry
    inspection: Inspection
    noise: NoiseMap | None
    number: int
    collection: int | None
    form: FormParts


def shifted(window: Window, origin: Sequence[int]) -> Window:
    """Shift a window to count from another first row and column."""
    (rows, columns), (y, x) = window, origin
    return slice(rows.start - y, rows.stop - y), slice(columns.start - x, columns.stop - x)


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
    """Write a chunk of the image (n_y, n_x), and the block of each pixel, or one block for all.

    A chunk that equals that of a patch, whose checksum is given, shares its storage where that is possible.
    """
    if patch is not None and stores.share_region(run.image, "image", window, source=patch[0], source_region=patch[1]):
        span = tuple((part.start, part.stop) for part in window)
        image = Written(run.name_of(run.image), "image", span, checksum)
    else:
        image = write(run, run.image, "image", window, pixels)
    return [image, *write_level(run, window, pixels), *write_owner(alike, window, owner, collections)]


def write_level(run: Run, window: Window, pixels: ComplexArray) -> list[Written]:
    """Write the chunk of the pyramid's first level that an image chunk averages to, if there is a pyramid."""
    if not run.pyramid:
        return []
    half = slice(window[0].start // 2, -(-window[0].stop // 2)), slice(window[1].start // 2, -(-window[1].stop // 2))
    return [write(run, run.image, stores.level_name(1), half, halve(pixels), cached=True)]


def write_owner(
    alike: AlikeChunks, window: Window, owner: NDArray[np.int16], collections: Mapping[int, int]
) -> list[Written]:
    """Write the block of each pixel of a chunk, `owner` as for `write_image`, and its collection.

    `collections` has that of each block; empty where runs have one only.
    """
    written = [alike.write("block", window, owner)]
    if collections:
        numbers = np.full(owner.shape, -1, np.int16)
        for block, collection in collections.items():
            numbers[owner == block] = collection
        written.append(alike.write("collection", window, numbers))
    return written


def add_layers(
    run: Run, unit: str, cells: Sequence[tuple[int, int]], grid: Grid, sights: Mapping[int, Sight]
) -> Receipt:
    """Write the terrain layers of output chunks, given by row and column, whose image is written.

    `sights` has the antenna as the pixels of each owner see it. Chunks are written by other threads while the next ones
    are computed.
    """
    layers, layer_chunks = TerrainLayers(run, grid, sights), AlikeChunks(run)
    with WritesBehind() as behind:
        for _, strip in strips_of(cells, grid):
            found = layers.of(strip)
            for number, columns in enumerate(strip.columns):
                turn, window = behind.turn(), (strip.rows, columns)
                owner = stores.read_region(run.image, "block", window, cached=False)
                turn.submit(write_layers, layer_chunks, window, found.over(number, owner))
    return Receipt(unit=unit, stage="layers", written=behind.written)


def form_chunks(
    run: Run, unit: str, stage: str, sources: Sequence[PixelSource], windows: Sequence[Window], grid: Grid
) -> Receipt:
    """Form output chunks directly from the samples of all collections, on the terrain if there is one."""
    terrain = local_terrain(run, grid, window_around(windows)) if run.on_terrain else None
    sources = [source._replace(geometry=source.geometry.over(terrain)) for source in sources]
    collections = {source.number: source.collection for source in sources if source.collection is not None}
    noises = {source.number: source.noise for source in sources if source.noise is not None}
    heights, layer_chunks = GroundHeights(run, grid), AlikeChunks(run)
    written: list[Written] = []
    for formed in zip(*(_form(run, source, windows, grid) for source in sources), strict=True):
        window, image = formed[0]
        owner = np.where(np.isfinite(image.real), 0, -1).astype(np.int16)
        if len(sources) > 1:
            merged = Merged(owner.shape)
            for source, (_, other) in zip(sources, formed, strict=True):
                margins = margins_over(source.geometry, grid.x[window[1]], grid.y[window[0]])
                np.copyto(image, other, where=merged.choose(source.number, np.isfinite(other.real), margins))
            owner = merged.taken
        if (owner >= 0).any():
            written += [
                write(run, run.image, "image", window, image),
                *write_level(run, window, image),
                *write_owner(layer_chunks, window, owner, collections),
                *write_noise(run, window, owner, grid, noises, heights.over(window) if noises else None),
            ]
    return Receipt(unit=unit, stage=stage, written=tuple(written))


def _form(
    run: Run, source: PixelSource, windows: Sequence[Window], grid: Grid
) -> Iterator[tuple[Window, ComplexArray]]:
    """Form output chunks from one collection."""

    def read(pulses: slice) -> ComplexArray:
        return read_valid(source.source, source.inspection, pulses)

    return source.form(read, source.geometry, grid.x, grid.y, windows, threads=run.threads)


def read_valid(source: stores.PhaseHistory, inspection: Inspection, pulses: slice) -> ComplexArray:
    """Read all columns of pulses; missing samples and outliers are NaN."""
    signal = source.read(pulses, slice(None))
    mask_outliers(signal, inspection, pulses=pulses)
    return signal
