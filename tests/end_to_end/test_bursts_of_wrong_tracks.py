"""Bursts whose tracks are wrong, each in its own way: their images meet where they overlap."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from bursts import CENTRE, SLANT, STEP, ground, write_bursts

import blocksar
from blocksar import stores
from blocksar.arrays import FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.simulation.scene import Scene

pytestmark = pytest.mark.slow

RANDOM = np.random.default_rng(3)
TARGETS = [
    ground(SLANT + r, CENTRE + STEP * y)
    for r, y in zip(RANDOM.uniform(-130, 130, 200), RANDOM.uniform(-1.6, 1.6, 200), strict=True)
]
X, Y = np.array(TARGETS).T
GRID = ((X.min() - 30, X.max() + 30, 4.0), (Y.min() - 30, Y.max() + 30, 4.0))
SETTINGS: dict[str, Any] = {"grid": GRID, "blocks": 1, "autofocus": True, "workers": 0}


@pytest.fixture(scope="module")
def bursts(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two bursts; the track that is stated has errors of centimetres, others in each."""
    written = write_bursts(tmp_path_factory.mktemp("bursts"), TARGETS)[:2]
    for number, store in enumerate(written):
        random = np.random.default_rng(60 + number)
        positions = zarr.open_group(store, mode="r+")["antenna_position"]
        time = stores.open_phase_history(store).collection.time[:, None]
        drift, motion, turns = (
            random.normal(scale=0.03, size=3),
            random.normal(scale=0.01, size=3),
            random.uniform(0, 6),
        )
        positions[:] = positions[:] - drift * (time / 0.1) ** 2 - motion * np.sin(2 * np.pi * 2 * time + turns)
    return written


@pytest.fixture(scope="module")
def run(bursts: list[Path]) -> Path:
    folder = bursts[0].with_name("run")
    report = blocksar.focus(bursts, folder, **SETTINGS)
    lines = [line for line in report.summary if ": tied to " in line]
    assert [line.partition(": ")[0] for line in lines] == [str(bursts[1])]
    assert sum(": not told by the samples" in line for line in report.summary) == 1  # of the first
    return folder


def flown(store: Path) -> Collection:
    """The collection as it was flown."""
    return Scene.read(str(store.with_suffix(".toml"))).collection()


def shifts(collection: Collection, true: Collection, x: FloatArray, y: FloatArray) -> FloatArray:
    """By how much points (n,) are shifted in the image: to where range and its change over the dwell are the same."""
    geometry = Geometry(collection=true.centred())
    first, last = geometry.beam.longest_pass(x, y)
    found = []
    for px, py, a, b in zip(x, y, first, last, strict=True):
        pulses = np.array([a, (a + b) // 2, b - 1])

        def seen(at: Collection, qx: float, qy: float, pulses: Any = pulses) -> FloatArray:
            ranges = np.linalg.norm(at.antenna_position[pulses] - [qx, qy, 0.0], axis=1)
            return np.array([ranges[1], ranges[2] - ranges[0]])

        wanted, place = seen(true, px, py), np.array([px, py])
        for _ in range(5):
            here = seen(collection, *place)
            slopes = np.stack([seen(collection, *(place + step)) - here for step in np.eye(2)], axis=1)
            place = place + np.linalg.solve(slopes, wanted - here)
        found.append(place - [px, py])
    return np.array(found)


def seam(one: Collection, other: Collection, stores_: list[Path]) -> float:
    """By how much two images differ in place where both see all of a dwell, m, rms."""
    true = [flown(store) for store in stores_]
    lit = [np.subtract(*Geometry(collection=each.centred()).beam.longest_pass(X, Y)[::-1]) for each in true]
    both = (lit[0] >= lit[0].max() - 8) & (lit[1] >= lit[1].max() - 8)
    assert both.sum() >= 4
    between = shifts(one, true[0], X[both], Y[both]) - shifts(other, true[1], X[both], Y[both])
    return float(np.sqrt((between**2).sum(axis=1).mean()))


def test_images_meet_in_place(bursts: list[Path], run: Path, tmp_path: Path) -> None:
    blocksar.autofocus(bursts[1], tmp_path / "1.zarr", grid=GRID, workers=0)
    tied = [stores.read_collection(run / "segments" / f"{number}" / "collection.zarr")[0] for number in range(2)]
    apart = tied[0], stores.open_phase_history(tmp_path / "1.zarr").collection  # the first stays
    assert seam(*apart, bursts) > 3
    assert seam(*tied, bursts) < 0.3  # m: a twentieth of a cell
    # What moves an image as a whole does not blur it.
    for number, store in enumerate(bursts):
        wavenumber, true = 4 * np.pi / tied[number].wavelength, flown(store)
        first, last = Geometry(collection=true.centred()).beam.longest_pass(X, Y)
        bends = []
        for x, y, a, b in zip(X, Y, first, last, strict=True):
            if b - a > 350:
                sight = np.array([x, y, 0.0]) - true.antenna_position[a:b]
                sight /= np.linalg.norm(sight, axis=1, keepdims=True)
                wrong = (tied[number].antenna_position - true.antenna_position)[a:b]
                phase = wavenumber * (sight * wrong).sum(axis=1)
                at = np.linspace(-1, 1, phase.size)
                bends.append(np.std(phase - np.polyval(np.polyfit(at, phase, 1), at)))
        assert np.sqrt(np.mean(np.square(bends))) < 0.1
