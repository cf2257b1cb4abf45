"""Listeners of commands: a live display on a terminal, plain lines elsewhere, bars in a notebook, and the log."""

from __future__ import annotations

import errno
import importlib
import json
import math
import os
import stat
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from html import escape
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal, Self

from blocksar.constants import GIB
from blocksar.errors import InputError
from blocksar.progress.estimate import Estimate, TimedStage, clock_time, rate_text
from blocksar.progress.listening import NOBODY, Listener, Updated, UpdateListener, Work, Workers
from blocksar.texts import time_text

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderableType
    from rich.live import Live

METADATA = ("zarr.json", ".zgroup", ".zarray")  # one of which each folder of a zarr store has


class Log:
    """Appends JSON objects (RFC 8259) to a file, one per line. A full disk costs lines, but does not stop the run.

    Raises
    ------
    InputError
        If the file cannot be written, or holds something else than a log.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = path
        self.trouble: str | None = None  # the first failure to write, if any
        if (store := _store_about(path)) is not None:
            raise InputError(f"--json-log {str(path)!r} lies in the store {str(store)!r}; give a file outside it")
        try:
            self._file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
        except (OSError, ValueError) as error:
            why = error.strerror if isinstance(error, OSError) else error
            raise InputError(f"--json-log {str(path)!r} cannot be written ({why}); give another file") from None
        self._regular = stat.S_ISREG(os.fstat(self._file).st_mode)
        if self._regular and not self._is_log():
            os.close(self._file)
            raise InputError(f"--json-log {str(path)!r} holds something else than a log; give another file")
        self._broken = self._regular and self._cut_short()

    def _is_log(self) -> bool:
        """Tell whether the file is empty or begins as JSON objects do: lines would spoil a scene or a picture."""
        with suppress(OSError), open(self.path, "rb") as file:
            return file.read(2) in (b"", b"{", b'{"')
        return True

    def _cut_short(self) -> bool:
        """Tell whether the last line is incomplete, as after a loss of power."""
        with suppress(OSError), open(self.path, "rb") as file:
            if file.seek(0, os.SEEK_END):
                file.seek(-1, os.SEEK_END)
                return file.read(1) != b"\n"
        return False

    def write(self, event: str, **facts: Any) -> None:
        """Append a line, whole or not at all. It takes no lock: other threads may have been stopped."""
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


def _store_about(path: str | Path) -> Path | None:
    """Return the zarr store that contains a path, if any: a log among its chunks would damage the store."""
    with suppress(OSError, ValueError):
        folders = Path(os.path.realpath(path)).parents
        return next((each for each in folders if any((each / name).exists() for name in METADATA)), None)
    return None


def _valid(value: Any) -> Any:
    """Convert a value to one that JSON can hold: no NaN, no incomplete characters."""
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


PLAIN_SECONDS = 60.0  # between lines of a stage without a terminal, which else has one, at its end
FRAMES = 4  # per second, of the live display
LOG_SECONDS = 1.0  # least time between two progress lines of a stage in the log, except its first and last
LOG_SILENCE = 10.0  # s, approximately: longest time without a progress line while workers report
MOST_NAMES = 8  # names of units in a line of the log
BAR_COLUMNS = 36  # largest width of a bar in the live display
BAR_NEEDS = 40  # columns of a terminal from which bars are shown
RATE_NEEDS = 56  # columns of a terminal from which rates are shown

_ACTIVE: list[Progress] = []  # displays that `abandon` must end


class Progress(Listener):
    """Shows the progress of a command on stderr, and writes it to a log. Any thread may call its methods.

    Parameters
    ----------
    quiet : bool
        Show nothing; the log is still written.
    log : path, optional
        File to which JSON lines are appended.
    clock : callable
        Returns the time, s.

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
        self._printed: dict[str, float] = {}  # when a line of a stage was printed, or it began; inf: ended
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
        _ACTIVE.append(self)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._over = True
        if self._live is not None:
            self._live.stop()
        _ACTIVE.remove(self)
        if self._log is not None:
            self._log.close()

    def start(self, command: str, settings: Mapping[str, Any], version: str) -> None:
        """Log the command with its settings, and the version of the package."""
        self._write_log("start", command=command, settings=settings, version=version)

    def end(self, status: int, message: str = "") -> None:
        """Log the end of the command: its exit status, and the error message."""
        self._write_log("end", status=status, message=message, seconds=round(self.estimate.elapsed, 3))

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
            current = self.estimate.update(stage, done, total)
            left = self.estimate.left()
            self._log_stage(current, left)
            if self._live is None and not self._quiet:
                self._print_stage(current, left)

    def watch(self, units: Sequence[str], workers: Workers) -> None:
        with self._lock:
            self._units, self._workers = units, workers
            current = self.estimate.current
            if current is not None and self.estimate.clock() - self._logged.get(current.name, math.inf) > LOG_SILENCE:
                self._log_progress(current, self.estimate.left())

    def dashboard(self, address: str) -> None:
        self._write_log("dashboard", address=address)
        self._print_line(f"dashboard: {address}")

    def note(self, text: str, *, again: bool = False) -> None:
        self._write_log("note", message=text)
        if not again:
            self._print_line(f"note: {text}")

    def _print_line(self, line: str) -> None:
        if self._live is not None:
            self._live.console.print(line, markup=False, highlight=False, soft_wrap=True)
        elif not self._quiet:
            with suppress(OSError):  # a full disk, or a pipe that nobody reads: the command goes on
                print(line, file=sys.stderr, flush=True)

    def _print_stage(self, stage: TimedStage, left: float | None) -> None:
        """Print a plain line at the stage's end, and each minute of one that lasts; its times are of all stages.

        A stage that has ended before, and ends again at once, as where all loops are compiled, is not said again.
        """
        now, ends = self.estimate.clock(), stage.done >= stage.total
        last = self._printed.setdefault(stage.name, now)
        ended = last == math.inf
        least = PLAIN_SECONDS if not ends else LOG_SECONDS if ended else 0.0
        if (stage.seconds(now) if ended else now - last) < least:
            return
        self._printed[stage.name] = math.inf if ends else now
        remaining = f", about {time_text(left)} left" if left else ""
        count = "done" if stage.total == 1 else f"{stage.done} of {stage.total}"
        self._print_line(f"{stage.name}: {count}; in all {clock_time(self.estimate.elapsed)} elapsed{remaining}")

    def _log_stage(self, stage: TimedStage, left: float | None) -> None:
        now, last = self.estimate.clock(), self._logged.get(stage.name)
        if last is None:
            self._write_log("stage", stage=stage.name, total=stage.total, reused=stage.reused)
        if last is None or stage.finished or now - last >= LOG_SECONDS:
            self._log_progress(stage, left)

    def _log_progress(self, stage: TimedStage, left: float | None) -> None:
        self._logged[stage.name] = self.estimate.clock()
        workers = self._workers
        self._write_log(
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

    def _write_log(self, event: str, **fields: Any) -> None:
        if self._log is None:
            return
        intact = self._log.trouble is None
        self._log.write(event, **fields)
        if intact and self._log.trouble is not None:
            self._print_line(f"note: {self._log.trouble}: the run goes on without it")

    def abandon(self, status: int, message: str) -> None:
        """End log and display of a process that ends at once, without taking locks or waiting."""
        if self._log is not None:
            self._log.write("end", status=status, message=message, seconds=round(self.estimate.elapsed, 3))
        if self._live is not None:
            os.write(2, b"\n\x1b[?25h")  # show the cursor again

    def frame(self, width: int, height: int) -> RenderableType:
        """Draw the live display for a terminal of `width` columns and `height` rows."""
        from rich.console import Group

        with self._lock:
            rows = [_row(stage, self.estimate.clock()) for stage in self.estimate.stages.values()]
            lines = self._lines(width)
        return Group(_table(_visible_rows(rows, height - len(lines) - 1), width), *lines)

    def _lines(self, width: int) -> list[RenderableType]:
        """Return the lines below the table: times, memory, units being processed."""
        from rich.text import Text

        left = self.estimate.left()
        line = Text(f"in all {clock_time(self.estimate.elapsed)} elapsed", no_wrap=True, overflow="crop")
        if self._over:  # a command without stages has nothing to show for it
            return [line] if self.estimate.stages else []
        if left:
            line.append(", ").append(f"about {time_text(left)} left", style="bold")
        lines: list[RenderableType] = [line]
        if self._workers.number:
            lines.append(Text(_memory_text(self._workers), no_wrap=True, overflow="crop", style="dim"))
            if self._units:
                lines.append(Text(_units_text(self._units, width), no_wrap=True, overflow="crop", style="dim"))
        return lines


def abandon(status: int, message: str) -> None:
    """End all logs and restore the terminal, in a process that ends at once."""
    for progress in _ACTIVE:
        with suppress(Exception):
            progress.abandon(status, message)


def _rounded(rate: float | None) -> float | None:
    return None if rate is None else float(f"{rate:.4g}")


def _memory_text(workers: Workers) -> str:
    limit = f" of {workers.limit / GIB:.1f}" if workers.limit else ""
    holder = f"{workers.number} workers, the fullest holds" if workers.number > 1 else "the worker holds"
    return f"{holder} {workers.memory / GIB:.1f}{limit} GiB"


def _units_text(units: Sequence[str], width: int) -> str:
    """Name as many units as fit into the width."""
    for count in range(len(units), 0, -1):
        more = f" and {len(units) - count} more" if count < len(units) else ""
        text = f"at work: {', '.join(units[:count])}{more}"
        if len(text) <= width:
            return text
    return f"at work: {len(units)} unit{'' if len(units) == 1 else 's'}"


class _Frame:
    """The live display, drawn for the terminal's size at that time."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Any:
        yield self._progress.frame(options.max_width, console.height)


@dataclass(frozen=True)
class _Row:
    """A stage as a row of the live display."""

    name: str
    share: float | None  # None: not begun
    count: str
    rate: str
    seconds: str
    style: str


def _visible_rows(rows: list[_Row], room: int) -> list[_Row]:
    """Select as many rows as fit: the earliest finished stages are omitted first, then the last to come."""
    finished = sum(row.share == 1.0 for row in rows)
    dropped = min(max(len(rows) - room, 0), finished)
    return rows[dropped : dropped + max(room, 1)]


def _row(stage: TimedStage, now: float) -> _Row:
    if stage.begun is None:
        return _Row(stage.name, None, "", "", "", "dim")
    count = f"{stage.done}/{stage.total}" if stage.last_finished is not None else ""
    share = (stage.done / stage.total if stage.total else 1.0) if stage.last_finished is not None else 0.0
    rate = rate_text(stage.rate()) if stage.total > 1 else ""
    return _Row(stage.name, share, count, rate, clock_time(stage.seconds(now)), "" if stage.finished else "bold")


def _table(rows: Sequence[_Row], width: int) -> RenderableType:
    from rich.progress_bar import ProgressBar
    from rich.table import Table
    from rich.text import Text

    table = Table.grid(padding=(0, 2, 0, 0))
    visible = [True, width >= BAR_NEEDS, True, width >= RATE_NEEDS, True]
    aligned: list[Any] = ["left", "left", "right", "right", "right"]
    widths = [max((len(cell) for cell in cells), default=0) for cells in _column_texts(rows)]
    for included, justify, least in zip(visible, aligned, widths, strict=True):
        if included:
            table.add_column(justify=justify, no_wrap=True, overflow="crop", min_width=least)
    taken = sum(least + 2 for least, included in zip(widths, visible, strict=True) if included and least)
    bar = max(min(BAR_COLUMNS, width - taken - 2), 4)
    for row in rows:
        cells: list[RenderableType] = [
            Text(row.name, style=row.style),
            "" if row.share is None else ProgressBar(total=1.0, completed=row.share, width=bar),
            Text(row.count),
            Text(row.rate, style="dim"),
            Text(row.seconds),
        ]
        table.add_row(*(cell for cell, included in zip(cells, visible, strict=True) if included))
    return table


def _column_texts(rows: Sequence[_Row]) -> list[list[str]]:
    """Return the texts of each column, and placeholders that keep its width constant as numbers grow."""
    return [
        [row.name for row in rows],
        [],  # bars fill the remaining width
        [*(row.count for row in rows), "000/000"],
        [*(row.rate for row in rows), "000/min"],
        [*(row.seconds for row in rows), "00:00"],
    ]


# ---------------------------------------------------------------- the listener that a caller wants


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
            rows = "".join(_cell_row(stage, now) for stage in self.estimate.stages.values())
            elapsed = clock_time(self.estimate.elapsed)
        notes = "".join(f"<div>note: {escape(text)}</div>" for text in self._notes)
        remaining = f", about {time_text(left)} left" if left else ""
        return f"<table>{rows}</table><div>{elapsed} elapsed{remaining}</div>{notes}"


def _cell_row(stage: TimedStage, now: float) -> str:
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
    """Return a full listener for an object that may only have `update`, for None, and for False.

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
