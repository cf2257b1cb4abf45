"""What `focus` would do, without doing it."""

from __future__ import annotations

import shutil
from pathlib import Path

from blocksar.api.facts import size_text
from blocksar.api.jobs import Job, Request
from blocksar.api.partial_pulses import recorded_lines
from blocksar.api.plan_lines import outside_window, plan_lines, time_line, workforce
from blocksar.api.plan_tables import block_table, plan_details
from blocksar.api.shown import RunReport
from blocksar.graph.machine import Resources
from blocksar.places.local import LocalPlace
from blocksar.places.place import Place
from blocksar.planning.disk import exact_bytes, run_bytes
from blocksar.runs.folder import is_begun
from blocksar.runs.record import RunRecord

NOTHING_DONE = "nothing was done: leave out --dry-run to focus"


def rehearse(request: Request, earlier: RunRecord | None, machine: Resources) -> RunReport:
    """Say what `focus` would do with a request: its plan, memory, and disk. Writes nothing.

    `earlier` is the run in the folder that would be resumed, or is finished; `result` is the plan, a tuple of them
    for several segments, None for back-projection or if nothing is left to do.

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
    plans = job.plans
    cluster = (
        f"{workforce(machine)}: {size_text(job.memory)} of memory planned for each, of the "
        f"{size_text(machine.memory_limit)} that it may take"
    )
    written = sum(size for plan in plans for size in run_bytes(plan).values())
    noise = any(history.collection.noise_power for history in request.histories)
    size = written if plans else sum(exact_bytes(job.grid, request.terrain, noise=noise).values())
    return RunReport(
        tables=[block_table(plans)] if plans else [],
        details=plan_details(plans) if plans else [],
        summary=[
            *(line for plan in plans for line in plan_lines(plan)),
            *recorded_lines([segment.geometry for segment in job.segments], job.grid),
            *(outside_window(plans) if plans else []),
            time_line(job.predict_effort(), machine),
            cluster,
            f"{_doing(request, job, earlier)}: about {size_text(size)}{_free(request.folder, size)}",
            NOTHING_DONE,
        ],
        result=None if not plans else plans[0] if len(plans) == 1 else tuple(plans),
    )


def _doing(request: Request, job: Job, earlier: RunRecord | None) -> str:
    if earlier is not None or is_begun(request.folder, job.record()):
        return f"would go on with the unfinished run in {request.folder}"
    replaced = request.overwrite and request.folder.exists() and request.folder.names()
    return f"would replace what is in {request.folder}" if replaced else f"would write {request.folder}"


def _free(folder: Place, size: int) -> str:
    """How much room there is on the disk of a local folder, and a warning if that is too little."""
    if not isinstance(folder, LocalPlace):
        return ""
    there = next(path for path in (folder.path, *folder.path.parents) if path.exists())
    free = shutil.disk_usage(Path(there)).free
    return f", of {size_text(free)} free" + (", which is too little" if free < size else "")
