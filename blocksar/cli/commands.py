"""The commands: each reads its options and calls the function of that name in `blocksar.api`.

Exit status: 0 success; 1 processing failed; 2 the user's input is wrong; 130 interrupted; 143 terminated.
Tables go to stdout, progress and messages to stderr.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated, Any, Literal

import typer

from blocksar.budget import FIDELITY
from blocksar.cli.display import show
from blocksar.cli.endings import WRONG_INPUT, Commands, catch_signals, complain, ending
from blocksar.cli.options import (
    PROCESSORS,
    AzimuthWeighting,
    Blocks,
    Fidelity,
    GridOption,
    JsonLog,
    MemoryLimit,
    Overwrite,
    PerformanceReport,
    ProcessorOption,
    Quiet,
    RangeWeighting,
    Threads,
    WeightingOption,
    Workers,
    method_options,
    parse_settings,
)
from blocksar.cli.parsing import parse_grid, parse_memory, parse_origin
from blocksar.focusing.method import PlannedProcessor
from blocksar.garbage import collect_seldom
from blocksar.progress import Progress
from blocksar.version import __version__

Run = Annotated[str, typer.Argument(metavar="RUN", help="Folder of a finished run.")]
StoreOut = Annotated[str, typer.Option(metavar="STORE", help="Phase-history store to write.")]

app = typer.Typer(
    name="blocksar",
    cls=Commands,
    help="Focus squint-TOPS radar data by angular blocks, in parallel, into a calibrated ground image."
    "\n\nExample: [bold]blocksar demo --out demo-run[/bold]",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="rich",
    # A traceback that reaches the user is a defect: print it whole and plain, so that it can be sent in.
    pretty_exceptions_enable=False,
)


@contextmanager
def _listening(context: typer.Context) -> Iterator[Progress]:
    """Show the progress of a command; log its settings and how it ends."""
    settings = context.params
    with Progress(quiet=settings["quiet"], log=settings["json_log"]) as progress:
        progress.start(" ".join(context.command_path.split()[1:]), settings, __version__)
        try:
            yield progress
        except BaseException as error:
            progress.end(*ending(error))
            raise
        progress.end(0)


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


@app.command()
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

    with _listening(context) as progress:
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


@app.command()
def simulate(
    context: typer.Context,
    scene: Annotated[str, typer.Argument(metavar="SCENE.toml", help="Scene file, or the name of a shipped scene.")],
    out: StoreOut,
    raw: Annotated[bool, typer.Option("--raw", help="Write the raw chirped echo over fast time instead.")] = False,
    cphd: Annotated[bool, typer.Option("--cphd", help="Write a CPHD 1.1.0 file instead of a store.")] = False,
    origin: Annotated[
        str | None, typer.Option(metavar="LAT,LON,HEIGHT", help="Scene centre for --cphd, in degrees and m.")
    ] = None,
    threads: Annotated[
        int | None, typer.Option(metavar="N", min=1, help="Number of threads; default: by the machine's cores.")
    ] = None,
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

    with _listening(context) as progress:
        api.simulate(
            scene, out, raw=raw, cphd=cphd, origin=place, threads=threads, overwrite=overwrite, progress=progress
        )
    typer.echo(f"wrote {out}")


@app.command()
@method_options
def plan(
    source: Annotated[str, typer.Argument(metavar="PH.zarr|SCENE.toml", help="Phase-history store or scene.")],
    processor: Annotated[
        PlannedProcessor,
        typer.Option(metavar="NAME", help=f"{PROCESSORS}; auto: compare all chains and propose the best."),
    ] = "angular-division",
    blocks: Blocks = "auto",
    fidelity: Fidelity = FIDELITY,
    weighting: WeightingOption = "uniform",
    weighting_range: RangeWeighting = None,
    weighting_azimuth: AzimuthWeighting = None,
    grid: GridOption = None,
    workers: Workers = None,
    memory_limit: MemoryLimit = None,
    **method: Any,
) -> None:
    """Show how a collection would be focused, and the predicted quality of its image.

    Prints blocks, predicted coherence, side lobes, widths and memory, without reading any samples.

    If the collection cannot be focused with these options, prints the reason and exits with status 2.

    Example: [bold]blocksar plan table1 --blocks 3[/bold]
    """
    tapers = (weighting, weighting_range, weighting_azimuth)
    settings = parse_settings(blocks, fidelity, tapers, grid, workers, memory_limit)

    from blocksar import api

    proposal = api.plan(source, processor=processor, **settings, **method)
    show(proposal)
    if proposal.refusal is not None:
        complain(proposal.refusal, WRONG_INPUT)


@app.command()
def check(
    source: Annotated[str, typer.Argument(metavar="PH.zarr", help="Phase-history store.")],
    grid: GridOption = None,
    threads: Threads = None,
) -> None:
    """Check that the samples are what is said of them: sign, order, track and beam.

    Compares the sharpness of prominent places as given with what it would be if something were said wrongly, and says
    what to change. Reads a part of the samples.

    Example: [bold]blocksar check table1.zarr[/bold]
    """
    points = None if grid is None else parse_grid(grid)

    from blocksar import api

    show(api.check(source, grid=points, threads=threads))


@app.command()
@method_options
def focus(
    context: typer.Context,
    source: Annotated[str, typer.Argument(metavar="PH.zarr", help="Phase-history store.")],
    out: Annotated[str, typer.Option(metavar="RUN", help="Folder of the run; an unfinished one is resumed.")],
    processor: ProcessorOption = "angular-division",
    blocks: Blocks = "auto",
    fidelity: Fidelity = FIDELITY,
    weighting: WeightingOption = "uniform",
    weighting_range: RangeWeighting = None,
    weighting_azimuth: AzimuthWeighting = None,
    grid: GridOption = None,
    workers: Workers = None,
    threads: Threads = None,
    memory_limit: MemoryLimit = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Use this dask scheduler instead of a local cluster.")
    ] = None,
    performance_report: PerformanceReport = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json_log: JsonLog = None,
    **method: Any,
) -> None:
    """Focus a phase history into a calibrated ground image.

    Give the same command again to resume an interrupted run.

    Example: [bold]blocksar focus table1.zarr --out run --blocks 3[/bold]
    """
    tapers = (weighting, weighting_range, weighting_azimuth)
    settings = parse_settings(blocks, fidelity, tapers, grid, workers, memory_limit)

    from blocksar import api

    if scheduler is None:
        from blocksar.graph.starting import start_early

        start_early(source, out, workers=workers, threads=threads)

    with _listening(context) as progress:
        report = api.focus(
            source,
            out,
            processor=processor,
            **settings,
            **method,
            threads=threads,
            scheduler=scheduler,
            overwrite=overwrite,
            progress=progress,
            performance_report=performance_report,
        )
    show(report)


@app.command()
def quality(
    run: Run,
    targets: Annotated[
        str | None,
        typer.Option(metavar="FILE", help="JSON file of targets; default: the targets of the phase history."),
    ] = None,
    reference: Annotated[
        bool, typer.Option("--reference", help="Also compare image chips with exact back-projection.")
    ] = False,
) -> None:
    """Measure side-lobe ratios, widths, position and calibration of every target.

    Prints a table with its definitions, and writes it to RUN/quality.json.

    Example: [bold]blocksar quality run --reference[/bold]
    """
    from blocksar import api

    show(api.quality(run, targets=targets, reference=reference))


@app.command()
def report(
    context: typer.Context,
    run: Run,
    out: Annotated[
        str | None, typer.Option(metavar="FILE", help="HTML file to write; default: RUN/report.html.")
    ] = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json_log: JsonLog = None,
) -> None:
    """Write an HTML page about a run, which opens in any browser without a network.

    Shows the image with zoom, block borders and targets; plan and measurements
    side by side; target responses; times; provenance.

    Example: [bold]blocksar report run[/bold]
    """
    from blocksar import api

    with _listening(context) as progress:
        page = api.report(run, out=out, overwrite=overwrite, progress=progress)
    show(page)


ingest = typer.Typer(
    name="ingest",
    help="Convert measured data to a phase history.\n\n"
    "Example: [bold]blocksar ingest cphd collect.cphd --out collect.zarr[/bold]",
    no_args_is_help=True,
)
app.add_typer(ingest)


@ingest.command("cphd")
def ingest_cphd(
    context: typer.Context,
    source: Annotated[str, typer.Argument(metavar="SOURCE.cphd", help="CPHD file, version 1.0.1 or 1.1.0.")],
    out: StoreOut,
    channel: Annotated[
        str | None, typer.Option(metavar="NAME", help="Channel to read, if the file has several.")
    ] = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json_log: JsonLog = None,
) -> None:
    """Convert a CPHD file to a phase history, in the tangent frame at its scene's reference point.

    Example: [bold]blocksar ingest cphd collect.cphd --out collect.zarr[/bold]
    """
    from blocksar import api

    with _listening(context) as progress:
        report = api.ingest_cphd(source, out, channel=channel, overwrite=overwrite, progress=progress)
    show(report)


@ingest.command("gotcha")
def ingest_gotcha(
    context: typer.Context,
    source: Annotated[list[str], typer.Argument(metavar="SOURCE.mat...", help="MATLAB files of one pass.")],
    out: StoreOut,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json_log: JsonLog = None,
) -> None:
    """Join MATLAB files of the AFRL Gotcha data set, in azimuth, into a phase history.

    The phase history keeps the scene-centred frame of the files.

    Example: [bold]blocksar ingest gotcha data_3dsar_pass1_az00*_HH.mat --out gotcha.zarr[/bold]
    """
    from blocksar import api

    with _listening(context) as progress:
        report = api.ingest_gotcha(source, out, overwrite=overwrite, progress=progress)
    show(report)


@app.command("compile")
def compile_loops(context: typer.Context, quiet: Quiet = False, json_log: JsonLog = None) -> None:
    """Compile all loops ahead of time, into numba's cache.

    For images of containers and for shared caches; otherwise the first run
    compiles what it needs. The folder is that of NUMBA_CACHE_DIR.

    Example: [bold]blocksar compile[/bold]
    """
    from blocksar import api

    with _listening(context) as progress:
        report = api.compile(progress=progress)
    show(report)


export = typer.Typer(
    name="export",
    help="Export the image of a run to a standard file format.\n\n"
    "Example: [bold]blocksar export png run --out image.png[/bold]",
    no_args_is_help=True,
)
app.add_typer(export)


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

    with _listening(context) as progress:
        report = api.export("sicd", run, out, overwrite=overwrite, progress=progress)
    show(report)


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

    with _listening(context) as progress:
        report = api.export("geotiff", run, out, content=content, overwrite=overwrite, progress=progress)
    show(report)


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

    with _listening(context) as progress:
        report = api.export("png", run, out, overwrite=overwrite, progress=progress)
    show(report)


def main() -> None:
    """Run the command line: the entry point of `blocksar`."""
    catch_signals()
    collect_seldom()
    app(prog_name="blocksar")
