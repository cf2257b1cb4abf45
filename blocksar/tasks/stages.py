"""Stages that runs of any processor have, as lists of units: inspection, parts of an image, layers.

Keys have the form `step-run-block`: the dashboard is readable, and no result of another run is reused. A unit of work
writes whole chunks that no other unit writes, then its receipt. A lost worker therefore costs time only, and an
interrupted run resumes from its receipts.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import chain
from typing import NamedTuple

from blocksar import stores
from blocksar.chunks import LAYER_CHUNKS
from blocksar.collection.empty_pulses import missing_pulses
from blocksar.collection.grid import Grid
from blocksar.collection.sublooks import whole_beam
from blocksar.errors import InputError
from blocksar.graph.units import Executor, Unit
from blocksar.imaging.noise import NoiseMap
from blocksar.imaging.terrain_layers import Sight, box_of
from blocksar.inspection.samples import Inspection, merge, refusal
from blocksar.planning.tiling import Window, chunk_spans, image_chunk, inspection_width
from blocksar.runs.receipts import Run
from blocksar.runs.record import Receipt, Written
from blocksar.tasks.forming import FormParts, PixelSource, add_layers, form_chunks
from blocksar.tasks.inspecting import inspect_group
from blocksar.tasks.segments import Segment

Parts = defaultdict[str, list[Written]]  # regions written by units, by store


class ReadSegment(NamedTuple):
    """A segment after its samples were read: recovered or inspected, with its noise where known."""

    segment: Segment
    receipts: list[Receipt]
    inspection: Inspection
    noise: NoiseMap | None = None


def reads_input(segment: Segment, run: Run) -> bool:
    """Tell whether a segment's samples are read from the input, not from the run's own prepared store."""
    return segment.history.path != segment.of(run).compressed


def inspect_samples(executor: Executor, segments: Sequence[Segment], run: Run) -> list[ReadSegment]:
    """Inspect samples that are not recovered.

    Raises
    ------
    InputError
        If the samples are not those of a radar.
    """
    units: list[Unit] = []
    for segment in segments:
        width = inspection_width(segment.history.collection)
        units += column_groups("inspect", segment, run, width, inspect_group)
    return read_samples(executor, "inspect", segments, units)


def column_groups(
    step: str, segment: Segment, run: Run, width: int, task: Callable[..., Receipt], *more: object
) -> list[Unit]:
    """Make the units that read a segment's samples, `width` columns each; `more` are further arguments of the task."""
    own, history, units = segment.of(run), segment.history, []
    for columns in chunk_spans(0, history.collection.n_range_frequency, width):
        name = own.unit_of_segment(f"columns-{columns[0]}")
        arguments = history.within(columns=slice(*columns)), columns, *more
        units.append(Unit(step, own, name, task, arguments, reads_input=reads_input(segment, run)))
    return units


def read_samples(
    executor: Executor, stage: str, segments: Sequence[Segment], units: Sequence[Unit]
) -> list[ReadSegment]:
    """Run units that read the samples of segments, and merge the inspections of each segment."""
    receipts, read = executor.run_units(stage, units, ahead=True), []
    for segment in segments:
        some = [receipt for unit, receipt in zip(units, receipts, strict=True) if unit.run.segment == segment.number]
        read.append(ReadSegment(segment, some, without_lost(segment.history, merge_inspections(some))))
    return read


def written_parts(receipts: Iterable[Receipt]) -> Parts:
    """Collect the written parts of each store from receipts."""
    parts = Parts(list)
    for part in chain.from_iterable(receipt.written for receipt in receipts):
        parts[part.store].append(part)
    return parts


def layers_of_parts(
    executor: Executor, segments: Sequence[Segment], run: Run, grid: Grid, formed: Sequence[Receipt]
) -> list[Receipt]:
    """Add the layers of a terrain to the chunks of the image that `form_parts` wrote; nothing on the plane."""
    every = {segment.number or 0: segment.number or 0 for segment in segments}
    side = image_chunk(grid)
    regions = [part.region for part in written_parts(formed)[run.name_of(run.image)] if part.variable == "block"]
    cells = {(rows[0] // side[0], columns[0] // side[1]): every for rows, columns in regions}
    return layers_of_chunks(executor, segments, run, grid, cells)


def layers_of_chunks(
    executor: Executor,
    segments: Sequence[Segment],
    run: Run,
    grid: Grid,
    cells: Mapping[tuple[int, int], Mapping[int, int]],
) -> list[Receipt]:
    """Add layers to image chunks; `cells` maps row and column to the segment of each owner of pixels there."""
    if not run.on_terrain:
        return []
    limits, ordered, units = stores.StoredTerrain(run.terrain).limits, sorted(cells), []
    box = box_of(grid.x, grid.y)
    sights = {segment.number or 0: Sight.of(segment.geometry, box, limits) for segment in segments}
    for first, end in chunk_spans(0, len(ordered), LAYER_CHUNKS):
        group = ordered[first:end]
        owners = {owner: sights[number] for cell in group for owner, number in cells[cell].items()}
        name = "layers-{}-{}".format(*group[0])
        units.append(Unit("layers", run, name, add_layers, (group, grid, owners), title=f"layers of {name}"))
    return executor.run_units("layers", units, per_worker=2)


def form_parts(
    executor: Executor,
    stage: str,
    forms: Sequence[FormParts],
    parts: Mapping[str, Sequence[Window]],
    read: Sequence[ReadSegment],
    grid: Grid,
    run: Run,
    *,
    on: str,
) -> list[Receipt]:
    """Form image.zarr directly from phase histories by one form each; `parts` maps units to windows of whole chunks.

    A unit has a CPU for itself, or a worker's GPU: `on` says which.
    """
    sources = [
        PixelSource(
            segment.history, segment.geometry.over(None), inspection, noise, segment.number or 0, segment.collection,
            form,
        )
        for (segment, _, inspection, noise), form in zip(read, forms, strict=True)
    ]  # fmt: skip
    reads = all(reads_input(each.segment, run) for each in read)
    units = [
        Unit(stage, run, name, form_chunks, (stage, sources, windows, grid), on=on, reads_input=reads)
        for name, windows in parts.items()
    ]
    return executor.run_units(stage, units)


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
    """Mark pulses as missing in an inspection that were lost and hold zeros, see `collection.empty_pulses`."""
    lost = missing_pulses(
        inspection.is_empty, inspection.lit > 0, whole_beam(history.collection, history.look),
        lambda pulse: history.read(slice(pulse, pulse + 1), slice(None))[0],
    )  # fmt: skip
    return inspection.without(lost)
