"""The listener that a caller wants, from what was given as `progress`.

The listener of functions that are called in a notebook: bars below the cell.
"""

from __future__ import annotations

import importlib
import sys
import time
from collections.abc import Callable
from html import escape
from typing import Any, Literal

from blocksar.errors import InputError
from blocksar.progress.display import FRAMES, Progress
from blocksar.progress.estimate import Stage, clock_time
from blocksar.progress.listening import Listener, Updated, UpdateListener
from blocksar.texts import time_text


def in_notebook() -> bool:
    """Tell whether this process is the kernel of a Jupyter notebook."""
    ipython = sys.modules.get("IPython")
    return getattr(ipython.get_ipython(), "kernel", None) is not None if ipython is not None else False


class CellProgress(Progress):
    """Shows the progress of a function below the cell that called it, as bars that are drawn again as they grow.

    Parameters
    ----------
    clock : callable
        Returns the time, s.
    """

    def __init__(self, *, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(quiet=True, clock=clock)
        self._output: Any = importlib.import_module("IPython.display")
        self._handle: Any = None
        self._drawn = -float("inf")
        self._notes: list[str] = []

    def update(self, stage: str, done: int, total: int) -> None:
        super().update(stage, done, total)
        if done >= total or self.estimate.clock() - self._drawn >= 1 / FRAMES:
            self._draw()

    def note(self, text: str, *, again: bool = False) -> None:
        if not again:
            self._notes.append(text)
            self._draw()

    def _draw(self) -> None:
        self._drawn = self.estimate.clock()
        content = self._output.HTML(self.html())
        if self._handle is None:
            self._handle = self._output.display(content, display_id=True)
        else:
            self._handle.update(content)

    def html(self) -> str:
        """The bars and the times as HTML."""
        with self._lock:
            now, left = self.estimate.clock(), self.estimate.left()
            rows = "".join(_row(stage, now) for stage in self.estimate.stages.values())
            elapsed = clock_time(self.estimate.elapsed)
        notes = "".join(f"<div>note: {escape(text)}</div>" for text in self._notes)
        remaining = f", about {time_text(left)} left" if left else ""
        return f"<table>{rows}</table><div>{elapsed} elapsed{remaining}</div>{notes}"


def _row(stage: Stage, now: float) -> str:
    begun = stage.last_finished is not None
    value = (stage.done / stage.total if stage.total else 1.0) if begun else 0.0
    count = f"{stage.done}/{stage.total}" if begun else ""
    seconds = clock_time(stage.seconds(now)) if stage.begun is not None else ""
    return (
        f'<tr><td style="text-align:left">{escape(stage.name)}</td>'
        f'<td><progress value="{value:.4f}" max="1" aria-label="{escape(stage.name)}"></progress></td>'
        f"<td>{count}</td><td>{seconds}</td></tr>"
    )


Wanted = Updated | Literal[False]  # of a parameter that may also be None


def as_listener(wanted: Wanted | None) -> Listener:
    """Return a full listener: for an object that may have `update` only, for None and for False.

    None stands for bars below the cell in a Jupyter notebook and for silence elsewhere, False for silence.

    Raises
    ------
    InputError
        If it is none of these.
    """
    if wanted is None and in_notebook():
        return CellProgress()
    if wanted is None or wanted is False:
        return Listener()
    if isinstance(wanted, Listener):
        return wanted
    if not callable(getattr(wanted, "update", None)):
        raise InputError(
            f"progress is {wanted!r}; give an object with a method update(stage, done, total), or False for silence"
        )
    return UpdateListener(wanted)
