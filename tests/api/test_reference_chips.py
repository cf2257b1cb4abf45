"""Which chips are judged beside exact back-projection."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from axis_beams import axis_collection, axis_scene

import blocksar
from blocksar.application.reference_chips import whole_geometry
from blocksar.collection.geometry import over_terrain
from blocksar.collection.terrain import Terrain
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.measurement.coherence import coherence


def test_the_power_of_a_chip_is_that_of_the_reference() -> None:
    exact = np.array([[1 + 1j, 2.0, np.nan]], np.complex64)
    assert coherence(2 * exact, exact).power == pytest.approx(3.0)
    assert coherence(np.zeros_like(exact), exact).power == pytest.approx(3.0)


def test_segments_on_a_terrain_are_compared_there() -> None:
    """They were back-projected on the plane: 0.0009 was said of an image whose coherence was 0.9996."""
    collection = axis_collection()
    terrain = Terrain.flat(120.0, (8500.0, 9500.0), (-500.0, 500.0))
    run = SimpleNamespace(segments=(over_terrain(collection, terrain),))
    found = whole_geometry(run, SimpleNamespace(collection=collection))  # type: ignore[arg-type]
    assert found.terrain is terrain
    assert found.collection.ground_height == 120.0


@pytest.mark.slow
@pytest.mark.parametrize(("rows", "compared"), [pytest.param(48, 9, marks=pytest.mark.slow), (12, 0)])
def test_a_small_part_of_what_a_block_owns_is_compared(tmp_path: Path, rows: int, compared: int) -> None:
    """The centre of the block and its seams lie beyond the image: nothing was compared, without a word."""
    clutter = "[clutter]\nscatterers = 300\nseed = 3\nx = [8600.0, 8750.0]\ny = [20.0, 90.0]"
    (tmp_path / "scene.toml").write_text(axis_scene('mode = "stripmap"\nwidth_deg = 0.7', more=clutter))
    store = blocksar.simulate(tmp_path / "scene.toml", tmp_path / "store.zarr", progress=False)
    grid = (8640.0, 8700.0, 1.2), (40.0, 40.0 + 0.6 * rows, 0.6)
    blocksar.focus(store, tmp_path / "run", grid=grid, blocks=1, workers=0, progress=False)
    report = blocksar.quality(tmp_path / "run", reference=True)
    assert len(report.result["reference"]) == compared
    assert any("nothing was compared" in line for line in report.summary) == (compared == 0)
    if compared:
        assert report.result["least_coherence"]["measured"] > 0.99


def one_point(*, n_pulse: int = 256, channels: tuple[str, ...] = ()) -> Any:
    """The phase history of one point, seen from the side."""
    time, f = (np.arange(n_pulse) - n_pulse // 2) / 400.0, (np.arange(64) - 32) * 1e6
    track = np.stack([0 * time - 8000.0, 120.0 * time, 0 * time + 5000.0], axis=1)
    reference = np.linalg.norm(track, axis=1)
    way = np.linalg.norm(track - [30.0, -24.0, 0.0], axis=1) - reference
    signal = np.exp(-4j * np.pi / SPEED_OF_LIGHT * np.outer(way, 10e9 + f)).astype(np.complex64)
    return blocksar.collection(
        signal=np.stack([signal] * len(channels)) if channels else signal, time=time, range_frequency=f,
        antenna_position=track, reference_range=reference, carrier_frequency=10e9,
        **({"channel": list(channels)} if channels else {}),
    )  # fmt: skip


@pytest.mark.parametrize("channels", [(), ("VV", "VH")])
def test_the_input_of_a_run_that_was_moved_with_it_is_found(channels: tuple[str, ...], tmp_path: Path) -> None:
    old, new = tmp_path / "old", tmp_path / "new"
    blocksar.write(one_point(channels=channels), old / "ph.zarr")
    grid = "-60:60:1,-60:60:1"
    blocksar.focus(old / "ph.zarr", old / "run", grid=grid, workers=0, progress=False)
    before = blocksar.quality(old / "run", reference=True)
    assert before.result["reference"][0]["coherence"] > 0.99
    chunk = next(file for file in sorted((old / "ph.zarr").rglob("signal/c/**/*")) if file.is_file())
    written = chunk.stat().st_mtime_ns
    os.utime(chunk, (1, 1))
    changed = blocksar.quality(old / "run", reference=True)
    assert changed.result["changed_input"] == [str(old / "ph.zarr")]
    assert any(f"{old / 'ph.zarr'} has changed since the run" in line for line in changed.summary)
    os.utime(chunk, ns=(written, written))
    shutil.move(old, new)
    after = blocksar.quality(new / "run", reference=True)
    assert after.result["reference"] == before.result["reference"] and "changed_input" not in after.result
    assert f"its samples are those of {new / 'ph.zarr'}" in after.summary
    (tmp_path / "elsewhere").mkdir()
    shutil.move(new / "ph.zarr", tmp_path / "elsewhere" / "other.zarr")
    with pytest.raises(InputError, match=r"old.ph\.zarr, which .* does not exist, nor does ph\.zarr beside"):
        blocksar.quality(new / "run", reference=True)
    told = blocksar.quality(new / "run", reference=True, source=tmp_path / "elsewhere" / "other.zarr")
    assert told.result["reference"] == before.result["reference"]
    blocksar.write(one_point(n_pulse=200, channels=channels), new / "ph.zarr")
    with pytest.raises(InputError, match=r"has 200 pulses of 64 range frequencies, and .* from 256 of 64; give"):
        blocksar.quality(new / "run", reference=True)
