"""Dry run of `focus`: report what it would do, without doing it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

from blocksar import stores
from blocksar.application.jobs import Job, Request
from blocksar.application.pulses import recorded_lines
from blocksar.application.shown import RunReport
from blocksar.chunks import stored_bytes
from blocksar.errors import InputError
from blocksar.graph.machine import Resources
from blocksar.places.place import no_room_for
from blocksar.planning.disk import Room, room_of_run, with_pyramid
from blocksar.processors import HIERARCHY, PROCESSORS, REFERENCE
from blocksar.processors.sentences import time_line, workforce
from blocksar.runs import folder as run_folder
from blocksar.runs.folder import is_begun
from blocksar.runs.record import RECORD, RunRecord
from blocksar.texts import size_text


def room_of(job: Job) -> Room:
    """Return the disk space that a run takes, starting from an empty folder."""
    request = job.request
    terrain_bytes = 0 if request.surroundings is None else request.surroundings.heights.nbytes
    temporary = len(job.packed)
    for history in {segment.collection: segment.source for segment in job.segments}.values():
        collection = history.collection
        if isinstance(history, stores.DatasetHistory):
            terrain_bytes += stored_bytes(history.shape)
        if history.raw is not None or request.asked.interference is not None:  # written anew first
            temporary += stored_bytes((collection.n_pulse, collection.n_range_frequency))
    stored = with_pyramid(job.plan.stored(), job.grid, request.asked.pyramid)
    return room_of_run(stored, beside=terrain_bytes, temporary=temporary, discard=request.asked.discard)


class RoomBeside(NamedTuple):
    """Disk space that is needed besides a run's own stores.

    Attributes
    ----------
    following : int
        Runs of its size that follow in folders of their own.
    first : int
        Bytes that are written before, and stay as long as it runs.
    """

    following: int = 0
    first: int = 0


def needed(job: Job, beside: RoomBeside, *, resumed: bool) -> int:
    """Return the bytes that must be free for a run and for what is written besides it.

    A resumed run needs what is not there yet. An earlier run that is replaced stays until the input of the new one has
    been read.
    """
    room, folder = room_of(job), job.request.folder
    others = (run_folder.ASIDE, run_folder.TRACK, *run_folder.LEFT_ALONE)
    replaced = resumed or (folder / RECORD).exists()
    there = folder.taken() - sum((folder / name).taken() for name in others) if replaced else 0
    own = room.most - there if resumed else max(room.reading, room.most - there)
    return max(own, 0) + beside.first + beside.following * room.left


def check_room_for_run(job: Job, beside: RoomBeside, *, resumed: bool) -> None:
    """Check that a run fits the disk of its folder; see `needed`.

    Raises
    ------
    NoRoom
        If it does not, with what would make it fit.
    """
    size, free = needed(job, beside, resumed=resumed), job.request.folder.free()
    if free is not None and size > free:
        raise no_room_for(job.request.folder, size, free, remedy(job, beside, free, resumed=resumed))


def remedy(job: Job, beside: RoomBeside, free: int, *, resumed: bool) -> str:
    """Name options with which a run would fit into `free` bytes."""
    fitting = []
    for words, other in _others(job, resumed=resumed):
        for more, tried in ((words, other), (f"{words} --discard", _discarding(other))):
            if (size := needed(tried, beside, resumed=resumed)) <= free:
                fitting.append(f"{more.strip()} ({size_text(size)})")
                break
    if not fitting:
        return "no option but a smaller --grid makes it fit: make room, or choose another --out"
    return f"{' or '.join(fitting)} would fit; else make room, or choose another --out"


def _others(job: Job, *, resumed: bool) -> Iterator[tuple[str, Job]]:
    """Iterate over the job and alternatives that need less disk, such as fewer blocks, each with its options in words.

    A run that is resumed keeps its blocks.
    """
    yield "", job
    if resumed:
        return
    count = max((piece.plan.n_blocks for piece in job.plan.pieces if piece.plan is not None), default=0)
    while (count := count // 2) > 0:
        with suppress(InputError):  # there is no such plan
            fewer = job.request.asking(blocks=count, processor=job.plan.processor)
            yield f"--blocks {count}", Job.of(fewer, None, job.machine)
    if job.plan.processor not in (HIERARCHY, REFERENCE):
        words = f"--processor {HIERARCHY}, {PROCESSORS.get(HIERARCHY).summary},"
        with suppress(InputError):
            other = job.request.asking(processor=HIERARCHY, options={})
            yield words, Job.of(other, None, job.machine)


def _discarding(job: Job) -> Job:
    return replace(job, request=job.request.asking(discard=True))


NOTHING_DONE = "nothing was done: leave out --dry-run to focus"


def rehearse(request: Request, earlier: RunRecord | None, machine: Resources, beside: RoomBeside) -> RunReport:
    """Report what `focus` would do with a request: its plan, memory, and disk. Writes nothing.

    `earlier` is the run in the folder that would be resumed, or is finished; `result` is the plan, a tuple of them
    for several segments, None for exact back-projection or if nothing is left to do.

    Raises
    ------
    InputError
        As `focus`.
    """
    if earlier is not None and earlier.finished:
        return RunReport(
            summary=[f"{request.folder} is finished already with these settings and this input: nothing would be done"]
        )
    job = Job.of(request, earlier, machine)
    plan = job.plan
    cluster = (
        f"{workforce(machine)}: {size_text(job.memory)} of memory planned for each, of the "
        f"{size_text(machine.memory_limit)} that it may take"
    )
    return RunReport(
        tables=plan.tables(),
        details=plan.details(),
        summary=[
            *plan.lines(),
            *recorded_lines([segment.geometry for segment in job.segments], job.grid),
            time_line(job.predict_effort(), machine, plan.stored_bytes()),
            cluster,
            _doing(request, job, earlier, beside),
            NOTHING_DONE,
        ],
        result=None if plan.processor == REFERENCE else plan.result,
    )


def _doing(request: Request, job: Job, earlier: RunRecord | None, beside: RoomBeside) -> str:
    """Describe what would be written, and whether the disk has room for it."""
    folder = request.folder
    resumed = earlier is not None or is_begun(folder, job.record())
    replaced = request.asked.overwrite and folder.exists() and folder.names()
    if resumed:
        doing = f"would go on with the unfinished run in {folder}"
    else:
        doing = f"would replace what is in {folder}" if replaced else f"would write {folder}"
    size, free = needed(job, beside, resumed=resumed), folder.free()
    more = f" for this and {beside.following} more" if beside.following else ""
    line = f"{doing}: about {size_text(size)}{more}"
    if free is None:
        return line
    lacking = f", which is too little: {remedy(job, beside, free, resumed=resumed)}" if free < size else ""
    return f"{line}, of {size_text(free)} free{lacking}"
