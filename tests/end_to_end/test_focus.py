"""End to end: scene file to measured image, against theory and against exact back-projection.

Tolerances are those of the project's quality bar, not the values that the chain happens to reach.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from distributed import Client
from quality_bar import check_targets, coarse_grid, planned
from scenes import GEOMETRIES, SMALL_SCAN, UNSTEERED_SCENE, one_target, scene, write_store

import blocksar
from blocksar import api, stores
from blocksar.errors import InputError
from blocksar.measurement.coherence import coherence
from blocksar.planning import planner
from blocksar.planning.planner import plan_collection
from blocksar.simulation.scene import Scene

CLUTTER = "[clutter]\nscatterers = 12000\nseed = 3\n"


@pytest.fixture(scope="module")
def clutter(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Phase history of clutter by name of the geometry, each simulated once."""
    return cache(lambda name: write_store(tmp_path_factory.mktemp("clutter"), **GEOMETRIES[name], more=CLUTTER))


# test_processors.py covers "scan reversed"; focusing/test_steps.py has lines of most geometries on small arrays.
@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in GEOMETRIES if name != "scan reversed"])
def test_clutter_is_coherent_with_back_projection(name: str, clutter: Callable[[str], Path], tmp_path: Path) -> None:
    store = clutter(name)
    blocksar.focus(store, tmp_path / "run", blocks=3, grid=coarse_grid(store), workers=0)
    quality = blocksar.quality(tmp_path / "run", reference=True).result
    chips = quality["reference"]
    # Chips differ from each other by 5e-4: they hold a few thousand resolution cells. Where fewer scatterers are lit
    # than the beam would hold, as at the ends of a scene, the ends of dwells lose less than predicted.
    assert abs(quality["least_coherence"]["measured"] - quality["least_coherence"]["predicted"]) < 0.0011
    assert len(chips) >= 15  # block centres, seams and swath ends, each at near, middle and far range
    for chip in chips:
        assert chip["coherence"] >= 0.998, chip
        assert chip["gain"] == pytest.approx(1.0, abs=0.02), chip
        assert abs(chip["phase"]) <= 0.02, chip


WOBBLE = """
[[track.wobble]]
amplitude = [0.03, 0.05, 0.02]
frequency = 2.3
phase_deg = [20.0, 60.0, 100.0]
[[track.wobble]]
amplitude = [0.0, 0.02, 0.03]
frequency = 4.2
"""


# planning/test_axis_beams.py has wobbling tracks on small arrays.
@pytest.mark.slow
@pytest.mark.parametrize("processor", ["angular-division", "keystone-resampling", "high-order-phase"])
def test_a_track_that_wobbles_is_coherent_with_back_projection(processor: Any, tmp_path: Path) -> None:
    """2 to 5 cm in all axes, which no polynomial follows; one correction for each pulse leaves 0.83."""
    store = write_store(tmp_path, swath=[29500.0, 30500.0], more=WOBBLE + CLUTTER)
    plan = planned(store, processor=processor)
    assert plan.geometry.track.wobble is not None
    # The steps in Doppler of the last smear the ends of dwells the most, which its plan says.
    least = 0.998 if processor == "high-order-phase" else 0.999
    assert plan.coherence >= least and (plan.faithful or processor == "high-order-phase")
    grid = coarse_grid(store)
    blocksar.focus(store, tmp_path / "run", blocks=plan.n_blocks, processor=processor, grid=grid, workers=0)
    measured, judged = blocksar.quality(tmp_path / "run", reference=True).result, 0
    assert measured["joint_coherence"] >= least
    for chip in measured["reference"]:
        # The range window is wider than the swath: beyond it is no clutter, only what its side lobes leave.
        if 29500 < float(plan.geometry.epoch_range(np.array(chip["x"]), np.array(chip["y"]))) < 30500:
            assert chip["coherence"] >= plan.coherence - 0.001, chip
            judged += 1
        assert chip["gain"] == pytest.approx(1.0, abs=0.02), chip
        assert abs(chip["phase"]) <= 0.02, chip
    assert judged >= 10


@pytest.mark.parametrize("name", ["table1", "35 GHz, 100 MHz"])
@pytest.mark.slow  # test_table1 measures range sub-blocks of a whole run
def test_range_sub_blocks_are_as_accurate_as_whole_blocks(
    name: str, clutter: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Compare clutter with back-projection in coherence, gain and phase, also across the range seams."""
    monkeypatch.setattr(planner, "plan_collection", lambda *a, **k: plan_collection(*a, **{**k, "parts": 3}))
    store = clutter(name)
    blocksar.focus(store, tmp_path / "run", blocks=2, grid=coarse_grid(store), workers=0)
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert [(b["block"], b["part"]) for b in record["plan"]["predicted"]] == [(b, p) for b in (0, 1) for p in (0, 1, 2)]
    chips = blocksar.quality(tmp_path / "run", reference=True).result["reference"]
    assert sum("range seam" in chip["place"] for chip in chips) >= 2
    for chip in chips:
        assert chip["coherence"] >= 0.996, chip
        assert chip["gain"] == pytest.approx(1.0, abs=0.02), chip
        assert abs(chip["phase"]) <= 0.02, chip


@pytest.mark.slow
def test_an_unsteered_beam_is_coherent_with_back_projection(tmp_path: Path) -> None:
    clutter = "[clutter]\nscatterers = 30000\nseed = 5\nx = [15306.0, 16906.0]\ny = [18394.0, 19994.0]\n"
    store = write_store(tmp_path, steering=None, prf=12e3, more=clutter)
    grid = ((15506.0, 16706.0, 3.0), (18594.0, 19794.0, 3.0))
    blocksar.focus(store, tmp_path / "run", blocks=3, grid=grid, workers=0)
    chips = blocksar.quality(tmp_path / "run", reference=True).result["reference"]
    assert min(chip["coherence"] for chip in chips) >= 0.995
    with pytest.raises(InputError, match="grid is missing"):
        blocksar.focus(store, tmp_path / "other", workers=0)


def test_a_range_window_as_narrow_as_the_interpolation_is_covered(tmp_path: Path) -> None:
    """Rows were cut at the end of the window of 45 m: no pixel of this grid was covered, and 1.0 was predicted."""
    text = UNSTEERED_SCENE.replace("swath = [7920.0, 8080.0]", "swath = [7980.0, 8020.0]")
    text = text.replace("centre_yaw_deg = 20.0", "centre_yaw_deg = 0.0")
    text = text.replace("ground_range_offset = 10.0, cross_range_offset = -15.0", "x = 6245.0, y = 0.0")
    (tmp_path / "scene.toml").write_text(text)
    store = blocksar.simulate(tmp_path / "scene.toml", tmp_path / "ph.zarr")
    grid = ((6235.0, 6255.0, 0.5), (-10.0, 10.0, 0.5))
    images = []
    for name, processor in (("run", "angular-division"), ("exact", "backprojection")):
        blocksar.focus(store, tmp_path / name, grid=grid, processor=processor, workers=0)
        images.append(stores.read_region(tmp_path / name / "image.zarr", "image", (slice(None), slice(None))))
    image, exact = images
    assert np.isfinite(exact).mean() > 0.95
    assert np.isfinite(image).mean() > 0.95 * np.isfinite(exact).mean()
    assert abs(coherence(image, exact).coherence) > 0.999
    assert abs(image[20, 20]) == pytest.approx(abs(exact[20, 20]), rel=0.01)


@pytest.mark.slow  # test_partial_pulses.py focuses raw echoes, test_axis_beams.py has pulses dropped
def test_raw_echo_with_dropped_pulses_is_focused(tmp_path: Path) -> None:
    more = (
        '[[targets]]\nname = "P"\nrange = 30000.0\nyaw_deg = 50.5\n'
        "[dropped]\nfraction = 0.05\nseed = 2\n[noise]\npower = 1e-4\nseed = 1\n"
    )
    (tmp_path / "scene.toml").write_text(scene(swath=[29800.0, 30200.0], more=more))
    store = blocksar.simulate(tmp_path / "scene.toml", tmp_path / "raw.zarr", raw=True)
    blocksar.focus(store, tmp_path / "run", blocks=2, workers=0)
    measured = blocksar.quality(tmp_path / "run", reference=True).result
    (target,), compared = measured["targets"], measured["reference"]
    # Randomly dropping 5 % of the pulses adds noise to the side lobes, and must not change the other figures.
    assert abs(complex(*target["value"])) == pytest.approx(1.0, abs=0.02)
    assert np.hypot(target["error_x"], target["error_y"]) <= 0.05
    assert target["azimuth_irw"] == pytest.approx(target["azimuth_irw_theory"], rel=0.01)
    assert not (tmp_path / "run" / "compressed.zarr").exists()
    # Away from the target there are only side lobes and noise. The chip on the seam, half a degree beside the target,
    # holds its far side lobes alone: they come from the ends of its dwell, which are a little smeared at a block's end.
    assert min(chip["coherence"] for chip in compared) > 0.9
    assert sorted(chip["coherence"] for chip in compared)[3] > 0.997


@pytest.mark.slow  # test_terrain.py measures targets of back-projection
def test_back_projection_processor_writes_the_same_store(tmp_path: Path) -> None:
    store = write_store(tmp_path, more='[[targets]]\nname = "P"\nrange = 30000.0\nyaw_deg = 50.5\n')
    made = Scene.read(tmp_path / "scene.toml")
    (point,) = made.point_targets()
    grid = ((point.x - 80, point.x + 80, 1.0), (point.y - 80, point.y + 80, 1.0))
    blocksar.focus(store, tmp_path / "fft", blocks=2, grid=grid, workers=0)
    blocksar.focus(store, tmp_path / "bp", processor="backprojection", grid=grid, workers=0)
    fft, bp = blocksar.open(tmp_path / "fft"), blocksar.open(tmp_path / "bp")
    assert fft.image.dims == bp.image.dims == ("y", "x")
    assert np.array_equal(fft.x, bp.x)
    a, b = fft.image.values, bp.image.values
    assert np.isfinite(a.real).all()
    assert abs(np.vdot(b, a)) / np.linalg.norm(a) / np.linalg.norm(b) >= 0.995
    check_targets(blocksar.quality(tmp_path / "bp").result, 1)
    check_targets(blocksar.quality(tmp_path / "fft").result, 1)


@pytest.mark.slow  # test_faults.py compares clusters of one and two workers, test_steps.py numbers of threads
def test_results_do_not_depend_on_workers_or_threads(client: Client, tmp_path: Path) -> None:
    store = write_store(tmp_path, swath=[29800.0, 30200.0], more=CLUTTER.replace("12000", "2000"))
    grid = coarse_grid(store, 8.0)
    sums = set()
    for workers, given in ((1, {"workers": 1, "threads": 3}), (2, {"client": client})):
        run = tmp_path / f"run-{workers}"
        blocksar.focus(store, run, blocks=3, grid=grid, **given)
        image = blocksar.open(run)
        sums.add((stores.checksum(image.image.values), stores.checksum(image.block.values)))
    assert len(sums) == 1


def test_a_dataset_is_accepted_and_returned(tmp_path: Path) -> None:
    grid = ((16000.0, 16200.0, 2.0), (19100.0, 19300.0, 2.0))
    with xr.open_zarr(one_target(tmp_path)) as source:
        blocksar.focus(source, tmp_path / "run", blocks=3, grid=grid, workers=0)
    image = blocksar.open(tmp_path / "run")
    assert image.image.dtype == np.complex64
    assert image.block.dtype == np.int16
    assert image.image.attrs["units"] == "1"
    assert image.x.attrs["long_name"]
    assert set(np.unique(image.block)) == {1}


@pytest.mark.slow  # bad_input/test_stores.py focuses stores of other programs
def test_a_phase_history_written_by_another_program_is_accepted(tmp_path: Path) -> None:
    """xarray writes the store with other chunks and compression; the image must be the same."""
    target = '[[targets]]\nname = "P"\nrange = 30000.0\nyaw_deg = 50.5\n'
    (tmp_path / "scene.toml").write_text(scene(**SMALL_SCAN, more=target))
    ours = blocksar.simulate(tmp_path / "scene.toml", tmp_path / "ours.zarr")
    with xr.open_zarr(ours) as source:
        chunks = {"signal": {"chunks": (700, 299)}}
        source.load().drop_encoding().to_zarr(
            tmp_path / "foreign.zarr", zarr_format=3, encoding=chunks, consolidated=False
        )
    grid = ((15800.0, 16200.0, 4.0), (19000.0, 19400.0, 4.0))
    images = []
    for name in ("ours", "foreign"):
        blocksar.focus(tmp_path / f"{name}.zarr", tmp_path / name, blocks=2, grid=grid, workers=0)
        images.append(blocksar.open(tmp_path / name).image.values)
    assert np.array_equal(images[0], images[1], equal_nan=True)


def test_the_api_has_the_names_of_the_commands() -> None:
    assert set(api.__all__) >= {"simulate", "plan", "focus", "quality", "open", "demo"}
