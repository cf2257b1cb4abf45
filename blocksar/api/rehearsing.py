"""Dry run of `focus`: what it would do, without doing it."""

from __future__ import annotations

from blocksar.api.jobs import Job, Request
from blocksar.api.partial_pulses import recorded_lines
from blocksar.api.room import Beside, needed, remedy
from blocksar.api.shown import RunReport
from blocksar.graph.machine import Resources
from blocksar.places.place import size_text
from blocksar.processors import REFERENCE
from blocksar.processors.lines import time_line, workforce
from blocksar.runs.folder import is_begun
from blocksar.runs.record import RunRecord

NOTHING_DONE = "nothing was done: leave out --dry-run to focus"


def rehearse(request: Request, earlier: RunRecord | None, machine: Resources, beside: Beside) -> RunReport:
    """Say what `focus` would do with a request: its plan, memory, and disk. Writes nothing.

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
            time_line(job.predict_effort(), machine),
            cluster,
            _doing(request, job, earlier, beside),
            NOTHING_DONE,
        ],
        result=None if plan.processor == REFERENCE else plan.result,
    )


def _doing(request: Request, job: Job, earlier: RunRecord | None, beside: Beside) -> str:
    """Find what would be written, and how much room there is for it."""
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
