"""The commands: each reads its options and calls the function of that name in `blocksar.api`.

Exit status: 0 success; 1 processing failed; 2 the user's input is wrong; 130 interrupted; 143 terminated.
Tables go to stdout, progress and messages to stderr.
"""

from __future__ import annotations

from typing import Annotated

import typer

from blocksar.api.parsing import parse_memory
from blocksar.cli.autofocusing import autofocus
from blocksar.cli.display import hint, show
from blocksar.cli.endings import Commands, catch_signals, open_streams
from blocksar.cli.exporting import export
from blocksar.cli.focusing import focus, plan
from blocksar.cli.imaging import ImagingCommand
from blocksar.cli.ingesting import ingest
from blocksar.cli.listening import listening
from blocksar.cli.measuring import quality, report
from blocksar.cli.options import JsonLog, MemoryLimit, Overwrite, PerformanceReport, Quiet, Threads, Workers
from blocksar.cli.sources import check, info, preview, simulate
from blocksar.garbage import collect_seldom
from blocksar.version import __version__

app = typer.Typer(
    name="blocksar",
    cls=Commands,
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


def demo(
    context: typer.Context,
    out: Annotated[str, typer.Option(metavar="RUN", help="Folder of the run.")] = "demo-run",
    workers: Workers = None,
    threads: Threads = None,
    memory_limit: MemoryLimit = None,
    performance_report: PerformanceReport = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json_log: JsonLog = None,
) -> None:
    """Simulate the paper's scene, focus it, measure its targets and write a report.

    Leaves in the run's folder a picture of the image, contour plots of nine
    targets, and report.html, a page for the browser.

    Example: [bold]blocksar demo --out demo-run[/bold]
    """
    memory = None if memory_limit is None else parse_memory(memory_limit)

    from blocksar import api

    with listening(context) as progress:
        report = api.demo(
            out,
            workers=workers,
            threads=threads,
            memory_limit=memory,
            overwrite=overwrite,
            progress=progress,
            performance_report=performance_report,
        )
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
for command in (simulate, info, plan, check, preview, autofocus, focus, quality, report):
    app.command(cls=ImagingCommand if command in (focus, plan) else None)(command)
app.command("compile")(compile_loops)


def main() -> None:
    """Run the command line: the entry point of `blocksar`."""
    open_streams()
    catch_signals()
    collect_seldom()
    app(prog_name="blocksar")
