"""Stores of collections whose beam turns about its own axis, or that have patterns."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
import zarr
from axis_beams import axis_collection, with_patterns

from blocksar import stores
from blocksar.collection.collection import Collection


def write(path: Path, collection: Collection) -> Path:
    stores.create_phase_history(path, collection)
    return path


@pytest.mark.parametrize("patterns", [False, True])
def test_a_beam_about_its_axis_is_read_as_it_was_written(tmp_path: Path, patterns: bool) -> None:
    collection = axis_collection("tops", noise_power=0.25)
    collection = with_patterns(collection) if patterns else collection
    path = write(tmp_path / "phase_history.zarr", collection)
    history = stores.open_phase_history(path)
    expected = collection.as_dict()
    for name, value in history.collection.as_dict().items():
        np.testing.assert_array_equal(value, expected[name], err_msg=name)
    assert history.same(stores.open_phase_history(path))
    assert "noise_power" not in history.attrs
    assert not (path / "beam_azimuth").exists()
    with xr.open_zarr(path) as dataset:
        assert dataset["beam_axis"].dims == ("pulse", "axis")
        assert dataset["beam_steering"].units == "rad"
        assert ("beam_pattern" in dataset) == patterns
        if patterns:
            assert dataset["beam_pattern"].dims == ("beam_offset",)
            assert set(dataset.coords) == {"time", "range_frequency", "beam_offset", "elevation"}
            assert all(
                "units" in dataset[name].attrs and "long_name" in dataset[name].attrs for name in dataset.variables
            )
    stores.write_collection(tmp_path / "collection.zarr", collection)
    again, _ = stores.read_collection(tmp_path / "collection.zarr")
    assert all(
        np.array_equal(value, expected[name], equal_nan=name == "beam_azimuth")
        for name, value in again.as_dict().items()
    )


def test_other_collections_have_none_of_these_variables(tmp_path: Path, small_collection: Collection) -> None:
    path = write(tmp_path / "phase_history.zarr", small_collection)
    assert sorted(zarr.open_group(path, mode="r").array_keys()) == sorted(stores.PHASE_HISTORY)


def test_the_fingerprint_covers_the_beam(tmp_path: Path) -> None:
    one, other = (
        stores.open_phase_history(write(tmp_path / f"{mode}.zarr", axis_collection(mode))).fingerprint()
        for mode in ("stripmap", "tops")
    )
    assert one != other
