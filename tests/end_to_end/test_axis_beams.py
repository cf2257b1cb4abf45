"""Runs under beams about the antenna's own axis, from a scene to measured targets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from axis_beams import axis_scene

import blocksar

CLUTTER = """
[clutter]
scatterers = 6000
seed = 3
power = 1e-3
x = [8450.0, 8850.0]
y = [-110.0, 110.0]
[dropped]
pulses = [500, 501]
"""
SCENE = {
    "bandwidth": 50e6, "range_sampling": 60e6, "prf": 600, "height": 5000.0, "velocity": [0.0, 200.0, 0.0],
    "acceleration": [0.4, -0.8, -0.6], "swath": [9800.0, 10200.0],
}  # fmt: skip
TARGETS = [(8560.0, -12.0), (8660.0, 7.0), (8740.0, 10.0)]
GRID = ((8500.0, 8800.0, 1.0), (-60.0, 60.0, 0.4))
MODES = {"spotlight": "width_deg = 0.62", "tops": 'width_deg = 1.2\nrate_deg = 1.0\npattern = "gaussian"'}


def scene(folder: Path, mode: str) -> Path:
    more = "".join(f'[[targets]]\nname = "P{i}"\nx = {x}\ny = {y}\n' for i, (x, y) in enumerate(TARGETS))
    path = folder / "scene.toml"
    path.write_text(axis_scene(f'mode = "{mode}"\n{MODES[mode]}', more=more + CLUTTER, time="duration = 2.0", **SCENE))
    return path


# planning/test_axis_beams.py compares the sums of spotlights with back-projection.
@pytest.mark.slow
def test_a_run_is_sharp_and_coherent_with_back_projection(tmp_path: Path) -> None:
    store = blocksar.simulate(scene(tmp_path, "tops"), tmp_path / "phase_history.zarr")
    report = blocksar.focus(store, tmp_path / "run", grid=GRID, workers=0)
    assert report.result["warnings"] == ["2 of 1200 pulses are missing: counted as not lit"]
    result = blocksar.quality(tmp_path / "run", reference=True).result
    assert [target["full_dwell"] for target in result["targets"]] == [True] * 3
    for target in result["targets"]:
        assert abs(complex(*target["value"]) - 1) < 0.1  # clutter
        assert np.hypot(target["error_x"], target["error_y"]) < 0.05
    full = [chip for chip in result["reference"] if chip["full_dwell"]]
    assert full and min(chip["coherence"] for chip in full) > 0.999
    assert 0.9995 < result["joint_coherence"] <= 1 and "changed_input" not in result
    chunk = next(file for file in sorted((store / "signal" / "c").rglob("*")) if file.is_file())
    chunk.write_bytes(chunk.read_bytes()[:-8] + bytes(8))
    changed = blocksar.quality(tmp_path / "run", reference=True)
    assert changed.result["changed_input"] == [str(store)]
    assert f"{store} has changed since the run" in "\n".join(changed.summary)


def test_no_grid_is_needed(tmp_path: Path) -> None:
    grid = blocksar.plan(scene(tmp_path, "spotlight"), processor="backprojection").plan.grid
    assert grid.x0 < 8560 and grid.x1 > 8740 and grid.y0 < -12 and grid.y1 > 10
