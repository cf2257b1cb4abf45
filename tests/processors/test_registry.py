"""Processors of other packages stand beside the own ones: in help, plans, runs, Python and messages."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from extension import PARTS, Ended, install, run_commands
from near_range import SPEED_OF_LIGHT

import blocksar
from blocksar.measurement.coherence import coherence
from blocksar.processors import PROCESSORS

pytestmark = pytest.mark.slow

GRID = "-36:36:0.25,-36:36:0.25"
FINE = "-36:36:0.12,-36:36:0.12"  # several chunks
TARGETS = {(0.0, 0.0): 1.0, (25.0, -18.0): 0.7, (-28.0, 29.0): 1j, (31.0, 31.0): 0.5}
OPTION = "order is 3, but it is an option of polar-format only; leave it out"
BROKEN = {"lost": "blocksar_extension.nowhere:LOST", "clash": "clash:CLASH"}
CLASH = """
from dataclasses import dataclass
from typing import Annotated
from blocksar.options import Option
from blocksar_extension.processor import PolarFormat

@dataclass(frozen=True, kw_only=True)
class Options:
    grid: Annotated[str, Option("Twice.")] = ""

class Clash(PolarFormat):
    options = Options

CLASH = Clash()
"""
# What a session in Python says of runs with keywords, one after the other.
CALLS = """
import json, sys
import blocksar
source, out, *each = json.loads(sys.argv[1])
said = []
for keywords in each:
    try:
        said.append(blocksar.focus(source, out, workers=0, progress=False, **keywords).result["settings"])
    except blocksar.InputError as error:
        said.append(str(error))
print(json.dumps(said))
"""


@pytest.fixture(scope="module")
def spotlight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A spotlight from 8.5 km: 300 pulses of a curved track, targets up to 44 m off the centre."""
    along, fc, n = np.linspace(-150, 150, 300), 10e9, 256
    track = np.stack([-8000 + along**2 / 1e5, along + 300, np.full(along.size, 3000.0)], axis=1)
    frequency = (np.arange(n) - n // 2) * 256e6 / n
    reference = np.linalg.norm(track, axis=1)
    signal = np.zeros((along.size, n), complex)
    for (x, y), value in TARGETS.items():
        rest = np.linalg.norm(track - [x, y, 0], axis=1) - reference
        signal += value * np.exp(-4j * np.pi / SPEED_OF_LIGHT * np.outer(rest, fc + frequency))
    path = tmp_path_factory.mktemp("spotlight") / "spot.zarr"
    collection = blocksar.collection(
        signal=signal, time=(np.arange(along.size) - along.size // 2) / 100, range_frequency=frequency,
        antenna_position=track, reference_range=reference, carrier_frequency=fc,
    )  # fmt: skip
    blocksar.write(collection, path)
    return path


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    return install(tmp_path_factory.mktemp("extension") / "site")


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where `ended` leaves what it writes."""
    return tmp_path_factory.mktemp("finished")


@pytest.fixture(scope="module")
def ended(environment: dict[str, str], spotlight: Path, finished: Path) -> dict[str, Ended]:
    """What commands leave, by a name; all of them in one process."""
    out, settings = finished / "polar", finished / "settings.toml"
    settings.write_text("order = 4\n")
    commands: dict[str, tuple[object, ...]] = {
        "focus --help": ("focus", "--help"),
        "plan --help": ("plan", "--help"),
        "plan": ("plan", spotlight, "--processor", "polar-format", f"--grid={GRID}"),
        "focus": polar(spotlight, out, "--config", settings, "--workers", 0),
        "info": ("info", out),
        "report": ("report", out, "--out", finished / "page.html", "-q"),
        "whole": polar(spotlight, finished / "whole", "--workers", 0, grid=FINE),
        "wrong order": polar(spotlight, finished / "run", "--order", 9),
        "foreign option": ("focus", spotlight, "--out", finished / "run", f"--grid={GRID}", "--order", 3),
        "unknown": ("focus", spotlight, "--out", finished / "run", "--processor", "omega-k"),
    }
    words = [tuple(map(str, each)) for each in commands.values()]
    return dict(zip(commands, run_commands(environment, *words), strict=True))


def calls(environment: dict[str, str], *arguments: object) -> Any:
    words = (sys.executable, "-c", CALLS, json.dumps(arguments))
    return json.loads(subprocess.run(words, env=environment, capture_output=True, text=True, check=True).stdout)


def polar(spotlight: Path, out: Path, *more: object, grid: str = GRID) -> tuple[object, ...]:
    return "focus", spotlight, "--out", out, "--processor", "polar-format", f"--grid={grid}", "-q", *more


def test_it_is_in_help_and_completion(environment: dict[str, str], ended: dict[str, Ended]) -> None:
    for command in ("focus", "plan"):
        shown = " ".join(ended[f"{command} --help"].stdout.replace("│", " ").split())
        assert all(name in shown for name in PROCESSORS.own)
        assert "polar-format: a spotlight by plane waves" in shown
        assert "Options of polar-format" in shown and "--order N Order of the splines that resample, 3 to 5." in shown
    asked = {"_BLOCKSAR_COMPLETE": "complete_bash", "COMP_WORDS": "blocksar focus --processor p", "COMP_CWORD": "3"}
    words = (sys.executable, "-m", "blocksar")
    done = subprocess.run(words, env=environment | asked, capture_output=True, text=True, check=False)
    assert "polar-format" in done.stdout.split()


def test_it_plans_and_forms_an_image(ended: dict[str, Ended], spotlight: Path, finished: Path, tmp_path: Path) -> None:
    planned, out = ended["plan"], finished / "polar"
    assert planned.returncode == 0, planned.stderr
    told = " ".join(planned.stdout.split())
    assert "image of 288 x 288 pixels by polar-format" in told and "peak memory of a worker" in told
    assert "curved waves leave a coherence with exact back-projection of at least 1.0000" in told
    assert "a run takes about" in told

    done = ended["focus"]
    assert done.returncode == 0 and "polar-format" in done.stdout, done.stderr
    record = json.loads((out / "run.json").read_text())
    assert record["settings"]["processor"] == "polar-format" and record["settings"]["order"] == 4
    shown = " ".join(ended["info"].stdout.split())
    assert "processor polar-format" in shown and "order 4" in shown
    assert ended["report"].returncode == 0
    assert "--processor polar-format --order 4" in (finished / "page.html").read_text()  # the command that repeats it

    image = blocksar.open(out)["image"]
    for (x, y), value in TARGETS.items():  # others' side lobes reach 0.003, the interpolation's errors 0.002
        assert abs(complex(image.sel(x=x, y=y, method="nearest")) / value - 1) < 0.006
    blocksar.focus(spotlight, tmp_path / "exact", processor="backprojection", grid=GRID, workers=0)
    exact = blocksar.open(tmp_path / "exact")["image"]
    assert (
        abs(coherence(image.values, exact.values).coherence) > 0.998
    )  # the edges of the two apertures differ by half a sample


def test_what_is_wrong_is_refused_in_a_sentence(
    environment: dict[str, str], ended: dict[str, Ended], spotlight: Path, finished: Path
) -> None:
    out = finished / "run"
    assert not out.exists()

    def said(name: str) -> str:
        assert ended[name].returncode == 2 and ended[name].stderr.count("\n") == 1
        return ended[name].stderr.strip().removeprefix("blocksar: ")

    assert said("wrong order") == "order = 9: give 3, 4 or 5"
    assert said("foreign option") == OPTION
    assert all(name in said("unknown") for name in (*PROCESSORS.own, "polar-format"))
    given = {"processor": "polar-format", "grid": GRID}
    order, near, linear, weighted, far = calls(
        environment, str(spotlight), str(out), given | {"order": 2}, given | {"ordr": 3},
        given | {"derotation": "linear"}, given | {"weighting": "hann"},
        given | {"grid": "-66:66:0.3,-900:900:4"},
    )  # fmt: skip
    assert order == "order = 2: give 3, 4 or 5"
    assert near == "ordr is 3, but processor polar-format has no such option; did you mean order?"
    assert linear.startswith("derotation is 'linear', but it is an option of angular-division, ")
    assert weighted.startswith("polar-format has no terrain, weighting, ")
    assert far.startswith(
        "waves are too curved for polar-format; take a smaller grid or step; hierarchical back-projection has "
    )


def test_a_killed_run_goes_on_to_the_same_bytes(
    environment: dict[str, str], ended: dict[str, Ended], spotlight: Path, finished: Path, tmp_path: Path
) -> None:
    whole, cut = finished / "whole", tmp_path / "cut"
    assert ended["whole"].returncode == 0
    words = [sys.executable, "-m", "blocksar", *map(str, polar(spotlight, cut, "--workers", 0, grid=FINE))]
    with subprocess.Popen(words, env=environment, stderr=subprocess.DEVNULL, start_new_session=True) as process:
        while process.poll() is None and not list((cut / "receipts").rglob("*part-*")):
            time.sleep(0.02)
        assert process.poll() is None, "the run ended before it could be killed"
        os.killpg(process.pid, signal.SIGKILL)
    words[words.index("--workers") + 1] = "1"
    again = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    assert again.returncode == 0, again.stderr
    assert "of polar-format used again" in " ".join(again.stdout.split())
    first, second = (
        {path.relative_to(each): path.read_bytes() for path in (each / "image.zarr").rglob("c/*/*")}
        for each in (whole, cut)
    )
    assert len(first) > 4 and first == second
    record = json.loads((cut / "run.json").read_text())
    assert 0 < record["peak_memory"] <= record["plan"]["memory"], (record["peak_memory"], record["plan"]["memory"])


def test_a_broken_package_breaks_nothing_else(spotlight: Path, tmp_path: Path) -> None:
    group = "blocksar.processors"
    environment = install(tmp_path / "site", {group: PARTS[group] | BROKEN})
    (tmp_path / "site" / "clash.py").write_text(CLASH)
    broken = ("plan", str(spotlight), "--processor", "lost", f"--grid={GRID}")
    shown, tried = run_commands(environment, ("focus", "--help"), broken)
    told = " ".join(shown.stdout.replace("│", " ").split())
    assert (shown.returncode, shown.stderr) == (0, "") and "--order" in told
    assert "processor lost of package blocksar_extension cannot be loaded (ModuleNotFoundError" in told
    assert "clash has an option grid, which is the command's own; repair or remove it" in told
    assert (tried.returncode, tried.stdout, tried.stderr.count("\n")) == (2, "", 1)
    assert tried.stderr.endswith("repair or remove that package\n")
