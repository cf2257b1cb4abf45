"""Phase histories of several channels: each reads like a store of its own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from scenes import scene

import blocksar
from blocksar import stores
from blocksar.errors import InputError
from blocksar.simulation.scene import Scene
from blocksar.simulation.simulate import simulate

TARGETS = """
[[targets]]
name = "T"
range = 30000.0
yaw_deg = 50.0
[[targets]]
name = "D"
range = 30030.0
yaw_deg = 50.2
amplitude = 2.0
scattering = {HV = [0.5, 90.0]}
[noise]
power = 0.01
seed = 3
"""
ALL = slice(None)
pytestmark = pytest.mark.filterwarnings("ignore:The data type .FixedLengthUTF32")  # from writing it


def text(channels: str = 'channels = ["HH", "HV"]') -> str:
    return f"{channels}\n" + scene(pulses=64, steering=(50.0, 50.3), dwell=0.01, swath=[29900.0, 30100.0], more=TARGETS)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("channels")
    (folder / "scene.toml").write_text(text())
    return Path(blocksar.simulate(folder / "scene.toml", folder / "ph.zarr"))


def test_a_channel_reads_like_a_store_of_its_own(store: Path, tmp_path: Path) -> None:
    history = stores.open_phase_history(store)
    assert history.channels == ("HH", "HV") and history.channel == 0
    variables = stores.open_dataset(store).variables.values()
    assert all({"units", "long_name"} <= set(variable.attrs) for variable in variables)
    alone = Scene.parse(
        text("").replace("scattering = {HV = [0.5, 90.0]}", "").replace("amplitude = 2.0", "amplitude = 0")
    )
    simulate(alone, tmp_path / "alone.zarr")
    single = stores.open_phase_history(tmp_path / "alone.zarr")
    assert history.shape == single.shape and history.chunks == single.chunks
    assert np.array_equal(history.read(ALL, ALL), single.read(ALL, ALL))
    assert np.array_equal(history.read(slice(5, 20), slice(7, 30)), single.read(ALL, ALL)[5:20, 7:30])
    other = history.of_channel("hv")
    assert other.channel == 1 and not np.array_equal(other.read(ALL, ALL), history.read(ALL, ALL))
    assert [t["reflectivity"] for t in history.attrs["targets"]] == [[1.0, 0.0], [0.0, 0.0]]
    np.testing.assert_allclose([t["reflectivity"] for t in other.attrs["targets"]], [[1, 0], [0, 1]], atol=1e-12)


def test_a_channel_is_pinned_and_identified_by_its_own_chunks(store: Path) -> None:
    history = stores.open_phase_history(store).pinned()
    other = stores.open_phase_history(store).of_channel("HV").pinned()
    assert history.versions and other.versions and not set(history.versions) & set(other.versions)
    assert history.fingerprint() != other.fingerprint()
    before = history.fingerprint()
    values = other.read(ALL, ALL)
    stores.write_region(store, "signal", (slice(1, 2), ALL, ALL), values[None])
    assert stores.open_phase_history(store).fingerprint() == before
    with pytest.raises(InputError, match="changes while it is read"):
        other.read(ALL, ALL)


def test_what_xarray_writes_is_read(store: Path, tmp_path: Path) -> None:
    dataset = xr.open_zarr(store, chunks=None).load()
    assert dataset.signal.dims == ("channel", "pulse", "range_frequency")
    assert dataset.channel.values.tolist() == ["HH", "HV"]
    dataset = dataset.assign_coords(channel=np.array(["HH", "HV"]))  # text of fixed length
    for variable in dataset.variables.values():
        variable.encoding.clear()
    dataset.to_zarr(tmp_path / "copy.zarr", zarr_format=3, consolidated=False)
    copy, history = (stores.open_phase_history(path) for path in (tmp_path / "copy.zarr", store))
    assert copy.channels == history.channels
    for name in ("HH", "HV"):
        assert np.array_equal(copy.of_channel(name).read(ALL, ALL), history.of_channel(name).read(ALL, ALL))


def test_an_unknown_channel_is_refused(store: Path) -> None:
    with pytest.raises(InputError, match=r"channel 'VV' is none of .*, which has HH, HV"):
        stores.open_phase_history(store).of_channel("VV")
