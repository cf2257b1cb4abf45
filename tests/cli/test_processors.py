"""`plan` and `focus` take the processors of other packages, and their options."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from extension import NAME, install

OMEGA = """
from dataclasses import dataclass
from typing import Annotated

from blocksar.errors import InputError
from blocksar.options import Option


@dataclass(frozen=True, kw_only=True)
class Options:
    taps: Annotated[int, Option("Taps of the interpolation.", metavar="N")] = 8


class Omega:
    name, summary, options = "omega-k", "exact for straight tracks", Options
    universal = compared = on_gpu = False

    def check(self, options):
        raise InputError(f"asked for {options}")

    def plan(self, problem):
        raise NotImplementedError


OMEGA = Omega()
"""


def test_a_processor_of_another_package_is_offered_with_its_options(tmp_path: Path) -> None:
    broken = {"lost": f"{NAME}.nowhere:LOST", "omega-k": f"{NAME}.omega:OMEGA"}
    environment = install(tmp_path / "site", {"blocksar.processors": broken})
    (tmp_path / "site" / NAME / "omega.py").write_text(OMEGA)

    def run(*words: str) -> str:
        command = [sys.executable, "-m", "blocksar", *words]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        return done.stdout + done.stderr

    told = run("focus", "--help")
    assert "--taps" in told and "Taps of the interpolation." in told
    (tmp_path / "run.toml").write_text('processor = "omega-k"\ntaps = 4\n')
    asked = run("plan", "table1", "--config", str(tmp_path / "run.toml"))
    assert asked.endswith("asked for Options(taps=4)\n")
