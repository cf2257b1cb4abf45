"""Scenes of papers B and C, with and without their corrections, and linear derotation."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from quality_bar import check_targets
from scenes import PAPERS

import blocksar
from blocksar.simulation.scene import Scene

pytestmark = pytest.mark.slow


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
