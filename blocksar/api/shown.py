"""open, report, export, demo: what one does with a finished run."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from blocksar import cluster, effort, geotiff, products, runs, sicd, stores
from blocksar.api.common import Report, finished_record, only_stage, open_run
from blocksar.api.focused import focus
from blocksar.api.measured import measure, targets_of
from blocksar.api.sources import simulate
from blocksar.geometry import Geometry
from blocksar.measurement import TABLE3, Response, as_json, measure_target
from blocksar.parameters import InputError, ProcessingError
from blocksar.places import LocalPlace, Location, Place, place
from blocksar.progress import Updated as Progress
from blocksar.progress import listener

if TYPE_CHECKING:
    import xarray as xr


def open(run: Location) -> xr.Dataset:  # the word of the interface
    """The image of a run as a lazily loaded dataset: `image` and `block` over y and x.

    It follows CF, with a grid mapping if it is georeferenced, and has the accessor `sar` (see `blocksar.accessor`):
    `ds.sar.db()`, `.crop()`, `.plot()`, `.cut()`, `.netcdf()`.

    Raises
    ------
    InputError
        If there is no such store, or the run is not finished. What an unfinished one has may be looked at by its own
        path, RUN/image.zarr.
    """
    from blocksar import accessor  # registers itself, and loads xarray

    folder = place(run)
    if not (folder / "image.zarr").exists():
        return accessor.prepare(stores.open_dataset(folder))
    if (folder / "run.json").exists():
        finished_record(folder)
    return accessor.prepare(stores.open_dataset(folder / "image.zarr"))


def report(
    run: Location, *, out: Location | None = None, overwrite: bool = False, progress: Progress | None = None
) -> Report:
    """Write the report page of a finished run: one HTML file that needs nothing else.

    It shows what RUN/quality.json holds; where there is none, the targets that the run knows are measured now.

    Parameters
    ----------
    out : path, optional
        The page; RUN/report.html by default, which is the run's own and is replaced.
    overwrite : bool
        Replace what stands at `out`.

    Returns
    -------
    Report
        `result` is where the page lies.

    Raises
    ------
    InputError
        If the run is not finished, what it says cannot be read, a library is not installed, or something stands at
        `out`.
    ProcessingError
        If the page cannot be written: what stood there stays.
    """
    folder = place(run)
    target = folder / "report.html" if out is None else place(out)
    if out is not None and target.exists() and not overwrite:
        raise InputError(f"{target} exists; choose another name, or have it overwritten (--overwrite)")
    if isinstance(target, LocalPlace) and target.path.is_dir():
        raise InputError(f"{target} is a folder; give --out the name of a file")
    image, collection, attrs, record = open_run(folder)
    try:
        from blocksar import page  # optional, and slow to load
    except ModuleNotFoundError as error:
        library = str(error.name).partition(".")[0]
        raise InputError(f"{library} is not installed, which reports need; install blocksar[plots]") from None
    source = products.Source(image.path, image.x, image.y, Geometry(collection=collection), attrs, record)
    found, why = _found(folder, source)
    told = only_stage(progress, "report")
    drawn = partial(listener(progress).update, "responses")
    history = str(stores.open_dataset(image.path).attrs.get("history", ""))
    made, verdict = page.make(source, found, folder=str(folder), history=history, why=why, progress=told, drawn=drawn)
    try:
        target.write_bytes(made)
    except (PermissionError, NotADirectoryError, FileExistsError) as error:
        raise InputError(f"{target} cannot be written ({error.strerror}); choose another --out") from error
    except OSError as error:
        raise ProcessingError(f"{target} cannot be written ({error.strerror or error})") from error
    return Report(summary=["; ".join(verdict), f"wrote {target}"], result=target)


def _found(folder: Place, source: products.Source) -> tuple[dict[str, Any] | None, str]:
    """What quality.json holds, or would hold; or None, and why there is nothing."""
    if (folder / "quality.json").exists():
        return stores.read_json(folder / "quality.json"), ""
    targets = targets_of(None, source.attrs)
    try:
        measured = [measure_target(source.read, source.x, source.y, source.geometry, target) for target in targets]
    except InputError as error:  # too coarse an image to measure in, but not to look at
        return None, f"Nothing was measured: {error}."
    return as_json(measured), ""


def export(
    kind: Literal["sicd", "geotiff", "png"],
    run: Location,
    out: Location,
    *,
    content: Literal["amplitude", "complex"] | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Report:
    """Write the image of a finished run as one file that other programs read.

    Parameters
    ----------
    kind : "sicd", "geotiff" or "png"
        The complex image on its ground plane; a cloud-optimised GeoTIFF; a picture for people.
    content : "amplitude" or "complex", optional
        Of a GeoTIFF; amplitude by default.

    Raises
    ------
    InputError
        If the run is not finished, says not where it lies on the Earth though the product must, a library is not
        installed, or something stands at `out`.
    ProcessingError
        If writing fails: nothing is left at `out`, or what was there.
    """
    folder = place(run)
    if content is not None and kind != "geotiff":
        raise InputError(f"content is {content!r}, but only a geotiff comes as amplitude or complex; leave it out")
    image, collection, attrs, record = open_run(folder)
    source = products.Source(image.path, image.x, image.y, Geometry(collection=collection), attrs, record)
    told = only_stage(progress, "export")
    match kind:
        case "sicd":
            said = sicd.write(source, out, overwrite=overwrite, progress=told)
        case "geotiff":
            said = geotiff.write(source, out, content=content or "amplitude", overwrite=overwrite, progress=told)
        case "png":
            try:
                from blocksar import quicklook  # optional, and slow to load
            except ModuleNotFoundError as error:
                raise InputError(f"{error.name} is not installed, which PNG needs; install blocksar[plots]") from None
            said = quicklook.write(source, out, overwrite=overwrite, progress=told)
        case _:
            raise InputError(f"kind is {kind!r}; it must be 'sicd', 'geotiff' or 'png'")
    return Report(summary=[*said, f"wrote {place(out)}"])


def demo(
    out: Location,
    *,
    workers: int | None = None,
    threads: int | None = None,
    memory_limit: int | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
    performance_report: str | Path | None = None,
) -> Report:
    """Simulate the main paper's scene, focus it in three blocks, measure it, and draw it.

    Leaves a run folder with quality.json, mosaic.png, contours.png and report.html besides.
    """
    told = listener(progress)
    if performance_report is not None:
        cluster.check_recordable(Path(performance_report), None)
    folder = place(out)
    history = folder / runs.LEFT_ALONE[0]
    if folder.names() and not history.exists():
        raise InputError(f"{folder} exists and is not a demonstration run; choose another --out")
    simulated = history.exists() and not overwrite
    told.expect(effort.of_demo(simulated=simulated, compiled=cluster.compiled()), 1)
    if not simulated:
        simulate("table1", history, threads=threads, overwrite=overwrite, progress=told)
    focused = focus(
        history, folder, blocks=3, workers=workers, threads=threads, memory_limit=memory_limit, overwrite=overwrite,
        progress=told, performance_report=performance_report,
    )  # fmt: skip
    told.expect(effort.FOCUS, 1)  # none of it is to come any more
    told.update("measure", 0, 1)
    measured, shown = measure(folder, None, reference=False)
    told.update("measure", 1, 1)
    told.update("draw", 0, 1)
    pictures = _draw(folder, shown)
    told.update("draw", 1, 1)
    page = report(folder, progress=told)
    lines = [*measured.summary, *focused.summary, f"pictures: {', '.join(str(p) for p in pictures)}"]
    lines.append(f"report: {page.result}, for a browser")
    return Report(tables=measured.tables, summary=lines, result=measured.result)


def _draw(folder: Place, shown: Sequence[Response]) -> list[Place]:
    try:
        from blocksar import plotting  # optional, and slow to load
    except ModuleNotFoundError as error:
        raise InputError(f"{error.name} is not installed, which pictures need; install blocksar[plots]") from None
    image, _, attrs, _ = open_run(folder)
    with tempfile.TemporaryDirectory() as drawn:
        mosaic, contours = Path(drawn, "mosaic.png"), Path(drawn, "contours.png")
        plotting.plot_mosaic(
            image.read, image.x, image.y, mosaic, read_block=image.block, targets=targets_of(None, attrs),
            labels=list(TABLE3), title=str(attrs.get("title", "")),
        )  # fmt: skip
        plotting.plot_contours(shown, contours, title="impulse responses of the nine named targets")
        for picture in (mosaic, contours):
            (folder / picture.name).write_bytes(picture.read_bytes())
    return [folder / mosaic.name, folder / contours.name]
