"""Progress: estimates against runs whose end is known, what a terminal, a pipe and a log get, and how each ends."""

from __future__ import annotations

import importlib.util
import io
import json
import os
import pty
import re
import signal
import subprocess
import sys
import termios
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from heapq import heappop, heappush
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
from distributed import Client
from faults import SETTINGS, make_store, until, words
from rich.console import Console
from typer.testing import CliRunner

import blocksar
from blocksar.cli import commands, endings
from blocksar.errors import InputError, ProcessingError
from blocksar.graph import cluster, recording
from blocksar.progress import NOBODY, Estimate, Listener, Log, Progress, Work, Workers, as_listener, display

GIB = 2**30
HIDDEN, SHOWN = b"\x1b[?25l", b"\x1b[?25h"  # the cursor
needs_bokeh = pytest.mark.skipif(importlib.util.find_spec("bokeh") is None, reason="bokeh is not installed")


class Clock:
    """Time that passes when it is told to."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


# ---------------------------------------------------------------- estimates, against runs whose end is known

WORK: Work = {"recover": [0.5] * 8, "focus": [3.0, 2.0, 4.0, 2.5, 2.5, 3.0], "mosaic": [0.1] * 20, "finish": [1.0]}


def carried_out(
    estimate: Estimate,
    work: Work,
    workers: int,
    pace: dict[str, float],
    *,
    cold: float = 0.0,
    reused: dict[str, int] | None = None,
) -> list[tuple[str, int, float, float | None]]:
    """Simulate a run to its end: stage, units done, time and time left told, whenever a unit is finished.

    `cold`: seconds that every worker needs before its first unit. The run takes its units as a cluster does.
    """
    clock = estimate.clock
    assert isinstance(clock, Clock)
    told = []
    ready = [cold] * workers
    for stage, costs in work.items():
        done = (reused or {}).get(stage, 0)
        estimate.begin(stage, done)
        estimate.update(stage, done, len(costs))
        ends: list[float] = []
        free = sorted(clock.now + delay for delay in ready)
        ready = [0.0] * workers
        for cost in costs[done:]:
            end = heappop(free) + pace[stage] * cost
            heappush(free, end)
            ends.append(end)
        for end in sorted(ends):
            clock.now = end
            done += 1
            estimate.update(stage, done, len(costs))
            told.append((stage, done, clock.now, estimate.left()))
    return told


@pytest.mark.parametrize("workers", [1, 2, 3])
@pytest.mark.parametrize("cold", [0.0, 7.0])
def test_a_run_at_one_pace_is_known_to_its_end_once_the_workers_are_warm(workers: int, cold: float) -> None:
    estimate = Estimate(Clock())
    estimate.expect(WORK, workers)
    assert estimate.left() is None
    told = carried_out(estimate, WORK, workers, dict.fromkeys(WORK, 2.5), cold=cold)
    end = told[-1][2]
    assert [left for *_, left in told[:workers]] == [None] * workers
    for _, _, now, left in told[workers:]:
        assert left == pytest.approx(end - now, abs=1e-6)


def test_a_stage_that_is_slower_than_the_others_is_followed() -> None:
    estimate = Estimate(Clock())
    estimate.expect(WORK, 2)
    told = carried_out(estimate, WORK, 2, dict.fromkeys(WORK, 1.0) | {"focus": 3.0})
    end = told[-1][2]
    begun = told[0][2]
    for stage, done, now, left in told:
        if (stage, done) >= ("focus", 2) and stage != "recover":
            assert left is not None
            assert abs(left - (end - now)) < 0.2 * (end - begun), (stage, done)


def test_what_an_earlier_run_finished_is_neither_work_nor_time() -> None:
    estimate = Estimate(Clock())
    estimate.expect(WORK, 1)
    told = carried_out(estimate, WORK, 1, dict.fromkeys(WORK, 2.0), reused={"recover": 8, "focus": 4})
    end = told[-1][2]
    assert [stage for stage, *_ in told[:2]] == ["focus", "focus"]  # of six, four were there
    for _, _, now, left in told:
        assert left == pytest.approx(end - now, abs=1e-6)
    recover, focus = estimate.stages["recover"], estimate.stages["focus"]
    assert (recover.rate(), recover.finished) == (None, True)
    assert focus.rate() == pytest.approx(2 / (2.0 * (2.5 + 3.0)))


def test_a_first_stage_that_ends_before_workers_are_warm_is_no_measure() -> None:
    """One unit of recovery, in a small run: its time is that of loading the code."""
    work = WORK | {"recover": [0.1]}
    estimate = Estimate(Clock())
    estimate.expect(work, 1)
    told = carried_out(estimate, work, 1, dict.fromkeys(work, 1.0), cold=2.0)
    end = told[-1][2]
    assert told[0][:1] + told[0][3:] == ("recover", None)
    for _, _, now, left in told[1:]:
        assert left == pytest.approx(end - now, abs=1e-6)


def test_a_unit_that_is_overdue_makes_time_left_grow() -> None:
    clock = Clock()
    estimate = Estimate(clock)
    estimate.expect({"focus": [1.0] * 4}, 1)
    estimate.begin("focus")
    estimate.update("focus", 0, 4)
    for done in (1, 2):
        clock.now += 1.0
        estimate.update("focus", done, 4)
    assert estimate.left() == pytest.approx(2.0)
    clock.now += 0.5
    assert estimate.left() == pytest.approx(1.5)
    clock.now += 9.5  # of the third unit, which is late by nine times its length
    left = estimate.left()
    assert left is not None and left > 4.0  # the fourth will take long as well, by all that is known
    clock.now += 10.0
    assert (estimate.left() or 0.0) > left


def test_a_stage_that_nobody_announced_counts_by_itself() -> None:
    clock = Clock()
    estimate = Estimate(clock)
    estimate.begin("export")
    assert estimate.left() is None
    clock.now += 6.0
    estimate.update("export", 3, 10)
    assert estimate.left() == pytest.approx(14.0)
    assert estimate.stages["export"].rate() == pytest.approx(0.5)
    estimate.update("export", 10, 10)
    assert estimate.left() == 0.0


def test_other_units_than_announced_share_the_work() -> None:
    clock = Clock()
    estimate = Estimate(clock)
    estimate.expect({"recover": [1.0] * 4, "mosaic": [1.0, 2.0, 3.0]}, 2)
    for done in (0, 2, 4):
        estimate.update("recover", done, 4)
        clock.now += 2.0 if done < 4 else 0.0
    estimate.update("mosaic", 0, 11)
    assert estimate.left() == pytest.approx(12.0 / 11 * 6)  # by two workers, in six rounds


def test_stages_that_do_not_come_after_all_are_forgotten() -> None:
    estimate = Estimate(Clock())
    estimate.expect({"focus": [1.0], "draw": [1.0]}, 1)
    estimate.expect({"focus": ()}, 1)
    assert list(estimate.stages) == ["draw"]


def test_stages_stand_in_the_order_of_their_beginning() -> None:
    estimate = Estimate(Clock())
    estimate.expect({"recover": [1.0], "focus": [1.0]}, 1)
    for stage in ("start-workers", "recover", "check-focus"):
        estimate.begin(stage)
    assert list(estimate.stages) == ["start-workers", "recover", "check-focus", "focus"]


# ---------------------------------------------------------------- who is told what


class Plain:
    """What a script may give as progress."""

    def __init__(self) -> None:
        self.told: list[tuple[str, int, int]] = []

    def update(self, stage: str, done: int, total: int) -> None:
        self.told.append((stage, done, total))


def test_an_object_with_update_alone_will_do() -> None:
    plain = Plain()
    told = as_listener(plain)
    told.expect(WORK, 1)
    told.begin("focus", reused=1)
    told.update("focus", 1, 3)
    told.watch(["block-1"], NOBODY)
    told.dashboard("http://127.0.0.1:8787/status")
    told.note("a note")
    assert plain.told == [("focus", 1, 3)]
    assert isinstance(as_listener(None), Listener)
    assert as_listener(told) is told


# ---------------------------------------------------------------- what is shown


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def under_way(clock: Clock, **options: Any) -> Progress:
    """Progress of a run in the middle of its blocks, in work of sixty workers."""
    told = Progress(clock=clock, **options)
    told.update("plan", 0, 1)
    told.update("plan", 1, 1)
    told.expect({"recover": [1.0] * 4, "focus": [100.0] * 120, "mosaic": [1.0] * 3, "finish": [1.0]}, 60)
    told.begin("recover", 4)
    told.update("recover", 4, 4)
    told.begin("focus")
    told.update("focus", 0, 120)
    clock.now += 4000.0
    told.update("focus", 60, 120)
    told.watch([f"block-{n}" for n in range(60, 120)], Workers(60, 3 * GIB // 2, 4 * GIB))
    return told


def lines_of(told: Progress, width: int, height: int = 40) -> list[str]:
    screen = io.StringIO()
    Console(file=screen, width=width, force_terminal=True, no_color=True).print(told.frame(width, height))
    return [re.sub(r"\x1b\[[0-9;]*m", "", line).rstrip() for line in screen.getvalue().splitlines()]


@pytest.mark.parametrize("width", [120, 80, 60, 42, 30])
def test_a_frame_fits_the_terminal(width: int) -> None:
    lines = lines_of(under_way(Clock()), width)
    assert max(map(len, lines)) <= width
    assert [line.split()[0] for line in lines[:5]] == ["plan", "recover", "focus", "mosaic", "finish"]
    assert "60/120" in lines[2] and lines[2].endswith("1:06:40")
    assert ("54/h" in lines[2]) == (width >= display.RATE_NEEDS)
    assert ("━" in lines[2]) == (width >= display.BAR_NEEDS)
    assert lines[5] == "1:06:40 elapsed, about 68 min left"[:width].rstrip()  # another round, and a fiftieth
    assert lines[6].startswith("60 workers, the fullest holds 1.5 of 4.0 GiB"[:width].rstrip())
    assert lines[7].startswith("at work: block-60") and "more" in lines[7]
    assert len(lines) == 8


def test_a_low_terminal_keeps_what_matters() -> None:
    lines = lines_of(under_way(Clock()), 80, height=6)
    assert [line.split()[0] for line in lines] == ["focus", "mosaic", "1:06:40", "60", "at"]


def test_nothing_on_the_terminal_is_taken_for_markup(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    monkeypatch.setenv("TERM", "xterm")
    with Progress() as told:
        told.update("focus [block 1]", 1, 4)
        told.note("half [red] done")
    assert "focus [block 1]" in screen.getvalue() and "half [red] done" in screen.getvalue()
    assert screen.getvalue().encode().rfind(SHOWN) > screen.getvalue().encode().rfind(HIDDEN) >= 0


def test_a_dumb_terminal_gets_plain_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    monkeypatch.setenv("TERM", "dumb")
    with under_way(Clock()) as told:
        told.update("focus", 120, 120)
    assert "focus: 120 of 120" in screen.getvalue() and "\x1b" not in screen.getvalue()


def test_plain_lines(capsys: pytest.CaptureFixture[str]) -> None:
    clock = Clock()
    with under_way(clock) as told:
        told.dashboard("http://127.0.0.1:8787/status")
        told.note("said with the result", again=True)
        told.note("one pulse is missing")
        for done in range(61, 121):
            clock.now += 60.0
            told.update("focus", done, 120)
    lines = capsys.readouterr().err.splitlines()
    assert lines[:6] == [
        "plan: 1 of 1, 0:00 elapsed",
        "recover: 4 of 4, 0:00 elapsed",
        "focus: 0 of 120, 0:00 elapsed",
        "focus: 60 of 120, 1:06:40 elapsed, about 68 min left",
        "dashboard: http://127.0.0.1:8787/status",
        "note: one pulse is missing",
    ]
    assert len(lines) == 11
    assert lines[-1] == "focus: 120 of 120, 2:06:40 elapsed, about 76 s left"


def test_quiet_is_quiet(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    for screen in (sys.stderr, Terminal()):
        monkeypatch.setattr(sys, "stderr", screen)
        with under_way(Clock(), quiet=True) as told:
            told.dashboard("http://127.0.0.1:8787/status")
            told.note("a note")
    assert screen.getvalue() == ""  # type: ignore[attr-defined]
    assert capsys.readouterr().err == ""


# ---------------------------------------------------------------- the log


def strictly(text: str) -> list[dict[str, Any]]:
    """Lines of JSON, every one of them whole; NaN and Infinity are not JSON."""

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is no JSON")

    assert text.endswith("\n")
    return [json.loads(line, parse_constant=refuse) for line in text.splitlines()]


def test_the_log_of_a_run(tmp_path: Path) -> None:
    file, clock = tmp_path / "log.jsonl", Clock()
    with under_way(clock, quiet=True, log=file) as told:
        told.start("focus", {"out": "run\udcff", "grid": ((0.0, float("nan")),), "path": tmp_path}, "1.0")
        told.dashboard("http://127.0.0.1:8787/status")
        told.note("one pulse is missing", again=True)
        clock.now += 11.0
        told.watch(["block-60"], Workers(1, GIB, 0))  # nothing has been heard of for long
        for done in range(61, 121):
            clock.now += 0.1
            told.update("focus", done, 120)
        told.end(1, "out of luck")
    log = strictly(file.read_text())
    assert all(re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}\+00:00", line["time"]) for line in log)
    by_event: dict[str, list[dict[str, Any]]] = {}
    for line in log:
        by_event.setdefault(line["event"], []).append(line)
    assert set(by_event) == {"start", "dashboard", "note", "stage", "progress", "end"}
    assert by_event["start"][0]["settings"] == {"out": "run\\udcff", "grid": [[0.0, None]], "path": str(tmp_path)}
    assert [(line["stage"], line["total"], line["reused"]) for line in by_event["stage"]] == [
        ("plan", 1, 0), ("recover", 4, 4), ("focus", 120, 0),
    ]  # fmt: skip
    of_focus = [line for line in by_event["progress"] if line["stage"] == "focus"]
    assert (of_focus[0]["seconds_left"], of_focus[0]["memory"]) == (None, None)
    assert of_focus[1]["rate"] == 0.015 and of_focus[1]["seconds_left"] > 4000
    assert of_focus[2]["done"] == 60
    assert (of_focus[2]["workers"], of_focus[2]["memory"], of_focus[2]["at_work"]) == (1, GIB, ["block-60"])
    assert of_focus[-1]["done"] == of_focus[-1]["total"] == 120
    assert len(of_focus) == 3 + 6  # one a second
    assert log[-1] | {"time": ""} == {
        "time": "", "event": "end", "status": 1, "message": "out of luck", "seconds": 4017.0,
    }  # fmt: skip


def test_the_log_is_appended_to_and_a_line_without_end_is_ended(tmp_path: Path) -> None:
    file = tmp_path / "log.jsonl"
    file.write_text('{"event": "start"}\n{"event": "st')  # the machine went down
    for number in (1, 2):
        log = Log(file)
        log.write("note", message=number)
        log.close()
    assert [json.loads(line)["event"] for line in file.read_text().splitlines() if not line.endswith("st")] == [
        "start", "note", "note",
    ]  # fmt: skip


@pytest.mark.parametrize("name", ["", "no/such/folder/log", ".", "a\0b"])
def test_a_log_that_cannot_be_written_stops_a_command_before_it_begins(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, api: Fake
) -> None:
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(commands.app, ["focus", "ph.zarr", "--out", "run", "--json-log", name])
    assert done.exit_code == 2 and done.stderr.count("\n") == 1
    assert done.stderr.startswith("blocksar: --json-log") and done.stderr.endswith("give another file\n")
    assert not api.called and not list(tmp_path.iterdir())


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_a_full_disk_costs_lines_and_nothing_else(capsys: pytest.CaptureFixture[str]) -> None:
    with under_way(Clock(), log="/dev/full") as told:
        told.end(0)
    said = [line for line in capsys.readouterr().err.splitlines() if "/dev/full" in line]
    assert said == ["note: /dev/full cannot be written (No space left on device): the run goes on without it"]


def test_no_line_is_written_by_half(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file, write = tmp_path / "log.jsonl", os.write
    log = Log(file)
    log.write("note", message="before")
    with monkeypatch.context() as patch:
        patch.setattr(os, "write", lambda number, data: write(number, data[:20]))
        log.write("note", message="half")
    log.write("note", message="after")
    log.close()
    assert [line["message"] for line in strictly(file.read_text())] == ["before", "after"]
    assert log.trouble is not None


class Fake(ModuleType):
    """Stands for blocksar.api: raises what it is told."""

    error: BaseException | None = None
    called = 0

    def focus(self, *_: Any, progress: Progress, **__: Any) -> Any:
        self.called += 1
        progress.update("recover", 1, 4)
        if self.error is not None:
            raise self.error
        return SimpleNamespace(summary=[], table=list)


@pytest.fixture
def api(monkeypatch: pytest.MonkeyPatch) -> Fake:
    fake = Fake("blocksar.api")
    monkeypatch.setitem(sys.modules, "blocksar.api", fake)
    monkeypatch.setattr(blocksar, "api", fake, raising=False)
    return fake


@pytest.mark.parametrize(
    ("error", "status", "message"),
    [
        (None, 0, ""),
        (ProcessingError("block 2 failed"), 1, "block 2 failed"),
        (OSError(28, "No space left on device"), 1, "[Errno 28] No space left on device"),
        (ZeroDivisionError("ours"), 1, "ZeroDivisionError: ours"),
        (InputError("time is not uniform"), 2, "time is not uniform"),
        (KeyboardInterrupt(), 130, "interrupted; what was finished stays: give the same command again to go on"),
        (endings.Terminated(143), 143, "terminated; what was finished stays: give the same command again to go on"),
    ],
)
def test_the_log_ends_with_the_exit_status(
    error: BaseException | None, status: int, message: str, api: Fake, tmp_path: Path
) -> None:
    api.error = error
    words = ["focus", "ph.zarr", "--out", "run", "--blocks", "3", "--quiet", "--json-log", str(tmp_path / "log")]
    assert CliRunner().invoke(commands.app, words).exit_code == status
    start, *_, end = strictly((tmp_path / "log").read_text())
    assert (start["event"], start["command"], start["version"]) == ("start", "focus", blocksar.__version__)
    assert (start["settings"]["source"], start["settings"]["blocks"]) == ("ph.zarr", "3")
    assert (end["event"], end["status"], end["message"]) == ("end", status, message)


def test_every_command_that_can_be_quiet_can_log() -> None:
    from typer.main import get_command

    def walk(command: Any, path: Sequence[str] = ()) -> Iterator[tuple[Sequence[str], set[str]]]:
        for name, each in getattr(command, "commands", {}).items():
            yield from walk(each, (*path, name))
        if not hasattr(command, "commands"):
            yield path, {parameter.name for parameter in command.params}

    found = dict(walk(get_command(commands.app)))
    assert (
        {path for path, names in found.items() if "quiet" in names}
        == {path for path, names in found.items() if "json_log" in names}
        >= {("demo",), ("simulate",), ("focus",), ("ingest", "cphd"), ("export", "png")}
    )
    assert {path for path, names in found.items() if "performance_report" in names} == {("demo",), ("focus",)}


# ---------------------------------------------------------------- real runs


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_store(tmp_path_factory.mktemp("progress") / "store")


@contextmanager
def in_terminal(*command: str) -> Iterator[tuple[subprocess.Popen[bytes], Callable[[], bytes]]]:
    """A program whose stderr is a terminal of 80 columns, and what it has written there so far, or to its end."""
    ours, theirs = pty.openpty()
    termios.tcsetwinsize(theirs, (24, 80))
    environment = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "NO_COLOR")}
    seen = bytearray()

    def read() -> bytes:
        with suppress(OSError):  # how Linux says that the other end is closed
            while True:
                data = os.read(ours, 65536)
                seen.extend(data)
        return bytes(seen)

    os.set_blocking(ours, False)
    with subprocess.Popen(
        command, stderr=theirs, stdout=subprocess.DEVNULL, env=environment | {"TERM": "xterm"}, start_new_session=True
    ) as process:
        os.close(theirs)
        try:
            yield process, read
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            os.close(ours)


BLOCKSAR = (
    sys.executable, "-c",
    "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # a background job is born deaf to it
    "from blocksar import cli; cli.main()",
)  # fmt: skip


def frames(written: bytes) -> list[list[str]]:
    """What a terminal was shown, frame by frame: rich goes back to a frame's first line by erasing its lines."""
    texts = re.split(r"(?:\r?\x1b\[2K(?:\x1b\[1A)?)+", written.decode())
    plain = [re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", text) for text in texts]
    return [text.replace("\r", "").splitlines() for text in plain if text.strip()]


@needs_bokeh
def test_a_run_in_a_terminal(store: Path, tmp_path: Path) -> None:
    log, page = tmp_path / "log.jsonl", tmp_path / "page.html"
    typed = words(store, tmp_path / "run", "--workers", "1", "--json-log", str(log), "--performance-report", str(page))
    with in_terminal(*BLOCKSAR, *typed) as (process, read):
        until(lambda: (read(), process.poll() is not None)[1], "the run to end")
        written = read()
    assert process.returncode == 0, written.decode()
    assert written.count(HIDDEN) == written.count(SHOWN) == 1 and written.find(HIDDEN) < written.find(SHOWN)
    shown = frames(written)
    assert max(len(line) for frame in shown for line in frame) <= 80
    names = ["plan", "compile", "start-workers", "recover", "focus", "mosaic", "finish"]
    assert [line.split()[0] for line in shown[-1][:7]] == names
    assert re.fullmatch(r"focus +━+ +3/3 .*\d:\d\d *", shown[-1][4])
    assert any("the worker holds 0." in line for frame in shown for line in frame)
    addresses = {line for frame in shown for line in frame if line.startswith("dashboard: ")}
    events = strictly(log.read_text())
    assert addresses == {f"dashboard: {line['address']}" for line in events if line["event"] == "dashboard"}
    assert [line["stage"] for line in events if line["event"] == "stage"] == names
    memory = [line["memory"] for line in events if line.get("memory")]
    assert memory and all(2**20 < each < 2**40 for each in memory)
    assert events[-1]["status"] == 0
    assert "<html" in page.read_text() and [p.name for p in tmp_path.glob(".*")] == []


def test_ctrl_c_leaves_the_terminal_and_the_log_in_order(store: Path, tmp_path: Path) -> None:
    log = tmp_path / "log.jsonl"
    typed = words(store, tmp_path / "run", "--workers", "1", "--json-log", str(log))
    with in_terminal(*BLOCKSAR, *typed) as (process, read):
        until(lambda: (read(), log.exists() and '"stage": "recover"' in log.read_text())[1], "recovery to begin")
        process.send_signal(signal.SIGINT)
        until(lambda: (read(), process.poll() is not None)[1], "the run to end")
        written = read()
    assert process.returncode == 130
    assert written.rfind(SHOWN) > written.rfind(HIDDEN) >= 0
    assert b"blocksar: interrupted" in written[written.rfind(SHOWN) :]
    last = strictly(log.read_text())[-1]
    assert (last["event"], last["status"]) == ("end", 130)


HANGING = """
import sys, time, types
api = types.ModuleType("blocksar.api")
def focus(source, out, progress, **settings):
    progress.update("recover", 1, 4)
    try:
        time.sleep(60)
    finally:
        time.sleep(60)
api.focus = focus
sys.modules["blocksar.api"] = api
from blocksar import cli
cli.GRACE = 0.2
cli.main()
"""


def test_a_run_that_does_not_end_in_good_order_gives_the_terminal_back(tmp_path: Path) -> None:
    log = tmp_path / "log.jsonl"
    typed = ("focus", "ph.zarr", "--out", "run", "--json-log", str(log))
    with in_terminal(sys.executable, "-c", HANGING, *typed) as (process, read):
        until(lambda: log.exists() and "recover" in log.read_text(), "the run to begin")
        process.send_signal(signal.SIGTERM)
        until(lambda: (read(), process.poll() is not None)[1], "the run to end")
        written = read()
    assert process.returncode == 143
    assert written.rfind(SHOWN) > written.rfind(HIDDEN) >= 0
    last = strictly(log.read_text())[-1]
    assert (last["event"], last["status"]) == ("end", 143)


class Heard(Listener):
    """Keeps what it is told; fails a run when a block is finished."""

    def __init__(self, *, fail: bool) -> None:
        self.fail = fail
        self.work: Work = {}
        self.totals: dict[str, int] = {}
        self.begun: dict[str, int] = {}
        self.units: set[str] = set()
        self.memory = 0
        self.notes: list[str] = []

    def expect(self, work: Work, workers: int) -> None:
        assert workers == 1
        self.work = work

    def begin(self, stage: str, reused: int = 0) -> None:
        self.begun[stage] = reused

    def update(self, stage: str, done: int, total: int) -> None:
        self.totals[stage] = total
        if self.fail and (stage, done) == ("focus", 1):
            raise ProcessingError("out of luck")

    def watch(self, units: Sequence[str], workers: Workers) -> None:
        self.units |= set(units)
        self.memory = max(self.memory, workers.memory)

    def note(self, text: str, *, again: bool = False) -> None:
        self.notes.append(text)


@pytest.fixture(scope="module")
def client() -> Iterator[Client]:
    with cluster.open_client(workers=1, threads=1, memory_limit=2 * GIB) as connected:
        yield connected


@needs_bokeh
def test_what_a_listener_hears_of_a_run_that_fails_and_goes_on(store: Path, client: Client, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    page.write_text("of an earlier run")
    failing = Heard(fail=True)
    settings: dict[str, Any] = {"client": client, "performance_report": page, **SETTINGS}
    with pytest.raises(ProcessingError, match="out of luck"):
        blocksar.focus(store, tmp_path / "run", progress=failing, **settings)
    assert "<html" in page.read_text()
    page.unlink()
    going_on = Heard(fail=False)
    blocksar.focus(store, tmp_path / "run", progress=going_on, **settings)
    assert "<html" in page.read_text() and not going_on.notes
    assert going_on.begun["recover"] == failing.totals["recover"] == 4
    assert 1 <= going_on.begun["focus"] < 3 and going_on.totals["check-recover"] == 4
    # What was predicted is what was done, unit by unit.
    assert {stage: len(costs) for stage, costs in going_on.work.items()} == {
        stage: going_on.totals[stage] for stage in ("recover", "focus", "mosaic", "finish")
    }
    assert all(cost > 0 for costs in going_on.work.values() for cost in costs)
    assert {"block-0", "block-1", "block-2"} <= failing.units | going_on.units
    assert 2**20 < going_on.memory < 2 * GIB
    again = Heard(fail=False)
    blocksar.focus(store, tmp_path / "run", progress=again, **settings)
    assert again.notes == [f"nothing was done, so there is no performance report at {page}"]


@pytest.mark.parametrize(
    ("processor", "more", "stages"),
    [
        ("angular-division", {"blocks": 3, "coefficients": "closed-form"}, ["recover", "focus", "mosaic"]),
        ("backprojection", {}, ["inspect", "backprojection"]),
    ],
)
def test_units_of_raw_echo_and_back_projection_are_predicted(
    processor: Any, more: dict[str, Any], stages: list[str], client: Client, tmp_path: Path
) -> None:
    raw = make_store(tmp_path / "raw", raw=True)
    heard = Heard(fail=False)
    grid = ((15900.0, 16300.0, 8.0), (19000.0, 19400.0, 8.0))
    blocksar.focus(raw, tmp_path / "run", progress=heard, processor=processor, client=client, grid=grid, **more)
    stages = ["range-compress", *stages, "finish"]
    assert list(heard.work) == stages
    assert {stage: len(heard.work[stage]) for stage in stages} == {stage: heard.totals[stage] for stage in stages}


def test_without_bokeh_there_is_no_dashboard_and_no_performance_report(
    store: Path, client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "bokeh" else found(name))
    assert recording.dashboard(client) is None
    with pytest.raises(InputError, match=r"bokeh is not installed.*install blocksar\[dashboard\]"):
        blocksar.focus(store, tmp_path / "run", client=client, performance_report=tmp_path / "page.html")
    assert not list(tmp_path.iterdir())


@needs_bokeh
@pytest.mark.parametrize("name", [".", "no/such/folder/page.html"])
def test_a_performance_report_that_cannot_be_written_is_refused_first(
    name: str, store: Path, client: Client, tmp_path: Path
) -> None:
    address = recording.dashboard(client)
    assert address is not None and address.startswith("http://127.0.0.1:")
    for call in (
        lambda: blocksar.focus(store, tmp_path / "run", client=client, performance_report=tmp_path / name),
        lambda: blocksar.api.demo(tmp_path / "run", performance_report=tmp_path / name),
    ):
        with pytest.raises(InputError, match=r"cannot be written.*give another file"):
            call()
    assert not list(tmp_path.iterdir())
