"""The stages of a run as task graphs: recovery by column group, focusing by block, the mosaic by output chunk.

Tasks receive paths and small constants, write their samples to zarr and return receipts. Keys have the form
`step-run-block`: the dashboard is readable, and no result of another run is reused. A unit of work writes whole chunks
that no other unit writes, then its receipt. A lost worker therefore costs time only, and an interrupted run resumes
from its receipts.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain, islice
from typing import Any, NamedTuple

import numpy as np
from distributed import Client, Future

from blocksar import stores
from blocksar.arrays import FloatArray
from blocksar.chunks import LAYER_CHUNKS, MOSAIC_CHUNKS, TILE
from blocksar.collection.beam import margins_over
from blocksar.collection.collection import Collection
from blocksar.collection.empty_pulses import missing_pulses
from blocksar.collection.grid import Grid
from blocksar.collection.sublooks import whole_beam
from blocksar.errors import InputError, ProcessingError
from blocksar.focusing.noise import NoiseMap
from blocksar.focusing.range_gate import RawCompression
from blocksar.graph.layers import sights_of
from blocksar.graph.patching import Patch, PatchChunk, merge_chunks, write_patch
from blocksar.graph.reading import Gated, gate_bins, inspect_group, prepare_pulses, recover_group
from blocksar.graph.segments import Segment, by_collection
from blocksar.graph.spectrum import SpectrumChunks, Window
from blocksar.graph.tasks import FormParts, Projected, add_layers, form_chunks, read_slab, run_stage
from blocksar.graph.units import Unit, run_units, single_task, spans
from blocksar.inspection.samples import Inspection, merge, refusal
from blocksar.places.place import Place
from blocksar.planning.block import BlockPlan
from blocksar.planning.plan import Plan
from blocksar.planning.tiling import chunk_window, image_chunk, inspection_width, patch_window, touched_chunks
from blocksar.progress import Listener
from blocksar.runs.receipts import Run
from blocksar.runs.record import Receipt, Written, block_unit


class Recovered(NamedTuple):
    """Receipts of a segment's recovered or inspected samples, and their inspection."""

    receipts: list[Receipt]
    inspection: Inspection


def recover(client: Client, segments: Sequence[Segment], run: Run, listener: Listener) -> list[Recovered]:
    """Recover the spectrum of every segment into its spectrum.zarr; return receipts and inspection of each.

    Raises
    ------
    InputError
        If the samples are not those of a radar.
    """
    units: list[list[Unit]] = []
    for segment in segments:
        plan, own = segment.planned, segment.of(run)
        run.establish(own.spectrum, partial(_create_spectrum, own, plan), volatile=["lit"])
        units.append(
            [
                single_task(
                    client,
                    own,
                    "recover",
                    own.unit_of_segment(f"columns-{columns[0]}"),
                    recover_group,
                    segment.history.within(columns=slice(*columns)),
                    columns,
                    plan.recovery,
                    plan.spectrum_chunk,
                )
                for columns in spans(plan.geometry.collection.n_range_frequency, plan.column_group)
            ]
        )
    recovered = _run_read(client, "recover", segments, units, run, listener)
    for segment, each in zip(segments, recovered, strict=True):
        stores.write_region(segment.of(run).spectrum, "lit", (slice(None),), each.inspection.lit)
    return recovered


def _create_spectrum(run: Run, plan: Plan) -> None:
    collection = plan.geometry.collection
    stores.create(
        run.spectrum, stores.SPECTRUM, sizes={}, attrs={"title": collection.title}, overwrite=True,
        coords={"doppler": plan.recovery.doppler.values, "range_frequency": collection.range_frequency},
        variables={"lit": np.full(collection.n_pulse, np.nan)},
        chunks=dict(zip(("doppler", "range_frequency"), plan.spectrum_chunk, strict=True)),
    )  # fmt: skip


def _run_read(
    client: Client,
    stage: str,
    segments: Sequence[Segment],
    units: Sequence[Sequence[Unit]],
    run: Run,
    listener: Listener,
) -> list[Recovered]:
    """Run units that read the samples of segments, and merge the inspections of each segment."""
    reading = [
        unit
        for segment, some in zip(segments, units, strict=True)
        for unit, _ in some
        if segment.history.path != segment.of(run).compressed
    ]
    receipts = iter(run_units(client, stage, list(chain(*units)), run, listener, ahead=True, reading_input=reading))
    groups = [list(islice(receipts, len(some))) for some in units]
    return [
        Recovered(group, without_lost(segment.history, merge_inspections(group)))
        for segment, group in zip(segments, groups, strict=True)
    ]


def gate_ranges(
    client: Client, segments: Sequence[Segment], run: Run, recovered: Sequence[Recovered], listener: Listener
) -> list[list[Receipt]]:
    """Gate the spectra in range for all sub-blocks, into gated/; nothing without sub-blocks. Receipts by segment."""
    units: list[list[Unit]] = []
    for segment, (receipts, _) in zip(segments, recovered, strict=True):
        plan, own = segment.planned, segment.of(run)
        targets = [
            Gated(block.name, block.range_gate, block.first_bin, plan.gated_bins(block)[0], plan.gated_chunk(block))
            for block in plan.blocks
            if block.range_gate is not None
        ]
        units.append([])
        if not targets:
            continue
        for block in plan.blocks:
            run.establish(own.gated(block.name), partial(_create_gated, own, plan, block))
        spectrum = _whole_spectrum(plan, own, receipts)
        for bins in plan.gate_spans():
            some = [target.within(*bins) for target in targets if target.common(*bins)[0] < target.common(*bins)[1]]
            unit = own.unit_of_segment(f"bins-{bins[0]}")
            units[-1].append(single_task(client, own, "gate", unit, gate_bins, bins, spectrum.within(*bins), some))
    flat = list(chain(*units))
    gated = iter(run_units(client, "gate", flat, run, listener, per_worker=2) if flat else [])
    return [list(islice(gated, len(some))) for some in units]


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
    """Find what receipts say was written to a store's spectrum."""
    name = run.name_of(store)
    return [part for receipt in receipts for part in receipt.written if part.store == name]


def _whole_spectrum(plan: Plan, run: Run, receipts: Sequence[Receipt]) -> SpectrumChunks:
    shape = plan.recovery.doppler.size, plan.geometry.collection.n_range_frequency
    written = _written(run, run.spectrum, receipts)
    return SpectrumChunks.of(run.spectrum, written, shape=shape, chunk=plan.spectrum_chunk, recovered=True)


def _gated_spectrum(plan: Plan, run: Run, block: BlockPlan, receipts: Sequence[Receipt]) -> SpectrumChunks:
    first, last = plan.gated_bins(block)
    store = run.gated(block.name)
    return SpectrumChunks.of(
        store, _written(run, store, receipts), first_bin=first, chunk=plan.gated_chunk(block),
        shape=(last - first, block.sampling.range_frequency.size),
    )  # fmt: skip


def focus_blocks(
    client: Client,
    segments: Sequence[Segment],
    run: Run,
    receipts: Sequence[Sequence[Receipt]],
    inspections: Sequence[Inspection],
    noises: Sequence[NoiseMap | None],
    listener: Listener,
) -> list[Receipt]:
    """Focus every block, from its segment's spectrum to patches/<block>, by a chain of tasks of its own.

    For every segment, the receipts of recovery and of the range gates have the checksums of spectra, and the inspection
    the valid fraction of each pulse.
    """
    # Create all patches here, before the first task: a late task of a lost worker must not empty a store that another
    # task has written to.
    blocks = [(number, block) for number, segment in enumerate(segments) for block in segment.planned.blocks]
    for number, block in blocks:
        run.establish(run.patch(block.name), partial(_create_patch, run, block, segments[number].planned.grid))
    chunks = [touched_chunks(block.ground, segments[number].planned.grid) for number, block in blocks]
    touching = Counter(cell for cells in chunks for cell in cells)
    spectra = [
        _whole_spectrum(segment.planned, segment.of(run), some)
        for segment, some in zip(segments, receipts, strict=True)
    ]
    units: list[Unit] = []
    for position, ((number, block), cells) in enumerate(zip(blocks, chunks, strict=True)):
        segment, inspection = segments[number], inspections[number]
        plan, own = segment.planned, segment.of(run)
        alone = frozenset(cell for cell in cells if touching[cell] == 1)
        slab = spectra[number] if block.range_gate is None else _gated_spectrum(plan, own, block, receipts[number])
        patch = Patch(
            ground=replace(block.ground, valid=inspection.lit), grid=plan.grid, own=alone, noise=noises[number]
        )
        units.append(
            (
                block_unit(block.name),
                partial(_submit_chain, client, own, block, slab, patch, -position),
            )
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
    client: Client, run: Run, block: BlockPlan, spectrum: SpectrumChunks, patch: Patch, priority: int
) -> Future[Any]:
    """Submit the tasks of a block; return the future of the last one.

    All have the priority of the block: a worker finishes the chain that it has begun before it starts another.
    """
    unit = block_unit(block.name)
    tail = f"{run.token}-{unit}"
    submit = partial(client.submit, pure=False, priority=priority)
    first, *rest = block.stages
    slab = spectrum.within(block.first_bin, block.first_bin + block.n_bin)
    node = submit(read_slab, run, block, first, slab, key=f"read-slab+{first.name}-{tail}")
    for stage in rest:
        node = submit(run_stage, run, block, stage, node, key=f"{stage.name}-{tail}")
    key = f"geometric-correction-{tail}"
    return submit(write_patch, run, unit, block, node, patch, key=key)


def discard_spectra(segments: Sequence[Segment], run: Run, receipts: Sequence[Sequence[Receipt]]) -> None:
    """Remove the spectra of the whole scene, and what range gates kept of them."""
    for segment, some in zip(segments, receipts, strict=True):
        own = segment.of(run)
        own.discard(own.spectrum, some)
        for block in segment.planned.blocks:
            if block.range_gate is not None:
                own.discard(own.gated(block.name), some)


def mosaic(
    client: Client,
    segments: Sequence[Segment],
    run: Run,
    patches: Sequence[Receipt],
    noises: Sequence[NoiseMap | None],
    listener: Listener,
) -> list[Receipt]:
    """Merge the patches into image.zarr, by output chunk, where several blocks may own pixels.

    Chunks that only one block touches are there already; those that no block covers are not written.
    """
    grid = segments[0].planned.grid
    cells = {
        cell: [part for part, _ in parts]
        for cell, parts in _patch_chunks(segments, run, patches).items()
        if not all(complete for _, complete in parts)
    }
    on_terrain = segments[0].geometry.terrain is not None
    known = {segment.number or 0: noise for segment, noise in zip(segments, noises, strict=True) if noise is not None}
    ordered = sorted(cells)
    units = []
    for first, end in spans(len(ordered), MOSAIC_CHUNKS):
        group = {cell: cells[cell] for cell in ordered[first:end]}
        margins = {cell: _margins(segments, cell, grid, parts) for cell, parts in group.items()}
        row, column = ordered[first]
        unit = f"chunk-{row}-{column}"
        task = merge_chunks, group, grid, margins, known, on_terrain
        units.append(single_task(client, run, "mosaic", unit, *task))
    return run_units(client, "mosaic", units, run, listener, per_worker=2)


def layers_of_blocks(
    client: Client, segments: Sequence[Segment], run: Run, patches: Sequence[Receipt], listener: Listener
) -> list[Receipt]:
    """Add the layers of a terrain to the chunks of the image that blocks cover; nothing on the plane."""
    seen_by = {block.index: segment.number or 0 for segment in segments for block in segment.planned.blocks}
    cells = {
        cell: {part.block: seen_by[part.block] for part, _ in parts}
        for cell, parts in _patch_chunks(segments, run, patches).items()
    }
    return _add_layers(client, segments, run, segments[0].planned.grid, cells, listener)


def layers_of_parts(
    client: Client, segments: Sequence[Segment], run: Run, grid: Grid, formed: Sequence[Receipt], listener: Listener
) -> list[Receipt]:
    """Add the layers of a terrain to the chunks of the image that `form_parts` wrote; nothing on the plane."""
    every = {segment.number or 0: segment.number or 0 for segment in segments}
    image, side = run.name_of(run.image), image_chunk(grid)
    regions = [
        part.region for receipt in formed for part in receipt.written if (part.store, part.variable) == (image, "block")
    ]
    cells = {(rows[0] // side[0], columns[0] // side[1]): every for rows, columns in regions}
    return _add_layers(client, segments, run, grid, cells, listener)


def _add_layers(
    client: Client,
    segments: Sequence[Segment],
    run: Run,
    grid: Grid,
    cells: Mapping[tuple[int, int], Mapping[int, int]],
    listener: Listener,
) -> list[Receipt]:
    """Add layers to chunks of the image, by row and column; of each, the segments that see what owns its pixels."""
    seen = [(segment.number or 0, segment.geometry) for segment in segments if segment.geometry.terrain is not None]
    if not seen:
        return []
    sights, ordered, units = sights_of(run, grid, seen), sorted(cells), []
    for first, end in spans(len(ordered), LAYER_CHUNKS):
        group = ordered[first:end]
        owners = {owner: sights[number] for cell in group for owner, number in cells[cell].items()}
        unit = "layers-{}-{}".format(*group[0])
        units.append(single_task(client, run, "layers", unit, add_layers, group, grid, owners))
    return run_units(client, "layers", units, run, listener, per_worker=2)


def _patch_chunks(
    segments: Sequence[Segment], run: Run, patches: Sequence[Receipt]
) -> dict[tuple[int, int], list[tuple[PatchChunk, bool]]]:
    """By row and column of an output chunk, the parts of it that blocks focused, and whether these are its image."""
    side = image_chunk(segments[0].planned.grid)
    cells: dict[tuple[int, int], list[tuple[PatchChunk, bool]]] = {}
    blocks = [(segment, block) for segment in segments for block in segment.planned.blocks]
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
    """By which margins the segments that cover some of an output chunk saw its ground; nothing if only one does."""
    numbers = sorted({part.segment for part in parts})
    if len(numbers) == 1:
        return {}
    rows, columns = chunk_window(cell, grid)
    return {
        segment.number: margins_over(segment.geometry, grid.x[columns], grid.y[rows])
        for segment in segments
        if segment.number is not None and segment.number in numbers
    }


def inspect_samples(client: Client, segments: Sequence[Segment], run: Run, listener: Listener) -> list[Recovered]:
    """Inspect phase histories that are not recovered.

    Raises
    ------
    InputError
        If the samples are not those of a radar.
    """
    units: list[list[Unit]] = []
    for segment in segments:
        own, history, group = segment.of(run), segment.history, []
        for columns in spans(history.collection.n_range_frequency, inspection_width(history.collection)):
            unit, part = own.unit_of_segment(f"columns-{columns[0]}"), history.within(columns=slice(*columns))
            group.append(single_task(client, own, "inspect", unit, inspect_group, part, columns))
        units.append(group)
    return _run_read(client, "inspect", segments, units, run, listener)


def form_parts(
    client: Client,
    stage: str,
    forms: Sequence[FormParts],
    parts: Mapping[str, Sequence[Window]],
    segments: Sequence[Segment],
    grid: Grid,
    inspections: Sequence[Inspection],
    noises: Sequence[NoiseMap | None],
    run: Run,
    listener: Listener,
    *,
    on: str,
) -> list[Receipt]:
    """Form image.zarr straight from phase histories, each by its form; `parts` are windows, whole chunks, by unit.

    A unit has a CPU for itself, or a worker's GPU: `on` says which.
    """
    sources = [
        Projected(
            segment.history, segment.geometry.over(None), inspection, noise, segment.number or 0, segment.collection,
            form,
        )
        for segment, inspection, noise, form in zip(segments, inspections, noises, forms, strict=True)
    ]  # fmt: skip
    on_terrain = segments[0].geometry.terrain is not None
    units = [
        single_task(client, run, stage, unit, form_chunks, stage, sources, windows, grid, on_terrain, on=on)
        for unit, windows in parts.items()
    ]
    raw = any(segment.history.path == segment.of(run).compressed for segment in segments)
    reading = [] if raw else [unit for unit, _ in units]
    return run_units(client, stage, units, run, listener, reading_input=reading)


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


def without_lost(history: stores.PhaseHistory, inspection: Inspection) -> Inspection:
    """An inspection with those pulses missing that were lost and hold zeros, see `collection.empty_pulses`."""
    lost = missing_pulses(
        inspection.is_empty, inspection.lit > 0, whole_beam(history.collection, history.look),
        lambda pulse: history.read(slice(pulse, pulse + 1), slice(None))[0],
    )  # fmt: skip
    return inspection.without(lost)


def prepare_samples(
    client: Client, segments: Sequence[Segment], run: Run, listener: Listener
) -> tuple[list[Segment], list[list[Receipt]]]:
    """Range-compress raw echoes and cut interference, each collection once, where there is something to do.

    Returns the segments as they are then read, and receipts of each.

    The receipts are those of the segment's whole collection, with its first segment only.
    """
    units: dict[int | None, list[Unit]] = {}
    for number, (first, *_) in by_collection(segments).items():
        raw = first.source.raw
        if raw is None and first.interference is None:
            continue
        own, whole = first.of(run), first.source
        run.establish(own.compressed, partial(_create_compressed, own, whole.collection, raw is not None))
        compression = None if raw is None else RawCompression.of_echo(raw, whole.collection)
        units[number] = [
            single_task(
                client,
                own,
                "interference" if compression is None else "compress",
                own.unit_of_collection(f"pulses-{pulses[0]}"),
                prepare_pulses,
                whole.within(pulses=slice(*pulses)),
                pulses,
                compression,
                first.interference,
            )
            for pulses in spans(whole.collection.n_pulse, TILE[0])
        ]
    if not units:
        return list(segments), [[] for _ in segments]
    flat = list(chain(*units.values()))
    stage = "interference" if all(segment.source.raw is None for segment in segments) else "range-compress"
    done = iter(run_units(client, stage, flat, run, listener, per_worker=2, reading_input=[unit for unit, _ in flat]))
    receipts = {number: list(islice(done, len(some))) for number, some in units.items()}
    try:
        opened = {
            number: replace(stores.open_phase_history(group[0].of(run).compressed).pinned(), look=group[0].source.look)
            for number, group in by_collection(segments).items()
            if number in units
        }
    except InputError as error:  # about the run's own store, not about the input
        raise ProcessingError(str(error)) from error
    ready = [replace(segment, source=opened.get(segment.collection, segment.source)) for segment in segments]
    return ready, [receipts.pop(segment.collection, []) for segment in segments]


def _create_compressed(run: Run, collection: Collection, of_echo: bool) -> None:
    # The noise of an echo is that of its samples, not of the signal's.
    kept = Collection(**{**collection.as_dict(), "noise_power": None}) if of_echo else collection
    stores.create_phase_history(run.compressed, kept, overwrite=True)
