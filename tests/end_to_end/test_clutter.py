"""Backscatter of simulated clutter: what each processor's image says of a field of known sigma nought."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from axis_beams import axis_scene

import blocksar

pytestmark = pytest.mark.slow

SCATTERERS, SIDES = 120_000, (500.0, 640.0)  # m; seven or more in a response of 18 m2
SIGMA = 4.0 * SCATTERERS / (SIDES[0] * SIDES[1])
FIELD = f"""
[clutter]
scatterers = {SCATTERERS}
seed = 7
power = 4.0
x = [8400.0, 8900.0]
y = [-320.0, 320.0]
[dropped]
ranges = [[640, 679]]
"""
SETTINGS: dict[str, Any] = {
    "bandwidth": 50e6, "range_sampling": 60e6, "prf": 600, "height": 5000.0, "time": "duration = 2",
    "swath": [9800.0, 10200.0],
}  # fmt: skip
TOPS = 'mode = "tops"\nwidth_deg = 1.2\nrate_deg = 1.0\npattern = "gaussian"'
CASES = {
    "backprojection": "uniform", "hierarchical-backprojection": "taylor:4:-35", "angular-division": "hamming",
}  # fmt: skip


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("clutter")
    (folder / "scene.toml").write_text(axis_scene(TOPS, more=FIELD, **SETTINGS))
    blocksar.simulate(folder / "scene.toml", folder / "ph.zarr")
    return folder / "ph.zarr"


@pytest.mark.parametrize("processor", CASES)
def test_clutter_has_its_sigma_nought(processor: Any, store: Path, tmp_path: Path) -> None:
    """Speckle leaves 1 / sqrt(n) of the mean of n independent responses: some 0.04 dB of all, 0.08 dB of a quarter."""
    grid = ((8440, 8860, 4.5), (-280, 280, 3.5))  # within the field, for side lobes
    blocksar.focus(store, tmp_path / "run", grid=grid, processor=processor, weighting=CASES[processor], workers=0)
    with blocksar.open(tmp_path / "run") as dataset:
        ratio = dataset.sar.backscatter("sigma0").values / SIGMA
        image = np.abs(dataset.image.values) ** 2
    covered = np.isfinite(ratio)
    assert 10 * np.log10(ratio[covered].mean()) == pytest.approx(0.0, abs=0.1)
    areas = (image / ratio)[covered]  # the less, the longer is the dwell
    assert areas.max() > 1.3 * areas.min()
    for part in np.array_split(ratio[covered][np.argsort(areas)], 4):
        assert 10 * np.log10(part.mean()) == pytest.approx(0.0, abs=0.3)
