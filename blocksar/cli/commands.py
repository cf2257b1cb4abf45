"""The commands: each reads its options and calls the function of that name in `blocksar.api`.

Exit status: 0 success; 1 processing failed; 2 the user's input is wrong; 130 interrupted; 143 terminated.
Tables go to stdout, progress and messages to stderr.

The group `export` has a command for each product, the group `ingest` one for each reader.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import typer

from blocksar.application.parsing import parse_origin
from blocksar.application.settings import options_taken
from blocksar.cli.endings import catch_signals, open_streams
from blocksar.cli.option_groups import (
    Channel,
    ColourMap,
    ColourRange,
    Everything,
    Explain,
    JsonLog,
    Overwrite,
    OwnThreads,
    Plugged,
    Quiet,
    Run,
    StoreOut,
    given,
    taking,
    with_options,
)
from blocksar.cli.plan_and_focus import OfProcessors, focus, plan
from blocksar.cli.printing import hint, listening, show
from blocksar.errors import InputError
from blocksar.garbage import collect_seldom
from blocksar.options import options_of, read_values
from blocksar.products.registry import PRODUCTS
from blocksar.version import __version__


class Products(Plugged):
    """The group `export`: one command for each product."""

    @classmethod
    def names(cls) -> tuple[str, ...]:
        return PRODUCTS.names()

    @classmethod
    def command_of(cls, name: str) -> Callable[..., None]:
        product = PRODUCTS.get(name)

        def export_product(
            context: typer.Context,
            run: Run,
            out: str | None = None,
            channel: Channel = None,
            overwrite: Overwrite = False,
            quiet: Quiet = False,
            json_log: JsonLog = None,
            **options: Any,
        ) -> None:
            from blocksar import api

            if out is None:
                out = f"{run.rstrip('/').rpartition('/')[2]}{product.endings[0]}"
            with listening(context) as progress:
                report = api.export(name, run, out, channel=channel, overwrite=overwrite, progress=progress, **options)
            show(report)
            hint(context, "report", run)

        file = typer.Option(
            metavar="FILE",
            help=f"File to write, {' or '.join(product.endings)}; default: the run's name with that, here.",
        )
        export_product.__annotations__["out"] = Annotated[str | None, file]
        example = f"Example: [bold]blocksar export {name} run --out image{product.endings[0]}[/bold]"
        return with_options(export_product, options_of(product.options), f"{product.summary}\n\n{example}")


export = typer.Typer(
    name="export",
    cls=Products,
    help="Export the image of a run to a standard file format.\n\n"
    "Example: [bold]blocksar export png run --out image.png[/bold]",
    no_args_is_help=True,
)

CollectionStart = Annotated[
    str | None,
    typer.Option(metavar="UTC", help="When the collection began, such as 2008-08-19T14:03:21.5Z, for products."),
]
TimeZero = Annotated[
    float | None, typer.Option(metavar="S", help="Seconds from --collection-start to slow time 0, for products.")
]


class Readers(Plugged):
    """The group `ingest`: one command for each reader; given a file, the reader is chosen by its first bytes."""

    @classmethod
    def names(cls) -> tuple[str, ...]:
        from blocksar.readers.registry import READERS

        return READERS.names()

    @classmethod
    def command_of(cls, name: str) -> Callable[..., None]:
        from blocksar.readers.registry import READERS

        reader = READERS.get(name)
        metavar, text = reader.source
        kind: Any = list[str] if reader.several else str

        def ingest_files(
            context: typer.Context,
            source: str,
            out: StoreOut,
            collection_start: CollectionStart = None,
            time_zero: TimeZero = None,
            overwrite: Overwrite = False,
            quiet: Quiet = False,
            json_log: JsonLog = None,
            **options: Any,
        ) -> None:
            from blocksar import api

            with listening(context) as progress:
                report = api.ingest(
                    name, source, out, collection_start=collection_start, time_zero=time_zero, overwrite=overwrite,
                    progress=progress, **options,
                )  # fmt: skip
            show(report)
            hint(context, "info", out)

        ingest_files.__annotations__["source"] = Annotated[kind, typer.Argument(metavar=metavar, help=text)]
        doc = f"{reader.summary}\n\nExample: [bold]blocksar ingest {name} {reader.example}[/bold]"
        return with_options(ingest_files, options_of(reader.options), doc)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        from blocksar.api.sources import reader_of

        named = not args or args[0].startswith("-") or args[0] in self.names()
        if not (named or ctx.resilient_parsing):  # which completes words
            name = reader_of(args[0])
            return name, self.get_command(ctx, name), args
        return super().resolve_command(ctx, args)


ingest = typer.Typer(
    name="ingest",
    cls=Readers,
    help="Convert measured data to a phase history. Without the name of a command, the file's first bytes tell it.\n\n"
    "Example: [bold]blocksar ingest cphd collect.cphd --out collect.zarr[/bold]",
    no_args_is_help=True,
)


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

    with listening(context) as progress:
        report = api.autofocus(source, out, progress=progress, **settings)
    show(report, context)
    hint(context, "focus", out, "--out", "RUN", *given(context, "out", "overwrite", "json_log", "control"))


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
    against: Annotated[
        str | None,
        typer.Option(metavar="RUN", help="Also compare chips with those of this run, aligned by shift and phase ramp."),
    ] = None,
    found: Annotated[
        int,
        typer.Option(metavar="N", help="Also find and measure the N brightest isolated points, and the noise floor."),
    ] = 0,
    area: Annotated[
        str | None, typer.Option(metavar="x0:x1,y0:y1", help="Also measure the equivalent looks of this part, m.")
    ] = None,
    channel: Channel = None,
    source: Annotated[
        str | None,
        typer.Option(
            metavar="PH.zarr", help="Phase history for --reference; default: where it was, or beside the run."
        ),
    ] = None,
    everything: Everything = False,
    explain: Explain = False,
    quiet: Quiet = False,
) -> None:
    """Measure side-lobe ratios, widths, position and calibration of every target.

    Prints the worst cases and the ten worst targets, and writes all to RUN/quality.json, if it can.

    Example: [bold]blocksar quality run --reference[/bold]
    """
    from blocksar import api

    report = api.quality(
        run, targets=targets, reference=reference, against=against, found=found, area=area, channel=channel,
        source=source,
    )  # fmt: skip
    show(report, context)
    hint(context, "report", run)


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


def compare(
    context: typer.Context,
    a: Annotated[str, typer.Argument(metavar="A", help="Folder of a finished run, the earlier one.")],
    b: Annotated[str, typer.Argument(metavar="B", help="Folder of another on the same grid.")],
    out: Annotated[str, typer.Option(metavar="FOLDER", help="Folder to write: pair.zarr and pictures.")],
    window: Annotated[
        str, typer.Option(metavar="AxB", help="Pixels along y and x, odd, over which coherence is estimated.")
    ] = "7x7",
    false_alarms: Annotated[
        float, typer.Option(metavar="P", help="Probability that an unchanged pixel is called changed.")
    ] = 0.001,
    crop: Annotated[
        str | None, typer.Option(metavar="x0:x1,y0:y1", help="Compare only this part of the ground, m.")
    ] = None,
    channel: Channel = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json_log: JsonLog = None,
) -> None:
    """Compare two runs on one grid: interferogram, coherence, amplitude ratio and coherent change.

    Writes FOLDER/pair.zarr, which opens with xarray, and pictures of all four.

    Example: [bold]blocksar compare pass-1 pass-2 --out pair[/bold]
    """
    from blocksar import api

    with listening(context) as progress:
        report = api.compare(
            a, b, out, window=window, false_alarms=false_alarms, crop=crop, channel=channel, overwrite=overwrite,
            progress=progress,
        )  # fmt: skip
    show(report)
    hint(context, "quality", a, "--against", b)


def calibrate(
    context: typer.Context,
    run: Run,
    reflectors: Annotated[
        str, typer.Option(metavar="FILE", help="Reflectors, with place, kind and side: JSON, CSV or GeoJSON.")
    ],
    out: Annotated[
        str | None, typer.Option(metavar="FILE", help="JSON file to write; default: RUN/calibration.json.")
    ] = None,
    channel: Channel = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Calibrate a run by reflectors whose radar cross-section is known.

    Writes a file that --calibration of export takes.

    Example: [bold]blocksar calibrate run --reflectors corners.geojson[/bold]
    """
    from blocksar import api

    report = api.calibrate(run, reflectors, out=out, channel=channel, overwrite=overwrite)
    show(report, context)
    file = out or f"{run.rstrip('/')}/calibration.json"
    name = f"{Path(run).name}.tif"
    hint(context, "export", "geotiff", run, "--quantity", "sigma0", "--calibration", file, "--out", name)


def view(
    context: typer.Context,
    run: Run,
    channel: Channel = None,
    port: Annotated[
        int | None, typer.Option(metavar="N", help="Where to listen on 127.0.0.1.", show_default="one that is free")
    ] = None,
    browser: Annotated[bool, typer.Option(help="Open the page in the browser.")] = True,
    quiet: Quiet = False,
) -> None:
    """Pan and zoom a run of any size in the browser, by its pyramid if it has one, until Ctrl-C.

    Served by this process, to this machine only.

    Example: [bold]blocksar view run[/bold]
    """
    from blocksar import api

    report = api.view(run, channel=channel, port=port, browser=browser)
    show(report)
    hint(context, "report", run)
    with suppress(KeyboardInterrupt):
        report.result.serve()


def simulate(
    context: typer.Context,
    scene: Annotated[str, typer.Argument(metavar="SCENE.toml", help="Scene file, or the name of a shipped scene.")],
    out: Annotated[
        str, typer.Option(metavar="OUT", help="Phase-history store to write; with --cphd, file.", show_default=False)
    ] = "",
    print_scene: Annotated[
        bool, typer.Option("--print", help="Print the text of the scene, to be edited, and write nothing.")
    ] = False,
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

    A scene file is written in TOML; the shipped scenes include table1, the paper's. Needs --out or --print.

    Example: [bold]blocksar simulate table1 --out table1.zarr[/bold]
    """
    place = None if origin is None else parse_origin(origin)

    from blocksar import api
    from blocksar.simulation.scene import scene_text

    if print_scene:
        typer.echo(scene_text(scene), nl=False)
        return
    if not out:
        command = f"blocksar simulate {scene} --out {Path(scene).stem}.zarr"
        raise InputError(f"--out is missing; name what to write: {command}")

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
    """Describe a file or folder: size, band, track, beam, grid, its history, and the command that comes next.

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
    """Check the samples against their metadata: sign, order, track and beam.

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
    """Draw a coarse picture of a collection in seconds, and print the grid that a run would use.

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
for command in (simulate, info, plan, check, preview, autofocus, focus, quality, report, compare, calibrate, view):
    app.command()(command)
app.command("compile")(compile_loops)


def main() -> None:
    """Run the command line: the entry point of `blocksar`."""
    open_streams()
    catch_signals()
    collect_seldom()
    app(prog_name="blocksar")
