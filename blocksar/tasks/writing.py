"""Computation in threads, with reading ahead of it and writing behind it."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Any, TypeVar

from blocksar.chunks import WRITES_AT_ONCE, WRITES_PER_THREAD
from blocksar.runs.record import Written

T = TypeVar("T")


class WritesBehind:
    """Writing behind the computation by a few turns; leaving the `with` block waits for the last write.

    Parameters
    ----------
    held : int, optional
        Turns whose results are held at a time: those that are computed, and those that are written meanwhile. Default:
        so many that neither waits for the other.
    threads : int
        Threads that compute, by `in_threads`.

    Attributes
    ----------
    held : int
    waited : float
        Seconds for which turns have waited.
    """

    def __init__(self, held: int | None = None, *, threads: int = 1) -> None:
        writers = writes_at_once(threads)
        self.held, self.waited = held or turns_at_once(threads) + writers, 0.0
        self._pool = ThreadPoolExecutor(writers)
        self._turns: list[ComputeTurn] = []

    def __enter__(self) -> WritesBehind:
        return self

    def __exit__(self, *error: type[BaseException] | BaseException | TracebackType | None) -> None:
        self._pool.shutdown(wait=True)

    def turn(self) -> ComputeTurn:
        """Begin a turn, once the earlier turn whose buffer it reuses has been written."""
        if len(self._turns) >= self.held:
            began = time.perf_counter()
            self._turns[-self.held].wait()
            self.waited += time.perf_counter() - began
        self._turns.append(ComputeTurn(self._pool, len(self._turns) % self.held))
        return self._turns[-1]

    @property
    def written(self) -> tuple[Written, ...]:
        """Wait for all writes; return their results in the order of the turns."""
        return tuple(part for turn in self._turns for part in turn.wait())


class ComputeTurn:
    """Unit of computation whose results are written while the next one is computed.

    Attributes
    ----------
    memory : int
        Number of the memory that its results may take: 0 .. held - 1.
    """

    def __init__(self, pool: ThreadPoolExecutor, memory: int) -> None:
        self.memory = memory
        self._pool, self._writes = pool, list[Future[Sequence[Written]]]()

    def submit(self, write: Callable[..., Sequence[Written]], *arguments: Any, **options: Any) -> None:
        """Submit a write of results of this turn."""
        self._writes.append(self._pool.submit(write, *arguments, **options))

    def wait(self) -> list[Written]:
        """Wait until this turn's writes have ended; return their results."""
        return [part for write in self._writes for part in write.result()]


def writes_at_once(threads: int) -> int:
    """Number of threads that write while `threads` compute."""
    return max(WRITES_AT_ONCE, math.ceil(WRITES_PER_THREAD * threads))


def turns_at_once(threads: int) -> int:
    """Number of turns that `in_threads` begins before it yields one."""
    return threads + 1 if threads > 1 else 1


def in_threads(jobs: Iterable[Callable[[], T]], threads: int) -> Iterator[T]:
    """Yield the results of jobs in order, computed in `threads` threads; by the caller if that is 1.

    Job k is asked for when all before job k - turns_at_once(threads) + 1 have been used.
    """
    if threads == 1:
        for job in jobs:
            yield job()
        return
    with ThreadPoolExecutor(threads) as pool:
        yield from ahead(pool, jobs, threads)


def ahead(pool: ThreadPoolExecutor, jobs: Iterable[Callable[[], T]], count: int) -> Iterator[T]:
    """Yield the results of jobs in order; up to `count` jobs run in the pool ahead of use."""
    coming: deque[Future[T]] = deque()
    for job in jobs:
        coming.append(pool.submit(job))
        if len(coming) > count:
            yield coming.popleft().result()
    while coming:
        yield coming.popleft().result()
