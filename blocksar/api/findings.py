"""Findings in the samples of a run's collections: warnings, counts, and how they fit track and beam."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from functools import cache, partial
from itertools import chain
from typing import NamedTuple

from blocksar import stores
from blocksar.api.checking import check_samples, refuse_real
from blocksar.api.jobs import Job
from blocksar.collection.track_shape import find_flaw
from blocksar.errors import InputError
from blocksar.focusing.interference import Interference
from blocksar.graph.reading import CUT
from blocksar.graph.segments import Segment, by_collection
from blocksar.graph.stages import Recovered
from blocksar.inspection import centroid, samples
from blocksar.inspection.samples import Inspection
from blocksar.processors import PROCESSORS
from blocksar.progress import Listener
from blocksar.runs.record import CentroidError, RunRecord, SampleCounts

MANY_MISSING = 0.02  # of the samples, from which on the image may be worse than predicted
Check = tuple[str | None, str]  # of a collection's samples: a warning, or a sentence that all is well


@contextmanager
def checking(job: Job, *, beside: bool) -> Iterator[Callable[[], list[Check]]]:
    """Check the samples of all collections, in a thread if `beside`: a function that waits for what was found.

    Otherwise they are checked when that function is called first.
    """
    if not beside:
        yield check_later(job)
        return
    with ThreadPoolExecutor(1) as pool:
        yield pool.submit(_check_collections, job).result


def check_later(job: Job) -> Callable[[], list[Check]]:
    """A function that checks the samples of all collections when it is called first."""
    return cache(partial(_check_collections, job))


def add_findings(
    job: Job, record: RunRecord, read: Sequence[Recovered], checked: Callable[[], list[Check]], listener: Listener
) -> RunRecord:
    """Add the findings of the inspections of all segments to the record, and those of the checks.

    Raises
    ------
    InputError
        If no sample of a collection is valid.
    """
    read_of, several = dict(zip(job.segments, read, strict=True)), len(job.request.histories) > 1
    exact = _universal(job)
    told = [
        _of_collection(
            number, [(segment, read_of[segment]) for segment in segments], checked, several=several, exact=exact
        )
        for number, segments in enumerate(by_collection(job.segments).values())
    ]
    warnings = (*chain.from_iterable(each.warnings for each in told), *job.left_out())
    for warning in warnings:
        listener.note(warning, again=True)
    offsets = chain.from_iterable(each.offsets for each in told)
    return replace(
        record, warnings=warnings, check="; ".join(each.check for each in told if each.check),
        samples=SampleCounts(sum(each.missing for each in told), sum(each.impossible for each in told)),
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
    read: Sequence[tuple[Segment, Recovered]],
    checked: Callable[[], list[Check]],
    *,
    several: bool,
    exact: bool,
) -> _Told:
    """Find what the inspections of a collection's segments tell, then its check; of one of `several`, with its path.

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
    """Whether the processor takes any track."""
    return PROCESSORS.get(job.plan.processor).universal


def without_samples(history: stores.PhaseHistory, *, zeros: bool) -> str:
    """Say what is wrong with a phase history that has no valid sample, or none but zeros."""
    wrong = (
        "holds zeros only; write it again from its source" if zeros else "holds no valid sample; is it the right store?"
    )
    return f"{history.variable} in {history.label} {wrong}"


def _inspections(segments: Sequence[Segment], read: Sequence[Recovered]) -> list[Inspection]:
    """The inspections of a collection: of its raw echo, if it is one, and of its samples."""
    echoes = [
        Inspection.from_dict({name: value for name, value in receipt.found.items() if name != CUT})
        for each in read
        for receipt in each.receipts
        if receipt.found and receipt.stage == "range-compress"
    ]
    parts = [(segment.pulses or (0, 0))[0] for segment in segments]
    inspection = read[0].inspection
    if len(segments) > 1 or segments[0].pulses:
        whole = segments[0].source.collection.n_pulse
        inspection = samples.join_segments(list(zip(parts, (r.inspection for r in read), strict=True)), whole)
    return [samples.merge_echoes(echoes), inspection] if echoes else [inspection]


def _of_interference(segment: Segment, read: Sequence[Recovered]) -> list[str]:
    """Say what interference was cut from a collection, if it was looked for."""
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
    """Compare prominent places with what is said of the samples.

    Of several segments of a collection, in the middle one. Nothing of a look: its samples saw the whole beam.
    """
    if segments[0].source.part_of_a_beam:
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
