"""Units of work, plain records of tasks, and two executors: this process, or a dask cluster.

Every stage of a run or of an estimate is a list of units for `Executor.run_units`. Those that have a valid receipt are
left out. The others are submitted, no more at a time than were planned for; each signs a receipt where it runs, once
its data are written. Receipts are the log, from which a killed run goes on. Tasks receive paths and small constants,
and write samples to stores; these pass from one task to the next within a worker, but never through the scheduler.
"""

from __future__ import annotations

import sys
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, replace
from typing import Any, NoReturn

from distributed import Client, Future, KilledWorker, wait

from blocksar.errors import InputError, ProcessingError
from blocksar.places.posix import resource
from blocksar.progress import NOBODY, Listener, Workers
from blocksar.runs.receipts import Run
from blocksar.runs.record import Receipt
from blocksar.texts import count


@dataclass(frozen=True, eq=False)
class Unit:
    """A unit of work: `task(run, name, *results, *arguments)`, which returns its receipt, not signed yet.

    Attributes
    ----------
    step : str
        Begins the key of its task on a cluster.
    run : Run
        As the task sees it.
    name : str
        Of its receipt; unique in a run.
    task : callable
    arguments : tuple
        Paths and small constants.
    after : tuple of Unit
        Tasks before this one, whose `results` stay in the worker that has made them. They leave no receipts, and are
        done with the unit: again, if it is.
    title : str
        What has failed if the task does, as its error says; empty: that depends on the error, see `_fail`.
    priority : int
        On a cluster; units of a higher one come first.
    on : str
        "gpu": it has a worker's GPU for itself.
    reads_input : bool
        Whether its InputErrors are about the input of the run, and raised as such.
    """

    step: str
    run: Run
    name: str
    task: Callable[..., Any]
    arguments: tuple[Any, ...] = ()
    after: tuple[Unit, ...] = ()
    title: str = ""
    priority: int = 0
    on: str = "cpu"
    reads_input: bool = False


def perform(unit: Unit, *results: Any) -> Any:
    """Run the task of a unit, where the unit is executed; sign its receipt, if it returns one.

    The seconds of the receipt are those of the task, and those that it has counted itself, of tasks before it.
    """
    started = time.perf_counter()
    try:
        made = unit.task(unit.run, unit.name, *results, *unit.arguments)
        if not isinstance(made, Receipt):
            return made
        return unit.run.sign(replace(made, peak_memory=peak_memory()), started - made.seconds)
    except Exception as error:
        if not unit.title:
            raise
        kind = "" if isinstance(error, InputError | ProcessingError) else f"{type(error).__name__}: "
        raise ProcessingError(f"{unit.title} failed: {kind}{error}") from error


def peak_memory() -> int:
    """Return the peak memory of this process since its start, bytes.

    Linux's high-water mark, where there is one: getrusage also counts the memory of the parent at the fork.
    """
    with suppress(OSError), open("/proc/self/status", encoding="ascii") as status:
        for line in status:
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def _intact(run: Run, _: str, receipt: Receipt) -> bool:
    return run.intact(receipt)


class Executor(ABC):
    """Runs units of work, and reports their progress to `listener`."""

    def __init__(self, listener: Listener) -> None:
        self.listener = listener

    @abstractmethod
    def execute(
        self, stage: str, units: Sequence[Unit], *, per_worker: int = 1, ahead: bool = False
    ) -> Iterator[tuple[str, Any]]:
        """Run all units, also those with receipts; yield the name and result of each as it ends.

        Raises
        ------
        ProcessingError, InputError
            As `run_units`.
        """

    def run_units(
        self, stage: str, units: Sequence[Unit], *, per_worker: int = 1, ahead: bool = False
    ) -> list[Receipt]:
        """Run the units that have no valid receipt; return the receipts of all units in order.

        Parameters
        ----------
        stage : str
            What listeners and errors call them.
        units : sequence of Unit
        per_worker : int
            Units in flight for each worker.
        ahead : bool
            One more for each worker of one thread, to follow at once; for units of one task.

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
        earlier = {unit.name: receipt for unit in units if (receipt := unit.run.receipt(unit.name)) is not None}
        receipts: dict[str, Receipt] = {}
        damaged = set()
        # Workers check the data: this process never loads samples.
        checks = [
            Unit("verify", unit.run, unit.name, _intact, (earlier[unit.name],))
            for unit in units
            if unit.name in earlier
        ]
        if checks:
            self.listener.begin(f"check-{stage}")
        for number, (name, intact) in enumerate(self.execute(stage, checks, per_worker=2), 1):
            if intact:
                receipts[name] = replace(earlier[name], reused=True)
            else:
                damaged.add(name)
            self.listener.update(f"check-{stage}", number, len(checks))
        self.listener.begin(stage, reused=len(receipts))
        self.listener.update(stage, len(receipts), len(units))
        missing = [unit for unit in units if unit.name not in receipts]
        for name, receipt in self.execute(stage, missing, per_worker=per_worker, ahead=ahead):
            receipts[name] = replace(receipt, damaged=name in damaged)
            self.listener.update(stage, len(receipts), len(units))
        return [receipts[unit.name] for unit in units]


def _fail(error: BaseException, stage: str, unit: Unit) -> NoReturn:
    """Raise a unit's error, with stage and unit in the message."""
    # A defect in the run's own stores is not an error in the user's input.
    if isinstance(error, ProcessingError) or (unit.reads_input and isinstance(error, InputError)):
        raise error
    if isinstance(error, KilledWorker):
        raise ProcessingError(
            f"{stage} of {unit.name} failed: {count(error.allowed_failures + 1, 'worker')} died of it, perhaps for "
            "lack of memory; give them more with --memory-limit"
        )
    raise ProcessingError(f"{stage} of {unit.name} failed: {type(error).__name__}: {error}") from error


class ThisProcess(Executor):
    """Runs units in this process, one after the other."""

    def execute(
        self, stage: str, units: Sequence[Unit], *, per_worker: int = 1, ahead: bool = False
    ) -> Iterator[tuple[str, Any]]:
        for unit in units:
            self.listener.watch([unit.name], NOBODY)
            try:
                made = self._perform(unit)
            except Exception as error:
                _fail(error, stage, unit)
            yield unit.name, made

    def _perform(self, unit: Unit) -> Any:
        return perform(unit, *map(self._perform, unit.after))


NO_WORKER = 120.0  # s without any worker before a run fails, where workers are started again by themselves
STALL = 3600.0  # s without a finished unit before a run fails
DONE = ("finished", "error")  # final states of a future; one lost with its worker becomes pending again
GPU = {"GPU": 1}  # dask's resources of a worker that has one
POLL = 2.0  # s between two checks of the cluster while no unit finishes
REMEDY = "start some, or wait longer for them (--wait-workers)"

_patience: ContextVar[float | None] = ContextVar("patience", default=None)


@contextmanager
def waiting_for_workers(seconds: float | None) -> Iterator[None]:
    """Set, for the block, the seconds to wait for a first worker or after the last is lost; None: NO_WORKER."""
    before = _patience.set(seconds)
    try:
        yield
    finally:
        _patience.reset(before)


def _patience_seconds() -> float:
    seconds = _patience.get()
    return NO_WORKER if seconds is None else seconds


def workers_of(client: Client) -> dict[str, dict[str, Any]]:
    """Query the scheduler's records of its workers, by address.

    `Client.scheduler_info` may answer without any worker: the client keeps the last answer to either of two questions,
    and asks every other second for the state of the cluster alone. None, too, if the scheduler is gone.
    """
    if client.status == "running" and client.scheduler is not None:
        with suppress(OSError):
            identity: dict[str, dict[str, Any]] = client.sync(client.scheduler.identity, n_workers=-1)
            return identity["workers"]
    return {}


def await_workers(client: Client, listener: Listener) -> dict[str, dict[str, Any]]:
    """Wait for a first worker; return the scheduler's records of its workers, by address.

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


class OnCluster(Executor):
    """Runs units on a dask cluster: each is a task, or a chain of them, submitted by the client."""

    def __init__(self, client: Client, listener: Listener) -> None:
        super().__init__(listener)
        self.client = client

    def execute(
        self, stage: str, units: Sequence[Unit], *, per_worker: int = 1, ahead: bool = False
    ) -> Iterator[tuple[str, Any]]:
        """Submit units, at most `per_worker` in flight for each worker; yield each once it has ended.

        The client limits the number in flight, so that no worker holds more data than was planned for it. With `ahead`,
        workers of one thread each have one more, which waits for that thread and holds nothing. A result that is lost
        with its worker is computed again; a unit that the scheduler has forgotten is submitted again.

        Raises
        ------
        ProcessingError
            Also if the scheduler is gone, no worker is left, or no unit finishes any more.
        """
        waiting, running = deque(units), dict[Future[Any], Unit]()
        watch = Watch(self.client, self.listener)
        try:
            while True:
                places = watch.count_workers() * (per_worker + (ahead and watch.one_thread_each))
                for _ in range(min(places - len(running), len(waiting))):
                    unit = waiting.popleft()
                    running[self._submit(unit)] = unit
                watch.notify(running.values())
                if not running:
                    return
                for future in watch.wait_for_any(running, stage):
                    unit = running[future]
                    if future.status in DONE:
                        watch.notify(other for other in running.values() if other is not unit)
                        if future.status == "error" and (error := future.exception()) is not None:
                            _fail(error, stage, unit)
                        yield unit.name, future.result()
                    elif future.status == "cancelled" and self.client.status == "running":
                        waiting.append(unit)
                    else:
                        continue
                    del running[future]
                    self._release(future)
        finally:
            # After a failure or an interruption: a shared cluster must neither go on with the units nor keep the
            # failure.
            if running and self.client.status == "running":
                self.client.cancel(list(running), force=True)

    def _submit(self, unit: Unit) -> Future[Any]:
        """Submit the task of a unit and those before it; `priority` makes workers finish what they have begun."""
        before = [self._submit(one) for one in unit.after]
        needed = {"resources": GPU} if unit.on == "gpu" else {}
        key = f"{unit.step}-{unit.run.token}-{unit.name}"
        return self.client.submit(
            perform, replace(unit, after=()), *before, key=key, pure=False, priority=unit.priority, **needed
        )

    def _release(self, future: Future[Any]) -> None:
        """Release a future; wait until a cancelled one is forgotten, so that its key can be submitted again."""
        future.release()
        until = time.monotonic() + POLL
        while future.status == "cancelled" and future.key in self.client.futures and time.monotonic() < until:
            time.sleep(0.01)


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

    def notify(self, units: Iterable[Unit]) -> None:
        """Report the units in flight and the last known state of the workers, without asking the scheduler."""
        self._listener.watch([unit.name for unit in units], self._workers)

    def wait_for_any(self, running: Mapping[Future[Any], Unit], stage: str) -> list[Future[Any]]:
        """Wait until a future is done or cancelled; return all that are.

        Raises
        ------
        ProcessingError
            If the scheduler is gone, there has been no worker for too long (see `waiting_for_workers`), or workers have
            finished no unit for STALL seconds.
        """
        while True:
            try:
                with self._client.as_current():  # `wait` takes no other
                    wait(list(running), timeout=POLL, return_when="FIRST_COMPLETED")
            except (TimeoutError, CancelledError):
                self._check(running, stage)
            if ended := [future for future in running if future.status in (*DONE, "cancelled")]:
                if any(future.status in DONE for future in ended):
                    self._last_finished = time.monotonic()
                return ended

    def _check(self, running: Mapping[Future[Any], Unit], stage: str) -> None:
        units = ", ".join(unit.name for unit in running.values())
        if self._client.status != "running":
            raise ProcessingError(f"{stage} of {units} was cut short: the dask scheduler is gone")
        before = time.monotonic()
        self.count_workers()
        self.notify(running.values())
        if self._last_worker < before:
            self._miss_workers(f"{stage} of {units}")
        elif before - self._last_finished > STALL:
            raise ProcessingError(f"{stage} of {units} hangs: nothing was finished for {STALL:.0f} s")

    def _miss_workers(self, units: str) -> None:
        """Fail if there has been no worker for too long; before that note it once, if workers are started by others."""
        self._last_finished = now = time.monotonic()  # nothing hangs as long as nobody works
        others = _patience.get() is not None
        if now - self._last_worker > _patience_seconds():
            remedy = f"; {REMEDY}" if others else ""
            raise ProcessingError(f"{units} waits in vain: no worker for {_patience_seconds():g} s{remedy}")
        if others and not self._missed:
            _note_waiting(self._listener, "no worker is left")
        self._missed = True
