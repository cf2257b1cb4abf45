"""The options that several commands share, and their conversion for `blocksar.api`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from inspect import Parameter, signature
from typing import Annotated, Any, Literal, TypedDict, get_args, get_type_hints

import typer

from blocksar.api.parsing import Axis, parse_blocks, parse_grid, parse_memory
from blocksar.cli.plugged import typer_option
from blocksar.collection.surface import Surface
from blocksar.focusing.method import ChainOptions, Coefficients, Method
from blocksar.options import options_of
from blocksar.processors import PROCESSORS
from blocksar.products.options import COLOUR_MAP, COLOUR_RANGE

Channel = Annotated[str | None, typer.Option(metavar="NAME", help="Of several channels.", show_default="the first")]
ColourMap = Annotated[str | None, typer_option(COLOUR_MAP)]
ColourRange = Annotated[str | None, typer_option(COLOUR_RANGE)]
Run = Annotated[str, typer.Argument(metavar="RUN", help="Folder of a finished run.")]
StoreOut = Annotated[str, typer.Option(metavar="STORE", help="Phase-history store to write.")]
ALTERNATIVES = "Alternative methods, for comparison"  # title of a panel in the help
METHOD_HELP = {each.name: each.option.help for each in options_of(ChainOptions)}

# Of the method's options the only one that scripts in workflows/ and deploy/ have; `plan` and `focus` have all.
CoefficientsOption = Annotated[
    Coefficients, typer.Option(help=METHOD_HELP["coefficients"], rich_help_panel=ALTERNATIVES)
]
Blocks = Annotated[
    str, typer.Option(metavar="auto|N", help="Number of angular blocks; auto: the fewest that keep the fidelity.")
]
Fidelity = Annotated[
    float, typer.Option(metavar="C", help="Coherence with exact back-projection that --blocks auto keeps.")
]
TAPERS = "uniform, taylor:NBAR:SLL (such as taylor:4:-35), hamming, hann, or kaiser:BETA"
WeightingOption = Annotated[str, typer.Option(metavar="NAME", help=f"Weighting of band and dwell: {TAPERS}.")]
RangeWeighting = Annotated[str | None, typer.Option(metavar="NAME", help="Weighting of the band instead.")]
AzimuthWeighting = Annotated[str | None, typer.Option(metavar="NAME", help="Weighting of the dwell instead.")]
ProcessorOption = Annotated[
    str, typer.Option(metavar="NAME", help=f"{', '.join(PROCESSORS.own)}: the fastest that keeps the fidelity.")
]
GridOption = Annotated[
    str | None,
    typer.Option(
        metavar="GRID",
        help="Image points x0:x1:dx,y0:y1:dy, m; default: the lit sector, spaced by half the resolution.",
    ),
]
TerrainOption = Annotated[
    str | None,
    typer.Option(metavar="FILE", help="Heights of the ground: zarr or netCDF in the scene frame, or GeoTIFF."),
]
SurfaceOption = Annotated[
    Surface, typer.Option(metavar="NAME", help="The ground without --terrain: plane, or ellipsoid, WGS 84.")
]
VerticalOption = Annotated[
    str | None,
    typer.Option(metavar="DATUM", help="Of a GeoTIFF's heights: ellipsoid, egm96, egm2008, or egm2008:FILE."),
]
WholePulses = Annotated[
    bool, typer.Option("--whole-pulses", help="Of a raw echo: leave ground NaN of which parts of pulses were recorded.")
]
GroundHeight = Annotated[
    float | None,
    typer.Option(metavar="M", help="Height z of the imaged plane in the scene frame; default: the store's."),
]
LooksOption = Annotated[
    int | None, typer.Option(metavar="N", help="Form N images, each of a part of every target's dwell.")
]
Workers = Annotated[
    int | None,
    typer.Option(metavar="N", min=0, help="Worker processes; 0: this process; default: by the cores."),
]
Threads = Annotated[
    int | None, typer.Option(metavar="N", min=1, help="Threads per worker; default: by the machine's cores.")
]
OwnThreads = Annotated[
    int | None, typer.Option(metavar="N", min=1, help="Number of threads; default: by the machine's cores.")
]
MemoryLimit = Annotated[
    str | None, typer.Option(metavar="SIZE", help="Memory per worker, such as 2GiB; default: its share.")
]
AutofocusOption = Annotated[
    bool, typer.Option("--autofocus", help="Correct the track from the samples first; see blocksar autofocus.")
]
Control = Annotated[
    str | None,
    typer.Option(metavar="FILE", help="With autofocus: JSON file of points at known places, which anchor the track."),
]
Scheduler = Annotated[
    str | None, typer.Option(metavar="ADDRESS", help="Use this dask scheduler instead of a local cluster.")
]
WaitWorkers = Annotated[
    float, typer.Option(metavar="SECONDS", help="Time to wait for workers while the scheduler has none; 0: none.")
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an existing output.")]
Discard = Annotated[
    bool, typer.Option("--discard", help="Remove spectrum and patches once the run needs them no more.")
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress, and no next command.")]
Everything = Annotated[bool, typer.Option("--all", help="Show all rows and columns of the tables.")]
Explain = Annotated[bool, typer.Option("--explain", help="Say what the columns mean.")]
JsonLog = Annotated[
    str | None, typer.Option(metavar="FILE", help="Append progress as JSON lines to a file, also with --quiet.")
]
PerformanceReport = Annotated[
    str | None, typer.Option(metavar="FILE.html", help="Write dask's performance report, also if the run fails.")
]


def given(context: typer.Context, *without: str) -> list[str]:
    """Return the options that stand on the command line, except some, as its words."""
    words: list[str] = []
    for parameter in context.command.params:
        source = context.get_parameter_source(parameter.name or "")
        option = max(parameter.opts, key=len)
        if parameter.name in without or source is None or source.name != "COMMANDLINE" or not option.startswith("-"):
            continue
        value = context.params[parameter.name or ""]
        if isinstance(value, bool):
            words.append(option if value else parameter.secondary_opts[0])
        else:
            words += [option, str(value)]
    return words


class Settings(TypedDict):
    """The settings besides the method that `plan` and `focus` share, as arguments of `blocksar.api`."""

    blocks: int | Literal["auto"]
    fidelity: float
    weighting: str
    weighting_range: str | None
    weighting_azimuth: str | None
    grid: tuple[Axis, Axis] | None
    workers: int | None
    memory_limit: int | None  # bytes


def parse_settings(
    blocks: str,
    fidelity: float,
    weighting: tuple[str, str | None, str | None],
    grid: str | None,
    workers: int | None,
    memory_limit: str | None,
) -> Settings:
    """Convert the options that `plan` and `focus` share.

    Raises
    ------
    InputError
        If blocks, grid or memory limit cannot be read.
    """
    return {
        "blocks": parse_blocks(blocks),
        "fidelity": fidelity,
        "weighting": weighting[0],
        "weighting_range": weighting[1],
        "weighting_azimuth": weighting[2],
        "grid": None if grid is None else parse_grid(grid),
        "workers": workers,
        "memory_limit": None if memory_limit is None else parse_memory(memory_limit),
    }


def _values(kind: Any) -> str | None:
    """The values that an option of this type takes, which a help of few columns can fold; None if it is a flag."""
    return ", ".join(map(str, get_args(kind))) or None


def method_options(command: Callable[..., None]) -> Callable[..., None]:
    """Decorate a command to accept every option in METHOD_HELP as a keyword argument.

    Types and defaults are those of the fields of `Method`.
    """
    types, defaults = get_type_hints(Method), {field.name: field.default for field in fields(Method)}
    options = [
        Parameter(
            name,
            Parameter.KEYWORD_ONLY,
            annotation=Annotated[
                types[name],
                typer.Option(help=text, metavar=_values(types[name]), rich_help_panel=ALTERNATIVES),
            ],
            default=defaults[name],
        )
        for name, text in METHOD_HELP.items()
    ]
    plain = signature(command, eval_str=True)
    own = [parameter for parameter in plain.parameters.values() if parameter.kind != Parameter.VAR_KEYWORD]
    command.__signature__ = plain.replace(parameters=[*own, *options])  # type: ignore[attr-defined]  # typer reads it
    return command
