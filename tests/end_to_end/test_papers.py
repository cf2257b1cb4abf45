"""Scenes of papers B and C, with and without their corrections, and linear derotation."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from quality_bar import check_targets
from scenes import PAPERS, scene, write_store

import blocksar
from blocksar.errors import InputError
from blocksar.simulation.scene import Scene

TARGET = '[[targets]]\nname = "P"\nrange = 30000.0\nyaw_deg = 50.0\n'


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Phase history of a paper's scene, simulated once."""
    folder = tmp_path_factory.mktemp("shipped")
    return cache(lambda name: Path(blocksar.simulate(name, folder / f"{name}.zarr")))


def middle_row(name: str) -> Any:
    """Return the grid of a strip along the middle row of a paper's targets."""
    along_x, along_y = PAPERS[name][1]
    middle = next(target.x for target in Scene.read(name).point_targets() if target.name == "M3")
    return (middle - 40.0, middle + 40.0, along_x[2]), along_y


# ---------------------------------------------------------------- papers B and C on their scenes


@pytest.mark.parametrize(
    ("name", "whole"),
    [
        ("paper_b", False),
        pytest.param("paper_b", True, marks=pytest.mark.slow),
        pytest.param("paper_c", True, marks=pytest.mark.slow),
    ],
)
def test_a_papers_scene_meets_the_quality_bar(
    name: str, whole: bool, store: Callable[[str], Path], tmp_path: Path
) -> None:
    """All fifteen targets, or the five of the middle row."""
    processor, grid = PAPERS[name]
    extent = grid if whole else middle_row(name)
    blocksar.focus(store(name), tmp_path / "run", processor=processor, grid=extent, workers=0)
    found = blocksar.quality(tmp_path / "run").result
    check_targets(
        found if whole else {"targets": [t for t in found["targets"] if t["name"][0] == "M"]}, 15 if whole else 5
    )


@pytest.mark.slow
def test_linear_derotation_needs_a_higher_prf(tmp_path: Path) -> None:
    """Paper A, Figure 6: a PRF sufficient for nonlinear derotation is refused; the message gives the required PRF."""
    (tmp_path / "low.toml").write_text(scene(prf=6900.0, swath=[27500.0, 32500.0]))
    assert blocksar.plan(tmp_path / "low.toml", blocks=3).refusal is None
    with pytest.raises(InputError, match=r"after linear derotation .* a PRF of at least 7\d\d\d Hz is needed"):
        blocksar.plan(tmp_path / "low.toml", blocks=3, derotation="linear")
    store = write_store(tmp_path, duration=0.3, steering=(46.0, 54.0), swath=[29800.0, 30200.0], more=TARGET)
    report = blocksar.focus(store, tmp_path / "run", blocks=1, derotation="linear", workers=0, grid=GRID)
    assert report.result["settings"]["derotation"] == "linear"
    straight = blocksar.focus(store, tmp_path / "straight", blocks=1, workers=0, grid=GRID)
    assert straight.result["settings"]["derotation"] == "nonlinear"
    one, other = (blocksar.open(tmp_path / name).image.values for name in ("run", "straight"))
    np.testing.assert_allclose(one, other, atol=1e-3)  # derotation is undone, so it must not affect the image


GRID = ((15900.0, 16300.0, 4.0), (19000.0, 19400.0, 4.0))
