"""`blocksar quality`: the worst targets first, and files of targets."""

from __future__ import annotations

from pathlib import Path

import pytest
import small_run

import blocksar
from blocksar.errors import InputError
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


# ---------------------------------------------------------------- files of targets


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("name,x,y\nA,1,2\nB,3,4\n", "looks like CSV, but targets are given in JSON: [{"),
        ("A;1;2\n", "looks like CSV"),
        ('[{"name": "A", "x": 1, "y": 2},\n]', "is not JSON at line 2; give [{"),
        ("", "is not JSON at line 1; give"),
        ('[{"name": "A", "x": 1, "Y": 2}]', "target 1 has the unknown key 'Y'; did you mean y?"),
        ('[{"name": "A", "x": 1, "y": 2, "sigma": 1}]', "has the unknown key 'sigma'; known are name, x, y"),
        ('[{"name": "A", "x": 1, "y": 2}, {"name": "B", "x": 1}]', "target 2 has no y; give"),
        ('[{"name": "A", "x": "far", "y": 2}]', "target 1: target {'name': 'A', 'x': 'far', 'y': 2} cannot be read"),
        ('[["A", 1, 2]]', 'target 1 is ["A", 1, 2], not a record; give'),
        ("[]", "holds no list of targets; give [{"),
        ('{"name": "A", "x": 1, "y": 2}', "holds no list of targets; give [{"),
    ],
)
def test_a_wrong_file_of_targets_is_named_with_its_fault(text: str, sentence: str, run: Path, tmp_path: Path) -> None:
    (tmp_path / "targets.json").write_text(text)
    with pytest.raises(InputError) as caught:
        blocksar.quality(run, targets=tmp_path / "targets.json")
    assert sentence in str(caught.value) and "targets.json" in str(caught.value) and "\n" not in str(caught.value)


def test_targets_of_a_list_a_dict_and_quality_json_are_read(run: Path, tmp_path: Path) -> None:
    (tmp_path / "list.json").write_text('[{"name": "A", "x": 0.3, "y": -0.2, "reflectivity": [1, 0]}]')
    (tmp_path / "dict.json").write_text('{"targets": [{"name": "A", "x": 0.3, "y": -0.2}]}')
    for name in ("list.json", "dict.json"):
        (found,) = blocksar.quality(run, targets=tmp_path / name).result["targets"]
        assert found["name"] == "A" and abs(found["error_x"]) < 0.1
    again = blocksar.quality(run, targets=run / "quality.json").result["targets"]
    assert [record["name"] for record in again] == ["A"]
