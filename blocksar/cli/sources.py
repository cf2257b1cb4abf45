"""The commands that make phase histories and look at them: `simulate`, `info`, `check`, `preview`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from blocksar.api.parsing import parse_origin
from blocksar.api.settings import options_taken
from blocksar.cli.display import hint, show
from blocksar.cli.listening import listening
from blocksar.cli.options import (
    Channel,
    ColourMap,
    ColourRange,
    Explain,
    JsonLog,
    Overwrite,
    OwnThreads,
    Quiet,
    given,
    taking,
)
from blocksar.options import read_values


def simulate(
    context: typer.Context,
    scene: Annotated[str, typer.Argument(metavar="SCENE.toml", help="Scene file, or the name of a shipped scene.")],
    out: Annotated[str, typer.Option(metavar="OUT", help="Phase-history store to write; with --cphd, file.")],
    raw: Annotated[bool, typer.Option("--raw", help="Write the raw chirped echo over fast time instead.")] = False,
    cphd: Annotated[bool, typer.Option("--cphd", help="Write a CPHD 1.1.0 file instead of a store.")] = False,
    origin: Annotated[
        str | None, typer.Option(metavar="LAT,LON,HEIGHT", help="Scene centre for --cphd, in degrees and m.")
    ] = None,
    threads: OwnThreads = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json_log: JsonLog = None,
) -> None:
    """Simulate the phase history of a scene, with exact ranges.

    A scene file is written in TOML; the shipped scenes include table1, the paper's.

    Example: [bold]blocksar simulate table1 --out table1.zarr[/bold]
    """
    place = None if origin is None else parse_origin(origin)

    from blocksar import api

    with listening(context) as progress:
        api.simulate(
            scene, out, raw=raw, cphd=cphd, origin=place, threads=threads, overwrite=overwrite, progress=progress
        )
    typer.echo(f"wrote {out}")
    hint(context, *(("ingest", "cphd", out, "--out", f"{Path(out).stem}.zarr") if cphd else ("plan", out)))


def info(
    context: typer.Context,
    path: Annotated[
        str, typer.Argument(metavar="PATH", help="Phase history, run, image, CPHD file, Gotcha files, or scene.")
    ],
    quiet: Quiet = False,
) -> None:
    """Say what a file or folder holds: size, band, track, beam, grid, what was done to it, and what comes next.

    Reads no samples.

    Example: [bold]blocksar info table1.zarr[/bold]
    """
    from blocksar import api

    found = api.info(path)
    show(found, context)
    for line in found.result["next"]:
        hint(context, *line)


@taking(options_taken("check"))
def check(
    context: typer.Context,
    source: Annotated[str, typer.Argument(metavar="PH.zarr", help="Phase-history store.")],
    threads: OwnThreads = None,
    explain: Explain = False,
    quiet: Quiet = False,
    **options: Any,
) -> None:
    """Check that the samples are what is said of them: sign, order, track and beam.

    Compares the sharpness of prominent places as given with what it would be if something were said wrongly, and says
    what to change. Reads a part of the samples.

    Example: [bold]blocksar check table1.zarr[/bold]
    """
    settings = read_values(options_taken("check"), options)

    from blocksar import api

    report = api.check(source, threads=threads, **settings)
    show(report, context)
    hint(context, "plan", source, *given(context, "threads", "explain"))


@taking(options_taken("preview"))
def preview(
    context: typer.Context,
    source: Annotated[str, typer.Argument(metavar="PH.zarr", help="Phase-history store.")],
    out: Annotated[str, typer.Option(metavar="FILE", help="PNG to write.")],
    size: Annotated[int, typer.Option(metavar="PIXELS", help="Pixels along the longer side, at most.")] = 1000,
    range: ColourRange = None,
    colour_map: ColourMap = None,
    channel: Channel = None,
    threads: OwnThreads = None,
    quiet: Quiet = False,
    json_log: JsonLog = None,
    **options: Any,
) -> None:
    """Draw a coarse picture of a collection in seconds, and say what grid a run would take.

    Short apertures and a part of the band, back-projected exactly: bright targets lie at their places.

    Example: [bold]blocksar preview table1.zarr --out preview.png[/bold]
    """
    settings = read_values(options_taken("preview"), options)

    from blocksar import api

    with listening(context) as progress:
        found = api.preview(
            source, out=out, size=size, range=range, colour_map=colour_map, channel=channel, threads=threads,
            progress=progress, **settings,
        )  # fmt: skip
    show(found, context)
    hint(context, "plan", source, *(["--grid", options["grid"]] if options["grid"] else []))
