"""`blocksar quality`: the worst targets first, and files of targets."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import small_run
import zarr
from bad_input import SCENE

import blocksar
from blocksar.errors import InputError
from blocksar.measurement.figures import rank
from blocksar.measurement.targets import Target
from blocksar.products.page.facts import responses_of


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_run.make(tmp_path_factory.mktemp("quality") / "run").folder


@pytest.mark.slow
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


@pytest.mark.slow
def test_images_are_compared_but_for_shift_and_ramp(run: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    shutil.copytree(run, other)
    group = zarr.open_group(other / "image.zarr")
    image = group["image"]
    assert isinstance(image, zarr.Array)
    ramp = np.exp(-0.05j * np.arange(image.shape[0]))[:, None]
    image[...] = np.roll(np.asarray(image[...]), 3, axis=1) * ramp
    report = blocksar.quality(run, against=other)
    x, y = (np.asarray(blocksar.open(run)[name]) for name in ("x", "y"))
    chips = report.result["against"]
    assert all(chip["as_is"] <= chip["shifted"] + 1e-9 <= chip["ramped"] + 2e-9 for chip in chips)
    told = [chip for chip in chips if chip["ramped"] > 0.95]
    assert len(told) == len(chips) - 1  # one has but a side lobe, at its end
    for chip in told:
        assert chip["as_is"] < 0.5 and chip["shifted"] < chip["ramped"] - 0.005
        assert chip["shift"] == pytest.approx([-3 * (x[1] - x[0]), 0.0], abs=0.05 * (x[1] - x[0]))
        assert chip["ramp"] == pytest.approx([0.0, 0.05 / (y[1] - y[0])], abs=0.01 / (y[1] - y[0]))
    assert any(line.startswith(f"coherence with {other}, least and median of ") for line in report.summary)
    assert len(report.tables[-1][1]) == len(report.result["against"])
    assert not any(line.startswith("weights differ") for line in report.summary)
    record = json.loads((other / "run.json").read_text())
    (other / "run.json").write_text(json.dumps(record | {"settings": record["settings"] | {"weighting_range": "hann"}}))
    summary = blocksar.quality(run, against=other).summary
    assert any(line.startswith("weights differ, uniform here and hann ") for line in summary)
    assert blocksar.quality(run, against=run).result["against"][0]["as_is"] == pytest.approx(1.0, abs=1e-6)
    assert "against" not in blocksar.quality(run).result
    group["x"][:] = x + 1  # type: ignore[index]
    with pytest.raises(InputError, match="has another x than"):
        blocksar.quality(run, against=other)


# ---------------------------------------------------------------- files of targets


def test_targets_of_a_list_a_dict_and_quality_json_are_read(run: Path, tmp_path: Path) -> None:
    (tmp_path / "list.json").write_text('[{"name": "A", "x": 0.3, "y": -0.2, "reflectivity": [1, 0]}]')
    (tmp_path / "dict.json").write_text('{"targets": [{"name": "A", "x": 0.3, "y": -0.2}]}')
    for name in ("list.json", "dict.json"):
        (found,) = blocksar.quality(run, targets=tmp_path / name).result["targets"]
        assert found["name"] == "A" and abs(found["error_x"]) < 0.1
    again = blocksar.quality(run, targets=run / "quality.json").result["targets"]
    assert [record["name"] for record in again] == ["A"]
    (tmp_path / "scene.toml").write_text(SCENE)
    of_scene = blocksar.quality(run, targets=tmp_path / "scene.toml").result["targets"]
    assert [record["name"] for record in of_scene] == ["P"]


@pytest.mark.slow
def test_targets_of_csv_and_geojson_are_those_of_json(run: Path, tmp_path: Path) -> None:
    names, places = [t.name for t in small_run.TARGETS], [(t.x, t.y) for t in small_run.TARGETS]
    lines = [f"{name};{x};{y};1+0j" for name, (x, y) in zip(names, places, strict=True)]
    (tmp_path / "targets.csv").write_text("\n".join(["name;x;y;reflectivity", *lines, ""]))
    degrees = small_run.DAYTON.to_geodetic(np.array([[x, y, 0.0] for x, y in places]))
    features = [
        {"type": "Feature", "geometry": {"type": "Point", "coordinates": [lon, lat]}, "properties": {"name": name}}
        for name, (lat, lon, _) in zip(names, degrees.tolist(), strict=True)
    ]
    (tmp_path / "targets.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    wanted = blocksar.quality(run).result["targets"]
    for name in ("targets.csv", "targets.geojson"):
        found = blocksar.quality(run, targets=tmp_path / name).result["targets"]
        assert [record["name"] for record in found] == names
        for one, other in zip(found, wanted, strict=True):
            assert (one["x"], one["y"]) == pytest.approx((other["x"], other["y"]), abs=1e-6)
            assert one["azimuth_pslr"] == pytest.approx(other["azimuth_pslr"], abs=1e-3)


# ---------------------------------------------------------------- what nobody named


@pytest.mark.slow
def test_targets_are_found_without_being_named(tmp_path: Path) -> None:
    """Under a taper, so that the targets' own side lobes are no neighbours of others."""
    folder = small_run.make(tmp_path / "run", weighting="taylor:4:-35", hole=False, size=(220, 200)).folder
    report = blocksar.quality(folder, targets=[], found=9, area="-40:-30,-36:-28")
    found = report.result["found"]
    assert len(found) == 4 and report.tables[-1][0][0] == "found"
    for target in small_run.TARGETS:
        off, point = min((np.hypot(p["x"] - target.x, p["y"] - target.y), p["name"]) for p in found)
        record = next(p for p in found if p["name"] == point)
        assert off < 0.05 and record["power"] == pytest.approx(0.0, abs=0.1) and record["prominence"] > 40
        assert record["azimuth_irw"] == pytest.approx(record["azimuth_irw_theory"], rel=0.01)
        assert record["range_pslr"] == pytest.approx(-35.0, abs=1.5)
        assert [ghost["order"] for ghost in record["ambiguities"]] == [-1, 1]
        assert all(ghost["level"] is None for ghost in record["ambiguities"])  # beyond this image
    area = report.result["area"]
    assert area["pixels"] == 26 * 21 and area["mean"] < -40 and area["cells"] > 10
    assert report.result["floor"] < -40
    assert {"found", "area", "floor"} <= json.loads((folder / "quality.json").read_text()).keys()


def test_points_at_the_edge_of_a_narrow_image_are_found(tmp_path: Path) -> None:
    """Their cuts leave the image; their power is that of the brightest pixel."""
    folder = small_run.make(tmp_path / "run", hole=False, size=(60, 3)).folder
    found = blocksar.quality(folder, targets=[], found=2).result["found"]
    assert all(np.isfinite(point["power"]) for point in found)
