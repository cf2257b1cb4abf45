"""Fixtures that several folders of tests share."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import date
from functools import cache
from pathlib import Path
from random import Random

import dask
import numpy as np
import pytest
import typer
from distributed import Client
from once import once

import blocksar
from blocksar.application import run_stages
from blocksar.application.jobs import Job
from blocksar.application.run_stages import Check, checking
from blocksar.collection.collection import Collection
from blocksar.garbage import collect_seldom
from blocksar.graph.cluster import open_client
from blocksar.places.local import LocalPlace

# Random collections are drawn by the day, which processes that share the tests must agree on.
os.environ.setdefault("BLOCKSAR_TESTS_DAY", date.today().isoformat())
END = float(os.environ.get("BLOCKSAR_TESTS_END", "inf"))  # s since 1970: tests that would begin later are left out

# Files that take longest, first: two processes that share the files then end at about the same time.
FIRST = (
    "end_to_end",
    "processors",
    "tests",  # pages, layers, compiled loops
    "bad_input",
    "workflows",
    "inspection",
    "runs",
    "stores",
    "products",
    "deploy",
    "readers",
    "planning",
)


def pytest_configure(config: pytest.Config) -> None:
    """Compile before the processes start that share the tests: each of them would compile all loops."""
    if getattr(config.option, "numprocesses", None) and not hasattr(config, "workerinput"):
        subprocess.run([sys.executable, "-m", "blocksar", "compile", "--quiet"], check=True, stdout=subprocess.DEVNULL)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Order the tests by folder, or by an order of the day where not all may come; keep their order within a file."""
    if math.isinf(END):
        place = {folder: number for number, folder in enumerate(FIRST)}
        items.sort(key=lambda item: place.get(item.path.parent.name, len(FIRST)))
    else:
        files = sorted({item.path for item in items})
        Random(os.environ["BLOCKSAR_TESTS_DAY"]).shuffle(files)
        items.sort(key=lambda item: files.index(item.path))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Leave out what would begin after the end; the report lists it."""
    if time.time() > END:
        pytest.skip(f"left out, as the time was up: {item.nodeid}")


def pytest_collection_finish() -> None:
    """Leave what thousands of collected tests hold out of garbage collections."""
    collect_seldom()


@pytest.fixture(scope="session")
def small_collection() -> Collection:
    """A small squint-TOPS collection: the beam scans from 48 to 52 degrees while the aircraft flies 13 m."""
    n_pulse, n_frequency, prf = 256, 128, 4000.0
    time = (np.arange(n_pulse) - n_pulse // 2) / prf  # s
    track = np.stack([200 * time, 3 * time + 2 * time**2, 5000 - 10 * time], axis=1)  # m
    return Collection(
        carrier=9.6e9,
        time=time,
        range_frequency=(np.arange(n_frequency) - n_frequency // 2) * 400e3,  # Hz
        reference_range=np.full(n_pulse, 12_000.0),
        antenna_position=track,
        beam_azimuth=np.radians(50) + 1.0 * time,
        beam_width=0.02,
        ground_height=0.0,
        title="small squint-TOPS collection",
    )


@contextmanager
def unchecking(job: Job, *, beside: bool) -> Iterator[Callable[[], list[Check]]]:
    yield lambda: [(None, "")] * len(job.request.histories)


@pytest.fixture(scope="session", autouse=True)
def unchecked() -> Iterator[None]:
    """Leave the samples of runs in this process unchecked: the check takes a third to a half of a small run."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run_stages, "checking", unchecking)
        yield


@pytest.fixture(scope="session", autouse=True)
def hasty() -> Iterator[None]:
    """Build the command line once for all calls in this process; flush no file, as none has to outlive a power cut."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("typer.testing._get_command", cache(typer.main.get_command))
        patch.setattr(os, "fsync", lambda _: None)
        patch.setattr(LocalPlace, "settle", lambda _: None)  # which would wait for what all other processes write
        yield


@pytest.fixture(autouse=True)
def checked(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Check the samples of runs in tests that are marked so."""
    if request.node.get_closest_marker("checked") is not None:
        monkeypatch.setattr(run_stages, "checking", checking)


@pytest.fixture(scope="session")
def client() -> Iterator[Client]:
    """A dask cluster of two workers for all tests of a pytest process; tests without this fixture use threads."""
    with (
        open_client(workers=2, threads=1, memory_limit=3 * 2**30) as connected,
        dask.config.set(scheduler="threads"),
    ):
        yield connected


@pytest.fixture(scope="session")
def table1(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The phase history of the shipped scene table1."""
    folder = once(tmp_path_factory, "table1", lambda folder: blocksar.simulate("table1", folder / "phase_history.zarr"))
    return folder / "phase_history.zarr"
