"""Shell completion, which typer provides, and `-h`."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from every_command import every_command
from typer.testing import CliRunner

from blocksar.cli import commands


def completed(line: str, shell: str = "bash") -> str:
    """What completion offers for a command line."""
    words = line.split(" ")
    environment = {"COMP_WORDS": line, "COMP_CWORD": str(len(words) - 1), "_TYPER_COMPLETE_ARGS": line}
    done = subprocess.run(
        [sys.executable, "-c", "from blocksar.cli import main; main()"], capture_output=True, text=True, check=False,
        env={**os.environ, "_BLOCKSAR_COMPLETE": f"complete_{shell}", **environment},
    )  # fmt: skip
    assert done.stderr == ""
    return done.stdout


@pytest.mark.slow
def test_commands_options_and_values_are_completed() -> None:
    assert completed("blocksar fo").split() == ["focus"]
    assert "--weighting-azimuth" in completed("blocksar focus --weighting-").split()
    assert completed("blocksar export ge").split() == ["geotiff"]
    assert "keystone-resampling" in completed("blocksar focus --processor ").split()


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_script_of_a_shell_is_printed(shell: str) -> None:
    done = CliRunner().invoke(commands.app, [], env={"_BLOCKSAR_COMPLETE": f"source_{shell}"}, prog_name="blocksar")
    assert done.exit_code == 0 and "_BLOCKSAR_COMPLETE=complete_" in done.stdout and "blocksar" in done.stdout


@pytest.mark.parametrize("names", every_command(), ids=" ".join)
def test_every_command_has_help_for_80_columns_and_can_be_quiet(names: tuple[str, ...]) -> None:
    short = CliRunner().invoke(commands.app, [*names, "-h"], prog_name="blocksar", env={"COLUMNS": "80"})
    assert short.exit_code == 0 and f"Usage: blocksar {' '.join(names)} " in short.stdout
    assert "…" not in short.stdout, "a name is cut"
    assert "─ Messages ─" in short.stdout
    options = {option for parameter in every_command()[names].params for option in parameter.opts}
    assert {"-q", "--quiet"} <= options


def test_options_are_named_without_arrays() -> None:
    """Help and completion wait for nothing that they do not need."""
    code = "import sys; from blocksar.cli import app; print({'numpy', 'scipy', 'dask', 'zarr'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
