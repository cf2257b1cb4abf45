"""The stages of a run, in order: from a folder that is claimed and a job that is planned to the record at the end."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from blocksar import stores
from blocksar.api.findings import Check, add_findings, check_later, checking
from blocksar.api.jobs import Job
from blocksar.collection.georeference import Georeference
from blocksar.errors import InputError
from blocksar.graph import cluster, compiling, recording, stages
from blocksar.graph.pyramid import build_pyramid
from blocksar.graph.segments import Segment
from blocksar.graph.stages import Recovered
from blocksar.loop_cache import compilation_seconds
from blocksar.planning.tiling import image_chunk
from blocksar.processors.base import Execution
from blocksar.progress import NOBODY, Listener
from blocksar.runs import folder as run_folder
from blocksar.runs import stored_plan
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
        stored_plan.write(run.folder, job.packed)
        record.write(run.folder)
        job = job.with_stored_input()
        on_terrain = compiling.TERRAIN if job.request.terrain is not None else ()
        pyramid = compiling.PYRAMID if run.pyramid else ()
        compiling.compile_missing(
            [*job.plan.loops(), *on_terrain, *pyramid], by="others" if cluster.is_here(client) else "all"
        )
        if client is None:
            scratch = run_folder.scratch(run.folder)
            client = cluster.Starting(**job.machine._asdict(), scratch=scratch, listener=listener)
        if isinstance(client, cluster.Starting):
            client = stack.enter_context(client).client()
        if (address := recording.dashboard(client)) is not None:
            listener.dashboard(address)
        with recording.record_performance(client, profile, listener):
            # Beside the first stage: the check takes a few samples, and the stage's tasks run in other processes.
            beside = not cluster.is_here(client) and job.request.asked.interference is None
            checked = stack.enter_context(checking(job, beside=beside))
            record = _form(job, run, record, client, checked, listener, input_read)
        listener.watch((), NOBODY)
        listener.begin("finish")
    record = replace(
        record,
        status=FINISHED,
        timings={**_compilation(compiled), **record.timings, "total": time.perf_counter() - started},
        peak_memory=max(receipt.peak_memory or 0 for receipt in record.receipts),
    )
    run_folder.finish(run.folder, record)
    if job.request.asked.discard:
        run_folder.discard_intermediate(run.folder)
    listener.update("finish", 1, 1)
    return record


def _compilation(compiled: float) -> dict[str, float]:
    """The seconds in which loops were compiled for a run, if any were."""
    seconds = compilation_seconds() - compiled
    return {"compile": seconds} if seconds else {}


def _form(
    job: Job, run: Run, record: RunRecord, client: Client, checked: Callable[[], list[Check]], listener: Listener,
    input_read: Callable[[], None],
) -> RunRecord:  # fmt: skip
    """Form the image; return the record with receipts and durations of all stages, and findings in the samples."""
    for segment in job.segments:
        own = segment.of(run)
        run.establish(own.described, partial(_write_collection, own, segment))
    for heights, path in ((job.request.terrain, run.terrain), (job.request.surroundings, run.surroundings)):
        if heights is not None:
            run.establish(path, partial(stores.write_terrain, path, heights))
    begun, timings = [time.perf_counter()], dict[str, float]()

    def end(stage: str) -> None:
        begun.append(time.perf_counter())
        timings[stage] = begun[-1] - begun[-2]

    def accept(read: Sequence[Recovered]) -> None:
        nonlocal record
        record = found = add_findings(job, record, read, checked, listener)
        run.establish(run.image, lambda: _create_image(run, job, found))
        end("check")

    segments, compressed = stages.prepare_samples(client, job.segments, run, listener)
    if job.request.asked.interference is not None:  # the check is of what is imaged
        checked = check_later(replace(job, segments=tuple(segments)))
    execution = Execution(
        client=client, run=run, listener=listener, segments=segments, compressed=compressed,
        workers=job.machine.workers, weighting=job.request.weighting, discard=job.request.asked.discard, accept=accept,
        input_read=input_read, end=end, noises=job.noises,
    )  # fmt: skip
    receipts = tuple(job.plan.form(execution))
    if levels := build_pyramid(client, run, job.grid.shape, listener):
        receipts = (*receipts, *levels)
        end("pyramid")
    if not any_covered(receipts, run.name_of(run.image)):
        listener.note(UNCOVERED, again=True)
        record = replace(record, warnings=(*record.warnings, UNCOVERED))
    return replace(record, receipts=receipts, timings=timings)


def any_covered(receipts: Sequence[Receipt], image: str) -> bool:
    """Whether the image of that name has any chunk: those without a covered pixel are not written."""
    written = (part for receipt in receipts for part in receipt.written)
    return any(part.store == image and part.variable == "image" for part in written)


def _write_collection(run: Run, segment: Segment) -> None:
    stores.write_collection(run.described, segment.history.collection, segment.history.attrs)


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
        "processor": record.processor,
        **({} if record.plan.coherence is None else {"predicted_coherence": record.plan.coherence}),
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
    pyramid = _pyramid(job) if run.pyramid else None
    stores.create(
        run.image, schema, sizes={}, coords={"x": job.grid.x, "y": job.grid.y},
        attrs=attributes | (pyramid.attrs if pyramid else {}), chunks={"y": side[0], "x": side[1]}, overwrite=True,
        groups=pyramid.groups if pyramid else {},
    )  # fmt: skip


def _pyramid(job: Job) -> stores.Pyramid:
    """Find what creates the pyramid of the image; with its map projection where the frame has one and PROJ is there."""
    frame, terrain = Georeference.among(job.history.attrs), job.request.terrain
    wkt = None
    if frame is not None and not frame.rotation % 360:
        height = job.history.collection.ground_height if terrain is None else terrain.mean
        with suppress(InputError, ImportError):  # PROJ is optional
            wkt = frame.projection(0.0, 0.0, height).to_wkt("WKT2_2019")
    return stores.pyramid_of(job.grid.x, job.grid.y, wkt)
