"""The commands: each reads its options and calls the function of that name in `blocksar.api`.

Exit status: 0 success; 1 processing failed; 2 the user's input is wrong; 130 interrupted; 143 terminated.
Tables go to stdout, progress and messages to stderr.
"""

from __future__ import annotations

from typing import Annotated, Any

import typer

from blocksar.api.settings import options_taken
from blocksar.cli.autofocusing import autofocus
from blocksar.cli.display import hint, show
from blocksar.cli.endings import catch_signals, open_streams
from blocksar.cli.exporting import export
from blocksar.cli.focusing import OfProcessors, focus, plan
from blocksar.cli.ingesting import ingest
from blocksar.cli.listening import listening
from blocksar.cli.measuring import compare, quality, report, view
from blocksar.cli.options import JsonLog, Quiet, taking
from blocksar.cli.sources import check, info, preview, simulate
from blocksar.garbage import collect_seldom
from blocksar.options import read_values
from blocksar.version import __version__

app = typer.Typer(
    name="blocksar",
    cls=OfProcessors,
    help="Focus squint-TOPS radar data by angular blocks, in parallel, into a calibrated ground image."
    "\n\nExample: [bold]blocksar demo --out demo-run[/bold]",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    rich_markup_mode="rich",
    # A traceback that reaches the user is a defect: print it whole and plain, so that it can be sent in.
    pretty_exceptions_enable=False,
)
app.add_typer(ingest)
app.add_typer(export)


def _print_version(requested: bool) -> None:
    if requested:
        typer.echo(f"blocksar {__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Options before a command."""


@taking(options_taken("demo"))
def demo(
    context: typer.Context,
    out: Annotated[str, typer.Option(metavar="RUN", help="Folder of the run.")] = "demo-run",
    quiet: Quiet = False,
    json_log: JsonLog = None,
    **options: Any,
) -> None:
    """Simulate the paper's scene, focus it, measure its targets and write a report.

    Leaves in the run's folder a picture of the image, contour plots of nine
    targets, and report.html, a page for the browser.

    Example: [bold]blocksar demo --out demo-run[/bold]
    """
    settings = read_values(options_taken("demo"), options)

    from blocksar import api

    with listening(context) as progress:
        report = api.demo(out, progress=progress, **settings)
    show(report)
    hint(context, "info", out)


def compile_loops(context: typer.Context, quiet: Quiet = False, json_log: JsonLog = None) -> None:
    """Compile all loops ahead of time, into numba's cache.

    For images of containers and for shared caches; otherwise the first run
    compiles what it needs. The folder is that of NUMBA_CACHE_DIR.

    Example: [bold]blocksar compile[/bold]
    """
    from blocksar import api

    with listening(context) as progress:
        report = api.compile(progress=progress)
    show(report)
    hint(context, "demo", "--out", "demo-run")


# In the order of the help.
app.command()(demo)
for command in (simulate, info, plan, check, preview, autofocus, focus, quality, report, compare, view):
    app.command()(command)
app.command("compile")(compile_loops)


def main() -> None:
    """Run the command line: the entry point of `blocksar`."""
    open_streams()
    catch_signals()
    collect_seldom()
    app(prog_name="blocksar")
