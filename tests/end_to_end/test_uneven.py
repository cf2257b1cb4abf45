"""Uneven pulses and range frequencies from the arrays to the measured image, and what others say of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sicd_files import read_sicd

import blocksar
from blocksar import stores
from blocksar.constants import SPEED_OF_LIGHT

N, STEP, CARRIER, GRID = 200, 1 / 750.0, 10e9, "-45:105:0.75,-84:36:0.75"
EVEN, BAND = (np.arange(N) - N / 2) * STEP, (np.arange(96) - 48) * 0.5e6
STAGGERED = np.cumsum(np.tile([0.85, 1.15], N)[:N]) * STEP - N / 2 * STEP
GAPPED = np.delete(BAND, np.arange(36, 48))


def history(time: np.ndarray, band: np.ndarray) -> Any:
    track = np.stack([0 * time - 8000.0, 240.0 * time, 0 * time + 5000.0], axis=1)
    reference = np.linalg.norm(track, axis=1)
    away = np.linalg.norm(track - [30.0, -24.0, 0.0], axis=1) - reference
    signal = np.exp(-4j * np.pi / SPEED_OF_LIGHT * np.outer(away, CARRIER + band)).astype(np.complex64)
    return blocksar.collection(
        signal=signal, time=time, range_frequency=band, antenna_position=track, reference_range=reference,
        carrier_frequency=CARRIER, georeference={"kind": "ENU", "latitude": 40.0, "longitude": 9.0, "height": 0.0},
        targets=[{"name": "A", "x": 30.0, "y": -24.0, "reflectivity": 1.0}],
    )  # fmt: skip


def focus(source: Any, out: Path) -> Any:
    return blocksar.focus(source, out, grid=GRID, workers=0, progress=False)


@pytest.fixture(scope="module")
def uneven(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any]:
    path = tmp_path_factory.mktemp("uneven")
    blocksar.write(history(STAGGERED, GAPPED), path / "ph.zarr")
    return path / "ph.zarr", focus(path / "ph.zarr", path / "run")


def test_the_store_keeps_its_axes(uneven: tuple[Path, Any]) -> None:
    read = stores.open_phase_history(uneven[0]).collection
    np.testing.assert_array_equal(read.time, STAGGERED)
    np.testing.assert_array_equal(read.range_frequency, GAPPED)
    facts = {row[0]: row[1] for row in blocksar.info(uneven[0]).tables[0][1]}
    assert "on average, pulses 1.133 .. 1.533 ms apart" in facts["pulses"]
    assert "84 range frequencies, 12 cut out: cells of 3.12 m" in facts["band"]


def test_auto_takes_exact_back_projection_and_says_why(uneven: tuple[Path, Any]) -> None:
    path, run = uneven
    plan = blocksar.plan(path, grid=GRID, workers=0)
    assert plan.plan is not None and plan.plan.processor == "backprojection"
    assert "angular-division cannot: time is not uniform: index 1 lies 0.149 steps" in plan.summary[0]
    assert abs(run.open()["image"].sel(x=30.0, y=-24.0).item() - 1) < 2e-3


def test_quality_compares_with_the_collection_as_it_is(uneven: tuple[Path, Any]) -> None:
    figures = blocksar.quality(uneven[0].parent / "run").result["targets"][0]
    for cut in ("range", "azimuth"):
        assert figures[f"{cut}_pslr"] == pytest.approx(figures[f"{cut}_pslr_theory"], abs=0.2)
        assert figures[f"{cut}_irw"] == pytest.approx(figures[f"{cut}_irw_theory"], rel=0.01)
    assert figures["range_pslr"] > -11  # the gap's


def test_rows_of_nan_are_named_first_and_serve(tmp_path: Path) -> None:
    rows = np.arange(80, 90)
    with pytest.raises(blocksar.InputError, match=r"10 values .* after index 79; write rows of NaN there, or t"):
        blocksar.plan(history(np.delete(EVEN, rows), BAND), grid=GRID, processor="angular-division", workers=0)
    whole = history(EVEN, BAND)
    whole["signal"][rows] = np.nan
    assert blocksar.plan(whole, grid=GRID, processor="angular-division", workers=0).refusal is None


@pytest.mark.parametrize("processor", ["high-order-phase", "hierarchical-backprojection"])
def test_others_refuse_in_one_sentence(processor: Any, uneven: tuple[Path, Any], tmp_path: Path) -> None:
    with pytest.raises(blocksar.InputError, match=r"needs uniform pulses .* take processor backprojection or auto"):
        blocksar.focus(uneven[0], tmp_path / "no", grid=GRID, processor=processor, workers=0, progress=False)
    with pytest.raises(blocksar.InputError, match=r"autofocus needs uniform pulses .*; take the track as it is"):
        blocksar.autofocus(uneven[0], tmp_path / "no.zarr", grid=GRID, workers=0, progress=False)
    assert not list(tmp_path.iterdir())


def test_a_sicd_states_no_polynomial_of_uneven_pulses(uneven: tuple[Path, Any], tmp_path: Path) -> None:
    blocksar.export("sicd", uneven[0].parent / "run", tmp_path / "a.nitf")
    timeline = read_sicd(tmp_path / "a.nitf").tree.find(".//{*}Timeline")
    assert timeline is not None and timeline.find("{*}IPP") is None
    duration = float(timeline.findtext("{*}CollectDuration") or "nan")
    assert duration == pytest.approx(STAGGERED[-1] - STAGGERED[0] + STEP, rel=1e-3)


def test_a_check_trusts_the_samples(uneven: tuple[Path, Any]) -> None:
    assert blocksar.check(uneven[0], grid=GRID).result["warning"] is None
