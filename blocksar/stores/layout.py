"""The layout of stores that `create` writes: zarr's metadata, version 3, written and recognised without zarr.

Loading zarr takes 0.1 to 0.3 s, and creating a store through it 4 to 9 ms instead of 1 ms: every run would wait.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

METADATA = (".zarray", ".zattrs", ".zgroup", ".zmetadata", "zarr.json")  # all names of files of metadata
NODE_METADATA = ("zarr.json", ".zgroup", ".zarray")  # one of which each group and array has
# Images: noise does not compress, and passes at the speed of memory; what is not covered takes no room. The checksum
# lets every reader notice an altered chunk.
COMPRESSION: dict[str, Any] = {"name": "zstd", "configuration": {"level": -5, "checksum": True}}
HIGHEST_LEVEL = 22  # of zstd
# Fill values by data type, as in the metadata; numpy's names are the same, except that of text.
FILLS = {"complex64": ["NaN", "NaN"], "float64": "NaN", "float32": "NaN", "int16": -1, "uint8": 255, "string": ""}


class Layout(NamedTuple):
    """Layout that the metadata of a variable state.

    Attributes
    ----------
    shape, chunks : tuple of int
        Shape of the array, and of a chunk.
    dtype : numpy dtype
        In the machine's byte order.
    compression : dict or None
        Its codec, as COMPRESSION; None: the samples as they are.
    dims : tuple of str
    attrs : dict
        Not to be changed.
    """

    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    dtype: np.dtype[Any]
    compression: Mapping[str, Any] | None
    dims: tuple[str, ...]
    attrs: Mapping[str, Any]


def fill_value(dtype: np.dtype[Any]) -> Any:
    """Return the value that stands for missing samples: NaN, -1 or the largest number for integers, or no text."""
    if dtype.kind == "T":
        return ""
    if dtype.kind == "u":
        return int(np.iinfo(dtype).max)
    return complex(np.nan, np.nan) if dtype.kind == "c" else np.nan if dtype.kind == "f" else -1


def array_metadata(layout: Layout) -> dict[str, Any]:
    """Return the metadata of a variable, with keys in zarr's order."""
    data_type = "string" if layout.dtype.kind == "T" else layout.dtype.name
    codec: dict[str, Any] = {"name": "bytes"}
    if data_type == "string":
        codec = {"name": "vlen-utf8", "configuration": {}}
    elif layout.dtype.itemsize > 1:
        codec["configuration"] = {"endian": sys.byteorder}
    return {
        "shape": [*layout.shape],
        "data_type": data_type,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [*layout.chunks]}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "fill_value": FILLS[data_type],
        "codecs": [codec, *([] if layout.compression is None else [layout.compression])],
        "attributes": layout.attrs,
        "dimension_names": [*layout.dims],
        "zarr_format": 3,
        "node_type": "array",
        "storage_transformers": [],
    }


def group_metadata(attrs: Mapping[str, Any], variables: Mapping[str, Any]) -> dict[str, Any]:
    """Return the metadata of a store, consolidated: with a copy of its variables'.

    Without the copy, xarray.open_zarr(path) warns. Metadata does not change after creation, so the copy stays valid.
    """
    inline = {"kind": "inline", "must_understand": False, "metadata": variables}
    return {"attributes": attrs, "zarr_format": 3, "node_type": "group", "consolidated_metadata": inline}


def metadata_bytes(metadata: Mapping[str, Any]) -> bytes:
    """Return the content of a metadata file."""
    return json.dumps(metadata, indent=2).encode()


@lru_cache(maxsize=256)
def layout_of(content: bytes) -> Layout | None:
    """Return what a variable's metadata file states, if it is as `create` writes it, at any level of compression."""
    try:
        metadata = json.loads(content)
    except (ValueError, RecursionError):
        return None
    match metadata:
        case {
            "shape": [*shape],
            "data_type": str(data_type),
            "chunk_grid": {"configuration": {"chunk_shape": [*chunks]}},
            "codecs": [_, *compression],
            "attributes": dict(attrs),
            "dimension_names": [*dims],
        } if (
            data_type in FILLS
            and len(shape) == len(chunks) == len(dims) > 0
            and all(type(n) is int and n > 0 for n in (*shape, *chunks))
            and all(isinstance(dim, str) for dim in dims)
            and all(map(_is_zstd, compression))
            and not (data_type == "string" and compression)
        ):
            dtype = np.dtype("T" if data_type == "string" else data_type)
            codec = compression[0] if compression else None
            layout = Layout(tuple(shape), tuple(chunks), dtype, codec, tuple(dims), attrs)
            return layout if metadata == array_metadata(layout) else None
    return None


def _is_zstd(codec: Any) -> bool:
    """Tell whether a codec's metadata is that of zstd, and zarr would take it."""
    match codec:
        case {"name": "zstd", "configuration": {"level": int(level), "checksum": bool()}}:
            return level <= HIGHEST_LEVEL and len(codec) == len(codec["configuration"]) == 2
    return False


def group_attrs(metadata: Any) -> dict[str, Any] | None:
    """Return the attributes in a store's metadata; None if it is not as `create` writes it, or zarr's consolidation."""
    match metadata:
        # A copy of the variables' metadata may be out of date, and is not looked at.
        case {"attributes": dict(attrs), "zarr_format": 3, "node_type": "group", **rest}:
            return attrs if rest.keys() <= {"consolidated_metadata"} else None
    return None
