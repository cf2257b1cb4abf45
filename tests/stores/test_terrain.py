"""A stored terrain, read by windows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from blocksar import stores
from blocksar.collection.terrain import Terrain
from blocksar.errors import InputError
from blocksar.places import place


def test_windows_are_those_of_the_whole_terrain(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    heights = np.random.default_rng(1).standard_normal((700, 1100))
    terrain = Terrain(x0=100.0, dx=5.0, y0=-50.0, dy=4.0, heights=heights, row=3, column=7)
    stores.write_terrain(place(tmp_path / "terrain.zarr"), terrain)
    stored = stores.StoredTerrain(place(tmp_path / "terrain.zarr"))
    assert stored.limits == terrain.limits
    boxes = [((300.0, 900.0), (0.0, 700.0)), ((400.0, 800.0), (10.0, 20.0)), ((2500.0, 5000.0), (900.0, 2700.0))]
    for kept in (1 << 30, 1 << 10):  # with and without chunks that are kept
        monkeypatch.setattr("blocksar.stores.terrain_store.KEPT_BYTES", kept)
        for box in boxes * 2:
            part, wanted = stored.read(*box), terrain.window(*box)
            np.testing.assert_array_equal(part.heights, wanted.heights)
            assert (part.row, part.column, part.x0, part.dy) == (wanted.row, wanted.column, 100.0, 4.0)
    np.testing.assert_array_equal(stored.read().heights, heights)


def test_a_damaged_store_is_named(tmp_path: Path) -> None:
    stores.write_terrain(place(tmp_path / "terrain.zarr"), Terrain.flat(3.0, (0.0, 9.0), (0.0, 9.0)))
    group = tmp_path / "terrain.zarr" / "zarr.json"
    group.write_text(group.read_text().replace('"limits"', '"other"'))
    with pytest.raises(InputError, match=r"terrain\.zarr is damaged .*focus again"):
        stores.StoredTerrain(place(tmp_path / "terrain.zarr"))
