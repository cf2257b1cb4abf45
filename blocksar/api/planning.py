"""plan: how a collection would be focused, and how sharp its image would be."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

from blocksar.api import definitions
from blocksar.api.arguments import Source, channels_of, collections_of, in_this_process, sources_of
from blocksar.api.exact_way import exact_way, naming_exact
from blocksar.api.ground import read_ground
from blocksar.api.look_plans import report_exact_looks, report_looks
from blocksar.api.looks import divide_dwells, one_source
from blocksar.api.parsing import GridLike
from blocksar.api.partial_pulses import imaged_collections, recorded_lines
from blocksar.api.plan_lines import exact_line, lit_pulses, outside_window, plan_lines, time_line, workforce
from blocksar.api.plan_tables import block_table, contender_table, plan_details
from blocksar.api.settings import PlanSettings
from blocksar.api.shown import PlanReport
from blocksar.budget import FIDELITY
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.collection.surface import Surface
from blocksar.collection.terrain import Terrain
from blocksar.constants import MIB
from blocksar.errors import InputError
from blocksar.focusing.method import (
    Coefficients,
    Derotation,
    Method,
    Perturbation,
    PlannedProcessor,
    RangeModel,
)
from blocksar.graph.machine import Resources, resources
from blocksar.ingestion.terrain.reading import terrain_notes
from blocksar.inspection.sentences import doubts_of_track
from blocksar.places import Location
from blocksar.planning import choice, effort
from blocksar.planning.choice import Contender
from blocksar.planning.disk import exact_bytes
from blocksar.planning.memory import checked_back_projection_memory
from blocksar.planning.plan import Plan
from blocksar.planning.planner import planner_of
from blocksar.planning.segments import PlannedSegment, Planner, joint_grid, plan_segments


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
    whole_pulses: bool = False,
    ground_height: float | None = None,
    looks: int | None = None,
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
        Coherence with exact back-projection that "auto" keeps where it can, below 1. Where whole dwells do not keep it,
        their edges are back-projected, also with a number of blocks. Default: 0.999.
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
        the box around the lit sector at about half the resolution. Needed if the beam is not steered, or turns about
        the antenna's own axis.
    terrain : path, optional
        Heights of the ground: zarr or netCDF with `height` (y, x) in m of the scene frame, or a GeoTIFF in any
        coordinate reference system, which needs a georeference. Default: the plane z = ground_height.
    surface : {"plane", "ellipsoid"}
        "ellipsoid": WGS 84 at ground_height, which needs a georeference. Default: "plane".
    vertical : str, optional
        What a GeoTIFF's heights are measured from, if it does not say so: "ellipsoid", "egm96" or "egm2008"; or
        "egm2008:FILE" with the geoid's grid. PROJ's own grid is taken if it is installed; nothing is downloaded. Needed
        for such a file only.
    whole_pulses : bool
        Of a raw echo, image only ground whose whole pulses were recorded; other ground stays NaN, as it does without a
        grid. Default: False, so that where `grid` has ground with parts of pulses, it is divided by the part.
    ground_height : float, optional
        Height z of the imaged plane in the scene frame, m. Ground that lies off it is displaced, at 30 m by up to as
        much. Default: that of the phase history.
    looks : int, optional
        Number of parts of each target's dwell that `focus` makes images of: each is planned, beside whole dwells.
        Default: whole dwells only.
    workers : int, optional
        Worker processes to plan for; 0: the calling process does the work. Default: as for `focus`.
    memory_limit : int or str, optional
        Memory of each worker, bytes or a text such as "2GiB". Default: its share of the machine's memory.

    Returns
    -------
    PlanReport
        `tables` has the blocks, the ten with the least coherence if there are many, and `details` all blocks with all
        figures; `refusal` is the reason if the plan cannot be carried out. `result` is the `planning.plan.Plan` (of
        several segments, or of looks, a tuple of them), the `Grid` for back-projection, or None if "auto" has no
        processor to propose. The method `plot` draws blocks, footprint and track.

    Raises
    ------
    InputError
        If the source is no collection, a setting is wrong, the PRF is too low, or the grid lies outside the swath.
    """
    settings = PlanSettings.of(locals())
    automatic = processor == "auto"
    method = (replace(settings, processor="angular-division") if automatic else settings).method
    points, tapers, ground = settings.points, settings.tapers, settings.ground
    collections = collections_of(source if looks is None else one_source(source, looks), ground_height, terrain=terrain)
    if automatic and method is not None:
        _check_automatic(method, collections, looks)
    parts = None if looks is None else divide_dwells(collections[0], looks, points)
    points = points if parts is None else parts.grid
    here = in_this_process(workers, collections)
    share = resources(0 if here else workers, None, settings.memory_limit)
    assumed = share._replace(workers=0) if here else share
    of_each = _channels_line(source)
    heights = None
    if not ground.plane:
        points = points or joint_grid([Geometry(collection=each) for each in collections])
        heights = read_ground(ground, collections[0], points, sources_of(source)[0])
        of_each += [] if heights is None else terrain_notes(heights, points)
    collections = imaged_collections(
        source, collections, settings.points, heights, ground_height=ground_height, whole_pulses=whole_pulses
    )
    if method is None and parts is not None:
        return report_exact_looks(
            lambda seen: _plan_backprojection([seen], points, heights, assumed), collections[0], parts
        )
    if method is None:
        return _told_first(_plan_backprojection(collections, points, heights, assumed), of_each)

    def plan_by(method: Method) -> Planner:
        return planner_of(
            method, blocks=settings.blocks, fidelity=settings.fidelity, weighting=tapers, terrain=heights,
            workers=share.workers, memory_limit=share.memory_limit,
        )  # fmt: skip

    def plan_all(collections: Sequence[Collection]) -> Sequence[PlannedSegment]:
        return plan_segments(plan_by(method), collections, grid=points, cut=settings.blocks == "auto")

    started = time.perf_counter()
    with naming_exact(collections, points, assumed):
        if parts is not None:
            report = report_looks(lambda seen: [each.plan for each in plan_all([seen])], collections[0], parts, assumed)
        elif automatic:
            contenders = choice.contend(lambda rival: plan_by(rival)(collections[0], grid=points))
            report = _report_contenders(contenders, assumed)
        else:
            report = _report_segments(plan_all(collections), assumed, time.perf_counter() - started)
    if report.refusal is not None:
        return replace(report, refusal=report.refusal + exact_way(collections, points, assumed))
    return _told_first(report, of_each)


def _check_automatic(method: Method, collections: Sequence[Collection], looks: int | None) -> None:
    """Check that processors can be compared: as they are, for whole dwells of one collection.

    Raises
    ------
    InputError
        If they cannot.
    """
    if method.rival:
        raise InputError(
            f"{' and '.join(method.departures)}: processor auto compares processors as they are; leave it out"
        )
    if looks is not None:
        raise InputError(f"looks = {looks!r}, but processor auto compares processors for whole dwells; leave one out")
    if len(collections) > 1:
        raise InputError("processor is auto, but several sources are given: compare processors for one of them")


def _channels_line(source: Source) -> list[str]:
    """That the plan is one of several channels, if it is."""
    names = channels_of(source)
    return [f"{len(names)} channels ({', '.join(names)}), one after the other, each as follows"] if names else []


def _told_first(report: PlanReport, lines: Sequence[str]) -> PlanReport:
    """A report with lines before its own."""
    return replace(report, summary=[*lines, *report.summary])


def _report_plan(plan: Plan, assumed: Resources, planning: float = 0.0, *, compared: bool = False) -> PlanReport:
    if plan.refusal is not None:  # the samples of what does not focus may have no bounds
        return PlanReport(refusal=plan.refusal, result=plan, geometry=plan.geometry)
    work = effort.of_plan(plan, workers=assumed.workers)
    return PlanReport(
        tables=[block_table([plan])],
        details=plan_details([plan]),
        definitions=definitions.PLAN,
        summary=[
            *plan_lines(plan, compared=compared),
            *recorded_lines([plan.geometry], plan.grid),
            *outside_window([plan]),
            time_line(work, assumed, planning),
            *exact_line([plan], work, assumed, planning),
        ],
        result=plan,
        geometry=plan.geometry,
    )


def _report_segments(segments: Sequence[PlannedSegment], assumed: Resources, planning: float) -> PlanReport:
    """Report the blocks of all segments together, then each segment; `planning` as for `time_line`."""
    plans = [segment.plan for segment in segments]
    if len(plans) == 1:
        return _report_plan(plans[0], assumed, planning)
    if (refusal := next((plan.refusal for plan in plans if plan.refusal is not None), None)) is not None:
        return PlanReport(refusal=refusal, result=tuple(plans))
    lines = []
    for number, segment in enumerate(segments):
        pulses = "" if segment.pulses is None else f", pulses {segment.pulses[0]} .. {segment.pulses[1] - 1}"
        blocks = f"blocks {segment.first_block} .. {segment.first_block + segment.plan.n_blocks - 1}"
        lines.append(f"segment {number} (collection {segment.collection}{pulses}, {blocks}):")
        lines += [f"  {line}" for line in plan_lines(segment.plan)]
    work = effort.together([effort.of_plan(plan, workers=assumed.workers) for plan in plans])
    lines += [
        *recorded_lines([plan.geometry for plan in plans], plans[0].grid),
        *outside_window(plans),
        time_line(work, assumed, planning),
        *exact_line(plans, work, assumed, planning),
    ]
    return PlanReport(
        tables=[block_table(plans)],
        details=plan_details(plans),
        definitions=definitions.PLAN,
        summary=lines,
        result=tuple(plans),
    )


def _report_contenders(contenders: list[Contender], assumed: Resources) -> PlanReport:
    """Report all processors side by side, then the plan of the proposed one."""
    (best, reason), table = choice.propose(contenders), contender_table(contenders)
    if best is None or best.plan is None:
        return PlanReport(refusal=reason)
    report = _report_plan(best.plan, assumed, compared=True)
    return replace(
        report,
        tables=[table, *report.tables],
        details=[table, *report.details],
        summary=[reason, *report.summary, f"to focus with it: --processor {best.processor}"],
    )


def _plan_backprojection(
    collections: Sequence[Collection], grid: Grid | None, terrain: Terrain | None, assumed: Resources
) -> PlanReport:
    geometries = [Geometry(collection=collection) for collection in collections]
    grid = grid or joint_grid(geometries)
    pixels = grid.shape[0] * grid.shape[1]
    lit = sum(lit_pulses(geometry, grid) for geometry in geometries)
    memory = max(
        checked_back_projection_memory(collection, grid, assumed.threads, assumed.memory_limit)
        for collection in collections
    )
    written = exact_bytes(grid, terrain, noise=any(each.noise_power for each in collections))
    lines = [
        f"exact back-projection of {grid.shape[1]} x {grid.shape[0]} pixels, {lit} lit pulses each: "
        f"{pixels * lit / 1e9:.3g} G updates at most, {workforce(assumed)}",
        *recorded_lines(geometries, grid),
        f"peak memory of a worker {memory / MIB:.0f} MiB",
        f"a run writes at most {sum(written.values()) / MIB:.0f} MiB",
        time_line(effort.together([effort.of_backprojection(each, grid) for each in geometries]), assumed),
        *dict.fromkeys(doubt for each in collections for doubt in doubts_of_track(each, exact=True)),
    ]
    return PlanReport(summary=lines, result=grid, geometry=geometries[0])
