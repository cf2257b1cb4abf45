"""Several collections in one run: three bursts that are flown one after another, and one mosaic."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from bursts import CENTRE, SLANT, STEP, ground, write_bursts

import blocksar
from blocksar import stores
from blocksar.arrays import ComplexArray
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.errors import InputError
from blocksar.measurement.coherence import coherence
from blocksar.measurement.targets import Target
from blocksar.processors.chain.planning.strip_segments import plan_segments
from blocksar.processors.chain.tasks import stages
from blocksar.processors.exact.sums import form_image

DX, DY = 3.0, 3.0
YAWS = CENTRE + STEP * np.array([-1.3, -1.0, -0.7, -0.52, -0.48, -0.1, 0.1, 0.48, 0.52, 1.0, 1.3])


def on_grid(x: float, y: float) -> tuple[float, float]:
    return round(x / DX) * DX, round(y / DY) * DY


TARGETS = [on_grid(*ground(SLANT + 30 * (-1) ** i, yaw)) for i, yaw in enumerate(YAWS)]
GRID = (
    (min(x for x, _ in TARGETS) - 90, max(x for x, _ in TARGETS) + 90, DX),
    (min(y for _, y in TARGETS) - 60, max(y for _, y in TARGETS) + 60, DY),
)
SETTINGS: dict[str, Any] = {"grid": GRID, "blocks": 1}


@pytest.fixture(scope="module")
def bursts(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return write_bursts(tmp_path_factory.mktemp("bursts"), TARGETS)


@pytest.fixture(scope="module")
def run(bursts: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("together") / "run"
    blocksar.focus(bursts, folder, **SETTINGS, workers=0)
    return folder


def exact(store: Path, x: Any, y: Any) -> tuple[ComplexArray, Any]:
    """Back-projection of a burst, zero where it is not lit; and the number of pulses that light each pixel."""
    history = stores.open_phase_history(store)
    geometry = Geometry(collection=history.collection.centred())
    image = form_image(lambda pulses: history.read(pulses, slice(None)), geometry, x, y, threads=1)
    first, last = geometry.beam.longest_pass(*np.meshgrid(x, y))
    return np.nan_to_num(image), last - first


def test_the_mosaic_has_no_seam(run: Path, bursts: list[Path]) -> None:
    image = blocksar.open(run)
    collection, block = image.collection.values, image.block.values
    assert set(np.unique(collection)) == {-1, 0, 1, 2}
    np.testing.assert_array_equal(np.isfinite(image.image.values.real), collection >= 0)
    np.testing.assert_array_equal(collection, block)  # one block each, numbered over all
    geometries = [Geometry(collection=stores.open_phase_history(store).collection.centred()) for store in bursts]
    owners, full = [], []
    for x, y in TARGETS:
        pixel = image.sel(x=x, y=y)
        margins = [float(geometry.beam.margin(np.array(x), np.array(y))) for geometry in geometries]
        owners.append(int(pixel.collection))
        assert owners[-1] == int(np.argmax(margins))
        full.append(max(margins) >= 0)
        value = complex(pixel.image)
        assert abs(20 * np.log10(abs(value))) < 0.1 and abs(np.angle(value)) < 0.05
    assert owners == sorted(owners) and set(owners) == {0, 1, 2} and np.mean(full) > 0.7


def test_it_is_the_back_projection_of_all_pulses(run: Path, bursts: list[Path]) -> None:
    """Where only one burst lit the ground; elsewhere that of the burst which a pixel comes from."""
    image = blocksar.open(run)
    alone = 0
    for x, y in TARGETS:
        chip = image.sel(x=slice(x - 45, x + 45), y=slice(y - 30, y + 30))
        several = [exact(store, chip.x.values, chip.y.values) for store in bursts]
        lit = np.array([count for _, count in several])
        total = sum(one * count for one, count in several) / np.maximum(lit.sum(axis=0), 1)
        own = np.take_along_axis(np.array([one for one, _ in several]), chip.collection.values[None], axis=0)[0]
        full = np.take_along_axis(lit, chip.collection.values[None], axis=0)[0] >= lit.max() - 1
        assert abs(coherence(np.where(full, chip.image.values, np.nan), own).coherence) > 0.999 or not full.any()
        once = (lit > 0).sum(axis=0) == 1
        if (once & full).mean() > 0.5:
            alone += 1
            assert abs(coherence(np.where(once & full, chip.image.values, np.nan), total).coherence) > 0.999
    assert alone >= 3


@pytest.mark.slow
def test_a_collection_is_focused_as_by_itself(run: Path, bursts: list[Path], tmp_path: Path) -> None:
    blocksar.focus(bursts[1], tmp_path / "alone", **SETTINGS, workers=0)
    together, alone = blocksar.open(run), blocksar.open(tmp_path / "alone")
    assert alone.image.dtype == np.complex64 and alone.block.dtype == np.int16
    assert alone.image.attrs["units"] == "1" and alone.x.attrs["long_name"]
    assert "collection" not in alone and not (tmp_path / "alone" / "segments").exists()
    owned = together.collection.values == 1
    np.testing.assert_array_equal(together.image.values[owned], alone.image.values[owned])


@pytest.mark.slow
def test_an_interrupted_run_resumes_to_the_same_bytes(
    run: Path, bursts: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: Any, **__: Any) -> Any:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(stages, "mosaic", interrupted)
        blocksar.focus(bursts, tmp_path / "run", **SETTINGS, workers=0)
    report = blocksar.focus(bursts, tmp_path / "run", **SETTINGS, workers=0)
    assert "3 of 3 column groups, 3 of 3 blocks," in report.summary[0]
    for variable in ("image", "block", "collection"):
        for chunk in (run / "image.zarr" / variable / "c").rglob("*"):
            if chunk.is_file():
                same = tmp_path / "run" / chunk.relative_to(run)
                assert same.read_bytes() == chunk.read_bytes()
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert [segment["path"] for segment in record["segments"]] == list(map(str, bursts))
    assert [segment["first_block"] for segment in record["segments"]] == [0, 1, 2]
    assert not (tmp_path / "run" / "receipts").exists()


def test_a_change_of_any_collection_is_noticed(run: Path, bursts: list[Path], tmp_path: Path) -> None:
    assert "nothing to do" in blocksar.focus(bursts, run, **SETTINGS, workers=0).summary[0]
    changed = [*bursts[:2], Path(shutil.copytree(bursts[2], tmp_path / "burst2.zarr"))]
    zarr.open_group(changed[2], mode="r+")["reference_range"][0] += 1e-3
    with pytest.raises(InputError, match=r"another input, not what is asked for now"):
        blocksar.focus(changed, run, **SETTINGS, workers=0)
    with pytest.raises(InputError, match=r"another input"):
        blocksar.focus(bursts[:2], run, **SETTINGS, workers=0)


@pytest.mark.slow
def test_products_know_the_collections(run: Path, bursts: list[Path], tmp_path: Path) -> None:
    two = [Target(f"P{i}", *TARGETS[i]) for i in (3, 4)]
    result = blocksar.quality(run, reference=True, targets=two).result
    assert {chip["place"].split(",")[0] for chip in result["reference"]} == {f"segment {i}" for i in range(3)}
    assert "changed_input" not in result
    report = blocksar.quality(run)
    figures = {target["name"]: target for target in report.result["targets"]}
    assert sum(target["full_dwell"] for target in figures.values()) > 7
    image = blocksar.open(run)
    for target in figures.values():  # where another burst's pixels lie within its response, it is not judged
        around = image.sel(x=slice(target["x"] - 20, target["x"] + 20), y=slice(target["y"] - 20, target["y"] + 20))
        assert not target["covered"] or len(np.unique(around.collection.values)) == 1
        assert target["error_x"] is None or np.hypot(target["error_x"], target["error_y"]) < 0.1
    assert any("within 10 widths of a seam between collections" in line for line in report.summary)
    blocksar.report(run)
    page = (run / "report.html").read_text()
    assert "<h1>burst 0 and 2 more</h1>" in page
    assert all(f"{i}: {store}, blocks {i} .. {i}" in page for i, store in enumerate(bursts))
    assert " ".join(map(str, bursts)) in page  # the command that repeats the run
    blocksar.export("png", run, tmp_path / "image.png")


def test_a_refusal_says_which_collection_it_is_about(bursts: list[Path]) -> None:
    def refuse(*_: Any, **__: Any) -> Any:
        raise InputError("PRF is too low")

    collections = [stores.open_phase_history(store).collection for store in bursts]
    with pytest.raises(InputError, match=r"^collection 0 \(burst 0\): PRF is too low$"):
        plan_segments(refuse, collections, grid=Grid(*GRID[0], *GRID[1]))
    with pytest.raises(InputError, match=r"^PRF is too low$"):
        plan_segments(refuse, collections[:1], grid=Grid(*GRID[0], *GRID[1]))


@pytest.mark.slow
def test_several_collections_are_planned(bursts: list[Path]) -> None:
    report = blocksar.plan(bursts, **SETTINGS)
    assert len(report.result) == 3 and [row[0] for row in report.tables[0][1]] == ["0", "1", "2"]
    report = blocksar.plan(bursts, blocks=1)
    grids = [plan.grid for plan in report.result]
    assert grids[0] == grids[1] == grids[2]
    one = blocksar.plan(bursts[0], blocks=1).result.grid
    assert grids[0].dx == one.dx and grids[0].x0 <= one.x0 and grids[0].x1 >= one.x1
    assert len(blocksar.plan(bursts, processor="auto").plan.pieces) == 3


def test_collections_of_several_frames_are_refused(bursts: list[Path], tmp_path: Path) -> None:
    other = Path(shutil.copytree(bursts[0], tmp_path / "other.zarr"))
    zarr.open_group(other, mode="r+").attrs["frame"] = "elsewhere"
    with pytest.raises(InputError, match=r"'elsewhere'.*give both the same georeference, or an attribute frame"):
        blocksar.focus([bursts[1], other], tmp_path / "run", **SETTINGS)
    zarr.open_group(other, mode="r+").attrs.update(frame="strip", ground_height=3.0)
    with pytest.raises(InputError, match=r"ground_height is 0 m .* and 3 m"):
        blocksar.focus([bursts[1], other], tmp_path / "run", **SETTINGS)
    zarr.open_group(other, mode="r+").attrs.update(ground_height=0.0, carrier_frequency=9.9e9)
    with pytest.raises(InputError, match=r"carrier_frequency is .* Hz in .*, but one image has one carrier"):
        blocksar.focus([bursts[1], other], tmp_path / "run", **SETTINGS)
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_a_collection_outside_the_grid_is_left_out(bursts: list[Path], tmp_path: Path) -> None:
    x, y = TARGETS[0]
    grid = ((x - 60, x + 60, DX), (y - 40, y + 40, DY))
    report = blocksar.focus([bursts[2], bursts[0]], tmp_path / "run", grid=grid, blocks=1, workers=0)
    assert report.result["warnings"] == [f"{bursts[2]} covers nothing of the grid"]
    assert set(np.unique(blocksar.open(tmp_path / "run").collection.values)) <= {-1, 1}
    with pytest.raises(InputError, match="lies outside the swath"):
        blocksar.focus(bursts[1:], tmp_path / "none", grid=((0.0, 10.0, 1.0), (0.0, 10.0, 1.0)), blocks=1)


def test_exact_back_projection_merges_them_alike(run: Path, bursts: list[Path], tmp_path: Path) -> None:
    x, y = TARGETS[3]  # 15 m from a seam
    grid = ((x - 60, x + 60, DX), (y - 42, y + 42, DY))
    blocksar.focus(bursts, tmp_path / "exact", grid=grid, processor="backprojection", workers=0)
    found = blocksar.open(tmp_path / "exact")
    wanted = blocksar.open(run).sel(x=found.x, y=found.y, method="nearest")
    assert len(np.unique(found.collection.values)) >= 2
    assert np.mean(found.collection.values == wanted.collection.values) > 0.98  # margins are interpolated over a chunk
    assert abs(coherence(wanted.image.values, found.image.values).coherence) > 0.999
