"""`blocksar info`: what a path holds, for everything that blocksar reads and writes."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import small_run
from scenes import UNSTEERED_SCENE
from scipy.io import savemat
from typer.testing import CliRunner

import blocksar
from blocksar import stores
from blocksar.cli import commands
from blocksar.collection.geometry import Geometry
from blocksar.collection.region import default_grid, plan_region
from blocksar.collection.terrain import Terrain
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError
from blocksar.places import place


def facts_of(path: Path | str) -> tuple[str, dict[str, str], list[list[str]]]:
    result: Any = blocksar.info(path).result
    return result["kind"], result["facts"], result["next"]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("info") / "small.toml"
    path.write_text(UNSTEERED_SCENE)
    return path


@pytest.fixture(scope="module")
def store(scene: Path) -> Path:
    return Path(blocksar.simulate(scene, scene.parent / "ph.zarr"))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_run.make(tmp_path_factory.mktemp("info") / "run").folder


def test_a_phase_history_is_described_without_reading_samples(table1: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> Any:
        raise AssertionError("samples were read")

    monkeypatch.setattr(stores.PhaseHistory, "read", refuse)
    kind, facts, following = facts_of(table1)
    assert kind == "phase history"
    collection = stores.open_phase_history(table1).collection
    assert facts["samples"].startswith(f"{collection.n_pulse} pulses x {collection.n_range_frequency} range freq")
    assert facts["pulses"] == "4800 in 0.6 s, PRF 8000 Hz"
    assert facts["band"].startswith("15 GHz, wavelength 2 cm; 50 MHz")
    # Paper A, Table 1: the platform flies at sqrt(40^2 + 1300^2 + 600^2) m/s at t = 0, the beam scans 42.13 .. 57.87.
    assert float(re.findall(r"at (\S+) m/s", facts["track"])[0]) == pytest.approx(math.hypot(40, 1300, 600), rel=1e-3)
    assert "yaw from 42.13 to 57.87 degrees" in facts["beam"] and "squint 48.2" in facts["beam"]
    geometry = Geometry(collection=collection.centred())
    grid = default_grid(geometry, plan_region(geometry, None))
    assert facts["default grid"].startswith(f"{grid.x0:g}:{grid.x1:g}:{grid.dx:g},{grid.y0:g}:")
    assert facts["targets"] == "81 at known positions" and facts["done"].endswith("created by blocksar")
    assert following == [["check", str(table1)], ["plan", str(table1)]]


def test_a_dataset_is_described_as_its_store_is(store: Path, run: Path) -> None:
    opened = blocksar.info(stores.open_dataset(store)).result
    assert opened == blocksar.info(store).result
    changed = stores.open_dataset(store).assign_attrs(title="mine")
    kind, facts, following = facts_of(changed)  # type: ignore[arg-type]
    assert (kind, facts["title"], following) == ("phase history", "mine", []) and "on disk" not in facts
    assert facts["track"] == opened["facts"]["track"]
    kind, facts, _ = facts_of(blocksar.open(run))  # type: ignore[arg-type]
    assert kind == "image" and facts["grid"] == facts_of(run / "image.zarr")[1]["grid"]
    with pytest.raises(InputError, match="signal"):
        blocksar.info(blocksar.open(run).drop_vars("image"))


def test_an_unsteered_phase_history_needs_a_grid(store: Path) -> None:
    _, facts, following = facts_of(store)
    assert "not steered" in facts["beam"] and "default grid" not in facts
    assert facts["range"].startswith("8000 m")
    assert following[-1] == ["plan", str(store), "--grid", "x0:x1:dx,y0:y1:dy"]


def test_a_run_says_what_was_done_and_what_is_next(run: Path) -> None:
    kind, facts, following = facts_of(run)
    assert (kind, facts["state"]) == ("run", "finished")
    assert facts["origin"].startswith("39.780000, -84.090000 degrees, 250.0 m")
    assert facts["targets"] == "4 at known positions"
    assert following == [["quality", str(run)], ["report", str(run)], ["export", "png", str(run), "--out", "run.png"]]
    (run / "quality.json").write_text("{}")
    assert facts_of(run)[1]["also made"] == "quality.json" and facts_of(run)[2][0] == ["report", str(run)]
    record = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(json.dumps(record | {"status": "unfinished", "input": {"path": "/old/ph.zarr"}}))
    kind, facts, following = facts_of(run)
    assert (kind, facts["state"]) == ("unfinished run", "not finished; begun")
    assert following == [["focus", "/old/ph.zarr", "--out", str(run)]]
    (run / "run.json").write_text(json.dumps(record))


def test_settings_of_a_run_are_named_unless_they_are_defaults(run: Path) -> None:
    record = json.loads((run / "run.json").read_text())
    settings = {"processor": "angular-division", "blocks": 3, "fidelity": 0.999, "keystone": True, "grid": None}
    (run / "run.json").write_text(json.dumps(record | {"settings": settings}))
    assert facts_of(run)[1]["settings"] == "processor angular-division, blocks 3"
    (run / "run.json").write_text(json.dumps(record))


def test_an_image_and_a_collection_are_described(run: Path) -> None:
    kind, facts, _ = facts_of(run / "image.zarr")
    assert kind == "image" and facts["grid"] == "-30:30:0.4,-26:26:0.4 (150 x 130 pixels)"
    kind, facts, _ = facts_of(run / "collection.zarr")
    assert kind.startswith("collection") and facts["pulses"].startswith("160 in")


def test_stores_beside_an_image_are_told_apart(run: Path, tmp_path: Path) -> None:
    stores.create(
        tmp_path / "patch.zarr", stores.PATCH, sizes={}, attrs={}, chunks={"y": 4, "x": 4},
        coords={"y": np.arange(4.0), "x": np.arange(4.0)},
    )  # fmt: skip
    assert facts_of(tmp_path / "patch.zarr")[0] == "one block's part of a run's image"
    stores.write_truth(tmp_path / "truth.zarr", np.arange(3.0), np.zeros((3, 3)))
    assert facts_of(tmp_path / "truth.zarr")[0].startswith("the track as flown")
    stores.write_terrain(place(tmp_path / "terrain.zarr"), Terrain.flat(1.0, (0.0, 9.0), (0.0, 9.0)))
    assert facts_of(tmp_path / "terrain.zarr")[0] == "the terrain of a run"


def test_a_scene_file_and_a_shipped_scene_are_described(scene: Path, tmp_path: Path, monkeypatch: Any) -> None:
    kind, facts, following = facts_of(scene)
    assert (kind, facts["holds"]) == ("scene", "1 point target")
    assert following[1] == ["simulate", str(scene), "--out", "small.zarr"]
    monkeypatch.chdir(tmp_path)
    assert facts_of("table1")[0] == "shipped scene"


def test_a_cphd_file_is_described(scene: Path) -> None:
    pytest.importorskip("sarkit", reason="the extra `formats` is not installed")
    path = Path(blocksar.simulate(scene, scene.with_name("small.cphd"), cphd=True, origin=(-33.5, 151.2, 40.0)))
    kind, facts, following = facts_of(path)
    assert kind == "CPHD file" and facts["format"].startswith("CPHD 1.1.0, FX domain")
    assert "(160 vectors x " in facts["channels"]
    assert facts["origin"].startswith("-33.500000, 151.200000 degrees, 40.0 m")
    assert facts["pulses"].startswith("160 in 0.4 s") and facts["track"].split(" at ")[1].startswith("120 m/s")
    assert following == [["ingest", "cphd", str(path), "--out", "small.zarr"]]
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(InputError, match=r"small\.cphd"):
        blocksar.info(path)


def test_a_folder_of_the_gotcha_set_is_described(tmp_path: Path) -> None:
    azimuth = np.radians(np.arange(1.0, 2.0, 0.05))
    position = np.stack([7000 * np.cos(azimuth), 7000 * np.sin(azimuth), np.full(azimuth.size, 7000.0)])
    frequency = 9.3e9 + 1.5e6 * np.arange(32)
    for k in (1, 2):
        x, y, z = (row[None] for row in (position if k == 1 else position * [[1], [1], [1.0]]))
        data = {"fp": np.ones((32, azimuth.size), np.complex64), "freq": frequency[:, None], "x": x, "y": y, "z": z}
        data["r0"] = np.sqrt(x**2 + y**2 + z**2)
        savemat(tmp_path / f"data_3dsar_pass3_az{k:03d}_VV.mat", {"data": data})
    kind, facts, following = facts_of(tmp_path)
    assert kind == "folder of the AFRL Gotcha set"
    assert (facts["pass"], facts["polarization"], facts["azimuth"]) == ("3", "VV", "1.00 .. 1.95 degrees")
    assert facts["band"].startswith(f"{(frequency[0] + frequency[-1]) / 2e9:.6g} GHz; 46.5 MHz in 32")
    assert following == [["ingest", "gotcha", f"{tmp_path}/*.mat", "--out", "gotcha.zarr"]]
    one = tmp_path / "data_3dsar_pass3_az001_VV.mat"
    assert facts_of(one)[2] == [["ingest", "gotcha", str(one), "--out", "gotcha.zarr"]]


def test_the_cell_size_is_that_of_the_bandwidth(store: Path) -> None:
    collection = stores.open_phase_history(store).collection
    assert f"cells of {SPEED_OF_LIGHT / 2 / collection.bandwidth:.3g} m" in facts_of(store)[1]["band"]


def test_the_command_prints_a_table_and_the_next_commands(store: Path) -> None:
    done = CliRunner().invoke(commands.app, ["info", str(store)])
    assert done.exit_code == 0 and "phase history" in done.stdout and "10 GHz" in done.stdout
    assert done.stderr.splitlines()[0] == f"next: blocksar check {store} --grid x0:x1:dx,y0:y1:dy"
    assert CliRunner().invoke(commands.app, ["info", str(store), "-q"]).stderr == ""
