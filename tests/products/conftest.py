"""Finished runs shared by the tests of products."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
import pytest
from once import once
from report_page import borrowed, write_scene
from small_run import Made, make

import blocksar
from blocksar import stores
from blocksar.graph.cluster import open_client
from blocksar.processors.chain import processor as chain
from blocksar.processors.chain.planning.planner import plan_collection
from blocksar.products.page import page

matplotlib.use("Agg")


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return make(tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="session")
def unplaced(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return make(tmp_path_factory.mktemp("unplaced"), frame=None, size=(60, 50))


# What the targets A, B and C of the small run scatter into HH, HV and VV.
KINDS = {"one bounce": (1, 0, 1), "two bounces": (1, 0, -1), "volume": (0, 0.7, 0)}


@pytest.fixture(scope="session")
def polarised(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of HH, HV and VV: the small run's image, weighted by the part of the scene that a target is in."""
    folder = tmp_path_factory.mktemp("polarised") / "run"
    for number, name in enumerate(("HH", "HV", "VV")):
        made = make(folder / "channels" / name, size=(110, 90), more={"channel": name})
        east, north = made.x[None, :] > 8, made.y[:, None] > 5
        one, two, volume = (factors[number] for factors in KINDS.values())
        weight = np.where(north, np.where(east, two, volume), one)
        for first in range(0, made.y.size, 64):
            rows = slice(first, min(first + 64, made.y.size))
            image = (weight * made.image)[rows].astype(np.complex64)
            stores.write_region(made.folder / "image.zarr", "image", (rows, slice(0, made.x.size)), image)
    stores.write_json(folder / "run.json", {"status": "finished", "identity": "0", "channels": ["HH", "HV", "VV"]})
    return folder


@pytest.fixture(scope="session")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A run with two blocks of two range sub-blocks each, and a back-projection run too coarse to measure in.

    By a worker of their own: its peak memory and times are judged, and other tests must not add to them.
    """
    folder = once(tmp_path_factory, "report", focus_and_report)
    return {"run": folder / "run", "exact": folder / "exact"}


def focus_and_report(folder: Path) -> None:
    store = write_scene(folder)
    with pytest.MonkeyPatch.context() as patch, open_client(workers=1, threads=1, memory_limit=3 * 2**30) as client:
        patch.setattr(chain, "plan_collection", lambda *a, **k: plan_collection(*a, **{**k, "parts": 2}))
        wide = ((15000.0, 17200.0, 1.2), (18000.0, 20400.0, 1.2))
        blocksar.focus(store, folder / "run", blocks=2, grid=wide, client=client)
        coarse = ((16000.0, 16400.0, 4.0), (19100.0, 19500.0, 4.0))
        blocksar.focus(store, folder / "exact", processor="backprojection", grid=coarse, client=client)
    blocksar.quality(folder / "run")
    blocksar.report(folder / "run")


@pytest.fixture(scope="session")
def whole(runs: dict[str, Path]) -> Path:
    """The report page of the first run, with default options."""
    return runs["run"] / "report.html"


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Skip the pictures of responses, which take most of the time of a page."""
    monkeypatch.setattr(page, "draw_responses", lambda *_: [])


@pytest.fixture
def run(runs: dict[str, Path], tmp_path: Path) -> Path:
    """A run whose records a test may change; its image is shared, not copied."""
    return borrowed(runs["run"], tmp_path / "run")
