"""`blocksar quality`: the worst targets first, and files of targets."""

from __future__ import annotations

from pathlib import Path

import pytest
import small_run

import blocksar
from blocksar.measurement.bar import rank
from blocksar.measurement.targets import Target
from blocksar.products.page.facts import responses_of


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_run.make(tmp_path_factory.mktemp("quality") / "run").folder


def test_the_ten_worst_targets_come_first_and_all_are_at_hand(run: Path) -> None:
    # The scene has four targets; of 13 positions, those that are off have figures that are off.
    targets = [*small_run.TARGETS, *(Target(f"off{k}", 0.3 + 0.05 * k, -0.2) for k in range(1, 10))]
    report = blocksar.quality(run, targets=targets)
    summary, worst = report.tables
    assert summary[0] == ("figure", "worst case", "ideal", "target") and len(summary[1]) == 10
    errors = {record["name"]: record["error_x"] for record in report.result["targets"] if record["covered"]}
    row = next(row for row in summary[1] if row[0] == "position error in x (mm)")
    assert row[3] == max(errors, key=lambda name: abs(errors[name]))
    assert worst[0][0] == "worst 10 of 13" and len(worst[1]) == 10
    ranked = sorted(responses_of(report.result), key=rank)
    assert {row[0] for row in worst[1]} == {response.name for response in ranked[:10]}
    assert [row[0] for row in report.details[1][1]] == [target.name for target in targets]
    assert any(line.startswith("PSLR: ") for line in report.definitions)
    assert not any("main lobe" in line for line in report.summary)
    assert "13 in all" in report.summary[0]


def test_few_targets_are_all_shown(run: Path) -> None:
    _, (header, rows) = blocksar.quality(run).tables
    assert header[0] == "target" and [row[0] for row in rows] == ["A", "B", "C", "D"]
