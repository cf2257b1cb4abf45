"""The `bench` fixture of the tests of bad input."""

from __future__ import annotations

import pytest
from bad_input import SCENE, Bench

import blocksar


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    room = tmp_path_factory.mktemp("bad")
    (room / "scene.toml").write_text(SCENE)
    store = blocksar.simulate(room / "scene.toml", room / "clean.zarr")
    return Bench(room, store)
