"""focus: turn a phase history into a calibrated image on the ground, in a run folder.

A finished run folder holds collection.zarr (the phase history without its samples), spectrum.zarr, patches/,
image.zarr and run.json. Units of work leave receipts in receipts/ during the run; run.json includes them at the end.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from blocksar import stores
from blocksar.application.arguments import Source, gpu_workers, in_this_process, on_ground
from blocksar.application.jobs import Job, Request
from blocksar.application.joint import focus_members, members_of
from blocksar.application.parsing import GridLike
from blocksar.application.pulses import recorded_lines
from blocksar.application.rehearsing import RoomBeside, check_room_for_run, rehearse
from blocksar.application.run_stages import carry_out
from blocksar.application.settings import Settings
from blocksar.application.shown import RunReport, is_measurable
from blocksar.application.track_places import TrackPlace
from blocksar.application.workforce import choose_workforce
from blocksar.budget import FIDELITY, WAIT_WORKERS
from blocksar.collection.surface import Surface
from blocksar.errors import InputError
from blocksar.graph import cluster, compiling, recording
from blocksar.graph.machine import Resources, resources
from blocksar.graph.units import Executor, OnCluster, ThisProcess
from blocksar.imaging.method import Coefficients, Cutting, Derotation, Perturbation, RangeModel
from blocksar.loop_cache import compilation_seconds
from blocksar.measurement.targets import Target
from blocksar.places import Location, place
from blocksar.places.place import Place
from blocksar.planning.disk import has_pyramid
from blocksar.processors import AUTO, PROCESSORS, OwnDevice, OwnProcessor
from blocksar.progress import Listener, as_listener
from blocksar.progress import Wanted as Progress
from blocksar.readers.heights import terrain_notes
from blocksar.runs import folder as run_folder
from blocksar.runs.receipts import Run
from blocksar.runs.record import RECORD, Receipt, RunRecord
from blocksar.texts import count, size_text

if TYPE_CHECKING:
    from distributed import Client

PARTS = "part of the mosaic", "parts of the mosaic"
UNITS = {
    "range-compress": ("group of pulses", "groups of pulses"),
    "interference": ("group of pulses", "groups of pulses"),
    "recover": ("column group", "column groups"),
    "inspect": ("column group", "column groups"),
    "gate": ("group of Doppler bins", "groups of Doppler bins"),
    "focus": ("block", "blocks"),
    "mosaic": PARTS,
    "layers": PARTS,
    "backprojection": PARTS,
    "hierarchical-backprojection": PARTS,
}  # names of each stage's units of work, in the summary


def focus(
    source: Source,
    out: Location,
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
    ground_height: float | None = None,
    interference: Cutting | None = None,
    autofocus: bool = False,
    control: Location | Sequence[Target] | None = None,
    whole_pulses: bool = False,
    looks: int | None = None,
    workers: int | None = None,
    threads: int | None = None,
    memory_limit: int | str | None = None,
    scheduler: str | None = None,
    wait_workers: float = WAIT_WORKERS,
    overwrite: bool = False,
    discard: bool = False,
    pyramid: bool | None = None,
    dry_run: bool = False,
    progress: Progress | None = None,
    performance_report: str | Path | None = None,
    client: Client | None = None,
    **options: Any,
) -> RunReport:
    """Focus a phase history into a run folder; an unfinished run of the same settings and input there is resumed.

    Parameters
    ----------
    source : path or xarray.Dataset, or a list of them
        Phase-history store, or a dataset of its contract, such as `collection` builds. The samples of a dataset that
        is not as it was opened from a store are written to RUN/input.zarr, once. Of several collections in one frame,
        each is planned by itself; each pixel is that of the collection which saw more of its dwell.
    out : path
        Run folder.
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
    ground_height : float, optional
        Height z of the imaged plane in the scene frame, m. Ground that lies off it is displaced, at 30 m by up to as
        much. Default: that of the phase history.
    interference : {"notch", "eigen"}, optional
        Cut narrow-band interference that stands out of the echoes, by group of pulses. "notch": its frequencies become
        missing. "eigen": what leaks from them over the band is projected out, too. Default: samples stay as they are.
    autofocus : bool
        Correct the track from the samples first, as `autofocus` does. Default: False.
    control : path or sequence of Target, optional
        With `autofocus`: points at known places, which anchor the track. Default: none.
    whole_pulses : bool
        Of a raw echo, image only ground whose whole pulses were recorded; other ground stays NaN, as it does without a
        grid. Default: False, so that where `grid` has ground with parts of pulses, it is divided by the part.
    looks : int, optional
        Number of parts of each target's dwell, each of which becomes an image of its own: (look, y, x). Default: one
        image of whole dwells.
    workers : int, optional
        Processes of the local cluster; 0: the calling process does the work, without a cluster. Default: the number of
        cores, or cores / threads where these are given, at most 4; in a notebook or another interactive session 0 for a
        collection of at most 2**24 samples, and 0 where no processes can start, as in a `multiprocessing.Pool`.
    threads : int, optional
        Threads of each worker. Default: cores / workers, at least 1.
    memory_limit : int or str, optional
        Memory of each worker, bytes or a text such as "2GiB". Default: its share of the machine's memory.
    scheduler : str, optional
        Address of a running dask scheduler, used instead of a local cluster.
    wait_workers : float
        Time to wait for a worker of a running cluster as long as it has none, at the start and whenever the last one is
        lost, s. 0: fail at once. Default: 60.
    overwrite : bool
        Replace a run with other settings or another input. Default: False.
    discard : bool
        Remove the spectrum once all blocks are focused, and the patches at the end: no command reads them afterwards.
        Interrupted in the mosaic, a run recovers the spectrum again. Default: False, keep them.
    pyramid : bool, optional
        Add coarser levels of the image's power to image.zarr, for viewers. A run that is resumed keeps what it began
        with. Default: where a side has more than 4096 pixels.
    dry_run : bool
        Say what would be done, and write nothing: `tables` and `result` are then those of `plan`. Default: False.
    progress : object with a method update(stage, done, total), or False, optional
        Called with the name of the stage (str) and the numbers of finished and of all units (int). A
        `blocksar.progress.Listener` receives more. Default: bars in a notebook, silence elsewhere; False: silence.
    performance_report : path, optional
        HTML file for dask's performance report, also written if the run fails. Default: none.
    client : distributed.Client, optional
        Client of a running cluster, used instead of a local cluster; also taken as `scheduler`. Blocks and memory are
        planned for its workers and the smallest of their memory limits, or for `workers` and `memory_limit`, if these
        are less. Default: dask's active client, if there is one and no `workers` are given.
    **options
        Those of a processor that another package adds.

    Returns
    -------
    RunReport
        `summary` has notes, times and peak memory; `result` is the record that RUN/run.json holds.

    Raises
    ------
    InputError
        If the input or a setting is wrong; nothing is written.
    ProcessingError
        If processing fails; finished work stays, and the same call resumes.
    """
    force = choose_workforce(
        client=client, scheduler=scheduler, workers=workers, wait_workers=wait_workers, device=device
    )
    settings = Settings.of(locals() | {"scheduler": force.scheduler, "workers": force.workers})
    resources(settings.workers, settings.threads, settings.memory_limit)  # which refuses wrong numbers
    on = partial(on_ground, height=ground_height, terrain=terrain)
    if (members := members_of(source, looks, settings.points, on)) is not None:
        report = focus_members(_focus_image, members, place(out), settings, progress, force.client)
    else:
        report = _focus_image(source, place(out), settings, progress=progress, client=force.client)
    return replace(report, summary=[*force.notes, *report.summary])


def _focus_image(
    source: Source,
    out: Place,
    settings: Settings,
    *,
    progress: Progress | None,
    client: Client | None,
    track: TrackPlace | None = None,
    following: int = 0,
) -> RunReport:
    """Focus one image of one channel; `track` is the place of the estimated track where several images share it.

    As many like it are `following`, in folders of their own.
    """
    listener, compiled = as_listener(progress), compilation_seconds()
    profile, discard = settings.performance_report, settings.discard
    request = Request.open(source, out, settings, track=track)
    if profile is not None:
        recording.check_recordable(profile, client)
    record = request.find_run()
    if record is not None and record.finished and not settings.dry_run:
        if profile is not None:
            listener.note(f"nothing was done, so there is no performance report at {profile}")
        return _report_finished(request.folder, record, discard=discard)
    with ExitStack() as stack:
        executor: Executor | None = None
        here = (
            client is None
            and settings.scheduler is None
            and in_this_process(settings.workers, [history.collection for history in request.histories])
        )
        if here and profile is not None:
            raise InputError(
                f"--performance-report {str(profile)!r} is given, but dask does no work where the calling process "
                "does; give workers, or leave it out"
            )
        workers, memory_limit = 0 if here else settings.workers, settings.memory_limit
        if request.device == "gpu" and client is None and settings.scheduler is None:
            workers = gpu_workers(workers)
        if client is not None or settings.scheduler is not None:
            opened = cluster.open_client(
                scheduler=settings.scheduler, client=client, wait_workers=settings.wait_workers
            )
            client = stack.enter_context(opened)
            executor = OnCluster(client, listener)
            workers, memory_limit = cluster.cluster_size(
                client, workers=workers, memory_limit=memory_limit, listener=listener
            )
            if request.device == "gpu":
                workers = min(workers, cluster.workers_with_gpu(client))
            if profile is not None:
                recording.check_recordable(profile, client)
        machine = resources(workers, settings.threads, memory_limit)
        if settings.dry_run:
            return rehearse(request, record, machine, _beside(request, following))
        stack.enter_context(run_folder.claim(request.folder))
        record = request.find_run()  # again: another process may have written it in the meantime
        if record is not None and record.finished:
            return _report_finished(request.folder, record, discard=discard, claimed=True)
        if here:
            executor = cluster.open_here(listener, _loops(request))
        sentences: list[str] = []
        if request.track is not None:
            from blocksar.application.tracks import (
                track_corrected,  # with all of `autofocusing`, which takes 20 ms to load
            )

            _check_room_before_track(request, record, machine, following)
            corrected = track_corrected(request, machine, executor, listener)
            request, sentences, executor = stack.enter_context(corrected)
        report = _focus(request, record, machine, executor, listener, profile, following, compiled)
        return replace(report, summary=[*sentences, *report.summary])


def _has_pyramid(job: Job, *, resumed: bool) -> bool:
    """Tell whether the image of a run has, or will have, a pyramid; an existing image keeps the levels that it has."""
    image = job.request.folder / "image.zarr"
    if resumed and (image / "zarr.json").exists():
        return stores.levels_of(image) > 0
    return has_pyramid(job.grid, job.request.asked.pyramid)


def _beside(request: Request, following: int) -> RoomBeside:
    """Return the disk space needed besides a run's stores: for `following` more images and the track's estimate."""
    if request.track is None:
        return RoomBeside(following)
    from blocksar.application.tracks import estimates_of

    return RoomBeside(following, sum(estimate.room() for estimate in estimates_of(request, request.track)))


def _check_room_before_track(request: Request, earlier: RunRecord | None, machine: Resources, following: int) -> None:
    """Check that a run fits the disk before its track is corrected: a plan with the given track needs as much space.

    Raises
    ------
    NoRoom
        If it does not.
    """
    needed_besides = _beside(request, following)
    try:
        job = Job.of(request, earlier, machine)
    except InputError:  # there may be a plan once the track is corrected
        return
    check_room_for_run(job, needed_besides, resumed=earlier is not None)


def _report_finished(folder: Place, record: RunRecord, *, discard: bool, claimed: bool = False) -> RunReport:
    """Report that a run was finished before, after checking its image and removing leftovers.

    Raises
    ------
    FolderError
        If the image is damaged, or another process holds the folder.
    """
    run_folder.check_unchanged(folder, record)
    if discard or not run_folder.is_tidy(folder):
        with nullcontext() if claimed else run_folder.claim(folder):
            run_folder.tidy(folder)
            if discard:
                run_folder.discard_intermediate(folder)
    return RunReport(
        summary=[f"{folder} is finished already with these settings and this input: nothing to do"],
        result=record.as_json(),
        folder=folder,
        measurable=is_measurable(record),
    )


def _focus(
    request: Request,
    earlier: RunRecord | None,
    machine: Resources,
    executor: Executor | None,
    listener: Listener,
    profile: Path | None,
    following: int,
    compiled: float,
) -> RunReport:
    """Plan and carry out a run in a folder that this process has claimed."""
    listener.update("plan", 0, 1)
    with _start_workers(request, earlier, machine, listener) if executor is None else nullcontext(executor) as workers:
        job = Job.of(request, earlier, machine)
        listener.expect(job.predict_effort(), machine.workers)
        listener.update("plan", 1, 1)
        record = job.record()
        resumed = earlier is not None or run_folder.is_begun(request.folder, record)
        pyramid = _has_pyramid(job, resumed=resumed)
        run = Run(
            folder=request.folder, identity=record.identity, threads=machine.threads, pyramid=pyramid,
            on_terrain=request.terrain is not None,
        )  # fmt: skip
        check_room_for_run(job, RoomBeside(following), resumed=resumed)
        with run_folder.resumable():
            finished = carry_out(job, run, record, workers, listener, profile, resumed=resumed, compiled=compiled)
    found = [] if job.plan.compared is None else [job.plan.compared.reason]
    found += [*job.plan.notes(), *recorded_lines([piece.geometry for piece in job.plan.pieces], job.grid, swath=False)]
    if request.terrain is not None:
        found += terrain_notes(request.terrain, job.grid)
    if not (measurable := is_measurable(finished)):
        found.append("quality, report and export take images of at least 2 x 2 pixels; this one opens in Python only")
    notes = [f"note: {line}" for line in found]
    worker = "this process" if isinstance(executor, ThisProcess) else "a worker"
    lines = [*_summary(request.folder, finished, job.memory, worker), *notes]
    return RunReport(summary=lines, result=finished.as_json(), folder=request.folder, measurable=measurable)


def _loops(request: Request) -> Sequence[str]:
    """The loops that planning and tasks of any plan of a request run."""
    universal = PROCESSORS.get(request.processor).universal and request.processor != AUTO
    return compiling.READ if universal else compiling.TASKS


@contextmanager
def _start_workers(
    request: Request, earlier: RunRecord | None, machine: Resources, listener: Listener
) -> Iterator[cluster.Starting | None]:
    """Start a local cluster while a run is planned; None where the run will move what lies in its folder.

    Its temporary files lie there.
    """
    if earlier is None and (request.folder / RECORD).exists():
        cluster.prepare_workers(machine.threads, listener, _loops(request))
        yield None
        return
    try:
        scratch = run_folder.scratch(request.folder)
        starts = cluster.Starting(**machine._asdict(), scratch=scratch, listener=listener, loops=_loops(request))
        with starts as starting:
            yield starting
    finally:
        (request.folder / run_folder.SCRATCH).remove()


def _summary(folder: Place, record: RunRecord, planned: int, worker: str) -> list[str]:
    """Return the warnings, and sentences on resumed work, time and memory; `planned` is a worker's peak, bytes."""
    timings = record.timings
    once = {"compile": " once for an installation"}
    stages = ", ".join(
        f"{name} {seconds:.1f} s{once.get(name, '')}" for name, seconds in timings.items() if name != "total"
    )
    peak = record.peak_memory or 0
    return [
        *(f"note: {line}" for line in record.warnings),
        *_resumed_line(record.receipts),
        f"{folder / 'image.zarr'} is finished in {timings['total']:.1f} s ({stages})",
        f"peak memory of {worker} {size_text(peak)}, planned {size_text(planned)}",
        *([record.check] if record.check else []),
    ]


def _resumed_line(receipts: Sequence[Receipt]) -> list[str]:
    """Return a sentence on the units that an earlier, unfinished run had finished or damaged, if any."""
    if not any(receipt.reused or receipt.damaged for receipt in receipts):
        return []
    counts = []
    for stage in dict.fromkeys(receipt.stage for receipt in receipts):
        units = [receipt for receipt in receipts if receipt.stage == stage]
        names = UNITS.get(stage, (f"unit of {stage}", f"units of {stage}"))  # those of another package's processor
        counts.append(f"{sum(receipt.reused for receipt in units)} of {count(len(units), *names)}")
    damaged = sum(receipt.damaged for receipt in receipts)
    also = f"; {damaged} more found damaged and computed again" if damaged else ""
    return [f"went on from an unfinished run: {', '.join(counts)} used again{also}"]
