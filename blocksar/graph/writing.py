"""Writing of chunks by other threads, while a task computes the next ones."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Any

from blocksar.chunks import WRITES_AT_ONCE
from blocksar.runs.record import Written


class WritesBehind:
    """Writes that lag behind what is computed by a few turns; the end of the `with` waits for the last of them.

    Parameters
    ----------
    held : int
        Turns whose results are held at a time: the one that is computed, and those that are written meanwhile.

    Attributes
    ----------
    waited : float
        Seconds for which turns have waited.
    """

    def __init__(self, held: int = WRITES_AT_ONCE + 1) -> None:
        self.waited = 0.0
        self._held, self._pool = held, ThreadPoolExecutor(WRITES_AT_ONCE)
        self._turns: list[list[Future[Sequence[Written]]]] = []

    def __enter__(self) -> WritesBehind:
        return self

    def __exit__(self, *error: type[BaseException] | BaseException | TracebackType | None) -> None:
        self._pool.shutdown(wait=True)

    def turn(self) -> int:
        """Begin a turn when the one whose memory it takes is written; return that memory's number, 0 .. held - 1."""
        if len(self._turns) >= self._held:
            began = time.perf_counter()
            for future in self._turns[-self._held]:
                future.result()
            self.waited += time.perf_counter() - began
        self._turns.append([])
        return (len(self._turns) - 1) % self._held

    def submit(self, write: Callable[..., Sequence[Written]], *arguments: Any, **options: Any) -> None:
        """Have something written that the turn has computed."""
        self._turns[-1].append(self._pool.submit(write, *arguments, **options))

    @property
    def written(self) -> tuple[Written, ...]:
        """All that was written, in the order of the turns; waits for what is not written yet."""
        return tuple(part for turn in self._turns for future in turn for part in future.result())
