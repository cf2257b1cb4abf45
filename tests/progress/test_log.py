"""The log of a run, line by line."""

from __future__ import annotations

import json
import os
import re
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
from every_command import every_command
from fake_clock import GIB, Clock, strictly, under_way
from typer.testing import CliRunner

import blocksar
from blocksar.cli import commands, endings
from blocksar.errors import InputError, ProcessingError
from blocksar.progress import Log, Progress, Workers


def test_the_log_of_a_run(tmp_path: Path) -> None:
    file, clock = tmp_path / "log.jsonl", Clock()
    with under_way(clock, quiet=True, log=file) as told:
        told.start("focus", {"out": "run\udcff", "grid": ((0.0, float("nan")),), "path": tmp_path}, "1.0")
        told.dashboard("http://127.0.0.1:8787/status")
        told.note("one pulse is missing", again=True)
        clock.now += 11.0
        told.watch(["block-60"], Workers(1, GIB, 0))  # long after the previous event
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
    assert len(of_focus) == 3 + 6  # one per second
    assert log[-1] | {"time": ""} == {
        "time": "", "event": "end", "status": 1, "message": "out of luck", "seconds": 4017.0,
    }  # fmt: skip


def test_the_log_is_appended_to_after_an_unfinished_line(tmp_path: Path) -> None:
    file = tmp_path / "log.jsonl"
    file.write_text('{"event": "start"}\n{"event": "st')  # as after a crash of the machine
    for number in (1, 2):
        log = Log(file)
        log.write("note", message=number)
        log.close()
    assert [json.loads(line)["event"] for line in file.read_text().splitlines() if not line.endswith("st")] == [
        "start", "note", "note",
    ]  # fmt: skip


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_a_full_disk_loses_log_lines_but_the_run_goes_on(capsys: pytest.CaptureFixture[str]) -> None:
    with under_way(Clock(), log="/dev/full") as told:
        told.end(0)
    said = [line for line in capsys.readouterr().err.splitlines() if "/dev/full" in line]
    assert said == ["note: /dev/full cannot be written (No space left on device): the run goes on without it"]


def test_no_partial_line_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
    """Replace blocksar.api: `focus` raises the error that the test sets."""

    error: BaseException | None = None
    called = 0

    def focus(self, *_: Any, progress: Progress, **__: Any) -> Any:
        self.called += 1
        progress.update("recover", 1, 4)
        if self.error is not None:
            raise self.error
        return SimpleNamespace(summary=[], table=list, measurable=True)


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


def test_long_commands_have_a_log_and_those_of_dask_a_performance_report() -> None:
    options = {names: {parameter.name for parameter in each.params} for names, each in every_command().items()}
    logged = {("demo",), ("simulate",), ("focus",), ("autofocus",), ("ingest", "cphd"), ("export", "png")}
    assert logged <= {names for names, known in options.items() if "json_log" in known}
    assert {names for names, known in options.items() if "performance_report" in known} == {("demo",), ("focus",)}
