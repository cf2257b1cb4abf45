"""End to end: scene file to measured image, against theory and against exact back-projection.

Tolerances are those of the project's quality bar, not the values that the chain happens to reach.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from scenes import UNSTEERED_SCENE, one_target

import blocksar
from blocksar import stores
from blocksar.measurement.coherence import coherence


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
