"""A package of its own that adds parts to blocksar, put on disk as an installer leaves it."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

NAME = "blocksar_extension"
PARTS: Mapping[str, Mapping[str, str]] = {
    "blocksar.processors": {"polar-format": f"{NAME}.processor:POLAR_FORMAT"},
    "blocksar.products": {"kml": f"{NAME}.product:KML"},
    "blocksar.readers": {"madeup": f"{NAME}.reader:MADEUP"},
}

COMMANDS = """
import json, sys
from typer.testing import CliRunner
from blocksar.cli import commands
done = [CliRunner().invoke(commands.app, words, prog_name="blocksar") for words in json.loads(sys.argv[1])]
print(json.dumps([(each.exit_code, each.stdout, each.stderr) for each in done]))
"""


class Ended(NamedTuple):
    """What a command left."""

    returncode: int
    stdout: str
    stderr: str


def run_commands(environment: Mapping[str, str], *each: Sequence[str]) -> list[Ended]:
    """Run commands of blocksar, each given by its words, in one process of their own."""
    words = [sys.executable, "-c", COMMANDS, json.dumps(each)]
    run = subprocess.run(words, env=environment, capture_output=True, text=True, check=True)
    return [Ended(*ended) for ended in json.loads(run.stdout)]


def install(folder: Path, parts: Mapping[str, Mapping[str, str]] = PARTS) -> dict[str, str]:
    """Install the package into a folder, with "module:attribute" of its parts by group and name.

    Returns the environment of a process that finds it.
    """
    shutil.copytree(Path(__file__).parent / NAME, folder / NAME)
    told = folder / f"{NAME}-1.0.dist-info"
    told.mkdir()
    (told / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {NAME}\nVersion: 1.0\n")
    lines = [line for group in parts for line in (f"[{group}]", *(f"{a} = {b}" for a, b in parts[group].items()))]
    (told / "entry_points.txt").write_text("\n".join(lines))
    return os.environ | {"PYTHONPATH": str(folder), "COLUMNS": "120"}
