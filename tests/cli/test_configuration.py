"""`--config`, `--print-config` and `--dry-run`."""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import typer
from typer.testing import CliRunner, Result

import blocksar
from blocksar.application.jobs import Request
from blocksar.application.rehearsing import RoomBeside, rehearse
from blocksar.application.settings import Settings
from blocksar.cli import commands
from blocksar.cli.plan_and_focus import NOT_CONFIGURED
from blocksar.collection.grid import Grid
from blocksar.graph.machine import resources
from blocksar.places import place
from blocksar.runs.record import FINISHED, RunRecord

EVERY = """
terrain = "dem.tif"
surface = "ellipsoid"
vertical = "egm96"
ground-height = 30.0
looks = 3
autofocus = true
control = "points.json"
source = "ph.zarr"
out = "run"
processor = "high-order-phase"
device = "auto"
blocks = 5
fidelity = 0.9995
weighting = "hann"
weighting_range = "taylor:4:-35"
weighting-azimuth = "kaiser:2.5"
grid = "-10:10:0.5,100:200:1"
workers = 3
threads = 2
memory-limit = "2GiB"
scheduler = "tcp://a:1"
wait-workers = 5.0
whole-pulses = true
interference = "eigen"
performance-report = "report.html"
overwrite = true
discard = true
pyramid = true
quiet = true
json-log = "log.jsonl"
coefficients = "closed-form"
perturbation = "none"
keystone = false
derotation = "linear"
range-model = "conventional"
"""


def as_words(text: str) -> list[str]:
    """The options of such a file as they stand on the command line."""
    given = {key.replace("_", "-"): value for key, value in tomllib.loads(text).items()}
    words = ["focus", given.pop("source")]
    for key, value in given.items():
        words += [f"--{'' if value else 'no-'}{key}"] if isinstance(value, bool) else [f"--{key}", str(value)]
    return words


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[tuple[tuple[Any, ...], dict[str, Any]]]:
    """The calls of `blocksar.api`, whose functions do nothing; the working directory is a fresh one."""
    calls: list[tuple[tuple[Any, ...], dict[str, Any]]] = []

    def record(*words: Any, **settings: Any) -> Any:
        settings.pop("progress", None)
        calls.append((words, settings))
        return SimpleNamespace(details=[], definitions=(), summary=[], table=list, refusal=None, measurable=True)

    api = ModuleType("blocksar.api")
    api.focus = api.plan = record  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "blocksar.api", api)
    monkeypatch.setattr(blocksar, "api", api, raising=False)
    monkeypatch.chdir(tmp_path)
    return calls


def run(*words: str) -> Result:
    return CliRunner().invoke(commands.app, words, prog_name="blocksar")


def test_a_file_gives_every_option_of_focus(seen: Any) -> None:
    Path("all.toml").write_text(EVERY)
    assert run("focus", "--config", "all.toml").exit_code == 0
    assert run(*as_words(EVERY)).exit_code == 0
    assert seen[0] == seen[1]
    options = {parameter.name for parameter in typer.main.get_command(commands.app).commands["focus"].params}  # type: ignore[attr-defined]
    assert {key.replace("-", "_") for key in tomllib.loads(EVERY)} == options - set(NOT_CONFIGURED)


def test_the_command_line_wins_over_the_file_and_the_file_over_defaults(seen: Any) -> None:
    Path("some.toml").write_text('blocks = 5\nkeystone = false\nweighting = "hann"\n')
    words = ["focus", "ph.zarr", "--out", "run", "--blocks", "7", "--keystone", "--config", "some.toml"]
    assert run(*words).exit_code == 0
    settings = seen[0][1]
    assert (settings["blocks"], settings["keystone"]) == (7, True)  # of the command line
    assert (settings["weighting"], settings["fidelity"]) == ("hann", 0.999)  # of the file; the default


def test_plan_takes_its_options_from_the_file_of_a_run(seen: Any) -> None:
    Path("all.toml").write_text(EVERY)
    done = run("plan", "table1", "--config", "all.toml", "--workers", "1")
    assert done.exit_code == 0
    assert seen[0][0] == ("table1",) and (seen[0][1]["blocks"], seen[0][1]["workers"]) == (5, 1)


@pytest.mark.parametrize("text", [EVERY, 'source = "a \\"b\\".zarr"\nout = "run"\n'])
def test_the_printed_configuration_is_read_back(text: str, seen: Any) -> None:
    Path("first.toml").write_text(text)
    printed = run("focus", "--config", "first.toml", "--print-config")
    assert (printed.exit_code, seen) == (0, [])
    Path("second.toml").write_text(printed.stdout)
    again = run("focus", "--config", "second.toml", "--print-config")
    assert again.stdout == printed.stdout
    assert run("focus", "--config", "first.toml").exit_code == run("focus", "--config", "second.toml").exit_code == 0
    assert seen[0] == seen[1]


# ---------------------------------------------------------------- what would be done


def test_a_dry_run_says_what_would_be_done_and_writes_nothing(table1: Path, tmp_path: Path) -> None:
    before = sorted(table1.parent.rglob("*"))
    done = run("focus", str(table1), "--out", str(tmp_path / "run"), "--blocks", "3", "--workers", "1", "--dry-run")
    assert done.exit_code == 0, done.output
    assert "predicted coherence" in done.stdout and "with 1 worker: " in done.stdout
    assert f"would write {tmp_path}/run: about" in done.stdout and "free" in done.stdout
    assert list(tmp_path.iterdir()) == [] and sorted(table1.parent.rglob("*")) == before
    assert done.stderr.splitlines()[-1] == (
        f"next: blocksar focus {table1} --out {tmp_path}/run --blocks 3 --workers 1"
    )


def test_a_dry_run_of_back_projection_names_memory_and_disk(table1: Path, tmp_path: Path) -> None:
    grid = ((16000.0, 16256.0, 1.0), (19000.0, 19256.0, 1.0))
    report = blocksar.focus(table1, tmp_path / "run", processor="backprojection", grid=grid, dry_run=True)
    assert "about 0.6 MiB" in report.summary[-2] and report.tables == []  # 256 x 256 pixels of 8 bytes, and the plan
    assert not (tmp_path / "run").exists()


def test_a_finished_run_needs_nothing() -> None:
    request: Any = SimpleNamespace(folder=place("run"))
    report = rehearse(request, RunRecord(status=FINISHED), resources(1, 1, None), RoomBeside())
    assert report.summary[0].endswith("nothing would be done") and report.result is None


def test_a_request_that_replaces_a_run_says_so(table1: Path, tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text("{}")
    grid = Grid(16000, 16032, 1, 19000, 19032, 1)
    request = Request.open(table1, place(tmp_path), Settings(processor="backprojection", grid=grid, overwrite=True))
    report = rehearse(request, None, resources(1, 1, None), RoomBeside())
    assert f"would replace what is in {tmp_path}" in report.summary[-2]
