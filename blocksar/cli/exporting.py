"""The commands below `export`: the image of a run in standard formats."""

from __future__ import annotations

from typing import Annotated, Literal

import typer

from blocksar.cli.display import hint, show
from blocksar.cli.listening import listening
from blocksar.cli.options import JsonLog, Overwrite, Quiet, Run

export = typer.Typer(
    name="export",
    help="Export the image of a run to a standard file format.\n\n"
    "Example: [bold]blocksar export png run --out image.png[/bold]",
    no_args_is_help=True,
)


@export.command("sicd")
def export_sicd(
    context: typer.Context,
    run: Run,
    out: Annotated[str, typer.Option(metavar="FILE", help="SICD file (NITF) to write.")],
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
        report = api.export("sicd", run, out, overwrite=overwrite, progress=progress)
    show(report)
    hint(context, "report", run)


@export.command("geotiff")
def export_geotiff(
    context: typer.Context,
    run: Run,
    out: Annotated[str, typer.Option(metavar="FILE", help="GeoTIFF to write.")],
    content: Annotated[
        Literal["amplitude", "complex"], typer.Option(help="Pixel values: amplitude in float32, or complex64.")
    ] = "amplitude",
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
        report = api.export("geotiff", run, out, content=content, overwrite=overwrite, progress=progress)
    show(report)
    hint(context, "report", run)


@export.command("png")
def export_png(
    context: typer.Context,
    run: Run,
    out: Annotated[str, typer.Option(metavar="FILE", help="PNG to write.")],
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
        report = api.export("png", run, out, overwrite=overwrite, progress=progress)
    show(report)
    hint(context, "report", run)
