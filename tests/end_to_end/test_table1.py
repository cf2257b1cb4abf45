"""Full Table 1 scene of the angular-division paper: 81 targets, the paper's comparison and memory limits."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from quality_bar import MARGIN, check_targets, planned
from repository import ROOT

import blocksar
from blocksar.errors import InputError
from blocksar.processors.chain.planning.written_bytes import run_bytes
from blocksar.runs import demonstration

EDGES = ("A1", "A3", "B1", "B3", "C1", "C3")


def middle_strip(table1: Path) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """The default grid's middle sixth in y."""
    grid = planned(table1, blocks=3).grid
    middle, half = (grid.y0 + grid.y1) / 2, (grid.y1 - grid.y0) / 12
    return (grid.x0, grid.x1, grid.dx), (middle - half, middle + half, grid.dy)


@pytest.fixture(scope="module")
def run(table1: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with three blocks, as proposed in the paper, on the middle strip."""
    run = tmp_path_factory.mktemp("proposed") / "run"
    blocksar.focus(table1, run, blocks=3, workers=0, grid=middle_strip(table1))
    return run


def inside_strip(run: Path, table1: Path) -> dict[str, Any]:
    """Quality of a run on the middle strip, of the targets well inside it."""
    low, high, _ = middle_strip(table1)[1]
    found = dict(blocksar.quality(run).result)
    return found | {"targets": [t for t in found["targets"] if low + MARGIN <= t["y"] <= high - MARGIN]}


def test_a_run_takes_the_room_that_was_planned(run: Path, table1: Path) -> None:
    predicted = run_bytes(planned(table1, blocks=3, grid=middle_strip(table1)))
    files = [path for path in run.rglob("*") if path.is_file()]
    written = {path.stat().st_ino: path.stat().st_size for path in files}  # hard links share their storage
    assert sum(written.values()) == pytest.approx(sum(predicted.values()), rel=0.02)
    # What only one block touches is stored once.
    merged = [path for path in (run / "image.zarr" / "image").rglob("c/*/*") if path.stat().st_nlink == 1]
    assert sum(path.stat().st_size for path in merged) == pytest.approx(predicted["image"], rel=0.1)


@pytest.mark.slow
def test_a_demonstration_takes_600_megabytes_at_most(table1: Path) -> None:
    """While it runs: phase history, spectrum and patches, before the spectrum is removed and chunks are merged."""
    room = run_bytes(planned(table1, blocks=demonstration.BLOCKS, grid=demonstration.GRID))
    history = sum(path.stat().st_size for path in table1.rglob("*") if path.is_file())
    assert history + room["spectrum"] + room["patches"] < 0.59e9
    assert history + room["patches"] + room["image"] < 0.4e9
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert "leaves 0.3 GB in `demo-run` and takes 0.6 GB while it runs" in text


@pytest.mark.slow
def test_a_low_memory_limit_divides_blocks_in_range_and_is_kept(table1: Path, tmp_path: Path) -> None:
    limit = 520 * 2**20
    blocksar.focus(table1, tmp_path / "run", blocks=2, workers=2, memory_limit=limit, grid=middle_strip(table1))
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert record["plan"]["parts"] > 1
    assert record["peak_memory"] <= max(b["memory"] for b in record["plan"]["predicted"]) <= limit
    check_targets(inside_strip(tmp_path / "run", table1), 8)
    # A resumed run keeps the sub-blocks of its first plan, whatever the memory limit is now.
    resumed = blocksar.focus(table1, tmp_path / "run", blocks=2, workers=1, grid=middle_strip(table1))
    assert "nothing to do" in resumed.summary[0]


@pytest.mark.slow
def test_memory_of_back_projection_is_predicted_and_kept(table1: Path, tmp_path: Path) -> None:
    grid = ((15900.0, 16900.0, 2.0), (19000.0, 20000.0, 2.0))
    settings: dict[str, Any] = {"processor": "backprojection", "grid": grid, "workers": 1, "threads": 2}
    record = blocksar.focus(table1, tmp_path / "run", **settings).result
    assert 0.4 * record["plan"]["memory"] < record["peak_memory"] <= record["plan"]["memory"]
    with pytest.raises(InputError, match=r"memory limit 330 MiB .* is too low: back-projection needs about \d+ MiB"):
        blocksar.focus(table1, tmp_path / "tight", memory_limit=330 * 2**20, **settings)
    assert not (tmp_path / "tight").exists()


@pytest.mark.slow
def test_the_whole_scene_and_its_edge_targets_are_as_in_table_2_and_table_3(table1: Path, tmp_path: Path) -> None:
    """The reference method blurs the edge targets and the proposed method does not (azimuth PSLR, dB)."""
    found = {}
    reference: dict[str, Any] = {"blocks": 1, "coefficients": "closed-form", "range_model": "conventional"}
    for name, settings in (("reference", reference), ("proposed", {"blocks": 3})):
        blocksar.focus(table1, tmp_path / name, workers=0, **settings)
        quality = blocksar.quality(tmp_path / name).result
        found[name] = {target["name"]: target["azimuth_pslr"] for target in quality["targets"]}
    check_targets(quality, 73)
    assert quality["table3"]["B2"]["azimuth_irw"] == 1.89
    assert sum(found["reference"][target] > -9.0 for target in EDGES) >= 3, found["reference"]
    for target in EDGES:
        assert found["reference"][target] > -11.5, target
        assert found["proposed"][target] == pytest.approx(-13.26, abs=0.2), target
    for centre in ("B2", "C2"):
        assert found["reference"][centre] == pytest.approx(-13.26, abs=0.2), centre
