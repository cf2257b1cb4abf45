"""The options that several commands share, and their conversion for `blocksar.api`."""

from __future__ import annotations

from typing import Annotated, Literal, TypedDict, get_args

import typer

from blocksar.cli.parsing import Axis, parse_blocks, parse_grid, parse_memory
from blocksar.focusing.method import Coefficients, Derotation, Perturbation, Processor, RangeModel

ALTERNATIVES = "Alternative methods, for comparison"  # title of a panel in the help
PROCESSORS = f"{', '.join(get_args(Processor)[:-1])}, or backprojection, exact but slow"

Blocks = Annotated[str, typer.Option(metavar="auto|N", help="Number of angular blocks; auto: the fewest that suffice.")]
CoefficientsOption = Annotated[
    Coefficients,
    typer.Option(help="Fitted to time-frequency lines, or by the paper's closed forms.", rich_help_panel=ALTERNATIVES),
]
PerturbationOption = Annotated[
    Perturbation,
    typer.Option(
        help="All of the processor's, the one in Doppler only, or none: deramp only.", rich_help_panel=ALTERNATIVES
    ),
]
KeystoneOption = Annotated[
    bool,
    typer.Option(
        "--keystone/--no-keystone",
        help="Without keystone: RCMC by one reference in time.",
        rich_help_panel=ALTERNATIVES,
    ),
]
DerotationOption = Annotated[
    Derotation,
    typer.Option(help="Linear: a single Doppler rate, which needs a higher PRF.", rich_help_panel=ALTERNATIVES),
]
RangeModelOption = Annotated[
    RangeModel,
    typer.Option(help="Conventional: substitute variables after RWC; needs closed-form.", rich_help_panel=ALTERNATIVES),
]
ProcessorOption = Annotated[Processor, typer.Option(metavar="NAME", help=f"{PROCESSORS}.")]
GridOption = Annotated[
    str | None,
    typer.Option(
        metavar="x0:x1:dx,y0:y1:dy", help="Image points, m; default: the lit sector, spaced by half the resolution."
    ),
]
Workers = Annotated[
    int | None, typer.Option(metavar="N", min=1, help="Worker processes; default: by the machine's cores and memory.")
]
Threads = Annotated[
    int | None, typer.Option(metavar="N", min=1, help="Threads per worker; default: by the machine's cores.")
]
MemoryLimit = Annotated[
    str | None, typer.Option(metavar="SIZE", help="Memory per worker, such as 2GiB; default: its share.")
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an existing output.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress.")]
JsonLog = Annotated[
    str | None, typer.Option(metavar="FILE", help="Append progress as JSON lines to a file, also with --quiet.")
]
PerformanceReport = Annotated[
    str | None, typer.Option(metavar="FILE.html", help="Write dask's performance report, also if the run fails.")
]


class Settings(TypedDict):
    """The settings that `plan` and `focus` share, as arguments of `blocksar.api`."""

    blocks: int | Literal["auto"]
    coefficients: Coefficients
    perturbation: Perturbation
    keystone: bool
    derotation: Derotation
    range_model: RangeModel
    grid: tuple[Axis, Axis] | None
    workers: int | None
    memory_limit: int | None  # bytes


def settings_of(
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
    """Convert the options that `plan` and `focus` share.

    Raises
    ------
    InputError
        If blocks, grid or memory limit cannot be read.
    """
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
