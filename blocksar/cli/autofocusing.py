"""The command `autofocus`."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from blocksar.api.settings import options_taken
from blocksar.cli.display import hint, show
from blocksar.cli.listening import listening
from blocksar.cli.options import JsonLog, Quiet, given, taking
from blocksar.options import read_values


@taking(options_taken("autofocus"))
def autofocus(
    context: typer.Context,
    source: Annotated[str, typer.Argument(metavar="PH.zarr", help="Phase-history store.")],
    out: Annotated[str, typer.Option(metavar="STORE", help="Phase-history store to write, with the track corrected.")],
    quiet: Quiet = False,
    json_log: JsonLog = None,
    **options: Any,
) -> None:
    """Correct the track of a phase history from its samples.

    Looks for prominent points, and finds the error of the track that blurs them.

    Give the same command again to go on with an interrupted one.

    Example: [bold]blocksar autofocus table1.zarr --out corrected.zarr[/bold]
    """
    settings = read_values(options_taken("autofocus"), options)

    from blocksar import api

    if settings["scheduler"] is None:
        from blocksar.graph.starting import start_early

        start_early([source], out, workers=settings["workers"], threads=settings["threads"])

    with listening(context) as progress:
        report = api.autofocus(source, out, progress=progress, **settings)
    show(report, context)
    hint(context, "focus", out, "--out", "RUN", *given(context, "out", "overwrite", "json_log", "control"))
