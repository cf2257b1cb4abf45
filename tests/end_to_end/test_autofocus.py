"""Correction of a track from the samples: the store that it writes, resuming, refusals, and focusing with it."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import wrong_tracks
from distributed import Client

import blocksar
from blocksar import stores
from blocksar.collection.terrain import Terrain
from blocksar.errors import InputError
from blocksar.graph import cluster
from blocksar.measurement.targets import Target
from blocksar.places import place
from blocksar.places.place import Place


class Corrected(NamedTuple):
    """A phase history with a wrong track, its correction, the report about it, and the control points' file."""

    source: Path
    store: Path
    report: Any
    control: Path


@pytest.fixture(scope="module")
def corrected(tmp_path_factory: pytest.TempPathFactory) -> Corrected:
    folder = tmp_path_factory.mktemp("autofocus")
    source, out, control = wrong_tracks.make(folder), folder / "corrected.zarr", folder / "control.json"
    control.write_text(json.dumps(stores.open_phase_history(source).attrs["targets"][:4]))
    report = blocksar.autofocus(source, out, grid=wrong_tracks.GRID, control=control, workers=0)
    return Corrected(source, out, report, control)


def files(store: Path) -> dict[str, bytes]:
    """All files of a store; of the group's metadata, what does not tell the time."""
    found = {str(path.relative_to(store)): path.read_bytes() for path in store.rglob("*") if path.is_file()}
    group = json.loads(found["zarr.json"])
    group["attributes"].pop("history")
    return {**found, "zarr.json": json.dumps(group).encode()}


@pytest.mark.slow
def test_the_track_is_corrected_and_nothing_else_changes(corrected: Corrected) -> None:
    source, store, report, _ = corrected
    assert wrong_tracks.residual_phase(source, source) > 5
    assert wrong_tracks.residual_phase(store, source) < 0.1
    assert sorted(path.name for path in store.parent.iterdir()) == [
        "control.json", "corrected.zarr", "ph.truth.zarr", "ph.zarr", "scene.toml",
    ]  # fmt: skip
    before, after = stores.open_phase_history(source), stores.open_phase_history(store)
    assert np.array_equal(before.read(slice(None), slice(None)), after.read(slice(None), slice(None)))
    for name, value in before.collection.as_dict().items():
        same = np.array_equal(getattr(after.collection, name), value, equal_nan=isinstance(value, np.ndarray))
        assert same == (name != "antenna_position"), name
    original = stores.open_dataset(store)[stores.ORIGINAL]
    assert np.array_equal(original, before.collection.antenna_position)
    attribute = after.attrs.pop("autofocus")
    assert attribute == report.result
    assert attribute["points"] >= 20 and attribute["entropy_after"] < attribute["entropy_before"] - 1
    line, earlier = after.attrs.pop("history").split("\n")
    assert "track corrected by blocksar" in line and earlier == before.attrs.pop("history")
    assert after.attrs == before.attrs
    assert report.summary[0].startswith("track corrected by up to")


@pytest.mark.slow
def test_control_points_anchor_the_phase(corrected: Corrected) -> None:
    figures = corrected.report.result["control"]
    assert figures["points"] == 4 and figures["phase_left"] < 0.2
    phases = wrong_tracks.phase_errors(corrected.store, corrected.source)
    turns = np.round(phases.mean() / (2 * np.pi))
    assert np.abs(phases - 2 * np.pi * turns).max() < 1.0  # everywhere, not at the control points only


def test_the_same_command_again_does_nothing_and_another_is_refused(corrected: Corrected) -> None:
    source, store, report, control = corrected
    before = files(store)
    again = blocksar.autofocus(source, store, grid=wrong_tracks.GRID, control=control, workers=0)
    assert again.result == report.result
    assert again.summary == [f"{store} is finished already with these settings and this input: nothing to do"]
    with pytest.raises(InputError, match="exists; choose another name"):
        blocksar.autofocus(source, store, grid=wrong_tracks.GRID, workers=0)
    (link := source.with_name("link.zarr")).symlink_to(source)
    for out in (source, source / "inside.zarr", source.parent, link / "inside.zarr"):
        with pytest.raises(InputError, match="lie in each other"):
            blocksar.autofocus(source, out, grid=wrong_tracks.GRID, workers=0)
    with pytest.raises(InputError, match="grid is missing"):
        blocksar.autofocus(source, store.with_name("other.zarr"), workers=0)
    assert files(store) == before
    assert not [path.name for path in store.parent.iterdir() if path.name.endswith(".autofocus")]


@pytest.mark.slow
def test_an_interrupted_command_goes_on_to_the_same_bytes(
    corrected: Corrected, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """But samples that change before they are copied are not taken with the track of others."""
    out, other, copied = tmp_path / "again.zarr", tmp_path / "other.zarr", stores.files_to_copy
    settings: dict[str, Any] = {"grid": wrong_tracks.GRID, "control": corrected.control, "workers": 0}
    sample = next(path for path in (corrected.source / "signal" / "c").rglob("*") if path.is_file())
    written = sample.stat().st_mtime_ns

    def interrupted(store: Place) -> Any:
        raise KeyboardInterrupt

    def changed(store: Place) -> Any:
        os.utime(sample, (1, 1))
        return copied(store)

    with monkeypatch.context() as patch:
        patch.setattr(stores, "files_to_copy", interrupted)
        with pytest.raises(KeyboardInterrupt):
            blocksar.autofocus(corrected.source, out, **settings)
    assert not out.exists()
    shutil.copytree(f"{out}.autofocus", f"{other}.autofocus")
    report = blocksar.autofocus(corrected.source, out, **settings)
    assert any(line.startswith("went on from an unfinished estimate") for line in report.summary)
    assert files(out) == files(corrected.store)
    monkeypatch.setattr(stores, "files_to_copy", changed)
    try:
        with pytest.raises(InputError, match=r"ph.zarr changes while it is read"):
            blocksar.autofocus(corrected.source, other, **settings)
    finally:
        os.utime(sample, ns=(written, written))
    assert [path.name for path in tmp_path.iterdir()] == ["again.zarr"]


def test_what_others_put_into_the_work_folder_stays(corrected: Corrected, tmp_path: Path) -> None:
    settings: dict[str, Any] = {"grid": wrong_tracks.GRID, "control": corrected.control, "workers": 0}
    for name in ("notes.txt", "0/notes.txt", "store.zarr/notes.txt", "0", "run.json"):
        foreign = tmp_path / name.replace("/", "-") / "again.zarr.autofocus" / name
        foreign.parent.mkdir(parents=True)
        foreign.write_text('["mine"]')
        folder = foreign.parents[name.count("/")]
        with pytest.raises(InputError, match="is not of an estimate of the track"):
            blocksar.autofocus(corrected.source, folder.with_name("again.zarr"), **settings)
        assert foreign.read_text() == '["mine"]' and [path.name for path in folder.parent.iterdir()] == [folder.name]
    for folder in (tmp_path / "run" / "autofocus", tmp_path / "run" / "autofocus" / "0"):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "notes.txt").write_text("mine")
        with pytest.raises(InputError, match=r"holds no run of blocksar \(but autofocus\)"):
            blocksar.focus(corrected.source, tmp_path / "run", autofocus=True, **settings)
        assert (folder / "notes.txt").read_text() == "mine"
        (folder / "notes.txt").unlink()


REFUSED = {
    "half of the pulses missing": wrong_tracks.targets() + "[dropped]\nfraction = 0.5\nseed = 1\n",
    "an empty scene": '[[targets]]\nname = "P"\nx = 3.0\ny = 4.0\namplitude = 0.0\n',
}


@pytest.mark.slow
@pytest.mark.parametrize("case", [*REFUSED, pytest.param("noise alone", marks=pytest.mark.slow)])
def test_samples_that_do_not_tell_are_refused_and_nothing_is_left(case: str, tmp_path: Path) -> None:
    source = wrong_tracks.make(tmp_path, REFUSED.get(case, "[noise]\npower = 1.0\nseed = 4\n"))
    before = sorted(path.name for path in tmp_path.iterdir())
    with pytest.raises(InputError) as caught:
        blocksar.autofocus(source, tmp_path / "corrected.zarr", grid=wrong_tracks.GRID, workers=0)
    assert "\n" not in str(caught.value) and any(character.isdigit() for character in str(caught.value))
    assert sorted(path.name for path in tmp_path.iterdir()) == before
    with pytest.raises(InputError, match=str(caught.value)[:20]):
        blocksar.focus(source, tmp_path / "run", grid=wrong_tracks.GRID, autofocus=True, workers=0)
    assert sorted(path.name for path in tmp_path.iterdir()) == before


@pytest.mark.slow
def test_focus_with_autofocus_is_the_two_in_one(
    corrected: Corrected, client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started = []

    class Started(cluster.Starting):
        def __init__(self, workers: int, *_: Any, **__: Any) -> None:
            started.append(workers)

        def client(self) -> Client:
            return client

        def __exit__(self, *_: Any) -> None:
            pass

    monkeypatch.setattr(cluster, "Starting", Started)
    monkeypatch.setattr(cluster, "prepare_workers", lambda *_: None)
    settings: dict[str, Any] = {"grid": wrong_tracks.GRID, "workers": 1, "processor": "backprojection"}
    anchored = {**settings, "control": corrected.control}
    both = blocksar.focus(corrected.source, tmp_path / "both", autofocus=True, **anchored)
    assert started == [1]
    assert both.summary[0].startswith("track corrected by up to")
    blocksar.focus(corrected.store, tmp_path / "second", **settings)
    image, second = (np.array(blocksar.open(tmp_path / name)["image"]) for name in ("both", "second"))
    assert np.array_equal(image, second)
    assert both.result["settings"]["autofocus"] is True
    quality = blocksar.quality(tmp_path / "both", targets=[])
    assert quality.result["autofocus"]["points"] == corrected.report.result["points"]
    again = blocksar.focus(corrected.source, tmp_path / "both", autofocus=True, **anchored)
    assert "nothing to do" in again.summary[0]
    assert not (tmp_path / "both" / "autofocus").exists()
    with pytest.raises(InputError, match="holds a run with autofocus"):
        blocksar.focus(corrected.source, tmp_path / "both", **settings)
    with pytest.raises(InputError, match="control is given without autofocus"):
        blocksar.focus(corrected.source, tmp_path / "other", **anchored)


HILL = "[terrain]\nhills = [{x = 0.0, y = 0.0, height = 30.0, width = 40.0}]\n"


@pytest.mark.slow
def test_points_stand_on_the_terrain(tmp_path: Path) -> None:
    source, out, terrain = (
        wrong_tracks.make(tmp_path, wrong_tracks.targets() + HILL),
        tmp_path / "c.zarr",
        tmp_path / "t",
    )
    at = np.arange(-100, 101, 4.0)
    hill = Terrain(x0=-100.0, dx=4.0, y0=-100.0, dy=4.0, heights=30 * np.exp(-(at**2 + at[:, None] ** 2) / 2 / 40**2))
    stores.write_terrain(place(terrain), hill)
    high = [Target(name="H", x=x, y=0.0) for x in (0.0, 300.0)]
    with pytest.raises(InputError, match="control point H has no z, and the terrain has no height there"):
        blocksar.autofocus(source, out, grid=wrong_tracks.GRID, terrain=terrain, control=high, workers=0)
    report = blocksar.autofocus(source, out, grid=wrong_tracks.GRID, terrain=terrain, workers=0)
    assert report.result["settings"]["terrain"] == str(terrain) and report.result["settings"]["heights"]
    assert wrong_tracks.residual_phase(out, source) < 0.1


@pytest.mark.slow
def test_a_raw_echo_is_corrected_too(tmp_path: Path) -> None:
    source = wrong_tracks.make(tmp_path, raw=True)
    blocksar.autofocus(source, tmp_path / "corrected.zarr", grid=wrong_tracks.GRID, workers=0)
    assert wrong_tracks.residual_phase(tmp_path / "corrected.zarr", source) < 0.1
    assert stores.open_phase_history(tmp_path / "corrected.zarr").raw is not None
