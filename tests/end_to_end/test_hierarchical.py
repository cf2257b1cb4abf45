"""Runs by hierarchical back-projection: all that an image may have, against exact back-projection of the same input."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bursts import CENTRE, SLANT, STEP, ground, write_bursts
from faults import digests
from scenes import write_store

import blocksar
from blocksar import stores
from blocksar.places import place
from blocksar.progress import Listener
from blocksar.runs.record import RunRecord
from blocksar.simulation.scene import Scene

pytestmark = pytest.mark.usefixtures("unchecked")

HIERARCHICAL, EXACT = "hierarchical-backprojection", "backprojection"
GRID = ((15800.0, 16400.0, 1.0), (18900.0, 19500.0, 1.0))
SMALL = ((16100.0, 16164.0, 1.0), (19200.0, 19264.0, 1.0))
SCENE = """
[noise]
power = 1e-3
seed = 4
[clutter]
scatterers = 4000
seed = 5
power = 1e-2
x = [15800.0, 16400.0]
y = [18900.0, 19500.0]
[terrain]
hills = [{x = 16140.0, y = 19200.0, height = 300.0, width = 700.0}]
"""


def both(source: Any, out: Path, **settings: Any) -> tuple[Any, Any]:
    """The images of both, opened."""
    for name in (HIERARCHICAL, EXACT):
        blocksar.focus(source, out / name, processor=name, workers=0, **settings)
    return blocksar.open(out / HIERARCHICAL), blocksar.open(out / EXACT)


def error(found: Any, exact: Any) -> float:
    """Error power over that of the exact image, dB; both cover the same pixels."""
    a, b = found.image.values, exact.image.values
    covered = np.isfinite(b)
    np.testing.assert_array_equal(np.isfinite(a), covered)
    return float(10 * np.log10((np.abs(a - b)[covered] ** 2).sum() / (np.abs(b[covered]) ** 2).sum()))


@pytest.fixture(scope="module")
def hills(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("hills")
    return write_store(folder, swath=[29500.0, 30500.0], more=SCENE)


@pytest.mark.slow
def test_an_image_on_a_terrain_has_its_layers_and_its_noise(hills: Path, tmp_path: Path) -> None:
    ground = Scene.read(str(hills.parent / "scene.toml")).terrain
    assert ground is not None
    stores.write_terrain(place(tmp_path / "ground.zarr"), ground)
    settings: dict[str, Any] = {"fidelity": 0.99999, "weighting": "taylor:4:-35", "grid": GRID}
    found, exact = both(hills, tmp_path, terrain=tmp_path / "ground.zarr", **settings)
    assert error(found, exact) < -50
    assert set(found.data_vars) == set(exact.data_vars)
    for name in set(found.data_vars) - {"image"}:
        np.testing.assert_array_equal(found[name].values, exact[name].values)
    record = RunRecord.from_json(json.loads((tmp_path / HIERARCHICAL / "run.json").read_text()))
    assert record.plan.least >= 0.99999 and record.peak_memory is not None and record.plan.memory is not None
    assert "predicted coherence with exact back-projection at least 0.99999" in str(
        blocksar.info(tmp_path / HIERARCHICAL)
    )
    page = blocksar.report(tmp_path / HIERARCHICAL).result.path.read_text(encoding="utf-8")
    assert "Predicted coherence with exact back-projection of the same samples: at least 0.99999" in page


@pytest.mark.slow
def test_of_several_collections_each_pixel_is_that_of_the_one_which_saw_it_best(tmp_path: Path) -> None:
    targets = [ground(SLANT, CENTRE + STEP * turn) for turn in (-0.9, -0.5, 0.0, 0.4, 0.8)]
    x, y = ([round(each[k]) for each in targets] for k in (0, 1))
    grid = ((min(x) - 60.0, max(x) + 60.0, 3.0), (min(y) - 60.0, max(y) + 60.0, 3.0))
    found, exact = both(write_bursts(tmp_path, targets), tmp_path, grid=grid)
    assert error(found, exact) < -48  # at the default fidelity as well
    np.testing.assert_array_equal(found.collection.values, exact.collection.values)


class Interrupted(Listener):
    """Ends a run after so many of its parts."""

    def __init__(self, parts: int) -> None:
        self.parts = parts

    def update(self, stage: str, done: int, total: int) -> None:
        if stage == HIERARCHICAL and done == self.parts:
            raise KeyboardInterrupt


def test_an_interrupted_run_goes_on_and_ends_with_the_same_bytes(hills: Path, tmp_path: Path) -> None:
    settings: dict[str, Any] = {"grid": GRID, "processor": HIERARCHICAL, "workers": 0}
    blocksar.focus(hills, tmp_path / "whole", **settings)
    with pytest.raises(KeyboardInterrupt):
        blocksar.focus(hills, tmp_path / "run", **settings, progress=Interrupted(1))
    assert (tmp_path / "run" / "plan.bin").exists()
    report = blocksar.focus(hills, tmp_path / "run", **settings)
    assert any(line.startswith("went on from an unfinished run: ") for line in report.summary)
    assert digests(tmp_path / "run" / "image.zarr") == digests(tmp_path / "whole" / "image.zarr")
    assert not (tmp_path / "run" / "plan.bin").exists()


class Begun(Listener):
    """Ends a run once all samples are read."""

    def update(self, stage: str, done: int, total: int) -> None:
        if stage in ("inspect", "recover") and done == total:
            raise KeyboardInterrupt


@pytest.mark.slow
def test_another_process_goes_on_with_what_auto_has_chosen(hills: Path, tmp_path: Path) -> None:
    """It has not loaded the processor, of whose types the plan in the folder is made."""
    run = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        blocksar.focus(hills, run, grid=SMALL, workers=0, progress=Begun())
    again = f"import blocksar; blocksar.focus({str(hills)!r}, {str(run)!r}, grid={SMALL!r}, workers=0, progress=False)"
    done = subprocess.run([sys.executable, "-c", again], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert RunRecord.from_json(json.loads((run / "run.json").read_text())).finished


def test_the_choice_of_auto_is_recorded(hills: Path, tmp_path: Path) -> None:
    report = blocksar.focus(hills, tmp_path / "run", processor="auto", grid=SMALL, workers=0)
    chosen = report.result["plan"]["processor"]
    assert chosen in (HIERARCHICAL, EXACT, "angular-division")
    assert report.result["settings"]["processor"] == "auto"
    assert any(f"{chosen} is chosen: it keeps the fidelity" in line for line in report.summary)
    assert f"processor {chosen}" in str(blocksar.info(tmp_path / "run"))
