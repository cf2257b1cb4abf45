"""Which chips are judged beside exact back-projection."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from axis_beams import axis_collection, axis_scene

import blocksar
from blocksar.api.reference_chips import whole_geometry
from blocksar.collection.geometry import over_terrain
from blocksar.collection.terrain import Terrain
from blocksar.measurement.coherence import coherence


def test_the_power_of_a_chip_is_that_of_the_reference() -> None:
    exact = np.array([[1 + 1j, 2.0, np.nan]], np.complex64)
    assert coherence(2 * exact, exact).power == pytest.approx(3.0)
    assert coherence(np.zeros_like(exact), exact).power == pytest.approx(3.0)


def test_segments_on_a_terrain_are_compared_there() -> None:
    """They were back-projected on the plane: 0.0009 was said of an image whose coherence was 0.9996."""
    collection = axis_collection()
    terrain = Terrain.flat(120.0, (8500.0, 9500.0), (-500.0, 500.0))
    run = SimpleNamespace(segments=(over_terrain(collection, terrain),))
    found = whole_geometry(run, SimpleNamespace(collection=collection))  # type: ignore[arg-type]
    assert found.terrain is terrain
    assert found.collection.ground_height == 120.0


@pytest.mark.slow
@pytest.mark.parametrize(("rows", "compared"), [pytest.param(48, 9, marks=pytest.mark.slow), (12, 0)])
def test_a_small_part_of_what_a_block_owns_is_compared(tmp_path: Path, rows: int, compared: int) -> None:
    """The centre of the block and its seams lie beyond the image: nothing was compared, without a word."""
    clutter = "[clutter]\nscatterers = 300\nseed = 3\nx = [8600.0, 8750.0]\ny = [20.0, 90.0]"
    (tmp_path / "scene.toml").write_text(axis_scene('mode = "stripmap"\nwidth_deg = 0.7', more=clutter))
    store = blocksar.simulate(tmp_path / "scene.toml", tmp_path / "store.zarr", progress=False)
    grid = (8640.0, 8700.0, 1.2), (40.0, 40.0 + 0.6 * rows, 0.6)
    blocksar.focus(store, tmp_path / "run", grid=grid, blocks=1, workers=0, progress=False)
    report = blocksar.quality(tmp_path / "run", reference=True)
    assert len(report.result["reference"]) == compared
    assert any("nothing was compared" in line for line in report.summary) == (compared == 0)
    if compared:
        assert report.result["least_coherence"]["measured"] > 0.99
