"""End to end: scene file to measured image, against theory and against exact back-projection.

Tolerances are those of the project's quality bar, not the values that the chain happens to reach.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from quality_bar import coarse_grid, planned
from scenes import GEOMETRIES, UNSTEERED_SCENE, one_target, write_store

import blocksar
from blocksar import stores
from blocksar.measurement.coherence import coherence

CLUTTER = "[clutter]\nscatterers = 12000\nseed = 3\n"


@pytest.fixture(scope="module")
def clutter(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Phase history of clutter by name of the geometry, each simulated once."""
    return cache(lambda name: write_store(tmp_path_factory.mktemp("clutter"), **GEOMETRIES[name], more=CLUTTER))


# test_processors.py covers "scan reversed"; focusing/test_steps.py has lines of most geometries on small arrays.
@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in GEOMETRIES if name != "scan reversed"])
def test_clutter_is_coherent_with_back_projection(name: str, clutter: Callable[[str], Path], tmp_path: Path) -> None:
    store = clutter(name)
    blocksar.focus(store, tmp_path / "run", blocks=3, grid=coarse_grid(store), workers=0)
    quality = blocksar.quality(tmp_path / "run", reference=True).result
    chips = quality["reference"]
    # Chips differ from each other by 5e-4: they hold a few thousand resolution cells. Where fewer scatterers are lit
    # than the beam would hold, as at the ends of a scene, the ends of dwells lose less than predicted.
    assert abs(quality["least_coherence"]["measured"] - quality["least_coherence"]["predicted"]) < 0.0011
    assert len(chips) >= 15  # block centres, seams and swath ends, each at near, middle and far range
    for chip in chips:
        assert chip["coherence"] >= 0.998, chip
        assert chip["gain"] == pytest.approx(1.0, abs=0.02), chip
        assert abs(chip["phase"]) <= 0.02, chip


WOBBLE = """
[[track.wobble]]
amplitude = [0.03, 0.05, 0.02]
frequency = 2.3
phase_deg = [20.0, 60.0, 100.0]
[[track.wobble]]
amplitude = [0.0, 0.02, 0.03]
frequency = 4.2
"""


# planning/test_axis_beams.py has wobbling tracks on small arrays.
@pytest.mark.slow
@pytest.mark.parametrize("processor", ["angular-division", "keystone-resampling", "high-order-phase"])
def test_a_track_that_wobbles_is_coherent_with_back_projection(processor: Any, tmp_path: Path) -> None:
    """2 to 5 cm in all axes, which no polynomial follows; one correction for each pulse leaves 0.83."""
    store = write_store(tmp_path, swath=[29500.0, 30500.0], more=WOBBLE + CLUTTER)
    plan = planned(store, processor=processor)
    assert plan.geometry.track.wobble is not None
    # The steps in Doppler of the last smear the ends of dwells the most, which its plan says.
    least = 0.998 if processor == "high-order-phase" else 0.999
    assert plan.coherence >= least and (plan.faithful or processor == "high-order-phase")
    grid = coarse_grid(store)
    blocksar.focus(store, tmp_path / "run", blocks=plan.n_blocks, processor=processor, grid=grid, workers=0)
    measured, judged = blocksar.quality(tmp_path / "run", reference=True).result, 0
    assert measured["joint_coherence"] >= least
    for chip in measured["reference"]:
        # The range window is wider than the swath: beyond it is no clutter, only what its side lobes leave.
        if 29500 < float(plan.geometry.epoch_range(np.array(chip["x"]), np.array(chip["y"]))) < 30500:
            assert chip["coherence"] >= plan.coherence - 0.001, chip
            judged += 1
        assert chip["gain"] == pytest.approx(1.0, abs=0.02), chip
        assert abs(chip["phase"]) <= 0.02, chip
    assert judged >= 10


def test_a_range_window_as_narrow_as_the_interpolation_is_covered(tmp_path: Path) -> None:
    """Rows were cut at the end of the window of 45 m: no pixel of this grid was covered, and 1.0 was predicted."""
    text = UNSTEERED_SCENE.replace("swath = [7920.0, 8080.0]", "swath = [7980.0, 8020.0]")
    text = text.replace("centre_yaw_deg = 20.0", "centre_yaw_deg = 0.0")
    text = text.replace("ground_range_offset = 10.0, cross_range_offset = -15.0", "x = 6245.0, y = 0.0")
    (tmp_path / "scene.toml").write_text(text)
    store = blocksar.simulate(tmp_path / "scene.toml", tmp_path / "ph.zarr")
    grid = ((6235.0, 6255.0, 0.5), (-10.0, 10.0, 0.5))
    images = []
    for name, processor in (("run", "angular-division"), ("exact", "backprojection")):
        blocksar.focus(store, tmp_path / name, grid=grid, processor=processor, workers=0)
        images.append(stores.read_region(tmp_path / name / "image.zarr", "image", (slice(None), slice(None))))
    image, exact = images
    assert np.isfinite(exact).mean() > 0.95
    assert np.isfinite(image).mean() > 0.95 * np.isfinite(exact).mean()
    assert abs(coherence(image, exact).coherence) > 0.999
    assert abs(image[20, 20]) == pytest.approx(abs(exact[20, 20]), rel=0.01)


def test_a_dataset_is_accepted_and_returned(tmp_path: Path) -> None:
    grid = ((16000.0, 16200.0, 2.0), (19100.0, 19300.0, 2.0))
    with xr.open_zarr(one_target(tmp_path)) as source:
        blocksar.focus(source, tmp_path / "run", blocks=3, grid=grid, workers=0)
    image = blocksar.open(tmp_path / "run")
    assert image.image.dtype == np.complex64
    assert image.block.dtype == np.int16
    assert image.image.attrs["units"] == "1"
    assert image.x.attrs["long_name"]
    assert set(np.unique(image.block)) == {1}
