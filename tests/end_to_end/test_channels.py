"""Runs of several channels: each image is that of its own run, and the whole resumes, measures and exports."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
import zarr
from faults import digests
from matplotlib.image import imread
from scenes import scene

import blocksar
from blocksar import stores
from blocksar.application import joint
from blocksar.errors import FolderError, InputError, ProcessingError

TARGETS = """
[[targets]]
name = "T"
range = 30000.0
yaw_deg = 50.0
[[targets]]
name = "D"
range = 30030.0
yaw_deg = 50.05
amplitude = 2.0
scattering = {HV = [0.5, 90.0]}
[clutter]
scatterers = 300
power = 1e-4
seed = 3
"""
GRID = ((16040.0, 16180.0, 1.0), (19135.0, 19275.0, 1.0))  # about T and D
SETTINGS: dict[str, Any] = {"blocks": 1, "workers": 0, "coefficients": "closed-form", "grid": GRID}


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("channels")
    text = scene(pulses=400, steering=(49.5, 50.5), dwell=0.02, swath=[29900.0, 30100.0], more=TARGETS)
    (folder / "scene.toml").write_text(f'channels = ["HH", "HV"]\n{text}')
    return Path(blocksar.simulate(folder / "scene.toml", folder / "ph.zarr"))


@pytest.fixture(scope="module")
def run(store: Path) -> Path:
    blocksar.focus(store, store.parent / "run", **SETTINGS)
    return store.parent / "run"


def test_each_channel_is_as_it_would_be_alone(store: Path, run: Path, tmp_path: Path) -> None:
    images = blocksar.open(run)
    assert images.image.dims == ("channel", "y", "x") and images.block.dims == ("y", "x")
    assert images.channel.values.tolist() == ["HH", "HV"]
    history = stores.open_phase_history(store).of_channel("HV")
    blocksar.focus(history, tmp_path / "HV", **SETTINGS)
    assert digests(tmp_path / "HV" / "image.zarr" / "image" / "c") == digests(
        run / "channels" / "HV" / "image.zarr" / "image" / "c"
    )
    alone = blocksar.open(tmp_path / "HV")
    assert np.array_equal(images.image.sel(channel="HV").values, alone.image.values, equal_nan=True)
    assert np.array_equal(images.block.values, alone.block.values)
    assert not np.array_equal(images.image[0].values, images.image[1].values, equal_nan=True)
    assert images.sar.db().dims == ("channel", "y", "x")
    assert images.sar.multilook("2x3").sizes["channel"] == 2
    with pytest.raises(InputError, match=r"2 channels; choose one, such as ds.sel\(channel='HH'\)"):
        images.sar.cut(0.0, 0.0)


@pytest.mark.slow
def test_the_image_of_all_has_the_pyramids_of_each(store: Path, run: Path, tmp_path: Path) -> None:
    x, y = (float(blocksar.open(run)[axis].mean()) for axis in "xy")
    grid = ((x - 135, x + 135, 0.5), (y - 5, y + 5, 0.5))  # 540 pixels: one level
    settings = {**SETTINGS, "grid": grid, "pyramid": True}
    blocksar.focus(store, tmp_path / "run", **settings)
    image = tmp_path / "run" / "image.zarr"
    level = xr.open_zarr(image, group="pyramid/1").power
    assert level.shape == (2, 10, 270) and level.channel.values.tolist() == ["HH", "HV"]
    for name in ("HH", "HV"):
        part = Path("channels", name, "image.zarr", "pyramid", "1")
        own = xr.open_zarr(tmp_path / "run" / part.parents[1], group="pyramid/1").power
        assert np.isfinite(own).any()
        xr.testing.assert_equal(level.sel(channel=name).drop_vars("channel"), own)
    assert digests(image / "pyramid/1/power/c/1") == digests(tmp_path / "run" / part / "power" / "c")
    attrs = xr.open_zarr(image).attrs
    assert [each["asset"] for each in attrs["multiscales"]["layout"]] == ["image", "pyramid/1/power"]
    chunk = image / "pyramid/1/power/c/0/0/0"
    chunk.unlink()
    with pytest.raises(InputError, match="pyramid/1/power/c/0/0/0"):
        blocksar.focus(store, tmp_path / "run", **settings)


def test_a_channel_without_samples_is_named_and_costs_no_run(
    store: Path, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bad = tmp_path / "bad.zarr"
    shutil.copytree(store, bad)
    signal = zarr.open_group(bad, mode="r+")["signal"]
    signal[1] = np.full(signal.shape[1:], np.nan, np.complex64)
    before = digests(run)
    with pytest.raises(InputError, match=r"^channel HV: signal in .* holds no valid sample"):
        blocksar.focus(bad, run, overwrite=True, **SETTINGS)
    assert digests(run) == before
    # Found later, as other faults of samples are, it leaves nothing of the channel before.
    monkeypatch.setattr(joint, "_refuse_empty", lambda members: None)
    with pytest.raises(InputError, match=r"^channel HV: signal in .* holds no valid sample"):
        blocksar.focus(bad, tmp_path / "new", **SETTINGS)
    assert not (tmp_path / "new").exists()


@pytest.mark.slow
def test_every_channel_is_measured_shown_and_exported(run: Path, tmp_path: Path) -> None:
    seen = {}
    for name in ("HH", "HV"):
        found = blocksar.quality(run, channel=name, reference=name == "HV").result
        seen[name] = {target["name"]: target for target in found["targets"]}
    assert min(chip["coherence"] for chip in found["reference"]) > 0.99 and "changed_input" not in found
    assert list(seen["HH"]) == ["T"] and list(seen["HV"]) == ["T", "D"]
    assert abs(complex(*seen["HV"]["D"]["value"])) == pytest.approx(1.0, abs=0.05)
    said = blocksar.export("png", run, tmp_path / "hv.png", channel="hv").summary
    assert imread(tmp_path / "hv.png").std() > 0.05 and said[-1].endswith("hv.png")
    with pytest.raises(InputError, match="channel 'VV' is none of"):
        blocksar.export("png", run, tmp_path / "vv.png", channel="VV")
    facts = blocksar.info(run).result["facts"]
    assert facts["channels"] == "HH, HV" and facts["title"] == "test" and "track" in facts
    pages = [run / "channels" / name / "report.html" for name in ("HH", "HV")]
    assert Path(str(blocksar.report(run).result)) == pages[0]
    first, second = (page.read_text() for page in pages)
    assert 'href="../HV/report.html"' in first and '<strong aria-current="page">HH</strong>' in first
    assert 'href="../HH/report.html"' in second
    assert f"--out {run} " in first.replace("\n", " ")  # the command that repeats the whole


@pytest.mark.slow
def test_a_run_that_fails_as_channels_are_joined_goes_on_to_the_same_bytes(
    store: Path, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A channel that was damaged meanwhile is noticed, also if its time of modification does not tell."""

    def full(*_: Any) -> Any:
        raise ProcessingError("no room") from OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(joint, "share_chunk", full)
        with pytest.raises(ProcessingError, match=r"No space left on device.*; what was finished stays, the same com"):
            blocksar.focus(store, tmp_path / "run", **SETTINGS)
    record = tmp_path / "run" / "run.json"
    assert json.loads(record.read_text())["status"] == "unfinished"
    with pytest.raises(InputError, match="is not finished"):
        blocksar.open(tmp_path / "run")
    chunk = tmp_path / "run" / "channels" / "HH" / "image.zarr" / "image" / "c" / "0" / "0"
    data, written = chunk.read_bytes(), chunk.stat().st_mtime_ns
    for content in (data[:-1] + bytes([data[-1] ^ 1]), data):
        chunk.write_bytes(content)
        os.utime(chunk, ns=(written, written))
        if content != data:
            with pytest.raises(
                FolderError,
                match=r"HH was finished, but its image has 1 .* \(first: image/c/0/0\); use overwrite=T",
            ):
                blocksar.focus(store, tmp_path / "run", **SETTINGS)
    summary = blocksar.focus(store, tmp_path / "run", overwrite=True, **SETTINGS).summary  # of a run that is unfinished
    assert sum("nothing to do" in line for line in summary) == 2
    assert digests(tmp_path / "run" / "image.zarr" / "image") == digests(run / "image.zarr" / "image")
    before = record.stat().st_mtime_ns
    assert "nothing to do" in blocksar.focus(store, tmp_path / "run", **SETTINGS).summary[0]
    assert record.stat().st_mtime_ns == before


@pytest.mark.slow
def test_other_runs_are_not_replaced_unasked(store: Path, run: Path, tmp_path: Path) -> None:
    with pytest.raises(FolderError, match="holds a run with blocks 1"):
        blocksar.focus(store, run, **{**SETTINGS, "blocks": 2})
    shutil.copytree(run / "channels" / "HV", tmp_path / "run")
    for dry in (True, False):
        with pytest.raises(FolderError, match="holds a run without channels"):
            blocksar.focus(store, tmp_path / "run", dry_run=dry, **SETTINGS)
    blocksar.focus(store, tmp_path / "run", overwrite=True, **SETTINGS)
    assert blocksar.open(tmp_path / "run").image.shape[0] == 2
    rehearsed = blocksar.focus(store, tmp_path / "other", dry_run=True, **SETTINGS)
    assert "2 channels (HH, HV)" in rehearsed.summary[0] and not (tmp_path / "other").exists()


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [{"memory_limit": "20MiB"}, {"grid": "0:10:1,0:10:1"}])
def test_wrong_input_replaces_no_earlier_run_and_leaves_no_files(
    wrong: dict[str, Any], store: Path, run: Path, tmp_path: Path
) -> None:
    """Neither a run of channels nor one without; nor of workers, before they are started and when they are."""
    settings: dict[str, Any] = SETTINGS | {"workers": 1} | wrong
    with pytest.raises(InputError, match=r"memory limit|outside the swath"):
        blocksar.focus(store, tmp_path / "run", **settings)
    assert not (tmp_path / "run").exists()
    for earlier in (run, run / "channels" / "HV"):
        shutil.copytree(earlier, tmp_path / "run")
        before = digests(tmp_path / "run")
        with pytest.raises(InputError, match=r"memory limit|outside the swath"):
            blocksar.focus(store, tmp_path / "run", overwrite=True, **settings)
        assert digests(tmp_path / "run") == before
        assert blocksar.info(tmp_path / "run").result["facts"]["state"].startswith("finished")
        assert sorted(path.name for path in (tmp_path / "run").iterdir()) == sorted(p.name for p in earlier.iterdir())
        shutil.rmtree(tmp_path / "run")


@pytest.mark.slow
def test_leftovers_of_a_killed_run_refuse_no_run_and_foreign_files_do(store: Path, tmp_path: Path) -> None:
    """As for a run of one image."""
    folder = tmp_path / "run"
    (folder / "scratch" / "dask-scratch-space" / "worker-1").mkdir(parents=True)
    (folder / ".run.json.0123abcd.part").write_text("{")
    blocksar.focus(store, folder, **SETTINGS)
    assert blocksar.open(folder).image.shape[0] == 2
    foreign = tmp_path / "foreign" / "scratch" / "notes.txt"
    foreign.parent.mkdir(parents=True)
    foreign.write_text("mine")
    with pytest.raises(FolderError, match=r"holds no run of blocksar \(but scratch\)"):
        blocksar.focus(store, tmp_path / "foreign", **SETTINGS)
    assert foreign.read_text() == "mine"


def test_previews_and_plans_say_the_channels(store: Path) -> None:
    powers = {}
    for name in ("HH", "HV"):
        report = blocksar.preview(store, channel=name, size=60, progress=False)
        assert report.summary[0] == f"channel {name} of HH, HV"
        powers[name] = np.nan_to_num(report.result.values)
    assert not np.array_equal(powers["HH"], powers["HV"])
    assert blocksar.plan(store, blocks=1).summary[0].startswith("2 channels (HH, HV), one after the other")


def test_an_image_of_one_row_opens_and_says_what_it_lacks(store: Path, tmp_path: Path) -> None:
    history = stores.open_phase_history(store).of_channel("HH")
    target = history.attrs["targets"][0]
    x, y = round(target["x"]), round(target["y"])
    grid = ((x - 20.0, x + 20.0, 1.0), (y, y + 0.5, 1.0))
    settings = {**SETTINGS, "grid": grid}
    report = blocksar.focus(history, tmp_path / "row", **settings)
    assert not report.measurable
    assert not blocksar.focus(history, tmp_path / "row", **settings).measurable  # it is finished already
    assert blocksar.info(tmp_path / "row").result["next"] == []
    assert (
        report.summary[-1]
        == "note: quality, report and export take images of at least 2 x 2 pixels; this one opens in Python only"
    )
    image = blocksar.open(tmp_path / "row").image
    assert image.shape == (1, 40) and abs(image).max() > 0.5
    with pytest.raises(InputError, match="has 1 x 40 pixels"):
        blocksar.export("png", tmp_path / "row", tmp_path / "row.png")
