"""How far a command has come: what is told of it, how long it will go on, and what is shown.

Whoever does the work tells a `Listener`; `Estimate` makes time left of it; `Progress` shows it to people, as a live
display on a terminal and as a few plain lines elsewhere, and to programs, as a log of JSON lines.
"""

from __future__ import annotations

import errno
import json
import math
import os
import stat
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from heapq import heapreplace
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, Self

from blocksar.parameters import InputError

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderableType
    from rich.live import Live

Work = Mapping[str, Sequence[float]]  # of stages to come: predicted seconds of each unit

PLAIN_STEPS = 10  # progress lines a stage, where there is no terminal
FRAMES = 4  # a second, of the live display
LOG_SECONDS = 1.0  # at least, between two progress lines of a stage in the log but its first and last
LOG_SILENCE = 10.0  # at most, about, while workers are heard of
MOST_NAMES = 8  # units at work that are named in the log
GIB = 2**30


# ---------------------------------------------------------------- what is told


class Workers(NamedTuple):
    """What a scheduler knows of its workers."""

    number: int
    memory: int  # bytes, of the one that holds most now
    limit: int  # bytes, of that one; 0: none


NOBODY = Workers(0, 0, 0)


class Updated(Protocol):
    """The least that can be told how far a command has come."""

    def update(self, stage: str, done: int, total: int) -> None: ...


class Listener:
    """Told how far a command has come: a subclass overrides what it wants to hear. From one thread at a time."""

    def expect(self, work: Work, workers: int) -> None:
        """What stages are to come, in order, and the seconds that their units take one of so many workers.

        Only the ratios between predicted seconds matter. A stage without units will not come after all.
        """

    def begin(self, stage: str, reused: int = 0) -> None:
        """A stage begins; so many of its units were taken up from an earlier run."""

    def update(self, stage: str, done: int, total: int) -> None:
        """`done` of `total` units of a stage are finished."""

    def watch(self, units: Sequence[str], workers: Workers) -> None:
        """The units at work now, and those who work."""

    def dashboard(self, address: str) -> None:
        """Where a dashboard of the cluster can be seen."""

    def note(self, text: str, *, again: bool = False) -> None:
        """What a person should know, in a sentence; `again`: it is said once more with the result."""


class _UpdatedOnly(Listener):
    def __init__(self, progress: Updated) -> None:
        self.update = progress.update  # type: ignore[method-assign]


def listener(progress: Updated | None) -> Listener:
    """Whatever was given as `progress`, as a listener."""
    if progress is None:
        return Listener()
    return progress if isinstance(progress, Listener) else _UpdatedOnly(progress)


# ---------------------------------------------------------------- how long it will go on


def finishing_times(costs: Sequence[float], workers: int) -> list[float]:
    """When units are finished that are started in order, each as soon as a worker is free; ascending.

    Examples
    --------
    >>> finishing_times([2, 3, 2], 2)
    [2.0, 3.0, 4.0]
    """
    free = [0.0] * max(min(workers, len(costs)), 1)
    ends = []
    for cost in costs:
        end = free[0] + cost
        heapreplace(free, end)
        ends.append(end)
    return sorted(ends)


@dataclass
class Stage:
    """A stage's units, when they were finished, and when they ought to be.

    Attributes
    ----------
    costs : sequence of float or None
        Predicted seconds of each unit, in the order in which they are started; None: equal, of unknown length.
    reused : int
        Units that an earlier run has finished: the first ones.
    cold : bool
        Workers are new to it: what their first units take besides (imports, compiled code, cold files) tells nothing.
    begun, heard : float or None
        When the stage began, and when a unit was finished last, s.
    """

    name: str
    costs: Sequence[float] | None = None
    workers: int = 1
    cold: bool = False
    reused: int = 0
    done: int = 0
    total: int = 0
    begun: float | None = None
    heard: float | None = None
    _ends: Sequence[float] = ()
    _even: float | None = None  # predicted seconds of each unit, where all are alike
    _warm: tuple[float, float] | None = None  # when the first units were finished, and ought to be

    @property
    def finished(self) -> bool:
        return self.heard is not None and self.done >= self.total

    @property
    def made(self) -> int:
        """Units that were finished here, not by an earlier run."""
        return max(self.done - self.reused, 0)

    def update(self, done: int, total: int, now: float) -> None:
        if self.heard is None or total != self.total:
            self.total = total
            self._predict()
        if self.heard is None or done != self.done:
            self.heard = now
        self.done = done
        if self.cold and self._warm is None and self.workers <= self.made < self.total - self.reused:
            self._warm = now, self.end(self.made)

    def _predict(self) -> None:
        left = self.total - self.reused
        if self.costs is not None and len(self.costs) == self.total:
            self._even, self._ends = None, finishing_times(self.costs[self.reused :], self.workers)
        else:
            self._even = 1.0 if self.costs is None else sum(self.costs) / max(self.total, 1)
            self._ends = range(left)

    def end(self, count: int) -> float:
        """When so many of the units that are made here ought to be finished, seconds from the beginning."""
        if not count:
            return 0.0
        if self._even is None:
            return self._ends[count - 1]
        workers = 1 if self.costs is None else self.workers
        return self._even * math.ceil(count / workers)

    def seconds(self, now: float) -> float:
        """Since it began, until it was finished."""
        if self.begun is None:
            return 0.0
        return (self.heard if self.finished and self.heard is not None else now) - self.begun

    def rate(self) -> float | None:
        """Units finished here per second."""
        if not self.made or self.begun is None or self.heard is None or self.heard <= self.begun:
            return None
        return self.made / (self.heard - self.begun)

    def measured(self) -> tuple[float, float]:
        """Seconds that units took together, and ought to take; 0 and 0 where that is not known yet."""
        if not self.made or self.heard is None or self.begun is None:
            return 0.0, 0.0
        start, ahead = self._since()
        if self.cold and self._warm is None:  # also once it is finished: it was over before workers were warm
            return 0.0, 0.0
        return self.heard - start, max(self.end(self.made) - ahead, 0.0)

    def _since(self) -> tuple[float, float]:
        """From when on units are counted, and when those before ought to be finished."""
        return self._warm or (self.begun or 0.0, 0.0)

    def left(self, now: float, pace: float | None) -> float | None:
        """Seconds that it will go on, and None where nothing tells.

        Parameters
        ----------
        pace : float or None
            Seconds that a predicted second took other stages; counts until this stage has one of its own.
        """
        if self.finished:
            return 0.0
        if self.costs is None and not self.made:
            return None
        seconds, predicted = self.measured()
        pace = seconds / predicted if predicted else pace
        if pace is None:
            return None
        if self.begun is None or self.heard is None:
            return pace * self._whole()
        start, ahead = self._since()
        waited, following = now - start, self.end(self.made + 1) - ahead
        # The next unit is not finished yet: it takes at least as long as it has taken.
        pace = max(pace, waited / following) if following > 0 else pace
        return max(pace * (self.end(self.total - self.reused) - ahead) - waited, 0.0)

    def _whole(self) -> float:
        return finishing_times(self.costs or (), self.workers)[-1]


@dataclass
class Estimate:
    """All stages of a command, and how long they will go on.

    Predicted work tells the stages' shares and how units fill the workers; time comes from finished units alone. As
    long as there is none of a stage that was announced, there is no estimate. What an earlier run finished counts
    neither as work nor as time.
    """

    clock: Callable[[], float] = time.monotonic
    stages: dict[str, Stage] = field(default_factory=dict)
    begun: float = math.nan

    def __post_init__(self) -> None:
        self.begun = self.clock()

    @property
    def elapsed(self) -> float:
        return self.clock() - self.begun

    def expect(self, work: Work, workers: int) -> None:
        first = next(iter(work), None)
        for name, costs in work.items():
            if costs:
                self.stages[name] = Stage(name, costs=tuple(costs), workers=workers, cold=name == first)
            elif name in self.stages and self.stages[name].begun is None:
                del self.stages[name]

    def begin(self, name: str, reused: int = 0) -> Stage:
        known = self.stages.pop(name, None)
        stage = Stage(name, reused=reused, begun=self.clock())
        if known is not None:
            stage.costs, stage.workers, stage.cold = known.costs, known.workers, known.cold
        # In the order in which they begin, ahead of those that are still to come.
        waiting = {other.name: other for other in self.stages.values() if other.begun is None}
        for other in waiting:
            del self.stages[other]
        self.stages |= {name: stage} | waiting
        return stage

    def update(self, name: str, done: int, total: int) -> Stage:
        stage = self.stages.get(name)
        if stage is None or stage.begun is None or (done < stage.done and stage.finished):
            stage = self.begin(name)
        stage.update(done, total, self.clock())
        return stage

    def left(self) -> float | None:
        """Seconds until all stages are finished; None where there is nothing to go on yet."""
        now, pace = self.clock(), self._pace()
        parts = [stage.left(now, pace) for stage in self.stages.values()]
        known = [part for part in parts if part is not None]
        return sum(known) if known and len(known) == len(parts) else None

    @property
    def current(self) -> Stage | None:
        """The stage that is at work, the last of several."""
        return next((s for s in reversed(self.stages.values()) if s.begun is not None and not s.finished), None)

    @property
    def finished(self) -> bool:
        return bool(self.stages) and all(stage.finished for stage in self.stages.values())

    def _pace(self) -> float | None:
        """Seconds that a predicted second has taken so far."""
        parts = [stage.measured() for stage in self.stages.values() if stage.costs is not None]
        seconds, predicted = (sum(part) for part in zip(*parts, strict=True)) if parts else (0.0, 0.0)
        return seconds / predicted if predicted else None


# ---------------------------------------------------------------- for programs: a log


class Log:
    """One JSON object (RFC 8259) a line, appended and flushed. A disk that fills up costs lines, never the run.

    Raises
    ------
    InputError
        If the file cannot be written.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = path
        self.trouble: str | None = None  # the first, if any
        try:
            self._file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
        except (OSError, ValueError) as error:
            why = error.strerror if isinstance(error, OSError) else error
            raise InputError(f"--json-log {str(path)!r} cannot be written ({why}); give another file") from None
        self._regular = stat.S_ISREG(os.fstat(self._file).st_mode)
        self._broken = self._regular and self._cut_short()

    def _cut_short(self) -> bool:
        """Whether the last line has no end, as a loss of power leaves it."""
        with suppress(OSError), open(self.path, "rb") as file:
            if file.seek(0, os.SEEK_END):
                file.seek(-1, os.SEEK_END)
                return file.read(1) != b"\n"
        return False

    def write(self, event: str, **facts: Any) -> None:
        """Append a line, whole or not at all. Takes no lock: it may be called while another thread is cut off."""
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        text = json.dumps(_valid({"time": now, "event": event, **facts}), allow_nan=False)
        line = b"\n" * self._broken + text.encode() + b"\n"
        try:
            written = os.write(self._file, line)
            if written < len(line):
                self._broken = True
                if self._regular:
                    os.ftruncate(self._file, os.fstat(self._file).st_size - written)
                    self._broken = False
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            self._broken = False
        except OSError as error:
            self.trouble = self.trouble or f"{self.path} cannot be written ({error.strerror or error})"

    def close(self) -> None:
        with suppress(OSError):
            os.close(self._file)


def _valid(value: Any) -> Any:
    """As JSON can hold it: no NaN, no half of a character."""
    match value:
        case None | bool() | int():
            return value
        case float():
            return value if math.isfinite(value) else None
        case Mapping():
            return {str(name): _valid(item) for name, item in value.items()}
        case list() | tuple():
            return [_valid(item) for item in value]
        case _:
            return str(value).encode("utf-8", "backslashreplace").decode()


# ---------------------------------------------------------------- in words


def clock_time(seconds: float) -> str:
    """As m:ss or h:mm:ss.

    Examples
    --------
    >>> clock_time(7.9), clock_time(3725)
    ('0:07', '1:02:05')
    """
    minutes, second = divmod(int(seconds), 60)
    hours, minute = divmod(minutes, 60)
    return f"{hours}:{minute:02}:{second:02}" if hours else f"{minute}:{second:02}"


def about(seconds: float) -> str:
    """Time left, no finer than it is known.

    Examples
    --------
    >>> about(34.6), about(330), about(8000)
    ('35 s', '6 min', '2 h 15 min')
    """
    if seconds < 90:
        return f"{math.ceil(seconds)} s"
    if seconds < 90 * 60:
        return f"{math.ceil(seconds / 60)} min"
    hours, minutes = divmod(5 * math.ceil(seconds / 300), 60)
    return f"{hours} h {minutes:02} min"


def rate_text(rate: float | None) -> str:
    """Units in the shortest time that holds one.

    Examples
    --------
    >>> rate_text(2.51), rate_text(0.2), rate_text(0.001)
    ('2.5/s', '12/min', '3.6/h')
    """
    if rate is None:
        return ""
    seconds, unit = next(((s, unit) for s, unit in ((1, "s"), (60, "min")) if rate * s >= 1), (3600, "h"))
    return f"{rate * seconds:.2g}/{unit}" if rate * seconds < 10 else f"{rate * seconds:.0f}/{unit}"


# ---------------------------------------------------------------- for people, and all together


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
