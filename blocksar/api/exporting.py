"""open, report, export, demo: what one does with a finished run."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, Literal

from blocksar import stores
from blocksar.api.measuring import targets_of
from blocksar.api.reports import Report, only_stage
from blocksar.collection.geometry import Geometry
from blocksar.errors import InputError, ProcessingError
from blocksar.measurement.figures import as_json, measure_target
from blocksar.places import Location, place
from blocksar.places.local import LocalPlace
from blocksar.places.place import Place
from blocksar.products import geotiff
from blocksar.products.sicd import nitf as sicd
from blocksar.progress import Updated as Progress
from blocksar.progress import listener
from blocksar.runs import finished
from blocksar.runs.finished import finished_record, open_run

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
    from blocksar.products import dataset  # registers the accessor, and loads xarray

    folder = place(run)
    if not (folder / "image.zarr").exists():
        return dataset.prepare(stores.open_dataset(folder))
    if (folder / "run.json").exists():
        finished_record(folder)
    return dataset.prepare(stores.open_dataset(folder / "image.zarr"))


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
        from blocksar.products.page import page  # optional, and slow to load
    except ModuleNotFoundError as error:
        library = str(error.name).partition(".")[0]
        raise InputError(f"{library} is not installed, which reports need; install blocksar[plots]") from None
    source = finished.Source(image.path, image.x, image.y, Geometry(collection=collection), attrs, record)
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


def _found(folder: Place, source: finished.Source) -> tuple[dict[str, Any] | None, str]:
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
    source = finished.Source(image.path, image.x, image.y, Geometry(collection=collection), attrs, record)
    told = only_stage(progress, "export")
    match kind:
        case "sicd":
            said = sicd.write(source, out, overwrite=overwrite, progress=told)
        case "geotiff":
            said = geotiff.write(source, out, content=content or "amplitude", overwrite=overwrite, progress=told)
        case "png":
            try:
                from blocksar.products.pictures import quicklook  # optional, and slow to load
            except ModuleNotFoundError as error:
                raise InputError(f"{error.name} is not installed, which PNG needs; install blocksar[plots]") from None
            said = quicklook.write(source, out, overwrite=overwrite, progress=told)
        case _:
            raise InputError(f"kind is {kind!r}; it must be 'sicd', 'geotiff' or 'png'")
    return Report(summary=[*said, f"wrote {place(out)}"])
