"""The command `autofocus`."""

from __future__ import annotations

from typing import Annotated

import typer

from blocksar.api.parsing import parse_grid, parse_memory
from blocksar.budget import WAIT_WORKERS
from blocksar.cli.display import hint, show
from blocksar.cli.listening import listening
from blocksar.cli.options import (
    Control,
    GridOption,
    GroundHeight,
    JsonLog,
    MemoryLimit,
    Overwrite,
    Quiet,
    Scheduler,
    SurfaceOption,
    TerrainOption,
    Threads,
    VerticalOption,
    WaitWorkers,
    Workers,
    given,
)


def autofocus(
    context: typer.Context,
    source: Annotated[str, typer.Argument(metavar="PH.zarr", help="Phase-history store.")],
    out: Annotated[str, typer.Option(metavar="STORE", help="Phase-history store to write, with the track corrected.")],
    grid: GridOption = None,
    terrain: TerrainOption = None,
    surface: SurfaceOption = "plane",
    vertical: VerticalOption = None,
    ground_height: GroundHeight = None,
    control: Control = None,
    workers: Workers = None,
    threads: Threads = None,
    memory_limit: MemoryLimit = None,
    scheduler: Scheduler = None,
    wait_workers: WaitWorkers = WAIT_WORKERS,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json_log: JsonLog = None,
) -> None:
    """Correct the track of a phase history from its samples.

    Looks for prominent points, and finds the error of the track that blurs them.

    Give the same command again to go on with an interrupted one.

    Example: [bold]blocksar autofocus table1.zarr --out corrected.zarr[/bold]
    """
    points = None if grid is None else parse_grid(grid)
    memory = None if memory_limit is None else parse_memory(memory_limit)

    from blocksar import api

    if scheduler is None:
        from blocksar.graph.starting import start_early

        start_early([source], out, workers=workers, threads=threads)

    with listening(context) as progress:
        report = api.autofocus(
            source,
            out,
            grid=points,
            terrain=terrain,
            surface=surface,
            vertical=vertical,
            ground_height=ground_height,
            control=control,
            workers=workers,
            threads=threads,
            memory_limit=memory,
            scheduler=scheduler,
            wait_workers=wait_workers,
            overwrite=overwrite,
            progress=progress,
        )
    show(report, context)
    hint(context, "focus", out, "--out", "RUN", *given(context, "out", "overwrite", "json_log", "control"))
