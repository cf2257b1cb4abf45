"""The terrain on the report page: its picture, its figures, and the heights in the table."""

from __future__ import annotations

import base64
import io
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread
from report_page import read
from scipy.optimize import fsolve
from small_run import TARGETS, hilly, make, ridge

import blocksar
from blocksar.places import place
from blocksar.products.page.picture import read_relief
from blocksar.runs.finished import FinishedRun


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
def test_the_page_shows_the_terrain_and_the_heights_of_targets(tmp_path: Path) -> None:
    run = make(tmp_path / "run", terrain=ridge(base=-5.0), formed_on_it=True, step=0.35)
    found = read(blocksar.report(run.folder).result)
    said = found.text()
    image = blocksar.open(run.folder)
    covered = np.isfinite(run.image)
    z = np.where(covered, image.height.values, np.nan)
    low, high = (f"{value:.1f}".replace("-", "\N{MINUS SIGN}") for value in (np.nanmin(z), np.nanmax(z)))
    assert f"between z = {low} m and {high} m" in said
    shares = [100 * (image.visibility.values == flag)[covered].mean() for flag in (1, 2)]
    assert (
        f"{shares[0]:.2g} % of the covered pixels are in layover" in said and f"{shares[1]:.2g} % are in shadow" in said
    )
    # The picture has hill shade, layover, shadow and what is not covered.
    source = next(a["src"] for a in found.all("img") if a["alt"].startswith("Hill shade"))
    pixels = imread(io.BytesIO(base64.b64decode(source.partition(",")[2])))[..., :3]
    grey = np.ptp(pixels, axis=2) < 0.02
    orange = (pixels[..., 0] - pixels[..., 2] > 0.25) & (pixels[..., 1] - pixels[..., 2] > 0.1)
    blue = (pixels[..., 2] - pixels[..., 0] > 0.25) & ~orange
    assert all(0.01 < part.mean() < 0.9 for part in (grey, orange, blue))
    cells = np.array([float(a["data-sort"]) for a in found.all("td") if re.fullmatch(r"-?[\d.e+-]+", a["data-sort"])])
    for target in TARGETS[:2]:
        assert np.abs(cells - float(ridge(base=-5.0)(np.array(target.x), np.array(target.y)))).min() < 1e-6
    assert "ground" in said


def test_slopes_and_shares_are_those_of_the_terrain(tmp_path: Path) -> None:
    run, terrain = make(tmp_path / "run", terrain=ridge(base=-5.0)), ridge(base=-5.0)
    relief = read_relief(FinishedRun.open(place(run.folder)), terrain)
    x, y = np.meshgrid(relief.x, relief.y)
    h = 1e-3
    slope = np.hypot(terrain(x + h, y) - terrain(x - h, y), terrain(x, y + h) - terrain(x, y - h)) / (2 * h)
    assert np.tan(relief.steepest) == pytest.approx(
        np.nanmax(np.where(np.isfinite(relief.height), slope, np.nan)), rel=0.02
    )


@pytest.mark.slow
def test_targets_in_shadow_are_not_judged(tmp_path: Path) -> None:
    """Of targets in the scene's quality, one behind the ridge has no echo to be measured."""
    run = make(tmp_path / "run", terrain=ridge(base=-5.0), formed_on_it=True, step=0.35)
    flags = blocksar.open(run.folder).visibility
    row, column = np.argwhere(flags.values == 2)[len(np.argwhere(flags.values == 2)) // 2]
    dark = {"name": "dark", "x": float(flags.x[column]), "y": float(flags.y[row])}
    high = {**dark, "name": "mast", "z": 40.0}
    lit = {"name": "B", "x": TARGETS[1].x, "y": TARGETS[1].y}
    report = blocksar.quality(run.folder, targets=[dark, high, lit])
    assert "in shadow of the terrain, and not judged: 1 of 3 targets (dark)" in report.summary
    assert [target["full_dwell"] for target in report.result["targets"]] == [False, True, True]


def test_targets_off_the_ground_are_measured_where_they_appear(tmp_path: Path) -> None:
    """A mast with the range and Doppler of a target: found by brute force on the circle of both."""
    terrain = hilly((0.0, 0.0))
    run = make(tmp_path, terrain=terrain, formed_on_it=True, hole=False)
    target, track = TARGETS[1], run.collection.antenna_position
    middle = run.collection.n_pulse // 2
    antenna, velocity = (track[middle - 1] + track[middle]) / 2, track[middle] - track[middle - 1]
    ground = np.array([target.x, target.y, float(terrain(np.array(target.x), np.array(target.y)))])
    top = brute(antenna, velocity, ground, ground[2] + 15.0)
    assert np.hypot(*(top - ground)[:2]) > 8
    mast = {"name": "mast", "x": top[0], "y": top[1], "z": top[2]}
    report = blocksar.quality(run.folder, targets=[mast, {"name": "B", "x": target.x, "y": target.y}])
    assert any("off the ground, and measured where" in line and "1 of 2 targets" in line for line in report.summary)
    one, other = report.result["targets"]
    assert [one["x"], one["y"]] == pytest.approx([target.x, target.y], abs=0.02)
    assert one["value"] == pytest.approx(other["value"], abs=0.01)


def brute(antenna: Any, velocity: Any, point: Any, z: float) -> Any:
    """The place at a height of the range and Doppler of a point, near it."""

    def left(xy: Any) -> Any:
        sights = [np.array([*xy, z]) - antenna, point - antenna]
        ranges = [np.linalg.norm(sight) for sight in sights]
        return [ranges[0] - ranges[1], *((sights[0] / ranges[0] - sights[1] / ranges[1])[None] @ velocity * 1e4)]

    return np.array([*fsolve(left, point[:2]), z])
