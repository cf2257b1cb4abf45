"""Several collections of hills: each as it would be alone, and targets where they stand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bursts import CENTRE, SLANT, STEP, ground, write_bursts

import blocksar
from blocksar import stores
from blocksar.places import place
from blocksar.simulation.scene import Scene

pytestmark = pytest.mark.slow

STEP_M = 2.0  # of grids, m
ALL_HERE = {"blocks": 1, "workers": 0}


def on_grid(slant: float, yaw_deg: float) -> tuple[float, float]:
    x, y = (STEP_M * round(value / STEP_M) for value in ground(slant, yaw_deg))
    return x, y


def hill(x: float, y: float) -> str:
    return f"[terrain]\nhills = [{{x = {x + 60}, y = {y - 40}, height = 200.0, width = 500.0}}]\n"


def keep_ground(toml: Path) -> Path:
    """The scene's terrain as a file."""
    terrain, path = Scene.read(toml).terrain, toml.parent / "ground.zarr"
    assert terrain is not None
    stores.write_terrain(place(path), terrain)
    return path


def box(x: float, y: float, half: float) -> tuple[tuple[float, float, float], ...]:
    return ((x - half, x + half, STEP_M), (y - half, y + half, STEP_M))


def test_a_mosaic_of_bursts_lies_on_the_hills(tmp_path: Path) -> None:
    """Across the seam of two bursts, whose antennas see the hill from different places."""
    seam = CENTRE + STEP / 2
    targets = [on_grid(SLANT, seam + off) for off in (-0.15, 0.15)]
    middle = on_grid(SLANT, seam)
    bursts = write_bursts(tmp_path, targets, more=hill(*middle))[1:]
    settings = {**ALL_HERE, "grid": box(*middle, 130.0), "terrain": keep_ground(tmp_path / "burst1.toml")}
    blocksar.focus(bursts, tmp_path / "run", **settings)
    image = blocksar.open(tmp_path / "run")
    heights = [float(image.height.sel(x=x, y=y)) for x, y in targets]
    assert min(heights) > 100
    assert sorted(int(image.collection.sel(x=x, y=y)) for x, y in targets) == [0, 1]
    for x, y in targets:
        value = complex(image.image.sel(x=x, y=y))
        assert abs(value) == pytest.approx(1.0, abs=0.02) and abs(np.angle(value)) < 0.05
    blocksar.focus(bursts[1], tmp_path / "alone", **settings)
    alone, own = blocksar.open(tmp_path / "alone"), image.collection.values == 1
    for name in ("image", "incidence_angle", "visibility", "height"):
        np.testing.assert_array_equal(image[name].values[own], alone[name].values[own])
