"""The package's own products for `export`: their options, file endings, and writing functions.

The registry imports this module for every help, so the modules that write products are imported on use.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Annotated, Any, Literal

from blocksar.errors import InputError, library_for
from blocksar.options import Option
from blocksar.products.shared_options import (
    COLOUR_MAP,
    COLOUR_RANGE,
    Calibration,
    Content,
    Crop,
    Decibels,
    Looks,
    OfBackscatter,
    Scale,
    decibels,
)

if TYPE_CHECKING:
    from blocksar.places import Location
    from blocksar.places.place import Place
    from blocksar.progress.listening import Callback
    from blocksar.runs.finished import FinishedRun


@dataclass(frozen=True, kw_only=True)
class SICDOptions:
    """Option of a SICD: how it is calibrated."""

    calibration: Calibration = None


class SICD:
    """Product SICD: the complex image pixel by pixel; see `sicd`."""

    summary = "Write the complex image, on its ground plane, as a SICD file.\n\nThe run must be georeferenced."
    endings = (".nitf", ".ntf", ".nsf")
    options = SICDOptions

    @staticmethod
    def write(
        run: Place, out: Location, options: SICDOptions, *, channel: str | None, overwrite: bool, progress: Callback
    ) -> list[str]:
        """Write the file; return lines for the user."""
        from blocksar.products import sicd
        from blocksar.products.writing import opened

        source, lines = opened(run, channel)
        written = sicd.write(source, out, calibration=options.calibration, overwrite=overwrite, progress=progress)
        return [*lines, *written]


@dataclass(frozen=True, kw_only=True)
class SIDDOptions:
    """Options of SIDD: the part, the looks, and the range in dB."""

    looks: Looks = None
    range: Annotated[Decibels | None, decibels("the 8 bits")] = None
    crop: Crop = None


class SIDD:
    """Product SIDD: the detected image; see `sidd`."""

    summary = (
        "Write the detected image, on the plane or on its terrain, as a SIDD file.\n\nThe run must be georeferenced."
    )
    endings = (".nitf", ".ntf", ".nsf")
    options = SIDDOptions

    @staticmethod
    def write(
        run: Place, out: Location, options: SIDDOptions, *, channel: str | None, overwrite: bool, progress: Callback
    ) -> list[str]:
        """Write the file; return lines for the user."""
        from blocksar.products import sidd
        from blocksar.products.pixels import pixels_of
        from blocksar.products.shared_metadata import refuse_bistatic
        from blocksar.products.writing import opened

        source, lines = opened(run, channel, options.crop)
        looks = (1, 1) if options.looks is None else options.looks
        refuse_bistatic(source, "a SIDD")
        frame = source.placed("a SIDD")
        pixels = pixels_of(source, content="db", looks=looks, scale="uint8", limits=options.range)
        return [*lines, *sidd.write(pixels, frame, out, overwrite=overwrite, progress=progress)]


@dataclass(frozen=True, kw_only=True)
class GeoTIFFOptions:
    """Options of pixels and of the map."""

    content: Annotated[
        Content | None,
        Option(
            "Pixel values, in float32, or complex64; the last four of images on a terrain.",
            metavar="amplitude, power, db, complex, height, incidence, visibility, gamma",
            default="amplitude; db with --scale",
        ),
    ] = None
    looks: Looks = None
    scale: Annotated[
        Scale | None,
        Option("Store dB as whole numbers, 0 where not covered.", metavar="uint8, uint16", default="float32"),
    ] = None
    range: Annotated[Decibels | None, decibels("--scale")] = None
    crop: Crop = None
    crs: Annotated[
        str | None,
        Option(
            "Orthorectify to this coordinate reference system.",
            metavar="EPSG:n",
            default="the scene frame's own, without resampling",
        ),
    ] = None
    quantity: OfBackscatter = None
    db: Annotated[bool | None, Option("Backscatter in dB.", default="power", flags=("--db",))] = None
    calibration: Calibration = None


class GeoTIFF:
    """Product GeoTIFF: complex pixels, power or layers of the image on a map; see `geotiff`."""

    summary = "Write the image as a cloud-optimised GeoTIFF.\n\nThe run must be georeferenced."
    endings = (".tif", ".tiff")
    options = GeoTIFFOptions

    @staticmethod
    def write(
        run: Place, out: Location, options: GeoTIFFOptions, *, channel: str | None, overwrite: bool, progress: Callback
    ) -> list[str]:
        """Write the file; return lines for the user."""
        from blocksar.products import geotiff
        from blocksar.products.pixels import pixels_of
        from blocksar.products.writing import opened

        source, lines = opened(run, channel, options.crop, options.quantity, options.calibration)
        pixels = pixels_of(
            source,
            content=_content(options),
            looks=(1, 1) if options.looks is None else options.looks,
            scale=options.scale,
            limits=options.range,
        )
        return [*lines, *geotiff.write(pixels, out, crs=options.crs, overwrite=overwrite, progress=progress)]


def _content(options: GeoTIFFOptions) -> Content | None:
    """Content of the pixels: of backscatter its power, or dB."""
    if options.quantity is None:
        if options.db:
            raise InputError("db = True is of a quantity; give one, such as sigma0, or take content db")
        return options.content
    if options.content is not None:
        raise InputError(
            f"content is {options.content!r}, but pixels hold {options.quantity}; leave content out, and give db for dB"
        )
    return "db" if options.db or options.scale else "power"


@dataclass(frozen=True, kw_only=True)
class PNGOptions:
    """Options of PNG: content and colours."""

    range: Annotated[Decibels | None, COLOUR_RANGE] = None
    colour_map: Annotated[str | None, COLOUR_MAP] = None
    size: Annotated[
        int | None, Option("Longer side of the picture.", metavar="PIXELS", default="by the image, up to 1700")
    ] = None
    crop: Crop = None
    looks: Looks = None
    composite: Annotated[
        Literal["pauli", "mean"] | None,
        Option(
            "Colours from HH, VV and HV or VH of one run; or the mean power of its looks or channels.",
            default="one channel or look",
        ),
    ] = None
    quantity: OfBackscatter = None
    calibration: Calibration = None


class PNG:
    """Product PNG: a picture in decibels; see `quicklook` and `composite`."""

    summary = (
        "Draw the image in decibels as a PNG, with axes in metres.\n\n"
        "Includes a scale bar, the look direction and north."
    )
    endings = (".png",)
    options = PNGOptions

    @staticmethod
    def write(
        run: Place, out: Location, options: PNGOptions, *, channel: str | None, overwrite: bool, progress: Callback
    ) -> list[str]:
        """Write the file; return lines for the user."""
        from blocksar.products.writing import opened

        drawn = {"limits": options.range, "size": options.size, "overwrite": overwrite, "progress": progress}
        if options.composite is None:
            source, lines = opened(run, channel, options.crop, options.quantity, options.calibration)
            cell = _cell(options, source)
            quicklook = _pictures("quicklook")
            return [*lines, *quicklook.write(source, out, cell=cell, colour_map=options.colour_map, **drawn)]
        sources = _composed(run, options, channel)
        first, *others = sources.values()
        cell = _cell(options, first)
        if options.composite == "pauli":
            return list(_pictures("composite").write(sources, out, cell=cell, **drawn))
        quicklook = _pictures("quicklook")
        return list(quicklook.write(first, out, others=others, cell=cell, colour_map=options.colour_map, **drawn))


def _cell(options: PNGOptions, source: FinishedRun) -> tuple[int, int]:
    """Pixels along y and x that a picture averages over, as requested by `looks`; 1 x 1 by default."""
    from blocksar.measurement.multilooking import checked_looks

    return (1, 1) if options.looks is None else checked_looks(options.looks, (source.y.size, source.x.size))


def _composed(run: Place, options: PNGOptions, channel: str | None) -> dict[str, FinishedRun]:
    """Open the channels or looks of a composite by name."""
    from blocksar.products.writing import opened
    from blocksar.runs.finished import finished_record

    composite = options.composite
    if composite not in ("pauli", "mean"):
        raise InputError(f"composite is {composite!r}; it must be 'pauli' or 'mean'")
    own = {"colour_map": options.colour_map, "quantity": options.quantity} if composite != "mean" else {}
    taken = {"channel": channel, **own}
    for name, value in taken.items():
        if value is not None:
            raise InputError(f"{name} is {value!r}, but a composite has channels and colours of its own; leave it out")
    names = finished_record(run).channels
    if composite == "mean" and not names:
        raise InputError(f"composite mean takes the looks or channels of a run, and {run} has none; leave it out")
    members = dict(zip(names, names, strict=True))
    if composite == "pauli":
        members = _pictures("composite").pauli_channels(names, str(run))
    asked = options.crop, options.quantity, options.calibration
    return {name: opened(run, member, *asked)[0] for name, member in members.items()}


def _pictures(name: str) -> Any:
    """Import a module of pictures: optional, and slow to load."""
    with library_for("PNG needs", "plots"):
        return import_module(f"blocksar.products.pictures.{name}")


def parse_files(files: Any) -> tuple[str, ...]:
    """Parse names of files: a text with commas between them, or several texts.

    Examples
    --------
    >>> parse_files("image.tif, image.nitf")
    ('image.tif', 'image.nitf')
    """
    several = files.split(",") if isinstance(files, str) else files if isinstance(files, Iterable) else (files,)
    return tuple(name for each in several if (name := str(each).strip()))


@dataclass(frozen=True, kw_only=True)
class STACOptions:
    """Options of STAC: the files that were exported from the run."""

    assets: Annotated[
        tuple[str, ...] | None,
        Option(
            "Exported files, assets of the item beside image.zarr.",
            metavar="FILE,FILE",
            default="none",
            read=parse_files,
        ),
    ] = None


class STAC:
    """Product STAC: an item on place, time, radar, processing and files of a run; see `stac`."""

    summary = "Describe the run and what was exported of it as a STAC item.\n\nThe run must be georeferenced."
    endings = (".json",)
    options = STACOptions

    @staticmethod
    def write(
        run: Place, out: Location, options: STACOptions, *, channel: str | None, overwrite: bool, progress: Callback
    ) -> list[str]:
        """Write the file; return lines for the user."""
        from blocksar.products import stac
        from blocksar.products.writing import opened

        source, notes = opened(run, channel)
        whole = run if channel is None else source.folder
        lines = stac.write(source, whole, out, options.assets or (), overwrite=overwrite)
        progress(1, 1)
        return [*(notes if channel else ()), *lines]
