"""Images on a terrain: targets on hills come out where they stand, and as sharp as on the plane."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from quality_bar import check_targets, planned
from scenes import write_store

import blocksar
from blocksar import stores
from blocksar.collection.geometry import Geometry
from blocksar.collection.terrain import Terrain
from blocksar.errors import FolderError
from blocksar.places import place
from blocksar.processors.chain.planning.written_bytes import run_bytes
from blocksar.simulation.scene import Scene

MIDDLE = np.array([16105.0, 19193.0])  # m: the middle of Table 1's swath
PLACES = {"top": (30.0, 10.0), "flank": (-150.0, 90.0), "foot": (180.0, -240.0)}  # m from there
HILLS = """
[terrain]
hills = [{x = 16140.0, y = 19200.0, height = 300.0, width = 700.0},
         {x = 15700.0, y = 18900.0, height = -120.0, width = 500.0}]
"""


def grid_about(half: float, step: float = 0.8) -> Any:
    return tuple((float(c - half), float(c + half), step) for c in MIDDLE)


def check_layers(image: Any, store: Path, ground: Terrain) -> None:
    """Check incidence and visibility of some pixels, from the pulses that light them."""
    assert image.incidence_angle.dtype == np.float32 and image.incidence_angle.attrs["units"] == "rad"
    assert image.visibility.dtype == np.uint8 and list(image.visibility.attrs["flag_values"]) == [0, 1, 2]
    assert image.visibility.attrs["flag_meanings"] == "visible layover shadow"
    assert (image.visibility.values == 0).all()  # the hills are not that steep
    geometry = Geometry(collection=stores.open_phase_history(store).collection).over(ground)
    rows, columns = (np.linspace(1, n - 2, 5).astype(int) for n in image.image.shape)
    for row, column in zip(rows, columns, strict=True):
        x, y = float(image.x[column]), float(image.y[row])
        lit = np.flatnonzero(geometry.beam.is_lit(np.array(x), np.array(y)))
        antenna = geometry.collection.antenna_position[[lit[0], lit[-1]]].mean(axis=0)
        slope = ground.slope(x, y)
        normal, sight = np.array([-slope[0], -slope[1], 1.0]), antenna - [x, y, float(ground(np.array(x), np.array(y)))]
        cosine = normal @ sight / np.linalg.norm(normal) / np.linalg.norm(sight)
        assert float(image.incidence_angle[row, column]) == pytest.approx(np.arccos(cosine), abs=2e-4)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Table 1's platform over hills, with targets and clutter on them."""
    rows = (
        f'[[targets]]\nname = "{name}"\nx = {MIDDLE[0] + dx:.3f}\ny = {MIDDLE[1] + dy:.3f}\n'
        for name, (dx, dy) in PLACES.items()
    )
    folder = tmp_path_factory.mktemp("hills")
    return write_store(folder, swath=[29600.0, 30400.0], more=HILLS + "".join(rows))


@pytest.fixture
def terrain(store: Path, tmp_path: Path) -> Path:
    """The scene's ground, as a file."""
    ground = Scene.read(store.parent / "scene.toml").terrain
    assert ground is not None
    path = tmp_path / "ground.zarr"
    stores.write_terrain(place(path), ground)
    return path


def test_back_projection_puts_targets_where_they_stand(store: Path, terrain: Path, tmp_path: Path) -> None:
    run, settings = tmp_path / "run", {"processor": "backprojection", "workers": 0, "terrain": terrain}
    dx, dy = PLACES["flank"]
    grid = tuple((float(c + d - 45), float(c + d + 45), 0.8) for c, d in zip(MIDDLE, (dx, dy), strict=True))
    blocksar.focus(store, run, grid=grid, **settings)
    found = blocksar.quality(run).result
    check_targets({"targets": [t for t in found["targets"] if t["name"] == "flank"]}, 1)
    image = blocksar.open(run)
    assert image.height.dtype == np.float32
    assert image.ground_height == stores.read_terrain(place(run / "terrain.zarr")).mean  # that of its map projection
    ground = stores.read_terrain(place(terrain))
    expected = ground.on_grid(image.x.values, image.y.values)
    assert np.nanmax(np.abs(image.height.values - expected)) < 1e-4
    check_layers(image, store, ground)
    # The same again is finished; another ground is another run.
    assert "nothing to do" in blocksar.focus(store, run, grid=grid, **settings).summary[0]
    with pytest.raises(FolderError, match="terrain"):
        blocksar.focus(store, run, grid=grid, processor="backprojection", workers=0)
    ground.heights[...] += 0.5
    stores.write_terrain(place(terrain), ground)
    with pytest.raises(FolderError, match="heights"):
        blocksar.focus(store, run, grid=grid, **settings)


@pytest.mark.slow
def test_a_chain_puts_targets_where_they_stand(store: Path, terrain: Path, tmp_path: Path) -> None:
    run, settings = tmp_path / "run", {"blocks": 2, "grid": grid_about(300.0, 1.0), "workers": 0}
    blocksar.focus(store, run, terrain=terrain, **settings)
    found = blocksar.quality(run).result
    check_targets(found, len(PLACES))
    image = blocksar.open(run)
    assert np.isfinite(image.image.values.real).all() and set(np.unique(image.block.values)) == {0, 1}
    ground = stores.read_terrain(place(terrain))
    assert np.abs(image.height.values - ground.on_grid(image.x.values, image.y.values)).max() < 1e-3
    check_layers(image, store, ground)
    files = [path for name in stores.ON_TERRAIN for path in (run / "image.zarr" / name).rglob("c/*/*")]
    layers = run_bytes(planned(store, blocks=2, grid=grid_about(300.0, 1.0), terrain=terrain))["layers"]
    assert sum(path.stat().st_size for path in files) == pytest.approx(layers, rel=0.03)
