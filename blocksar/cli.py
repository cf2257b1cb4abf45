"""The commands: words, numbers and messages for people; everything else is `blocksar.api`.

Exit status: 0 done; 1 processing failed; 2 the user's input is wrong; 130 interrupted; 143 terminated.
Tables go to stdout, progress and messages to stderr.
"""

from __future__ import annotations

import errno
import math
import os
import re
import reprlib
import signal
import sys
import textwrap
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any, Literal, NoReturn, Protocol, TypedDict, get_args

import typer
from typer.core import TyperGroup

from blocksar import __version__
from blocksar.method import Coefficients, Derotation, Perturbation, PlannedProcessor, Processor, RangeModel
from blocksar.parameters import InputError, ProcessingError
from blocksar.progress import Progress, abandon

if TYPE_CHECKING:
    from rich.table import Table

Axis = tuple[float, float, float]

UsageError: Any = typer.BadParameter.__base__  # typer gives the class of a wrong command line no public name
FAILED, WRONG_INPUT, INTERRUPTED, TERMINATED = 1, 2, 130, 143
GRACE = 10.0  # seconds that an interrupted command has to end in good order
PIPE_WIDTH = 240  # columns of a table that goes to no terminal: nothing may be folded there


class Settings(TypedDict):
    """What `plan` and `focus` share, as the api takes it."""

    blocks: int | Literal["auto"]
    coefficients: Coefficients
    perturbation: Perturbation
    keystone: bool
    derotation: Derotation
    range_model: RangeModel
    grid: tuple[Axis, Axis] | None
    workers: int | None
    memory_limit: int | None  # bytes


class Report(Protocol):
    """What a function of the api has to tell a person."""

    @property
    def summary(self) -> Sequence[str]:
        """Sentences that follow the tables."""

    def table(self) -> Sequence[tuple[Sequence[str], Sequence[Sequence[str]]]]:
        """Tables as (header, rows), every cell as it is to be printed."""


class Terminated(SystemExit):
    """SIGTERM came. Raised in the main thread, so that clusters and half-made stores are cleaned up."""


# ---------------------------------------------------------------- what the user typed


def parse_grid(text: str) -> tuple[Axis, Axis]:
    """Read `x0:x1:dx,y0:y1:dy`: points x0, x0 + dx, ... < x1 in m, likewise y.

    Returns
    -------
    ((x0, x1, dx), (y0, y1, dy)) in m

    Raises
    ------
    InputError
        If the text has another form, a number is not finite, or an axis would be empty.

    Examples
    --------
    >>> parse_grid("-100:100:0.5,18e3:20e3:1")
    ((-100.0, 100.0, 0.5), (18000.0, 20000.0, 1.0))
    """
    example = "give --grid x0:x1:dx,y0:y1:dy in metres, such as --grid -2500:2500:1,18000:23000:1"
    axes = text.split(",")
    if len(axes) != 2:
        raise InputError(f"--grid {quoted(text)} has {len(axes)} axes instead of two; {example}")
    x, y = (_parse_axis(name, axis, example) for name, axis in zip("xy", axes, strict=True))
    return x, y


def quoted(text: str) -> str:
    """What was typed, for a message."""
    short = reprlib.Repr()
    short.maxstring = 80
    return short.repr(text)


def _parse_axis(name: str, text: str, example: str) -> Axis:
    try:
        first, end, step = (float(number) for number in text.split(":"))
    except ValueError:
        raise InputError(f"--grid has {quoted(text)} for {name}, which is not three numbers; {example}") from None
    if not all(map(math.isfinite, (first, end, step))):
        raise InputError(f"--grid has {quoted(text)} for {name}, which is not finite; {example}")
    if step <= 0:
        raise InputError(f"--grid has a spacing of {step:g} m for {name}; give one above zero")
    if end <= first:
        raise InputError(f"--grid is empty: {name} runs from {first:g} to {end:g} m; let the end lie above the start")
    return first, end, step


def parse_memory(text: str) -> int:
    """Read an amount of memory, such as `2GiB`, `500 MB` or `1e9`, as bytes.

    Raises
    ------
    InputError
        If the text is no positive number with a unit of bytes.

    Examples
    --------
    >>> parse_memory("1.5GiB"), parse_memory("500 MB")
    (1610612736, 500000000)
    """
    match = re.fullmatch(r"\s*(\d+\.?\d*(?:e\d+)?|\.\d+)\s*([kmgt]i?)?b?\s*", text, re.IGNORECASE)
    if match is None or not float(match[1]):
        raise InputError(
            f"--memory-limit {quoted(text)} is no amount of memory; give a number with a unit, such as 2GiB"
        )
    unit = (match[2] or "").lower()
    base = 1024 if unit.endswith("i") else 1000
    size = float(match[1]) * base ** ("", "k", "m", "g", "t").index(unit.removesuffix("i"))
    if not 1 <= size < 2**60:
        raise InputError(f"--memory-limit {quoted(text)} is no memory that a machine has; give one such as 2GiB")
    return int(size)


def parse_origin(text: str) -> Axis:
    """Read `latitude,longitude,height`, in degrees and m.

    Raises
    ------
    InputError
        If the text is not three finite numbers.

    Examples
    --------
    >>> parse_origin("39.78,-84.1,300")
    (39.78, -84.1, 300.0)
    """
    try:
        latitude, longitude, height = (float(number) for number in text.split(","))
    except ValueError:
        latitude = longitude = height = math.nan
    if not all(map(math.isfinite, (latitude, longitude, height))):
        raise InputError(
            f"--origin {quoted(text)} is not three numbers; give latitude,longitude,height in degrees and "
            "metres, such as --origin 39.78,-84.1,300"
        )
    return latitude, longitude, height


def parse_blocks(text: str) -> int | Literal["auto"]:
    """Read `auto` or a number of blocks.

    Raises
    ------
    InputError
        If the text is neither.
    """
    if text == "auto":
        return "auto"
    if not re.fullmatch(r"0*[1-9]\d{0,8}", text, re.ASCII):
        raise InputError(
            f"--blocks {quoted(text)} is neither 'auto' nor a whole number above zero, of few digits; try --blocks auto"
        )
    return int(text)


def _settings(
    blocks: str,
    coefficients: Coefficients,
    perturbation: Perturbation,
    keystone: bool,
    derotation: Derotation,
    range_model: RangeModel,
    grid: str | None,
    workers: int | None,
    memory_limit: str | None,
) -> Settings:
    return {
        "blocks": parse_blocks(blocks),
        "coefficients": coefficients,
        "perturbation": perturbation,
        "keystone": keystone,
        "derotation": derotation,
        "range_model": range_model,
        "grid": None if grid is None else parse_grid(grid),
        "workers": workers,
        "memory_limit": None if memory_limit is None else parse_memory(memory_limit),
    }


# ---------------------------------------------------------------- what the user sees


def show(report: Report) -> None:
    """Print a report's tables and summary on stdout."""
    from rich.console import Console

    terminal = sys.stdout.isatty()
    console = Console(width=None if terminal else PIPE_WIDTH)
    for header, rows in report.table():
        for part in tables(header, rows, console.width):
            console.print(part)
    for line in report.summary:
        typer.echo(_wrapped(line, console.width) if terminal else line)


def tables(header: Sequence[str], rows: Sequence[Sequence[str]], width: int) -> Iterator[Table]:
    """A table for so many columns of a terminal: where it is too wide, several below each other.

    Each begins with the first column. A title may be folded between its words; no figure is ever cut or folded.
    """
    from rich import box
    from rich.cells import cell_len
    from rich.table import Table
    from rich.text import Text

    sides, between = 4, 3  # columns of the terminal beside a table, and from one of its columns to the next
    columns = list(zip(header, *rows, strict=True))
    least = [max(map(cell_len, [*(column[0].split() or [""]), *column[1:]])) for column in columns]

    def total(part: Sequence[int]) -> int:
        return sides + sum(least[i] + between for i in part) - between

    parts: list[list[int]] = []
    for i in range(len(columns)):
        if not parts or (len(parts[-1]) > 1 and total([*parts[-1], i]) > width):
            parts.append([0, i] if i else [0])
        else:
            parts[-1].append(i)
    for part in parts:
        spare = max(width - total(part), 0)
        # Text, not str: rich would take a unit in square brackets for markup.
        table = Table(box=box.SIMPLE_HEAD)
        for i in part:
            wider = min(max(cell_len(header[i]) - least[i], 0), spare)
            spare -= wider
            table.add_column(Text(header[i]), width=least[i] + wider)
        for row in rows:
            table.add_row(*(Text(row[i]) for i in part))
        yield table


def _wrapped(line: str, width: int) -> str:
    """Folded between words, as terminals do not; a word that is too long, a path for instance, stays whole."""
    fold = textwrap.TextWrapper(max(width, 20), break_long_words=False, break_on_hyphens=False)
    folded = []
    for each in line.splitlines():
        fold.subsequent_indent = each[: len(each) - len(each.lstrip())]
        folded.append(fold.fill(each))
    return "\n".join(folded)


def complain(message: str, status: int) -> NoReturn:
    """End the command with one message on stderr."""
    typer.echo(f"blocksar: {message}", err=True)
    raise typer.Exit(status)


class Commands(TyperGroup):
    """The group of commands, and the one place where an error becomes a message and an exit status."""

    def make_context(self, *arguments: Any, **settings: Any) -> Any:
        try:
            return super().make_context(*arguments, **settings)
        except UsageError as error:
            _complain_of_usage(error)

    def invoke(self, ctx: Any) -> Any:  # typer gives the class of this context no public name
        try:
            return super().invoke(ctx)
        except UsageError as error:
            _complain_of_usage(error)
        except (InputError, ProcessingError, KeyboardInterrupt, Terminated) as error:
            _complain_of(error)
        except OSError as error:
            # A reader that has seen enough (`blocksar plan ... | head`) is nobody's error: typer ends quietly.
            if error.errno == errno.EPIPE:
                raise
            _complain_of(error)


def _complain_of(error: BaseException) -> NoReturn:
    status, message = ending(error)
    complain(message, status)


def _complain_of_usage(error: Any) -> NoReturn:
    """A wrong command line, in one sentence like any other input."""
    message = error.format_message().removesuffix(".").replace("Value error, ", "")
    if not message:  # a group of commands alone, without one of them: typer has printed its help
        raise typer.Exit(WRONG_INPUT)
    for problem in getattr(error.__cause__, "errors", list)():  # pydantic's, whose text does not say the value
        typed = quoted(str(problem["input"]))
        message = message if typed in message else f"{message}, not {typed}"
    command = "blocksar" if error.ctx is None else error.ctx.command_path
    ending = " See" if message.endswith("?") else "; see"
    complain(f"{message[0].lower()}{message[1:]}{ending} {command} --help", WRONG_INPUT)


def ending(error: BaseException) -> tuple[int, str]:
    """The exit status of a command that ends with this, and what a person is told."""
    match error:
        case InputError():
            return WRONG_INPUT, str(error)
        case ProcessingError() | OSError():
            return FAILED, str(error)
        case KeyboardInterrupt():
            return INTERRUPTED, _stopped(INTERRUPTED)
        case Terminated():
            return TERMINATED, _stopped(TERMINATED)
        case _:  # ours: a traceback follows
            return FAILED, f"{type(error).__name__}: {error}"


@contextmanager
def progress_of(context: typer.Context) -> Iterator[Progress]:
    """What shows how far a command has come, and logs what it was told and how it ended."""
    settings = context.params
    with Progress(quiet=settings["quiet"], log=settings["json_log"]) as progress:
        progress.start(" ".join(context.command_path.split()[1:]), settings, __version__)
        try:
            yield progress
        except BaseException as error:
            progress.end(*ending(error))
            raise
        progress.end(0)


# ---------------------------------------------------------------- options that several commands share

Blocks = Annotated[str, typer.Option(metavar="auto|N", help="Angular blocks; auto: the fewest that serve.")]
RIVALS = "Rivals, to compare with"
CoefficientsOption = Annotated[
    Coefficients, typer.Option(help="Fitted on time-frequency lines, or as printed.", rich_help_panel=RIVALS)
]
PerturbationOption = Annotated[
    Perturbation,
    typer.Option(help="All the processor has, one in Doppler only, or none: a deramp only.", rich_help_panel=RIVALS),
]
KeystoneOption = Annotated[
    bool,
    typer.Option("--keystone/--no-keystone", help="Without: RCMC by one reference in time.", rich_help_panel=RIVALS),
]
DerotationOption = Annotated[
    Derotation, typer.Option(help="Linear: one Doppler rate only, which needs a higher PRF.", rich_help_panel=RIVALS)
]
RangeModelOption = Annotated[
    RangeModel,
    typer.Option(help="Conventional, with closed form: variables substituted after RWC.", rich_help_panel=RIVALS),
]
PROCESSORS = f"{', '.join(get_args(Processor)[:-1])}, or the exact, slow backprojection"
ProcessorOption = Annotated[Processor, typer.Option(metavar="NAME", help=f"{PROCESSORS}.")]
GridOption = Annotated[
    str | None,
    typer.Option(metavar="x0:x1:dx,y0:y1:dy", help="Image points, m; default: the lit sector at half the resolution."),
]
Workers = Annotated[
    int | None, typer.Option(metavar="N", min=1, help="Worker processes; default: as the machine allows.")
]
Threads = Annotated[
    int | None, typer.Option(metavar="N", min=1, help="Threads of each worker; default: as the cores allow.")
]
MemoryLimit = Annotated[
    str | None, typer.Option(metavar="SIZE", help="Memory of each worker, such as 2GiB; default: its share.")
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace what stands at --out.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress.")]
JsonLog = Annotated[
    str | None, typer.Option(metavar="FILE", help="Append progress as JSON, one object a line; also with --quiet.")
]
PerformanceReport = Annotated[
    str | None, typer.Option(metavar="FILE.html", help="Write dask's performance report, also where the run fails.")
]

# ---------------------------------------------------------------- commands

app = typer.Typer(
    name="blocksar",
    cls=Commands,
    help="Focus squint-TOPS radar data by angular blocks, in parallel, to a calibrated ground image."
    "\n\nExample: [bold]blocksar demo --out demo-run[/bold]",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="rich",
    # A traceback that reaches the user is a defect: print it whole and plain, so that it can be sent in.
    pretty_exceptions_enable=False,
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"blocksar {__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Options that stand before a command."""


@app.command()
def demo(
    context: typer.Context,
    out: Annotated[str, typer.Option(help="Folder of the run.")] = "demo-run",
    workers: Workers = None,
    threads: Threads = None,
    memory_limit: MemoryLimit = None,
    performance_report: PerformanceReport = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json_log: JsonLog = None,
) -> None:
    """Simulate the paper's scene, focus it, measure it, show it.

    Leaves the run in the folder, with a picture of the mosaic, contour plots of nine targets, and report.html, a page
    for the browser.

    Example: [bold]blocksar demo --out demo-run[/bold]
    """
    memory = None if memory_limit is None else parse_memory(memory_limit)

    from blocksar import api

    with progress_of(context) as progress:
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
    out: Annotated[str, typer.Option(help="Phase-history store to write.")],
    raw: Annotated[bool, typer.Option("--raw", help="Write a raw chirped echo over fast time.")] = False,
    cphd: Annotated[bool, typer.Option("--cphd", help="Write a CPHD 1.1.0 file instead of a store.")] = False,
    origin: Annotated[
        str | None, typer.Option(metavar="LAT,LON,HEIGHT", help="Of the scene's centre in the CPHD file: degrees, m.")
    ] = None,
    threads: Threads = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json_log: JsonLog = None,
) -> None:
    """Simulate the phase history of a scene, with exact ranges.

    Example: [bold]blocksar simulate table1 --out table1.zarr[/bold]
    """
    place = None if origin is None else parse_origin(origin)

    from blocksar import api

    with progress_of(context) as progress:
        api.simulate(
            scene, out, raw=raw, cphd=cphd, origin=place, threads=threads, overwrite=overwrite, progress=progress
        )
    typer.echo(f"wrote {out}")


@app.command()
def plan(
    source: Annotated[str, typer.Argument(metavar="PH.zarr|SCENE.toml", help="Phase-history store or scene.")],
    processor: Annotated[
        PlannedProcessor,
        typer.Option(metavar="NAME", help=f"{PROCESSORS}; auto: all chains side by side, and the best one proposed."),
    ] = "angular-division",
    blocks: Blocks = "auto",
    coefficients: CoefficientsOption = "fitted",
    perturbation: PerturbationOption = "all",
    keystone: KeystoneOption = True,
    derotation: DerotationOption = "nonlinear",
    range_model: RangeModelOption = "polar",
    grid: GridOption = None,
    workers: Workers = None,
    memory_limit: MemoryLimit = None,
) -> None:
    """Say how a collection would be focused, and how sharp its image would be.

    Blocks, residual phase, predicted side lobes and widths, memory; no samples are read.

    A collection that cannot be focused as asked: the reason follows, with its figure, and the exit status is 2.

    Example: [bold]blocksar plan table1 --blocks 3[/bold]
    """
    settings = _settings(
        blocks, coefficients, perturbation, keystone, derotation, range_model, grid, workers, memory_limit
    )

    from blocksar import api

    made = api.plan(source, processor=processor, **settings)
    show(made)
    if made.refusal is not None:
        complain(made.refusal, WRONG_INPUT)


@app.command()
def focus(
    context: typer.Context,
    source: Annotated[str, typer.Argument(metavar="PH.zarr", help="Phase-history store.")],
    out: Annotated[str, typer.Option(metavar="RUN", help="Folder of the run; an unfinished one is resumed.")],
    processor: ProcessorOption = "angular-division",
    blocks: Blocks = "auto",
    coefficients: CoefficientsOption = "fitted",
    perturbation: PerturbationOption = "all",
    keystone: KeystoneOption = True,
    derotation: DerotationOption = "nonlinear",
    range_model: RangeModelOption = "polar",
    grid: GridOption = None,
    workers: Workers = None,
    threads: Threads = None,
    memory_limit: MemoryLimit = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="A running dask scheduler, instead of an own cluster.")
    ] = None,
    performance_report: PerformanceReport = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json_log: JsonLog = None,
) -> None:
    """Focus a phase history to a calibrated ground image.

    Example: [bold]blocksar focus table1.zarr --out run --blocks 3[/bold]
    """
    settings = _settings(
        blocks, coefficients, perturbation, keystone, derotation, range_model, grid, workers, memory_limit
    )

    from blocksar import api

    with progress_of(context) as progress:
        report = api.focus(
            source,
            out,
            processor=processor,
            **settings,
            threads=threads,
            scheduler=scheduler,
            overwrite=overwrite,
            progress=progress,
            performance_report=performance_report,
        )
    show(report)


@app.command()
def quality(
    run: Annotated[str, typer.Argument(metavar="RUN", help="Folder of a finished run.")],
    targets: Annotated[
        str | None, typer.Option(metavar="FILE", help="Targets to measure; default: those that the run knows.")
    ] = None,
    reference: Annotated[
        bool, typer.Option("--reference", help="Compare chips of the image with exact back-projection.")
    ] = False,
) -> None:
    """Measure side-lobe ratios, widths, position and calibration of every target.

    Prints the table with its definitions, and writes it to RUN/quality.json.

    Example: [bold]blocksar quality run --reference[/bold]
    """
    from blocksar import api

    show(api.quality(run, targets=targets, reference=reference))


@app.command()
def report(
    context: typer.Context,
    run: Annotated[str, typer.Argument(metavar="RUN", help="Folder of a finished run.")],
    out: Annotated[str | None, typer.Option(metavar="FILE", help="The page; default: RUN/report.html.")] = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json_log: JsonLog = None,
) -> None:
    """Write one HTML page about a run, which opens in any browser and needs no network.

    The image with zoom, block borders and targets; the plan beside what was measured; responses; times; provenance.

    Example: [bold]blocksar report run[/bold]
    """
    from blocksar import api

    with progress_of(context) as progress:
        made = api.report(run, out=out, overwrite=overwrite, progress=progress)
    show(made)


ingest = typer.Typer(
    name="ingest",
    help="Measured data to a phase history.\n\n"
    "Example: [bold]blocksar ingest cphd collect.cphd --out collect.zarr[/bold]",
    no_args_is_help=True,
)
app.add_typer(ingest)


@ingest.command("cphd")
def ingest_cphd(
    context: typer.Context,
    source: Annotated[str, typer.Argument(metavar="SOURCE.cphd", help="CPHD file, version 1.0.1 or 1.1.0.")],
    out: Annotated[str, typer.Option(help="Phase-history store to write.")],
    channel: Annotated[
        str | None, typer.Option(metavar="NAME", help="Which channel, where the file has several.")
    ] = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json_log: JsonLog = None,
) -> None:
    """Turn a CPHD file into a phase history, in the tangent frame at its scene's reference point.

    Example: [bold]blocksar ingest cphd collect.cphd --out collect.zarr[/bold]
    """
    from blocksar import api

    with progress_of(context) as progress:
        report = api.ingest_cphd(source, out, channel=channel, overwrite=overwrite, progress=progress)
    show(report)


@ingest.command("gotcha")
def ingest_gotcha(
    context: typer.Context,
    source: Annotated[list[str], typer.Argument(metavar="SOURCE.mat...", help="MATLAB files of one pass.")],
    out: Annotated[str, typer.Option(help="Phase-history store to write.")],
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json_log: JsonLog = None,
) -> None:
    """Join the AFRL Gotcha set's MATLAB files in azimuth into a phase history, in their scene-centred frame.

    Example: [bold]blocksar ingest gotcha data_3dsar_pass1_az00*_HH.mat --out gotcha.zarr[/bold]
    """
    from blocksar import api

    with progress_of(context) as progress:
        report = api.ingest_gotcha(source, out, overwrite=overwrite, progress=progress)
    show(report)


export = typer.Typer(
    name="export",
    help="The image of a run to a file of a standard format.\n\n"
    "Example: [bold]blocksar export png run --out image.png[/bold]",
    no_args_is_help=True,
)
app.add_typer(export)

Run = Annotated[str, typer.Argument(metavar="RUN", help="Folder of a finished run.")]


@export.command("sicd")
def export_sicd(
    context: typer.Context,
    run: Run,
    out: Annotated[str, typer.Option(help="SICD file (NITF) to write.")],
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json_log: JsonLog = None,
) -> None:
    """Write the complex image, on its ground plane, as a SICD file; the run must be georeferenced.

    Example: [bold]blocksar export sicd run --out image.nitf[/bold]
    """
    from blocksar import api

    with progress_of(context) as progress:
        report = api.export("sicd", run, out, overwrite=overwrite, progress=progress)
    show(report)


@export.command("geotiff")
def export_geotiff(
    context: typer.Context,
    run: Run,
    out: Annotated[str, typer.Option(help="GeoTIFF to write.")],
    content: Annotated[
        Literal["amplitude", "complex"], typer.Option(help="What its pixels are: float32, or complex64.")
    ] = "amplitude",
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json_log: JsonLog = None,
) -> None:
    """Write the image as a cloud-optimised GeoTIFF; the run must be georeferenced.

    Example: [bold]blocksar export geotiff run --out image.tif[/bold]
    """
    from blocksar import api

    with progress_of(context) as progress:
        report = api.export("geotiff", run, out, content=content, overwrite=overwrite, progress=progress)
    show(report)


@export.command("png")
def export_png(
    context: typer.Context,
    run: Run,
    out: Annotated[str, typer.Option(help="PNG to write.")],
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    json_log: JsonLog = None,
) -> None:
    """Draw the image in decibels, with axes in metres, a scale bar, the look direction and north.

    Example: [bold]blocksar export png run --out image.png[/bold]
    """
    from blocksar import api

    with progress_of(context) as progress:
        report = api.export("png", run, out, overwrite=overwrite, progress=progress)
    show(report)


def main() -> None:
    """Entry point of `blocksar`."""
    catch_signals()
    app(prog_name="blocksar")


def catch_signals() -> None:
    """Let Ctrl-C raise KeyboardInterrupt and SIGTERM raise Terminated, and see to it that the process then ends."""
    for number in (signal.SIGINT, signal.SIGTERM):
        # A shell starts what runs in the background with Ctrl-C ignored: so it stays.
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _stop)


def _stop(number: int, frame: FrameType | None) -> None:
    """End in good order; at once if asked again, or if that order takes longer than GRACE."""
    status = INTERRUPTED if number == signal.SIGINT else TERMINATED
    for each in (signal.SIGINT, signal.SIGTERM):
        signal.signal(each, lambda *_: _stop_at_once(status))
    late = threading.Timer(GRACE, _stop_at_once, (status,))
    late.daemon = True
    late.start()
    raise KeyboardInterrupt if status == INTERRUPTED else Terminated(TERMINATED)


def _stop_at_once(status: int) -> None:
    """Workers end with the process that started them; what is half-written has a name that nobody takes for whole."""
    abandon(status, _stopped(status))
    os.write(2, f"blocksar: {_stopped(status)}\n".encode())
    os._exit(status)


def _stopped(status: int) -> str:
    how = "interrupted" if status == INTERRUPTED else "terminated"
    return f"{how}; what was finished stays: give the same command again to go on"


if __name__ == "__main__":
    main()
