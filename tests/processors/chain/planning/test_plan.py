"""Plans: the number of blocks, the residuals of the closed forms, and refusals."""

from __future__ import annotations

import math
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from quality_bar import planned
from scenes import UNSTEERED_SCENE, scene

import blocksar
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.collection.region import plan_region
from blocksar.graph.machine import Resources, pace
from blocksar.imaging.method import Method
from blocksar.planning import effort
from blocksar.processors import sentences
from blocksar.processors.chain.dwells.target_lines import Sector
from blocksar.processors.chain.planning import stage_work
from blocksar.processors.chain.planning.block import plan_block
from blocksar.processors.chain.planning.planner import plan_collection
from blocksar.processors.chain.planning.spectrum_recovery import plan_recovery
from blocksar.processors.chain.planning.written_bytes import run_bytes
from blocksar.simulation.scene import Scene


def test_looking_along_the_velocity_is_refused(tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text(scene(steering=(85.0, 101.0), centre=93.0, swath=[29900.0, 30100.0]))
    report = blocksar.plan(tmp_path / "scene.toml", blocks=3)
    assert report.refusal is not None
    assert "along the velocity" in report.refusal


def test_a_plan_reads_no_samples_and_accepts_a_scene_or_a_store(table1: Path) -> None:
    from_scene, from_store = planned("table1", blocks=3), planned(table1, blocks=3)  # type: ignore[arg-type]
    assert [b.first_bin for b in from_scene.blocks] == [b.first_bin for b in from_store.blocks]
    header, rows = blocksar.plan(table1, blocks=3).table()[0]
    assert len(rows) == 3
    assert all(len(row) == len(header) for row in rows)


@pytest.mark.slow
def test_of_many_blocks_the_ten_worst_are_shown_and_all_are_at_hand() -> None:
    report = blocksar.plan("table1", blocks=14)
    header, rows = report.tables[0]
    least = sorted(block.prediction.coherence for block in report.result.blocks)[:10]
    assert header[0] == "worst 10 of 14" and len(rows) == 10
    assert sorted(float(row[2]) for row in rows) == pytest.approx(least, abs=1e-4)
    assert [row[0] for _, rows in report.details[:1] for row in rows] == [str(i) for i in range(14)]
    names = " ".join(report.definitions)
    assert all(title.partition(" (")[0] in names for title in report.details[0][0])


@pytest.mark.slow
def test_a_plan_says_how_long_a_run_takes_and_all_else_repeats(monkeypatch: pytest.MonkeyPatch) -> None:
    def summary(pace: float) -> list[str]:
        monkeypatch.setattr(sentences, "pace", lambda: pace)
        monkeypatch.setattr(sentences, "PLANNING_TOLD", math.inf)
        return blocksar.plan("table1", blocks=3, workers=1).summary

    first, second = summary(1.0), summary(100.0)
    (changed,) = [line for line, other in zip(first, second, strict=True) if line != other]
    assert "on this machine with 1 worker (start 2 s, recover " in changed and "focus " in changed
    work = stage_work.of_plan(planned("table1", blocks=3))  # type: ignore[arg-type]
    monkeypatch.setattr(sentences, "PLANNING_TOLD", 3.0)
    monkeypatch.setattr(sentences, "pace", lambda: 1.0)
    for planning, begin in ((3.0, "(plan 3 s, start "), (2.9, "(start ")):
        assert begin in sentences.time_line(work, Resources(1, 1, 2**30), 0, planning)
    assert "slow (27.8 h to write at 200 MB/s)" in sentences.time_line(work, Resources(1, 1, 2**30), 20_000 * 10**9)
    alone, two = (effort.seconds_of(work, workers=workers, threads=1, pace=1.0) for workers in (1, 2))
    assert two["recover"] == pytest.approx(alone["recover"] / 2, rel=0.1)  # many units, side by side
    assert alone["focus"] / 2 < two["focus"] < alone["focus"]  # three units
    slow = effort.seconds_of(work, workers=2, threads=1, pace=2.0)
    assert all(slow[stage] == pytest.approx(2 * two[stage]) for stage in two)


def test_the_pace_of_a_machine_is_measured_once() -> None:
    assert pace() > 0 and pace() == pace()


@pytest.mark.slow
def test_range_sub_blocks_are_shown_with_their_range() -> None:
    header, rows = blocksar.plan("table1", blocks=2, memory_limit=560 * 2**20).tables[0]
    assert header[2] == "range (km)" and all(len(row) == len(header) for row in rows)
    assert {row[0].partition(".")[0] for row in rows} == {"0", "1"}


@pytest.mark.slow
def test_the_gate_has_room_for_dwells_that_the_collection_cuts() -> None:
    """In narrow outer blocks the dwells that are left are much shorter than those that the gate continues."""
    made = Scene.parse(
        scene(carrier=9.6e9, bandwidth=250e6, range_sampling=300e6, prf=900.0, velocity=[4.0, 55.0, -1.5],
              acceleration=[0.3, -0.2, 0.1], duration=6.0, steering=(28.0, 36.0), dwell=2.0, centre=32.0,
              swath=[16700.0, 17100.0])
    )  # fmt: skip
    blocks = plan_collection(made.collection().centred(), blocks=16).blocks
    assert len(blocks) == 16
    for block in blocks:
        gate = block.sampling.gate
        assert gate is not None and gate.time.extent > 1.2 * gate.length


def wide_collection() -> Collection:
    """Table 1 with four times the swath and the aperture: `auto` tries many divisions of it."""
    text = (resources.files("blocksar.simulation") / "scenes" / "table1.toml").read_text(encoding="utf-8")
    wide = {
        "prf = 8e3": "prf = 20720.0", "duration = 0.6": "duration = 2.4", "start_deg = 42.13": "start_deg = 18.52",
        "stop_deg = 57.87": "stop_deg = 81.48", "swath = [27500.0, 32500.0]": "swath = [20000.0, 40000.0]",
    }  # fmt: skip
    for before, after in wide.items():
        assert text.count(before) == 1
        text = text.replace(before, after)
    return Scene.parse(text).collection().centred()


def test_where_the_kinds_tried_fold_lines_another_is_fitted() -> None:
    """The cheapest kinds of chain fold lines of the last of 28 blocks, though not at the three ranges tried first."""
    geometry = Geometry(collection=wide_collection())
    region = plan_region(geometry, None)
    recovery = plan_recovery(geometry, region)
    low, high = 1.3828, 1.4592
    near, far = region.limits(low, high)
    sector = Sector(geometry=geometry, recovery=recovery, region=region, low=low, high=high, near=near, far=far)
    plan = plan_block(sector, Method(), index=27)
    assert np.isfinite(plan.choice.cost)
    assert np.isfinite(list(plan.prediction)).all()


@pytest.mark.slow
def test_range_gates_share_their_delays_and_divide_the_spectrum_into_whole_chunks() -> None:
    """One transform of each Doppler bin serves all sub-blocks, and each group of bins is written by one task."""
    plan = plan_collection(Scene.parse(scene()).collection().centred(), blocks=2, parts=3)
    gates = [block.range_gate for block in plan.blocks]
    assert len(gates) == 6
    for gate in gates:
        assert gate is not None and gates[0] is not None
        assert gate.to_delay == gates[0].to_delay
        assert abs(gate.gate.start / gate.gate.step - round(gate.gate.start / gate.gate.step)) < 1e-9
    height, group = plan.spectrum_chunk[0], plan.gate_group
    assert height % group == 0
    spans, n_bin = plan.gate_spans(), plan.recovery.doppler.size
    for block in plan.blocks:
        first, last = plan.gated_bins(block)
        assert first % group == 0 and (last % group == 0 or last == n_bin)
        assert first <= block.first_bin < first + group
        assert block.first_bin + block.n_bin <= last < block.first_bin + block.n_bin + group
        assert any(span[0] <= first < span[1] for span in spans) and any(span[0] < last <= span[1] for span in spans)
        assert block.steps == block.chain[1:]
    assert run_bytes(plan)["gated"] > 0
    assert plan.memory >= plan.gating_memory > 0
    # A Doppler bin is transformed to delay once, however many sub-blocks have it.
    made = [each for each in plan.transforms() if each.stage == "range-gate"]
    assert made[0].count <= n_bin < sum(block.n_bin for block in plan.blocks)
    assert [each.count for each in made[1:]] == [block.n_bin for block in plan.blocks]
    whole = plan_collection(Scene.parse(scene()).collection().centred(), blocks=2)
    assert whole.gating_memory == 0 and not whole.gate_spans() and "gated" not in run_bytes(whole)


@pytest.mark.slow
@pytest.mark.parametrize("processor", ["angular-division", "hierarchical-backprojection", "backprojection", "auto"])
def test_a_part_of_the_grid_beyond_the_range_window_is_told(processor: Any, tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text(UNSTEERED_SCENE)
    inside, beyond = ((5840.0, 5880.0, 1.0), (2120.0, 2160.0, 1.0)), ((5600.0, 6100.0, 1.0), (2120.0, 2160.0, 1.0))
    told = [
        " ".join(blocksar.plan(tmp_path / "scene.toml", grid=grid, processor=processor).summary)
        for grid in (inside, beyond)
    ]
    assert "range window" not in told[0]
    assert "% of the grid's pixels lie outside the range window (" in told[1]


def test_targets_that_no_pixel_shows_do_not_refuse_a_plan() -> None:
    """A scan of 39 degrees at 10 % of bandwidth: at its ends targets migrate by 1.4 cells, on the grid by 0.1."""
    text = scene(
        carrier=3e9, bandwidth=300e6, range_sampling=360e6, prf=4000, velocity=[0.0, 250.0, -20.0],
        acceleration=[3.0, 2.0, -3.0], duration=3.0, steering=(20.0, 50.0), dwell=0.9, swath=[11800.0, 12200.0],
        centre=35.0, reference_range='"scene_centre"',
    )  # fmt: skip
    made = Scene.parse(text.replace("16500.0", "6000.0"))  # m: height
    x, y = (float(v) for v in made.centre[:2])
    grid = Grid(x - 60, x + 60, 0.4, y - 60, y + 60, 0.4)
    plan = plan_collection(made.collection().centred(), grid=grid, blocks=1)
    assert plan.refusal is None and plan.blocks[0].prediction.range_loss < 1e-3
    assert plan.blocks[0].prediction.migration < 0.2
