"""The stages of a run, in order: from a folder that is claimed and a job that is planned to the record at the end.

The record gets the findings in the samples of the run's collections: warnings, counts, and their agreement with track
and beam.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import cache, partial
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

from blocksar import stores
from blocksar.application.checks import check_samples, refuse_real
from blocksar.application.jobs import Job
from blocksar.collection.georeference import Georeference
from blocksar.collection.track_shape import find_flaw
from blocksar.errors import InputError
from blocksar.graph import cluster, compiling, recording
from blocksar.graph.units import Executor, OnCluster, ThisProcess
from blocksar.imaging.interference import Interference
from blocksar.inspection import centroid, samples
from blocksar.inspection.samples import Inspection
from blocksar.loop_cache import compilation_seconds
from blocksar.planning.tiling import image_chunk
from blocksar.processors import PROCESSORS
from blocksar.processors.base import Execution
from blocksar.progress import NOBODY, Listener
from blocksar.runs import folder as run_folder
from blocksar.runs import stored_plan
from blocksar.runs.receipts import Run
from blocksar.runs.record import FINISHED, CentroidError, Receipt, RunRecord, SampleCounts
from blocksar.tasks import preparing
from blocksar.tasks.preparing import CUT, ZERO_GAPS
from blocksar.tasks.pyramid_levels import build_pyramid
from blocksar.tasks.segments import Segment, by_collection
from blocksar.tasks.stages import ReadSegment
from blocksar.version import __version__

MANY_MISSING = 0.02  # of the samples, from which on the image may be worse than predicted
Check = tuple[str | None, str]  # of a collection's samples: a warning, or a sentence that all is well


@contextmanager
def checking(job: Job, *, beside: bool) -> Iterator[Callable[[], list[Check]]]:
    """Yield a function that returns the checks of all collections' samples; `beside`: made in a thread meanwhile.

    Otherwise they are checked when that function is called first.
    """
    if not beside:
        yield check_later(job)
        return
    with ThreadPoolExecutor(1) as pool:
        yield pool.submit(_check_collections, job).result


def check_later(job: Job) -> Callable[[], list[Check]]:
    """Return a function that checks the samples of all collections when it is first called."""
    return cache(partial(_check_collections, job))


def add_findings(
    job: Job, record: RunRecord, read: Sequence[ReadSegment], checked: Callable[[], list[Check]], listener: Listener
) -> RunRecord:
    """Add the findings of inspections and checks of the samples to the record of a run.

    Raises
    ------
    InputError
        If no sample of a collection is valid.
    """
    read_of, several = dict(zip(job.segments, read, strict=True)), len(job.request.histories) > 1
    exact = _universal(job)
    findings = [
        _of_collection(
            number, [(segment, read_of[segment]) for segment in segments], checked, several=several, exact=exact
        )
        for number, segments in enumerate(by_collection(job.segments).values())
    ]
    warnings = (*chain.from_iterable(each.warnings for each in findings), *job.left_out())
    for warning in warnings:
        listener.note(warning, again=True)
    offsets = chain.from_iterable(each.offsets for each in findings)
    return replace(
        record, warnings=warnings, check="; ".join(each.check for each in findings if each.check),
        samples=SampleCounts(sum(each.missing for each in findings), sum(each.impossible for each in findings)),
        doppler_centroid=max(offsets, key=lambda offset: abs(offset.error), default=None),
    )  # fmt: skip


class _Told(NamedTuple):
    """Findings in the samples of a collection; see `RunRecord`."""

    warnings: list[str]
    check: str
    offsets: list[CentroidError]
    missing: int
    impossible: int


def _of_collection(
    number: int,
    read: Sequence[tuple[Segment, ReadSegment]],
    checked: Callable[[], list[Check]],
    *,
    several: bool,
    exact: bool,
) -> _Told:
    """Collect the findings of a collection: inspection of its segments, then its check; with its path if `several`.

    `exact`: for an image that takes any track.

    Raises
    ------
    InputError
        If no sample is valid.
    """
    segments = [segment for segment, _ in read]
    history, inspections = segments[0].source, _inspections(segments, [each for _, each in read])
    if not inspections[-1].lit.any():
        raise InputError(without_samples(history, zeros=False))
    if not inspections[-1].valid:
        raise InputError(without_samples(history, zeros=True))
    lines = _of_interference(segments[0], [each for _, each in read])
    lines += _of_gaps([each for _, each in read])
    lines += [line for each in inspections for line in samples.describe(each)]
    lines += samples.doubts_of_track(history.collection, exact=exact)
    missing, size = sum(inspections[-1].missing.values()), math.prod(history.shape)
    if missing > MANY_MISSING * size and not exact:
        lines.append(
            f"{100 * missing / size:.2g} % of the samples are missing, which the prediction does not know: beside "
            "gaps images differ more from back-projection"
        )
    offsets = []
    for segment, recovered in read:
        offset, disagreement = _compare_centroid(segment, recovered.inspection)
        offsets += [offset] if offset else []
        lines += [disagreement] if disagreement and disagreement not in lines else []
    warning, check = checked()[number]
    lines += [warning] if warning else []
    about = f"{history.path}: " if several else ""
    impossible = sum(each.n_outlier for each in inspections)
    return _Told([about + line for line in lines], about + check if check else "", offsets, missing, impossible)


def _universal(job: Job) -> bool:
    """Tell whether the processor takes any track."""
    return PROCESSORS.get(job.plan.processor).universal


def without_samples(history: stores.PhaseHistory, *, zeros: bool) -> str:
    """Say what is wrong with a phase history that has no valid sample, or none but zeros."""
    wrong = (
        "holds zeros only; write it again from its source" if zeros else "holds no valid sample; is it the right store?"
    )
    return f"{history.variable} in {history.label} {wrong}"


def _inspections(segments: Sequence[Segment], read: Sequence[ReadSegment]) -> list[Inspection]:
    """The inspections of a collection: of its raw echo, if it is one, and of its samples."""
    echoes = _echoes(read)
    parts = [(segment.pulses or (0, 0))[0] for segment in segments]
    inspection = read[0].inspection
    if len(segments) > 1 or segments[0].pulses:
        whole = segments[0].source.collection.n_pulse
        inspection = samples.join_segments(list(zip(parts, (r.inspection for r in read), strict=True)), whole)
    return [samples.merge_echoes(echoes), inspection] if echoes else [inspection]


def _compressed(read: Sequence[ReadSegment]) -> list[dict[str, Any]]:
    """Return the findings of range compression, by group of pulses of a raw echo."""
    receipts = (receipt for each in read for receipt in each.receipts if receipt.stage == "range-compress")
    return [dict(receipt.found) for receipt in receipts if receipt.found]


def _echoes(read: Sequence[ReadSegment]) -> list[Inspection]:
    return [
        Inspection.from_dict({name: value for name, value in found.items() if name not in (CUT, ZERO_GAPS)})
        for found in _compressed(read)
    ]


def _of_gaps(read: Sequence[ReadSegment]) -> list[str]:
    """Describe the gaps in pulses of a raw echo, if there are any."""
    echoes = _echoes(read)
    return samples.describe_gaps(echoes, sum(found.get(ZERO_GAPS, 0) for found in _compressed(read))) if echoes else []


def _of_interference(segment: Segment, read: Sequence[ReadSegment]) -> list[str]:
    """Describe the interference that was cut from a collection, if it was looked for."""
    if segment.interference is None:
        return []
    found = [receipt.found or {} for each in read for receipt in each.receipts]
    cut = [Interference(**some[CUT]) for some in found if CUT in some]
    collection = segment.source.collection
    return [Interference.merge(cut).sentence(segment.interference, collection.carrier + collection.range_frequency)]


def _compare_centroid(segment: Segment, inspection: Inspection) -> tuple[CentroidError | None, str | None]:
    """Compare the measured Doppler centroid with that of track and beam.

    Returns the difference, and a warning if it is large; None where there is nothing to compare.
    """
    if segment.plan is None or segment.source.part_of_a_beam:
        return None, None
    region = segment.plan.region
    expected = centroid.expect(
        segment.geometry, segment.plan.recovery, yaw=region.yaw, near=region.near, far=region.far
    )
    if expected is None:
        return None, None
    measured = centroid.measure_centroid(inspection, prf=segment.geometry.collection.prf)
    return CentroidError(measured.mean_offset, measured.mean_coherence), centroid.disagreement(inspection, expected)


def _check_collections(job: Job) -> list[Check]:
    return [_check_samples(job, segments) for segments in by_collection(job.segments).values()]


def _check_samples(job: Job, segments: Sequence[Segment]) -> Check:
    """Check the samples against the metadata at prominent places of the scene.

    Of several segments of a collection, in the middle one. Nothing of a look, whose samples saw the whole beam, nor of
    a bistatic collection.
    """
    if segments[0].source.part_of_a_beam or segments[0].source.collection.bistatic:
        return None, ""
    refuse_real(segments[0].source)
    if (flaw := find_flaw(segments[0].source.collection)) is not None and flaw.ways > 1:
        return None, ""  # a place has several lines, which a check does not follow
    try:
        middle = segments[len(segments) // 2]
        findings = check_samples(
            middle.history, job.grid, threads=job.machine.threads, thorough=False, terrain=middle.geometry.terrain
        )
    except InputError:
        if not _universal(job):
            raise
        return None, ""  # such processors also form images about the nadir, where yaw has no meaning
    warning = findings.warning()
    return warning, "" if warning else findings.sentence()


UNCOVERED = "no pixel of the image is covered: look where the swath lies (blocksar preview), and give that --grid"


def carry_out(
    job: Job,
    run: Run,
    record: RunRecord,
    workers: Executor | cluster.Starting | None,
    listener: Listener,
    profile: Path | None,
    *,
    resumed: bool,
    compiled: float,
) -> RunRecord:
    """Carry out a run and return its final record, by an executor, or a local cluster, which is starting or its own.

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
            [*job.plan.loops(), *on_terrain, *pyramid],
            "others" if isinstance(workers, ThisProcess) else "all",
            listener,
        )
        if workers is None:
            scratch = run_folder.scratch(run.folder)
            workers = cluster.Starting(**job.machine._asdict(), scratch=scratch, listener=listener)
        if isinstance(workers, cluster.Starting):
            workers = OnCluster(stack.enter_context(workers).client(), listener)
        client = workers.client if isinstance(workers, OnCluster) else None
        if (address := recording.dashboard(client)) is not None:
            listener.dashboard(address)
        with recording.record_performance(client, profile, listener):
            # In parallel with the first stage: the check takes few samples, and the stage's tasks run in other
            # processes.
            in_thread = client is not None and job.request.asked.interference is None
            checked = stack.enter_context(checking(job, beside=in_thread))
            record = _form(job, run, record, workers, checked, input_read)
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
    """Return the seconds in which loops were compiled for a run, if any were."""
    seconds = compilation_seconds() - compiled
    return {"compile": seconds} if seconds else {}


def _form(
    job: Job,
    run: Run,
    record: RunRecord,
    executor: Executor,
    checked: Callable[[], list[Check]],
    input_read: Callable[[], None],
) -> RunRecord:
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

    segments, compressed = preparing.prepare_samples(executor, job.segments, run)
    if job.request.asked.interference is not None:  # check the samples that are imaged
        checked = check_later(replace(job, segments=tuple(segments)))

    def accept_read(stage: str, read: Sequence[ReadSegment]) -> list[ReadSegment]:
        nonlocal record
        end(stage)
        joined = [each._replace(receipts=[*some, *each.receipts]) for some, each in zip(compressed, read, strict=True)]
        record = found = add_findings(job, record, joined, checked, executor.listener)
        run.establish(run.image, lambda: _create_image(run, job, found))
        end("check")
        input_read()
        noises = job.noises([each.inspection.lit for each in joined])
        return [each._replace(noise=noise) for each, noise in zip(joined, noises, strict=True)]

    execution = Execution(
        executor=executor, run=run, segments=segments, weighting=job.request.weighting,
        discard=job.request.asked.discard, accept_read=accept_read, end=end,
    )  # fmt: skip
    receipts = tuple(job.plan.form(execution))
    if levels := build_pyramid(executor, run, job.grid.shape):
        receipts = (*receipts, *levels)
        end("pyramid")
    if not any_covered(receipts, run.name_of(run.image)):
        executor.listener.note(UNCOVERED, again=True)
        record = replace(record, warnings=(*record.warnings, UNCOVERED))
    return replace(record, receipts=receipts, timings=timings)


def any_covered(receipts: Sequence[Receipt], image: str) -> bool:
    """Tell whether any chunk of the image was written: chunks without a covered pixel are not."""
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
        **({} if (factor := stores.calibration_of(attrs)) is None else {stores.CALIBRATION_FACTOR: factor}),
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
    """Pyramid of the image, with its map projection where the frame has one."""
    frame, terrain = Georeference.among(job.history.attrs), job.request.terrain
    height = job.history.collection.ground_height if terrain is None else terrain.mean
    projection = None if frame is None else frame.map_projection(height)
    return stores.pyramid_of(job.grid.x, job.grid.y, projection)
