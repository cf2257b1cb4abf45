"""The project's quality bar, and plans of scenes for end-to-end tests."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import blocksar
from blocksar.processors.chain.planning.plan import Plan

MARGIN = 30.0  # m from the image's edge: room for a chip and for the side lobes of a response


def check_targets(found: dict[str, Any], expected: int) -> None:
    """Check that every full-dwell target meets the quality bar."""
    full = [t for t in found["targets"] if t["full_dwell"]]
    assert len(full) >= expected
    for target in full:
        assert target["covered"], target
        for axis in ("range", "azimuth"):
            assert target[f"{axis}_pslr"] == pytest.approx(-13.26, abs=0.2), target
            assert target[f"{axis}_irw"] == pytest.approx(target[f"{axis}_irw_theory"], rel=0.01), target
        assert abs(target["error_x"]) <= 0.05, target
        assert abs(target["error_y"]) <= 0.05, target
        value = complex(*target["value"])
        assert abs(value) == pytest.approx(1.0, abs=0.02), target
        assert abs(np.angle(value)) <= 0.05, target


def planned(path: Path, **settings: Any) -> Plan:
    plan = blocksar.plan(path, **settings).result
    assert isinstance(plan, Plan)
    return plan


def coarse_grid(store: Path, step: float = 4.0) -> Any:
    """Return a grid for comparing complex values: it need not sample the image adequately."""
    grid = planned(store, blocks=3).grid
    return ((grid.x0, grid.x1, step), (grid.y0, grid.y1, step))
