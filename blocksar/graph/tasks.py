"""The tasks that run on workers: each reads stores, writes whole chunks, and returns a receipt or samples."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import wraps
from itertools import pairwise
from typing import ParamSpec, TypeVar

import numpy as np

from blocksar import stores
from blocksar.arrays import ComplexArray
from blocksar.chunks import BACKPROJECTION_CHUNK, DOPPLER_GROUP, SPECTRUM_BYTES
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.errors import InputError, ProcessingError
from blocksar.focusing.backprojection import form_image
from blocksar.focusing.correction import correct, covers
from blocksar.focusing.ground_map import GroundMap
from blocksar.focusing.range_compression import RawCompression
from blocksar.focusing.recovery import Recovery, recover_columns
from blocksar.focusing.step import Stage
from blocksar.inspection.samples import Inspection, inspect, mask_outliers
from blocksar.places.place import Place
from blocksar.planning.block import BlockPlan
from blocksar.planning.tiling import image_chunk, patch_window
from blocksar.runs.receipts import Run, write, written_entry
from blocksar.runs.record import Receipt, Written

P = ParamSpec("P")
R = TypeVar("R")
# A block's part of an output chunk: block, its name, first row and column of its patch, checksum of the part.
PatchChunk = tuple[int, str, int, int, str]


def peak_memory() -> int:
    """Return the peak memory of this process since its start, bytes.

    Linux's high-water mark, where there is one: getrusage also counts the memory of the parent at the fork.
    """
    with suppress(OSError), open("/proc/self/status", encoding="ascii") as status:
        for line in status:
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def _sign(run: Run, receipt: Receipt, started: float) -> Receipt:
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


def compress_pulses(
    run: Run, unit: str, source: stores.PhaseHistory, pulses: tuple[int, int], compression: RawCompression
) -> Receipt:
    """Range-compress pulses of a raw echo into the run's own phase history; a pulse with a gap becomes missing."""
    started = time.perf_counter()
    echo = source.read(slice(*pulses), slice(None))
    inspection = inspect(echo, range_frequency=np.zeros(echo.shape[1]), recovery=None, threads=run.threads)
    signal = compression.apply(echo, pulses=slice(*pulses), threads=run.threads)
    signal[list(inspection.missing)] = np.nan
    region = (slice(*pulses), slice(0, signal.shape[1]))
    part = write(run, run.compressed, "signal", region, signal)
    receipt = Receipt(unit=unit, stage="range-compress", written=(part,), found=inspection.as_dict())
    return _sign(run, receipt, started)


def recover_group(
    run: Run,
    unit: str,
    source: stores.PhaseHistory,
    columns: tuple[int, int],
    recovery: Recovery,
    chunk: tuple[int, int],
) -> Receipt:
    """Recover the spectrum of a column group, a chunk's columns at a time; missing and impossible samples are unlit."""
    started = time.perf_counter()
    height, width = chunk
    signal = source.read(slice(None), slice(*columns))
    frequency = source.collection.carrier + source.collection.range_frequency - recovery.carrier
    inspection = inspect(
        signal, range_frequency=frequency[slice(*columns)], recovery=recovery, first_column=columns[0],
        threads=run.threads,
    )  # fmt: skip
    parts = []
    buffer = np.empty(recovery.doppler.size * width, np.complex64)
    for first in range(columns[0], columns[1], width):
        part = slice(first, min(first + width, columns[1]))
        shape = (recovery.doppler.size, part.stop - part.start)
        spectrum = recover_columns(
            signal[:, part.start - columns[0] : part.stop - columns[0]],
            range_frequency=frequency[part],
            recovery=recovery,
            threads=run.threads,
            out=buffer[: shape[0] * shape[1]].reshape(shape),
        )
        # One entry for each chunk, so that a block can check those that it reads.
        parts += [
            write(run, run.spectrum, "spectrum", (slice(*bins), part), spectrum[slice(*bins)])
            for bins in _chunks(0, shape[0], height)
        ]
    receipt = Receipt(unit=unit, stage="recover", written=tuple(parts), found=inspection.as_dict())
    return _sign(run, receipt, started)


def inspect_group(run: Run, unit: str, source: stores.PhaseHistory, columns: tuple[int, int]) -> Receipt:
    """Inspect a column group without recovery, for back-projection, which reads the samples by pulse."""
    started = time.perf_counter()
    signal = source.read(slice(None), slice(*columns))
    frequency = source.collection.range_frequency[slice(*columns)]
    inspection = inspect(signal, range_frequency=frequency, recovery=None, first_column=columns[0], threads=run.threads)
    return _sign(run, Receipt(unit=unit, stage="inspect", found=inspection.as_dict()), started)


@dataclass
class Samples:
    """The samples of a block between two tasks, and the seconds of each step so far."""

    values: ComplexArray | None
    seconds: dict[str, float]

    def take(self) -> ComplexArray:
        """Hand the array over for in-place work; a second call fails.

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


def _chunks(first: int, last: int, size: int) -> Iterator[tuple[int, int]]:
    """Divide first .. last at multiples of `size`, the borders of a store's chunks."""
    edges = [first, *range(first - first % size + size, last, size), last]
    return pairwise(edges)


@dataclass(frozen=True)
class SpectrumChunks:
    """The chunks of spectrum.zarr that a block reads, with the checksums of their receipts.

    Attributes
    ----------
    shape, chunk : (int, int)
        Doppler bins and range frequencies of the spectrum, and of a chunk.
    checksums : mapping
        By first bin and first column.
    """

    shape: tuple[int, int]
    chunk: tuple[int, int]
    checksums: Mapping[tuple[int, int], str]

    @classmethod
    def of(cls, receipts: Sequence[Receipt], shape: tuple[int, int], chunk: tuple[int, int]) -> SpectrumChunks:
        """All chunks, from the receipts of recovery."""
        parts = [part for receipt in receipts for part in receipt.written if receipt.stage == "recover"]
        return cls(shape, chunk, {(part.region[0][0], part.region[1][0]): part.checksum for part in parts})

    def within(self, first_bin: int, last_bin: int) -> SpectrumChunks:
        """Those with some of the bins first_bin .. last_bin."""
        first = first_bin - first_bin % self.chunk[0]
        kept = {place: checksum for place, checksum in self.checksums.items() if first <= place[0] < last_bin}
        return replace(self, checksums=kept)

    def read(self, store: Place, region: tuple[slice, slice]) -> ComplexArray:
        """Read a region; its columns are whole chunks.

        Raises
        ------
        ProcessingError
            If a chunk that it touches does not have its checksum.
        """
        bins, columns = region
        height, width = self.chunk
        first, last = bins.start - bins.start % height, min(-(-bins.stop // height) * height, self.shape[0])
        rows = slice(bins.start - first, bins.stop - first)
        at_once = max(SPECTRUM_BYTES // (8 * (last - first) * width), 1) * width
        if columns.stop - columns.start <= at_once:
            return self._checked(store, (first, last), (columns.start, columns.stop))[rows]
        values = np.empty((bins.stop - bins.start, columns.stop - columns.start), np.complex64)
        for c, d in _chunks(columns.start, columns.stop, at_once):
            values[:, c - columns.start : d - columns.start] = self._checked(store, (first, last), (c, d))[rows]
        return values

    def _checked(self, store: Place, bins: tuple[int, int], columns: tuple[int, int]) -> ComplexArray:
        """Read whole chunks, and compare their checksums."""
        values: ComplexArray = stores.read_region(store, "spectrum", (slice(*bins), slice(*columns)))
        for a, b in _chunks(*bins, self.chunk[0]):
            for c, d in _chunks(*columns, self.chunk[1]):
                chunk = values[a - bins[0] : b - bins[0], c - columns[0] : d - columns[0]]
                if stores.checksum(chunk) != self.checksums.get((a, c)):
                    raise ProcessingError(
                        f"{store} no longer has the checksum of its receipt at doppler {a}..{b - 1}, range_frequency "
                        f"{c}..{d - 1}"
                    )
        return values


@naming_failures(lambda run, block, stage, *_: f"read-slab+{stage.name} of block {block.name}")
def read_slab(run: Run, block: BlockPlan, stage: Stage, spectrum: SpectrumChunks) -> Samples:
    """Run a block's first stage on its part of the spectrum, which is read by chunks' bins or by chunks' columns."""
    started, reading = time.perf_counter(), 0.0
    program, first_bin, last_bin = stage.program, block.first_bin, block.first_bin + block.n_bin
    if stage.layout == "columns":
        # The range gate works along rows of the store: read groups of Doppler bins.
        out = np.empty((program.target.size, program.n_row), np.complex64)
        parts = [(slice(a, b), slice(0, spectrum.shape[1])) for a, b in _chunks(first_bin, last_bin, DOPPLER_GROUP)]
    else:
        out = np.empty((block.sampling.n_buffer_row, program.target.size), np.complex64)
        parts = [(slice(first_bin, last_bin), slice(a, b)) for a, b in _chunks(0, program.n_row, spectrum.chunk[1])]
    for region in parts:
        read_from = time.perf_counter()
        part = spectrum.read(run.spectrum, region)
        reading += time.perf_counter() - read_from
        if stage.layout == "columns":
            program.run(part, out=out, first=region[0].start - first_bin, store="columns", threads=run.threads)
        else:
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
        # The later stages need a buffer: the slab as a range gate leaves it has none, or rows become longer.
        inner = out is None and stage.steps[-1].name != block.chain[-1].name
        if program.source == block.sampling.slab or inner:
            out = np.empty((block.sampling.n_buffer_row, program.target.size), np.complex64)
        result = program.run(values[: program.n_row], out=out, threads=run.threads)
    return Samples(result, samples.seconds | {stage.name: time.perf_counter() - started})


@naming_failures(lambda run, unit, name, *_: f"geometric-correction of block {name}")
def write_patch(run: Run, unit: str, name: str, block: Samples, ground: GroundMap, grid: Grid) -> Receipt:
    """Correct a focused block geometrically, and write its patch in chunks of the image's grid."""
    started = time.perf_counter()
    first_y, first_x, n_y, n_x = patch_window(ground, grid)
    path = run.patch(name)
    side = image_chunk(grid)
    assert block.values is not None
    chunks = []
    chunk = np.empty(side[0] * side[1], np.complex64)
    for y in range(0, n_y, side[0]):
        for x in range(0, n_x, side[1]):
            rows, columns = slice(y, min(y + side[0], n_y)), slice(x, min(x + side[1], n_x))
            place = {
                "x": grid.x[first_x + columns.start : first_x + columns.stop],
                "y": grid.y[first_y + rows.start : first_y + rows.stop],
            }
            if not covers(ground, **place):
                continue
            shape = (rows.stop - rows.start, columns.stop - columns.start)
            pixels = correct(
                block.values, ground, threads=run.threads, out=chunk[: shape[0] * shape[1]].reshape(shape), **place
            )
            if np.isfinite(pixels.real).any():
                chunks.append(write(run, path, "image", (rows, columns), pixels))
    seconds = block.seconds | {"geometric-correction": time.perf_counter() - started}
    # The receipt covers the whole block: the tasks before this one have no receipts.
    origin = (int(first_y), int(first_x))
    receipt = Receipt(unit=unit, stage="focus", written=tuple(chunks), origin=origin, steps=seconds)
    return _sign(run, receipt, started - sum(block.seconds.values()))


@naming_failures(lambda run, unit, *_: f"mosaic of {unit}")
def merge_chunks(run: Run, unit: str, cells: Mapping[tuple[int, int], Sequence[PatchChunk]], grid: Grid) -> Receipt:
    """Merge patches into output chunks of the mosaic, given by row and column of the chunk."""
    started = time.perf_counter()
    parts = [part for cell, patches in cells.items() for part in _merge(run, cell, patches, grid)]
    return _sign(run, Receipt(unit=unit, stage="mosaic", written=tuple(parts)), started)


def _merge(run: Run, cell: tuple[int, int], parts: Sequence[PatchChunk], grid: Grid) -> list[Written]:
    """Write the image of one output chunk, and the block that each pixel comes from; later parts win."""
    side = image_chunk(grid)
    y, x = cell[0] * side[0], cell[1] * side[1]
    rows, columns = slice(y, min(y + side[0], grid.shape[0])), slice(x, min(x + side[1], grid.shape[1]))
    shape = (rows.stop - rows.start, columns.stop - columns.start)
    windows = [
        tuple(slice(part.start - first, part.stop - first) for part, first in zip((rows, columns), origin, strict=True))
        for _, _, *origin, _ in parts
    ]
    image: ComplexArray | None = None
    owner = np.full(shape, -1, np.int16)
    for (index, name, *_, checksum), window in zip(parts, windows, strict=True):
        patch = stores.read_region(run.patch(name), "image", window)
        if stores.checksum(patch) != checksum:
            raise ProcessingError(f"the patch of block {name} no longer has the checksum of its receipt")
        covered = np.isfinite(patch.real)
        np.copyto(owner, index, where=covered)
        if image is None:
            image = patch
        else:
            np.copyto(image, patch, where=covered)
    assert image is not None
    # A chunk that only one block covers equals that block's: the two share their storage.
    shared = len(parts) == 1 and stores.share_region(
        run.image, "image", (rows, columns), source=run.patch(parts[0][1]), source_region=windows[0]
    )
    store = written_entry if shared else write
    return [
        store(run, run.image, "image", (rows, columns), image),
        write(run, run.image, "block", (rows, columns), owner),
    ]


def back_project_chunk(
    run: Run,
    unit: str,
    source: stores.PhaseHistory,
    cell: tuple[int, int],
    geometry: Geometry,
    grid: Grid,
    inspection: Inspection,
) -> Receipt:
    """Form one output chunk by exact back-projection; reads only the pulses that light it."""
    started = time.perf_counter()
    side = image_chunk(grid)
    y, x = cell[0] * side[0], cell[1] * side[1]
    rows, columns = slice(y, min(y + side[0], grid.shape[0])), slice(x, min(x + side[1], grid.shape[1]))

    def read(pulses: slice) -> ComplexArray:
        signal = source.read(pulses, slice(None))
        mask_outliers(signal, inspection, pulses=pulses)
        return signal

    image = np.full((rows.stop - rows.start, columns.stop - columns.start), np.nan + 1j * np.nan, np.complex64)
    for i in range(0, image.shape[0], BACKPROJECTION_CHUNK):
        for j in range(0, image.shape[1], BACKPROJECTION_CHUNK):
            part = (slice(i, i + BACKPROJECTION_CHUNK), slice(j, j + BACKPROJECTION_CHUNK))
            image[part] = form_image(
                read, geometry, grid.x[columns][part[1]], grid.y[rows][part[0]], threads=run.threads
            )
    covered = np.isfinite(image.real)
    parts = []
    if covered.any():
        owner = np.where(covered, 0, -1).astype(np.int16)
        parts = [
            write(run, run.image, "image", (rows, columns), image),
            write(run, run.image, "block", (rows, columns), owner),
        ]
    return _sign(run, Receipt(unit=unit, stage="backprojection", written=tuple(parts)), started)
