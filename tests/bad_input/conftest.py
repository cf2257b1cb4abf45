"""The `bench` fixture of the tests of bad input."""

from __future__ import annotations

import pytest
from bad_input import SCENE, Bench
from distributed import Client

import blocksar


@pytest.fixture(scope="module")
def bench(client: Client, tmp_path_factory: pytest.TempPathFactory) -> Bench:
    room = tmp_path_factory.mktemp("bad")
    (room / "scene.toml").write_text(SCENE)
    store = blocksar.simulate(room / "scene.toml", room / "clean.zarr")
    return Bench(client, room, store)
