"""Tasks in the calling process: no cluster, no other processes, and so no main guard in scripts."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

from blocksar.progress import NOBODY, Listener


class Done:
    """What a task has left: its result or its error. It has those methods of dask's futures that the stages call."""

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
