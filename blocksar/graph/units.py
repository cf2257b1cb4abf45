"""Units of work: single tasks, and running those that have no valid receipt."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import replace
from functools import partial
from typing import Any

from distributed import Client, Future, KilledWorker, wait

from blocksar.errors import InputError, ProcessingError
from blocksar.progress import NOBODY, Listener, Workers
from blocksar.runs.receipts import Run
from blocksar.runs.record import Receipt


class Done:
    """Result or error of a task in this process, with the methods of dask's futures that stages call."""

    def __init__(self, key: str, result: Any = None, error: Exception | None = None) -> None:
        self.key = key
        self.status = "finished" if error is None else "error"
        self._result, self._error = result, error

    def result(self) -> Any:
        if self._error is not None:
            raise self._error
        return self._result

    def exception(self) -> Exception | None:
        return self._error


class Here:
    """Runs each task when it is submitted. It has those methods of dask's clients that the stages call."""

    def submit(self, task: Callable[..., Any], *arguments: Any, key: str = "", **_: Any) -> Done:
        """Run a task now; futures among its arguments become their results, or their error that of the task."""
        try:
            return Done(key, task(*(item.result() if isinstance(item, Done) else item for item in arguments)))
        except Exception as error:
            return Done(key, error=error)

    def as_completed(
        self, units: deque[tuple[str, Callable[[], Any]]], listener: Listener
    ) -> Iterator[tuple[str, Any]]:
        """Take units one after another, run them, and yield each with what it has left."""
        while units:
            unit, start = units.popleft()
            listener.watch([unit], NOBODY)
            yield unit, start()


Unit = tuple[str, Callable[[], Future[Any]]]  # name of a unit of work, and the function that submits it
NO_WORKER = 120.0  # s without any worker before a run fails, where workers are started again by themselves
STALL = 3600.0  # s without a finished unit before a run fails
DONE = ("finished", "error")  # final states of a future; one lost with its worker becomes pending again
POLL = 2.0  # s between two checks of the cluster while no unit finishes
REMEDY = "start some, or wait longer for them (--wait-workers)"

_patience: ContextVar[float | None] = ContextVar("patience", default=None)


@contextmanager
def waiting_for_workers(seconds: float | None) -> Iterator[None]:
    """In the block, wait so long for a first worker, and for another whenever the last is lost; None: NO_WORKER."""
    before = _patience.set(seconds)
    try:
        yield
    finally:
        _patience.reset(before)


def _patience_seconds() -> float:
    seconds = _patience.get()
    return NO_WORKER if seconds is None else seconds


def as_completed(
    client: Client, stage: str, units: Iterable[Unit], per_worker: int, listener: Listener, *, ahead: bool = False
) -> Iterator[tuple[str, Future[Any]]]:
    """Submit units, at most `per_worker` in flight for each worker, and yield each with its future once it has ended.

    The client limits the number in flight, so that no worker holds more data than was planned for it. With `ahead`, for
    units of one task, workers of one thread each have one more, which waits for that thread and holds nothing. A result
    that is lost with its worker is computed again; a unit that the scheduler has forgotten is submitted again.

    Raises
    ------
    ProcessingError
        If the scheduler is gone, no worker is left, or no unit finishes any more.
    """
    waiting = units if isinstance(units, deque) else deque(units)
    if isinstance(client, Here):
        yield from client.as_completed(waiting, listener)
        return
    starts: dict[str, Callable[[], Future[Any]]] = {}
    running: dict[Future[Any], str] = {}
    watch = Watch(client, listener)
    try:
        while True:
            places = watch.count_workers() * (per_worker + (ahead and watch.one_thread_each))
            for _ in range(min(places - len(running), len(waiting))):
                unit, starts[unit] = waiting.popleft()
                running[starts[unit]()] = unit
            watch.notify(running)
            if not running:
                return
            for future in watch.wait_for_any(running, stage):
                if future.status in DONE:
                    watch.notify({other: unit for other, unit in running.items() if other is not future})
                    yield running[future], future
                elif future.status == "cancelled" and client.status == "running":
                    waiting.append((running[future], starts[running[future]]))
                else:
                    continue
                del running[future]
                _release(client, future)
    finally:
        # After a failure or an interruption: a shared cluster must neither go on with the units nor keep the failure.
        if running and client.status == "running":
            client.cancel(list(running), force=True)


def _release(client: Client, future: Future[Any]) -> None:
    """Release a future; wait until a cancelled one is forgotten, so that its key can be submitted again."""
    future.release()
    until = time.monotonic() + POLL
    while future.status == "cancelled" and future.key in client.futures and time.monotonic() < until:
        time.sleep(0.01)


def workers_of(client: Client) -> dict[str, dict[str, Any]]:
    """Ask the scheduler for what it knows of its workers, by address.

    `Client.scheduler_info` may answer without any worker: the client keeps the last answer to either of two questions,
    and asks every other second for the state of the cluster alone. None, too, if the scheduler is gone.
    """
    if client.status == "running" and client.scheduler is not None:
        with suppress(OSError):
            identity: dict[str, dict[str, Any]] = client.sync(client.scheduler.identity, n_workers=-1)
            return identity["workers"]
    return {}


def await_workers(client: Client, listener: Listener) -> dict[str, dict[str, Any]]:
    """Return what the scheduler knows of its workers, by address, once there is one.

    Raises
    ------
    InputError
        If there is none in time; see `waiting_for_workers`.
    """
    if found := workers_of(client):
        return found
    began, patience = time.monotonic(), _patience_seconds()
    if patience:
        _note_waiting(listener, "the dask scheduler has no worker")
    # A cluster that adapts to its load starts workers once there is a task.
    task = client.submit(time.monotonic, pure=False)
    while not (found := workers_of(client)):
        if client.status != "running" or time.monotonic() - began >= patience:
            lack = f"had no worker for {patience:g} s" if patience else "no worker"
            raise InputError(f"the dask scheduler has {lack}; {REMEDY}")
        with suppress(TimeoutError):
            client.wait_for_workers(1, timeout=min(POLL, patience))
    task.release()
    return found


def _note_waiting(listener: Listener, what: str) -> None:
    listener.note(f"{what}: waiting for one, at most {_patience_seconds():g} s")


class Watch:
    """Waits for futures, and fails if the cluster makes no progress."""

    def __init__(self, client: Client, listener: Listener) -> None:
        self._client, self._listener = client, listener
        self._last_finished = self._last_worker = time.monotonic()
        self._workers = NOBODY
        self._missed = False  # whether the last worker is known to be lost
        self.one_thread_each = False  # as count_workers found it

    def count_workers(self) -> int:
        """Ask the scheduler for the number of workers; return at least 1."""
        workers = workers_of(self._client).values()
        if workers:
            self._last_worker, self._missed = time.monotonic(), False
            self.one_thread_each = all(w["nthreads"] == 1 for w in workers)
            memory, limit = max((w["metrics"].get("memory", 0), w["memory_limit"]) for w in workers)
            self._workers = Workers(len(workers), int(memory), int(limit or 0))
        return max(self._workers.number, 1)

    def notify(self, running: Mapping[Future[Any], str]) -> None:
        """Tell the listener the units in flight and the last known state of the workers; the scheduler is not asked."""
        self._listener.watch(list(running.values()), self._workers)

    def wait_for_any(self, running: Mapping[Future[Any], str], stage: str) -> list[Future[Any]]:
        """Wait until a future is done or cancelled; return all that are.

        Raises
        ------
        ProcessingError
            If the scheduler is gone, there has been no worker for too long (see `waiting_for_workers`), or workers have
            finished no unit for STALL seconds.
        """
        while True:
            try:
                wait(list(running), timeout=POLL, return_when="FIRST_COMPLETED")
            except (TimeoutError, CancelledError):
                self._check(running, stage)
            if ended := [future for future in running if future.status in (*DONE, "cancelled")]:
                if any(future.status in DONE for future in ended):
                    self._last_finished = time.monotonic()
                return ended

    def _check(self, running: Mapping[Future[Any], str], stage: str) -> None:
        units = ", ".join(running.values())
        if self._client.status != "running":
            raise ProcessingError(f"{stage} of {units} was cut short: the dask scheduler is gone")
        before = time.monotonic()
        self.count_workers()
        self.notify(running)
        if self._last_worker < before:
            self._miss_workers(f"{stage} of {units}")
        elif before - self._last_finished > STALL:
            raise ProcessingError(f"{stage} of {units} hangs: nothing was finished for {STALL:.0f} s")

    def _miss_workers(self, units: str) -> None:
        """Fail if there has been no worker for too long; until then say so once, if others are to start them."""
        self._last_finished = now = time.monotonic()  # nothing hangs as long as nobody works
        others = _patience.get() is not None
        if now - self._last_worker > _patience_seconds():
            remedy = f"; {REMEDY}" if others else ""
            raise ProcessingError(f"{units} waits in vain: no worker for {_patience_seconds():g} s{remedy}")
        if others and not self._missed:
            _note_waiting(self._listener, "no worker is left")
        self._missed = True


GPU = {"GPU": 1}  # dask's resources of a worker that has one


def spans(n: int, size: int) -> list[tuple[int, int]]:
    """Divide 0 .. n into spans (first, end) of `size`; the last may be shorter."""
    return [(first, min(first + size, n)) for first in range(0, n, size)]


def single_task(
    client: Client, run: Run, step: str, unit: str, task: Callable[..., Receipt], *arguments: Any, on: str = "cpu"
) -> Unit:
    """Return a unit of work that is a single task, `task(run, unit, *arguments)`; on a GPU it has one for itself."""
    key = f"{step}-{run.token}-{unit}"
    needed = {"resources": GPU} if on == "gpu" else {}
    return unit, partial(client.submit, task, run, unit, *arguments, key=key, pure=False, **needed)


def run_units(
    client: Client,
    stage: str,
    units: Sequence[Unit],
    run: Run,
    listener: Listener,
    *,
    per_worker: int = 1,
    ahead: bool = False,
    reading_input: Iterable[str] = (),
) -> list[Receipt]:
    """Run the units that have no valid receipt; return the receipts of all units in order.

    Parameters
    ----------
    per_worker : int
        Units in flight for each worker.
    ahead : bool
        One more for each worker of one thread, to follow at once; for units of one task.
    reading_input : iterable of str
        Units that read the input of the run: their InputErrors are raised as such.

    Returns
    -------
    list of Receipt
        `reused` if the unit was not run again; `damaged` if it was, because its data were damaged.

    Raises
    ------
    ProcessingError
        If a unit or the cluster fails for good; finished units stay.
    InputError
        If a unit finds the input wrong.
    """
    readers = frozenset(reading_input)
    earlier = {unit: receipt for unit, _ in units if (receipt := run.receipt(unit)) is not None}
    receipts: dict[str, Receipt] = {}
    damaged = set()
    # Workers check the data: this process never loads samples.
    checks = [(unit, _submit_check(client, run, receipt)) for unit, receipt in earlier.items()]
    if checks:
        listener.begin(f"check-{stage}")
    for number, (unit, future) in enumerate(as_completed(client, stage, checks, 2, listener), 1):
        if _result(future, stage, unit):
            receipts[unit] = replace(earlier[unit], reused=True)
        else:
            damaged.add(unit)
        listener.update(f"check-{stage}", number, len(checks))
    listener.begin(stage, reused=len(receipts))
    listener.update(stage, len(receipts), len(units))
    waiting = deque(unit for unit in units if unit[0] not in receipts)
    for unit, future in as_completed(client, stage, waiting, per_worker, listener, ahead=ahead):
        signed: Receipt = _result(future, stage, unit, reads_input=unit in readers)
        receipts[unit] = replace(signed, damaged=unit in damaged)
        listener.update(stage, len(receipts), len(units))
    return [receipts[unit] for unit, _ in units]


def _submit_check(client: Client, run: Run, receipt: Receipt) -> Callable[[], Future[Any]]:
    key = f"verify-{run.token}-{receipt.unit}"
    return partial(client.submit, run.intact, receipt, key=key, pure=False)


def _result(future: Future[Any], stage: str, unit: str, *, reads_input: bool = False) -> Any:
    """Return the result of a unit, or raise its error with the stage and the unit."""
    if future.status == "finished":
        return future.result()
    error = future.exception()
    # A defect in the run's own stores is not an error in the user's input.
    if isinstance(error, ProcessingError) or (reads_input and isinstance(error, InputError)):
        raise error
    if isinstance(error, KilledWorker):
        raise ProcessingError(
            f"{stage} of {unit} failed: {error.allowed_failures + 1} workers died of it, perhaps for lack of memory; "
            "give them more with --memory-limit"
        )
    raise ProcessingError(f"{stage} of {unit} failed: {type(error).__name__}: {error}") from error
