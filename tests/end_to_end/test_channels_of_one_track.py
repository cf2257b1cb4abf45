"""Channels and looks with a track that is wrong: one estimate for all of them, from the channel that tells most."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import wrong_tracks
import xarray as xr
import zarr
from faults import digests

import blocksar
from blocksar import stores
from blocksar.application import tracks
from blocksar.collection.geometry import Geometry
from blocksar.errors import InputError
from blocksar.measurement.coherence import coherence
from blocksar.processors.exact.sums import form_image

CHANNELS = 'channels = ["HH", "HV"]\n'
GRID = ((-45.0, 45.0, 0.75), (-45.0, 45.0, 0.75))
SETTINGS: dict[str, Any] = {"grid": GRID, "blocks": 2, "autofocus": True, "workers": 0}
TRACK = "track corrected by up to"


def scene() -> str:
    """Thirty points in HV, six of them in HH: too few for the track."""
    text = ""
    for number, point in enumerate(wrong_tracks.targets().split("[[targets]]")[1:]):
        seen = "HH = [0.7, 60.0], " if number < 6 else ""
        text += f"[[targets]]{point}scattering = {{{seen}HV = [1.0, 0.0]}}\n"
    return text


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return wrong_tracks.make(tmp_path_factory.mktemp("channels"), scene(), top=CHANNELS)


@pytest.fixture(scope="module")
def run(store: Path) -> Path:
    folder = store.with_name("run")
    calls, estimate = [], tracks.estimate_track

    def counted(*given: Any) -> Any:
        calls.append(given)
        return estimate(*given)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tracks, "estimate_track", counted)
        report = blocksar.focus(store, folder, **SETTINGS)
    assert len(calls) == 1
    (said,) = (line for line in report.summary if TRACK in line)
    assert " points of channel HV" in said
    return folder


@pytest.mark.slow
def test_the_channel_that_tells_most_mends_the_track_of_all(store: Path, run: Path, tmp_path: Path) -> None:
    images = blocksar.open(run)
    assert images.channel.values.tolist() == ["HH", "HV"]
    for name in ("HH", "HV"):
        history = stores.open_phase_history(store).of_channel(name)
        used, _ = stores.read_collection(run / "channels" / name / "collection.zarr")
        corrected = replace(history.collection, antenna_position=used.antenna_position)
        assert wrong_tracks.residual_phase(history.collection, store) > 5
        assert wrong_tracks.residual_phase(corrected, store) < 0.1
        geometry = Geometry(collection=corrected.centred())
        exact = form_image(
            lambda pulses, history=history: history.read(pulses, slice(None)),
            geometry, images.x.values, images.y.values, threads=1,
        )  # fmt: skip
        assert abs(coherence(images.image.sel(channel=name).values, exact).coherence) > 0.999
    assert not (run / "autofocus").exists()
    assert not [path for path in (run / "channels").glob("*/autofocus")]
    alone = tmp_path / "hh.zarr"
    with xr.open_zarr(store) as whole:
        blocksar.write(whole.isel(channel=0), alone)
    with pytest.raises(InputError):
        blocksar.autofocus(alone, tmp_path / "refused.zarr", grid=GRID, workers=0)


@pytest.mark.slow
def test_a_change_of_one_channel_is_a_change_of_the_track_of_all(store: Path, run: Path, tmp_path: Path) -> None:
    """Also of those that were finished before."""
    aside, folder = tmp_path / "ph.zarr", tmp_path / "run"
    shutil.copytree(store, aside)
    shutil.copytree(run, folder)
    first = digests(folder)
    signal_ = zarr.open_group(store, mode="r+")["signal"]
    signal_[1] = signal_[1] * np.exp(1j * np.linspace(0, 3, signal_.shape[1]) ** 2)[:, None]
    try:
        with pytest.raises(InputError, match="holds a run with track_input"):
            blocksar.focus(store, folder, **SETTINGS)
        assert digests(folder) == first
    finally:
        shutil.rmtree(store)
        aside.rename(store)


@pytest.mark.slow
def test_samples_that_do_not_tell_leave_an_earlier_run_as_it_was(run: Path, tmp_path: Path) -> None:
    noise = wrong_tracks.make(tmp_path, scene().replace("1.0, 0.0", "0.0, 0.0").replace("0.7", "0.001"), top=CHANNELS)
    shutil.copytree(run, tmp_path / "run")
    before = digests(tmp_path / "run")
    for folder in ("run", "new"):
        with pytest.raises(InputError, match=r"channel H[HV]: "):
            blocksar.focus(noise, tmp_path / folder, overwrite=True, **SETTINGS)
    assert digests(tmp_path / "run") == before
    assert not (tmp_path / "new").exists() and not (tmp_path / "run" / "autofocus").exists()


@pytest.mark.slow
def test_looks_have_the_track_of_the_whole_dwell(store: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"has several channels .*; write one of them"):
        blocksar.focus(store, tmp_path / "several", looks=2, **SETTINGS)
    blocksar.autofocus(store, tmp_path / "corrected.zarr", grid=GRID, workers=0)
    for name, source, autofocus in (("looks", store, True), ("then", tmp_path / "corrected.zarr", False)):
        one = stores.open_phase_history(source).of_channel("HV")
        report = blocksar.focus(one, tmp_path / name, looks=2, **SETTINGS | {"autofocus": autofocus})
        assert sum(TRACK in line for line in report.summary) == autofocus
    assert digests(tmp_path / "looks" / "image.zarr" / "image") == digests(tmp_path / "then" / "image.zarr" / "image")
    assert not (tmp_path / "looks" / "autofocus").exists()
