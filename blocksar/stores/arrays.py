"""Opening arrays of a store: only known codecs, only names of chunks in its folders."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import zarr

from blocksar.errors import InputError
from blocksar.places.local import LocalPlace
from blocksar.places.objects import ObjectPlace, os_errors
from blocksar.places.place import Place
from blocksar.stores.chunk_files import refuse_odd_file
from blocksar.stores.faults import cause_of, unreachable

CODECS = {  # all that may decode a chunk: of others who knows what they do with it, such as unpickling
    *("adler32", "bitround", "blosc", "bytes", "bz2", "crc32", "crc32c", "delta", "fixedscaleoffset", "fletcher32"),
    *("gzip", "lz4", "lzma", "packbits", "sharding_indexed", "shuffle", "transpose", "vlen-bytes", "vlen-utf8"),
    *("zlib", "zstd"),
}
METADATA = ("zarr.json", ".zgroup", ".zarray")
CHUNK_NAME = re.compile(r"c|(c\.)?\d+(\.\d+)*")  # what a chunk's file, or a folder of them, is called


def open_array(path: Place, name: str, mode: Any = "r") -> zarr.Array[Any]:
    """Open a variable by its own path: a tenth of the time of opening the group first."""
    place = path / name
    try:
        found = metadata_file(place)
        missing = "" if found else f"it has no variable {name}" if path.exists() else "it is not there"
    except OSError as error:
        raise unreachable(place, error, writing=mode != "r") from error
    if missing:
        raise InputError(f"{name} cannot be read from {path}: {missing}; check the path, or write it again")
    try:
        with os_errors(place):
            array = zarr.open_array(
                store=place.zarr_path(),
                mode=mode,
                zarr_format=3 if found == "zarr.json" else 2,
                config={"write_empty_chunks": True},
            )
    except Exception as error:
        if isinstance(error, OSError) and isinstance(place, ObjectPlace):
            raise unreachable(place, error, writing=mode != "r") from error
        raise InputError(f"{place} has damaged metadata ({cause_of(error)}); write it again") from error
    refuse_codecs(array, str(place))
    return array


def refuse_codecs(array: zarr.Array[Any], what: str) -> None:
    """Chunks are decoded by known codecs only: whatever else is installed here may run what a store tells it to."""
    metadata: Any = array.metadata.to_dict()
    stated = metadata.get("codecs") or [*(metadata.get("filters") or ()), metadata.get("compressor")]
    for name in _codec_names(stated):
        if name not in CODECS:
            raise InputError(f"{what} is encoded by {name!r}, which is not decoded here; write it with zstd or plainly")


def _codec_names(codecs: Any) -> Iterator[str]:
    """Names of codecs in an array's metadata, of version 3 or 2; those within shards included."""
    for codec in codecs:
        match codec:
            case {"name": str(name)}:
                yield name.removeprefix("numcodecs.")
                inner = codec.get("configuration") or {}
                yield from _codec_names((*inner.get("codecs", ()), *inner.get("index_codecs", ())))
            case {"id": str(name)} | str(name):
                yield name.removeprefix("numcodecs.")
            case other if other is not None:
                yield str(other)


def metadata_file(path: Place) -> str:
    """Name of the zarr metadata in a directory, version 3 or 2; empty if there is none."""
    if not isinstance(path, LocalPlace):
        for name in METADATA:
            with suppress(FileNotFoundError):
                (path / name).read_bytes()
                return name
        return ""
    found = ""
    for name in (*METADATA, ".zattrs"):  # zarr reads all that are there
        # Not os.path.isfile: to that, a folder one may not enter is an empty one.
        with suppress(FileNotFoundError, NotADirectoryError):
            refuse_odd_file(os.path.join(path.path, name))
            found = found or name
    return found if found != ".zattrs" else ""


def refuse_odd_chunks(folder: str | os.PathLike[str], depth: int) -> None:
    """Refuse pipes, devices, links to nothing, and folders where chunks should be: zarr takes these for no chunk.

    Chunks are `depth` names below the variable's folder: c/0/0 is three.
    """
    with os.scandir(folder) as found:
        entries = list(found)
    for entry in entries:
        chunk = CHUNK_NAME.fullmatch(entry.name) is not None
        if entry.is_dir():
            odd = chunk and depth == 1
            if not odd and depth > 1:
                refuse_odd_chunks(entry.path, depth - 1)
        else:
            odd = not entry.is_file() or (chunk and depth > 1)
        if odd:
            right = "file" if depth == 1 or not chunk else "folder"
            raise InputError(f"{entry.path} should be a {right} that can be read; put it back, or write it again")


def dimension_names(array: zarr.Array[Any]) -> tuple[str | None, ...] | None:
    """Dimension names: in the metadata since version 3, an attribute of xarray's before."""
    dims: Any = getattr(array.metadata, "dimension_names", None) or array.attrs.get("_ARRAY_DIMENSIONS")
    return None if dims is None else tuple(dims)
