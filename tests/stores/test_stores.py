"""Stores: data are read back as written, and everything else on disk is refused in one sentence."""

from __future__ import annotations

import json
import os
import shutil
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
import zarr
from samples import noise

from blocksar import stores
from blocksar.collection.collection import Collection
from blocksar.collection.raw_echo import RawEcho
from blocksar.errors import InputError, ProcessingError
from blocksar.places import local, place
from blocksar.stores import chunk_files

SAMPLES = stores.Variable(("pulse", "range_frequency"), "complex64", "1", "samples")


def dataset(collection: Collection, **changes: Any) -> xr.Dataset:
    """A phase history as another program would build it from the contract alone."""
    n, m = collection.n_pulse, collection.n_range_frequency
    data: dict[str, Any] = {
        "signal": (("pulse", "range_frequency"), noise(n, m)),
        "reference_range": ("pulse", collection.reference_range),
        "antenna_position": (("pulse", "axis"), collection.antenna_position),
        "beam_azimuth": ("pulse", collection.beam_azimuth),
    }
    coords: dict[str, Any] = {
        "time": ("pulse", collection.time),
        "range_frequency": ("range_frequency", collection.range_frequency),
    }
    attrs = {"carrier_frequency": np.float64(collection.carrier), "beam_width": np.float32(collection.beam_width)}
    for name, value in changes.items():
        target = attrs if name in ("carrier_frequency", "beam_width", "ground_height") else coords
        target = data if name in data or name == "extra" else target
        if value is None:
            del target[name]
        else:
            target[name] = value
    return xr.Dataset(data, coords, attrs)


def written(ds: xr.Dataset, path: Path, **options: Any) -> Path:
    ds.to_zarr(path, **{"consolidated": False, "zarr_format": 3, **options})
    return path


@pytest.fixture
def own(small_collection: Collection, tmp_path: Path) -> Path:
    """A phase history written by blocksar, in four chunks."""
    path = tmp_path / "ph.zarr"
    c = small_collection
    stores.create(
        path,
        stores.PHASE_HISTORY,
        sizes={},
        coords={"time": c.time, "range_frequency": c.range_frequency},
        variables={name: getattr(c, name) for name in stores.TRACK_AND_BEAM},
        attrs={"carrier_frequency": c.carrier, "beam_width": c.beam_width, "title": c.title},
        chunks={"pulse": 128, "range_frequency": 64},
    )
    stores.write_region(path, "signal", (slice(None), slice(None)), noise(c.n_pulse, c.n_range_frequency))
    return path


@pytest.fixture
def echo(small_collection: Collection) -> RawEcho:
    rate = 60e6
    fast_time = 80e-6 + np.arange(1200) / rate
    return RawEcho(fast_time=fast_time, chirp_rate=5e12, pulse_width=10e-6, sampling_rate=rate)


def same(a: Collection, b: Collection) -> bool:
    return all(
        np.array_equal(value, b.as_dict()[name], equal_nan=name == "beam_azimuth")
        if isinstance(value, np.ndarray)
        else value == b.as_dict()[name]
        for name, value in a.as_dict().items()
    )


def one_sentence(error: pytest.ExceptionInfo[InputError]) -> str:
    text = str(error.value)
    assert "\n" not in text and "Traceback" not in text and len(text) < 700
    return text


# Round trips


def test_a_phase_history_is_read_back_to_the_last_bit(small_collection: Collection, tmp_path: Path) -> None:
    path = tmp_path / "deep" / "ph.zarr"
    targets = [{"name": "A1", "x": np.float64(1.5), "y": 2, "reflectivity": (1.0, 0.0)}]
    stores.create_phase_history(path, small_collection, attrs={"targets": targets, "seed": np.int64(3)})
    history = stores.open_phase_history(path)
    assert same(history.collection, small_collection)
    assert history.raw is None and history.variable == "signal"
    assert history.attrs["targets"] == [{"name": "A1", "x": 1.5, "y": 2, "reflectivity": [1.0, 0.0]}]
    assert history.attrs["seed"] == 3 and history.attrs["title"] == small_collection.title
    assert {"history", "Conventions"} <= set(history.attrs)
    samples = noise(*history.shape)
    stores.write_region(path, "signal", (slice(0, 256), slice(0, 128)), samples)
    read = history.read(slice(3, 200), slice(5, 7))
    assert read.dtype == np.complex64 and np.array_equal(read, samples[3:200, 5:7])


def test_zeros_are_written_as_a_chunk(own: Path) -> None:
    stores.write_region(own, "signal", (slice(0, 128), slice(0, 64)), np.zeros((128, 64), np.complex64))
    assert (own / "signal" / "c" / "0" / "0").stat().st_size == 128 * 64 * 8
    assert (stores.open_dataset(own)["signal"].values[:128, :64] == 0).all()


@pytest.mark.parametrize("options", [{}, {"consolidated": False}])
def test_xarray_opens_every_store_without_a_warning(own: Path, tmp_path: Path, options: dict[str, Any]) -> None:
    axes = {"x": np.arange(20.0), "y": np.arange(10.0)}
    frequency = {"doppler": np.arange(32.0), "range_frequency": np.arange(16.0)}
    for name, coords in (("IMAGE", axes), ("PATCH", axes), ("SPECTRUM", frequency)):
        schema = getattr(stores, name)
        stores.create(tmp_path / name, schema, sizes={"pulse": 9}, coords=coords, attrs={}, chunks={"x": 8})
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            ds = xr.open_zarr(tmp_path / name, **options)
        assert set(ds.variables) == set(schema)
        for variable, stated in schema.items():
            found = ds[variable]
            assert (found.dims, str(found.dtype)) == (stated.dims, stated.dtype)
            assert (found.attrs["units"], found.attrs["long_name"]) == (stated.units, stated.long_name)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ds = xr.open_zarr(own, **options).load()
    assert set(ds.coords) == {"time", "range_frequency"} and ds["time"].dtype == np.float64


def test_a_raw_echo_is_read_back_as_written(small_collection: Collection, echo: RawEcho, tmp_path: Path) -> None:
    fields = small_collection.as_dict() | {"range_frequency": echo.range_frequency}
    stores.create_phase_history(tmp_path / "raw.zarr", Collection(**fields), raw=echo)
    history = stores.open_phase_history(tmp_path / "raw.zarr")
    assert history.raw is not None and history.shape == (256, 1200) and history.variable == "echo"
    assert np.array_equal(history.raw.fast_time, echo.fast_time)
    assert (history.raw.chirp_rate, history.raw.pulse_width) == (5e12, 10e-6)
    # The rate is computed from the axis, whose values are rounded to 1e-20 s at 1e-4 s.
    assert history.raw.sampling_rate == pytest.approx(60e6, rel=1e-9)
    assert history.collection.range_frequency == pytest.approx(echo.range_frequency, rel=1e-9)
    assert np.isnan(history.read(slice(0, 4), slice(1000, 1200))).all()


def test_raw_range_frequencies_are_those_of_the_transform_within_the_chirp_band(echo: RawEcho) -> None:
    f = echo.range_frequency
    assert f[0] == -25e6 and f[-1] == 25e6  # the band's edge is a grid point here and is included
    assert np.allclose(np.diff(f), 60e6 / 1200) and 0.0 in f


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"chirp_rate": 0.0}, "chirp_rate"),
        ({"chirp_rate": np.nan}, "chirp_rate"),
        ({"chirp_rate": 7e12}, "60000000|6e\\+07"),
        ({"pulse_width": 30e-6}, "pulse_width"),
        ({"pulse_width": np.nan}, "pulse_width"),
        ({"sampling_rate": 61e6}, "sampling_rate"),
        ({"fast_time": np.zeros(9)}, "fast_time"),
    ],
)
def test_a_raw_echo_is_validated_on_creation(echo: RawEcho, change: dict[str, Any], words: str) -> None:
    fields = {name: getattr(echo, name) for name in echo.__dataclass_fields__}
    with pytest.raises(InputError, match=words):
        RawEcho(**(fields | change))


# Regions


@pytest.mark.parametrize("region", [np.s_[0:100, 0:64], np.s_[1:129, 0:64], np.s_[0:128, 64:127], np.s_[0:256:2, :]])
def test_only_whole_chunks_are_written(own: Path, region: tuple[slice, ...]) -> None:
    shape = noise(256, 128)[region].shape
    with pytest.raises(ValueError, match="whole chunks"):
        stores.write_region(own, "signal", region, np.zeros(shape, np.complex64))


def test_the_last_chunk_may_be_short(tmp_path: Path) -> None:
    sizes = {"pulse": 10, "range_frequency": 7}
    path, values = tmp_path / "s.zarr", noise(10, 7)
    chunks = {"pulse": 4, "range_frequency": 5}
    stores.create(path, {"s": SAMPLES}, sizes=sizes, coords={}, attrs={}, chunks=chunks)
    for rows in (slice(0, 8), slice(8, 10)):
        for columns in (slice(0, 5), slice(5, 7)):
            stores.write_region(path, "s", (rows, columns), values[rows, columns])
    assert np.array_equal(stores.read_region(path, "s", np.s_[1:, :6]), values[1:, :6])


def test_values_that_do_not_fit_the_region_are_refused(own: Path) -> None:
    with pytest.raises(ValueError, match="shape"):
        stores.write_region(own, "signal", np.s_[0:128, 0:64], np.zeros((64, 128), np.complex64))
    with pytest.raises(ValueError, match="does not go into"):
        stores.write_region(own, "time", (slice(None),), np.zeros(256, np.complex64))
    with pytest.raises(ValueError, match="dimensions"):
        stores.write_region(own, "signal", (slice(None),), np.zeros((256, 128), np.complex64))
    with pytest.raises(InputError, match="no variable image"):
        stores.write_region(own, "image", np.s_[0:128, 0:64], np.zeros((128, 64), np.complex64))


def test_reading_a_region_opens_only_its_chunks(own: Path) -> None:
    shutil.rmtree(own / "signal" / "c" / "1")
    (own / "signal" / "c" / "0" / "1").write_bytes(b"damaged")
    assert np.array_equal(stores.read_region(own, "signal", np.s_[5:128, 3:64]), noise(256, 128)[5:128, 3:64])


# Agreement of plain files with zarr


BOX = stores.Variable(("a", "b", "c"), "complex64", "1", "samples")
PLAIN = {
    "one axis": (stores.Variable(("a",), "float64", "1", "samples"), (19,), (7,)),
    "complex": (stores.Variable(("a", "b"), "complex64", "1", "samples"), (23, 19), (8, 5)),
    "whole chunks": (stores.Variable(("a", "b"), "complex64", "1", "samples"), (24, 20), (8, 5)),
    "integers": (stores.Variable(("a", "b"), "int16", "1", "samples"), (10, 33), (4, 33)),
    "box": (BOX, (9, 5, 8), (4, 3, 5)),
}


@pytest.fixture(params=[1 << 19, 300, 1])
def slab(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Slabs of a whole chunk, of several rows and of one row: the default slab holds any chunk of these tests."""
    monkeypatch.setattr(chunk_files, "SLAB", request.param)
    monkeypatch.setattr(chunk_files, "TRANSPOSED_COLUMNS", 3)


def plain_store(path: Path, name: str) -> tuple[zarr.Array[Any], np.ndarray]:
    """Create a store with one empty variable, and values for it."""
    variable, shape, chunks = PLAIN[name]
    sizes, tiles = dict(zip(variable.dims, shape, strict=True)), dict(zip(variable.dims, chunks, strict=True))
    stores.create(path, {"s": variable}, sizes=sizes, coords={}, attrs={}, chunks=tiles)
    values = noise(*shape) if variable.dtype == "complex64" else (noise(*shape).real * 1e3).astype(variable.dtype)
    return zarr.open_array(path / "s", mode="r+", config={"write_empty_chunks": True}), values


def layouts(values: np.ndarray) -> list[np.ndarray]:
    """Return the values in four memory layouts: C order, transposed, as part of a wider array, and reversed."""
    wide = np.zeros(tuple(2 * n + 1 for n in values.shape), values.dtype)[
        tuple(slice(1, None, 2) for _ in values.shape)
    ]
    turned, back = values.T.copy().T, values[::-1].copy()[::-1]
    wide[...] = values
    return [values.copy(), turned, wide, back]


def chunk_bytes(path: Path) -> dict[str, bytes]:
    return {str(p.relative_to(path)): p.read_bytes() for p in (path / "s" / "c").rglob("*") if p.is_file()}


@pytest.mark.parametrize("name", ["PHASE_HISTORY", "RAW_ECHO", "COLLECTION", "SPECTRUM", "PATCH", "IMAGE"])
def test_every_variable_of_ours_is_stored_in_plain_files(tmp_path: Path, name: str) -> None:
    schema = getattr(stores, name)
    sizes = {dim: 5 for variable in schema.values() for dim in variable.dims}
    stores.create(tmp_path / "s.zarr", schema, sizes=sizes, coords={}, attrs={}, chunks={"y": 2, "pulse": 3})
    for variable, stated in schema.items():
        files = chunk_files.chunk_files_of(place(tmp_path / "s.zarr"), variable)
        array = zarr.open_array(tmp_path / "s.zarr" / variable, mode="r")
        assert files is not None and files.dtype == stated.dtype
        assert (files.shape, files.chunks, files.dtype) == (array.shape, array.chunks, array.dtype)


@pytest.mark.parametrize("name", PLAIN)
def test_chunks_equal_the_files_that_zarr_writes(tmp_path: Path, name: str, slab: None) -> None:
    array, values = plain_store(tmp_path / "zarr", name)
    array[...] = values
    for i, layout in enumerate(layouts(values)):
        plain_store(tmp_path / str(i), name)
        for _ in range(2):  # first new files, then existing ones
            stores.write_region(tmp_path / str(i), "s", (slice(None),) * values.ndim, layout)
        assert chunk_bytes(tmp_path / str(i)) == chunk_bytes(tmp_path / "zarr")


@pytest.mark.slow
@pytest.mark.parametrize("name", PLAIN)
def test_regions_are_read_as_by_zarr(tmp_path: Path, name: str, slab: None) -> None:
    array, values = plain_store(tmp_path / "s", name)
    array[...] = values
    chunk_files = sorted(p for p in (tmp_path / "s" / "s" / "c").rglob("*") if p.is_file())
    chunk_files[1].unlink()
    rng = np.random.default_rng(3)
    regions = [tuple(slice(*rng.integers(-2, n + 2, 2)) for n in values.shape) for _ in range(40)]
    regions += [(slice(None),) * values.ndim, (slice(1, None, 2),) * values.ndim, (slice(5, 5),) * values.ndim]
    for region in regions:
        expected = array[region]
        found = stores.read_region(tmp_path / "s", "s", region)
        assert found.dtype == array.dtype and np.array_equal(found, expected, equal_nan=True)
        for out in layouts(np.zeros_like(expected)):
            assert stores.read_region(tmp_path / "s", "s", region, out=out) is out
            assert np.array_equal(out, expected, equal_nan=True)


OTHERWISE: dict[str, dict[str, Any]] = {
    "compressed": {"compressors": zarr.codecs.GzipCodec()},
    "turned": {"filters": zarr.codecs.TransposeCodec(order=(1, 0))},
    "sharded": {"chunks": (4, 5), "shards": (8, 10)},
    "big-endian": {"serializer": zarr.codecs.BytesCodec(endian="big")},
    "other names": {"chunk_key_encoding": {"name": "default", "separator": "."}},
    "names of version 2": {"chunk_key_encoding": {"name": "v2", "separator": "/"}},
    "other fill value": {"fill_value": 0},
    "other type": {"dtype": "complex128"},
    "version 2": {"zarr_format": 2, "chunk_key_encoding": {"name": "v2", "separator": "/"}},
}


@pytest.mark.parametrize("name", OTHERWISE)
def test_other_layouts_are_delegated_to_zarr(tmp_path: Path, name: str) -> None:
    usual: dict[str, Any] = {"chunks": (8, 10), "dtype": "complex64", "fill_value": np.nan, "compressors": None}
    values = noise(23, 19)
    array = zarr.create_array(tmp_path / "s", shape=values.shape, **(usual | OTHERWISE[name]))
    assert chunk_files.chunk_files_of(place(tmp_path), "s") is None
    stores.write_region(tmp_path, "s", np.s_[:16, :], values[:16])
    expected = np.full(values.shape, array.fill_value, array.dtype)
    expected[:16] = values[:16]
    assert np.array_equal(array[...], expected, equal_nan=True)
    out = np.zeros((19, 23), array.dtype).T
    assert stores.read_region(tmp_path, "s", np.s_[:, :], out=out) is out
    assert np.array_equal(out, expected, equal_nan=True)
    with pytest.raises(ValueError, match="out is"):
        stores.read_region(tmp_path, "s", np.s_[:9, :], out=out)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("zarr_format", 4),
        ("shape", [23]),
        ("shape", [23.0, 19]),
        ("shape", [0, 19]),
        ("data_type", {"name": "complex64"}),
        ("data_type", "complex256"),
        ("chunk_grid", {"name": "rectangular", "configuration": {"chunk_shape": [8, 5]}}),
        ("chunk_grid", {"name": "regular", "configuration": {"chunk_shape": [8, -5]}}),
        ("storage_transformers", [{"name": "swap"}]),
        ("must_understand_this", {}),
    ],
)
def test_unexpected_metadata_are_delegated_to_zarr(tmp_path: Path, key: str, value: Any) -> None:
    plain_store(tmp_path / "s", "complex")
    assert chunk_files.chunk_files_of(place(tmp_path / "s"), "s") is not None
    file = tmp_path / "s" / "s" / "zarr.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {key: value}))
    assert chunk_files.chunk_files_of(place(tmp_path / "s"), "s") is None


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_a_failed_write_leaves_the_old_chunk(own: Path, monkeypatch: Any, error: BaseException) -> None:
    before = stores.open_phase_history(own).fingerprint()

    def full(*_: object) -> None:
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(chunk_files, "copy_values", full)  # fails while the chunk is written
        patch.setattr(os, "replace", full)  # fails after the chunk is written
        for values in (np.zeros((128, 64), np.complex64), np.zeros((64, 128), np.complex64).T):
            with pytest.raises((ProcessingError, KeyboardInterrupt)) as found:
                stores.write_region(own, "signal", np.s_[:128, :64], values)
            if isinstance(error, OSError):
                assert str(found.value) == f"signal in {own} cannot be written (No space left on device)"
    assert stores.open_phase_history(own).fingerprint() == before


@pytest.mark.parametrize("length", [-1, 1])
def test_a_chunk_of_wrong_length_is_damaged_even_if_the_requested_part_exists(own: Path, length: int) -> None:
    chunk = own / "signal" / "c" / "1" / "0"
    chunk.write_bytes((chunk.read_bytes() + b"\0")[: 128 * 64 * 8 + length])
    with pytest.raises(InputError, match=r"pulse 128\.\.255, range_frequency 0\.\.63"):
        stores.read_region(own, "signal", np.s_[120:140, 60:70])


def test_concurrent_writers_of_a_chunk_leave_one_whole_chunk(own: Path) -> None:
    def write(i: int) -> None:
        stores.write_region(own, "signal", np.s_[:128, :64], np.full((128, 64), i + 1, np.complex64))

    run_together(write, 30)
    assert np.unique(stores.read_region(own, "signal", np.s_[:128, :64])).size == 1
    assert not [p for p in (own / "signal").rglob(".*")]


# Creation


def test_what_killed_processes_left_beside_a_store_goes_and_what_living_ones_write_stays(
    small_collection: Collection, tmp_path: Path
) -> None:
    path = tmp_path / "ph.zarr"
    left = [".ph.zarr.0123abcd.part", ".ph.zarr.0123abce.old"]
    for name in [*left, ".ph.zarr.2.0123abcd.part", "..ph.zarr.0123abcd.part.0123abcd.part"]:
        (tmp_path / name / "signal").mkdir(parents=True)
    with local.held_part(path, os.mkdir) as part:
        stores.create_phase_history(path, small_collection)
        assert sorted(os.listdir(tmp_path)) == sorted([".ph.zarr.2.0123abcd.part", os.path.basename(part), "ph.zarr"])
    assert sorted(os.listdir(tmp_path)) == [".ph.zarr.2.0123abcd.part", "ph.zarr"]


def test_a_store_that_was_moved_away_stays_until_another_has_its_name(tmp_path: Path) -> None:
    (tmp_path / ".ph.zarr.0123abce.old").mkdir()
    local.sweep_beside(tmp_path / "ph.zarr")
    assert os.listdir(tmp_path) == [".ph.zarr.0123abce.old"]


def test_a_full_disk_is_no_wrong_input(
    small_collection: Collection, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    def fill(part: Any) -> None:
        with monkeypatch.context() as patch:
            patch.setattr(os, "replace", full)
            stores.write_region(part, "signal", np.s_[:, :], np.zeros((256, 128), np.complex64))

    path = tmp_path / "ph.zarr"
    said = f"{path} cannot be written (No space left on device); make room, and give the same command again"
    with pytest.raises(ProcessingError) as found:
        stores.create_phase_history(path, small_collection, fill=fill)
    assert str(found.value) == said
    monkeypatch.setattr(os, "mkdir", full)
    with pytest.raises(ProcessingError) as found:
        stores.create_phase_history(path, small_collection)
    assert str(found.value) == said
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"sizes": {"pulse": 4}}, "range_frequency"),
        ({"variables": {"phase": np.zeros(4)}}, "not in the schema"),
        ({"variables": {"s": np.zeros(4)}}, "shape"),
        ({"variables": {"s": np.zeros((4, 5))}}, "length 4"),
        ({"attrs": {"weight": 1 + 2j}}, "weight"),
        ({"attrs": {"targets": [{"sigma": np.complex64(1)}]}}, "sigma"),
    ],
)
def test_data_that_violate_the_schema_are_refused(tmp_path: Path, change: dict[str, Any], words: str) -> None:
    right: dict[str, Any] = {
        "sizes": {"pulse": 4, "range_frequency": 4},
        "coords": {},
        "attrs": {},
        "chunks": {},
        "variables": {},
    }
    with pytest.raises(ValueError, match=words):
        stores.create(tmp_path / "s.zarr", {"s": SAMPLES}, **(right | change))
    assert os.listdir(tmp_path) == []


# Phase histories from other programs


def test_consolidated_metadata_of_version_3_is_read(small_collection: Collection, tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a warning of the writer, not of blocksar
        path = written(dataset(small_collection), tmp_path / "ph.zarr", consolidated=True)
    assert stores.open_phase_history(path).shape == (256, 128)


def test_optional_parts_may_be_absent(small_collection: Collection, tmp_path: Path) -> None:
    path = written(dataset(small_collection, beam_azimuth=None, beam_width=None), tmp_path / "ph.zarr")
    history = stores.open_phase_history(path)
    assert not history.collection.steered and np.isnan(history.collection.beam_azimuth).all()
    assert history.collection.ground_height == 0 and history.collection.title == ""


@pytest.mark.parametrize("beam_width", [None, np.nan])
def test_a_beam_azimuth_of_nan_means_not_steered(small_collection: Collection, tmp_path: Path, beam_width: Any) -> None:
    ds = dataset(small_collection, beam_azimuth=("pulse", np.full(256, np.nan)), beam_width=beam_width)
    assert not stores.open_phase_history(written(ds, tmp_path / "ph.zarr")).collection.steered


WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "no track": ({"antenna_position": None}, "antenna_position .* is missing"),
    "no carrier": ({"carrier_frequency": None}, "carrier_frequency is missing"),
    "NaN carrier": ({"carrier_frequency": np.nan}, "carrier_frequency .* nan"),
    "carrier beyond float64": ({"carrier_frequency": 10**400}, "carrier_frequency"),
    "no beam width": ({"beam_width": None}, "beam_width"),
    "beam width alone": ({"beam_azimuth": None}, "beam_width"),
    "beam azimuth NaN here and there": ({"beam_azimuth": ("pulse", np.r_[np.nan, np.ones(255)])}, "azimuth is NaN"),
    "ground above the antenna": ({"ground_height": 6000.0}, "ground_height"),
    "georeference in words": ({"georeference": "EPSG:4326"}, "georeference is str instead of a mapping"),
    "origin beyond the pole": ({"georeference": {"kind": "ENU", "latitude": 91, "longitude": 9, "height": 0}}, "is 91"),
    "real samples": ({"signal": (("pulse", "range_frequency"), np.zeros((256, 128)))}, "signal is float64"),
    "transposed": ({"signal": (("range_frequency", "pulse"), np.zeros((128, 256), "c8"))}, "transpose"),
    "descending time": ({"time": ("pulse", -np.arange(256.0))}, "time does not ascend"),
    "NaN in time": ({"time": ("pulse", np.r_[np.nan, 1:256.0])}, "time is not finite at 1 of 256 values"),
    "time in ms": ({"time": ("pulse", np.arange(256.0), {"units": "ms"})}, "time is in 'ms'"),
    "absolute frequency": ({"range_frequency": -9.7e9 + np.arange(128.0)}, "baseband"),
    "flat track": ({"antenna_position": (("pulse", "axis"), np.ones((256, 2)))}, r"position has shape \(256, 2"),
    "one position": ({"antenna_position": ("axis", np.ones(3))}, "antenna_position has dimensions"),
    "both": ({"extra": (("pulse", "fast_time"), np.zeros((256, 9), "c8"))}, "both signal and echo"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_departures_from_the_contract_are_refused(name: str, small_collection: Collection, tmp_path: Path) -> None:
    change, words = WRONG[name]
    names = ("carrier_frequency", "beam_width", "ground_height", "georeference")
    attrs = {k: v for k, v in change.items() if k in names}
    ds = dataset(small_collection, **{k: v for k, v in change.items() if k not in attrs})
    ds = ds.rename(extra="echo") if "extra" in ds else ds
    path = written(ds, tmp_path / "ph.zarr")
    # Attributes are edited in the file, because no writer accepts some of these values.
    metadata = json.loads((path / "zarr.json").read_text())
    for key, value in attrs.items():
        metadata["attributes"].pop(key, None)
        if value is not None:
            metadata["attributes"][key] = value
    (path / "zarr.json").write_text(json.dumps(metadata))
    with pytest.raises(InputError, match=words) as error:
        stores.open_phase_history(path)
    assert str(path) in one_sentence(error)


@pytest.mark.parametrize(
    ("attr", "words"), [("chirp_rate", "chirp_rate is missing"), ("pulse_width", "pulse_width is missing")]
)
def test_a_raw_echo_without_its_chirp_is_refused(
    small_collection: Collection, echo: RawEcho, tmp_path: Path, attr: str, words: str
) -> None:
    path = tmp_path / "raw.zarr"
    stores.create_phase_history(path, small_collection, raw=echo)
    metadata = json.loads((path / "zarr.json").read_text())
    del metadata["attributes"][attr]
    (path / "zarr.json").write_text(json.dumps(metadata))
    with pytest.raises(InputError, match=words):
        stores.open_phase_history(path)


def test_dimensions_without_names_are_refused(small_collection: Collection, tmp_path: Path) -> None:
    path = written(dataset(small_collection), tmp_path / "ph.zarr")
    metadata = json.loads((path / "time" / "zarr.json").read_text())
    del metadata["dimension_names"]
    (path / "time" / "zarr.json").write_text(json.dumps(metadata))
    with pytest.raises(InputError, match=r"time has dimensions none, but must have \(pulse\)"):
        stores.open_phase_history(path)


# Paths that hold no phase history


def test_a_missing_path_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        stores.open_phase_history(tmp_path / "nowhere.zarr")
    with pytest.raises(InputError, match="not there"):
        stores.read_region(tmp_path / "nowhere.zarr", "signal", np.s_[:, :])
    for path in ("", "a\0b", "s3://bucket/ph.zarr"):
        with pytest.raises(InputError):
            stores.open_phase_history(path)


def test_files_and_foreign_folders_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("hello")
    (tmp_path / "folder").mkdir()
    zarr.create_array(store=str(tmp_path / "array"), shape=(3,), dtype="f8")
    zarr.create_array(store=str(tmp_path / "array2"), shape=(3,), dtype="f8", zarr_format=2)
    xr.Dataset({"temperature": ("x", np.zeros(3))}).to_zarr(tmp_path / "other", consolidated=False)
    words = {
        "file": "not a directory.*blocksar ingest",
        "folder": "not a zarr store",
        "array": "single zarr array",
        "array2": "single zarr array",
        "other": "neither signal nor echo .* temperature",
    }
    for name, expected in words.items():
        with pytest.raises(InputError, match=expected) as error:
            stores.open_phase_history(tmp_path / name)
        assert str(tmp_path / name) in one_sentence(error)


# Damage


@pytest.mark.parametrize("file", ["zarr.json", "time/zarr.json"])
@pytest.mark.parametrize(
    "content", [b"", b"{", b"null", b"[]", b"{}", b"\xff\xfe\x00", b"[" * 100_000, b'{"zarr_format": 3}']
)
def test_damaged_metadata_are_refused(own: Path, file: str, content: bytes) -> None:
    (own / file).write_bytes(content)
    with pytest.raises(InputError) as error:
        stores.open_phase_history(own)
    assert str(own) in one_sentence(error)


def test_truncated_and_missing_coordinates_are_refused(own: Path) -> None:
    name = "antenna_position"
    chunk = next(p for p in (own / name / "c").rglob("*") if p.is_file())
    chunk.write_bytes(chunk.read_bytes()[:-5])
    with pytest.raises(InputError, match=name) as error:
        stores.open_phase_history(own)
    assert "damaged" in one_sentence(error)
    chunk.unlink()
    with pytest.raises(InputError, match=name):  # a missing chunk is read as fill value, NaN
        stores.open_phase_history(own)


@pytest.mark.parametrize("compressed", [False, True])
def test_damaged_samples_are_named(small_collection: Collection, tmp_path: Path, compressed: bool) -> None:
    encoding = {"signal": {"chunks": (128, 64), "compressors": zarr.codecs.ZstdCodec() if compressed else None}}
    path = written(dataset(small_collection), tmp_path / "ph.zarr", encoding=encoding)
    (path / "signal" / "c" / "1" / "0").write_bytes(b"garbage")
    history = stores.open_phase_history(path)
    assert history.read(slice(0, 128), slice(None)).shape == (128, 128)
    with pytest.raises(InputError, match=r"pulse 128\.\.255, range_frequency 0\.\.63") as error:
        history.read(slice(100, 256), slice(0, 128))
    assert "signal" in one_sentence(error)


def test_a_store_that_changes_while_open_is_detected(own: Path, small_collection: Collection) -> None:
    history = stores.open_phase_history(own)
    fields = small_collection.as_dict() | {"range_frequency": small_collection.range_frequency[:64]}
    stores.create_phase_history(own, Collection(**fields), overwrite=True)
    with pytest.raises(InputError, match="changed since it was opened"):
        history.read(slice(None), slice(None))
    shutil.rmtree(own)
    with pytest.raises(InputError):
        history.read(slice(None), slice(None))


# Fingerprint, checksum, JSON


def test_the_fingerprint_changes_with_every_change_of_the_store(own: Path, tmp_path: Path) -> None:
    history = stores.open_phase_history(own)
    seen = {history.fingerprint()}
    assert history.fingerprint() in seen
    chunk = own / "signal" / "c" / "1" / "1"
    os.utime(chunk, ns=(1, 1))
    seen.add(history.fingerprint())
    chunk.unlink()
    seen.add(history.fingerprint())
    stores.write_region(own, "reference_range", (slice(None),), np.full(256, 12_001.0))
    seen.add(history.fingerprint())
    metadata = json.loads((own / "zarr.json").read_text())
    metadata["attributes"]["carrier_frequency"] = 9.7e9
    (own / "zarr.json").write_text(json.dumps(metadata))
    seen.add(history.fingerprint())
    assert len(seen) == 5
    now = history.fingerprint()
    own.rename(tmp_path / "moved.zarr")
    assert stores.open_phase_history(tmp_path / "moved.zarr").fingerprint() == now


def test_the_checksum_depends_only_on_the_values() -> None:
    values = noise(6, 8)
    assert stores.checksum(values) == stores.checksum(np.asfortranarray(values))
    assert stores.checksum(values[:, ::2]) == stores.checksum(values[:, ::2].copy())
    changed = values.copy()
    changed[5, 7] = np.nextafter(changed[5, 7].real, np.float32(9)) + 1j * changed[5, 7].imag
    assert stores.checksum(changed) != stores.checksum(values)
    assert stores.checksum(np.array(1.5)) and stores.checksum(np.zeros((0, 3)))


def test_json_is_read_back_as_written(tmp_path: Path) -> None:
    path = tmp_path / "run.json"
    record = {"blocks": (1, np.int16(2)), "residual": np.array([0.5, np.nan]), "path": Path("a"), "ok": np.True_}
    stores.write_json(path, record)
    stores.write_json(path, record)
    assert stores.read_json(path) == {"blocks": [1, 2], "residual": [0.5, None], "path": "a", "ok": True}
    with pytest.raises(ValueError, match="sigma"):
        stores.write_json(path, {"sigma": 1j})
    assert os.listdir(tmp_path) == ["run.json"]
    for each in (record, {"counts": {2: 1, 10: 3}, "rows": [(0.5, None)]}):  # the checksum is that of what is read
        stores.write_json(path, each)
        assert stores.json_checksum(stores.read_json(path)) == stores.json_checksum(each)


def test_an_unwritable_path_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("...")
    with pytest.raises(ProcessingError, match="cannot be written"):
        stores.write_json(tmp_path / "file" / "run.json", {})


def test_concurrent_writers_of_a_store_leave_one_whole_store(small_collection: Collection, tmp_path: Path) -> None:
    def make(_: int) -> None:
        stores.create_phase_history(tmp_path / "ph.zarr", small_collection, overwrite=True)

    run_together(make, 6)
    assert same(stores.open_phase_history(tmp_path / "ph.zarr").collection, small_collection)
    assert os.listdir(tmp_path) == ["ph.zarr"]


def run_together(function: Callable[[int], None], times: int) -> None:
    with ThreadPoolExecutor(3) as pool:
        list(pool.map(function, range(times)))


# Shared chunks


def image_store(path: Path, shape: tuple[int, int], chunk: int) -> Path:
    y, x = (np.arange(n, dtype=np.float64) for n in shape)
    stores.create(path, stores.PATCH, sizes={}, coords={"x": x, "y": y}, attrs={}, chunks={"y": chunk, "x": chunk})
    return path


def test_shared_chunks_are_not_copied_and_separate_when_one_is_rewritten(tmp_path: Path) -> None:
    patch, image = image_store(tmp_path / "patch", (6, 11), 4), image_store(tmp_path / "image", (10, 11), 4)
    values = (np.arange(66).reshape(6, 11) * (1 - 2j)).astype(np.complex64)
    whole = (slice(None), slice(None))
    stores.write_region(patch, "image", whole, values)
    cell, window = (slice(4, 8), slice(8, 11)), (slice(0, 4), slice(8, 11))
    for _ in range(2):  # the second time as in a task that is retried
        assert stores.share_region(image, "image", cell, source=patch, source_region=window)
    there, here = (p / "image" / "c" / key / "2" for p, key in ((image, "1"), (patch, "0")))
    assert os.path.samefile(there, here)
    assert sorted(os.listdir(there.parent)) == ["2"]
    np.testing.assert_array_equal(stores.read_region(image, "image", cell), values[window])
    np.testing.assert_array_equal(stores.read_region(image, "image", (slice(0, 4), slice(None))).real, np.nan)
    stores.write_region(patch, "image", whole, 2 * values)
    np.testing.assert_array_equal(stores.read_region(image, "image", cell), values[window])
    zarr.open_array(str(image / "image"), mode="r+")[cell] = 7
    np.testing.assert_array_equal(stores.read_region(patch, "image", whole), 2 * values)


def test_chunks_that_do_not_coincide_are_not_shared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    patch, image = image_store(tmp_path / "patch", (8, 8), 4), image_store(tmp_path / "image", (8, 8), 4)
    other = image_store(tmp_path / "other", (8, 8), 2)
    whole = (slice(0, 8), slice(0, 8))
    for store in (patch, other):
        stores.write_region(store, "image", whole, np.ones((8, 8), np.complex64))
    corner = (slice(0, 4), slice(0, 4))
    assert not stores.share_region(image, "image", corner, source=other, source_region=corner)
    for region, source in (
        (corner, (slice(2, 6), slice(0, 4))),
        ((slice(1, 5), slice(0, 4)), corner),
        (corner, whole),
    ):
        assert not stores.share_region(image, "image", region, source=patch, source_region=source)

    def refused(*_: Any) -> None:
        raise OSError("no hard links here")

    monkeypatch.setattr(os, "link", refused)
    assert not stores.share_region(image, "image", corner, source=patch, source_region=corner)
    assert np.isnan(stores.read_region(image, "image", whole).real).all()
    assert not [p for p in image.rglob("*") if p.name.endswith(".part")]


def test_a_compressed_chunk_that_declares_too_much_is_refused_before_it_is_decoded(tmp_path: Path) -> None:
    """One flipped byte of its header must not exhaust the memory."""
    axes = {"x": np.arange(600.0), "y": np.arange(600.0)}
    stores.create(
        tmp_path / "s", stores.PATCH, sizes={}, coords=axes, attrs={}, chunks={"x": 512, "y": 512}
    )  # fmt: skip
    region = (slice(0, 512), slice(0, 512))
    stores.write_region(tmp_path / "s", "image", region, np.ones((512, 512), np.complex64))
    chunk = tmp_path / "s" / "image" / "c" / "0" / "0"
    frame = chunk.read_bytes()
    width = (1, 2, 4, 8)[frame[4] >> 6]
    header = frame[:4] + bytes([(frame[4] & 0x1F) | 0xE0]) + (1 << 50).to_bytes(8, "little")
    chunk.write_bytes(header + frame[5 + (1 - (frame[4] >> 5 & 1)) + width :])
    with pytest.raises(InputError, match=r"has a chunk of 1125899906842624 bytes instead of 2097152"):
        stores.read_region(tmp_path / "s", "image", region)


def test_heights_that_do_not_compress_are_framed_at_once_and_a_flipped_bit_of_them_is_noticed(tmp_path: Path) -> None:
    axes = {"x": np.arange(600.0), "y": np.arange(300.0)}
    schema = {**stores.IMAGE, **stores.ON_TERRAIN}
    stores.create(tmp_path / "s", schema, sizes={}, coords=axes, attrs={}, chunks={"x": 512, "y": 300})
    height = (300 * np.hypot(*np.meshgrid(axes["x"] - 333.3, axes["y"] + 77.7))).astype(np.float32)
    height[:, 512:] = 7.0  # compresses
    stores.write_region(tmp_path / "s", "height", (slice(0, 300), slice(0, 600)), height)
    np.testing.assert_array_equal(zarr.open_group(tmp_path / "s", mode="r")["height"][...], height)
    np.testing.assert_array_equal(stores.read_region(tmp_path / "s", "height", (slice(0, 300), slice(0, 600))), height)
    dense, level = (tmp_path / "s" / "height" / "c" / "0" / name for name in "01")
    assert dense.stat().st_size == 4 * 300 * 512 + 9 + 3 * 5 + 4 and level.stat().st_size < 10_000
    frame = bytearray(dense.read_bytes())
    assert height[:, :512].tobytes()[:1000] in frame  # as it is
    frame[5000] ^= 1
    dense.write_bytes(frame)
    with pytest.raises(InputError, match="that chunk is damaged"):
        stores.read_region(tmp_path / "s", "height", (slice(0, 300), slice(0, 600)))
