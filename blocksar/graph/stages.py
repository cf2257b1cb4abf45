"""The task graph: recovery by column group, one chain a block, the mosaic by output chunk.

Tasks get paths and small constants and leave their samples in zarr; what travels is
receipts. Keys read `step-run-block`, so that the dashboard can be read and no stale result is taken for a
new one. A unit of work writes whole chunks that nobody else writes, then its receipt: a worker that is lost
loses nothing but time, and a run that was interrupted goes on from its receipts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from distributed import Client, Future, KilledWorker

from blocksar import stores
from blocksar.arrays import FloatArray
from blocksar.chunks import MOSAIC_CHUNKS, TILE
from blocksar.collection.beam import lit_pulses
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.errors import InputError, ProcessingError
from blocksar.focusing.range_compression import RawCompression
from blocksar.focusing.step import stages
from blocksar.graph.admission import Unit, in_turn
from blocksar.graph.tasks import (
    Parts,
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
from blocksar.planning.block import BlockPlan
from blocksar.planning.plan import Plan
from blocksar.planning.tiling import image_chunk, inspection_width, patch_window
from blocksar.progress import Listener
from blocksar.runs.receipts import Run
from blocksar.runs.record import Receipt, block_unit


def run_units(
    client: Client,
    stage: str,
    units: Sequence[Unit],
    run: Run,
    report: Listener,
    *,
    each: int = 1,
    source: stores.PhaseHistory | None = None,
) -> list[Receipt]:
    """Run the units without a trusted receipt, `each` at a time on every worker, and return all receipts in order.

    Parameters
    ----------
    source : PhaseHistory, optional
        What the units read. Their InputErrors are the user's only if it is the input of the run.

    Returns
    -------
    list of Receipt
        `reused` where the unit was not run again, `damaged` where it was because its data were damaged.

    Raises
    ------
    ProcessingError
        If a unit or the cluster fails for good: what was finished stays.
    InputError
        If a unit finds the input wrong.
    """
    reads_input = source is not None and source.path != run.compressed
    claims = {unit: receipt for unit, _ in units if (receipt := run.receipt(unit)) is not None}
    receipts: dict[str, Receipt] = {}
    damaged = set()
    # By workers: samples never come here.
    checks = [(unit, _verify(client, run, claims[unit])) for unit in claims]
    if checks:
        report.begin(f"check-{stage}")
    for number, (unit, future) in enumerate(in_turn(client, stage, checks, 2, report), 1):
        if _result(future, stage, unit):
            receipts[unit] = replace(claims[unit], reused=True)
        else:
            damaged.add(unit)
        report.update(f"check-{stage}", number, len(checks))
    report.begin(stage, reused=len(receipts))
    report.update(stage, len(receipts), len(units))
    for unit, future in in_turn(client, stage, [unit for unit in units if unit[0] not in receipts], each, report):
        signed: Receipt = _result(future, stage, unit, reads_input=reads_input)
        receipts[unit] = replace(signed, damaged=unit in damaged)
        report.update(stage, len(receipts), len(units))
    return [receipts[unit] for unit, _ in units]


def _verify(client: Client, run: Run, receipt: Receipt) -> Callable[[], Future[Any]]:
    key = f"verify-{run.token}-{receipt.unit}"
    return lambda: client.submit(run.intact, receipt, key=key, pure=False)


def _result(future: Future[Any], stage: str, unit: str, *, reads_input: bool = False) -> Any:
    if future.status == "finished":
        return future.result()
    error = future.exception()
    # What is wrong with the run's own stores is not the user's fault.
    if isinstance(error, ProcessingError) or (reads_input and isinstance(error, InputError)):
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
    groups_done = run_units(client, "recover", units, run, report, source=source)
    found = found_in(groups_done)
    stores.write_region(run.spectrum, "lit", (slice(None),), found.lit)
    return receipts + groups_done, found


def found_in(receipts: Sequence[Receipt]) -> Inspection:
    """Merge the inspections in receipts.

    Raises
    ------
    InputError
        If the samples are none of a radar.
    """
    found = merge(Inspection.from_dict(dict(receipt.found)) for receipt in receipts if receipt.found is not None)
    if (reason := refusal(found)) is not None:
        raise InputError(reason)
    return found


def _compress(
    client: Client, source: stores.PhaseHistory, run: Run, report: Listener
) -> tuple[stores.PhaseHistory, list[Receipt]]:
    collection = source.collection
    assert source.raw is not None
    run.establish(run.compressed, lambda: stores.create_phase_history(run.compressed, collection, overwrite=True))
    chunk = TILE[0]
    compression = RawCompression.of_echo(source.raw, collection)

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
    receipts = run_units(client, "range-compress", units, run, report, each=2, source=source)
    try:
        return stores.open_phase_history(run.compressed), receipts
    except InputError as error:  # about the run's own store, not about the input
        raise ProcessingError(str(error)) from error


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
        (unit := block_unit(block.name), start(position, unit, block)) for position, block in enumerate(plan.blocks)
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
        assert receipt.origin is not None
        first_y, first_x = receipt.origin
        for part in receipt.written:
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
    looked = run_units(client, "inspect", units, run, report, source=source)
    return source, receipts + looked, found_in(looked)


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
    return run_units(client, "backprojection", units, run, report, source=source)
