"""The most likely mistakes of a first day at the terminal: one good sentence each, exit status 2, nothing written."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import small_run
from scenes import UNSTEERED_SCENE
from typer.testing import CliRunner

import blocksar
from blocksar.cli import commands
from blocksar.graph import cluster

# The command line, and what it answers; the table in blocksar/cli/README.md lists the likeliest.
MISTAKES = {
    "a scene for a phase history": (
        "focus scene.toml --out new",
        "is a scene, not a phase history; write one first: `blocksar simulate scene.toml --out scene.zarr`",
    ),
    "a shipped scene for a phase history": (
        "focus table1 --out new",
        "table1 is a shipped scene, not a phase history; write one first: `blocksar simulate table1 --out table1.zarr`",
    ),
    "an image for a phase history": ("plan run/image.zarr", "is an image of a run, not a phase history"),
    "a link that leads nowhere": ("plan linked.zarr", "is a symbolic link to gone.zarr, which does not exist; correct"),
    "a phase history for targets": ("quality run --targets ph.zarr", "ph.zarr is no regular file; give [{"),
    "a file that is to be ingested": (
        "focus collect.cphd --out new",
        "is a CPHD file; turn it into a phase history first: `blocksar ingest cphd collect.cphd --out collect.zarr`",
    ),
    "a run for a phase history": (
        "check run",
        "is a run, not a phase history; `blocksar info` names the phase history",
    ),
    "a phase history for a run": (
        "quality ph.zarr",
        "ph.zarr is a store, not a run; give the folder that `blocksar focus",
    ),
    "a misspelt run": ("report rnu", "rnu does not exist; give the folder that `blocksar focus --out` left"),
    "a misspelt path": ("plan ph.zar", "ph.zar does not exist; did you mean ph.zarr?"),
    "a path that is too long": (f"plan {'ph' * 200}.zarr", "File name too long"),
    "a log that is the scene": (
        "simulate scene.toml --out new.zarr --json-log scene.toml",
        "--json-log 'scene.toml' holds something else than a log; give another file",
    ),
    "no grid for a beam that is not steered": (
        "focus ph.zarr --out new",
        "grid is missing: a collection whose beam is not",
    ),
    "a grid in kilometres": ("plan ph.zarr --grid 5.8:5.9:0.001,2.1:2.2:0.001", "it looks like km: give metres"),
    "a size without its unit": (
        "focus ph.zarr --out new --memory-limit 2",
        "--memory-limit '2' is 2 bytes; give it with a unit",
    ),
    "a misspelt command": ("fokus ph.zarr --out new", "no such command 'fokus'. Did you mean 'focus'?"),
}


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as it looks after the first hour."""
    folder = tmp_path_factory.mktemp("desk")
    (folder / "scene.toml").write_text(UNSTEERED_SCENE)
    blocksar.simulate(folder / "scene.toml", folder / "ph.zarr")
    small_run.make(folder / "run")
    (folder / "collect.cphd").write_bytes(b"CPHD/1.1.0\n")
    (folder / "linked.zarr").symlink_to("gone.zarr")
    return folder


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_gets_one_sentence_with_its_remedy(mistake: str, desk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    line, sentence = MISTAKES[mistake]
    monkeypatch.chdir(desk)
    before, scene = sorted(desk.rglob("*")), (desk / "scene.toml").read_bytes()
    done = CliRunner().invoke(commands.app, line.split(), prog_name="blocksar")
    assert (done.exit_code, done.stdout, done.stderr.count("\n")) == (2, "", 1), done.output
    assert done.stderr.startswith("blocksar: ") and sentence in done.stderr
    assert sorted(desk.rglob("*")) == before and (desk / "scene.toml").read_bytes() == scene


@pytest.mark.parametrize(
    "line", ["focus ph.zarr --out new", "focus ph.zarr --out new --grid 5.8:5.9:0.001,2.1:2.2:0.001"]
)
def test_a_grid_is_judged_before_loops_are_compiled(line: str, desk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """That takes half a minute on the first day, and says so in a line of its own."""
    monkeypatch.chdir(desk)
    monkeypatch.setattr(cluster, "kernels_cached", lambda _: False)
    monkeypatch.setattr(cluster, "compile_missing", lambda *_: pytest.fail("loops were compiled"))
    done = CliRunner().invoke(commands.app, line.split(), prog_name="blocksar")
    assert (done.exit_code, done.stderr.count("\n")) == (2, 1), done.output


def test_no_threads_in_the_environment(tmp_path: Path) -> None:
    environment = {**os.environ, "NUMBA_NUM_THREADS": "0"}
    ended = subprocess.run(
        [sys.executable, "-m", "blocksar", "demo", "--out", "run"], cwd=tmp_path, env=environment, capture_output=True,
        text=True, check=False,
    )  # fmt: skip
    assert ended.returncode == 2 and ended.stderr.startswith("blocksar: NUMBA_NUM_THREADS = 0 in the environment must")
    assert ended.stderr.count("\n") == 1 and not list(tmp_path.iterdir())
