"""The commands that make phase histories and look at them: `simulate`, `info`, `check`, `preview`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from blocksar.api.parsing import parse_grid, parse_origin
from blocksar.cli.display import hint, show
from blocksar.cli.listening import listening
from blocksar.cli.options import (
    Channel,
    ColourMap,
    ColourRange,
    Explain,
    GridOption,
    GroundHeight,
    JsonLog,
    Overwrite,
    OwnThreads,
    Quiet,
    SurfaceOption,
    TerrainOption,
    VerticalOption,
    given,
)


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


def check(
    context: typer.Context,
    source: Annotated[str, typer.Argument(metavar="PH.zarr", help="Phase-history store.")],
    grid: GridOption = None,
    terrain: TerrainOption = None,
    surface: SurfaceOption = "plane",
    vertical: VerticalOption = None,
    ground_height: GroundHeight = None,
    threads: OwnThreads = None,
    explain: Explain = False,
    quiet: Quiet = False,
) -> None:
    """Check that the samples are what is said of them: sign, order, track and beam.

    Compares the sharpness of prominent places as given with what it would be if something were said wrongly, and says
    what to change. Reads a part of the samples.

    Example: [bold]blocksar check table1.zarr[/bold]
    """
    points = None if grid is None else parse_grid(grid)

    from blocksar import api

    report = api.check(
        source,
        grid=points,
        terrain=terrain,
        surface=surface,
        vertical=vertical,
        ground_height=ground_height,
        threads=threads,
    )
    show(report, context)
    hint(context, "plan", source, *given(context, "threads", "explain"))


def preview(
    context: typer.Context,
    source: Annotated[str, typer.Argument(metavar="PH.zarr", help="Phase-history store.")],
    out: Annotated[str, typer.Option(metavar="FILE", help="PNG to write.")],
    grid: GridOption = None,
    size: Annotated[int, typer.Option(metavar="PIXELS", help="Pixels along the longer side, at most.")] = 1000,
    range: ColourRange = None,
    colour_map: ColourMap = None,
    channel: Channel = None,
    threads: OwnThreads = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json_log: JsonLog = None,
) -> None:
    """Draw a coarse picture of a collection in seconds, and say what grid a run would take.

    Short apertures and a part of the band, back-projected exactly: bright targets lie at their places.

    Example: [bold]blocksar preview table1.zarr --out preview.png[/bold]
    """
    points = None if grid is None else parse_grid(grid)

    from blocksar import api

    with listening(context) as progress:
        found = api.preview(
            source, out=out, grid=points, size=size, range=range, colour_map=colour_map, channel=channel,
            threads=threads, overwrite=overwrite, progress=progress,
        )  # fmt: skip
    show(found, context)
    hint(context, "plan", source, *(["--grid", grid] if grid else []))
