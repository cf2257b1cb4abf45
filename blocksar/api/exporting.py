"""open, export: use a finished run."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, Literal

from blocksar import stores
from blocksar.api.reports import Report, only_stage
from blocksar.errors import InputError, library_for
from blocksar.measurement.looks import checked_looks
from blocksar.places import Location, place
from blocksar.places.place import Place
from blocksar.products import geotiff
from blocksar.products.options import OPTIONS, check_ending, parse_looks, parse_range
from blocksar.products.pixels import Content, Scale, checked_limits, pixels_of
from blocksar.products.sicd import nitf as sicd
from blocksar.progress import Wanted as Progress
from blocksar.runs.finished import FinishedRun, finished_record, folder_of, member_line
from blocksar.runs.record import RECORD
from blocksar.spans import parse_crop

if TYPE_CHECKING:
    import xarray as xr


def open(run: Location) -> xr.Dataset:
    """Open the image of a run as a lazily loaded dataset: `image` and `block` over y and x.

    The dataset follows CF, with a grid mapping if it is georeferenced, and has the accessor `ds.sar`.

    Parameters
    ----------
    run : path
        Folder of a finished run, or any store of blocksar, such as RUN/spectrum.zarr.

    Returns
    -------
    xarray.Dataset
        `image` (y, x) complex64, NaN where not covered; `block` (y, x) int16, -1 where not covered; x, y in m. Of
        several channels, `image` is (channel, y, x).

    Raises
    ------
    InputError
        If there is no such store, or the run is not finished. The image of an unfinished run opens by its own path,
        RUN/image.zarr.
    """
    from blocksar.products import dataset  # registers the accessor, and loads xarray

    folder = place(run)
    if (folder / RECORD).exists():
        finished_record(folder)
    elif not (folder / "image.zarr").exists():
        return dataset.prepare(stores.open_dataset(folder))
    return dataset.prepare(stores.open_dataset(folder / "image.zarr"))


def export(
    kind: Literal["sicd", "geotiff", "png"],
    run: Location,
    out: Location,
    *,
    content: Content | None = None,
    looks: tuple[int, int] | str | None = None,
    scale: Scale | None = None,
    range: tuple[float, float] | str | None = None,
    crop: tuple[tuple[float, float], tuple[float, float]] | str | None = None,
    crs: str | None = None,
    colour_map: str | None = None,
    size: int | None = None,
    composite: Literal["pauli", "mean"] | None = None,
    channel: str | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Report:
    """Write the image of a finished run as one file that other programs read.

    Parameters
    ----------
    kind : {"sicd", "geotiff", "png"}
        Complex image on its ground plane; cloud-optimised GeoTIFF; picture in decibels.
    run : path
        Folder of a finished run.
    out : path
        Local file to write.
    content : {"amplitude", "power", "db", "complex", "height", "incidence", "visibility", "gamma"}, optional
        Pixels of a GeoTIFF: float32, or complex64, or uint8 flags. Those from "height" on are of images on a terrain;
        "gamma" is the power without what slopes do to it. Default: "amplitude", or "db" with `scale`. Only for
        `kind="geotiff"`.
    looks : (int, int) or str, optional
        Pixels along y and along x of the cells over which a GeoTIFF or a PNG averages power, such as (4, 2) or "4x2".
        Cells that are not covered as a whole are no data in a GeoTIFF. Default: no averaging; in a PNG cells that suit
        its size.
    scale : {"uint8", "uint16"}, optional
        Whole numbers in which a GeoTIFF stores dB: 1 at the lower end of `range`, 0 where not covered. Default:
        float32.
    range : (float, float) or str, optional
        dB at the ends of a picture's colours, or of `scale`, such as (-40, 0) or "-40:0". Default: by the image.
    crop : ((float, float), (float, float)) or str, optional
        Ends of x and of y, m, of the part to write, such as "0:500,18000:18500"; not for SICD. Default: the whole
        image.
    crs : str, optional
        Coordinate reference system to which a GeoTIFF is orthorectified, such as "EPSG:32616": each pixel shows the
        ground, at its height, whose place it is. Default: the pixels of the image, in the frame's own projection.
    colour_map : str, optional
        Of a PNG, by matplotlib's name. Default: "gray".
    size : int, optional
        Pixels of a PNG along its longer side. Default: by the image, up to about 1700.
    composite : {"pauli", "mean"}, optional
        A PNG of several channels or looks of one run. "pauli": colours from HH, VV and HV or VH, |HH - VV|, |HV + VH|
        and |HH + VV|, each over sqrt(2), as red, green and blue. "mean": their mean power, which has less speckle.
        Default: one channel or look.
    channel : str, optional
        Of a run of several channels. Default: the first.
    overwrite : bool
        Replace what stands at `out`. Default: False.
    progress : object with a method update(stage, done, total), or False, optional
        As in `focus`. Default: bars in a notebook, silence elsewhere.

    Returns
    -------
    Report
        `summary` describes the file and gives its path.

    Raises
    ------
    InputError
        If the run is not finished, has no georeference though the product needs one, a library is not installed, an
        option is wrong or not one of the product's, or `out` has the ending of another product, or exists and
        `overwrite` is False.
    ProcessingError
        If writing fails; what stood at `out` stays.
    """
    if kind not in tuple(OPTIONS):  # which need not be hashable
        raise InputError(f"kind is {kind!r}; it must be 'sicd', 'geotiff' or 'png'")
    given = {"content": content, "looks": looks, "scale": scale, "range": range, "crop": crop, "crs": crs,
             "colour_map": colour_map, "size": size, "composite": composite}  # fmt: skip
    for name, value in given.items():
        if value is not None and name not in OPTIONS[kind]:
            kinds = [other for other, names in OPTIONS.items() if name in names]
            raise InputError(f"{name} is {value!r}, but it is an option of {' and '.join(kinds)} only; leave it out")
    check_ending(kind, str(place(out)))
    limits = None if range is None else checked_limits(parse_range(range))
    callback = only_stage(progress, "export")

    if composite is not None:
        own = {"channel": channel, **({"colour_map": colour_map} if composite != "mean" else {})}
        sources = _composed(place(run), composite, crop, own)
        cell = _cell(looks, next(iter(sources.values())))
        drawn = {"limits": limits, "size": size, "cell": cell, "overwrite": overwrite, "progress": callback}
        if composite == "mean":
            first, *others = sources.values()
            lines = _pictures("quicklook").write(first, out, others=others, colour_map=colour_map, **drawn)
        else:
            lines = _pictures("composite").write(sources, out, **drawn)
        return Report(summary=[*lines, f"wrote {place(out)}"])
    source = _opened(place(run), channel, crop)
    if kind == "sicd":
        lines = sicd.write(source, out, overwrite=overwrite, progress=callback)
    elif kind == "geotiff":
        pixels = pixels_of(
            source, content=content, looks=parse_looks((1, 1) if looks is None else looks), scale=scale, limits=limits
        )
        lines = geotiff.write(pixels, out, crs=crs, overwrite=overwrite, progress=callback)
    else:
        lines = _pictures("quicklook").write(
            source, out, cell=_cell(looks, source), limits=limits, colour_map=colour_map, size=size,
            overwrite=overwrite, progress=callback,
        )  # fmt: skip
    return Report(summary=[*member_line(place(run), channel), *lines, f"wrote {place(out)}"])


def _cell(looks: Any, source: FinishedRun) -> tuple[int, int]:
    """Pixels along y and along x of the cells of a picture, or of their parts."""
    return (1, 1) if looks is None else checked_looks(parse_looks(looks), (source.y.size, source.x.size))


def _opened(run: Place, channel: str | None, crop: Any) -> FinishedRun:
    """Open a channel of a run, or a part of it."""
    source = FinishedRun.open(folder_of(run, channel))
    return source if crop is None else source.cropped(*parse_crop(crop))


def _composed(run: Place, composite: str, crop: Any, others: dict[str, Any]) -> dict[str, FinishedRun]:
    """Open the channels or looks of a composite by name; `others` are options that must be None beside it."""
    if composite not in ("pauli", "mean"):
        raise InputError(f"composite is {composite!r}; it must be 'pauli' or 'mean'")
    for name, value in others.items():
        if value is not None:
            raise InputError(f"{name} is {value!r}, but a composite has channels and colours of its own; leave it out")
    names = finished_record(run).channels
    if composite == "mean":
        if not names:
            raise InputError(f"composite mean takes the looks or channels of a run, and {run} has none; leave it out")
        return {name: _opened(run, name, crop) for name in names}
    taken = _pictures("composite").pauli_channels(names, str(run))
    return {name: _opened(run, channel, crop) for name, channel in taken.items()}


def _pictures(name: str) -> Any:
    """Import a module of pictures: optional, and slow to load."""
    with library_for("PNG needs", "plots"):
        return import_module(f"blocksar.products.pictures.{name}")
