"""focus: a phase history to a calibrated image on the ground, and the bookkeeping of its run.

A run folder holds what `focus` leaves: collection.zarr (the phase history less its samples), spectrum.zarr,
patches/, image.zarr and run.json. Units of work leave receipts in receipts/ while the run goes on; at the
end they are gathered in run.json.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeGuard

from blocksar import stores
from blocksar.api.arguments import GridLike, grid_of, path_of, resources
from blocksar.api.reports import Report
from blocksar.collection.geometry import Geometry
from blocksar.collection.georeference import Georeference
from blocksar.collection.grid import Grid
from blocksar.collection.region import default_grid, plan_region
from blocksar.constants import MIB
from blocksar.errors import InputError, ProcessingError
from blocksar.focusing.method import Coefficients, Derotation, Method, Perturbation, Processor, RangeModel, method_of
from blocksar.graph import cluster, recording, stages
from blocksar.inspection import centroid, samples, sentences
from blocksar.inspection.samples import Inspection
from blocksar.places import Location, place
from blocksar.places.place import Place
from blocksar.planning import effort
from blocksar.planning.memory import checked_back_projection_memory, checked_memory, compression_memory
from blocksar.planning.plan import Plan, plan_collection
from blocksar.planning.tiling import image_chunk
from blocksar.progress import NOBODY, Listener, Work, as_listener
from blocksar.progress import Updated as Progress
from blocksar.runs import folder as run_folder
from blocksar.runs.folder import FORMAT
from blocksar.runs.receipts import Receipt, Run
from blocksar.version import __version__

if TYPE_CHECKING:
    import xarray as xr
    from distributed import Client


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
    told = as_listener(progress)
    profile = None if performance_report is None else Path(performance_report)
    method = method_of(
        processor,
        coefficients=coefficients,
        perturbation=perturbation,
        keystone=keystone,
        derotation=derotation,
        range_model=range_model,
    )
    wanted = grid_of(grid)
    settings: dict[str, Any] = {
        **(Method() if method is None else method).as_settings(),
        "processor": processor,
        "blocks": blocks,
        "grid": None if wanted is None else _grid_record(wanted),
    }
    history = stores.open_phase_history(path_of(source))
    if "georeference" in history.attrs:
        Georeference.from_attribute(history.attrs["georeference"])  # what the image carries on should be right
    fingerprint = history.fingerprint()
    folder = place(out)
    run_folder.refuse_overlap(place(history.path), folder)
    if profile is not None:
        recording.check_recordable(profile, client)

    def found() -> dict[str, Any] | None:
        return run_folder.existing(folder, settings, fingerprint, overwrite=overwrite)

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
                recording.check_recordable(profile, connected)
        workers, threads, memory_limit = resources(workers, threads, memory_limit)
        stack.enter_context(run_folder.claimed(folder))
        if _finished(record := found()):  # by somebody who wrote it until now
            return _left_alone(folder, record, claimed=True)
        told.update("plan", 0, 1)
        job = _job(history, settings, wanted, record, workers, threads, memory_limit)
        told.expect(_effort(job), workers)
        told.update("plan", 1, 1)
        divided = None if job.plan is None else (job.plan.n_blocks, job.plan.parts)
        identity = stores.checksum_bytes(
            repr((FORMAT, sorted(settings.items(), key=str), fingerprint, divided)).encode("utf-8", "surrogateescape")
        )
        run = Run(folder=folder, identity=identity, threads=threads)
        unfinished = {
            "format": FORMAT,
            "status": run_folder.UNFINISHED,
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
                "memory": job.memory,
                "grid": _grid_record(job.grid),
                "predicted": _predicted(job.plan),
            },
        }
        try:
            done = _carry_out(job, run, unfinished, connected, told, profile, resumed=record is not None)
        except ProcessingError as error:
            raise ProcessingError(f"{error}; what was finished stays, the same command goes on from there") from error
    return Report(summary=_focus_lines(folder, done, job.memory), result=done)


@dataclass(frozen=True, kw_only=True)
class _Job:
    """What is to be focused, and how; without a plan, by back-projection.

    Attributes
    ----------
    memory : int
        Predicted peak of a worker, bytes.
    """

    history: stores.PhaseHistory
    geometry: Geometry
    grid: Grid
    plan: Plan | None
    memory: int


def _job(
    history: stores.PhaseHistory,
    settings: dict[str, Any],
    grid: Grid | None,
    record: dict[str, Any] | None,
    workers: int,
    threads: int,
    memory_limit: int,
) -> _Job:
    """A run that goes on is divided as it was begun."""
    collection = history.collection.centred()
    geometry = Geometry(collection=collection)
    compression = checked_memory("range compression", compression_memory(history.collection, history.raw), memory_limit)
    if settings["processor"] == "backprojection":
        grid = grid or default_grid(geometry, plan_region(geometry, None))
        memory = max(compression, checked_back_projection_memory(collection, grid, threads, memory_limit))
        return _Job(history=history, geometry=geometry, grid=grid, plan=None, memory=memory)
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
    memory = max(compression, made.memory)
    return _Job(history=history, geometry=geometry, grid=made.grid, plan=made, memory=memory)


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
        input_read = (lambda: None) if resumed else stack.enter_context(run_folder.begun(run.folder))
        run.folder.sweep()
        stores.write_json(run.folder / "run.json", record)
        if connected is None:
            connected = stack.enter_context(
                cluster.open_client(
                    workers=record["workers"],
                    threads=record["threads"],
                    memory_limit=record["memory_limit"],
                    scratch=run_folder.scratch(run.folder),
                    report=told,
                )
            )
        if (address := recording.dashboard(connected)) is not None:
            told.dashboard(address)
        with recording.recorded(connected, profile, told):
            receipts, timings = _stages(connected, job, run, record, told, input_read)
        told.watch((), NOBODY)
        told.begin("finish")
    record |= {
        "receipts": receipts,
        "timings": timings | {"total": time.perf_counter() - started},
        "peak_memory": max(receipt["peak_memory"] for receipt in receipts),
    }
    run_folder.finish(run, record)
    told.update("finish", 1, 1)
    return record


def _finished(record: dict[str, Any] | None) -> TypeGuard[dict[str, Any]]:
    return record is not None and record["status"] == run_folder.FINISHED


def _left_alone(folder: Place, record: dict[str, Any], *, claimed: bool = False) -> Report:
    run_folder.check_finished(folder, record)
    if not run_folder.is_tidy(folder):
        with nullcontext() if claimed else run_folder.claimed(folder):
            run_folder.tidy(folder)
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
        samples, looked, found = stages.look_through(client, history, run, told)
        timings["inspect"] = lap()
        _judge(job, run, record, looked, found, told)
        input_read()
        formed = stages.back_project(client, samples, job.geometry, job.grid, found, run, told)
        return [*looked, *formed], timings | {"backprojection": lap()}
    recovered, found = stages.recover(client, history, plan, run, told)
    timings["recover"] = lap()
    _judge(job, run, record, recovered, found, told)
    input_read()
    focused = stages.focus_blocks(client, plan, run, found.lit, told)
    timings["focus"] = lap()
    merged = stages.mosaic(client, plan, run, focused, told)
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
    looks = [samples.levels(echoes), found] if echoes else [found]
    record["warnings"] = [line for look in looks for line in sentences.lines(look)]
    record["samples"] = {"missing": sum(found.missing.values()), "impossible": sum(look.n_outlier for look in looks)}
    if plan is not None:
        region = plan.region
        expected = centroid.expect(job.geometry, plan.recovery, yaw=region.yaw, near=region.near, far=region.far)
        if expected is not None:
            measured = centroid.centroid(found, prf=job.geometry.collection.prf)
            record["doppler_centroid"] = {"error": measured.mean_offset, "coherence": measured.mean_coherence}
            if (sentence := centroid.disagreement(found, expected)) is not None:
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


def _focus_lines(folder: Place, record: dict[str, Any], planned: int) -> list[str]:
    timings = record["timings"]
    stages = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in timings.items() if name != "total")
    said = [*(f"note: {line}" for line in record["warnings"]), *_resumed_line(record["receipts"])]
    said.append(f"{folder / 'image.zarr'} is finished in {timings['total']:.1f} s ({stages})")
    peak = record["peak_memory"]
    said.append(f"peak memory of a worker {peak / MIB:.0f} MiB, planned {planned / MIB:.0f} MiB")
    return said
