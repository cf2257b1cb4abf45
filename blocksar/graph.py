"""The task graph: recovery by column group, one chain a block, the mosaic by output chunk.

Tasks get paths and small constants and leave their samples in zarr; what travels is
receipts. Keys read `step-run-block`, so that the dashboard can be read and no stale result is taken for a
new one. A unit of work writes whole chunks that nobody else writes, then its receipt: a worker that is lost
loses nothing but time, and a run that was interrupted goes on from its receipts.
"""

from __future__ import annotations

import math
import resource
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial, wraps
from itertools import pairwise
from typing import Any, ParamSpec, TypeVar

import numpy as np
from distributed import Client, Future, KilledWorker

from blocksar import stores
from blocksar.backprojection import form_image, image_memory
from blocksar.cluster import Unit, in_turn
from blocksar.geometry import Geometry
from blocksar.ground import GroundMap, correct, covers
from blocksar.inspection import Inspection, inspect, merge, refusal, strike
from blocksar.parameters import Collection, ComplexArray, FloatArray, InputError, ProcessingError
from blocksar.planning import DOPPLER_GROUP, IMAGE_CHUNK, PROCESS_MEMORY, SIGNAL_BYTES, BlockPlan, Plan
from blocksar.progress import Listener
from blocksar.range_steps import ResidualRangeWalk
from blocksar.recovery import COMPRESSED_ROWS, RawCompression, Recovery, recover_columns
from blocksar.region import Grid, lit_pulses
from blocksar.runs import Receipt, Run, Written, write, written
from blocksar.steps import Stage, stages

P = ParamSpec("P")
R = TypeVar("R")

MOSAIC_CHUNKS = 4  # output chunks merged by a task: one takes no longer than the scheduler's answer
READING_STAGES = ("range-compress", "recover", "inspect", "backprojection")
BACKPROJECTION_CHUNK = 256  # pixels a side of a back-projection task


def peak_memory() -> int:
    """Of this process since it began, bytes.

    Linux's own high-water mark: getrusage there also counts what the parent held when it made this process.
    """
    with suppress(OSError), open("/proc/self/status", encoding="ascii") as status:
        for line in status:
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def _sign(run: Run, unit: str, started: float, written: Iterable[Written], **facts: Any) -> Receipt:
    return run.sign(unit, started, written, peak_memory=peak_memory(), **facts)


# ---------------------------------------------------------------- tasks: what runs on a worker


def named(step: Callable[..., str]) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Let a task say which step of which block failed. `step` tells it from the task's arguments."""

    def decorate(task: Callable[P, R]) -> Callable[P, R]:
        @wraps(task)
        def run(*args: P.args, **kwargs: P.kwargs) -> R:
            try:
                return task(*args, **kwargs)
            except Exception as error:
                kind = "" if isinstance(error, InputError | ProcessingError) else f"{type(error).__name__}: "
                raise ProcessingError(f"{step(*args)} failed: {kind}{error}") from error

        return run

    return decorate


def compress_pulses(
    source: stores.PhaseHistory, run: Run, unit: str, pulses: tuple[int, int], compression: RawCompression
) -> Receipt:
    """Range-compress some pulses of a raw echo into a phase history of the run's own; one with a gap is missing."""
    started = time.perf_counter()
    echo = source.read(slice(*pulses), slice(None))
    found = inspect(echo, range_frequency=np.zeros(echo.shape[1]), recovery=None, threads=run.threads)
    signal = compression.apply(echo, pulses=slice(*pulses), threads=run.threads)
    signal[list(found.missing)] = np.nan
    region = (slice(*pulses), slice(0, signal.shape[1]))
    return _sign(run, unit, started, [write(run, run.compressed, "signal", region, signal)], found=found.as_dict())


def recover_group(
    source: stores.PhaseHistory, run: Run, unit: str, columns: tuple[int, int], recovery: Recovery, width: int
) -> Receipt:
    """Recover the spectrum of a column group, `width` columns at a time; what is missing or impossible is not lit."""
    started = time.perf_counter()
    signal = source.read(slice(None), slice(*columns))
    frequency = source.collection.carrier + source.collection.range_frequency - recovery.carrier
    found = inspect(
        signal, range_frequency=frequency[slice(*columns)], recovery=recovery, first_column=columns[0],
        threads=run.threads,
    )  # fmt: skip
    parts = []
    memory = np.empty(recovery.doppler.size * width, np.complex64)
    for first in range(columns[0], columns[1], width):
        part = slice(first, min(first + width, columns[1]))
        shape = (recovery.doppler.size, part.stop - part.start)
        spectrum = recover_columns(
            signal[:, part.start - columns[0] : part.stop - columns[0]],
            range_frequency=frequency[part],
            recovery=recovery,
            threads=run.threads,
            out=memory[: shape[0] * shape[1]].reshape(shape),
        )
        parts.append(write(run, run.spectrum, "spectrum", (slice(0, shape[0]), part), spectrum))
    return _sign(run, unit, started, parts, found=found.as_dict())


def inspect_group(source: stores.PhaseHistory, run: Run, unit: str, columns: tuple[int, int]) -> Receipt:
    """Look at a column group without recovering it: back-projection reads the samples by pulse."""
    started = time.perf_counter()
    signal = source.read(slice(None), slice(*columns))
    frequency = source.collection.range_frequency[slice(*columns)]
    found = inspect(signal, range_frequency=frequency, recovery=None, first_column=columns[0], threads=run.threads)
    return _sign(run, unit, started, [], found=found.as_dict())


@dataclass
class Samples:
    """A block on its way, and the seconds that each of its tasks took."""

    values: ComplexArray | None
    seconds: dict[str, float]

    def take(self) -> ComplexArray:
        """The values, to be worked on in place: who asks a second time gets none, rather than half-worked ones."""
        values, self.values = self.values, None
        if values is None:
            raise ProcessingError("a block was asked to take the same step twice")
        # What has travelled from another worker may not be written to.
        return values if values.flags.writeable else values.copy()


@named(lambda run, block, stage, *_: f"read-slab+{stage.name} of block {block.name}")
def read_slab(run: Run, block: BlockPlan, stage: Stage, width: int) -> Samples:
    """Run a block's first stage on its part of the spectrum, read some bins or a chunk's `width` columns at a time."""
    started, reading = time.perf_counter(), 0.0
    program, first_bin, last_bin = stage.program, block.first_bin, block.first_bin + block.n_bin
    if stage.layout == "columns":
        # Rows of the file are what the range gate works along: Doppler bin by Doppler bin.
        out = np.empty((program.target.size, program.n_row), np.complex64)
        parts = [(slice(a, b), slice(None)) for a, b in _chunks(first_bin, last_bin, DOPPLER_GROUP)]
    else:
        out = _buffer(block, program.target.size)
        parts = [(slice(first_bin, last_bin), slice(a, b)) for a, b in _chunks(0, program.n_row, width)]
    for region in parts:
        begun = time.perf_counter()
        part = stores.read_region(run.spectrum, "spectrum", region)
        reading += time.perf_counter() - begun
        if stage.layout == "columns":
            program.run(part, out=out, first=region[0].start - first_bin, store="columns", threads=run.threads)
        else:
            program.run(part, out=out, first=region[1].start, load="columns", threads=run.threads)
    return Samples(out, {"read-slab": reading, stage.name: time.perf_counter() - started - reading})


def _chunks(first: int, last: int, size: int) -> Iterator[tuple[int, int]]:
    """first .. last divided at multiples of `size`, where chunks of a store meet."""
    edges = [first, *range(first - first % size + size, last, size), last]
    return pairwise(edges)


def _buffer(block: BlockPlan, length: int) -> ComplexArray:
    """Room for the block at every later stage: a worker holds it once."""
    rows = max(block.range_frequency.size, block.ground.rows.size)
    return np.empty((rows, length), np.complex64)


@named(lambda run, block, stage, *_: f"{stage.name} of block {block.name}")
def run_stage(run: Run, block: BlockPlan, stage: Stage, given: Samples) -> Samples:
    """Run a stage on a block, in place where the result fits: nobody else has its input."""
    started = time.perf_counter()
    samples, program = given.take(), stage.program
    if stage.layout == "columns":
        program.run(
            samples[: program.source.size], out=samples[: program.target.size],
            load="columns", store="columns", threads=run.threads,
        )  # fmt: skip
        out = samples
    else:
        room = samples if program.target.size <= samples.shape[1] else None
        if isinstance(stage.steps[0], ResidualRangeWalk):  # after a range gate, whose block is another
            room = _buffer(block, program.target.size)
        out = program.run(samples[: program.n_row], out=room, threads=run.threads)
    return Samples(out, given.seconds | {stage.name: time.perf_counter() - started})


@named(lambda run, unit, name, *_: f"geometric-correction of block {name}")
def write_patch(run: Run, unit: str, name: str, block: Samples, ground: GroundMap, grid: Grid) -> Receipt:
    """Geometric correction of a focused block into its own patch, chunk by chunk of the image's grid."""
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
    # The unit is the whole block: its earlier steps were tasks of their own, and left no receipt.
    return _sign(run, unit, started - sum(block.seconds.values()), chunks, origin=[first_y, first_x], steps=seconds)


Parts = Sequence[tuple[int, str, int, int, str]]  # block, name, first row and column of its patch, checksum there


@named(lambda run, unit, *_: f"mosaic of {unit}")
def merge_chunks(run: Run, unit: str, cells: dict[tuple[int, int], Parts], grid: Grid) -> Receipt:
    """Some output chunks of the mosaic."""
    started = time.perf_counter()
    parts = [part for cell, patches in cells.items() for part in _merge(run, cell, patches, grid)]
    return _sign(run, unit, started, parts)


def _merge(run: Run, cell: tuple[int, int], parts: Parts, grid: Grid) -> list[Written]:
    """One output chunk: its image and its owners."""
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
            raise ProcessingError(f"the patch of block {name} is no longer what was written")
        mine = np.isfinite(patch.real)
        np.copyto(owner, index, where=mine)
        if image is None:
            image = patch
        else:
            np.copyto(image, patch, where=mine)
    assert image is not None
    # A chunk that one block alone covers is that block's: it need not lie on the disk twice.
    alone = len(parts) == 1 and stores.share_region(
        run.image, "image", (rows, columns), source=run.patch(parts[0][1]), source_region=windows[0]
    )
    store = written if alone else write
    return [
        store(run, run.image, "image", (rows, columns), image),
        write(run, run.image, "block", (rows, columns), owner),
    ]


def back_project_chunk(
    source: stores.PhaseHistory,
    run: Run,
    unit: str,
    cell: tuple[int, int],
    geometry: Geometry,
    grid: Grid,
    found: Inspection,
) -> Receipt:
    """One output chunk by exact back-projection; reads the lit pulses only."""
    started = time.perf_counter()
    side = image_chunk(grid)
    y, x = cell[0] * side[0], cell[1] * side[1]
    rows, columns = slice(y, min(y + side[0], grid.shape[0])), slice(x, min(x + side[1], grid.shape[1]))

    def read(pulses: slice) -> ComplexArray:
        signal = source.read(pulses, slice(None))
        strike(signal, found, pulses=pulses)
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
    return _sign(run, unit, started, parts)


# ---------------------------------------------------------------- the graph: what is asked of the workers


def image_chunk(grid: Grid) -> tuple[int, int]:
    return min(IMAGE_CHUNK, grid.shape[0]), min(IMAGE_CHUNK, grid.shape[1])


def patch_window(ground: GroundMap, grid: Grid) -> tuple[int, int, int, int]:
    """First row, first column, rows and columns of a block's patch: whole chunks of the image around its sector."""
    yaw = np.linspace(ground.low, ground.high, 257)
    corners = ground.geometry.ground_point(np.array([[ground.near], [ground.far]]), yaw)
    side = image_chunk(grid)
    spans = []
    for axis, values, chunk, step in ((1, grid.y, side[0], grid.dy), (0, grid.x, side[1], grid.dx)):
        # The outline between two samples bulges by less than this.
        bulge = ground.far * (yaw[1] - yaw[0]) ** 2 + step
        low, high = np.nanmin(corners[..., axis]) - bulge, np.nanmax(corners[..., axis]) + bulge
        first = int(np.clip(np.searchsorted(values, low), 0, values.size - 1)) // chunk * chunk
        last = int(np.clip(np.searchsorted(values, high), 1, values.size))
        spans.append((first, min(-(-last // chunk) * chunk, values.size) - first))
    return spans[0][0], spans[1][0], spans[0][1], spans[1][1]


def run_units(
    client: Client, stage: str, units: Sequence[Unit], run: Run, report: Listener, *, each: int = 1
) -> list[Receipt]:
    """Run what has no trusted receipt yet, `each` units at a time on every worker, and return all receipts in order.

    Receipts of units that were not run again say `"reused": true`, those of units whose data were found damaged
    `"damaged": true`.

    Raises
    ------
    ProcessingError
        If a unit fails for good, or nothing more will come of the cluster: what was finished stays.
    InputError
        If a unit that reads the input finds it wrong.
    """
    claims = {unit: receipt for unit, _ in units if (receipt := run.receipt(unit)) is not None}
    receipts: dict[str, Receipt] = {}
    damaged = set()
    # By workers: samples never come here.
    checks = [(unit, _verify(client, run, claims[unit])) for unit in claims]
    if checks:
        report.begin(f"check-{stage}")
    for number, (unit, future) in enumerate(in_turn(client, stage, checks, 2, report), 1):
        if _result(future, stage, unit):
            receipts[unit] = claims[unit] | {"reused": True}
        else:
            damaged.add(unit)
        report.update(f"check-{stage}", number, len(checks))
    report.begin(stage, reused=len(receipts))
    report.update(stage, len(receipts), len(units))
    for unit, future in in_turn(client, stage, [unit for unit in units if unit[0] not in receipts], each, report):
        receipts[unit] = _result(future, stage, unit) | ({"damaged": True} if unit in damaged else {})
        report.update(stage, len(receipts), len(units))
    return [receipts[unit] for unit, _ in units]


def _verify(client: Client, run: Run, receipt: Receipt) -> Callable[[], Future[Any]]:
    key = f"verify-{run.token}-{receipt['unit']}"
    return lambda: client.submit(run.intact, receipt, key=key, pure=False)


def _result(future: Future[Any], stage: str, unit: str) -> Any:
    if future.status == "finished":
        return future.result()
    error = future.exception()
    # Only these stages read the input: what is wrong with a run's own stores is no fault of it.
    if isinstance(error, ProcessingError) or (stage in READING_STAGES and isinstance(error, InputError)):
        raise error
    if isinstance(error, KilledWorker):
        raise ProcessingError(
            f"{stage} of {unit} failed: {error.allowed_failures + 1} workers died of it, for want of memory perhaps; "
            "give them more with --memory-limit"
        )
    raise ProcessingError(f"{stage} of {unit} failed: {type(error).__name__}: {error}") from error


def recover(
    client: Client, source: stores.PhaseHistory, plan: Plan, run: Run, report: Listener
) -> tuple[list[Receipt], Inspection]:
    """Phase history to spectrum.zarr, and what was found in the samples.

    Raises
    ------
    InputError
        If they are no samples of a radar.
    """
    collection = plan.geometry.collection
    receipts: list[Receipt] = []
    if source.raw is not None:
        source, receipts = _compress(client, source, run, report)

    def create() -> None:
        stores.create(
            run.spectrum, stores.SPECTRUM, sizes={}, attrs={"title": collection.title}, overwrite=True,
            coords={"doppler": plan.recovery.doppler.values, "range_frequency": collection.range_frequency},
            variables={"lit": np.full(collection.n_pulse, np.nan)},
            chunks=dict(zip(("doppler", "range_frequency"), plan.spectrum_chunk, strict=True)),
        )  # fmt: skip

    run.establish(run.spectrum, create, volatile=["lit"])
    n = collection.n_range_frequency

    def start(unit: str, columns: tuple[int, int]) -> Callable[[], Future[Any]]:
        return lambda: client.submit(
            recover_group,
            source,
            run,
            unit,
            columns,
            plan.recovery,
            plan.spectrum_chunk[1],
            key=f"recover-{run.token}-{unit}",
            pure=False,
        )

    groups = [(first, min(first + plan.column_group, n)) for first in range(0, n, plan.column_group)]
    units = [(f"columns-{a}", start(f"columns-{a}", (a, b))) for a, b in groups]
    groups_done = run_units(client, "recover", units, run, report)
    found = _found(groups_done)
    stores.write_region(run.spectrum, "lit", (slice(None),), found.lit)
    return receipts + groups_done, found


def _found(receipts: Sequence[Receipt]) -> Inspection:
    found = merge(Inspection.from_dict(receipt["found"]) for receipt in receipts)
    if (reason := refusal(found)) is not None:
        raise InputError(reason)
    return found


def _compress(
    client: Client, source: stores.PhaseHistory, run: Run, report: Listener
) -> tuple[stores.PhaseHistory, list[Receipt]]:
    collection = source.collection
    run.establish(run.compressed, lambda: stores.create_phase_history(run.compressed, collection, overwrite=True))
    chunk = stores.TILE[0]
    compression = compression_of(source)

    def start(unit: str, pulses: tuple[int, int]) -> Callable[[], Future[Any]]:
        return lambda: client.submit(
            compress_pulses,
            source,
            run,
            unit,
            pulses,
            compression,
            key=f"compress-{run.token}-{unit}",
            pure=False,
        )

    groups = [(a, min(a + chunk, collection.n_pulse)) for a in range(0, collection.n_pulse, chunk)]
    units = [(f"pulses-{a}", start(f"pulses-{a}", (a, b))) for a, b in groups]
    receipts = run_units(client, "range-compress", units, run, report, each=2)
    return stores.open_phase_history(run.compressed), receipts


def compression_of(source: stores.PhaseHistory) -> RawCompression:
    """How a raw echo's pulses become range-frequency signals."""
    assert source.raw is not None
    return RawCompression.of(
        fast_time=source.raw.fast_time, chirp_rate=source.raw.chirp_rate, pulse_width=source.raw.pulse_width,
        range_frequency=source.collection.range_frequency, reference_range=source.collection.reference_range,
    )  # fmt: skip


def compression_memory(source: stores.PhaseHistory) -> int:
    """Peak of a worker that range-compresses a raw echo, bytes; 0 where there is none."""
    if source.raw is None:
        return 0
    echo, band = source.raw.fast_time.size, source.collection.range_frequency.size
    pulses = 8 * stores.TILE[0] * (2 * echo + 2 * band)  # as read, and as chunks give and take them
    return PROCESS_MEMORY + pulses + COMPRESSED_ROWS * (8 * echo + 5 * 16 * band)


def focus_blocks(client: Client, plan: Plan, run: Run, lit: FloatArray, report: Listener) -> list[Receipt]:
    """Every block by its own chain of tasks: spectrum.zarr to patches/<block>."""
    collection = plan.geometry.collection
    # By this process, before all tasks: one that was given up, and comes too late, must not empty what another wrote.
    for block in plan.blocks:
        run.establish(run.patch(block.name), partial(_create_patch, run, block, plan.grid))

    def start(position: int, unit: str, block: BlockPlan) -> Callable[[], Future[Any]]:
        ground = replace(block.ground, lit=lit_pulses(collection, block.ground.yaw_axis, lit))

        def chain() -> Future[Any]:
            tail = f"{run.token}-{unit}"
            # One priority a block: a worker finishes the chain it has begun before it starts another.
            common: dict[str, Any] = {"pure": False, "priority": -position}
            first, *others = stages(block.chain)
            node = client.submit(
                read_slab, run, block, first, plan.spectrum_chunk[1], key=f"read-slab+{first.name}-{tail}", **common
            )
            for stage in others:
                node = client.submit(run_stage, run, block, stage, node, key=f"{stage.name}-{tail}", **common)
            return client.submit(
                write_patch,
                run,
                unit,
                block.name,
                node,
                ground,
                plan.grid,
                key=f"geometric-correction-{tail}",
                **common,
            )

        return chain

    units = [
        (f"block-{block.name}", start(position, f"block-{block.name}", block))
        for position, block in enumerate(plan.blocks)
    ]
    return run_units(client, "focus", units, run, report)


def _create_patch(run: Run, block: BlockPlan, grid: Grid) -> None:
    first_y, first_x, n_y, n_x = patch_window(block.ground, grid)
    side = image_chunk(grid)
    stores.create(
        run.patch(block.name), stores.PATCH, sizes={}, attrs={"title": f"block {block.name}"}, overwrite=True,
        coords={"x": grid.x[first_x : first_x + n_x], "y": grid.y[first_y : first_y + n_y]},
        chunks={"y": side[0], "x": side[1]},
    )  # fmt: skip


def mosaic(client: Client, plan: Plan, run: Run, patches: Sequence[Receipt], report: Listener) -> list[Receipt]:
    """Patches to image.zarr, by output chunk; chunks that no block covers are never written."""
    side = image_chunk(plan.grid)
    cells: dict[tuple[int, int], list[tuple[int, str, int, int, str]]] = {}
    for block, receipt in zip(plan.blocks, patches, strict=True):
        first_y, first_x = receipt["origin"]
        for part in map(Written.of, receipt["written"]):
            (y, _), (x, _) = part.region
            cell = ((first_y + y) // side[0], (first_x + x) // side[1])
            cells.setdefault(cell, []).append((block.index, block.name, first_y, first_x, part.checksum))

    def start(unit: str, some: dict[tuple[int, int], Parts]) -> Callable[[], Future[Any]]:
        return lambda: client.submit(
            merge_chunks, run, unit, some, plan.grid, key=f"mosaic-{run.token}-{unit}", pure=False
        )

    ordered = sorted(cells)
    groups = [ordered[i : i + MOSAIC_CHUNKS] for i in range(0, len(ordered), MOSAIC_CHUNKS)]
    units = []
    for group in groups:
        unit = f"chunk-{group[0][0]}-{group[0][1]}"
        units.append((unit, start(unit, {cell: cells[cell] for cell in group})))
    return run_units(client, "mosaic", units, run, report, each=2)


def inspection_width(collection: Collection) -> int:
    """Range frequencies that a task looks at."""
    return min(max(SIGNAL_BYTES // (8 * collection.n_pulse), 1), stores.TILE[1])


def look_through(
    client: Client, source: stores.PhaseHistory, run: Run, report: Listener
) -> tuple[stores.PhaseHistory, list[Receipt], Inspection]:
    """Inspect a phase history that is not recovered; a raw one is compressed first. Where its samples are then.

    Raises
    ------
    InputError
        If they are no samples of a radar.
    """
    receipts: list[Receipt] = []
    if source.raw is not None:
        source, receipts = _compress(client, source, run, report)
    n = source.collection.n_range_frequency
    width = inspection_width(source.collection)

    def start(unit: str, columns: tuple[int, int]) -> Callable[[], Future[Any]]:
        key = f"inspect-{run.token}-{unit}"
        return lambda: client.submit(inspect_group, source, run, unit, columns, key=key, pure=False)

    units = [(f"columns-{a}", start(f"columns-{a}", (a, min(a + width, n)))) for a in range(0, n, width)]
    looked = run_units(client, "inspect", units, run, report)
    return source, receipts + looked, _found(looked)


def back_projection_memory(collection: Collection, grid: Grid, *, threads: int) -> int:
    """Peak of a worker that looks through a phase history and back-projects it, bytes."""
    pixels, part = math.prod(image_chunk(grid)), min(math.prod(image_chunk(grid)), BACKPROJECTION_CHUNK**2)
    looking = 2 * 8 * inspection_width(collection) * collection.n_pulse  # as read, and as chunks give it
    forming = 3 * 8 * pixels + image_memory(part, collection, threads=threads)  # image, covered part, bytes to write
    return PROCESS_MEMORY + max(looking, forming)


def back_project(
    client: Client,
    source: stores.PhaseHistory,
    geometry: Geometry,
    grid: Grid,
    found: Inspection,
    run: Run,
    report: Listener,
) -> list[Receipt]:
    """Phase history straight to image.zarr by exact back-projection, by output chunk."""
    side = image_chunk(grid)

    def start(unit: str, cell: tuple[int, int]) -> Callable[[], Future[Any]]:
        return lambda: client.submit(
            back_project_chunk, source, run, unit, cell, geometry, grid, found,
            key=f"backprojection-{run.token}-{unit}", pure=False,
        )  # fmt: skip

    units = []
    for row in range(-(-grid.shape[0] // side[0])):
        for column in range(-(-grid.shape[1] // side[1])):
            unit = f"chunk-{row}-{column}"
            units.append((unit, start(unit, (row, column))))
    return run_units(client, "backprojection", units, run, report)
