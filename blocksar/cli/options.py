"""The options that commands share."""

from __future__ import annotations

from typing import Annotated, Literal, TypedDict, get_args

import typer

from blocksar.cli.parsing import Axis, parse_blocks, parse_grid, parse_memory
from blocksar.focusing.method import Coefficients, Derotation, Perturbation, Processor, RangeModel


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
