"""Copies of phase histories with another track."""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
import xxhash

from blocksar import stores
from blocksar.collection.collection import Collection
from blocksar.errors import InputError
from blocksar.places import place


def written(path: Path, collection: Collection) -> xr.Dataset:
    """A store of noise."""
    shape = (collection.n_pulse, collection.n_range_frequency)
    signal = np.random.default_rng(1).standard_normal((*shape, 2)).astype(np.float32).view(np.complex64)[..., 0]

    def fill(store: Any) -> None:
        stores.write_region(store, "signal", (slice(None), slice(None)), signal)

    stores.create_phase_history(path, collection, attrs={"targets": [], "scene": "noise"}, fill=fill)
    return stores.open_dataset(path)


def ours(path: Path, collection: Collection) -> None:
    written(path, collection)


def version_2(path: Path, collection: Collection) -> None:
    """As another program writes it: zarr format 2, compressed, with a variable of its own."""
    dataset = written(path.with_name("own.zarr"), collection).load().drop_encoding()
    dataset["weather"] = ("pulse", np.arange(collection.n_pulse))
    dataset.to_zarr(path, zarr_format=2)


def not_consolidated(path: Path, collection: Collection) -> None:
    dataset = written(path.with_name("own.zarr"), collection).load().drop_encoding()
    dataset.to_zarr(path, zarr_format=3, consolidated=False)


@pytest.mark.slow
@pytest.mark.parametrize("write", [ours, version_2, not_consolidated])
def test_a_copy_differs_in_track_and_attributes_only(
    write: Callable[[Path, Collection], None], small_collection: Collection, tmp_path: Path
) -> None:
    write(tmp_path / "ph.zarr", small_collection)
    source, target = place(tmp_path / "ph.zarr"), place(tmp_path / "made" / "copy.zarr")
    before = stores.open_phase_history(source)
    corrected = small_collection.antenna_position + np.array([0.01, -0.02, 0.03])
    versions = stores.files_to_copy(source)
    checksums: dict[str, str] = {}
    groups = stores.groups_of(versions, 3000)
    assert len(groups) > 1 and sorted(name for group in groups for name in group) == sorted(versions)
    for group in groups:
        checksums |= stores.copy_files(source, target, {name: versions[name] for name in group})
    assert stores.same_files(target, checksums)
    with pytest.raises(InputError, match="is not a zarr store"):  # not before its metadata is there
        stores.open_phase_history(target)
    stores.write_track(
        source, target, corrected=corrected, original=small_collection.antenna_position,
        attrs={"autofocus": {"points": 30}, "history": "corrected"},
    )  # fmt: skip
    stores.publish(target, place(tmp_path / "copy.zarr"), overwrite=False)
    after = stores.open_phase_history(tmp_path / "copy.zarr")
    assert np.array_equal(after.collection.antenna_position, corrected)
    assert after.attrs == {**before.attrs, "autofocus": {"points": 30}, "history": "corrected"}
    with warnings.catch_warnings():
        if write is not_consolidated:
            warnings.simplefilter("ignore")  # as the source itself
        old, new = (xr.open_zarr(tmp_path / name) for name in ("ph.zarr", "copy.zarr"))
    assert set(new.variables) == {*old.variables, stores.ORIGINAL}
    assert new[stores.ORIGINAL].attrs["units"] == "m"
    for name in old.variables:
        if name != "antenna_position":
            assert new[name].equals(old[name]) and new[name].attrs == old[name].attrs
    assert np.array_equal(new[stores.ORIGINAL], old["antenna_position"])
    for name in versions:  # byte by byte
        assert (tmp_path / "copy.zarr" / name).read_bytes() == (tmp_path / "ph.zarr" / name).read_bytes()
    assert after.fingerprint() != before.fingerprint()


def test_a_source_that_changes_and_an_altered_copy_are_noticed(
    small_collection: Collection, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written(tmp_path / "ph.zarr", small_collection)
    source, target = place(tmp_path / "ph.zarr"), place(tmp_path / "copy.zarr")
    versions = stores.files_to_copy(source)
    checksums = stores.copy_files(source, target, versions)
    (name,) = [name for name in versions if name.startswith("signal/")]
    data = bytearray((tmp_path / "copy.zarr" / name).read_bytes())
    data[1000] ^= 1
    (tmp_path / "copy.zarr" / name).write_bytes(data)
    assert not stores.same_files(target, checksums)
    (tmp_path / "copy.zarr" / name).unlink()
    assert not stores.same_files(target, checksums)
    os.utime(tmp_path / "ph.zarr" / name, (1, 1))
    with pytest.raises(InputError, match=r"changes while it is read \(signal"):
        stores.copy_files(source, target, versions)
    os.utime(tmp_path / "ph.zarr" / name, ns=(int(versions[name].split()[1]),) * 2)
    stores.copy_files(source, target, versions)
    piece = xxhash.xxh3_128

    def while_it_is_copied() -> Any:
        os.utime(tmp_path / "ph.zarr" / name, (1, 1))
        return piece()

    monkeypatch.setattr(xxhash, "xxh3_128", while_it_is_copied)
    with pytest.raises(InputError, match=r"changes while it is read \(signal"):
        stores.copy_files(source, target, {name: versions[name]})


def test_a_published_copy_replaces_only_what_it_may(small_collection: Collection, tmp_path: Path) -> None:
    written(tmp_path / "ph.zarr", small_collection)
    written(tmp_path / "made.zarr", small_collection)
    made, out = place(tmp_path / "made.zarr"), place(tmp_path / "ph.zarr")
    with pytest.raises(InputError, match="exists; choose another name"):
        stores.publish(made, out, overwrite=False)
    (tmp_path / "made.zarr" / ".zarr.json.0123abcd.part").write_text("{")  # of a process that was killed
    (tmp_path / "made.zarr" / "mark").touch()
    stores.publish(made, out, overwrite=True)
    assert sorted(os.listdir(tmp_path)) == ["ph.zarr"]
    assert (tmp_path / "ph.zarr" / "mark").exists()
    assert not list((tmp_path / "ph.zarr").glob(".*"))
    assert json.loads((tmp_path / "ph.zarr" / "zarr.json").read_text())["attributes"]["scene"] == "noise"
