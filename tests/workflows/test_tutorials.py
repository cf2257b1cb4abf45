"""The tutorial workflows as a user runs them: printed values, written files and refusals are correct."""

from __future__ import annotations

import ast
import csv
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import dask
import numpy as np
import pytest
import xarray as xr
from distributed import Client, LocalCluster
from repository import ROOT

import blocksar
from blocksar import stores
from blocksar.application.parsing import parse_grid
from blocksar.simulation.scene import Scene

pytestmark = pytest.mark.slow

WORKFLOWS = ROOT / "workflows"
TUTORIALS = ("first_image", "look_at_outputs", "blocks_against_residual_phase", "on_a_cluster")
PIXEL = 1.5  # m, pixel spacing of the image of first_image


def run(name: str, *words: str, cwd: Path, status: int = 0) -> subprocess.CompletedProcess[str]:
    """Run a tutorial's command line in a folder, and check its exit status."""
    command = [sys.executable, str(WORKFLOWS / f"{name}.py"), *words]
    env = os.environ | {"PYTHONPATH": str(ROOT), "MPLBACKEND": "agg"}
    done = subprocess.run(command, cwd=cwd, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == status, done.stdout + done.stderr
    assert "Traceback" not in done.stderr and "Warning" not in done.stderr, done.stderr
    return done


def refused(name: str, *words: str, cwd: Path) -> str:
    """Run a command line that is refused, and return its one-sentence message."""
    before = sorted(cwd.rglob("*"))
    done = run(name, *words, cwd=cwd, status=2)
    (sentence,) = done.stderr.strip().splitlines()
    assert sentence.startswith(f"{name}: ")
    assert sorted(cwd.rglob("*")) == before
    return sentence


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The folder of the first image, and the printed output."""
    folder = tmp_path_factory.mktemp("first")
    return folder / "first-image", run("first_image", "first-image", cwd=folder).stdout


@pytest.fixture(scope="module")
def modules() -> Iterator[dict[str, ModuleType]]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(WORKFLOWS))
        import blocks_against_residual_phase
        import look_at_outputs
        import on_a_cluster

        yield {"look": look_at_outputs, "cluster": on_a_cluster, "study": blocks_against_residual_phase}


# ---------------------------------------------------------------- first_image


def test_the_first_image_shows_every_target_of_the_scene(first: tuple[Path, str]) -> None:
    """Every target peaks in its own pixel and meets the quality bar."""
    folder, said = first
    image = blocksar.open(folder / "run")
    targets = Scene.read(folder / "scene.toml").point_targets()
    assert len(targets) == 9
    for name, x, y, *_ in targets:
        power = image.sar.crop(x=(x - 20, x + 20), y=(y - 20, y + 20)).sar.db()
        peak = power.isel(power.argmax(["y", "x"]))
        assert np.abs([float(peak.x) - x, float(peak.y) - y]).max() <= PIXEL / 2 + 0.1, name
        found = re.search(rf"^{name}: side lobes (\S+) dB, width / theory (\S+), value (\S+)$", said, re.M)
        assert found is not None, said
        lobes, width, value = map(float, found.groups())
        assert (lobes, width, value) == (
            pytest.approx(-13.26, abs=0.2),
            pytest.approx(1, abs=0.01),
            pytest.approx(1, abs=0.01),
        )
    assert (folder / "image.png").stat().st_size > 50_000


# ---------------------------------------------------------------- look_at_outputs


def test_look_at_outputs_prints_correct_values(
    first: tuple[Path, str], modules: dict[str, ModuleType], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, _ = first
    modules["look"].main(folder / "run", tmp_path / "look.png")
    said = capsys.readouterr().out
    targets = Scene.read(folder / "scene.toml").point_targets()
    image, record = blocksar.open(folder / "run"), stores.read_json(folder / "run" / "run.json")

    def numbers(pattern: str) -> list[list[float]]:
        return [[*map(float, m.groups())] for m in re.finditer(pattern.replace("#", r"(-?\d+(?:\.\d+)?)"), said)]

    ((_, x, y),) = numbers(r"brightest pixel: # dB at x = # m, y = # m")
    assert min(max(abs(x - t.x), abs(y - t.y)) for t in targets) <= PIXEL / 2 + 0.1
    ((pulses, begin, end, direction),) = numbers(r"lit by # pulses, t = # \.\. # s, along # degrees")
    assert pulses == pytest.approx(800, abs=1)  # 0.1 s at 8 kHz
    assert end - begin == pytest.approx(0.1, abs=2e-4)
    assert direction == pytest.approx(50, abs=1.5)
    for (level, width), theory in zip(numbers(r" the look: # dB, # m wide"), (3.2, 3.05), strict=True):
        # Range: 0.886 c / 2B over the sine of the incidence angle; azimuth: the value in quality.json.
        assert level == pytest.approx(0, abs=0.1) and width == pytest.approx(theory, abs=0.1)
    areas = [area for (area,) in numbers(r"block(?: \d+)?: # km\^2")]
    assert sum(areas) == pytest.approx(image["block"].size * PIXEL**2 / 1e6, abs=2e-3)
    assert areas[1] == pytest.approx(int((image["block"] == 0).sum()) * PIXEL**2 / 1e6, abs=6e-4)
    ((total,),) = numbers(r"stages: .*total # s")
    assert total == pytest.approx(record["timings"]["total"], abs=0.06)
    promised = numbers(r"predicted # dB, width # of theory; measured at # targets # dB, #")
    owners = [int(image["block"].sel(x=t.x, y=t.y, method="nearest")) for t in targets]
    assert [row[2] for row in promised] == [owners.count(b["block"]) for b in record["plan"]["predicted"]]
    assert len(set(row[2] for row in promised)) > 1  # otherwise a wrong order would go unnoticed
    measured = stores.read_json(folder / "run" / "quality.json")["targets"]
    assert max(row[3] for row in promised) == pytest.approx(max(t["azimuth_pslr"] for t in measured), abs=0.006)
    assert "patches/0 equals the image" in said
    assert (tmp_path / "look.png").stat().st_size > 50_000


def test_cuts_follow_the_two_axes_of_a_response(first: tuple[Path, str], modules: dict[str, ModuleType]) -> None:
    """A response has visible side lobes only along its two axes."""
    target = next(t for t in Scene.read(first[0] / "scene.toml").point_targets() if t.name == "centre")
    look = modules["look"]
    direction = look.look_direction(blocksar.open(first[0] / "run" / "collection.zarr").load(), target[1:3])
    for cut in look.cuts_through(blocksar.open(first[0] / "run"), target[1:3], direction).values():
        beside = cut.where(abs(cut.distance - cut.distance[cut.argmax("distance")]) > 3.6)
        assert float(beside.max() - cut.max()) == pytest.approx(-13.3, abs=1.0)


def test_a_patch_that_differs_from_the_image_is_detected(
    first: tuple[Path, str], modules: dict[str, ModuleType]
) -> None:
    run_folder = first[0] / "run"
    image, patch = blocksar.open(run_folder), blocksar.open(run_folder / "patches" / "0").load()
    same = modules["look"].same_pixels
    assert same(patch, image)
    rows, columns = np.nonzero(np.isfinite(patch["image"].values))
    patch["image"].values[rows[100], columns[100]] *= 1.001
    assert not same(patch, image)


def test_a_decimated_picture_keeps_strong_pixels_and_gaps(modules: dict[str, ModuleType]) -> None:
    values = np.full((1700, 900), np.nan, np.complex64)
    values[:, 450:] = 0.1
    values[1234, 777] = 2j
    with dask.config.set(scheduler="threads"):  # not the cluster that other tests of this process may have left
        picture = modules["look"].decimate(xr.DataArray(values, dims=("y", "x"))).compute()
    assert picture.shape == (567, 300)
    assert np.isnan(picture.values[:, :150]).all()
    assert picture.values[1234 // 3, 777 // 3] == pytest.approx(20 * np.log10(2), abs=1e-4)
    assert (np.delete(picture.values[:, 150:].ravel(), 1234 // 3 * 150 + 777 // 3 - 150) < -19.9).all()


def test_a_folder_without_a_finished_run_is_refused(
    first: tuple[Path, str], modules: dict[str, ModuleType], tmp_path: Path
) -> None:
    record = stores.read_json(first[0] / "run" / "run.json")
    stores.write_json(tmp_path / "run.json", record | {"status": "unfinished"})
    with pytest.raises(blocksar.InputError, match="is unfinished; give the command"):
        modules["look"].read_record(tmp_path)


# ---------------------------------------------------------------- blocks_against_residual_phase


def test_residual_phase_falls_with_blocks_and_predictions_match_measurements(tmp_path: Path) -> None:
    """At the end of table1's scan more blocks leave less residual phase; predictions match measurements."""
    text = (resources.files("blocksar.simulation") / "scenes" / "table1.toml").read_text(encoding="utf-8")
    text = text.replace("[27500.0, 32500.0]", "[29950.0, 30050.0]").split("[matrix]")[0]
    for yaw in (44.3, 50.0):  # full dwell holds from 44.26 to 55.74; the second is outside the grid
        text += f'[[targets]]\nname = "{yaw}"\nrange = 30000.0\nyaw_deg = {yaw}\n'
    (tmp_path / "narrow.toml").write_text(text)
    grid = "17882:17982:1,17449:17549:1"
    words = ("narrow.toml", "--out", "study", "--blocks", "1,4", "--measured", "1", "--grid", grid)
    said = run("blocks_against_residual_phase", *words, cwd=tmp_path).stdout
    with (tmp_path / "study" / "blocks.csv").open(newline="") as file:
        rows = {(r["processor"], r["coefficients"], int(r["blocks"])): r for r in csv.DictReader(file)}
    assert len(rows) == 3 * 2 * 2
    assert {path.name for path in (tmp_path / "study").iterdir()} == {"blocks.csv", "blocks.png"}
    for (processor, coefficients, blocks), row in rows.items():
        left = float(row["residual_phase_rad"])
        assert f"{left:.4f}" in said
        if blocks == 4 and coefficients == "closed-form":
            assert left < 0.7 * float(rows[processor, coefficients, 1]["residual_phase_rad"]), processor
        if coefficients == "fitted":
            assert left < 0.02, (processor, blocks)
    axes = parse_grid(grid)
    made = blocksar.plan(tmp_path / "narrow.toml", blocks=4, coefficients="closed-form", grid=axes).result
    row = rows["angular-division", "closed-form", 4]
    assert float(row["pslr_db"]) == max(block.prediction.pslr for block in made.blocks)
    assert float(row["memory_mib"]) == made.memory / 2**20
    for coefficients, lobes, width in (("fitted", 0.2, 0.01), ("closed-form", 1.0, 0.03)):
        row = rows["angular-division", coefficients, 1]
        assert float(row["measured_pslr_db"]) == pytest.approx(float(row["pslr_db"]), abs=lobes)
        assert float(row["measured_width"]) == pytest.approx(float(row["width"]), abs=width)
        assert float(row["measured_memory_mib"]) < float(row["memory_mib"])
    assert float(rows["angular-division", "closed-form", 1]["pslr_db"]) > -9  # otherwise the comparison is meaningless


def test_a_study_takes_the_worst_target_of_full_dwell(
    modules: dict[str, ModuleType], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def target(lobes: float | None, width: float, **more: bool) -> dict[str, object]:
        whole = {"full_dwell": True, "covered": True} | more
        return whole | {"azimuth_pslr": lobes, "azimuth_irw": width, "azimuth_irw_theory": 2.0}

    found = [target(-13.0, 2.2), target(-11.0, 2.0), target(-5, 4, full_dwell=False), target(-4, 5, covered=False)]
    record = {"peak_memory": 3 * 2**20}
    monkeypatch.setattr(blocksar, "focus", lambda *_, **__: SimpleNamespace(result=record))
    monkeypatch.setattr(blocksar, "quality", lambda _: SimpleNamespace(result={"targets": found}))
    row = {"processor": "angular-division", "coefficients": "fitted", "blocks": 1}
    measured = modules["study"].measure(row, tmp_path, tmp_path, None)
    assert (measured["measured_pslr_db"], measured["measured_memory_mib"]) == (-11, 3)
    assert measured["measured_width"] == pytest.approx(1.1)
    found[0]["azimuth_pslr"] = None  # too blurred to measure
    assert np.isnan(modules["study"].measure(row, tmp_path, tmp_path, None)["measured_pslr_db"])


def test_invalid_studies_are_refused(
    modules: dict[str, ModuleType], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(blocksar.InputError, match="grid is missing"):
        modules["study"].main("paper_b", blocks="1")
    assert not list(tmp_path.iterdir())
    numbers = modules["study"].parse_numbers
    assert numbers("4,1,4", "--blocks") == [1, 4]
    for text in ("1,x", "", "0", "1,-2", "1.5"):
        with pytest.raises(blocksar.InputError, match=r"^--blocks is '.*'; give numbers of blocks"):
            numbers(text, "--blocks")


# ---------------------------------------------------------------- on_a_cluster


def test_a_run_on_a_cluster_survives_an_interrupt_and_a_killed_worker(tmp_path: Path) -> None:
    """After Ctrl-C and a killed worker the image is complete and correct."""
    words = ("--local-test", "--out", "run", "--blocks", "4", "--report", "report.html")
    said = run("on_a_cluster", *words, cwd=tmp_path).stdout
    events = [said.index(text) for text in ("(Ctrl-C)", "interrupted; the same call", "(kill -9 of", "went on from")]
    assert events == sorted(events)
    assert re.search(r"went on from an unfinished run: .*\b2 of 4 blocks", said)
    assert said.count("worker tcp://127.0.0.1") == 2 and "is shared by all workers" in said
    worst = blocksar.quality(tmp_path / "run").result["summary"]
    assert worst["measured"] == 9
    assert worst["worst"]["azimuth_irw_over_theory"]["value"] == pytest.approx(1, abs=0.02)
    assert "bokeh" in (tmp_path / "report.html").read_text(encoding="utf-8").lower()
    assert not list(tmp_path.glob(".probe-*"))


def test_unsuitable_workers_are_reported_by_address(modules: dict[str, ModuleType], tmp_path: Path) -> None:
    cluster, here = modules["cluster"], {"blocksar": blocksar.__version__, "numpy": "2.1"}

    def versions(**there: str) -> Any:
        known = dict.fromkeys(cluster.PACKAGES, "1") | here
        found = {"client": {"packages": known}, "workers": {"tcp://w:1": {"packages": known | there}}}
        return SimpleNamespace(get_versions=lambda packages: found)

    cluster.check_versions(versions(numpy="2.2"))
    with pytest.raises(blocksar.InputError, match=r"tcp://w:1 has blocksar 9\.9, but here is .*; install the same"):
        cluster.check_versions(versions(blocksar="9.9"))

    def elsewhere(mark: Any, on_error: str) -> dict[str, object]:
        assert on_error == "return"
        return {"tcp://w:1": mark(SimpleNamespace(id="w1")), "tcp://w:2": FileNotFoundError("no such folder")}

    with pytest.raises(blocksar.InputError, match=r"^tcp://w:2 does not share .*no such folder"):
        cluster.check_folder(SimpleNamespace(run=elsewhere), tmp_path)
    with pytest.raises(blocksar.InputError, match=r"^tcp://w:3 does not share"):  # writes elsewhere
        cluster.check_folder(SimpleNamespace(run=lambda mark, on_error: {"tcp://w:3": "w3"}), tmp_path)
    assert not list(tmp_path.iterdir())


def test_workers_that_come_late_are_waited_for(
    modules: dict[str, ModuleType], capsys: pytest.CaptureFixture[str]
) -> None:
    settings: dict[str, Any] = {"n_workers": 0, "threads_per_worker": 1, "processes": False, "memory_limit": 2**30}
    with LocalCluster(**settings, dashboard_address="127.0.0.1:0") as threads, Client(threads) as client:
        with pytest.raises(blocksar.InputError, match="scheduler has no worker; start some"):
            modules["cluster"].print_workers(client, 0.0)
        threads.adapt(minimum=0, maximum=1)  # once there is a task
        modules["cluster"].print_workers(client, 1e6)
    assert capsys.readouterr().out.startswith(
        "note: the dask scheduler has no worker: waiting for one, at most 1e+06 s\n"
    )


# ---------------------------------------------------------------- all tutorials


@pytest.mark.parametrize("name", TUTORIALS)
def test_a_tutorial_uses_only_public_names(name: str) -> None:
    tree = ast.parse((WORKFLOWS / f"{name}.py").read_text(encoding="utf-8"))
    taken = [alias.name for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) for alias in n.names]
    taken += [n.attr for n in ast.walk(tree) if isinstance(n, ast.Attribute)]
    assert not [word for word in taken if word.startswith("_") and not word.startswith("__")]
