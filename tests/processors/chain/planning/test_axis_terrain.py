"""Plans of beams about the antenna's own axis over a terrain."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from axis_beams import axis_collection

from blocksar.collection.grid import Grid
from blocksar.collection.terrain import Terrain
from blocksar.errors import OutsideSwath
from blocksar.imaging.method import Method
from blocksar.processors.chain.dwells.target_lines import Sector
from blocksar.processors.chain.planning.block import BlockPlan, plan_block
from blocksar.processors.chain.planning.planner import plan_collection
from blocksar.processors.chain.planning.strip_segments import owned_by

GRID = Grid(8880.0, 9120.0, 1.5, -80.0, 80.0, 0.9)


def test_a_strip_of_which_a_grid_needs_one_segment_is_planned() -> None:
    """The others see none of it, so that nothing bounds what the one images."""
    collection = axis_collection("tops", n_pulse=1200)
    spans = [(300, 900)]
    owned = owned_by(collection, spans, 0)
    x, y = np.meshgrid(GRID.x, GRID.y)
    assert owned(x, y).any()


@pytest.mark.slow
def test_blocks_at_the_rim_of_what_is_lit_cost_over_a_hill_what_they_cost_on_the_plane() -> None:
    """Where none of a block's targets has a full dwell, those with the longest are judged, not all that are there."""
    collection, y = axis_collection("squinted", n_pulse=1200), float(np.hypot(9000, 4000) * np.tan(0.25))
    x, along = np.arange(8300.0, 9700.0, 10.0), np.arange(y - 700, y + 700, 10.0)
    heights = 100 * np.exp(-((x - 9000) ** 2 + (along[:, None] - y) ** 2) / 150**2)
    terrain = Terrain(x0=x[0], dx=10.0, y0=along[0], dy=10.0, heights=heights)
    grid = Grid(8500.0, 9500.0, 4.0, y - 500, y + 500, 4.0)
    assert plan_collection(collection, grid=grid, blocks=4, terrain=terrain).coherence > 0.999


def test_a_block_of_which_nothing_is_lit_lies_outside_the_swath(monkeypatch: pytest.MonkeyPatch) -> None:
    kept: list[tuple[Sector, Method]] = []

    def keep(sector: Sector, method: Method, **rest: Any) -> BlockPlan:
        kept.append((sector, method))
        return plan_block(sector, method, **rest)

    monkeypatch.setattr("blocksar.processors.chain.planning.planner.plan_block", keep)
    plan_collection(axis_collection("squinted"), grid=Grid(8880.0, 9120.0, 3.0, 2450.0, 2500.0, 2.0), blocks=1)
    sector, method = kept[0]
    with pytest.raises(OutsideSwath, match="lights none of its ground"):
        plan_block(replace(sector, low=sector.high + 0.1, high=sector.high + 0.12), method, index=0)
