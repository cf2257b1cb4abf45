"""Phase histories in memory: built from arrays, written, planned, focused and resumed."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from arrays import GRID, TARGETS, arrays
from distributed import Client

import blocksar
from blocksar import stores
from blocksar.collection.georeference import Georeference
from blocksar.errors import InputError

CORNER = ((-10.0, 10.0, 0.5), (-10.0, 10.0, 0.5))


@pytest.fixture(scope="module")
def dataset() -> xr.Dataset:
    return blocksar.collection(**arrays())


@pytest.fixture(scope="module")
def store(dataset: xr.Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = blocksar.write(dataset, tmp_path_factory.mktemp("store") / "ph.zarr")
    assert isinstance(path, Path)
    return path


@pytest.fixture(scope="module")
def focused(store: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run from the store."""
    run = tmp_path_factory.mktemp("run") / "run"
    blocksar.focus(store, run, grid=GRID, workers=0, processor="angular-division")
    return run


def pixels(run: Path) -> Any:
    return blocksar.open(run)["image"].values


def focus(source: Any, run: Path, **settings: Any) -> Any:
    return blocksar.focus(source, run, **{"grid": GRID, "workers": 0, "processor": "angular-division", **settings})


# ---------------------------------------------------------------- building and writing


def test_a_store_holds_what_the_arrays_held(dataset: xr.Dataset, store: Path) -> None:
    given = arrays()
    history = stores.open_phase_history(store)
    np.testing.assert_array_equal(history.read(slice(None), slice(None)), given["signal"].astype(np.complex64))
    for name in ("time", "range_frequency", "antenna_position", "beam_azimuth"):
        np.testing.assert_array_equal(getattr(history.collection, name), given[name])
    np.testing.assert_array_equal(history.collection.reference_range, given["reference_range"])
    opened = xr.open_zarr(store)
    for name, variable in dataset.variables.items():
        assert opened[name].attrs["units"] == variable.attrs["units"] == stores.PHASE_HISTORY[str(name)].units
        assert opened[name].attrs["long_name"] == variable.attrs["long_name"]
    assert [target["name"] for target in opened.attrs["targets"]] == ["A", "B", "C"]


def test_a_store_is_not_replaced_unasked(dataset: xr.Dataset, store: Path) -> None:
    with pytest.raises(InputError, match=r"exists; choose another name"):
        blocksar.write(dataset, store)
    with pytest.raises(InputError, match=r"is what the dataset was opened from; write it to another place"):
        blocksar.write(xr.open_zarr(store), store, overwrite=True)


def test_a_channel_of_zeros_is_named(tmp_path: Path) -> None:
    given = arrays()
    channels = {"signal": np.stack([given["signal"], 0 * given["signal"]]), "channel": ["HH", "HV"]}
    with pytest.raises(InputError, match=r"^channel HV: signal in the dataset holds zeros only"):
        focus(blocksar.collection(**{**given, **channels}), tmp_path / "run")


# ---------------------------------------------------------------- focusing


def test_the_image_is_that_of_the_store(
    dataset: xr.Dataset, focused: Path, tmp_path: Path, client: Client, store: Path
) -> None:
    report = focus(dataset, tmp_path / "own")
    assert report.result["input"]["path"] == str(tmp_path / "own" / "input.zarr")
    (blocks,) = {json.loads((run / "run.json").read_text())["plan"]["blocks"] for run in (focused, tmp_path / "own")}
    blocksar.focus(store, tmp_path / "cluster", grid=GRID, client=client, blocks=blocks)  # auto depends on workers
    for run in (tmp_path / "own", tmp_path / "cluster"):
        np.testing.assert_array_equal(pixels(run), pixels(focused))


@pytest.mark.slow
@pytest.mark.parametrize("processor", ["backprojection", None])
def test_pulses_of_zeros_are_missing(processor: str | None, tmp_path: Path) -> None:
    """Under a beam that is not steered, at the ends and inside; amplitudes were those of the pulses that are there."""
    given = arrays(steered=False)
    given["signal"][np.r_[0:30, 200:203, 377:400]] = 0
    settings = {"processor": processor} if processor else {}
    report = focus(blocksar.collection(**given), tmp_path / "run", **settings)
    assert "56 of 400 pulses are missing (56 hold zeros only): counted as not lit" in report.result["warnings"]
    image = np.abs(blocksar.open(tmp_path / "run")["image"])
    for target in TARGETS:
        assert abs(float(image.sel(x=target["x"], y=target["y"])) - 1) < 0.01
    assert float(image.sel(x=0, y=20).max()) < 0.1
    chips = blocksar.quality(tmp_path / "run", reference=True).result["reference"] if not processor else []
    assert all(abs(chip["gain"] - 1) < 0.01 for chip in chips if chip["power"] > 1e-3)


@pytest.mark.slow
def test_a_finished_run_of_the_same_data_is_known_again(dataset: xr.Dataset, tmp_path: Path) -> None:
    focus(dataset, tmp_path / "run", grid=CORNER)
    again = blocksar.collection(**arrays())
    assert "finished already" in focus(again, tmp_path / "run", grid=CORNER).summary[0]
    other = again.assign(signal=again.signal * 2)
    with pytest.raises(InputError, match=r"holds a run with another input, not what is asked for now"):
        focus(other, tmp_path / "run", grid=CORNER)
    before = pixels(tmp_path / "run")
    focus(other, tmp_path / "run", grid=CORNER, overwrite=True)
    np.testing.assert_allclose(pixels(tmp_path / "run"), 2 * before, rtol=1e-5)


class Interrupting:
    """Stands for a user who interrupts once the spectrum is recovered."""

    def update(self, stage: str, done: int, total: int) -> None:
        if stage == "focus" and done:
            raise KeyboardInterrupt


@pytest.mark.slow
def test_an_interrupted_run_goes_on_with_the_samples_that_it_kept(
    dataset: xr.Dataset, focused: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        focus(dataset, run, progress=Interrupting())
    kept = (run / "input.zarr" / "zarr.json").stat().st_mtime_ns
    report = focus(blocksar.collection(**arrays()), run)
    assert any(line.startswith("went on from an unfinished run") for line in report.summary)
    assert (run / "input.zarr" / "zarr.json").stat().st_mtime_ns == kept
    np.testing.assert_array_equal(pixels(run), pixels(focused))


@pytest.mark.slow
def test_a_resumed_run_writes_lost_samples_again(dataset: xr.Dataset, focused: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        focus(dataset, run, progress=Interrupting())
    shutil.rmtree(run / "input.zarr")
    focus(dataset, run)
    np.testing.assert_array_equal(pixels(run), pixels(focused))


@pytest.mark.slow
def test_a_run_that_was_moved_is_compared_with_its_own_samples(dataset: xr.Dataset, tmp_path: Path) -> None:
    focus(dataset, tmp_path / "first", grid=((-35.0, 35.0, 0.5), (-35.0, 35.0, 0.5)))
    (tmp_path / "first").rename(tmp_path / "second")
    chips = blocksar.quality(tmp_path / "second", reference=True).result["reference"]
    assert max(chip["coherence"] for chip in chips) > 0.99


# ---------------------------------------------------------------- channels


@pytest.fixture(scope="module")
def channels() -> xr.Dataset:
    """Two channels, the second of which is half as strong."""
    given = arrays()
    return blocksar.collection(
        **{**given, "signal": np.stack([given["signal"], given["signal"] / 2])}, channel=["HH", "VV"]
    )


def test_channels_in_memory_are_written_and_taken_out(channels: xr.Dataset, tmp_path: Path) -> None:
    blocksar.write(channels, tmp_path / "ph.zarr")
    history, own = stores.open_phase_history(tmp_path / "ph.zarr"), stores.history_of(channels)
    assert history.channels == own.channels == ("HH", "VV")
    every = slice(None), slice(None)
    for number, name in enumerate(history.channels):
        expected = channels["signal"].values[number]
        np.testing.assert_array_equal(history.of_channel(name).read(*every), expected)
        np.testing.assert_array_equal(own.of_channel(name).read(*every), expected)
        taken = stores.history_of(xr.open_zarr(tmp_path / "ph.zarr", chunks=None).isel(channel=number))
        assert taken.channels == () and taken.attrs["channel"] == name
        np.testing.assert_array_equal(taken.read(*every), expected)
        assert taken.fingerprint() == own.of_channel(name).fingerprint()


# ---------------------------------------------------------------- what a dataset is


@pytest.mark.slow
def test_a_dataset_as_opened_is_its_store(store: Path, tmp_path: Path) -> None:
    report = focus(xr.open_zarr(store), tmp_path / "run", grid=CORNER)
    assert report.result["input"]["path"] == str(store)
    assert not (tmp_path / "run" / "input.zarr").exists()
    assert not isinstance(stores.history_of(blocksar.open(store)), stores.DatasetHistory)


CHANGES: dict[str, Callable[[xr.Dataset], xr.Dataset]] = {
    "scaled": lambda ds: ds.assign(signal=ds.signal * 2),
    "scaled in place": lambda ds: _doubled(ds.load()),
    "fewer pulses": lambda ds: ds.isel(pulse=slice(20, 380)),
    "fewer frequencies": lambda ds: ds.isel(range_frequency=slice(0, 48)),
    "another track": lambda ds: ds.assign(antenna_position=ds.antenna_position + np.array([0.0, 1.0, 0.0])),
    "another carrier": lambda ds: ds.assign_attrs(carrier_frequency=10.001e9),
}


def _doubled(dataset: xr.Dataset) -> xr.Dataset:
    dataset["signal"].values[...] *= 2
    return dataset


@pytest.mark.parametrize(("change", "lazy"), [*((change, "dask") for change in CHANGES), ("scaled", "lazy")])
def test_a_changed_dataset_is_not_its_store(change: str, lazy: str, store: Path) -> None:
    opened = xr.open_zarr(store) if lazy == "dask" else blocksar.open(store)
    changed = CHANGES[change](opened)
    history = stores.history_of(changed)
    assert isinstance(history, stores.DatasetHistory)
    np.testing.assert_array_equal(history.read(slice(None), slice(None)), changed["signal"].values)
    assert history.fingerprint() != stores.history_in_memory(xr.open_zarr(store)).fingerprint()


@pytest.mark.slow
def test_a_plan_reads_no_samples_and_needs_no_store(dataset: xr.Dataset, store: Path) -> None:
    unreadable = dataset.assign(signal=dataset.signal.chunk().map_blocks(_refuse, template=dataset.signal.chunk()))
    planned, expected = (blocksar.plan(source, grid=GRID).summary for source in (unreadable, store))
    assert len(planned) == len(expected)
    for line, wanted in zip(planned, expected, strict=True):  # seconds are those of this machine as it is
        assert line == wanted or line[:17] == wanted[:17] == "a run takes about"


def _refuse(block: Any) -> Any:
    raise AssertionError("a sample was read")


def test_samples_in_memory_are_checked(dataset: xr.Dataset) -> None:
    conjugate = dataset.assign(signal=np.conj(dataset.signal))
    assert "conjugate" in str(blocksar.check(conjugate).result["warning"])


# ---------------------------------------------------------------- where the work is done


@pytest.mark.slow
def test_an_interactive_session_focuses_small_collections_itself(
    dataset: xr.Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from blocksar.graph import cluster

    def refuse(**_: Any) -> Any:
        raise AssertionError("a cluster was started")

    monkeypatch.setattr(cluster, "open_client", refuse)
    monkeypatch.setattr("sys.ps1", ">>> ", raising=False)
    blocksar.focus(dataset, tmp_path / "run", grid=CORNER)
    assert np.isfinite(pixels(tmp_path / "run")).any()


def test_an_earth_centred_track_is_carried_into_the_frame() -> None:
    frame = Georeference(latitude=-33.1, longitude=151.2, height=40.0, rotation=20.0)
    given = arrays()
    position = np.asarray(given.pop("antenna_position"))
    # By the formula of the store: origin, and the components along east, north and up.
    where = frame.as_attribute()
    turn = np.radians(where["rotation_deg"])
    x_axis = np.cos(turn) * np.array(where["east"]) + np.sin(turn) * np.array(where["north"])
    y_axis = np.cos(turn) * np.array(where["north"]) - np.sin(turn) * np.array(where["east"])
    earth = np.array(where["ecef"]) + position @ np.stack([x_axis, y_axis, np.array(where["up"])])
    made = blocksar.collection(**given, antenna_position=earth, georeference=where, earth_centred=True)
    np.testing.assert_allclose(made.antenna_position.values, position, atol=1e-6)
    with pytest.raises(InputError, match="no georeference is given"):
        blocksar.collection(**given, antenna_position=earth, earth_centred=True)
    with pytest.raises(InputError, match=r"has the shape \(3,\)"):
        blocksar.collection(**given, antenna_position=earth[0], georeference=where, earth_centred=True)
