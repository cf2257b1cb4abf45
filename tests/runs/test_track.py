"""The correction of a track as stores, runs and the report page have it."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import small_run

import blocksar
from blocksar.errors import InputError
from blocksar.runs.track import DEPTH, TrackCorrection, levels


def correction() -> TrackCorrection:
    time = np.linspace(-1, 1, 33)
    power = np.random.default_rng(1).random((3, 11, 17)) ** 4
    before, after = levels(0.1 * power, power)
    return TrackCorrection(
        figures={
            "points": 42, "knots": 64, "halves_apart": 0.06, "predicted_error": 0.03, "entropy_before": 6.5,
            "entropy_after": 4.25, "history": [{"loop": 1, "step_rad": 3.0}, {"loop": 2, "step_rad": 0.01}],
        },
        identity="0123", settings={"grid": None}, time=time, before=before, after=after,
        error=np.stack([0.1 * time**2, 0.02 * np.sin(9 * time), 0 * time], axis=1),
        uncertainty=np.full((33, 3), [1e-3, 2e-3, 3e-3]), places=np.array([[1.0, 2.0], [-3.5, 4.0], [5.0, -6.0]]),
    )  # fmt: skip


def test_a_correction_is_read_as_it_was_written() -> None:
    made = correction()
    read = TrackCorrection.of(made.as_json(), "store")
    assert (read.figures, read.identity, read.settings) == (made.figures, made.identity, made.settings)
    for name in ("time", "error", "uncertainty", "places"):
        assert getattr(read, name) == pytest.approx(getattr(made, name), abs=1e-7)
    assert np.array_equal(read.before, made.before) and np.array_equal(read.after, made.after)
    assert made.after.max() == 255 and made.before.max() == round(255 * (1 - 10 / DEPTH))
    first, second, third = read.sentences()
    assert third.startswith("not told by the samples")
    assert first.startswith("track corrected by up to 100 mm") and "from 42 points in 2 loops" in first
    few = replace(made, figures={**made.figures, "distinct": 6, "channel": "HV"}).sentences()[0]
    assert "from 42 points of channel HV, 6 of which stand out of noise and clutter, in 2 loops" in few
    assert (
        "6.500 before and 4.250 after" in first and "0.030 rad r.m.s. predicted, if the ground is the plane" in second
    )


def test_control_points_and_the_ground_are_in_the_sentences() -> None:
    control = {"points": 5, "left_out": ["T12"], "moved": 2.064, "phase_left": 0.21}
    made = correction()
    made = replace(made, figures={**made.figures, "control": control}, settings={"grid": None, "surface": "plane"})
    _, second, third = made.sentences()
    assert "0.030 rad r.m.s. predicted; " in second  # a terrain is given
    assert third.startswith("5 control points anchor it, and move it by up to 2.06 m; 0.21 rad r.m.s.")
    assert third.endswith("left out, as they do not agree with the others: T12")


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"points": "many"}, r"attribute autofocus is damaged: points is 'many', not a number; correct the track anew"),
        ({"track": {}}, r"attribute autofocus is damaged: track\.time is missing"),
        ({"chips": {"shape": [1, 2, 3], "before": "AAAA", "after": "AAAA"}}, "attribute autofocus is damaged"),
        ({"chips": None}, "chips is null, not an object"),
    ],
)
def test_a_damaged_attribute_is_one_sentence(change: dict[str, Any], expected: str) -> None:
    attribute = {**copy.deepcopy(correction().as_json()), **change}
    with pytest.raises(InputError, match=expected) as caught:
        TrackCorrection.of(attribute, "store")
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_quality_and_the_report_page_show_it(tmp_path: Path) -> None:
    small_run.make(tmp_path, more={"autofocus": correction().as_json()})
    report = blocksar.quality(tmp_path)
    assert any(line.startswith("track corrected by up to 100 mm") for line in report.summary)
    assert report.result["autofocus"]["points"] == 42
    (table,) = [rows for header, rows in report.tables if header[0] == "track's error"]
    assert [row[0] for row in table] == ["x", "y", "z"] and table[0][1:3] == ["100.00", "0.00"]
    blocksar.report(tmp_path)
    page = (tmp_path / "report.html").read_text()
    assert "Track corrected by up to 100 mm" in page and page.count("What was taken off the track") == 2
    assert "Chips about some points" in page
