"""The commands below `ingest`: measured data to phase histories."""

from __future__ import annotations

from typing import Annotated

import typer

from blocksar.cli.display import hint, show
from blocksar.cli.endings import Commands
from blocksar.cli.listening import listening
from blocksar.cli.options import JsonLog, Overwrite, Quiet, StoreOut

CollectionStart = Annotated[
    str | None,
    typer.Option(metavar="UTC", help="When the collection began, such as 2008-08-19T14:03:21.5Z, for products."),
]
TimeZero = Annotated[
    float | None, typer.Option(metavar="S", help="Seconds from --collection-start to slow time 0, for products.")
]
IngestedGround = Annotated[float, typer.Option(metavar="M", help="Height z of the imaged plane in the scene frame.")]

ingest = typer.Typer(
    name="ingest",
    cls=Commands,
    help="Convert measured data to a phase history.\n\n"
    "Example: [bold]blocksar ingest cphd collect.cphd --out collect.zarr[/bold]",
    no_args_is_help=True,
)


@ingest.command("cphd")
def ingest_cphd(
    context: typer.Context,
    source: Annotated[str, typer.Argument(metavar="SOURCE.cphd", help="CPHD file, version 1.0 or 1.1; or its URL.")],
    out: StoreOut,
    channel: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Channel to read, if the file has several; all: one store of all of them."),
    ] = None,
    pulses: Annotated[
        str | None,
        typer.Option(metavar="A:B", help="Vectors that are read: A to the one before B.", show_default="all"),
    ] = None,
    frequencies: Annotated[
        str | None, typer.Option(metavar="F1:F2", help="Band that is read, Hz.", show_default="all")
    ] = None,
    area: Annotated[
        str | None,
        typer.Option(
            metavar="x0:x1,y0:y1", help="Ground, m, of which the samples are kept, and no more.", show_default="all"
        ),
    ] = None,
    ground_height: IngestedGround = 0.0,
    collection_start: CollectionStart = None,
    time_zero: TimeZero = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json_log: JsonLog = None,
) -> None:
    """Convert a CPHD file to a phase history, in the tangent frame at its scene's reference point.

    Example: [bold]blocksar ingest cphd collect.cphd --out collect.zarr[/bold]
    """
    from blocksar import api

    with listening(context) as progress:
        report = api.ingest_cphd(
            source,
            out,
            channel=channel,
            pulses=pulses,
            frequencies=frequencies,
            area=area,
            ground_height=ground_height,
            collection_start=collection_start,
            time_zero=time_zero,
            overwrite=overwrite,
            progress=progress,
        )
    show(report)
    hint(context, "info", out)


@ingest.command("gotcha")
def ingest_gotcha(
    context: typer.Context,
    source: Annotated[
        list[str],
        typer.Argument(metavar="SOURCE.mat...", help="MATLAB files of one pass, of one or more polarisations."),
    ],
    out: StoreOut,
    ground_height: IngestedGround = 0.0,
    collection_start: CollectionStart = None,
    time_zero: TimeZero = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json_log: JsonLog = None,
) -> None:
    """Join MATLAB files of the AFRL Gotcha data set, in azimuth, into a phase history.

    The phase history keeps the scene-centred frame of the files.

    Example: [bold]blocksar ingest gotcha data_3dsar_pass1_az00*_HH.mat --out gotcha.zarr[/bold]
    """
    from blocksar import api

    with listening(context) as progress:
        report = api.ingest_gotcha(
            source, out, ground_height=ground_height, collection_start=collection_start, time_zero=time_zero,
            overwrite=overwrite, progress=progress,
        )  # fmt: skip
    show(report)
    hint(context, "info", out)
