"""plan: how a collection would be focused, and how sharp its image would be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from blocksar.api import definitions
from blocksar.api.arguments import (
    GridLike,
    Source,
    blocks_of,
    channels_of,
    collections_of,
    fidelity_of,
    grid_of,
    in_this_process,
    memory_of,
    sources_of,
)
from blocksar.api.ground import read_ground
from blocksar.api.reports import Table
from blocksar.api.shortfall import describe_shortfall
from blocksar.api.shown import PlanReport
from blocksar.budget import FIDELITY
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid, ground_resolution
from blocksar.collection.lit_sums import most_lit_pulses
from blocksar.collection.region import Owned
from blocksar.collection.terrain import Surface
from blocksar.collection.weighting import Weighting
from blocksar.constants import MIB, SINC_WIDTH
from blocksar.errors import InputError
from blocksar.focusing.method import (
    Coefficients,
    Derotation,
    Method,
    Perturbation,
    PlannedProcessor,
    RangeModel,
    method_of,
)
from blocksar.focusing.relief_correction import bend_scale
from blocksar.graph.machine import Resources, machine, pace, resources
from blocksar.ingestion.terrain.reading import Ground, coverage_note
from blocksar.inspection.sentences import doubted_time
from blocksar.places import Location
from blocksar.planning import choice, effort
from blocksar.planning.block import BlockPlan
from blocksar.planning.choice import Contender
from blocksar.planning.disk import SAMPLE, run_bytes
from blocksar.planning.memory import checked_back_projection_memory
from blocksar.planning.plan import Plan, plan_collection
from blocksar.planning.prediction import Prediction
from blocksar.planning.segments import Divided, PlannedSegment, joint_grid, plan_segments
from blocksar.progress import Work

FEW_BLOCKS, WORST = 12, 10  # most blocks that are all shown, and how many are of more
BLOCK_HEADER = (
    "block", "yaw (deg)", "range (km)", "Doppler bins", "padded", "bias (m/s2)", "residual phase (rad)",
    "quadratic (rad)", "PSLR (dB)", "width / limit", "azimuth width (m)", "migration (cells)", "memory (MiB)",
)  # fmt: skip
FINE = 0.9999  # coherence from which on it is shown with six decimals
TRACK_TOLD = 0.01  # rad: noise of the track that leaves less is not mentioned
LOOKED_AT = 64  # points along a side of a grid at which lit pulses are counted
SHORT_DWELL = 12  # pulses, below which a coherence of up to 0.002 less than is predicted was measured


def plan(
    source: Source,
    *,
    processor: PlannedProcessor = "angular-division",
    blocks: int | Literal["auto"] = "auto",
    fidelity: float = FIDELITY,
    weighting: str = "uniform",
    weighting_range: str | None = None,
    weighting_azimuth: str | None = None,
    coefficients: Coefficients = "fitted",
    perturbation: Perturbation = "all",
    keystone: bool = True,
    derotation: Derotation = "nonlinear",
    range_model: RangeModel = "polar",
    grid: GridLike | None = None,
    terrain: Location | None = None,
    surface: Surface = "plane",
    vertical: str | None = None,
    workers: int | None = None,
    memory_limit: int | str | None = None,
) -> PlanReport:
    """Predict how a collection would be focused, and how sharp the image would be. Reads no samples.

    Parameters
    ----------
    source : path or xarray.Dataset, or a list of them
        Phase-history store or a dataset of its contract, scene file (TOML), or the name of a shipped scene. Several are
        planned for one image.
    processor : {"angular-division", "keystone-resampling", "high-order-phase", "backprojection", "auto"}
        Chain to plan. "auto" compares the first three and proposes one. Default: "angular-division".
    blocks : int or "auto"
        Number of angular blocks, at least 1. "auto" (default): the fewest that keep `fidelity` and fit the memory.
    fidelity : float
        Coherence with exact back-projection that "auto" keeps where it can, below 1. Default: 0.999.
    weighting : str
        Taper over band and dwell: "uniform", "taylor:NBAR:SLL" (such as "taylor:4:-35"), "hamming", "hann" or
        "kaiser:BETA". Default: "uniform".
    weighting_range, weighting_azimuth : str, optional
        Taper over the band, or over the dwell, instead.
    coefficients : {"fitted", "closed-form"}
        "fitted" (default): fitted to traced time-frequency lines. "closed-form": expanded about the centre of each
        block, as in the papers.
    perturbation : {"all", "frequency", "none"}
        "all" (default): those of the processor. "frequency": one in Doppler only. "none": deramp only.
    keystone : bool
        False: RCMC with one reference in the time domain, without keystone transform. Default: True.
    derotation : {"nonlinear", "linear"}
        "linear": recovery removes a single Doppler rate, which needs a higher PRF. Default: "nonlinear".
    range_model : {"polar", "conventional"}
        "conventional": substituted variables after range-walk correction; needs `coefficients="closed-form"`. Default:
        "polar".
    grid : Grid, ((x0, x1, dx), (y0, y1, dy)) or str, optional
        Image points x0, x0 + dx, ... < x1 in m in the scene frame, likewise y; as a text "x0:x1:dx,y0:y1:dy". Default:
        the box around the lit sector at about half the resolution. Needed if the beam is not steered.
    terrain : path, optional
        Heights of the ground: zarr or netCDF with `height` (y, x) in m of the scene frame, or a GeoTIFF in any
        coordinate reference system, which needs a georeference. Default: the plane z = ground_height.
    surface : {"plane", "ellipsoid"}
        "ellipsoid": WGS 84 at ground_height, which needs a georeference. Default: "plane".
    vertical : str, optional
        What a GeoTIFF's heights are measured from, if it does not say so: "ellipsoid", "egm96" or "egm2008"; or
        "egm2008:FILE" with the geoid's grid. Needed for such a file only.
    workers : int, optional
        Worker processes to plan for; 0: the calling process does the work. Default: as for `focus`.
    memory_limit : int or str, optional
        Memory of each worker, bytes or a text such as "2GiB". Default: its share of the machine's memory.

    Returns
    -------
    PlanReport
        `tables` has the blocks, the ten with the least coherence if there are many, and `details` all blocks with all
        figures; `refusal` is the reason if the plan cannot be carried out. `result` is the `planning.plan.Plan` (of
        several segments a tuple of them), the `Grid` for back-projection, or None if "auto" has no processor to
        propose. The method `plot` draws blocks, footprint and track.

    Raises
    ------
    InputError
        If the source is no collection, a setting is wrong, the PRF is too low, or the grid lies outside the swath.
    """
    automatic = processor == "auto"
    method = method_of(
        "angular-division" if automatic else processor,
        coefficients=coefficients,
        perturbation=perturbation,
        keystone=keystone,
        derotation=derotation,
        range_model=range_model,
    )
    if automatic and method is not None and method.rival:
        raise InputError(
            f"{' and '.join(method.departures)}: processor auto compares processors as they are; leave it out"
        )
    tapers = Weighting.parse(weighting, weighting_range, weighting_azimuth)
    points, n_blocks, least = grid_of(grid), blocks_of(blocks), fidelity_of(fidelity)
    limit, collections = memory_of(memory_limit), collections_of(source)
    here = in_this_process(workers, collections)
    share = resources(0 if here else workers, None, limit)
    assumed = share._replace(workers=0) if here else share
    of_each = _channels_line(source)
    ground = Ground(terrain=terrain, surface=surface, vertical=vertical)
    heights = None
    if not ground.plane:
        points = points or joint_grid([Geometry(collection=each) for each in collections])
        heights = read_ground(ground, collections[0], points, sources_of(source)[0])
        if heights is not None and (gaps := coverage_note(heights, points)) is not None:
            of_each.append(gaps)
    if method is None:
        return _told_first(_plan_backprojection(collections, points, assumed), of_each)

    def plan_by(
        collection: Collection, *, grid: Grid | None, like: Divided | None = None, owned: Owned | None = None,
        by: Method = method,
    ) -> Plan:  # fmt: skip
        return plan_collection(
            collection, blocks=like.blocks if like else n_blocks, parts=like.parts if like else "auto",
            fidelity=least, weighting=tapers, method=by, grid=grid, owned=owned, workers=share.workers,
            memory_limit=share.memory_limit, terrain=heights,
        )  # fmt: skip

    if not automatic:
        planned = plan_segments(plan_by, collections, grid=points, cut=blocks == "auto")
        return _told_first(_report_segments(planned, assumed), of_each)
    if len(collections) > 1:
        raise InputError("processor is auto, but several sources are given: compare processors for one of them")
    contenders = choice.contend(lambda method: plan_by(collections[0], grid=points, by=method))
    return _told_first(_report_contenders(contenders, assumed), of_each)


def _channels_line(source: Source) -> list[str]:
    """That the plan is one of several channels, if it is."""
    names = channels_of(source)
    return [f"{len(names)} channels ({', '.join(names)}), one after the other, each as follows"] if names else []


def _told_first(report: PlanReport, lines: Sequence[str]) -> PlanReport:
    """A report with lines before its own."""
    return replace(report, summary=[*lines, *report.summary])


def _report_plan(plan: Plan, assumed: Resources) -> PlanReport:
    return PlanReport(
        tables=[block_table([plan])],
        details=plan_details([plan]),
        definitions=definitions.PLAN,
        summary=[*plan_lines(plan), time_line(effort.of_plan(plan), assumed)],
        refusal=plan.refusal,
        result=plan,
        geometry=plan.geometry,
    )


def _report_segments(segments: Sequence[PlannedSegment], assumed: Resources) -> PlanReport:
    """Report the blocks of all segments together, then each segment."""
    plans = [segment.plan for segment in segments]
    if len(plans) == 1:
        return _report_plan(plans[0], assumed)
    lines = []
    for number, segment in enumerate(segments):
        pulses = "" if segment.pulses is None else f", pulses {segment.pulses[0]} .. {segment.pulses[1] - 1}"
        blocks = f"blocks {segment.first_block} .. {segment.first_block + segment.plan.n_blocks - 1}"
        lines.append(f"segment {number} (collection {segment.collection}{pulses}, {blocks}):")
        lines += [f"  {line}" for line in plan_lines(segment.plan)]
    lines.append(time_line(effort.together([effort.of_plan(plan) for plan in plans]), assumed))
    return PlanReport(
        tables=[block_table(plans)],
        details=plan_details(plans),
        definitions=definitions.PLAN,
        summary=lines,
        refusal=next((plan.refusal for plan in plans if plan.refusal is not None), None),
        result=tuple(plans),
    )


def _report_contenders(contenders: list[Contender], assumed: Resources) -> PlanReport:
    """Report all processors side by side, then the plan of the proposed one."""
    best, reason = choice.propose(contenders)
    least = min(c.plan.work() for c in contenders if c.plan is not None)
    header = (
        "processor", "blocks", "residual phase (rad)", "quadratic (rad)", "PSLR (dB)", "width / limit",
        "migration (cells)", "coherence", "work", "memory (MiB)", "keeps the fidelity",
    )  # fmt: skip
    rows = [_contender_row(c, least) for c in contenders]
    if best is None or best.plan is None:
        return PlanReport(tables=[(header, rows)], summary=[reason], refusal=reason)
    report = _report_plan(best.plan, assumed)
    return replace(
        report,
        tables=[(header, rows), *report.tables],
        details=[(header, rows), *report.details],
        summary=[reason, *report.summary, f"to focus with it: --processor {best.processor}"],
    )


def _contender_row(contender: Contender, least: float) -> list[str]:
    plan = contender.plan
    if plan is None:
        return [contender.processor, *["-"] * 9, "no"]
    p = contender.worst.prediction
    return [
        contender.processor, str(plan.n_blocks), f"{p.residual_phase:.4f}", f"{p.quadratic_phase:.4f}", f"{p.pslr:.2f}",
        f"{p.width:.3f}", f"{p.migration:.3f}", _digits(plan.coherence), f"{plan.work() / least:.2f}",
        f"{plan.memory / MIB:.0f}", "yes" if contender.serves else "no",
    ]  # fmt: skip


def block_table(plans: Sequence[Plan]) -> Table:
    """The figures that decide, of all blocks, or of the ten that are predicted to lose most."""
    blocks = [block for plan in plans for block in plan.blocks]
    few, divided = len(blocks) <= FEW_BLOCKS, any(plan.parts > 1 for plan in plans)
    worst = sorted(blocks, key=lambda block: block.prediction.coherence)[:WORST]
    header = [
        "block" if few else f"worst {WORST} of {len(blocks)}", "yaw (deg)", *(["range (km)"] if divided else []),
        "coherence", *([] if divided else ["residual phase (rad)", "PSLR (dB)"]), "width / limit", "memory (MiB)",
    ]  # fmt: skip
    rows = []
    for block in blocks:
        if few or block in worst:
            own, p = dict(zip(BLOCK_HEADER, _block_row(block), strict=True)), block.prediction
            rows.append([block.name, *(own.get(name, _digits(p.coherence)) for name in header[1:])])
    return header, rows


def plan_details(plans: Sequence[Plan]) -> list[Table]:
    """All figures of all blocks, and what their coherence is made of."""
    relief = [] if plans[0].geometry.terrain is None else [_relief_table(plans)]
    return [_all_blocks(plans), _coherence_table(plans), *relief]


def _relief_table(plans: Sequence[Plan]) -> Table:
    """The terrain of each block, and what it does to the phase of targets far above or below its smooth part."""
    header = ("block", "z (m)", "over the smooth ground (m)", "bend taken out (rad)", "predicted coherence")
    rows = []
    for block in (block for plan in plans for block in plan.blocks):
        relief = block.ground.relief
        assert relief is not None
        heights = f"{relief.lowest:.1f} .. {relief.highest:.1f}", f"{relief.low:.1f} .. {relief.high:.1f}"
        bend = 2 * np.pi * relief.most_bend * bend_scale(block.ground)
        rows.append([block.name, *heights, f"{bend:.2f}", _digits(block.prediction.coherence)])
    return header, rows


def _all_blocks(plans: Sequence[Plan]) -> Table:
    return BLOCK_HEADER, [_block_row(block) for plan in plans for block in plan.blocks]


def _coherence_table(plans: Sequence[Plan]) -> Table:
    header = (
        "block", "predicted coherence", "lost by residual phase", "by range migration", "at the ends of the dwell",
        "by noise of the track",
    )  # fmt: skip
    return header, [_coherence_row(block.name, block.prediction) for plan in plans for block in plan.blocks]


def _coherence_row(name: str, p: Prediction) -> list[str]:
    losses = (p.phase_loss, p.range_loss, p.dispersion_loss, p.track_loss)
    places = 4 if p.coherence < FINE else 6
    return [name, _digits(p.coherence), *(f"{loss:.{places}f}" for loss in losses)]


def _digits(coherence: float) -> str:
    """A coherence with four decimals, or six where four would show none of its loss."""
    return f"{coherence:.{4 if coherence < FINE else 6}f}"


def _block_row(block: BlockPlan) -> list[str]:
    low, high = np.degrees([block.low, block.high])
    p = block.prediction
    return [
        block.name,
        f"{low:.3f} .. {high:.3f}",
        f"{block.ground.near / 1e3:.3f} .. {block.ground.far / 1e3:.3f}",
        f"{block.first_bin} .. {block.first_bin + block.n_bin}",
        str(block.ground.doppler.size),
        f"{block.choice.candidate.bias:.1f}",
        f"{p.residual_phase:.4f}",
        f"{p.quadratic_phase:.4f}",
        f"{p.pslr:.2f}",
        f"{p.width:.3f}",
        f"{p.resolution:.3f}",
        f"{p.migration:.3f}",
        f"{block.memory / MIB:.0f}",
    ]


def plan_lines(plan: Plan) -> list[str]:
    """What there is to say of a plan besides its tables."""
    recovery, collection, grid = plan.recovery, plan.geometry.collection, plan.grid
    spectrum = recovery.doppler.size * collection.n_range_frequency * 8
    divided = f" of {plan.parts} range sub-blocks each" if plan.parts > 1 else ""
    lines = [
        f"{plan.n_blocks} blocks{divided}, {plan.method.coefficients} coefficients; "
        f"track: {plan.geometry.track}, misfit {plan.geometry.track.max_misfit:.2g} m",
        f"derotated band {recovery.band[1] - recovery.band[0]:.0f} Hz at PRF {collection.prf:.0f} Hz; recovered "
        f"spectrum {recovery.doppler.size} x {collection.n_range_frequency} ({spectrum / MIB:.0f} MiB), "
        f"{recovery.doppler.extent:.0f} Hz wide",
        f"image {grid.shape[1]} x {grid.shape[0]} pixels: x {grid.x[0]:g} .. {grid.x[-1]:g} m every {grid.dx:g} m, "
        f"y {grid.y[0]:g} .. {grid.y[-1]:g} m every {grid.dy:g} m",
    ]
    if plan.geometry.terrain is not None:
        low, high = plan.geometry.terrain.limits
        lines.append(f"terrain: z = {low:.5g} .. {high:.5g} m; blocks are fitted on its smooth part")
    lines.append(
        "predicted coherence with exact back-projection: at least "
        f"{_digits(plan.coherence)} for targets with full dwell"
    )
    if not plan.weighting.uniform:
        azimuth = plan.weighting.azimuth.ideal.pslr
        if plan.stays:  # each target has a part of the taper
            azimuth = max(block.prediction.ideal_pslr for block in plan.blocks)
        lines.append(
            f"weighting {plan.weighting.text}: ideal side lobes {plan.weighting.range.ideal.pslr:.2f} dB in range, "
            f"{azimuth:.2f} dB in azimuth"
        )
    if plan.stays:
        lines.append(
            "the beam stays on its ground: all pulses are summed, and those that do not light a pixel taken out"
        )
    if plan.edge_pulses:
        lines.append(f"the edges of dwells, some {plan.edge_pulses} pulses at either end, are back-projected")
    if (parts := max(len(block.sampling.over_band) for block in plan.blocks)) > 1:
        lines.append(f"dwells are gated in {parts} parts over the band, which are focused one after the other")
    lines.append(_disk_line(plan))
    if (doubt := doubted_time(plan.geometry.collection)) is not None:
        lines.append(doubt)
    lines += [line for doubt in (undersampling, short_dwells) if (line := doubt(plan)) is not None]
    noise = max(block.prediction.track_phase for block in plan.blocks)
    if noise > TRACK_TOLD:
        lines.append(
            f"the noise of the track leaves a phase of {noise:.2g} rad r.m.s. over a dwell; smooth the positions"
        )
    if not plan.faithful:
        lines.append(describe_shortfall(plan))
    return lines


def _disk_line(plan: Plan) -> str:
    """Room that a run needs; a raw echo's range compression is not counted, since a plan knows no samples."""
    stores = run_bytes(plan)
    parts = ", ".join(f"{name} {size / MIB:.0f}" for name, size in stores.items())
    return f"a run writes about {sum(stores.values()) / MIB:.0f} MiB ({parts})"


def time_line(work: Work, assumed: Resources) -> str:
    """How long a run would take on this machine, by stage; the only part of a plan that is measured."""
    workers = min(assumed.workers, machine()[0])  # more than there are cores gain nothing
    seconds = effort.seconds_of(work, workers=workers, threads=assumed.threads, pace=pace())
    if not assumed.workers:
        del seconds["start"]
    stages = ", ".join(f"{name} {time_text(value)}" for name, value in seconds.items())
    return (
        f"a run takes about {time_text(sum(seconds.values()))} on this machine {workforce(assumed)} "
        f"({stages}), more where others use it, the disk is slow, or loops are not compiled"
    )


def workforce(assumed: Resources) -> str:
    """Who does the work, in words."""
    count = assumed.workers
    return f"with {count} worker{'s' if count > 1 else ''}" if count else "in one process"


def time_text(seconds: float) -> str:
    """A predicted time with as many digits as it deserves.

    Examples
    --------
    >>> time_text(0.04), time_text(13.3), time_text(250), time_text(9000)
    ('1 s', '13 s', '4 min', '2.5 h')
    """
    if seconds < 100:
        return f"{max(round(seconds), 1)} s"
    return f"{round(seconds / 60)} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


def undersampling(plan: Plan) -> str | None:
    """A sentence if the grid is coarser than the resolution of any block, else None."""
    step = max(plan.grid.dx, plan.grid.dy)
    widths = [
        min(ground_resolution(plan.geometry, (b.ground.near + b.ground.far) / 2, (b.low + b.high) / 2))
        for b in plan.blocks
    ]
    finest = min(widths)
    if step <= finest / SINC_WIDTH:
        return None
    return (
        f"the grid's step of {step:g} m undersamples the image, whose resolution is {finest:.3g} m: targets between "
        f"its points are lost, and spectra fold; a step of {finest / 2:.2g} m shows everything"
    )


def short_dwells(plan: Plan) -> str | None:
    """A sentence if no point of the grid is lit by enough pulses, else None."""
    n_pulse, lit = plan.geometry.collection.n_pulse, _lit_pulses(plan.geometry, plan.grid)
    if lit >= SHORT_DWELL or n_pulse < SHORT_DWELL:
        return None
    return (
        f"{lit} pulses light a target at most, of {n_pulse}, and predictions hold from {SHORT_DWELL} pulses "
        "on; is beam_width in rad, and what says where the beam points?"
    )


def _lit_pulses(geometry: Geometry, grid: Grid) -> int:
    """The largest number of pulses that light any point of a grid."""
    return most_lit_pulses(
        geometry, *np.meshgrid(*(axis[:: max(axis.size // LOOKED_AT, 1)] for axis in (grid.x, grid.y)))
    )


def _plan_backprojection(collections: Sequence[Collection], grid: Grid | None, assumed: Resources) -> PlanReport:
    geometries = [Geometry(collection=collection) for collection in collections]
    grid = grid or joint_grid(geometries)
    pixels = grid.shape[0] * grid.shape[1]
    lit = sum(_lit_pulses(geometry, grid) for geometry in geometries)
    memory = max(
        checked_back_projection_memory(collection, grid, assumed.threads, assumed.memory_limit)
        for collection in collections
    )
    lines = [
        f"exact back-projection of {grid.shape[1]} x {grid.shape[0]} pixels, {lit} lit pulses each: "
        f"{pixels * lit / 1e9:.3g} G updates at most, {workforce(assumed)}",
        f"peak memory of a worker {memory / MIB:.0f} MiB",
        f"a run writes at most {pixels * SAMPLE / MIB:.0f} MiB",
        time_line(effort.together([effort.of_backprojection(each, grid) for each in geometries]), assumed),
    ]
    return PlanReport(summary=lines, result=grid, geometry=geometries[0])
