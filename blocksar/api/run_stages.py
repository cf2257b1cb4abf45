"""The stages of a run, in order: from a folder that is claimed and a job that is planned to the record at the end."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

from blocksar import stores
from blocksar.api.findings import Check, add_findings, checking
from blocksar.api.jobs import Job
from blocksar.graph import cluster, compiling, recording, stages
from blocksar.graph.segments import Segment
from blocksar.graph.stages import Recovered
from blocksar.planning.tiling import image_chunk
from blocksar.progress import NOBODY, Listener
from blocksar.runs import folder as run_folder
from blocksar.runs.receipts import Run
from blocksar.runs.record import FINISHED, Receipt, RunRecord
from blocksar.version import __version__

if TYPE_CHECKING:
    from distributed import Client


def carry_out(
    job: Job,
    run: Run,
    record: RunRecord,
    client: Client | None,
    listener: Listener,
    profile: Path | None,
    *,
    resumed: bool,
) -> RunRecord:
    """Carry out a run and return its final record. Without a client, a local cluster is started."""
    started = time.perf_counter()
    with ExitStack() as stack:
        input_read = (lambda: None) if resumed else stack.enter_context(run_folder.begin(run.folder))
        run.folder.sweep()
        record.write(run.folder)
        job = job.with_stored_input()
        projected = job.exact or any(plan.completed for plan in job.plans)
        on_terrain = job.request.terrain is not None
        blends = any(plan.blends for plan in job.plans)
        optional = (compiling.PROJECTION, projected), (compiling.TERRAIN, on_terrain), (compiling.WEIGHTS, blends)
        compiling.compile_missing(name for names, used in optional if used for name in names)
        if client is None:
            scratch = run_folder.scratch(run.folder)
            client = stack.enter_context(
                cluster.open_client(**job.machine._asdict(), scratch=scratch, listener=listener)
            )
        if (address := recording.dashboard(client)) is not None:
            listener.dashboard(address)
        with recording.record_performance(client, profile, listener):
            # Beside the first stage: the check takes a few samples, and the stage's tasks run in other processes.
            checked = stack.enter_context(checking(job, beside=not cluster.is_here(client)))
            record = _run_stages(client, job, run, record, checked, listener, input_read)
        listener.watch((), NOBODY)
        listener.begin("finish")
    record = replace(
        record,
        status=FINISHED,
        timings={**record.timings, "total": time.perf_counter() - started},
        peak_memory=max(receipt.peak_memory or 0 for receipt in record.receipts),
    )
    run_folder.finish(run.folder, record)
    if job.request.discard:
        run_folder.discard_intermediate(run.folder)
    listener.update("finish", 1, 1)
    return record


def _run_stages(
    client: Client,
    job: Job,
    run: Run,
    record: RunRecord,
    checked: Callable[[], list[Check]],
    listener: Listener,
    input_read: Callable[[], None],
) -> RunRecord:
    """Carry out all stages; return the record with their receipts and durations, and the findings in the samples.

    Calls `input_read` once all of the input has been read and accepted.
    """
    clock = [time.perf_counter()]

    def lap() -> float:
        clock.append(time.perf_counter())
        return clock[-1] - clock[-2]

    for segment in job.segments:
        own = segment.of(run)
        run.establish(own.described, partial(_write_collection, own, segment))
    for heights, path in ((job.request.terrain, run.terrain), (job.request.surroundings, run.surroundings)):
        if heights is not None:
            run.establish(path, partial(stores.write_terrain, path, heights))
    timings: dict[str, float] = {}
    segments, compressed = stages.compress_raw(client, job.segments, run, listener)
    if job.exact:
        inspected = stages.inspect_samples(client, segments, run, listener)
        read = _joined(compressed, inspected)
        timings["inspect"] = lap()
        record = add_findings(job, record, read, checked, listener)
        run.establish(run.image, lambda: _create_image(run, job, record))
        timings["check"] = lap()
        input_read()
        weighting = job.request.weighting
        noises = job.noises([each.inspection.lit for each in read])
        inspections = [inspection for _, inspection in read]
        formed = stages.back_project(client, segments, job.grid, inspections, weighting, noises, run, listener)
        timings["backprojection"] = lap()
        return replace(record, receipts=(*_receipts_of(read), *formed), timings=timings)
    recovered = _joined(compressed, stages.recover(client, segments, run, listener))
    timings["recover"] = lap()
    record = add_findings(job, record, recovered, checked, listener)
    run.establish(run.image, lambda: _create_image(run, job, record))
    timings["check"] = lap()
    reads_later = any(plan.completed for plan in job.plans)  # the edges of dwells, from the samples
    if not reads_later:
        input_read()
    gated = stages.gate_ranges(client, segments, run, recovered, listener)
    if any(gated):
        timings["gate"] = lap()
    receipts = [(*each.receipts, *some) for each, some in zip(recovered, gated, strict=True)]
    inspections = [each.inspection for each in recovered]
    noises = job.noises([inspection.lit for inspection in inspections])
    focused = stages.focus_blocks(client, segments, run, receipts, inspections, noises, listener)
    timings["focus"] = lap()
    if reads_later:
        input_read()
    if job.request.discard:
        for segment, some in zip(segments, receipts, strict=True):
            own = segment.of(run)
            own.discard(own.spectrum, some)
            for block in segment.planned.blocks:
                if block.range_gate is not None:
                    own.discard(own.gated(block.name), some)
    merged = stages.mosaic(client, segments, run, focused, noises, listener)
    timings["mosaic"] = lap()
    every = (*_receipts_of(recovered), *chain(*gated), *focused.patches, *merged)
    return replace(record, receipts=every, timings=timings)


def _write_collection(run: Run, segment: Segment) -> None:
    stores.write_collection(run.described, segment.history.collection, segment.source.attrs)


def _joined(compressed: Sequence[Sequence[Receipt]], read: Sequence[Recovered]) -> list[Recovered]:
    """The receipts of range compression, and those of the samples that it led to."""
    return [Recovered([*some, *each.receipts], each.inspection) for some, each in zip(compressed, read, strict=True)]


def _receipts_of(read: Sequence[Recovered]) -> list[Receipt]:
    return [receipt for each in read for receipt in each.receipts]


def _create_image(run: Run, job: Job, record: RunRecord) -> None:
    """Create image.zarr, without pixels."""
    side, attrs = image_chunk(job.grid), job.history.attrs
    title = attrs.get("title") or job.history.collection.title or "blocksar image"
    attributes = {
        "title": title,
        "Conventions": stores.CONVENTIONS,
        "history": stores.history_line(f"focused by blocksar {__version__}", attrs.get("history")),
        "source": str(job.history.path),
        "settings": record.settings,
        "run": run.identity,
        "carrier_frequency": job.history.collection.carrier,
        "ground_height": job.history.collection.ground_height,
        "calibration": "a target of reflectivity 1 peaks at 1 + 0j",
        "predicted": [block.as_json() for block in record.plan.predicted],
        "warnings": list(record.warnings),
        "scene": attrs.get("scene", ""),
    }
    if "georeference" in attrs:
        attributes["georeference"] = attrs["georeference"]
    several = len(job.request.histories) > 1
    if several:
        attributes |= {"source": [str(history.path) for history in job.request.histories], "scene": ""}
    if job.request.terrain is not None:
        attributes["terrain"] = job.request.ground.describe(job.request.terrain)
    schema = {
        **stores.IMAGE,
        **(stores.COLLECTION_NUMBER if several else {}),
        **(stores.NOISE if all(segment.source.collection.noise_power for segment in job.segments) else {}),
        **(stores.ON_TERRAIN if job.request.terrain is not None else {}),
    }
    stores.create(
        run.image, schema, sizes={}, coords={"x": job.grid.x, "y": job.grid.y}, attrs=attributes,
        chunks={"y": side[0], "x": side[1]}, overwrite=True,
    )  # fmt: skip
