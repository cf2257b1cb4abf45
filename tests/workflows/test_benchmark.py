"""The benchmark on a scene of a few seconds: the correctness of its measurements, not their values."""

from __future__ import annotations

import json
import math
import shutil
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from repository import WORKFLOWS
from scenes import scene

import blocksar
from blocksar import stores
from blocksar.errors import InputError
from blocksar.processors.chain.planning.plan import Plan
from blocksar.processors.exact.sums import form_points
from blocksar.simulation.scene import Scene

SMALL = {"duration": 0.15, "steering": (48.0, 52.0), "swath": [29900.0, 30100.0]}
SIDE = 64  # pixels per side of the peer's chip
CLUTTER = "[clutter]\nscatterers = 2000\nseed = 3\n"


@pytest.fixture(scope="module")
def benchmark() -> Any:
    """The script as a module, on the import path so that workers find it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(WORKFLOWS))
        import benchmark
        from benchmarks import (
            back_projection,
            bench,
            floors,
            folders,
            guard,
            other_version,
            processor_page,
            processors,
            scenes,
            scheduling,
            tables,
        )

        parts = (
            back_projection, bench, floors, folders, guard, other_version, processor_page, processors, scenes,
            scheduling, tables,
        )  # fmt: skip
        yield SimpleNamespace(
            main=benchmark.main, **{part.__name__.removeprefix("benchmarks."): part for part in parts}
        )


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "small.toml"
    path.write_text(scene(**SMALL, more=CLUTTER))
    return path


def every_number(value: Any, name: str = "") -> list[tuple[str, float]]:
    if isinstance(value, dict):
        return [found for key, item in value.items() for found in every_number(item, f"{name}.{key}")]
    if isinstance(value, list):
        return [found for item in value for found in every_number(item, name)]
    return [(name, value)] if isinstance(value, int | float) else []


@pytest.mark.timeout(1800)  # two clusters are started and warmed up
@pytest.mark.slow
def test_a_benchmark_measures_every_quantity(
    benchmark: Any, small: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(benchmark.folders, "SETTLING", 0.1)  # s
    # Another Python that imports this working tree, not an installed version.
    python, root = small.with_name("python"), WORKFLOWS.parent
    python.write_text(f'#!/bin/sh\nPYTHONPATH="{root}" exec "{sys.executable}" "$@"\n')
    python.chmod(0o755)
    benchmark.main(
        scene=str(small), scale="1x1", repeats=1, workers=2, blocks="auto", memory_limit="3GiB",
        out=tmp_path, json_file=tmp_path / "result.json", speedup=True, starts=True, guard=None, peer=True, keep=False,
        against=str(python), cost_against_error=None, peers=None,
    )  # fmt: skip
    assert [path.name for path in tmp_path.iterdir()] == ["result.json"]
    result = json.loads((tmp_path / "result.json").read_text())
    found = result["scenes"]["1x1"]
    assert set(found["ratios"]) == set(benchmark.tables.RATIOS)
    for name, ratio in every_number(found["ratios"]):
        assert math.isfinite(ratio) and ratio > 0, name
    seconds = found["seconds"]
    assert set(seconds["stages"]) == {
        "plan", "recover", "check", "focus", "mosaic", "stores and receipts", "finish",
    }  # fmt: skip
    plan = blocksar.plan(small, blocks=2).result
    steps = {part for name in seconds["steps_summed_over_workers"] for part in name.split("+")}
    chain = {step.name for block in plan.blocks for step in block.chain}
    assert chain < steps  # steps also contain reading the slab and the geometric correction
    assert set(seconds["fft_floor_summed_over_workers"]) == {made.stage for made in plan.transforms()}
    assert {"read input", "write spectrum", "read spectrum", "write image"} <= set(seconds["io_floor_by_kind"])
    for name, value in every_number(seconds):
        assert math.isfinite(value) and value >= 0, name
    assert len(found["memory"]["peak_by_worker_bytes"]) == 2
    assert found["coherence"]["min"] > 0.99
    assert found["other_version"] == {"python": str(python), "version": blocksar.__version__}
    assert len(seconds["end_to_end_other_version"]["runs"]) == 1
    assert result["machine"]["cores"] >= 1
    assert result["versions"]["blocksar"] == blocksar.__version__
    printed = capsys.readouterr().out
    assert all(label in printed for label in benchmark.tables.RATIOS.values())
    assert max(map(len, printed.splitlines())) <= benchmark.tables.WIDTH


@pytest.mark.parametrize(
    ("python", "reason"), [("/no/such/python", "cannot be run"), (shutil.which("false"), "cannot start blocksar")]
)
def test_a_python_without_blocksar_is_refused(benchmark: Any, python: str, reason: str) -> None:
    other = benchmark.other_version.other_version(python, workers=1, threads=1, memory_limit=2**30)
    with pytest.raises(InputError, match=reason), other:
        pass


@pytest.mark.parametrize("source", ["table1", "small"])
def test_a_scaled_scene_keeps_dwell_and_resolution(benchmark: Any, source: str, small: Path) -> None:
    scenes = benchmark.scenes
    tables = scenes.scene_tables(str(small) if source == "small" else source)
    first, wide = (Scene.parse(scenes.as_toml(scenes.scaled(tables, scenes.Scale(a, b)))) for a, b in ((1, 1), (3, 2)))
    assert wide.beam_width_deg == pytest.approx(first.beam_width_deg)
    assert wide.radar == first.radar
    assert wide.n_pulse == 2 * first.n_pulse
    assert np.diff(wide.beam_azimuth)[0] == pytest.approx(np.diff(first.beam_azimuth)[0])
    assert np.ptp(wide.area.swath) == pytest.approx(3 * np.ptp(first.area.swath))
    assert sum(wide.area.swath) == pytest.approx(sum(first.area.swath))


def test_scene_tables_survive_a_toml_round_trip(benchmark: Any) -> None:
    tables = {
        "title": "t", "track": {"position": [0.0, 1.0, 2e3]}, "matrix": {"rows": 2, "names": {"A1": [0, 0]}},
        "targets": [{"name": "P", "x": 1.5, "y": -2.0}, {"name": "Q", "x": 1e-7, "y": 3.0}],
    }  # fmt: skip
    assert tomllib.loads(benchmark.scenes.as_toml(tables)) == tables


@pytest.mark.slow
def test_the_prf_is_raised_only_as_far_as_needed(benchmark: Any) -> None:
    case = benchmark.scenes.plan_case(
        "table1", benchmark.scenes.Scale(1, 1.5), blocks=3, workers=2, memory_limit=8 * 2**30
    )
    band = np.ptp(case.plan.recovery.band)
    assert band < case.scene.radar.prf
    if case.scene.radar.prf > 8e3:
        assert case.scene.radar.prf < 1.02 * band
        assert "PRF 8000 Hz raised" in case.notes[0]


@pytest.mark.parametrize("text", ["2", "2x", "0x1", "axb", "1x-1", "1.2.3x1"])
def test_a_wrong_scale_is_refused(benchmark: Any, text: str) -> None:
    with pytest.raises(InputError, match="give pairs such as"):
        benchmark.scenes.Scale.parse(text)


@pytest.mark.slow
def test_a_hard_linked_file_counts_as_written_once(benchmark: Any, collected: Any, tmp_path: Path) -> None:
    history, plan, *_ = collected
    patch, image = tmp_path / "patches" / "0" / "image" / "c", tmp_path / "image.zarr" / "image" / "c"
    for folder in (patch, image):
        folder.mkdir(parents=True)
    (patch / "0").write_bytes(bytes(1000))
    (patch / "1").write_bytes(bytes(1000))
    (image / "0").hardlink_to(patch / "0")
    (image / "1").write_bytes(bytes(600))
    found = {kind.name: kind for kind in benchmark.floors.traffic_of(Path(history.path), tmp_path, plan)}
    assert set(found) == {"input", "patches", "image"}
    assert (found["patches"].written, found["patches"].read) == (2000, 1000)  # the mosaic reads what is not shared
    assert (found["image"].written, found["image"].read) == (600, 0)
    assert found["input"].read == 8 * np.prod(history.shape)


# ---------------------------------------------------------------- peer


@pytest.fixture(scope="module")
def collected(benchmark: Any, small: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A phase history, its plan, one chip in the middle of its image, and the exact pixels of the chip."""
    store = blocksar.simulate(small, tmp_path_factory.mktemp("peer") / "phase_history.zarr")
    plan = blocksar.plan(store, blocks=1).result
    assert isinstance(plan, Plan)
    x, y, _ = plan.geometry.ground_point(np.array(30e3), np.radians(50.0))
    mesh = np.meshgrid(float(x) + np.arange(SIDE) * plan.grid.dx, float(y) + np.arange(SIDE) * plan.grid.dy)
    history = stores.open_phase_history(store)
    chips = benchmark.back_projection.Chips(["middle"], [], *mesh)
    exact = form_points(lambda pulses: history.read(pulses, slice(None)), plan.geometry, *mesh, threads=1)
    return history, plan, chips, exact


def test_a_missing_peer_is_reported_as_not_installed(
    benchmark: Any, collected: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "torchbp", None)
    monkeypatch.setitem(sys.modules, "torch", None)
    found = benchmark.back_projection.run_peer(*collected, 1)
    assert (found["name"], found["status"]) == ("torchbp", "not installed")
    assert "not installed" in benchmark.tables.peer_line(found)


@pytest.mark.slow
def test_processors_are_compared_by_processor_time_and_error(
    benchmark: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On one small scene: the page has what was measured, and why a package is not there."""
    processors = benchmark.processors
    spotlight = processors.SCENES["spotlight"]._replace(half=20.0)
    monkeypatch.setattr(processors, "SCENES", {"spotlight": spotlight})
    monkeypatch.setattr(processors, "_asked", lambda: iter([("hierarchical-backprojection", 0.999)]))
    monkeypatch.setattr(blocksar, "compile", lambda: None)
    result = processors.compare_processors(tmp_path, repeats=1, peers=None)
    exact, row = result["scenes"]["spotlight"]["rows"]
    assert exact.error is None and row.processor == "hierarchical-backprojection"
    assert 0 < row.error < 1e-3 and row.coherence == pytest.approx(1 - row.error / 2, abs=1e-3)
    benchmark.processor_page.write_page(result, tmp_path / "page.md")
    page = (tmp_path / "page.md").read_text(encoding="utf-8")
    assert f"| 0.999 | {row.coherence:.6f} | {10 * math.log10(row.error):.1f} | {row.seconds:.1f} |" in page
    assert "`fastsar`: not run; --peers names a Python" in page
    assert (tmp_path / "cost_against_error.png").stat().st_size > 5000
    image = np.array([[1 + 1j, np.nan], [2, 3]], np.complex64)
    assert processors._error(image * np.float32(1.1), image) == pytest.approx((1.0, 0.01))
    with pytest.raises(InputError, match=r"--peers \S*nowhere: No such file.*; give the path of a Python"):
        processors._peers(str(tmp_path / "nowhere"), tmp_path / "spotlight.zarr", image, tmp_path)
    with pytest.raises(InputError, match=r"No module named 'fastsar'; give the path"):
        processors._peers(sys.executable, tmp_path / "spotlight.zarr", image, tmp_path)


def test_ratios_are_compared_with_their_bounds(benchmark: Any, tmp_path: Path) -> None:
    guard = benchmark.guard
    bounds = guard.read_bounds(guard.BOUNDS)
    assert set(bounds) <= set(benchmark.tables.RATIOS)
    scenes = {"1x1": {"ratios": {name: {"median": next(iter(bound.values()))} for name, bound in bounds.items()}}}
    assert guard.violations(scenes, bounds) == []
    one = next(iter(bounds))
    scenes["1x1"]["ratios"][one]["median"] *= 1.01 if "at_most" in bounds[one] else 0.99
    assert len(guard.violations(scenes, bounds)) == 1
    del scenes["1x1"]["ratios"][one]
    assert guard.violations(scenes, bounds) == [f"{one} was not measured"]
    for text in ("", "[]", '{"a": {}}', '{"a": {"at_most": "b"}}', '{"a": {"most": 1}}'):
        (tmp_path / "bounds.json").write_text(text)
        with pytest.raises(InputError, match="--guard"):
            guard.read_bounds(tmp_path / "bounds.json")
