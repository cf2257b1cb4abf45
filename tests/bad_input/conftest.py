"""The bench of the tests of bad input."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from bad_input import SCENE, Bench

import blocksar
from blocksar.graph import cluster


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    room = tmp_path_factory.mktemp("bad")
    (room / "scene.toml").write_text(SCENE)
    store = blocksar.simulate(room / "scene.toml", room / "clean.zarr")
    with cluster.open_client(workers=1, threads=1, memory_limit=2 * 2**30) as client:
        yield Bench(client, room, store)
