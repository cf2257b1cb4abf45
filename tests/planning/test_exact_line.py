"""What `plan` says where exact back-projection would take less time than a chain."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from scenes import SMALL_SCAN, scene

import blocksar

SMALL = "16040:16060:1,19120:19140:1"
TOLD = "exact back-projection of this grid takes less, about "


def test_a_grid_that_back_projection_takes_less_time_for_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "scene.toml").write_text(scene(**SMALL_SCAN))
    monkeypatch.setattr("blocksar.api.plan_lines.EXACT_TOLD", 0.0)
    monkeypatch.setattr("blocksar.api.plan_lines.EXACT_GAIN", 1.0)

    def told(source: str | Path, **settings: Any) -> list[str]:
        return [line for line in blocksar.plan(source, **settings).summary if line.startswith(TOLD)]

    assert len(told(tmp_path / "scene.toml", grid=SMALL, workers=0)) == 1
    assert not told("table1")
    monkeypatch.setattr("blocksar.api.plan_lines.EXACT_TOLD", 1e6)  # a matter of so few seconds is not worth a word
    assert not told(tmp_path / "scene.toml", grid=SMALL, workers=0)
