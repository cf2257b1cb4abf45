"""The commands as functions: simulate, ingest, plan, focus, quality, report, export, open, demo.

A run folder holds what `focus` leaves: collection.zarr (the phase history less its samples), spectrum.zarr,
patches/, image.zarr and run.json. Units of work leave receipts in receipts/ while the run goes on; at the
end they are gathered in run.json.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass, field
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeGuard

import numpy as np

from blocksar import (
    __version__,
    choice,
    cluster,
    effort,
    geotiff,
    graph,
    inspection,
    products,
    runs,
    sicd,
    simulation,
    stores,
)
from blocksar.backprojection import form_image
from blocksar.choice import Contender
from blocksar.cluster import machine
from blocksar.geometry import Geometry
from blocksar.georeference import Georeference
from blocksar.graph import image_chunk
from blocksar.inspection import Inspection
from blocksar.measurement import (
    DEFINITIONS,
    TABLE3,
    ChipComparison,
    PointResponse,
    Response,
    Target,
    as_json,
    coherence,
    measure_target,
    read_response,
    summary,
)
from blocksar.method import (
    Coefficients,
    Derotation,
    Method,
    Perturbation,
    PlannedProcessor,
    Processor,
    RangeModel,
    method_of,
)
from blocksar.parameters import Collection, ComplexArray, FloatArray, InputError, ProcessingError
from blocksar.places import LocalPlace, Location, Place, place
from blocksar.planning import BlockPlan, Plan, plan_collection
from blocksar.progress import NOBODY, Listener, Work, listener
from blocksar.progress import Updated as Progress
from blocksar.region import Grid, default_grid, plan_region
from blocksar.runs import FORMAT, Receipt, Run
from blocksar.scene import Scene, shipped_scenes

if TYPE_CHECKING:
    import xarray as xr
    from distributed import Client

__all__ = ["demo", "export", "focus", "ingest", "open", "plan", "quality", "report", "simulate"]

GridLike = Grid | tuple[tuple[float, float, float], tuple[float, float, float]]
Table = tuple[Sequence[str], Sequence[Sequence[str]]]

RANGES_COMPARED = (("near", 0.1), ("middle", 0.5), ("far", 0.9))  # name, share of the swath
MIB = 2**20


def _told(progress: Progress | None, stage: str) -> Callable[[int, int], None]:
    """A command's only stage begins: what its parts are told to."""
    told = listener(progress)
    told.begin(stage)
    return partial(told.update, stage)


@dataclass(frozen=True)
class Report:
    """What a command tells a person: tables, then sentences. `refusal` says why a plan cannot be carried out."""

    tables: list[Table] = field(default_factory=list)
    summary: list[str] = field(default_factory=list)
    refusal: str | None = None
    result: Any = None

    def table(self) -> list[Table]:
        return self.tables


# ---------------------------------------------------------------- simulate


def simulate(
    scene: Scene | str | Path,
    out: Location,
    *,
    raw: bool = False,
    cphd: bool = False,
    origin: tuple[float, float, float] | None = None,
    threads: int | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Path | Place:
    """Write the phase history of a scene (a file, or the name of a shipped one), with exact ranges.

    Parameters
    ----------
    raw : bool
        Write a raw chirped echo instead of range-frequency samples.
    cphd : bool
        Write a CPHD file instead of a store.
    origin : (latitude, longitude, height), optional
        Of the scene's centre in a CPHD file: degrees, and m above the WGS 84 ellipsoid.

    Raises
    ------
    InputError
        If the scene is wrong, or `out` exists and `overwrite` is False.
    """
    _, threads, _ = _resources(1, threads, None)
    told = _told(progress, "simulate")
    if cphd:
        if raw:
            raise InputError("raw is given together with cphd, but CPHD files hold compressed pulses; leave out one")
        from blocksar import cphd_simulation  # optional libraries

        return cphd_simulation.simulate(
            scene, out, origin=origin or cphd_simulation.ORIGIN, threads=threads, overwrite=overwrite,
            progress=told,
        )  # fmt: skip
    if origin is not None:
        raise InputError(f"origin is {origin}, but only CPHD files have one; leave it out")
    return simulation.simulate(scene, out, raw=raw, threads=threads, overwrite=overwrite, progress=told)


# ---------------------------------------------------------------- ingest


def ingest(
    kind: Literal["cphd", "gotcha"], source: Location | Sequence[Location], out: Location, **options: Any
) -> Report:
    """Turn measured data into a phase history: `ingest_cphd` or `ingest_gotcha`, by name."""
    if kind == "cphd":
        if isinstance(source, Sequence) and not isinstance(source, str):
            raise InputError(f"source is a list of {len(source)}; a CPHD file is ingested by itself")
        return ingest_cphd(source, out, **options)
    if kind == "gotcha":
        return ingest_gotcha(source, out, **options)
    raise InputError(f"kind is {kind!r}; it must be 'cphd' or 'gotcha'")


def ingest_cphd(
    source: Location,
    out: Location,
    *,
    channel: str | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Report:
    """Turn one channel of a CPHD file into a phase history, in the tangent frame at its scene's reference point.

    Returns
    -------
    Report
        `result` is the collection that the store holds.

    Raises
    ------
    InputError
        If the file is damaged, contradicts itself or is not supported, or `out` exists and `overwrite` is False.
    """
    from blocksar import cphd  # optional libraries, and slow to load

    made = cphd.ingest(source, out, channel=channel, overwrite=overwrite, progress=_told(progress, "ingest"))
    return Report(summary=[*made.said, f"wrote {made.path}"], result=made.collection)


def ingest_gotcha(
    source: Location | Sequence[Location],
    out: Location,
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Report:
    """Join the AFRL Gotcha set's MATLAB files in azimuth into a phase history, in their scene-centred frame.

    Returns
    -------
    Report
        `result` is the collection that the store holds.

    Raises
    ------
    InputError
        If a file is damaged, files do not belong together, or `out` exists and `overwrite` is False.
    """
    from blocksar import gotcha

    made = gotcha.ingest(source, out, overwrite=overwrite, progress=_told(progress, "ingest"))
    return Report(summary=[*made.said, f"wrote {made.path}"], result=made.collection)


# ---------------------------------------------------------------- plan


def plan(
    source: Location | xr.Dataset,
    *,
    processor: PlannedProcessor = "angular-division",
    blocks: int | Literal["auto"] = "auto",
    coefficients: Coefficients = "fitted",
    perturbation: Perturbation = "all",
    keystone: bool = True,
    derotation: Derotation = "nonlinear",
    range_model: RangeModel = "polar",
    grid: GridLike | None = None,
    workers: int | None = None,
    memory_limit: int | None = None,
) -> Report:
    """How a collection (a phase-history store or a scene) would be focused, and how sharply; no samples are read.

    Returns
    -------
    Report
        `result` is the `planning.Plan`.

    Raises
    ------
    InputError
        If the source is no collection, the PRF is too low, or the grid is outside the swath.
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
    collection, wanted = _collection(source), _grid(grid)
    workers, _, memory_limit = _resources(workers, None, memory_limit)
    if method is None:
        return _plan_backprojection(collection, wanted, workers)

    def made_for(method: Method) -> Plan:
        return plan_collection(
            collection, blocks=blocks, method=method, grid=wanted, workers=workers, memory_limit=memory_limit
        )

    if automatic:
        return _plan_automatic(choice.contend(made_for))
    made = made_for(method)
    return Report(tables=[_block_table(made)], summary=_plan_lines(made), refusal=made.refusal, result=made)


def _plan_automatic(contenders: list[Contender]) -> Report:
    """All processors side by side, then the proposed one's own plan."""
    best, reason = choice.propose(contenders)
    least = min(c.plan.work() for c in contenders if c.plan is not None)
    header = (
        "processor", "blocks", "residual phase (rad)", "quadratic (rad)", "PSLR (dB)", "width / limit",
        "migration (cells)", "dwell lost (%)", "work", "memory (MiB)", "within its budgets",
    )  # fmt: skip
    rows = [_contender_row(c, least) for c in contenders]
    if best is None or best.plan is None:
        return Report(tables=[(header, rows)], summary=[reason], refusal=reason)
    made = best.plan
    return Report(
        tables=[(header, rows), _block_table(made)],
        summary=[reason, *_plan_lines(made), f"to focus with it: --processor {best.processor}"],
        refusal=made.refusal,
        result=made,
    )


def _contender_row(contender: Contender, least: float) -> list[str]:
    made = contender.plan
    if made is None:
        return [contender.processor, *["-"] * 9, "no"]
    p = contender.worst.prediction
    return [
        contender.processor, str(made.n_blocks), f"{p.residual_phase:.4f}", f"{p.quadratic_phase:.4f}", f"{p.pslr:.2f}",
        f"{p.width:.3f}", f"{p.migration:.3f}", f"{100 * contender.loss:.1f}", f"{made.work() / least:.2f}",
        f"{made.memory / MIB:.0f}", "yes" if contender.serves else "no",
    ]  # fmt: skip


def _grid(grid: GridLike | None) -> Grid | None:
    if grid is None or isinstance(grid, Grid):
        return grid
    return Grid(*grid[0], *grid[1])


def _collection(source: Location | xr.Dataset) -> Collection:
    text = str(source) if isinstance(source, str | Path) else ""
    if text.endswith(".toml") or (text in shipped_scenes() and not Path(text).exists()):
        return Scene.read(text).collection().centred()
    return stores.open_phase_history(_where(source)).collection.centred()


def _where(source: Location | xr.Dataset) -> Location:
    return source if isinstance(source, str | os.PathLike | Place) else _dataset_path(source)


def _dataset_path(source: xr.Dataset) -> str:
    path = source.encoding.get("source")
    if path is None:
        raise InputError(
            "source is a dataset that lies in no store; write it with to_zarr(path, zarr_format=3) and pass that path"
        )
    return str(path)


def _resources(workers: int | None, threads: int | None, memory_limit: int | None) -> tuple[int, int, int]:
    """Workers, threads a worker, bytes a worker: by default workers x threads is the number of cores."""
    cores, memory = machine()
    for name, value in (("workers", workers), ("threads", threads)):
        if value is not None and value < 1:
            raise InputError(f"{name} must be at least 1, got {value}")
    workers = workers or min(cores, 4)
    threads = threads or max(cores // workers, 1)
    return workers, threads, memory_limit or memory // workers


def _block_table(made: Plan) -> Table:
    header = (
        "block", "yaw (deg)", "range (km)", "Doppler bins", "padded", "bias (m/s2)", "residual phase (rad)",
        "quadratic (rad)", "PSLR (dB)", "width / limit", "azimuth width (m)", "migration (cells)", "memory (MiB)",
    )  # fmt: skip
    return header, [_block_row(block) for block in made.blocks]


def _block_row(block: BlockPlan) -> list[str]:
    low, high = np.degrees([block.low, block.high])
    p = block.prediction
    return [
        block.name,
        f"{low:.3f} .. {high:.3f}",
        f"{block.ground.near / 1e3:.3f} .. {block.ground.far / 1e3:.3f}",
        f"{block.first_bin} .. {block.first_bin + block.n_bin}",
        str(block.ground.doppler.size),
        f"{block.candidate.bias:.1f}",
        f"{p.residual_phase:.4f}",
        f"{p.quadratic_phase:.4f}",
        f"{p.pslr:.2f}",
        f"{p.width:.3f}",
        f"{p.resolution:.3f}",
        f"{p.migration:.3f}",
        f"{block.memory / MIB:.0f}",
    ]


def _plan_lines(made: Plan) -> list[str]:
    recovery, collection, grid = made.recovery, made.geometry.collection, made.grid
    spectrum = recovery.doppler.size * collection.n_range_frequency * 8
    divided = f" of {made.parts} range sub-blocks each" if made.parts > 1 else ""
    lines = [
        f"{made.n_blocks} blocks{divided}, {made.method.coefficients} coefficients; "
        f"track of order {made.geometry.track.order}, misfit {made.geometry.track.max_misfit:.2g} m",
        f"derotated band {recovery.band[1] - recovery.band[0]:.0f} Hz at PRF {collection.prf:.0f} Hz; recovered "
        f"spectrum {recovery.doppler.size} x {collection.n_range_frequency} ({spectrum / MIB:.0f} MiB), "
        f"{recovery.doppler.extent:.0f} Hz wide",
        f"image {grid.shape[1]} x {grid.shape[0]} pixels: x {grid.x[0]:g} .. {grid.x[-1]:g} m every {grid.dx:g}, "
        f"y {grid.y[0]:g} .. {grid.y[-1]:g} m every {grid.dy:g}",
    ]
    if not made.within_budget():
        lines.append(
            "the predicted residual phase or migration is above its budget: more blocks, or fitted coefficients"
        )
    return lines


def _plan_backprojection(collection: Collection, grid: Grid | None, workers: int) -> Report:
    geometry = Geometry(collection=collection)
    grid = grid or default_grid(geometry, plan_region(geometry, None))
    pixels = grid.shape[0] * grid.shape[1]
    lit = collection.n_pulse
    if collection.beam_width is not None:
        sweep = float(np.ptp(collection.beam_azimuth))
        lit = min(lit, round(collection.n_pulse * collection.beam_width / max(sweep, 1e-9)))
    lines = [
        f"exact back-projection of {grid.shape[1]} x {grid.shape[0]} pixels, {lit} lit pulses each: "
        f"{pixels * lit / 1e9:.3g} G updates at most, by {workers} workers",
    ]
    return Report(summary=lines, result=grid)


# ---------------------------------------------------------------- focus


def focus(
    source: Location | xr.Dataset,
    out: Location,
    *,
    processor: Processor = "angular-division",
    blocks: int | Literal["auto"] = "auto",
    coefficients: Coefficients = "fitted",
    perturbation: Perturbation = "all",
    keystone: bool = True,
    derotation: Derotation = "nonlinear",
    range_model: RangeModel = "polar",
    grid: GridLike | None = None,
    workers: int | None = None,
    threads: int | None = None,
    memory_limit: int | None = None,
    scheduler: str | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
    performance_report: str | Path | None = None,
    client: Client | None = None,
) -> Report:
    """Focus a phase history into the run folder `out`; an unfinished run there is resumed.

    Parameters
    ----------
    source : path or xarray.Dataset opened from one
        Phase-history store.
    workers, threads : int, optional
        Of the cluster that is started here: processes, and threads in each.
    memory_limit : int, optional
        Bytes a worker.
    scheduler : str, optional
        Address of a dask scheduler to use instead.
    progress : object with a method `update(stage, done, total)`, optional
        Told how far each stage has come; a `progress.Listener` is told more.
    performance_report : path, optional
        HTML file for dask's performance report of this call, also where it fails.
    client : distributed.Client, optional
        Likewise, already connected.

    Raises
    ------
    InputError
        If the input or a setting is wrong: nothing is written.
    ProcessingError
        If processing fails: what was finished stays, and the same call resumes.
    """
    told = listener(progress)
    profile = None if performance_report is None else Path(performance_report)
    method = method_of(
        processor,
        coefficients=coefficients,
        perturbation=perturbation,
        keystone=keystone,
        derotation=derotation,
        range_model=range_model,
    )
    wanted = _grid(grid)
    settings: dict[str, Any] = {
        **(Method() if method is None else method).as_settings(),
        "processor": processor,
        "blocks": blocks,
        "grid": None if wanted is None else _grid_record(wanted),
    }
    history = stores.open_phase_history(_where(source))
    if "georeference" in history.attrs:
        Georeference.from_attribute(history.attrs["georeference"])  # what the image carries on should be right
    fingerprint = history.fingerprint()
    folder = place(out)
    runs.refuse_overlap(place(history.path), folder)
    if profile is not None:
        cluster.check_recordable(profile, client)

    def found() -> dict[str, Any] | None:
        return runs.existing(folder, settings, fingerprint, overwrite=overwrite)

    if _finished(record := found()):
        if profile is not None:
            told.note(f"nothing was done, so there is no performance report at {profile}")
        return _left_alone(folder, record)
    with ExitStack() as stack:
        connected = None
        if client is not None or scheduler is not None:
            connected = stack.enter_context(cluster.open_client(scheduler=scheduler, client=client))
            workers, memory_limit = cluster.cluster_size(connected)
            if profile is not None:
                cluster.check_recordable(profile, connected)
        workers, threads, memory_limit = _resources(workers, threads, memory_limit)
        stack.enter_context(runs.claimed(folder))
        if _finished(record := found()):  # by somebody who wrote it until now
            return _left_alone(folder, record, claimed=True)
        told.update("plan", 0, 1)
        job = _job(history, settings, wanted, record, workers, memory_limit)
        told.expect(_effort(job), workers)
        told.update("plan", 1, 1)
        divided = None if job.plan is None else (job.plan.n_blocks, job.plan.parts)
        identity = stores.checksum_bytes(
            repr((FORMAT, sorted(settings.items(), key=str), fingerprint, divided)).encode("utf-8", "surrogateescape")
        )
        run = Run(folder=folder, identity=identity, threads=threads)
        unfinished = {
            "format": FORMAT,
            "status": runs.UNFINISHED,
            "settings": settings,
            "input": {"path": str(history.path), "fingerprint": fingerprint},
            "identity": identity,
            "versions": _versions(),
            "workers": workers,
            "threads": threads,
            "memory_limit": memory_limit,
            "plan": {
                "blocks": job.plan and job.plan.n_blocks,
                "parts": job.plan and job.plan.parts,
                "memory": job.plan and job.plan.memory,
                "grid": _grid_record(job.grid),
                "predicted": _predicted(job.plan),
            },
        }
        try:
            done = _carry_out(job, run, unfinished, connected, told, profile, resumed=record is not None)
        except ProcessingError as error:
            raise ProcessingError(f"{error}; what was finished stays, the same command goes on from there") from error
    return Report(summary=_focus_lines(folder, done, job.plan), result=done)


@dataclass(frozen=True, kw_only=True)
class _Job:
    """What is to be focused, and how; without a plan, by back-projection."""

    history: stores.PhaseHistory
    geometry: Geometry
    grid: Grid
    plan: Plan | None


def _job(
    history: stores.PhaseHistory,
    settings: dict[str, Any],
    grid: Grid | None,
    record: dict[str, Any] | None,
    workers: int,
    memory_limit: int,
) -> _Job:
    """A run that goes on is divided as it was begun."""
    collection = history.collection.centred()
    geometry = Geometry(collection=collection)
    if settings["processor"] == "backprojection":
        grid = grid or default_grid(geometry, plan_region(geometry, None))
        return _Job(history=history, geometry=geometry, grid=grid, plan=None)
    made = plan_collection(
        collection,
        blocks=settings["blocks"] if record is None else record["plan"]["blocks"],
        parts="auto" if record is None else record["plan"]["parts"],
        method=Method.of_settings(settings),
        grid=grid,
        workers=workers,
        memory_limit=memory_limit,
    )
    if made.refusal is not None:
        raise InputError(made.refusal)
    return _Job(history=history, geometry=geometry, grid=made.grid, plan=made)


def _effort(job: _Job) -> Work:
    """What the stages to come will cost."""
    raw = job.history.raw
    echo = 0 if raw is None else raw.fast_time.size * job.history.collection.n_pulse
    if job.plan is None:
        return effort.of_backprojection(job.geometry, job.grid, echo_samples=echo)
    return effort.of_plan(job.plan, echo_samples=echo)


def _carry_out(
    job: _Job,
    run: Run,
    record: dict[str, Any],
    connected: Client | None,
    told: Listener,
    profile: Path | None,
    *,
    resumed: bool,
) -> dict[str, Any]:
    """From the input to a finished run's record."""
    started = time.perf_counter()
    with ExitStack() as stack:
        input_read = (lambda: None) if resumed else stack.enter_context(runs.begun(run.folder))
        run.folder.sweep()
        stores.write_json(run.folder / "run.json", record)
        if connected is None:
            connected = stack.enter_context(
                cluster.open_client(
                    workers=record["workers"],
                    threads=record["threads"],
                    memory_limit=record["memory_limit"],
                    scratch=runs.scratch(run.folder),
                    report=told,
                )
            )
        if (address := cluster.dashboard(connected)) is not None:
            told.dashboard(address)
        with cluster.recorded(connected, profile, told):
            receipts, timings = _stages(connected, job, run, record, told, input_read)
        told.watch((), NOBODY)
        told.begin("finish")
    record |= {
        "receipts": receipts,
        "timings": timings | {"total": time.perf_counter() - started},
        "peak_memory": max(receipt["peak_memory"] for receipt in receipts),
    }
    runs.finish(run, record)
    told.update("finish", 1, 1)
    return record


def _finished(record: dict[str, Any] | None) -> TypeGuard[dict[str, Any]]:
    return record is not None and record["status"] == runs.FINISHED


def _left_alone(folder: Place, record: dict[str, Any], *, claimed: bool = False) -> Report:
    runs.check_finished(folder, record)
    if not runs.is_tidy(folder):
        with nullcontext() if claimed else runs.claimed(folder):
            runs.tidy(folder)
    return Report(
        summary=[f"{folder} is finished already with these settings and this input: nothing to do"], result=record
    )


def _stages(
    client: Client,
    job: _Job,
    run: Run,
    record: dict[str, Any],
    told: Listener,
    input_read: Callable[[], None],
) -> tuple[list[Receipt], dict[str, float]]:
    """All receipts, and the seconds of each stage."""
    clock = [time.perf_counter()]

    def lap() -> float:
        clock.append(time.perf_counter())
        return clock[-1] - clock[-2]

    history, plan = job.history, job.plan
    run.establish(
        run.folder / "collection.zarr",
        lambda: stores.write_collection(run.folder / "collection.zarr", history.collection, history.attrs),
    )
    timings: dict[str, float] = {}
    if plan is None:
        samples, looked, found = graph.look_through(client, history, run, told)
        timings["inspect"] = lap()
        _judge(job, run, record, looked, found, told)
        input_read()
        formed = graph.back_project(client, samples, job.geometry, job.grid, found, run, told)
        return [*looked, *formed], timings | {"backprojection": lap()}
    recovered, found = graph.recover(client, history, plan, run, told)
    timings["recover"] = lap()
    _judge(job, run, record, recovered, found, told)
    input_read()
    focused = graph.focus_blocks(client, plan, run, found.lit, told)
    timings["focus"] = lap()
    merged = graph.mosaic(client, plan, run, focused, told)
    timings["mosaic"] = lap()
    return [*recovered, *focused, *merged], timings


def _judge(
    job: _Job, run: Run, record: dict[str, Any], receipts: Sequence[Receipt], found: Inspection, told: Listener
) -> None:
    """Put down what the samples told; the image carries it too."""
    history, plan = job.history, job.plan
    if not found.lit.any():
        raise InputError(f"{history.variable} in {history.path} holds no valid sample; is it the right store?")
    echoes = [Inspection.from_dict(r["found"]) for r in receipts if r["unit"].startswith("pulses-")]
    looks = [inspection.levels(echoes), found] if echoes else [found]
    record["warnings"] = [line for look in looks for line in inspection.lines(look)]
    record["samples"] = {"missing": sum(found.missing.values()), "impossible": sum(look.n_outlier for look in looks)}
    if plan is not None:
        region = plan.region
        expected = inspection.expect(job.geometry, plan.recovery, yaw=region.yaw, near=region.near, far=region.far)
        if expected is not None:
            measured = inspection.centroid(found, prf=job.geometry.collection.prf)
            record["doppler_centroid"] = {"error": measured.mean_offset, "coherence": measured.mean_coherence}
            if (sentence := inspection.disagreement(found, expected)) is not None:
                record["warnings"].append(sentence)
    for warning in record["warnings"]:
        told.note(warning, again=True)
    run.establish(run.image, lambda: _create_image(run, job, record))


def _grid_record(grid: Grid) -> list[float]:
    return [grid.x0, grid.x1, grid.dx, grid.y0, grid.y1, grid.dy]


def _versions() -> dict[str, str]:
    names = ("numpy", "scipy", "numba", "dask", "zarr", "xarray")
    return {"blocksar": __version__} | {name: metadata.version(name) for name in names}


def _predicted(made: Plan | None) -> list[dict[str, Any]]:
    if made is None:
        return []
    return [
        {"block": b.index, "part": b.part, "yaw": [b.low, b.high], "range": [b.ground.near, b.ground.far],
         "memory": b.memory, "bias": b.candidate.bias, **b.prediction._asdict()}
        for b in made.blocks
    ]  # fmt: skip


def _create_image(run: Run, job: _Job, record: dict[str, Any]) -> None:
    side, attrs = image_chunk(job.grid), job.history.attrs
    title = attrs.get("title") or job.history.collection.title or "blocksar image"
    text = {
        "title": title,
        "Conventions": stores.CONVENTIONS,
        "history": stores.history_line(f"focused by blocksar {__version__}", attrs.get("history")),
        "source": str(job.history.path),
        "settings": record["settings"],
        "run": run.identity,
        "carrier_frequency": job.history.collection.carrier,
        "ground_height": job.history.collection.ground_height,
        "calibration": "a target of reflectivity 1 peaks at 1 + 0j",
        "predicted": record["plan"]["predicted"],
        "warnings": record["warnings"],
        "scene": attrs.get("scene", ""),
    }
    if "georeference" in attrs:
        text["georeference"] = attrs["georeference"]
    stores.create(
        run.image, stores.IMAGE, sizes={}, coords={"x": job.grid.x, "y": job.grid.y}, attrs=text,
        chunks={"y": side[0], "x": side[1]}, overwrite=True,
    )  # fmt: skip


REUSED = {"pulses": "groups of pulses", "columns": "column groups", "block": "blocks", "chunk": "parts of the mosaic"}


def _resumed_line(receipts: Sequence[Receipt]) -> list[str]:
    """What of an earlier, unfinished run was used again."""
    if not any(receipt.get("reused") for receipt in receipts):
        return []
    counts = []
    for prefix, what in REUSED.items():
        units = [receipt for receipt in receipts if receipt["unit"].startswith(f"{prefix}-")]
        if units:
            counts.append(f"{sum('reused' in receipt for receipt in units)} of {len(units)} {what}")
    damaged = sum("damaged" in receipt for receipt in receipts)
    also = f"; {damaged} more were found damaged and made again" if damaged else ""
    return [f"went on from an unfinished run: {', '.join(counts)} were used again{also}"]


def _focus_lines(folder: Place, record: dict[str, Any], made: Plan | None) -> list[str]:
    timings = record["timings"]
    stages = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in timings.items() if name != "total")
    said = [*(f"note: {line}" for line in record["warnings"]), *_resumed_line(record["receipts"])]
    said.append(f"{folder / 'image.zarr'} is finished in {timings['total']:.1f} s ({stages})")
    planned = "" if made is None else f", planned {made.memory / MIB:.0f} MiB"
    said.append(f"peak memory of a worker {record['peak_memory'] / MIB:.0f} MiB{planned}")
    return said


# ---------------------------------------------------------------- open, quality


def open(run: Location) -> xr.Dataset:  # the word of the interface
    """The image of a run as a lazily loaded dataset: `image` and `block` over y and x.

    It follows CF, with a grid mapping if it is georeferenced, and has the accessor `sar` (see `blocksar.accessor`):
    `ds.sar.db()`, `.crop()`, `.plot()`, `.cut()`.
    """
    from blocksar import accessor  # registers itself, and loads xarray

    folder = place(run)
    return accessor.prepare(stores.open_dataset(folder / "image.zarr" if (folder / "image.zarr").exists() else folder))


@dataclass(frozen=True, eq=False)
class _Image:
    """A finished run's image, read by window."""

    path: Place
    x: FloatArray
    y: FloatArray

    def read(self, rows: slice, columns: slice) -> ComplexArray:
        return stores.read_region(self.path, "image", (rows, columns))

    def block(self, rows: slice, columns: slice) -> Any:
        return stores.read_region(self.path, "block", (rows, columns))


def _open_run(run: Place) -> tuple[_Image, Collection, dict[str, Any], dict[str, Any]]:
    if not (run / "run.json").exists():
        raise InputError(f"{run} holds no run.json; give the folder that `blocksar focus --out` left")
    record = stores.read_json(run / "run.json")
    if not isinstance(record, dict) or record.get("status") != "finished":
        raise InputError(f"{run} is not finished; run `blocksar focus` again with the same settings")
    collection, attrs = stores.read_collection(run / "collection.zarr")
    x, y = (stores.read_region(run / "image.zarr", name, (slice(None),)) for name in ("x", "y"))
    if x.size and y.size and min(x.size, y.size) < 2:
        raise InputError(
            f"the image of {run} has {y.size} x {x.size} pixels (y, x), and products and measurements take 2 at least "
            "in each direction; focus on a larger --grid"
        )
    if any(axis.size < 2 or not (np.diff(axis) > 0).all() for axis in (x, y)):
        raise InputError(f"x or y in {run / 'image.zarr'} is damaged; focus again with --overwrite")
    return _Image(run / "image.zarr", x, y), collection.centred(), attrs, record


def quality(run: Location, *, targets: Location | Sequence[Target] | None = None, reference: bool = False) -> Report:
    """Measure a run's point targets, and compare chips with exact back-projection.

    Parameters
    ----------
    targets : path or sequence of Target, optional
        JSON or TOML file of {"name", "x", "y", "reflectivity"}; by default those the collection was simulated with.
    reference : bool
        Also back-project chips at the blocks' centres, seams and swath ends from the run's input, and compare.

    Returns
    -------
    Report
        `result` is what RUN/quality.json holds.
    """
    return _measure(place(run), targets, reference)[0]


def _measure(
    folder: Place, targets: Location | Sequence[Target] | None, reference: bool
) -> tuple[Report, list[Response]]:
    image, collection, attrs, record = _open_run(folder)
    geometry = Geometry(collection=collection)
    wanted = _targets(targets, attrs)
    responses = [measure_target(image.read, image.x, image.y, geometry, target) for target in wanted]
    found = as_json(responses)
    tables = [_response_table(responses)] if responses else []
    lines = [] if not responses else [DEFINITIONS, *_worst_lines(responses)]
    if not responses:
        lines.append("the collection names no targets: give --targets FILE to measure some")
    if attrs.get("scene") == "table1" and responses:
        found["table3"] = {name: row._asdict() for name, row in TABLE3.items()}
        tables.append(_table3(responses))
        lines.append("paper: Table 3 of the angular-division paper; its ISLR follows another, unstated definition")
    shown = [r for t in wanted if t.name in TABLE3 and (r := read_response(image.read, image.x, image.y, geometry, t))]
    if reference:
        compared = _compare(image, geometry, record)
        found["reference"] = [
            {"place": name, "x": x, "y": y, "coherence": abs(c.coherence), "gain": c.gain, "phase": c.phase}
            for name, x, y, c in compared
        ]
        tables.append(_reference_table(compared))
        lines.append("reference: exact back-projection of the same samples; chips of 64 x 64 pixels")
    stores.write_json(folder / "quality.json", found)
    return Report(tables=tables, summary=lines, result=found), shown


def _targets(targets: Location | Sequence[Target] | None, attrs: dict[str, Any]) -> list[Target]:
    if targets is None:
        return [Target.from_record(record) for record in attrs.get("targets") or []]
    if not isinstance(targets, str | os.PathLike | Place):
        return list(targets)
    path = place(targets)
    if path.name.endswith(".toml"):
        return [Target(*t) for t in Scene.read(str(path)).point_targets()]
    records = stores.read_json(path)
    if isinstance(records, dict):
        records = records.get("targets")
    if not isinstance(records, list):
        raise InputError(f'{path} holds no list of targets; give [{{"name": ..., "x": ..., "y": ...}}, ...]')
    return [Target.from_record(record) for record in records]


def _response_table(responses: Sequence[PointResponse]) -> Table:
    header = (
        "target", "full dwell", "range PSLR", "ISLR", "IRW (m)", "/theory", "azimuth PSLR", "ISLR", "IRW (m)",
        "/theory", "dx (mm)", "dy (mm)", "|value|", "phase (rad)",
    )  # fmt: skip
    rows = []
    for r in responses:
        rows.append([
            r.name, "yes" if r.full_dwell else "no", f"{r.range_pslr:.2f}", f"{r.range_islr:.2f}",
            f"{r.range_irw:.3f}", f"{r.range_irw / r.range_irw_theory:.4f}", f"{r.azimuth_pslr:.2f}",
            f"{r.azimuth_islr:.2f}", f"{r.azimuth_irw:.3f}", f"{r.azimuth_irw / r.azimuth_irw_theory:.4f}",
            f"{1e3 * r.error_x:.1f}", f"{1e3 * r.error_y:.1f}", f"{abs(r.value):.4f}", f"{np.angle(r.value):.4f}",
        ])  # fmt: skip
    return header, rows


def _worst_lines(responses: Sequence[PointResponse]) -> list[str]:
    found = summary(responses)
    head = (
        f"{found.measured} of {found.full_dwell} full-dwell targets measured ({found.targets} in all); worst of them:"
    )
    return [head, *(f"  {name}: {w.value:.4f} at {w.name} (ideal {w.ideal:.4f})" for name, w in found.worst.items())]


def _table3(responses: Sequence[PointResponse]) -> Table:
    header = (
        "target", "range PSLR", "paper", "ISLR", "paper", "IRW (m)", "paper",
        "azimuth PSLR", "paper", "ISLR", "paper", "IRW (m)", "paper",
    )  # fmt: skip
    rows = []
    for r in responses:
        if (p := TABLE3.get(r.name)) is None:
            continue
        rows.append([
            r.name if r.full_dwell else f"{r.name} (part of a dwell)",
            f"{r.range_pslr:.2f}", f"{p.range_pslr:.2f}", f"{r.range_islr:.2f}", f"{p.range_islr:.2f}",
            f"{r.range_irw:.2f}", f"{p.range_irw:.2f}", f"{r.azimuth_pslr:.2f}", f"{p.azimuth_pslr:.2f}",
            f"{r.azimuth_islr:.2f}", f"{p.azimuth_islr:.2f}", f"{r.azimuth_irw:.2f}", f"{p.azimuth_irw:.2f}",
        ])  # fmt: skip
    return header, rows


Compared = list[tuple[str, float, float, ChipComparison]]


def _compare(image: _Image, geometry: Geometry, record: dict[str, Any]) -> Compared:
    """Chips of the image against exact back-projection of the run's input at telling places."""
    history = stores.open_phase_history(record["input"]["path"])
    if history.raw is not None:
        raise InputError(
            "--reference needs range-frequency samples, but the run's input is a raw echo; focus a signal store"
        )
    half = 32
    found: Compared = []
    for name, x, y in _places(geometry, record):
        column, row = (
            round((x - image.x[0]) / (image.x[1] - image.x[0])),
            round((y - image.y[0]) / (image.y[1] - image.y[0])),
        )
        rows, columns = slice(max(row - half, 0), row + half), slice(max(column - half, 0), column + half)
        if row < 0 or column < 0 or image.y[rows].size < half or image.x[columns].size < half:
            continue
        mine = image.read(rows, columns)
        if np.isfinite(mine.real).mean() < 0.5:
            continue
        read = partial(_read_pulses, history)
        exact = form_image(read, geometry, image.x[columns], image.y[rows], threads=machine()[0])
        found.append((name, float(x), float(y), coherence(mine, exact)))
    return found


def _read_pulses(history: stores.PhaseHistory, pulses: slice) -> ComplexArray:
    return history.read(pulses, slice(None))


def _places(geometry: Geometry, record: dict[str, Any]) -> list[tuple[str, float, float]]:
    """Block centres, seams, near and far range, and the last yaws of full dwell."""
    predicted = record["plan"]["predicted"]
    if not predicted:
        x0, x1, _, y0, y1, _ = record["plan"]["grid"]
        return [("image centre", (x0 + x1) / 2, (y0 + y1) / 2)]
    collection = geometry.collection
    low, high = predicted[0]["yaw"][0], predicted[-1]["yaw"][1]
    if collection.beam_width is not None and np.ptp(collection.beam_azimuth) > collection.beam_width:
        low = max(low, float(collection.beam_azimuth.min() + collection.beam_width / 2))
        high = min(high, float(collection.beam_azimuth.max() - collection.beam_width / 2))
    blocks = {b["block"]: b["yaw"] for b in predicted}
    yaws = [(f"block {index} centre", float(np.clip(sum(yaw) / 2, low, high))) for index, yaw in blocks.items()]
    yaws += [(f"seam {index}|{index + 1}", yaw[1]) for index, yaw in list(blocks.items())[:-1]]
    inset = 0.01 * (high - low)
    yaws += [("first full dwell", low + inset), ("last full dwell", high - inset)]
    parts = [[b["range"] for b in predicted if b["block"] == index] for index in blocks]
    near, far = max(ranges[0][0] for ranges in parts), min(ranges[-1][1] for ranges in parts)
    ranges = [(f"{where} range", near + share * (far - near)) for where, share in RANGES_COMPARED]
    places = [(f"{name}, {where}", yaw, rng) for name, yaw in yaws for where, rng in ranges]
    for (name, yaw), of_block in zip(yaws, parts, strict=False):  # blocks come first
        inner = [b[1] for b in of_block[:-1]]
        places += [(f"{name}, range seam {k}|{k + 1}", yaw, rng) for k, rng in enumerate(inner) if near < rng < far]
    points = [geometry.ground_point(np.array(rng), np.array(yaw)) for _, yaw, rng in places]
    return [(name, float(p[0]), float(p[1])) for (name, _, _), p in zip(places, points, strict=True)]


def _reference_table(compared: Compared) -> Table:
    header = ("place", "x (m)", "y (m)", "coherence", "gain", "phase (rad)")
    return header, [
        [name, f"{x:.0f}", f"{y:.0f}", f"{abs(c.coherence):.5f}", f"{c.gain:.4f}", f"{c.phase:.4f}"]
        for name, x, y, c in compared
    ]


# ---------------------------------------------------------------- report


def report(
    run: Location, *, out: Location | None = None, overwrite: bool = False, progress: Progress | None = None
) -> Report:
    """Write the report page of a finished run: one HTML file that needs nothing else.

    It shows what RUN/quality.json holds; where there is none, the targets that the run knows are measured now.

    Parameters
    ----------
    out : path, optional
        The page; RUN/report.html by default, which is the run's own and is replaced.
    overwrite : bool
        Replace what stands at `out`.

    Returns
    -------
    Report
        `result` is where the page lies.

    Raises
    ------
    InputError
        If the run is not finished, what it says cannot be read, a library is not installed, or something stands at
        `out`.
    ProcessingError
        If the page cannot be written: what stood there stays.
    """
    folder = place(run)
    target = folder / "report.html" if out is None else place(out)
    if out is not None and target.exists() and not overwrite:
        raise InputError(f"{target} exists; choose another name, or have it overwritten (--overwrite)")
    if isinstance(target, LocalPlace) and target.path.is_dir():
        raise InputError(f"{target} is a folder; give --out the name of a file")
    image, collection, attrs, record = _open_run(folder)
    try:
        from blocksar import page  # optional, and slow to load
    except ModuleNotFoundError as error:
        library = str(error.name).partition(".")[0]
        raise InputError(f"{library} is not installed, which reports need; install blocksar[plots]") from None
    source = products.Source(image.path, image.x, image.y, Geometry(collection=collection), attrs, record)
    found, why = _found(folder, source)
    told = _told(progress, "report")
    history = str(stores.open_dataset(image.path).attrs.get("history", ""))
    made, verdict = page.make(source, found, folder=str(folder), history=history, why=why, progress=told)
    try:
        target.write_bytes(made)
    except (PermissionError, NotADirectoryError, FileExistsError) as error:
        raise InputError(f"{target} cannot be written ({error.strerror}); choose another --out") from error
    except OSError as error:
        raise ProcessingError(f"{target} cannot be written ({error.strerror or error})") from error
    return Report(summary=["; ".join(verdict), f"wrote {target}"], result=target)


def _found(folder: Place, source: products.Source) -> tuple[dict[str, Any] | None, str]:
    """What quality.json holds, or would hold; or None, and why there is nothing."""
    if (folder / "quality.json").exists():
        return stores.read_json(folder / "quality.json"), ""
    targets = _targets(None, source.attrs)
    try:
        measured = [measure_target(source.read, source.x, source.y, source.geometry, target) for target in targets]
    except InputError as error:  # too coarse an image to measure in, but not to look at
        return None, f"Nothing was measured: {error}."
    return as_json(measured), ""


# ---------------------------------------------------------------- export


def export(
    kind: Literal["sicd", "geotiff", "png"],
    run: Location,
    out: Location,
    *,
    content: Literal["amplitude", "complex"] | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Report:
    """Write the image of a finished run as one file that other programs read.

    Parameters
    ----------
    kind : "sicd", "geotiff" or "png"
        The complex image on its ground plane; a cloud-optimised GeoTIFF; a picture for people.
    content : "amplitude" or "complex", optional
        Of a GeoTIFF; amplitude by default.

    Raises
    ------
    InputError
        If the run is not finished, says not where it lies on the Earth though the product must, a library is not
        installed, or something stands at `out`.
    ProcessingError
        If writing fails: nothing is left at `out`, or what was there.
    """
    folder = place(run)
    if content is not None and kind != "geotiff":
        raise InputError(f"content is {content!r}, but only a geotiff comes as amplitude or complex; leave it out")
    image, collection, attrs, record = _open_run(folder)
    source = products.Source(image.path, image.x, image.y, Geometry(collection=collection), attrs, record)
    told = _told(progress, "export")
    match kind:
        case "sicd":
            said = sicd.write(source, out, overwrite=overwrite, progress=told)
        case "geotiff":
            said = geotiff.write(source, out, content=content or "amplitude", overwrite=overwrite, progress=told)
        case "png":
            try:
                from blocksar import quicklook  # optional, and slow to load
            except ModuleNotFoundError as error:
                raise InputError(f"{error.name} is not installed, which PNG needs; install blocksar[plots]") from None
            said = quicklook.write(source, out, overwrite=overwrite, progress=told)
        case _:
            raise InputError(f"kind is {kind!r}; it must be 'sicd', 'geotiff' or 'png'")
    return Report(summary=[*said, f"wrote {place(out)}"])


# ---------------------------------------------------------------- demo


def demo(
    out: Location,
    *,
    workers: int | None = None,
    threads: int | None = None,
    memory_limit: int | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
    performance_report: str | Path | None = None,
) -> Report:
    """Simulate the main paper's scene, focus it in three blocks, measure it, and draw it.

    Leaves a run folder with quality.json, mosaic.png, contours.png and report.html besides.
    """
    told = listener(progress)
    if performance_report is not None:
        cluster.check_recordable(Path(performance_report), None)
    folder = place(out)
    history = folder / runs.LEFT_ALONE[0]
    if folder.names() and not history.exists():
        raise InputError(f"{folder} exists and is not a demonstration run; choose another --out")
    simulated = history.exists() and not overwrite
    told.expect(effort.of_demo(simulated=simulated, compiled=cluster.compiled()), 1)
    if not simulated:
        simulate("table1", history, threads=threads, overwrite=overwrite, progress=told)
    focused = focus(
        history, folder, blocks=3, workers=workers, threads=threads, memory_limit=memory_limit, overwrite=overwrite,
        progress=told, performance_report=performance_report,
    )  # fmt: skip
    told.expect(effort.FOCUS, 1)  # none of it is to come any more
    told.update("measure", 0, 1)
    measured, shown = _measure(folder, None, reference=False)
    told.update("measure", 1, 1)
    told.update("draw", 0, 1)
    pictures = _draw(folder, shown)
    told.update("draw", 1, 1)
    page = report(folder, progress=told)
    lines = [*measured.summary, *focused.summary, f"pictures: {', '.join(str(p) for p in pictures)}"]
    lines.append(f"report: {page.result}, for a browser")
    return Report(tables=measured.tables, summary=lines, result=measured.result)


def _draw(folder: Place, shown: Sequence[Response]) -> list[Place]:
    try:
        from blocksar import plotting  # optional, and slow to load
    except ModuleNotFoundError as error:
        raise InputError(f"{error.name} is not installed, which pictures need; install blocksar[plots]") from None
    image, _, attrs, _ = _open_run(folder)
    with tempfile.TemporaryDirectory() as drawn:
        mosaic, contours = Path(drawn, "mosaic.png"), Path(drawn, "contours.png")
        plotting.plot_mosaic(
            image.read, image.x, image.y, mosaic, read_block=image.block, targets=_targets(None, attrs),
            labels=list(TABLE3), title=str(attrs.get("title", "")),
        )  # fmt: skip
        plotting.plot_contours(shown, contours, title="impulse responses of the nine named targets")
        for picture in (mosaic, contours):
            (folder / picture.name).write_bytes(picture.read_bytes())
    return [folder / mosaic.name, folder / contours.name]
