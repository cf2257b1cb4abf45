"""plan: predict how a collection would be focused, and how sharp its image would be."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any, Literal

from blocksar.application.arguments import Source, channels_of, collections_of, in_this_process, sources_of
from blocksar.application.ground import ground_under, read_ground
from blocksar.application.jobs import ANY, naming_hierarchy
from blocksar.application.looks import divide_dwells, one_source, report_looks
from blocksar.application.parsing import GridLike
from blocksar.application.pulses import imaged_collections, recorded_lines
from blocksar.application.reports import PLAN_COLUMNS
from blocksar.application.settings import Settings
from blocksar.application.shown import PlanReport
from blocksar.application.workforce import active_client, size_of
from blocksar.budget import FIDELITY
from blocksar.collection.geometry import Geometry
from blocksar.collection.region import joint_grid
from blocksar.collection.surface import Surface
from blocksar.graph.machine import Resources, resources
from blocksar.imaging.interference import check_band
from blocksar.imaging.method import Coefficients, Cutting, Derotation, Perturbation, RangeModel
from blocksar.places import Location
from blocksar.planning import effort
from blocksar.processors import PROCESSORS, OwnDevice, OwnProcessor, device_for, options_for
from blocksar.processors.base import ImagePlan, Problem, plan_image
from blocksar.processors.sentences import time_line
from blocksar.readers.heights import terrain_notes


def plan(
    source: Source,
    *,
    processor: OwnProcessor = "auto",
    device: OwnDevice = "cpu",
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
    surface: Surface | None = None,
    vertical: str | None = None,
    whole_pulses: bool = False,
    ground_height: float | None = None,
    interference: Cutting | None = None,
    looks: int | None = None,
    workers: int | None = None,
    memory_limit: int | str | None = None,
    **options: Any,
) -> PlanReport:
    """Predict how a collection would be focused, and how sharp the image would be. Reads no samples.

    Parameters
    ----------
    source : path or xarray.Dataset, or a list of them
        Phase-history store or a dataset of its contract, scene file (TOML), or the name of a shipped scene. Several are
        planned for one image.
    processor : str
        How the image is formed: by a chain of steps ("angular-division", "keystone-resampling", "high-order-phase");
        "hierarchical-backprojection": any geometry, as exactly as `fidelity` asks; "backprojection": exact and slow;
        "auto" (default): back-projection, or the main chain where it keeps `fidelity` in half the time; with `blocks`
        or an option of chains, "angular-division".
    device : {"cpu", "gpu", "auto"}
        What back-projection runs on; chains run on the CPU. "auto": a GPU if this process finds one and the processor
        runs there. Default: "cpu".
    blocks : int or "auto"
        Number of angular blocks, at least 1. "auto" (default): the fewest that keep `fidelity` and fit the memory.
    fidelity : float
        Least coherence with exact back-projection that processor and blocks keep where they can, below 1.
        Default: 0.999.
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
    surface : {"plane", "ellipsoid"}, optional
        "ellipsoid": WGS 84 at ground_height, which needs a georeference. Default: that of the phase history,
        or "plane".
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
    interference : {"notch", "eigen"}, optional
        Cut narrow-band interference that stands out of the echoes, by group of pulses. "notch": its frequencies become
        missing. "eigen": what leaks from them over the band is projected out, too. Default: samples stay as they are.
    looks : int, optional
        Number of parts of each target's dwell that `focus` makes images of: each is planned, beside whole dwells.
        Default: whole dwells only.
    workers : int, optional
        Worker processes to plan for; 0: the calling process does the work. Default: as for `focus`.
    memory_limit : int or str, optional
        Memory of each worker, bytes or a text such as "2GiB". Default: its share of the machine's memory.
    **options
        Those of a processor that another package adds.

    Returns
    -------
    PlanReport
        `tables` has the blocks, the ten with the least coherence if there are many, and `details` all blocks with all
        figures; `refusal` is the reason if the plan cannot be carried out. `plan` is the plan, and `result` of a chain
        its `processors.chain.planning.plan.Plan` (of several segments, or of looks, a tuple of them), and of
        back-projection the `Grid`. The method `plot` draws blocks, footprint and track.

    Raises
    ------
    InputError
        If the source is no collection, a setting is wrong, the PRF is too low, or the grid lies outside the swath.
    """
    settings = Settings.of(locals())
    way = PROCESSORS.get(settings.processor)
    chosen = options_for(settings.processor, settings.options)
    points = settings.points
    collections = collections_of(source if looks is None else one_source(source, looks), ground_height, terrain=terrain)
    ground = ground_under(settings.ground, sources_of(source)[0])
    parts = None if looks is None else divide_dwells(collections[0], looks, points)
    points = points if parts is None else parts.grid
    runs_on = device_for(settings.processor, device)
    active, notes = (None, []) if workers is not None else active_client(runs_on)
    here = active is None and in_this_process(workers, collections)
    if runs_on == "gpu" and not here:
        workers = workers or 1
    size = (0 if here else workers), settings.memory_limit
    count, memory = size if active is None else size_of(active, *size)
    share = resources(count, None, memory)
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
    if settings.interference is not None:
        for each in collections:
            check_band(each.n_range_frequency)
    problem = Problem(
        collections=collections, grid=points, terrain=heights, blocks=settings.blocks, fidelity=settings.fidelity,
        weighting=settings.tapers, options=chosen, machine=share, device=runs_on,
    )  # fmt: skip
    started = time.perf_counter()
    with naming_hierarchy():
        if parts is not None:
            report = report_looks(
                lambda seen: plan_image(way, replace(problem, collections=[seen])),
                collections[0], parts, assumed,
            )  # fmt: skip
        else:
            planned = plan_image(way, problem)
            report = _report(planned, assumed, time.perf_counter() - started)
    if report.refusal is not None:
        return replace(report, refusal=report.refusal + ANY)
    cut = [] if settings.interference is None else [NOT_KNOWN.format(method=settings.interference)]
    return replace(report, summary=[*notes, *of_each, *report.summary, *cut])


NOT_KNOWN = (
    "interference ({method}) is looked for by focus: a plan reads no samples, and its figures are those without lines; "
    "where a share q of the band is cut, noise rises by 1 / (1 - q)"
)


def _channels_line(source: Source) -> list[str]:
    """State which channel the plan is for, if the source has several."""
    names = channels_of(source)
    return [f"{len(names)} channels ({', '.join(names)}), one after the other, each as follows"] if names else []


def _report(plan: ImagePlan, assumed: Resources, planning: float) -> PlanReport:
    """Report a plan; `planning` as for `time_line`."""
    if plan.refusal is not None:  # the samples of what does not focus may have no bounds
        return PlanReport(refusal=plan.refusal, result=plan.result, plan=plan)
    work = {**plan.work(), **effort.of_pyramid(plan.grid)}
    tables, compared = plan.tables(), plan.compared
    return PlanReport(
        tables=[*([compared.table] if compared else []), *tables],
        details=[*([compared.table] if compared else []), *plan.details()],
        definitions=PLAN_COLUMNS if tables else (),
        summary=[
            *([compared.reason] if compared else []),
            *plan.lines(),
            *recorded_lines([piece.geometry for piece in plan.pieces], plan.grid),
            time_line(work, assumed, plan.stored_bytes(), planning),
        ],
        result=plan.result,
        plan=plan,
    )
