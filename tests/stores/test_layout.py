"""The layout of our stores: the same bytes as through zarr."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from zarr.codecs import ZstdCodec

from blocksar import stores
from blocksar.stores import schema
from blocksar.stores.schema import Variable

SCHEMAS: dict[str, dict[str, Variable]] = {
    name: value
    for name, value in vars(schema).items()
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


def test_text_is_written_and_read_by_region(tmp_path: Path) -> None:
    names = np.asarray(["", "\u00fc", "HH" * 40, "x", "HV"], "T")
    text = {"s": Variable(("n",), "T", "1", "names")}
    stores.create(tmp_path / "s", text, sizes={"n": 5}, coords={}, attrs={}, chunks={"n": 2})
    stores.write_region(tmp_path / "s", "s", (slice(2, 5),), names[2:])
    assert [*stores.read_region(tmp_path / "s", "s", (slice(None),))] == ["", "", *names[2:]]
    assert [*zarr.open_array(tmp_path / "s" / "s", mode="r")[:]] == ["", "", *names[2:]]
    assert [*stores.read_region(tmp_path / "s", "s", (slice(3, 5),))] == ["x", "HV"]
