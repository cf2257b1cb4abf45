"""Weighted images: a target against the ideal response, the rim of a beam against exact back-projection."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from quality_bar import planned
from scenes import SMALL_SCAN, scene

import blocksar
from blocksar.collection.weighting import Taper
from blocksar.errors import FolderError

pytestmark = pytest.mark.slow

TAYLOR = Taper.parse("taylor:4:-35")


def write(folder: Path) -> tuple[Path, Any]:
    """The phase history of a target at a seam, and the grid of its image."""
    text = scene(**SMALL_SCAN)
    (folder / "empty.toml").write_text(text)
    plan = planned(folder / "empty.toml", blocks=2)
    x, y, _ = plan.geometry.ground_point(np.array(30e3), np.array(plan.blocks[0].high))
    grid = ((x - 70, x + 70, 0.5), (y - 70, y + 70, 0.5))
    # One only: the side lobes of another would be as high as those to be measured.
    text += f'\n[[targets]]\nname = "T"\nx = {x + 1.3}\ny = {y - 0.7}\n'
    (folder / "scene.toml").write_text(text)
    return Path(blocksar.simulate(folder / "scene.toml", folder / "ph.zarr")), grid


def test_weighted_targets_have_the_ideal_response(tmp_path: Path) -> None:
    store, grid = write(tmp_path)
    blocksar.focus(store, tmp_path / "run", blocks=2, grid=grid, weighting=TAYLOR.text, workers=0)
    report = blocksar.quality(tmp_path / "run")
    assert len(report.result["targets"]) == 1
    assert report.result["weighting"] == {"range": TAYLOR.text, "azimuth": TAYLOR.text}
    for target in report.result["targets"]:
        assert target["full_dwell"] and target["covered"]
        for axis in ("range", "azimuth"):
            assert target[f"{axis}_pslr"] == pytest.approx(-35.17, abs=0.5), target
            assert target[f"{axis}_irw"] == pytest.approx(target[f"{axis}_irw_theory"], rel=0.01), target
        assert max(abs(target["error_x"]), abs(target["error_y"])) <= 0.02
        assert abs(complex(*target["value"])) == pytest.approx(1.0, abs=0.005)
    with pytest.raises(FolderError, match="weighting_range 'taylor:4:-35'"):
        blocksar.focus(store, tmp_path / "run", blocks=2, grid=grid, workers=0)
    blocksar.report(tmp_path / "run")
    page = " ".join((tmp_path / "run" / "report.html").read_text().split())
    assert "weighting-azimuth" in page and "side lobes within 0.5 dB of" in page


RIM = """
[radar]
carrier = 9.6e9
bandwidth = 50e6
range_sampling = 60e6
prf = 600
[track]
position = [0.0, 0.0, 5000.0]
velocity = [0.0, 200.0, 0.0]
[time]
duration = 2.0
[beam]
mode = "spotlight"
width_deg = 1.5
pattern = "gaussian"
[scene]
swath = [9700.0, 10300.0]
centre_yaw_deg = 0.0
reference_range = "constant"
[[targets]]
name = "T"
x = 8400.0
y = 100.0
"""


def test_the_rim_of_a_staring_beam(tmp_path: Path) -> None:
    """Weights there tilt over the aperture: a target lost its first 30 of 1200 pulses, and was 42 dB from the exact."""
    (tmp_path / "scene.toml").write_text(RIM)
    blocksar.simulate(tmp_path / "scene.toml", tmp_path / "ph.zarr")
    asked: dict[str, Any] = {"grid": ((8390.0, 8410.0, 1.0), (97.0, 103.0, 0.25)), "weighting": TAYLOR.text}
    images = []
    for name, how in (("chosen", {"fidelity": 0.999999}), ("exact", {"processor": "backprojection"})):
        blocksar.focus(tmp_path / "ph.zarr", tmp_path / name, workers=0, threads=1, **asked, **how)  # type: ignore[arg-type]
        images.append(blocksar.open(tmp_path / name).image.values)
    error = np.linalg.norm(images[0] - images[1]) / np.linalg.norm(images[1])
    assert error < 10 ** (-55 / 20)
