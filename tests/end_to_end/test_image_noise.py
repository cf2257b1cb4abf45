"""The noise of images: that of collections of noise alone, against what the images say of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from axis_beams import axis_scene

import blocksar

pytestmark = pytest.mark.slow

NOISE = "\n[noise]\npower = 0.5\nseed = 5\n[dropped]\npulses = [700, 701, 702]\n"
PARTS = 8  # of the pixels, from the longest dwells to the shortest
AXIS: dict[str, Any] = {"bandwidth": 50e6, "range_sampling": 60e6, "prf": 600, "height": 5000.0, "time": "duration = 2"}
TOPS = 'mode = "tops"\nwidth_deg = 1.2\nrate_deg = 1.0\npattern = "gaussian"'
SLIDING = 'mode = "sliding-spotlight"\nwidth_deg = 0.9\nrate_deg = -0.35'
SCENES = {
    "tops": (axis_scene(TOPS, swath=[9800.0, 10200.0], more=NOISE, **AXIS), ((8400, 8900, 5), (-320, 320, 2))),
    "sliding": (axis_scene(SLIDING, swath=[9800.0, 10200.0], more=NOISE, **AXIS), ((8400, 8900, 5), (-200, 200, 1))),
}


@pytest.mark.parametrize(("name", "processor"), [("tops", "angular-division"), ("sliding", "backprojection")])
def test_the_noise_of_an_image_is_as_strong_as_it_says(name: str, processor: Any, tmp_path: Path) -> None:
    """The mean of n independent pixels' power over its expectation is 1 to within 1 / sqrt(n)."""
    text, grid = SCENES[name]
    (tmp_path / "scene.toml").write_text(text)
    store = blocksar.simulate(tmp_path / "scene.toml", tmp_path / "ph.zarr")
    blocksar.focus(store, tmp_path / "run", grid=grid, processor=processor, weighting="taylor:4:-35", workers=0)
    with blocksar.open(tmp_path / "run") as dataset:
        image, noise = dataset.image.values, dataset.noise_equivalent.values
        np.testing.assert_allclose(dataset.sar.noise_db(), 10 * np.log10(noise), atol=1e-4)
    assert noise.dtype == np.float32 and not (np.isfinite(noise) & ~np.isfinite(image)).any()
    both = np.isfinite(noise)
    assert both.sum() > 0.99 * np.isfinite(image).sum() > 1e4  # not those that are lit for less than a pulse
    order = np.argsort(noise[both])
    expected = noise[both][order]
    assert expected[-1] > (20 if name != "tops" else 1.2) * expected[0]
    for part in np.array_split((np.abs(image[both]) ** 2)[order] / expected, PARTS):
        assert part.mean() == pytest.approx(1.0, abs=4 / np.sqrt(part.size))
    figures = blocksar.quality(tmp_path / "run").result["noise"]
    assert expected[0] <= figures["least"] <= figures["median"] <= figures["greatest"] <= expected[-1]
    assert figures["median"] == pytest.approx(np.median(expected), rel=0.05)
