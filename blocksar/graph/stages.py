"""The stages of a run as task graphs: recovery by column group, focusing by block, the mosaic by output chunk.

Tasks receive paths and small constants, write their samples to zarr and return receipts. Keys have the form
`step-run-block`: the dashboard is readable, and no result of another run is reused. A unit of work writes whole chunks
that no other unit writes, then its receipt. A lost worker therefore costs time only, and an interrupted run resumes
from its receipts.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from distributed import Client, Future, KilledWorker

from blocksar import stores
from blocksar.arrays import FloatArray
from blocksar.chunks import MOSAIC_CHUNKS, TILE
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.collection.weighting import Weighting
from blocksar.errors import InputError, ProcessingError
from blocksar.focusing.ground_map import sum_lit
from blocksar.focusing.noise import NoiseMap
from blocksar.focusing.range_compression import RawCompression
from blocksar.focusing.step import stages
from blocksar.graph.admission import Unit, as_completed
from blocksar.graph.gating import Gated, gate_bins
from blocksar.graph.spectrum import SpectrumChunks
from blocksar.graph.tasks import (
    PatchChunk,
    back_project_chunk,
    compress_pulses,
    inspect_group,
    merge_chunks,
    read_slab,
    recover_group,
    run_stage,
    write_patch,
)
from blocksar.inspection.samples import Inspection, merge
from blocksar.inspection.sentences import refusal
from blocksar.places.place import Place
from blocksar.planning.block import BlockPlan
from blocksar.planning.plan import Plan
from blocksar.planning.tiling import image_chunk, inspection_width, patch_window, touched_chunks
from blocksar.progress import Listener
from blocksar.runs.receipts import Run
from blocksar.runs.record import Receipt, Written, block_unit


def recover(
    client: Client, source: stores.PhaseHistory, plan: Plan, run: Run, listener: Listener
) -> tuple[list[Receipt], Inspection]:
    """Recover the spectrum of a phase history into spectrum.zarr; return the receipts and the samples' inspection.

    Raises
    ------
    InputError
        If the samples are not those of a radar.
    """
    collection = plan.geometry.collection
    source, compressed = _compress_raw(client, source, run, listener)

    def create() -> None:
        stores.create(
            run.spectrum, stores.SPECTRUM, sizes={}, attrs={"title": collection.title}, overwrite=True,
            coords={"doppler": plan.recovery.doppler.values, "range_frequency": collection.range_frequency},
            variables={"lit": np.full(collection.n_pulse, np.nan)},
            chunks=dict(zip(("doppler", "range_frequency"), plan.spectrum_chunk, strict=True)),
        )  # fmt: skip

    run.establish(run.spectrum, create, volatile=["lit"])
    units = [
        _single_task(
            client,
            run,
            "recover",
            f"columns-{columns[0]}",
            recover_group,
            source.within(columns=slice(*columns)),
            columns,
            plan.recovery,
            plan.spectrum_chunk,
        )
        for columns in _spans(collection.n_range_frequency, plan.column_group)
    ]
    recovered = run_units(client, "recover", units, run, listener, source=source)
    inspection = merge_inspections(recovered)
    stores.write_region(run.spectrum, "lit", (slice(None),), inspection.lit)
    return compressed + recovered, inspection


def gate_ranges(
    client: Client, plan: Plan, run: Run, recovered: Sequence[Receipt], listener: Listener
) -> list[Receipt]:
    """Gate the spectrum in range for all sub-blocks, into gated/; nothing without sub-blocks."""
    targets = [
        Gated(block.name, block.range_gate, block.first_bin, plan.gated_bins(block)[0], plan.gated_chunk(block))
        for block in plan.blocks
        if block.range_gate is not None
    ]
    if not targets:
        return []
    for block in plan.blocks:
        run.establish(run.gated(block.name), partial(_create_gated, run, plan, block))
    spectrum = _whole_spectrum(plan, run, recovered)
    units = []
    for bins in plan.gate_spans():
        some = [target.within(*bins) for target in targets if target.common(*bins)[0] < target.common(*bins)[1]]
        units.append(
            _single_task(client, run, "gate", f"bins-{bins[0]}", gate_bins, bins, spectrum.within(*bins), some)
        )
    return run_units(client, "gate", units, run, listener, per_worker=2)


def _create_gated(run: Run, plan: Plan, block: BlockPlan) -> None:
    first, last = plan.gated_bins(block)
    stores.create(
        run.gated(block.name), stores.GATED, sizes={}, attrs={"title": f"block {block.name}"}, overwrite=True,
        coords={
            "doppler": plan.recovery.doppler.part(first, last - first).values,
            "range_frequency": block.sampling.range_frequency.values,
        },
        chunks=dict(zip(("doppler", "range_frequency"), plan.gated_chunk(block), strict=True)),
    )  # fmt: skip


def _written(run: Run, store: Place, receipts: Sequence[Receipt]) -> list[Written]:
    """What receipts say was written to a store's spectrum."""
    name = run.name_of(store)
    return [part for receipt in receipts for part in receipt.written if part.store == name]


def _whole_spectrum(plan: Plan, run: Run, receipts: Sequence[Receipt]) -> SpectrumChunks:
    shape = plan.recovery.doppler.size, plan.geometry.collection.n_range_frequency
    written = _written(run, run.spectrum, receipts)
    return SpectrumChunks.of(run.spectrum, written, shape=shape, chunk=plan.spectrum_chunk)


def _gated_spectrum(plan: Plan, run: Run, block: BlockPlan, receipts: Sequence[Receipt]) -> SpectrumChunks:
    first, last = plan.gated_bins(block)
    store = run.gated(block.name)
    return SpectrumChunks.of(
        store, _written(run, store, receipts), first_bin=first, chunk=plan.gated_chunk(block),
        shape=(last - first, block.sampling.range_frequency.size),
    )  # fmt: skip


def focus_blocks(
    client: Client,
    plan: Plan,
    run: Run,
    receipts: Sequence[Receipt],
    lit: FloatArray,
    noise: NoiseMap | None,
    listener: Listener,
) -> list[Receipt]:
    """Focus every block, from the spectrum to patches/<block>, by a chain of tasks of its own.

    The receipts of recovery and of the range gates have the checksums of spectra, `lit` the valid fraction of each
    pulse.
    """
    # Create all patches here, before the first task: a late task of a lost worker must not empty a store that another
    # task has written to.
    for block in plan.blocks:
        run.establish(run.patch(block.name), partial(_create_patch, run, block, plan.grid))
    spectrum = _whole_spectrum(plan, run, receipts)
    chunks = [touched_chunks(block.ground, plan.grid) for block in plan.blocks]
    touching = Counter(cell for cells in chunks for cell in cells)
    units: list[Unit] = []
    for position, (block, cells) in enumerate(zip(plan.blocks, chunks, strict=True)):
        own = frozenset(cell for cell in cells if touching[cell] == 1)
        slab = spectrum if block.range_gate is None else _gated_spectrum(plan, run, block, receipts)
        units.append(
            (block_unit(block.name), partial(_submit_chain, client, plan, run, slab, lit, noise, block, own, -position))
        )
    return run_units(client, "focus", units, run, listener)


def _create_patch(run: Run, block: BlockPlan, grid: Grid) -> None:
    first_y, first_x, n_y, n_x = patch_window(block.ground, grid)
    side = image_chunk(grid)
    stores.create(
        run.patch(block.name), stores.PATCH, sizes={}, attrs={"title": f"block {block.name}"}, overwrite=True,
        coords={"x": grid.x[first_x : first_x + n_x], "y": grid.y[first_y : first_y + n_y]},
        chunks={"y": side[0], "x": side[1]},
    )  # fmt: skip


def _submit_chain(
    client: Client, plan: Plan, run: Run, spectrum: SpectrumChunks, lit: FloatArray, noise: NoiseMap | None,
    block: BlockPlan, own: frozenset[tuple[int, int]], priority: int,
) -> Future[Any]:  # fmt: skip
    """Submit the tasks of a block; return the future of the last one.

    All have the priority of the block: a worker finishes the chain that it has begun before it starts another.
    """
    unit = block_unit(block.name)
    tail = f"{run.token}-{unit}"
    submit = partial(client.submit, pure=False, priority=priority)
    ground = block.ground
    summed = sum_lit(
        ground.geometry, near=ground.near, far=ground.far, yaw=ground.yaw_axis, valid=lit, taper=ground.taper
    )
    ground = replace(ground, lit=summed)
    first, *others = stages(block.steps)
    slab = spectrum.within(block.first_bin, block.first_bin + block.n_bin)
    node = submit(read_slab, run, block, first, slab, key=f"read-slab+{first.name}-{tail}")
    for stage in others:
        node = submit(run_stage, run, block, stage, node, key=f"{stage.name}-{tail}")
    key = f"geometric-correction-{tail}"
    return submit(write_patch, run, unit, block, node, ground, plan.grid, own, noise, key=key)


def mosaic(
    client: Client, plan: Plan, run: Run, patches: Sequence[Receipt], noise: NoiseMap | None, listener: Listener
) -> list[Receipt]:
    """Merge the patches into image.zarr, by output chunk, where several blocks may own pixels.

    Chunks that only one block touches are there already; chunks that no block covers are not written.
    """
    side = image_chunk(plan.grid)
    cells: dict[tuple[int, int], list[PatchChunk]] = {}
    for block, receipt in zip(plan.blocks, patches, strict=True):
        assert receipt.origin is not None
        first_y, first_x = receipt.origin
        patch = run.name_of(run.patch(block.name))
        complete = {part.region for part in receipt.written if part.store != patch}
        for part in receipt.written:
            (y, y_end), (x, x_end) = part.region
            region = ((first_y + y, first_y + y_end), (first_x + x, first_x + x_end))
            if part.store != patch or region in complete:
                continue
            cell = ((first_y + y) // side[0], (first_x + x) // side[1])
            cells.setdefault(cell, []).append((block.index, block.name, first_y, first_x, part.checksum))
    ordered = sorted(cells)
    units = []
    for first, end in _spans(len(ordered), MOSAIC_CHUNKS):
        group = {cell: cells[cell] for cell in ordered[first:end]}
        row, column = ordered[first]
        unit = f"chunk-{row}-{column}"
        units.append(_single_task(client, run, "mosaic", unit, merge_chunks, group, plan.grid, noise))
    return run_units(client, "mosaic", units, run, listener, per_worker=2)


def inspect_samples(
    client: Client, source: stores.PhaseHistory, run: Run, listener: Listener
) -> tuple[stores.PhaseHistory, list[Receipt], Inspection]:
    """Inspect a phase history that is not recovered; a raw echo is compressed first.

    Returns
    -------
    (PhaseHistory, list of Receipt, Inspection)
        The phase history is the compressed one for a raw echo, else `source`.

    Raises
    ------
    InputError
        If the samples are not those of a radar.
    """
    source, compressed = _compress_raw(client, source, run, listener)
    units = [
        _single_task(
            client,
            run,
            "inspect",
            f"columns-{columns[0]}",
            inspect_group,
            source.within(columns=slice(*columns)),
            columns,
        )
        for columns in _spans(source.collection.n_range_frequency, inspection_width(source.collection))
    ]
    inspected = run_units(client, "inspect", units, run, listener, source=source)
    return source, compressed + inspected, merge_inspections(inspected)


def back_project(
    client: Client,
    source: stores.PhaseHistory,
    geometry: Geometry,
    grid: Grid,
    inspection: Inspection,
    weighting: Weighting,
    noise: NoiseMap | None,
    run: Run,
    listener: Listener,
) -> list[Receipt]:
    """Form image.zarr from a phase history by exact back-projection, by output chunk."""
    side = image_chunk(grid)
    units = [
        _single_task(
            client, run, "backprojection", f"chunk-{row}-{column}",
            back_project_chunk, source, (row, column), geometry.over(None), grid, inspection, weighting, noise,
            geometry.terrain is not None,
        )
        for row in range(-(-grid.shape[0] // side[0]))
        for column in range(-(-grid.shape[1] // side[1]))
    ]  # fmt: skip
    return run_units(client, "backprojection", units, run, listener, source=source)


def merge_inspections(receipts: Sequence[Receipt]) -> Inspection:
    """Merge the inspections in receipts.

    Raises
    ------
    InputError
        If the samples are not those of a radar.
    """
    inspection = merge(Inspection.from_dict(dict(receipt.found)) for receipt in receipts if receipt.found is not None)
    if (reason := refusal(inspection)) is not None:
        raise InputError(reason)
    return inspection


def _compress_raw(
    client: Client, source: stores.PhaseHistory, run: Run, listener: Listener
) -> tuple[stores.PhaseHistory, list[Receipt]]:
    """Range-compress a raw echo into compressed.zarr; return that phase history, or `source` if it is not raw."""
    if source.raw is None:
        return source, []
    collection = source.collection
    # The noise is that of a sample of the echo, not of the signal.
    kept = Collection(**{**collection.as_dict(), "noise_power": None})
    run.establish(run.compressed, lambda: stores.create_phase_history(run.compressed, kept, overwrite=True))
    compression = RawCompression.of_echo(source.raw, collection)
    units = [
        _single_task(
            client,
            run,
            "compress",
            f"pulses-{pulses[0]}",
            compress_pulses,
            source.within(pulses=slice(*pulses)),
            pulses,
            compression,
        )
        for pulses in _spans(collection.n_pulse, TILE[0])
    ]
    receipts = run_units(client, "range-compress", units, run, listener, per_worker=2, source=source)
    try:
        return stores.open_phase_history(run.compressed).pinned(), receipts
    except InputError as error:  # about the run's own store, not about the input
        raise ProcessingError(str(error)) from error


def _spans(n: int, size: int) -> list[tuple[int, int]]:
    """Divide 0 .. n into spans (first, end) of `size`; the last may be shorter."""
    return [(first, min(first + size, n)) for first in range(0, n, size)]


def _single_task(client: Client, run: Run, step: str, unit: str, task: Callable[..., Receipt], *arguments: Any) -> Unit:
    """Return a unit of work that is a single task, `task(run, unit, *arguments)`."""
    key = f"{step}-{run.token}-{unit}"
    return unit, partial(client.submit, task, run, unit, *arguments, key=key, pure=False)


def run_units(
    client: Client,
    stage: str,
    units: Sequence[Unit],
    run: Run,
    listener: Listener,
    *,
    per_worker: int = 1,
    source: stores.PhaseHistory | None = None,
) -> list[Receipt]:
    """Run the units that have no valid receipt; return the receipts of all units in order.

    Parameters
    ----------
    per_worker : int
        Units in flight for each worker.
    source : PhaseHistory, optional
        What the units read. Their InputErrors are raised as such only if it is the input of the run.

    Returns
    -------
    list of Receipt
        `reused` if the unit was not run again; `damaged` if it was, because its data were damaged.

    Raises
    ------
    ProcessingError
        If a unit or the cluster fails for good; finished units stay.
    InputError
        If a unit finds the input wrong.
    """
    reads_input = source is not None and source.path != run.compressed
    earlier = {unit: receipt for unit, _ in units if (receipt := run.receipt(unit)) is not None}
    receipts: dict[str, Receipt] = {}
    damaged = set()
    # Workers check the data: this process never loads samples.
    checks = [(unit, _submit_check(client, run, receipt)) for unit, receipt in earlier.items()]
    if checks:
        listener.begin(f"check-{stage}")
    for number, (unit, future) in enumerate(as_completed(client, stage, checks, 2, listener), 1):
        if _result(future, stage, unit):
            receipts[unit] = replace(earlier[unit], reused=True)
        else:
            damaged.add(unit)
        listener.update(f"check-{stage}", number, len(checks))
    listener.begin(stage, reused=len(receipts))
    listener.update(stage, len(receipts), len(units))
    left = [unit for unit in units if unit[0] not in receipts]
    for unit, future in as_completed(client, stage, left, per_worker, listener):
        signed: Receipt = _result(future, stage, unit, reads_input=reads_input)
        receipts[unit] = replace(signed, damaged=unit in damaged)
        listener.update(stage, len(receipts), len(units))
    return [receipts[unit] for unit, _ in units]


def _submit_check(client: Client, run: Run, receipt: Receipt) -> Callable[[], Future[Any]]:
    key = f"verify-{run.token}-{receipt.unit}"
    return partial(client.submit, run.intact, receipt, key=key, pure=False)


def _result(future: Future[Any], stage: str, unit: str, *, reads_input: bool = False) -> Any:
    """Return the result of a unit, or raise its error with the stage and the unit."""
    if future.status == "finished":
        return future.result()
    error = future.exception()
    # A defect in the run's own stores is not an error in the user's input.
    if isinstance(error, ProcessingError) or (reads_input and isinstance(error, InputError)):
        raise error
    if isinstance(error, KilledWorker):
        raise ProcessingError(
            f"{stage} of {unit} failed: {error.allowed_failures + 1} workers died of it, perhaps for lack of memory; "
            "give them more with --memory-limit"
        )
    raise ProcessingError(f"{stage} of {unit} failed: {type(error).__name__}: {error}") from error
