"""For people: a live display on a terminal, a few plain lines elsewhere; and all of it together."""

from __future__ import annotations

import math
import os
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from blocksar.progress.estimate import Estimate, Stage
from blocksar.progress.listening import NOBODY, Listener, Work, Workers
from blocksar.progress.log import Log
from blocksar.progress.words import about, clock_time, rate_text

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderableType
    from rich.live import Live


PLAIN_STEPS = 10  # progress lines a stage, where there is no terminal
FRAMES = 4  # a second, of the live display
LOG_SECONDS = 1.0  # at least, between two progress lines of a stage in the log but its first and last
LOG_SILENCE = 10.0  # at most, about, while workers are heard of
MOST_NAMES = 8  # units at work that are named in the log
GIB = 2**30


class Progress(Listener):
    """Shows how far a command has come, on stderr and in a log; may be told from any thread.

    Parameters
    ----------
    quiet : bool
        Show nothing; the log is written all the same.
    log : path, optional
        File that JSON lines are appended to.

    Raises
    ------
    InputError
        If the log cannot be written.
    """

    def __init__(
        self, *, quiet: bool = False, log: str | Path | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.estimate = Estimate(clock)
        self._quiet = quiet
        self._lock = threading.Lock()
        self._live: Live | None = None
        self._printed: dict[str, int] = {}
        self._logged: dict[str, float] = {}
        self._units: Sequence[str] = ()
        self._workers = NOBODY
        self._over = False
        self._log = None if log is None else Log(log)

    def __enter__(self) -> Self:
        if not self._quiet and sys.stderr.isatty() and os.environ.get("TERM") not in ("dumb", "unknown"):
            from rich.console import Console
            from rich.live import Live

            self._live = Live(
                console=Console(stderr=True),
                get_renderable=lambda: _Frame(self),
                refresh_per_second=FRAMES,
                redirect_stdout=False,
            )
            self._live.start()
        _SHOWN.append(self)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._over = True
        if self._live is not None:
            self._live.stop()
        _SHOWN.remove(self)
        if self._log is not None:
            self._log.close()

    # ---- what a command says of itself

    def start(self, command: str, settings: Mapping[str, Any], version: str) -> None:
        """Log what was asked for."""
        self._tell_log("start", command=command, settings=settings, version=version)

    def end(self, status: int, message: str = "") -> None:
        """Log how the command ended: its exit status, and what was wrong."""
        self._tell_log("end", status=status, message=message, seconds=round(self.estimate.elapsed, 3))

    # ---- what is told on the way

    def expect(self, work: Work, workers: int) -> None:
        with self._lock:
            self.estimate.expect(work, workers)

    def begin(self, stage: str, reused: int = 0) -> None:
        with self._lock:
            self.estimate.begin(stage, reused)
            self._logged.pop(stage, None)
            self._printed.pop(stage, None)

    def update(self, stage: str, done: int, total: int) -> None:
        with self._lock:
            found = self.estimate.update(stage, done, total)
            left = self.estimate.left()
            self._log_stage(found, left)
            if self._live is None and not self._quiet:
                self._print(found, left)

    def watch(self, units: Sequence[str], workers: Workers) -> None:
        with self._lock:
            self._units, self._workers = units, workers
            current = self.estimate.current
            if current is not None and self.estimate.clock() - self._logged.get(current.name, math.inf) > LOG_SILENCE:
                self._log_progress(current, self.estimate.left())

    def dashboard(self, address: str) -> None:
        self._tell_log("dashboard", address=address)
        self._say(f"dashboard: {address}")

    def note(self, text: str, *, again: bool = False) -> None:
        self._tell_log("note", message=text)
        if not again:
            self._say(f"note: {text}")

    # ---- how it is shown

    def _say(self, line: str) -> None:
        if self._live is not None:
            self._live.console.print(line, markup=False, highlight=False, soft_wrap=True)
        elif not self._quiet:
            print(line, file=sys.stderr, flush=True)

    def _print(self, stage: Stage, left: float | None) -> None:
        step = PLAIN_STEPS * stage.done // stage.total if stage.total else PLAIN_STEPS
        if stage.total == 1 and not stage.done:  # one line says it all
            return
        if step > self._printed.get(stage.name, -1):
            self._printed[stage.name] = step
            ahead = f", about {about(left)} left" if left else ""
            self._say(
                f"{stage.name}: {stage.done} of {stage.total}, {clock_time(self.estimate.elapsed)} elapsed{ahead}"
            )

    def _log_stage(self, stage: Stage, left: float | None) -> None:
        now, last = self.estimate.clock(), self._logged.get(stage.name)
        if last is None:
            self._tell_log("stage", stage=stage.name, total=stage.total, reused=stage.reused)
        if last is None or stage.finished or now - last >= LOG_SECONDS:
            self._log_progress(stage, left)

    def _log_progress(self, stage: Stage, left: float | None) -> None:
        self._logged[stage.name] = self.estimate.clock()
        workers = self._workers
        self._tell_log(
            "progress",
            stage=stage.name,
            done=stage.done,
            total=stage.total,
            rate=_rounded(stage.rate()),
            elapsed=round(self.estimate.elapsed, 3),
            seconds_left=None if left is None else round(left, 1),
            workers=workers.number,
            memory=workers.memory or None,
            memory_limit=workers.limit or None,
            at_work=list(self._units[:MOST_NAMES]),
        )

    def _tell_log(self, event: str, **facts: Any) -> None:
        if self._log is None:
            return
        sound = self._log.trouble is None
        self._log.write(event, **facts)
        if sound and self._log.trouble is not None:
            self._say(f"note: {self._log.trouble}: the run goes on without")

    def abandon(self, status: int, message: str) -> None:
        """For a process that is about to end at once: no lock is taken, nothing is waited for."""
        if self._log is not None:
            self._log.write("end", status=status, message=message, seconds=round(self.estimate.elapsed, 3))
        if self._live is not None:
            os.write(2, b"\n\x1b[?25h")  # the cursor comes back

    # ---- a frame of the live display

    def frame(self, width: int, height: int) -> RenderableType:
        """What a terminal of so many columns and rows shows now."""
        from rich.console import Group

        with self._lock:
            rows = [_row(stage, self.estimate.clock()) for stage in self.estimate.stages.values()]
            lines = self._lines(width)
        return Group(_table(_fitting(rows, height - len(lines) - 1), width), *lines)

    def _lines(self, width: int) -> list[RenderableType]:
        from rich.text import Text

        left = self.estimate.left()
        line = Text(f"{clock_time(self.estimate.elapsed)} elapsed", no_wrap=True, overflow="crop")
        if self._over:
            return [line]
        if left:
            line.append(", ").append(f"about {about(left)} left", style="bold")
        lines: list[RenderableType] = [line]
        if self._workers.number:
            lines.append(Text(_memory_text(self._workers), no_wrap=True, overflow="crop", style="dim"))
            if self._units:
                lines.append(Text(_units_text(self._units, width), no_wrap=True, overflow="crop", style="dim"))
        return lines


_SHOWN: list[Progress] = []  # those that are at it


def abandon(status: int, message: str) -> None:
    """End all logs and give the terminal back, for a process that is about to end at once."""
    for each in _SHOWN:
        with suppress(Exception):
            each.abandon(status, message)


def _rounded(rate: float | None) -> float | None:
    return None if rate is None else float(f"{rate:.4g}")


def _memory_text(workers: Workers) -> str:
    limit = f" of {workers.limit / GIB:.1f}" if workers.limit else ""
    whose = f"{workers.number} workers, the fullest holds" if workers.number > 1 else "the worker holds"
    return f"{whose} {workers.memory / GIB:.1f}{limit} GiB"


def _units_text(units: Sequence[str], width: int) -> str:
    """As many names as a line holds."""
    for shown in range(len(units), 0, -1):
        more = f" and {len(units) - shown} more" if shown < len(units) else ""
        text = f"at work: {', '.join(units[:shown])}{more}"
        if len(text) <= width:
            return text
    return f"at work: {len(units)} units"


class _Frame:
    """What the live display draws: as wide as the terminal is at that time."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Any:
        yield self._progress.frame(options.max_width, console.height)


@dataclass(frozen=True)
class _Row:
    """A stage, as the live display shows it."""

    name: str
    share: float | None  # None: nobody knows
    count: str
    rate: str
    seconds: str
    style: str


def _fitting(rows: list[_Row], room: int) -> list[_Row]:
    """As many rows as there is room for: what is long over goes first, then what is far ahead."""
    over = sum(row.share == 1.0 for row in rows)
    dropped = min(max(len(rows) - room, 0), over)
    return rows[dropped : dropped + max(room, 1)]


def _row(stage: Stage, now: float) -> _Row:
    if stage.begun is None:
        return _Row(stage.name, None, "", "", "", "dim")
    count = f"{stage.done}/{stage.total}" if stage.heard is not None else ""
    share = (stage.done / stage.total if stage.total else 1.0) if stage.heard is not None else 0.0
    rate = rate_text(stage.rate()) if stage.total > 1 else ""
    return _Row(stage.name, share, count, rate, clock_time(stage.seconds(now)), "" if stage.finished else "bold")


BAR_COLUMNS = 36  # of the live display, at most
RATE_NEEDS = 56  # columns of a terminal, for the rate to be shown
BAR_NEEDS = 40  # for the bar


def _table(rows: Sequence[_Row], width: int) -> RenderableType:
    from rich.progress_bar import ProgressBar
    from rich.table import Table
    from rich.text import Text

    table = Table.grid(padding=(0, 2, 0, 0))
    shown = [True, width >= BAR_NEEDS, True, width >= RATE_NEEDS, True]
    aligned: list[Any] = ["left", "left", "right", "right", "right"]
    widths = [max((len(cell) for cell in cells), default=0) for cells in _texts(rows)]
    for wanted, justify, least in zip(shown, aligned, widths, strict=True):
        if wanted:
            table.add_column(justify=justify, no_wrap=True, overflow="crop", min_width=least)
    taken = sum(least + 2 for least, wanted in zip(widths, shown, strict=True) if wanted and least)
    bar = max(min(BAR_COLUMNS, width - taken - 2), 4)
    for row in rows:
        cells: list[RenderableType] = [
            Text(row.name, style=row.style),
            "" if row.share is None else ProgressBar(total=1.0, completed=row.share, width=bar),
            Text(row.count),
            Text(row.rate, style="dim"),
            Text(row.seconds),
        ]
        table.add_row(*(cell for cell, wanted in zip(cells, shown, strict=True) if wanted))
    return table


def _texts(rows: Sequence[_Row]) -> list[list[str]]:
    """By column, with what lets columns stand still while they fill."""
    return [
        [row.name for row in rows],
        [],  # bars take what is left
        [*(row.count for row in rows), "000/000"],
        [*(row.rate for row in rows), "000/min"],
        [*(row.seconds for row in rows), "00:00"],
    ]
