"""autofocus: correct the track of a phase history from its samples.

The estimate and the copy of the samples are made in a folder beside the store, OUT.autofocus, with receipts as those of
a run; the store gets its name when it is complete.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

from blocksar import stores
from blocksar.application.arguments import control_points, history_of, on_ground
from blocksar.application.ground import read_ground
from blocksar.application.parsing import GridLike
from blocksar.application.reports import Report
from blocksar.application.settings import Settings
from blocksar.application.track_places import TrackPlace
from blocksar.application.tracks import TrackEstimate
from blocksar.application.workforce import choose_workforce
from blocksar.autofocusing.finishing import Result
from blocksar.budget import WAIT_WORKERS
from blocksar.chunks import stored_bytes
from blocksar.collection.surface import Surface
from blocksar.errors import InputError
from blocksar.graph import cluster
from blocksar.graph.machine import resources
from blocksar.graph.units import Executor, OnCluster
from blocksar.measurement.targets import Target
from blocksar.places import Location, lies_in, place
from blocksar.places.place import Place, check_room
from blocksar.progress import Wanted as Progress
from blocksar.progress import as_listener
from blocksar.runs import folder as run_folder
from blocksar.runs.receipts import Run
from blocksar.runs.record import Receipt
from blocksar.runs.track import ATTRIBUTE
from blocksar.tasks.track_stages import copy_store
from blocksar.version import __version__

if TYPE_CHECKING:
    import xarray as xr
    from distributed import Client

STORE = "store.zarr"  # the corrected store in the folder of the estimate, until it is complete


def autofocus(
    source: Location | xr.Dataset,
    out: Location,
    *,
    grid: GridLike | None = None,
    terrain: Location | None = None,
    surface: Surface | None = None,
    vertical: str | None = None,
    ground_height: float | None = None,
    control: Location | Sequence[Target] | None = None,
    workers: int | None = None,
    threads: int | None = None,
    memory_limit: int | str | None = None,
    scheduler: str | None = None,
    wait_workers: float = WAIT_WORKERS,
    overwrite: bool = False,
    progress: Progress | None = None,
    client: Client | None = None,
) -> Report:
    """Estimate the error of the track from prominent points, and write the phase history with its track corrected.

    Only `antenna_position` changes. What all of the scene has in common, a shift of the track or of its speed along the
    line of sight, cannot be seen in the samples, and stays as it is.

    Parameters
    ----------
    source : path or xarray.Dataset
        Phase-history store, or a dataset.
    out : path
        Phase-history store to write. An unfinished one of the same input and settings is gone on with.
    grid : Grid or ((x0, x1, dx), (y0, y1, dy)), optional
        Ground in which points are looked for, m in the scene frame. Default: the lit sector. Needed if the beam is not
        steered.
    terrain : path, optional
        Heights of the ground on which the points stand, as `focus` takes them. Default: the plane z = ground_height.
    surface : {"plane", "ellipsoid"}, optional
        "ellipsoid": WGS 84 at ground_height, which needs a georeference. Default: that of the phase history,
        or "plane".
    vertical : str, optional
        What a GeoTIFF's heights are measured from, as in `focus`. Needed where the file does not say so.
    ground_height : float, optional
        Height z of the imaged plane in the scene frame, m. Ground that lies off it is displaced, at 30 m by up to as
        much. Default: that of the phase history.
    control : path or sequence of Target, optional
        Points at known places, as `quality` takes targets: they anchor place and phase, which the samples alone do not
        tell. Default: none, and the track is moved by nothing that the samples do not tell.
    workers : int, optional
        Processes of the local cluster; 0: the calling process does the work, without a cluster. Default: the number of
        cores, or cores / threads where these are given, at most 4; 0 where no processes can start, as in a
        `multiprocessing.Pool`.
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
        Replace what stands at `out`. Default: False.
    progress : object with a method update(stage, done, total), or False, optional
        As in `focus`. Default: bars in a notebook, silence elsewhere.
    client : distributed.Client, optional
        Client of a running cluster, used instead of a local cluster; also taken as `scheduler`. Default: dask's active
        client, if there is one and no `workers` are given.

    Returns
    -------
    Report
        `summary` has the figures of the correction; `result` is the attribute `autofocus` of the store.

    Raises
    ------
    InputError
        If the input or a setting is wrong, or the samples do not tell of the track's error; nothing is written.
    ProcessingError
        If processing fails; finished work stays, and the same call goes on with it.
    """
    force = choose_workforce(client=client, scheduler=scheduler, workers=workers, wait_workers=wait_workers)
    client, scheduler, workers, notes = force
    settings = Settings.of(locals())
    listener, target = as_listener(progress), place(out)
    [history] = on_ground([history_of(source)], ground_height, terrain=terrain)
    stored = not isinstance(history, stores.DatasetHistory)
    if stored and (lies_in(history.path, target) or lies_in(target, history.path)):
        raise InputError(f"--out {target} and the input {history.path} lie in each other; choose another place")
    ground, within = settings.ground.under(history.attrs), settings.points
    work = TrackPlace.of(place(f"{target}.autofocus"), [history])
    estimate = TrackEstimate(
        channels=work.channels[0], folder=work.folder, fingerprint=work.fingerprints[0], grid=within,
        control=control_points(control, source, ground_height), ground=ground,
        terrain=read_ground(ground, history.collection.centred(), within, dict(history.attrs)),
    )  # fmt: skip
    if (attribute := _finished(target, estimate)) is not None:
        run_folder.remove_estimate(work.folder)
        return Report(
            summary=[f"{target} is finished already with these settings and this input: nothing to do"],
            result=attribute,
        )
    overwrite = overwrite or stores.was_being_published(work.folder / STORE, target)
    stores.refuse_existing(target, overwrite=overwrite)
    run_folder.refuse_foreign(work.folder)
    limit = settings.memory_limit
    with ExitStack() as stack:
        executor: Executor | None = None
        if client is not None or scheduler is not None:
            opened = cluster.open_client(scheduler=scheduler, client=client, wait_workers=wait_workers)
            client = stack.enter_context(opened)
            executor = OnCluster(client, listener)
            workers, limit = cluster.cluster_size(client, workers=workers, memory_limit=limit, listener=listener)
        elif workers == 0:
            executor = cluster.open_here(listener)
        machine = resources(workers, threads, limit)
        memory = estimate.checked_memory(machine)
        if target.free() is not None:
            check_room(target, estimate.room(_copied(history)))
        stack.enter_context(run_folder.claim(estimate.folder))
        stores.refuse_existing(target, overwrite=overwrite)  # again: another process may have written it meanwhile
        clock = time.perf_counter()
        with (
            work.removed_if_wrong(),
            run_folder.resumable(),
            estimate.opened(machine, executor, listener) as at_work,
        ):
            made = estimate.carry_out(at_work, machine, local=executor is None)
            run = estimate.run(machine.threads)
            copied, attribute = _write(estimate, made.result, run, target, at_work, overwrite=overwrite)
        run_folder.remove_estimate(work.folder)
        summary = estimate.summary([*made.receipts, *copied], attribute, memory)
        return Report(
            summary=[*notes, *summary, f"{target} is finished in {time.perf_counter() - clock:.1f} s"], result=attribute
        )


def _finished(target: Place, estimate: TrackEstimate) -> dict[str, Any] | None:
    """Return the attribute `autofocus` of an existing store that this same estimate has written; None otherwise."""
    if not target.exists():
        return None
    try:
        attribute = stores.open_phase_history(target).attrs.get(ATTRIBUTE)
    except InputError:
        return None
    return attribute if isinstance(attribute, dict) and attribute.get("identity") == estimate.identity else None


def _copied(history: stores.PhaseHistory) -> int:
    """Return the size of the copy of a phase history, bytes."""
    if isinstance(history, stores.DatasetHistory):
        return stored_bytes(history.shape)
    return sum(size for _, size, _ in history.path.files())


def _write(
    estimate: TrackEstimate,
    result: Result,
    run: Run,
    target: Place,
    executor: Executor,
    *,
    overwrite: bool,
) -> tuple[Sequence[Receipt], dict[str, Any]]:
    """Write the store with the corrected track into a folder that this process locked; return receipts, attribute."""
    source, made = estimate.stored()[0], estimate.folder / STORE
    receipts = copy_store(executor, source.path, made, run)
    executor.listener.begin("finish")
    attribute = estimate.attribute(result)
    line = stores.history_line(f"track corrected by blocksar {__version__}", source.attrs.get("history"))
    stores.write_track(
        source.path, made, corrected=result.antenna_position, original=source.collection.antenna_position,
        attrs={ATTRIBUTE: attribute, "history": line},
    )  # fmt: skip
    estimate.check_unchanged()
    stores.publish(made, target, overwrite=overwrite)
    executor.listener.update("finish", 1, 1)
    return receipts, attribute
