"""Admission of units of work: a bounded number is in flight, and a stalled cluster is noticed."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from typing import Any

from distributed import Client, Future, wait

from blocksar.errors import ProcessingError
from blocksar.progress import NOBODY, Listener, Workers

Unit = tuple[str, Callable[[], Future[Any]]]  # a unit of work: its name, and what submits it
NO_WORKER = 120.0  # seconds without any worker
STALL = 3600.0  # seconds in which nothing was finished
DONE = ("finished", "error")  # of a future's states; what is lost with a worker is pending again soon
POLL = 2.0  # seconds between two looks at the cluster while nothing is finished


# ---------------------------------------------------------------- how much of it is asked


def in_turn(
    client: Client, stage: str, units: Sequence[Unit], each: int, report: Listener
) -> Iterator[tuple[str, Future[Any]]]:
    """Units as they are done, well or not, with no more of them at work than `each` a worker.

    Admission is by the client, so that no worker ever holds more than it was planned for. A unit whose outcome went
    with its worker is waited for again, and one that the scheduler has forgotten over that is started again.

    Raises
    ------
    ProcessingError
        If nothing more will come of the cluster.
    """
    waiting = deque(units)
    starts = dict(units)
    running: dict[Future[Any], str] = {}
    watch = Watch(client, report)
    try:
        while True:
            for _ in range(min(each * watch.workers() - len(running), len(waiting))):
                unit, start = waiting.popleft()
                running[start()] = unit
            watch.tell(running)
            if not running:
                return
            for future in watch.first(running, stage):
                if future.status in DONE:
                    watch.tell({other: unit for other, unit in running.items() if other is not future})
                    yield running[future], future
                elif future.status == "cancelled" and client.status == "running":
                    waiting.append((running[future], starts[running[future]]))
                else:
                    continue
                del running[future]
                _release(client, future)
    finally:
        # Where a unit failed or the run was interrupted: the cluster shall neither go on, nor remember the failure.
        if running and client.status == "running":
            client.cancel(list(running), force=True)


def _release(client: Client, future: Future[Any]) -> None:
    """Forget a future, and be sure of it: a unit that is started again must not get the old one back."""
    future.release()
    until = time.monotonic() + POLL
    while future.status == "cancelled" and future.key in client.futures and time.monotonic() < until:
        time.sleep(0.01)


class Watch:
    """Waits for a cluster, and notices when nothing more will come of it."""

    def __init__(self, client: Client, report: Listener) -> None:
        self._client, self._report = client, report
        self._heard = self._seen = time.monotonic()
        self._workers = NOBODY

    def workers(self) -> int:
        """How many there are now; at least one."""
        found = self._client.scheduler_info(n_workers=-1)["workers"].values()
        if found:
            self._seen = time.monotonic()
            memory, limit = max((w["metrics"].get("memory", 0), w["memory_limit"]) for w in found)
            self._workers = Workers(len(found), int(memory), int(limit or 0))
        return max(self._workers.number, 1)

    def tell(self, running: Mapping[Future[Any], str]) -> None:
        """What is at work, and how the workers were when they were last looked at: costs no message."""
        self._report.watch(list(running.values()), self._workers)

    def first(self, running: Mapping[Future[Any], str], stage: str) -> list[Future[Any]]:
        """Those of the futures that are done or cancelled, as soon as there is one.

        Raises
        ------
        ProcessingError
            If the scheduler has gone, if there has been no worker for NO_WORKER seconds, or if nothing was finished
            for STALL seconds.
        """
        while True:
            try:
                wait(list(running), timeout=POLL, return_when="FIRST_COMPLETED")
            except (TimeoutError, CancelledError):
                self._check(running, stage)
            if done := [future for future in running if future.status in (*DONE, "cancelled")]:
                if any(future.status in DONE for future in done):
                    self._heard = time.monotonic()
                return done

    def _check(self, running: Mapping[Future[Any], str], stage: str) -> None:
        units = ", ".join(running.values())
        if self._client.status != "running":
            raise ProcessingError(f"{stage} of {units} was cut short: the dask scheduler is gone")
        self.workers()
        self.tell(running)
        now = time.monotonic()
        if now - self._seen > NO_WORKER:
            raise ProcessingError(f"{stage} of {units} waits in vain: no worker for {NO_WORKER:.0f} s")
        if now - self._heard > STALL:
            raise ProcessingError(f"{stage} of {units} hangs: nothing was finished for {STALL:.0f} s")
