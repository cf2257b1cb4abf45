"""The stages of a run, in order: from a folder that is claimed and a job that is planned to the record at the end."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
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
from blocksar.loop_cache import compilation_seconds
from blocksar.planning.tiling import image_chunk
from blocksar.progress import NOBODY, Listener
from blocksar.runs import folder as run_folder
from blocksar.runs.receipts import Run
from blocksar.runs.record import FINISHED, Receipt, RunRecord
from blocksar.version import __version__

if TYPE_CHECKING:
    from distributed import Client

UNCOVERED = "no pixel of the image is covered: look where the swath lies (blocksar preview), and give that --grid"


def carry_out(
    job: Job,
    run: Run,
    record: RunRecord,
    client: Client | cluster.Starting | None,
    listener: Listener,
    profile: Path | None,
    *,
    resumed: bool,
    compiled: float,
) -> RunRecord:
    """Carry out a run and return its final record, by a client, or a local cluster: one that is starting, or its own.

    The local cluster has ended when the record is written. Loops that were compiled since `compilation_seconds` was
    `compiled` count in its time, also those from before.
    """
    started = time.perf_counter() - (compilation_seconds() - compiled)
    with ExitStack() as stack:
        input_read = stack.enter_context(run_folder.begin(run.folder, resumed=resumed))
        run.folder.sweep()
        record.write(run.folder)
        job = job.with_stored_input()
        projected = job.exact or any(plan.completed for plan in job.plans)
        on_terrain = job.request.terrain is not None
        blends = any(plan.blends for plan in job.plans)
        optional = (compiling.PATTERNS, projected), (compiling.TERRAIN, on_terrain), (compiling.WEIGHTS, blends)
        needed = (name for names, used in optional if used for name in names)
        compiling.compile_missing(needed, by="others" if cluster.is_here(client) else "all")
        if client is None:
            scratch = run_folder.scratch(run.folder)
            client = cluster.Starting(**job.machine._asdict(), scratch=scratch, listener=listener)
        if isinstance(client, cluster.Starting):
            client = stack.enter_context(client).client()
        if (address := recording.dashboard(client)) is not None:
            listener.dashboard(address)
        with recording.record_performance(client, profile, listener):
            # Beside the first stage: the check takes a few samples, and the stage's tasks run in other processes.
            checked = stack.enter_context(checking(job, beside=not cluster.is_here(client)))
            course = _Course(client=client, job=job, run=run, checked=checked, listener=listener, input_read=input_read)
            record = _run_stages(course, record)
        listener.watch((), NOBODY)
        listener.begin("finish")
    record = replace(
        record,
        status=FINISHED,
        timings={**_compilation(compiled), **record.timings, "total": time.perf_counter() - started},
        peak_memory=max(receipt.peak_memory or 0 for receipt in record.receipts),
    )
    run_folder.finish(run.folder, record)
    if job.request.discard:
        run_folder.discard_intermediate(run.folder)
    listener.update("finish", 1, 1)
    return record


def _compilation(compiled: float) -> dict[str, float]:
    """The seconds in which loops were compiled for a run, if any were."""
    seconds = compilation_seconds() - compiled
    return {"compile": seconds} if seconds else {}


@dataclass(frozen=True, kw_only=True)
class _Course:
    """What the stages of a run share: where they run, for which job, who listens, and how long they have taken."""

    client: Client
    job: Job
    run: Run
    checked: Callable[[], list[Check]]  # the findings in the samples, once they are known
    listener: Listener
    input_read: Callable[[], None]  # to be called once all of the input has been read and accepted
    timings: dict[str, float] = field(default_factory=dict)  # s, of each stage
    started: list[float] = field(default_factory=lambda: [time.perf_counter()])

    def end(self, stage: str) -> None:
        """Note how long a stage has taken since the end of the one before."""
        self.started.append(time.perf_counter())
        self.timings[stage] = self.started[-1] - self.started[-2]

    def accept(self, record: RunRecord, read: Sequence[Recovered]) -> RunRecord:
        """Add what was found in the samples to the record, and create the image without pixels."""
        record = add_findings(self.job, record, read, self.checked, self.listener)
        self.run.establish(self.run.image, lambda: _create_image(self.run, self.job, record))
        self.end("check")
        return record


def _run_stages(course: _Course, record: RunRecord) -> RunRecord:
    """Carry out all stages; return the record with their receipts and durations, and the findings in the samples."""
    job, run = course.job, course.run
    for segment in job.segments:
        own = segment.of(run)
        run.establish(own.described, partial(_write_collection, own, segment))
    for heights, path in ((job.request.terrain, run.terrain), (job.request.surroundings, run.surroundings)):
        if heights is not None:
            run.establish(path, partial(stores.write_terrain, path, heights))
    segments, compressed = stages.compress_raw(course.client, job.segments, run, course.listener)
    form_image = _back_project if job.exact else _focus_blocks
    record, receipts = form_image(course, record, segments, compressed)
    if not any_covered(receipts, run.name_of(run.image)):
        course.listener.note(UNCOVERED, again=True)
        record = replace(record, warnings=(*record.warnings, UNCOVERED))
    return replace(record, receipts=receipts, timings=course.timings)


def any_covered(receipts: Sequence[Receipt], image: str) -> bool:
    """Whether the image of that name has any chunk: those without a covered pixel are not written."""
    written = (part for receipt in receipts for part in receipt.written)
    return any(part.store == image and part.variable == "image" for part in written)


def _back_project(
    course: _Course, record: RunRecord, segments: Sequence[Segment], compressed: Sequence[Sequence[Receipt]]
) -> tuple[RunRecord, tuple[Receipt, ...]]:
    """Form the image by exact back-projection, straight from the samples."""
    client, job, run, listener = course.client, course.job, course.run, course.listener
    read = _joined(compressed, stages.inspect_samples(client, segments, run, listener))
    course.end("inspect")
    record = course.accept(record, read)
    course.input_read()
    inspections = [each.inspection for each in read]
    noises = job.noises([inspection.lit for inspection in inspections])
    formed = stages.back_project(
        client, segments, job.grid, inspections, job.request.weighting, noises, run, listener
    )  # fmt: skip
    course.end("backprojection")
    return record, (*_receipts_of(read), *formed)


def _focus_blocks(
    course: _Course, record: RunRecord, segments: Sequence[Segment], compressed: Sequence[Sequence[Receipt]]
) -> tuple[RunRecord, tuple[Receipt, ...]]:
    """Form the image by a chain: recover the spectrum, focus its blocks, lay them side by side."""
    client, job, run, listener = course.client, course.job, course.run, course.listener
    recovered = _joined(compressed, stages.recover(client, segments, run, listener))
    course.end("recover")
    record = course.accept(record, recovered)
    reads_later = any(plan.completed for plan in job.plans)  # the edges of dwells, from the samples
    if not reads_later:
        course.input_read()
    gated = stages.gate_ranges(client, segments, run, recovered, listener)
    if any(gated):
        course.end("gate")
    receipts = [(*each.receipts, *some) for each, some in zip(recovered, gated, strict=True)]
    inspections = [each.inspection for each in recovered]
    noises = job.noises([inspection.lit for inspection in inspections])
    focused = stages.focus_blocks(
        client, segments, run, receipts, inspections, noises, listener, workers=job.machine.workers
    )
    course.end("focus")
    if reads_later:
        course.input_read()
    if job.request.discard:
        _discard_spectra(run, segments, receipts)
    merged = stages.mosaic(client, segments, run, focused, noises, listener)
    course.end("mosaic")
    return record, (*_receipts_of(recovered), *chain(*gated), *focused.patches, *merged)


def _discard_spectra(run: Run, segments: Sequence[Segment], receipts: Sequence[Sequence[Receipt]]) -> None:
    """Remove the spectra of the whole scene, and what range gates kept of them."""
    for segment, some in zip(segments, receipts, strict=True):
        own = segment.of(run)
        own.discard(own.spectrum, some)
        for block in segment.planned.blocks:
            if block.range_gate is not None:
                own.discard(own.gated(block.name), some)


def _write_collection(run: Run, segment: Segment) -> None:
    stores.write_collection(run.described, segment.history.collection, segment.history.attrs)


def _joined(compressed: Sequence[Sequence[Receipt]], read: Sequence[Recovered]) -> list[Recovered]:
    """The receipts of range compression, and those of the samples that it led to."""
    return [Recovered([*some, *each.receipts], each.inspection) for some, each in zip(compressed, read, strict=True)]


def _receipts_of(read: Sequence[Recovered]) -> list[Receipt]:
    return [receipt for each in read for receipt in each.receipts]


def _create_image(run: Run, job: Job, record: RunRecord) -> None:
    """Create image.zarr, without pixels."""
    side, attrs, terrain = image_chunk(job.grid), job.history.attrs, job.request.terrain
    title = attrs.get("title") or job.history.collection.title or "blocksar image"
    attributes = {
        "title": title,
        "Conventions": stores.CONVENTIONS,
        "history": stores.history_line(f"focused by blocksar {__version__}", attrs.get("history")),
        "source": str(job.history.path),
        "settings": record.settings,
        "run": run.identity,
        "carrier_frequency": job.history.collection.carrier,
        "ground_height": job.history.collection.ground_height if terrain is None else terrain.mean,
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
    if terrain is not None:
        attributes["terrain"] = job.request.ground.describe(terrain)
    schema = {
        **stores.IMAGE,
        **(stores.COLLECTION_NUMBER if several else {}),
        **(stores.NOISE if all(segment.source.collection.noise_power for segment in job.segments) else {}),
        **(stores.ON_TERRAIN if terrain is not None else {}),
    }
    stores.create(
        run.image, schema, sizes={}, coords={"x": job.grid.x, "y": job.grid.y}, attrs=attributes,
        chunks={"y": side[0], "x": side[1]}, overwrite=True,
    )  # fmt: skip
