"""What `plan` says of time: of exact back-projection where it takes less, and nothing of what does not focus."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from scenes import SMALL_SCAN, scene

import blocksar

SMALL = "16040:16060:1,19120:19140:1"
# Of a strip whose beam looks far ahead, the last of 11 blocks holds hardly any ground that is lit.
SLIVER = """
[radar]
carrier = 9.3e9
bandwidth = 80e6
range_sampling = 96e6
prf = 450.0
[track]
position = [0.0, 0.0, 1200.0]
velocity = [70.0, 0.0, 8.0]
acceleration = [-0.4, -0.9, 0.2]
[time]
pulses = 2600
[beam]
mode = "stripmap"
width_deg = 2.0
squint_deg = 58.0
[scene]
swath = [4900.0, 5150.0]
centre_yaw_deg = 30.0
reference_range = "constant"
"""
TOLD = "exact back-projection of this grid takes less, about "


def test_a_grid_that_back_projection_takes_less_time_for_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "scene.toml").write_text(scene(**SMALL_SCAN))
    monkeypatch.setattr("blocksar.processors.lines.EXACT_TOLD", 0.0)
    monkeypatch.setattr("blocksar.processors.lines.EXACT_GAIN", 1.0)

    def told(source: str | Path, **settings: Any) -> list[str]:
        return [line for line in blocksar.plan(source, **settings).summary if line.startswith(TOLD)]

    assert len(told(tmp_path / "scene.toml", grid=SMALL, workers=0)) == 1
    assert not told("table1")
    monkeypatch.setattr("blocksar.processors.lines.EXACT_TOLD", 1e6)  # a matter of so few seconds is not worth a word
    assert not told(tmp_path / "scene.toml", grid=SMALL, workers=0)


def test_a_plan_that_does_not_focus_is_not_timed(tmp_path: Path) -> None:
    """The samples of a block that folds may have no bounds: 4e14 bytes were asked for, and a traceback printed."""
    (tmp_path / "scene.toml").write_text(SLIVER)
    report = blocksar.plan(tmp_path / "scene.toml", blocks=11)
    assert report.refusal is None or "block 10" in report.refusal
    assert any("a run takes about" in line for line in report.summary) == (report.refusal is None)
