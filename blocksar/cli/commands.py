"""The commands: each reads its options and calls the function of that name in `blocksar.api`.

Exit status: 0 success; 1 processing failed; 2 the user's input is wrong; 130 interrupted; 143 terminated.
Tables go to stdout, progress and messages to stderr.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from blocksar.api.parsing import parse_grid, parse_memory_limit, parse_origin
from blocksar.budget import FIDELITY
from blocksar.cli.autofocusing import autofocus
from blocksar.cli.configuration import ConfigOption, PrintConfig, configuration
from blocksar.cli.display import hint, show
from blocksar.cli.endings import WRONG_INPUT, Commands, catch_signals, complain
from blocksar.cli.exporting import export
from blocksar.cli.ingesting import ingest
from blocksar.cli.listening import listening
from blocksar.cli.options import (
    PROCESSORS,
    AutofocusOption,
    AzimuthWeighting,
    Blocks,
    Channel,
    ColourMap,
    Control,
    Discard,
    Everything,
    Explain,
    Fidelity,
    GridOption,
    JsonLog,
    MemoryLimit,
    Overwrite,
    PerformanceReport,
    ProcessorOption,
    Quiet,
    RangeWeighting,
    Run,
    Scheduler,
    StoreOut,
    SurfaceOption,
    TerrainOption,
    Threads,
    VerticalOption,
    WeightingOption,
    Workers,
    given,
    method_options,
    parse_settings,
)
from blocksar.focusing.method import PlannedProcessor
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
    memory = None if memory_limit is None else parse_memory_limit(memory_limit)

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

    with listening(context) as progress:
        api.simulate(
            scene, out, raw=raw, cphd=cphd, origin=place, threads=threads, overwrite=overwrite, progress=progress
        )
    typer.echo(f"wrote {out}")
    hint(context, *(("ingest", "cphd", out, "--out", f"{Path(out).stem}.zarr") if cphd else ("plan", out)))


@app.command()
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


@app.command()
@method_options
def plan(
    context: typer.Context,
    source: Annotated[list[str], typer.Argument(metavar="PH.zarr|SCENE.toml", help="Phase-history stores or scenes.")],
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
    terrain: TerrainOption = None,
    surface: SurfaceOption = "plane",
    vertical: VerticalOption = None,
    workers: Workers = None,
    memory_limit: MemoryLimit = None,
    config: ConfigOption = None,
    everything: Everything = False,
    explain: Explain = False,
    quiet: Quiet = False,
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

    proposal = api.plan(
        one_or_all(source), processor=processor, terrain=terrain, surface=surface, vertical=vertical, **settings,
        **method,
    )  # fmt: skip
    show(proposal, context)
    if proposal.refusal is not None:
        complain(proposal.refusal, WRONG_INPUT)
    _hint_after_plan(context, source, proposal)


def one_or_all(sources: list[str]) -> str | list[str]:
    """The only source, or all of them."""
    return sources if len(sources) > 1 else sources[0]


OF_PLAN = ("everything", "explain")  # its options that `focus` has not


def _hint_after_plan(context: typer.Context, sources: list[str], proposal: Any) -> None:
    """Simulate a scene, or focus phase histories with the same options."""
    for source in sources:
        shipped = "://" not in source and not Path(source).exists()
        if shipped or source.endswith(".toml"):
            hint(context, "simulate", source, "--out", f"{Path(source).stem}.zarr")
            return
    proposed = ["--processor", proposal.result.method.processor] if context.params["processor"] == "auto" else []
    hint(
        context,
        "focus",
        *sources,
        "--out",
        "run",
        *proposed,
        *given(context, *OF_PLAN, *(["processor"] if proposed else [])),
    )


@app.command()
def check(
    context: typer.Context,
    source: Annotated[str, typer.Argument(metavar="PH.zarr", help="Phase-history store.")],
    grid: GridOption = None,
    terrain: TerrainOption = None,
    surface: SurfaceOption = "plane",
    vertical: VerticalOption = None,
    threads: Threads = None,
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

    report = api.check(source, grid=points, terrain=terrain, surface=surface, vertical=vertical, threads=threads)
    show(report, context)
    hint(context, "plan", source, *given(context, "threads", "explain"))


@app.command()
def preview(
    context: typer.Context,
    source: Annotated[str, typer.Argument(metavar="PH.zarr", help="Phase-history store.")],
    out: Annotated[str, typer.Option(metavar="FILE", help="PNG to write.")],
    grid: GridOption = None,
    size: Annotated[int, typer.Option(metavar="PIXELS", help="Pixels along the longer side, at most.")] = 1000,
    range: Annotated[
        str | None,
        typer.Option("--range", metavar="LOW:HIGH", help="dB at the ends of the colours.", show_default="by the image"),
    ] = None,
    colour_map: ColourMap = None,
    channel: Channel = None,
    threads: Threads = None,
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


app.command()(autofocus)


@app.command()
@method_options
def focus(
    context: typer.Context,
    source: Annotated[
        list[str], typer.Argument(metavar="PH.zarr", help="Phase-history stores; several of one frame: one mosaic.")
    ],
    out: Annotated[str, typer.Option(metavar="RUN", help="Folder of the run; an unfinished one is resumed.")],
    processor: ProcessorOption = "angular-division",
    blocks: Blocks = "auto",
    fidelity: Fidelity = FIDELITY,
    weighting: WeightingOption = "uniform",
    weighting_range: RangeWeighting = None,
    weighting_azimuth: AzimuthWeighting = None,
    grid: GridOption = None,
    looks: Annotated[
        int | None, typer.Option(metavar="N", help="Form N images, each of a part of every target's dwell.")
    ] = None,
    terrain: TerrainOption = None,
    surface: SurfaceOption = "plane",
    vertical: VerticalOption = None,
    autofocus: AutofocusOption = False,
    control: Control = None,
    workers: Workers = None,
    threads: Threads = None,
    memory_limit: MemoryLimit = None,
    scheduler: Scheduler = None,
    performance_report: PerformanceReport = None,
    overwrite: Overwrite = False,
    discard: Discard = False,
    config: ConfigOption = None,
    print_config: PrintConfig = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what would be done, with memory and disk, and write nothing.")
    ] = False,
    quiet: Quiet = False,
    json_log: JsonLog = None,
    **method: Any,
) -> None:
    """Focus a phase history into a calibrated ground image, or several of one frame into one mosaic.

    Give the same command again to resume an interrupted run.

    Example: [bold]blocksar focus table1.zarr --out run --blocks 3[/bold]
    """
    tapers = (weighting, weighting_range, weighting_azimuth)
    settings = parse_settings(blocks, fidelity, tapers, grid, workers, memory_limit)
    if print_config:
        typer.echo(configuration(context))
        return

    from blocksar import api

    if scheduler is None and not dry_run:
        from blocksar.graph.starting import start_early

        start_early(source, out, workers=workers, threads=threads)

    with listening(context) as progress:
        report = api.focus(
            one_or_all(source),
            out,
            processor=processor,
            **settings,
            looks=looks,
            terrain=terrain,
            surface=surface,
            vertical=vertical,
            **method,
            autofocus=autofocus,
            control=control,
            threads=threads,
            scheduler=scheduler,
            overwrite=overwrite,
            discard=discard,
            progress=progress,
            performance_report=performance_report,
            dry_run=dry_run,
        )
    show(report)
    if dry_run:
        hint(context, "focus", *source, "--out", out, *given(context, "out", "dry_run"))
    else:
        hint(context, "quality", out)


@app.command()
def quality(
    context: typer.Context,
    run: Run,
    targets: Annotated[
        str | None,
        typer.Option(metavar="FILE", help="JSON, CSV or GeoJSON file of targets; default: those of the phase history."),
    ] = None,
    reference: Annotated[
        bool, typer.Option("--reference", help="Also compare image chips with exact back-projection.")
    ] = False,
    found: Annotated[
        int,
        typer.Option(metavar="N", help="Also find and measure the N brightest isolated points, and the noise floor."),
    ] = 0,
    area: Annotated[
        str | None, typer.Option(metavar="x0:x1,y0:y1", help="Also measure the equivalent looks of this part, m.")
    ] = None,
    channel: Channel = None,
    everything: Everything = False,
    explain: Explain = False,
    quiet: Quiet = False,
) -> None:
    """Measure side-lobe ratios, widths, position and calibration of every target.

    Prints the worst cases and the ten worst targets, and writes all to RUN/quality.json.

    Example: [bold]blocksar quality run --reference[/bold]
    """
    from blocksar import api

    report = api.quality(run, targets=targets, reference=reference, found=found, area=area, channel=channel)
    show(report, context)
    hint(context, "report", run)


@app.command()
def report(
    context: typer.Context,
    run: Run,
    out: Annotated[
        str | None, typer.Option(metavar="FILE", help="HTML file to write; default: RUN/report.html.")
    ] = None,
    channel: Channel = None,
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

    with listening(context) as progress:
        page = api.report(run, out=out, channel=channel, overwrite=overwrite, progress=progress)
    show(page)
    hint(context, "export", "png", run, "--out", f"{Path(run).name}.png")


@app.command("compile")
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


def main() -> None:
    """Run the command line: the entry point of `blocksar`."""
    catch_signals()
    collect_seldom()
    app(prog_name="blocksar")
