"""Stages of a chain as lists of units: recovery by column group, focusing by block, the mosaic by output chunk."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from blocksar import stores
from blocksar.arrays import FloatArray
from blocksar.chunks import MOSAIC_CHUNKS
from blocksar.collection.beam import margins_over
from blocksar.collection.grid import Grid
from blocksar.graph.units import Executor, Unit
from blocksar.planning.tiling import chunk_spans, chunk_window, image_chunk
from blocksar.processors.chain.ground.patches import patch_window, touched_chunks
from blocksar.processors.chain.planning.block import BlockPlan
from blocksar.processors.chain.planning.plan import Plan
from blocksar.processors.chain.tasks.blocks import read_slab, run_stage
from blocksar.processors.chain.tasks.patching import Patch, PatchChunk, merge_chunks, write_patch
from blocksar.processors.chain.tasks.recovering import Gated, gate_bins, recover_group
from blocksar.processors.chain.tasks.spectrum import SpectrumChunks
from blocksar.runs.receipts import Run
from blocksar.runs.record import Receipt, block_unit
from blocksar.tasks.segments import Segment
from blocksar.tasks.stages import Parts, ReadSegment, column_groups, layers_of_chunks, read_samples, written_parts


def planned(segment: Segment) -> Plan:
    """The chain's plan of a segment."""
    assert isinstance(segment.plan, Plan)
    return segment.plan


def recover(executor: Executor, segments: Sequence[Segment], run: Run) -> list[ReadSegment]:
    """Recover the spectrum of every segment into its spectrum.zarr.

    Raises
    ------
    InputError
        If the samples are not those of a radar.
    """
    units: list[Unit] = []
    for segment in segments:
        plan, own = planned(segment), segment.of(run)
        run.establish(own.spectrum, partial(_create_spectrum, own, plan), volatile=["lit"])
        more = plan.recovery, plan.spectrum_chunk
        units += column_groups("recover", segment, run, plan.column_group, recover_group, *more)
    recovered = read_samples(executor, "recover", segments, units)
    for each in recovered:
        stores.write_region(each.segment.of(run).spectrum, "lit", (slice(None),), each.inspection.lit)
    return recovered


def _create_spectrum(run: Run, plan: Plan) -> None:
    collection = plan.geometry.collection
    stores.create(
        run.spectrum, stores.SPECTRUM, sizes={}, attrs={"title": collection.title}, overwrite=True,
        coords={"doppler": plan.recovery.doppler.values, "range_frequency": collection.range_frequency},
        variables={"lit": np.full(collection.n_pulse, np.nan)},
        chunks=dict(zip(("doppler", "range_frequency"), plan.spectrum_chunk, strict=True)),
    )  # fmt: skip


def gate_ranges(executor: Executor, recovered: Sequence[ReadSegment], run: Run) -> list[Receipt]:
    """Gate spectra in range for all sub-blocks, into gated/; nothing without sub-blocks."""
    units: list[Unit] = []
    for segment, receipts, *_ in recovered:
        plan, own = planned(segment), segment.of(run)
        targets = [
            Gated(block.name, block.range_gate, block.first_bin, plan.gated_bins(block)[0], plan.gated_chunk(block))
            for block in plan.blocks
            if block.range_gate is not None
        ]
        if not targets:
            continue
        for block in plan.blocks:
            run.establish(own.gated(block.name), partial(_create_gated, own, plan, block))
        spectrum = _whole_spectrum(plan, own, written_parts(receipts))
        for bins in plan.gate_spans():
            some = [target.within(*bins) for target in targets if target.common(*bins)[0] < target.common(*bins)[1]]
            name = own.unit_of_segment(f"bins-{bins[0]}")
            arguments = bins, spectrum.within(*bins), some
            units.append(Unit("gate", own, name, gate_bins, arguments, title=f"range-gate of {name}"))
    return executor.run_units("gate", units, per_worker=2) if units else []


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


def _whole_spectrum(plan: Plan, run: Run, parts: Parts) -> SpectrumChunks:
    shape = plan.recovery.doppler.size, plan.geometry.collection.n_range_frequency
    written = parts[run.name_of(run.spectrum)]
    return SpectrumChunks.of(run.spectrum, written, shape=shape, chunk=plan.spectrum_chunk, recovered=True)


def _gated_spectrum(plan: Plan, run: Run, block: BlockPlan, parts: Parts) -> SpectrumChunks:
    first, last = plan.gated_bins(block)
    store = run.gated(block.name)
    return SpectrumChunks.of(
        store, parts[run.name_of(store)], first_bin=first, chunk=plan.gated_chunk(block),
        shape=(last - first, block.sampling.range_frequency.size),
    )  # fmt: skip


def focus_blocks(
    executor: Executor, recovered: Sequence[ReadSegment], run: Run, receipts: Sequence[Receipt]
) -> list[Receipt]:
    """Focus every block, from its segment's spectrum to patches/<block>, each by its own chain of tasks.

    The receipts of recovery and of the range gates have the checksums of spectra.
    """
    # Create all patches here, before the first task: a late task of a lost worker must not empty a store that another
    # task has written to.
    blocks = [(each, block) for each in recovered for block in planned(each.segment).blocks]
    grid = planned(recovered[0].segment).grid
    for _, block in blocks:
        run.establish(run.patch(block.name), partial(_create_patch, run, block, grid))
    chunks = [touched_chunks(block.ground, grid) for _, block in blocks]
    touching = Counter(cell for cells in chunks for cell in cells)
    parts, spectra = written_parts(receipts), dict[int | None, SpectrumChunks]()
    units: list[Unit] = []
    for position, ((each, block), cells) in enumerate(zip(blocks, chunks, strict=True)):
        segment = each.segment
        plan, own, number = planned(segment), segment.of(run), segment.number
        if block.range_gate is not None:
            slab = _gated_spectrum(plan, own, block, parts)
        else:
            slab = spectra[number] = spectra.get(number) or _whole_spectrum(plan, own, parts)
        alone = frozenset(cell for cell in cells if touching[cell] == 1)
        ground = replace(block.ground, valid=each.inspection.lit)
        patch = Patch(ground=ground, grid=plan.grid, own=alone, noise=each.noise)
        units.append(_chain(own, block, slab, patch, -position))
    return executor.run_units("focus", units)


def _create_patch(run: Run, block: BlockPlan, grid: Grid) -> None:
    first_y, first_x, n_y, n_x = patch_window(block.ground, grid)
    side = image_chunk(grid)
    stores.create(
        run.patch(block.name), stores.PATCH, sizes={}, attrs={"title": f"block {block.name}"}, overwrite=True,
        coords={"x": grid.x[first_x : first_x + n_x], "y": grid.y[first_y : first_y + n_y]},
        chunks={"y": side[0], "x": side[1]},
    )  # fmt: skip


def _chain(run: Run, block: BlockPlan, spectrum: SpectrumChunks, patch: Patch, priority: int) -> Unit:
    """Make the unit of a block: its last task, with the tasks before it.

    All have the priority of the block: a worker finishes the chain that it has begun before it starts another.
    """

    def task(step: str, function: Callable[..., Any], *arguments: Any, after: tuple[Unit, ...] = ()) -> Unit:
        title = f"{step} of block {block.name}"
        return Unit(step, run, block_unit(block.name), function, arguments, after, title=title, priority=priority)

    first, *rest = block.stages
    slab = spectrum.within(block.first_bin, block.first_bin + block.n_bin)
    node = task(f"read-slab+{first.name}", read_slab, block, first, slab)
    for stage in rest:
        node = task(stage.name, run_stage, block, stage, after=(node,))
    return task("geometric-correction", write_patch, block, patch, after=(node,))


def discard_spectra(segments: Sequence[Segment], run: Run, receipts: Sequence[Receipt]) -> None:
    """Remove the recovered spectra and the gated ones."""
    for segment in segments:
        own = segment.of(run)
        own.discard(own.spectrum, receipts)
        for block in planned(segment).blocks:
            if block.range_gate is not None:
                own.discard(own.gated(block.name), receipts)


def mosaic(executor: Executor, recovered: Sequence[ReadSegment], run: Run, patches: Sequence[Receipt]) -> list[Receipt]:
    """Merge patches into image.zarr, one output chunk at a time, where several blocks may own pixels.

    Chunks that only one block touches are there already; those that no block covers are not written.
    """
    segments = [each.segment for each in recovered]
    grid = planned(segments[0]).grid
    cells = {
        cell: [part for part, _ in parts]
        for cell, parts in _patch_chunks(segments, run, patches).items()
        if not all(complete for _, complete in parts)
    }
    known = {each.segment.number or 0: each.noise for each in recovered if each.noise is not None}
    ordered = sorted(cells)
    units = []
    for first, end in chunk_spans(0, len(ordered), MOSAIC_CHUNKS):
        group = {cell: cells[cell] for cell in ordered[first:end]}
        margins = {cell: _margins(segments, cell, grid, parts) for cell, parts in group.items()}
        name = "chunk-{}-{}".format(*ordered[first])
        arguments = group, grid, margins, known
        units.append(Unit("mosaic", run, name, merge_chunks, arguments, title=f"mosaic of {name}"))
    return executor.run_units("mosaic", units, per_worker=2)


def layers_of_blocks(
    executor: Executor, segments: Sequence[Segment], run: Run, patches: Sequence[Receipt]
) -> list[Receipt]:
    """Add the layers of a terrain to the chunks of the image that blocks cover; nothing on the plane."""
    seen_by = {block.index: segment.number or 0 for segment in segments for block in planned(segment).blocks}
    cells = {
        cell: {part.block: seen_by[part.block] for part, _ in parts}
        for cell, parts in _patch_chunks(segments, run, patches).items()
    }
    return layers_of_chunks(executor, segments, run, planned(segments[0]).grid, cells)


def _patch_chunks(
    segments: Sequence[Segment], run: Run, patches: Sequence[Receipt]
) -> dict[tuple[int, int], list[tuple[PatchChunk, bool]]]:
    """Map output chunks, by row and column, to their parts; each with whether it is already written to the image."""
    side = image_chunk(planned(segments[0]).grid)
    cells: dict[tuple[int, int], list[tuple[PatchChunk, bool]]] = {}
    blocks = [(segment, block) for segment in segments for block in planned(segment).blocks]
    for (segment, block), receipt in zip(blocks, patches, strict=True):
        assert receipt.origin is not None
        first_y, first_x = receipt.origin
        patch = run.name_of(run.patch(block.name))
        complete = {part.region for part in receipt.written if part.store != patch and part.variable == "image"}
        for part in receipt.written:
            (y, y_end), (x, x_end) = part.region
            region = ((first_y + y, first_y + y_end), (first_x + x, first_x + x_end))
            if part.store != patch:
                continue
            cell = ((first_y + y) // side[0], (first_x + x) // side[1])
            chunk = PatchChunk(
                block.index, block.name, (first_y, first_x), part.checksum, segment.number or 0, segment.collection
            )
            cells.setdefault(cell, []).append((chunk, region in complete))
    return cells


def _margins(
    segments: Sequence[Segment], cell: tuple[int, int], grid: Grid, parts: Sequence[PatchChunk]
) -> dict[int, FloatArray]:
    """Margins of the segments that cover parts of an output chunk; empty if there is only one segment."""
    numbers = sorted({part.segment for part in parts})
    if len(numbers) == 1:
        return {}
    rows, columns = chunk_window(cell, grid)
    return {
        segment.number: margins_over(segment.geometry, grid.x[columns], grid.y[rows])
        for segment in segments
        if segment.number is not None and segment.number in numbers
    }
