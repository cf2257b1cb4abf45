"""What quality says of targets that lack pixels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from small_run import TARGETS, make

import blocksar
from blocksar.measurement.targets import Target


def test_targets_near_the_edge_and_outside_are_named(tmp_path: Path) -> None:
    made = make(tmp_path, hole=False)
    edge = Target("edge", float(made.x[4]), float(made.y[50]))
    between = Target("between", float(made.x[4]) + 0.1, float(made.y[50]))
    away = Target("away", float(made.x[-1]) + 30, 0.0)
    report = blocksar.quality(tmp_path, targets=[TARGETS[0], edge, between, away])
    values = {target["name"]: target["value"] for target in report.result["targets"]}
    assert complex(*values["edge"]) == pytest.approx(complex(made.image[50, 4]), abs=1e-6)
    assert values["between"] == values["away"] == [None, None]
    assert np.abs(complex(*values["A"])) == pytest.approx(1, abs=0.1)
    assert "1 target outside the image (away): not measured" in report.summary
    (line,) = (line for line in report.summary if "edge of what the image covers" in line)
    assert line.startswith("2 targets close to the edge of what the image covers (edge, between): not judged")


def test_a_target_beside_a_brighter_one_is_not_measured(tmp_path: Path) -> None:
    make(tmp_path, hole=False)
    a = TARGETS[0]
    report = blocksar.quality(tmp_path, targets=[a, Target("beside", a.x + 4.0, a.y)])
    own, beside = report.result["targets"]
    assert not own["crowded"] and own["range_pslr"] < 0
    assert beside["crowded"] and beside["range_pslr"] is beside["azimuth_pslr"] is beside["error_x"] is None
    assert report.result["summary"]["measured"] == 1
    assert any("(beside): another peak is near, or the image is out of focus there" in line for line in report.summary)
