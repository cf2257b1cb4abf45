"""The commands `plan` and `focus`, which take the same settings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from blocksar.budget import FIDELITY, WAIT_WORKERS
from blocksar.cli.configuration import ConfigOption, PrintConfig, configuration
from blocksar.cli.display import hint, show
from blocksar.cli.endings import WRONG_INPUT, complain
from blocksar.cli.listening import listening
from blocksar.cli.options import (
    AutofocusOption,
    AzimuthWeighting,
    Blocks,
    Control,
    Discard,
    Everything,
    Explain,
    Fidelity,
    GridOption,
    GroundHeight,
    JsonLog,
    LooksOption,
    MemoryLimit,
    Overwrite,
    PerformanceReport,
    ProcessorOption,
    Quiet,
    RangeWeighting,
    Scheduler,
    SurfaceOption,
    TerrainOption,
    Threads,
    VerticalOption,
    WaitWorkers,
    WeightingOption,
    WholePulses,
    Workers,
    given,
    method_options,
    parse_settings,
)


@method_options
def plan(
    context: typer.Context,
    source: Annotated[list[str], typer.Argument(metavar="PH.zarr|SCENE.toml", help="Phase-history stores or scenes.")],
    processor: ProcessorOption = "angular-division",
    blocks: Blocks = "auto",
    fidelity: Fidelity = FIDELITY,
    weighting: WeightingOption = "uniform",
    weighting_range: RangeWeighting = None,
    weighting_azimuth: AzimuthWeighting = None,
    grid: GridOption = None,
    terrain: TerrainOption = None,
    surface: SurfaceOption = "plane",
    vertical: VerticalOption = None,
    whole_pulses: WholePulses = False,
    ground_height: GroundHeight = None,
    looks: LooksOption = None,
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
        one_or_all(source), processor=processor, terrain=terrain, surface=surface, vertical=vertical,
        ground_height=ground_height, whole_pulses=whole_pulses, looks=looks, **settings, **method,
    )  # fmt: skip
    show(proposal, context)
    if proposal.refusal is not None:
        complain(proposal.refusal, WRONG_INPUT)
    _hint_after_plan(context, source, proposal)


OF_PLAN = ("everything", "explain")  # its options that `focus` has not


def _hint_after_plan(context: typer.Context, sources: list[str], proposal: Any) -> None:
    """Simulate a scene, or focus phase histories with the same options."""
    from blocksar.api.arguments import is_scene

    for source in sources:
        if is_scene(source):
            hint(context, "simulate", source, "--out", f"{Path(source).stem}.zarr")
            return
    proposed = ["--processor", proposal.plan.processor] if context.params["processor"] == "auto" else []
    hint(
        context,
        "focus",
        *sources,
        "--out",
        "run",
        *proposed,
        *given(context, *OF_PLAN, *(["processor"] if proposed else [])),
    )


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
    looks: LooksOption = None,
    terrain: TerrainOption = None,
    surface: SurfaceOption = "plane",
    vertical: VerticalOption = None,
    whole_pulses: WholePulses = False,
    ground_height: GroundHeight = None,
    autofocus: AutofocusOption = False,
    control: Control = None,
    workers: Workers = None,
    threads: Threads = None,
    memory_limit: MemoryLimit = None,
    scheduler: Scheduler = None,
    wait_workers: WaitWorkers = WAIT_WORKERS,
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
            whole_pulses=whole_pulses,
            ground_height=ground_height,
            **method,
            autofocus=autofocus,
            control=control,
            threads=threads,
            scheduler=scheduler,
            wait_workers=wait_workers,
            overwrite=overwrite,
            discard=discard,
            progress=progress,
            performance_report=performance_report,
            dry_run=dry_run,
        )
    show(report)
    if dry_run:
        hint(context, "focus", *source, "--out", out, *given(context, "out", "dry_run"))
    elif report.measurable:
        hint(context, "quality", out)


def one_or_all(sources: list[str]) -> str | list[str]:
    """The only source, or all of them."""
    return sources if len(sources) > 1 else sources[0]
