"""A first day at the terminal: what is judged before loops are compiled, and an environment without threads."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from arrays import arrays
from typer.testing import CliRunner

import blocksar
from blocksar.cli import commands
from blocksar.graph import cluster


@pytest.mark.parametrize("line", ["focus ph.zarr --out new", "focus ph.zarr --out new --grid 9040:9121:3,-40:41:3"])
def test_a_grid_is_judged_before_loops_are_compiled(line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """That takes half a minute on the first day, and says so in a line of its own."""
    monkeypatch.chdir(tmp_path)
    blocksar.write(blocksar.collection(**arrays(steered=False)), "ph.zarr")
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
