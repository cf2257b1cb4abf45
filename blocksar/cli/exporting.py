"""The commands below `export`: the image of a run in standard formats."""

from __future__ import annotations

from typing import Annotated, Literal

import typer

from blocksar.cli.display import hint, show
from blocksar.cli.endings import Commands
from blocksar.cli.listening import listening
from blocksar.cli.options import Channel, ColourMap, ColourRange, JsonLog, Overwrite, Quiet, Run, ScaleRange

Crop = Annotated[
    str | None,
    typer.Option(metavar="x0:x1,y0:y1", help="Write only this part of the ground, m.", show_default="the whole image"),
]

Looks = Annotated[
    str | None,
    typer.Option(
        metavar="AxB", help="Average power over cells of A pixels along y and B along x.", show_default="by the product"
    ),
]

export = typer.Typer(
    name="export",
    cls=Commands,
    help="Export the image of a run to a standard file format.\n\n"
    "Example: [bold]blocksar export png run --out image.png[/bold]",
    no_args_is_help=True,
)


@export.command("sicd")
def export_sicd(
    context: typer.Context,
    run: Run,
    out: Annotated[str, typer.Option(metavar="FILE", help="SICD file (NITF) to write.")],
    channel: Channel = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json_log: JsonLog = None,
) -> None:
    """Write the complex image, on its ground plane, as a SICD file.

    The run must be georeferenced.

    Example: [bold]blocksar export sicd run --out image.nitf[/bold]
    """
    from blocksar import api

    with listening(context) as progress:
        report = api.export("sicd", run, out, channel=channel, overwrite=overwrite, progress=progress)
    show(report)
    hint(context, "report", run)


@export.command("geotiff")
def export_geotiff(
    context: typer.Context,
    run: Run,
    out: Annotated[str, typer.Option(metavar="FILE", help="GeoTIFF to write.")],
    content: Annotated[
        Literal["amplitude", "power", "db", "complex", "height", "incidence", "visibility", "gamma"] | None,
        typer.Option(
            metavar="amplitude, power, db, complex, height, incidence, visibility, gamma",
            help="Pixel values, in float32, or complex64; the last four of images on a terrain.",
            show_default="amplitude; db with --scale",
        ),
    ] = None,
    looks: Looks = None,
    scale: Annotated[
        Literal["uint8", "uint16"] | None,
        typer.Option(
            metavar="uint8, uint16", help="Store dB as whole numbers, 0 where not covered.", show_default="float32"
        ),
    ] = None,
    range: ScaleRange = None,
    crop: Crop = None,
    crs: Annotated[
        str | None,
        typer.Option(
            metavar="EPSG:n",
            help="Orthorectify to this coordinate reference system.",
            show_default="the scene frame's own, without resampling",
        ),
    ] = None,
    channel: Channel = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json_log: JsonLog = None,
) -> None:
    """Write the image as a cloud-optimised GeoTIFF.

    The run must be georeferenced.

    Example: [bold]blocksar export geotiff run --out image.tif[/bold]
    """
    from blocksar import api

    with listening(context) as progress:
        report = api.export(
            "geotiff", run, out, content=content, looks=looks, scale=scale, range=range, crop=crop, crs=crs,
            channel=channel, overwrite=overwrite, progress=progress,
        )  # fmt: skip
    show(report)
    hint(context, "report", run)


@export.command("png")
def export_png(
    context: typer.Context,
    run: Run,
    out: Annotated[str, typer.Option(metavar="FILE", help="PNG to write.")],
    range: ColourRange = None,
    colour_map: ColourMap = None,
    size: Annotated[
        int | None,
        typer.Option(metavar="PIXELS", help="Longer side of the picture.", show_default="by the image, up to 1700"),
    ] = None,
    crop: Crop = None,
    looks: Looks = None,
    composite: Annotated[
        Literal["pauli", "mean"] | None,
        typer.Option(
            help="Colours from HH, VV and HV or VH of one run; or the mean power of its looks or channels.",
            show_default="one channel or look",
        ),
    ] = None,
    channel: Channel = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json_log: JsonLog = None,
) -> None:
    """Draw the image in decibels as a PNG, with axes in metres.

    Includes a scale bar, the look direction and north.

    Example: [bold]blocksar export png run --out image.png[/bold]
    """
    from blocksar import api

    with listening(context) as progress:
        report = api.export(
            "png", run, out, looks=looks, range=range, colour_map=colour_map, size=size, crop=crop, composite=composite,
            channel=channel, overwrite=overwrite, progress=progress,
        )  # fmt: skip
    show(report)
    hint(context, "report", run)
