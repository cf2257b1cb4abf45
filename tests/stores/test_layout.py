"""The layout of our stores: the same bytes as through zarr, and opened alike with and without it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from zarr.codecs import ZstdCodec

from blocksar import stores
from blocksar.collection.collection import Collection
from blocksar.errors import InputError
from blocksar.places import place
from blocksar.stores import chunk_files, contract, phase_history, regions
from blocksar.stores.contract import Variable

SCHEMAS: dict[str, dict[str, Variable]] = {
    name: value
    for name, value in vars(contract).items()
    if isinstance(value, dict) and all(isinstance(variable, Variable) for variable in value.values())
}
SCHEMAS |= {
    "PHASE_HISTORY with channels": stores.with_channels(stores.PHASE_HISTORY, "signal"),
    "IMAGE with looks": stores.with_channels(
        stores.IMAGE | stores.NOISE | stores.ON_TERRAIN | stores.COLLECTION_NUMBER, "image", dimension="look"
    ),
    "a compressed small variable": {"s": Variable(("n", "m"), "complex64", "1", "samples", compressed=True)},
    "an empty variable": {"s": Variable(("nothing",), "float64", "1", "samples")},
}
LENGTHS = {"channel": 2, "look": 3, "pulse": 7, "axis": 3, "nothing": 0}
CHUNKS = {"pulse": 3, "y": 2, "x": 4, "channel": 1}
ATTRS = {"title": "\u00fcn\u00efc\u00f6d\u00e9 \U0001f6f0", "width": np.nan, "list": [1, 2.5, {"a": None}], "none": []}
pytestmark = pytest.mark.filterwarnings("ignore:The codec .vlen-utf8.")  # of zarr 3.1.0


def values_of(variable: Variable) -> np.ndarray:
    shape = tuple(LENGTHS.get(dim, 5) for dim in variable.dims)
    if variable.dtype == "T":
        return np.asarray([f"n\u00e4me{i}" for i in range(shape[0])], "T")
    values = np.arange(np.prod(shape, dtype=int)).reshape(shape) - 3.25
    if variable.dtype[0] in "fc" and values.size:
        values.flat[-1] = np.nan
    return values.astype(variable.dtype)


def create_with_zarr(path: Path, variables: Mapping[str, Variable], small: Mapping[str, Any], coords: set[str]) -> None:
    """Create a store as `stores.create` does, through zarr."""
    attrs = ATTRS | {"width": None}
    group = zarr.create_group(path, zarr_format=3, attributes=attrs)
    for name, variable in variables.items():
        shape = tuple(LENGTHS.get(dim, 5) for dim in variable.dims)
        whole = name in small
        lengths = (n if whole else CHUNKS.get(dim, n) for dim, n in zip(variable.dims, shape, strict=True))
        attributes: dict[str, Any] = {"units": variable.units, "long_name": variable.long_name}
        if variable.flags:
            attributes |= {"flag_values": [*range(len(variable.flags))], "flag_meanings": " ".join(variable.flags)}
        listed = [c for c in coords if variables[c].dims != (c,) and {*variables[c].dims} <= {*variable.dims}]
        if listed and name not in coords:
            attributes["coordinates"] = " ".join(listed)
        kind = np.dtype(variable.dtype).kind
        array = group.create_array(
            name,
            shape=shape,
            chunks=tuple(max(min(n, m), 1) for n, m in zip(lengths, shape, strict=True)),
            dtype=variable.dtype,
            fill_value={"T": "", "u": 255, "i": -1, "f": np.nan, "c": complex(np.nan, np.nan)}[kind],
            compressors=[ZstdCodec(level=-5, checksum=True)] if variable.compressed else None,
            filters=None,
            dimension_names=variable.dims,
            attributes=attributes,
            config={"write_empty_chunks": True},
        )
        if whole:
            array[...] = small[name]
    metadata = json.loads((path / "zarr.json").read_bytes())
    metadata.pop("consolidated_metadata", None)  # elsewhere before zarr 3.1.4
    inline = {name: json.loads((path / name / "zarr.json").read_bytes()) for name in variables}
    metadata["consolidated_metadata"] = {"kind": "inline", "must_understand": False, "metadata": inline}
    (path / "zarr.json").write_text(json.dumps(metadata, indent=2))
    for file in path.rglob("zarr.json"):  # GDAL refuses arrays that state a negative level
        file.write_text(file.read_text().replace('"level": -5', '"level": 1'))


def files_of(path: Path) -> dict[str, bytes]:
    return {str(file.relative_to(path)): file.read_bytes() for file in path.rglob("*") if file.is_file()}


@pytest.mark.parametrize("small", [True, False], ids=["written", "to be written"])
@pytest.mark.parametrize("name", SCHEMAS)
def test_a_store_has_the_bytes_that_zarr_writes(name: str, small: bool, tmp_path: Path) -> None:
    variables = SCHEMAS[name]
    written = {key: values_of(variable) for key, variable in variables.items() if small or variable.dims == (key,)}
    coords = {key for key in written if key in ("time", *(dim for v in variables.values() for dim in v.dims))}
    create_with_zarr(tmp_path / "zarr", variables, written, coords)
    stores.create(
        tmp_path / "own",
        variables,
        sizes={dim: LENGTHS.get(dim, 5) for variable in variables.values() for dim in variable.dims},
        coords={key: written[key] for key in variables if key in coords},
        variables={key: value for key, value in written.items() if key not in coords},
        attrs=ATTRS,
        chunks=CHUNKS,
    )
    assert files_of(tmp_path / "own") == files_of(tmp_path / "zarr")


def through_zarr(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave every array and group to zarr."""
    monkeypatch.setattr(regions, "chunk_files_of", lambda *_: None)
    monkeypatch.setattr(phase_history, "group_attrs", lambda _: None)


@pytest.fixture
def own(small_collection: Collection, tmp_path: Path) -> Path:
    stores.create_phase_history(tmp_path / "ph.zarr", small_collection, channels=("HH", "HV"), attrs={"scene": "s"})
    return tmp_path / "ph.zarr"


def test_a_store_is_opened_alike_through_zarr(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert all(
        chunk_files.chunk_files_of(place(own), name)
        for name in (*contract.PHASE_HISTORY, "channel")
        if name != "beam_axis"
    )
    direct = stores.open_phase_history(own)
    through_zarr(monkeypatch)
    other = stores.open_phase_history(own)
    assert direct.same(other) and direct.attrs == other.attrs and direct.channels == other.channels == ("HH", "HV")
    assert direct.shape == other.shape and direct.chunks == other.chunks
    assert list(direct.collection.as_dict()) == list(other.collection.as_dict())


def variable(name: str, **changes: Any) -> Callable[[Path], None]:
    """Change the metadata of a variable, or of the group."""

    def change(store: Path) -> None:
        file = store / name / "zarr.json"
        file.write_text(json.dumps(json.loads(file.read_text()) | changes))

    return change


def chunk(name: str, content: bytes) -> Callable[[Path], None]:
    def change(store: Path) -> None:
        (store / name).write_bytes(content)

    return change


ZSTD = {"name": "zstd", "configuration": {"level": 3, "checksum": False}}
BYTES = {"name": "bytes", "configuration": {"endian": "little"}}
DEPARTURES: dict[str, Callable[[Path], None]] = {
    "units": variable("time", attributes={"units": "ms"}),
    "packed": variable("time", attributes={"scale_factor": 2}),
    "attributes": variable("time", attributes=5),
    "no names": variable("time", dimension_names=None),
    "a text of names": variable("time", dimension_names="p"),
    "other names": variable("time", dimension_names=["azimuth"]),
    "too many names": variable("time", dimension_names=["pulse", "axis"]),
    "transposed": variable("antenna_position", dimension_names=["axis", "pulse"]),
    "integers": variable("signal", data_type="int16", fill_value=-1),
    "too long": variable("time", shape=[1 << 25]),
    "a huge chunk": variable(
        "time", chunk_grid={"name": "regular", "configuration": {"chunk_shape": [1 << 40]}}
    ),
    "many chunks": variable("time", chunk_grid={"name": "regular", "configuration": {"chunk_shape": [1]}}),
    "one pulse less": variable("time", shape=[255]),
    "a level beyond zstd's": variable(
        "time", codecs=[BYTES, {"name": "zstd", "configuration": {"level": 99, "checksum": False}}]
    ),
    "a word more of zstd": variable(
        "time", codecs=[BYTES, {"name": "zstd", "configuration": {"level": 1, "checksum": False, "fast": True}}]
    ),
    "compressed, it says": variable("time", codecs=[BYTES, ZSTD]),
    "a word more": variable("time", more={}),
    "a short chunk": chunk("time/c/0", b"1234"),
    "channels": variable("channel", shape=[3]),
    "channels of another dimension": variable("channel", dimension_names=["look"]),
    "a channel's name": chunk("channel/c/0", b"\2\0\0\0\2\0\0\0HH\2\0\0\0.."),
    "no texts": chunk("channel/c/0", b""),
    "too many texts": chunk("channel/c/0", b"\xff\xff\0\0\2\0\0\0HH\2\0\0\0HV"),
    "a text without its end": chunk("channel/c/0", b"\2\0\0\0\2\0\0\0HH\x09\0\0\0HV"),
    "a text that is none": chunk("channel/c/0", b"\2\0\0\0\2\0\0\0HH\2\0\0\0\xff\xff"),
    "a group's attributes": variable("", attributes=[]),
    "a group's version": variable("", zarr_format=4),
    "a group's word more": variable("", more={}),
    "a group that is none": variable("", node_type="array"),
}  # fmt: skip


@pytest.mark.parametrize("name", DEPARTURES)
def test_a_departure_is_refused_as_through_zarr(name: str, own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    DEPARTURES[name](own)
    with pytest.raises(InputError) as found:
        stores.open_phase_history(own)
    through_zarr(monkeypatch)
    with pytest.raises(InputError) as expected:
        stores.open_phase_history(own)
    assert str(found.value) == str(expected.value)


def test_no_group_without_consolidated_metadata_needs_zarr(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    metadata = json.loads((own / "zarr.json").read_text())
    del metadata["consolidated_metadata"]
    (own / "zarr.json").write_text(json.dumps(metadata))
    monkeypatch.setattr(zarr, "open_group", None)
    assert stores.open_phase_history(own).attrs["scene"] == "s"


def test_text_is_written_and_read_by_region(tmp_path: Path) -> None:
    names = np.asarray(["", "\u00fc", "HH" * 40, "x", "HV"], "T")
    text = {"s": Variable(("n",), "T", "1", "names")}
    stores.create(tmp_path / "s", text, sizes={"n": 5}, coords={}, attrs={}, chunks={"n": 2})
    stores.write_region(tmp_path / "s", "s", (slice(2, 5),), names[2:])
    assert [*stores.read_region(tmp_path / "s", "s", (slice(None),))] == ["", "", *names[2:]]
    assert [*zarr.open_array(tmp_path / "s" / "s", mode="r")[:]] == ["", "", *names[2:]]
    assert [*stores.read_region(tmp_path / "s", "s", (slice(3, 5),))] == ["x", "HV"]
