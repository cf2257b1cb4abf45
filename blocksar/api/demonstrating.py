"""demo: simulate the paper's scene, focus it, measure it, draw it."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

from blocksar.api.describing import disk_size
from blocksar.api.focusing import focus
from blocksar.api.measuring import measure
from blocksar.api.reporting import report
from blocksar.api.sources import simulate
from blocksar.application.reports import Report
from blocksar.application.target_files import targets_of
from blocksar.errors import InputError, library_for
from blocksar.graph import compiling, recording
from blocksar.measurement.figures import TABLE3
from blocksar.measurement.response import Response
from blocksar.places import Location, place
from blocksar.places.local import LocalPlace
from blocksar.places.place import Place, check_room
from blocksar.planning import effort
from blocksar.progress import Wanted as Progress
from blocksar.progress import as_listener
from blocksar.runs import demonstration
from blocksar.runs.finished import FinishedRun
from blocksar.texts import size_text


def demo(
    out: Location,
    *,
    workers: int | None = None,
    threads: int | None = None,
    memory_limit: int | str | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
    performance_report: str | Path | None = None,
) -> Report:
    """Simulate the shipped scene "table1", focus it in three blocks, measure it, and draw it.

    Leaves a run folder that also holds quality.json, mosaic.png, contours.png and report.html, but not the spectrum and
    the patches that `focus` leaves: 0.3 GB, and 0.6 GB while it runs.

    Parameters
    ----------
    out : path
        Run folder.
    workers : int, optional
        Processes of the local cluster. Default: the number of cores, or cores / threads, at most 4.
    threads : int, optional
        Threads of each worker. Default: cores / workers, at least 1.
    memory_limit : int or str, optional
        Memory of each worker, bytes or a text such as "2GiB". Default: its share of the machine's memory.
    overwrite : bool
        Simulate and focus anew. Default: False.
    progress : object with a method update(stage, done, total), or False, optional
        As in `focus`. Default: bars in a notebook, silence elsewhere.
    performance_report : path, optional
        HTML file for dask's performance report, also written if the run fails. Default: none.

    Returns
    -------
    Report
        `tables` and `result` are those of `quality`.

    Raises
    ------
    InputError
        If `out` holds something other than a demonstration, or a library is not installed.
    ProcessingError
        If processing fails; the same call resumes.
    """
    listener = as_listener(progress)
    if performance_report is not None:
        recording.check_recordable(Path(performance_report), None)
    folder = place(out)
    history = folder / demonstration.HISTORY
    if isinstance(folder, LocalPlace) and folder.exists() and not folder.path.is_dir():
        raise InputError(f"{folder} is not a folder; choose another --out")
    if folder.names() and not history.exists():
        raise InputError(f"{folder} exists and is not a demonstration run; choose another --out")
    simulated = history.exists() and not overwrite
    if not simulated:
        check_room(folder, demonstration.ROOM - folder.taken())
        listener.note(f"{folder} will take 0.3 GB, and 0.6 GB while the demonstration runs")
    listener.expect(effort.of_demo(simulated=simulated, compiled=compiling.kernels_cached(compiling.DEMO)), 1)
    listener.update("compile", 0, 1)
    compiling.compile_missing(compiling.DEMO, listener=listener)
    listener.update("compile", 1, 1)
    if not simulated:
        simulate(demonstration.SCENE, history, threads=threads, overwrite=overwrite, progress=listener)
    focused = focus(
        history, folder, blocks=demonstration.BLOCKS, grid=demonstration.GRID, workers=workers, threads=threads,
        memory_limit=memory_limit, overwrite=overwrite, discard=True, progress=listener,
        performance_report=performance_report,
    )  # fmt: skip
    listener.expect(effort.FOCUS, 1)  # withdraw stages of `focus` that a finished run did not need
    listener.update("measure", 0, 1)
    quality, responses = measure(folder, None, reference=False)
    listener.update("measure", 1, 1)
    listener.update("draw", 0, 1)
    pictures = _draw(folder, responses)
    listener.update("draw", 1, 1)
    page = report(folder, progress=listener)
    lines = [*quality.summary, *focused.summary, f"pictures: {', '.join(str(p) for p in pictures)}"]
    lines.append(f"report: {page.result}, for a browser")
    if (size := disk_size(folder)) is not None:
        lines.append(
            f"{folder} takes {size_text(size)}: `focus` keeps spectrum and patches too, unless --discard is given, "
            "and proposes a grid of 1 m"
        )
    return Report(
        tables=quality.tables, details=quality.details, definitions=quality.definitions, summary=lines,
        result=quality.result,
    )  # fmt: skip


def _draw(folder: Place, responses: Sequence[Response]) -> list[Place]:
    """Draw the mosaic and the contours of responses into a run folder; return the pictures."""
    with library_for("pictures need", "plots"):
        from blocksar.products.pictures.blocks import plot_mosaic  # optional, and slow to load
        from blocksar.products.pictures.responses import plot_contours
    run = FinishedRun.open(folder)
    with tempfile.TemporaryDirectory() as scratch:
        pictures = [Path(scratch, "mosaic.png"), Path(scratch, "contours.png")]
        plot_mosaic(
            run.read, run.x, run.y, pictures[0], read_block=run.read_block, targets=targets_of(None, run.attrs),
            labels=list(TABLE3), title=str(run.attrs.get("title", "")),
        )  # fmt: skip
        plot_contours(responses, pictures[1], title="impulse responses of the nine named targets")
        for picture in pictures:
            (folder / picture.name).write_bytes(picture.read_bytes())
    return [folder / picture.name for picture in pictures]
