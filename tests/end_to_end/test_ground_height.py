"""The height of the imaged plane as an option: targets above the stored plane lie at their places only with it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import blocksar
from blocksar import stores
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import FolderError

HEIGHT = 30.0  # m over the stored plane: layover of 30 m x 9 / 12
TARGETS = ((0.0, 0.0), (12.0, 9.0), (-11.0, 14.0))
GRID = "-20:20:0.5,-20:20:0.5"
N = 256


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A pass 12 km west of the scene and 9 km above it; its targets stand at HEIGHT."""
    time = (np.arange(N) - N // 2) / 150.0
    antenna = np.stack([np.full(N, -12000.0), 150 * time, np.full(N, 9000.0)], axis=1)
    frequency = (np.arange(N) - N // 2) * 390625.0
    reference = np.linalg.norm(antenna, axis=1)
    signal = np.zeros((N, N), complex)
    for x, y in TARGETS:
        path = np.linalg.norm(antenna - [x, y, HEIGHT], axis=1) - reference
        signal += np.exp(-4j * np.pi * (9.65e9 + frequency) * path[:, None] / SPEED_OF_LIGHT)
    history = blocksar.collection(
        time=time, antenna_position=antenna, reference_range=reference, carrier_frequency=9.65e9,
        range_frequency=frequency, signal=signal.astype(np.complex64),
    )  # fmt: skip
    path = tmp_path_factory.mktemp("height") / "ph.zarr"
    blocksar.write(history, path)
    return path


def misplaced(run: Any) -> float:
    """Largest distance of a target from the brightest pixel within 4 m, or of that from a peak of 1, m."""
    image = blocksar.open(run).image
    worst = 0.0
    for x, y in TARGETS:
        part = np.abs(image.sel(x=slice(x - 4, x + 4), y=slice(y - 4, y + 4)))
        peak = part.values.max()
        row, column = np.unravel_index(int(part.values.argmax()), part.shape)
        off = float(np.hypot(part.x[column] - x, part.y[row] - y))
        worst = max(worst, off if peak > 0.8 else 4.0)
    return worst


@pytest.mark.slow
@pytest.mark.parametrize("processor", ["backprojection", "high-order-phase"])
def test_targets_lie_at_their_places_only_at_their_height(store: Path, tmp_path: Path, processor: Any) -> None:
    assert misplaced(blocksar.focus(store, tmp_path / "a", grid=GRID, processor=processor, workers=0).folder) == 4.0
    run = blocksar.focus(store, tmp_path / "b", grid=GRID, processor=processor, workers=0, ground_height=HEIGHT).folder
    assert misplaced(run) <= 0.5  # a pixel
    again = blocksar.focus(store, run, grid=GRID, processor=processor, workers=0, ground_height=HEIGHT)
    assert "nothing to do" in again.summary[0] or again.result["settings"]["ground_height"] == HEIGHT
    with pytest.raises(FolderError):
        blocksar.focus(store, run, grid=GRID, processor=processor, workers=0, ground_height=HEIGHT + 1)
    assert stores.read_collection(run / "collection.zarr")[0].ground_height == HEIGHT


@pytest.mark.slow
def test_the_stored_height_is_the_default(store: Path, tmp_path: Path) -> None:
    """The same as an attribute, and of a dataset in memory."""
    dataset = blocksar.open(store).load()
    dataset.attrs["ground_height"] = HEIGHT
    options: dict[str, Any] = {"grid": GRID, "processor": "backprojection", "workers": 0}
    stated = blocksar.open(blocksar.focus(dataset, tmp_path / "a", **options).folder).image.values
    run = blocksar.focus(blocksar.open(store).load(), tmp_path / "b", **options, ground_height=HEIGHT).folder
    np.testing.assert_array_equal(blocksar.open(run).image.values, stated)
    np.testing.assert_array_equal(
        blocksar.open(blocksar.focus(dataset, tmp_path / "c", **options, ground_height=0.0).folder).image.values,
        blocksar.open(blocksar.focus(store, tmp_path / "d", **options).folder).image.values,
    )


@pytest.mark.slow
def test_plan_and_check_take_it(store: Path) -> None:
    plans = [blocksar.plan(store, grid=GRID, ground_height=height).plan for height in (None, 0.0, HEIGHT)]
    heights = [plan.pieces[0].geometry.collection.ground_height for plan in plans]
    assert heights == [0.0, 0.0, HEIGHT]
    assert blocksar.check(store, grid=GRID, ground_height=HEIGHT).result["warning"] is None
