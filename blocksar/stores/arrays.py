"""Opening the arrays of a store, which may come from other programs: codecs, metadata and chunk names are checked.

zarr is loaded for those only that are not plain files in the layout of `create`.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from blocksar.errors import InputError
from blocksar.places.local import LocalPlace
from blocksar.places.objects import ObjectPlace, os_errors
from blocksar.places.place import Place
from blocksar.stores.chunk_files import NODE_METADATA, ChunkFiles, chunk_files_of, chunk_name, refuse_odd_file
from blocksar.stores.records import cause_of, unreachable

if TYPE_CHECKING:
    import zarr

CODECS = {  # the only ones accepted: other codecs could run code while decoding, by unpickling for instance
    *("adler32", "bitround", "blosc", "bytes", "bz2", "crc32", "crc32c", "delta", "fixedscaleoffset", "fletcher32"),
    *("gzip", "lz4", "lzma", "packbits", "sharding_indexed", "shuffle", "transpose", "vlen-bytes", "vlen-utf8"),
    *("zlib", "zstd"),
}
CHUNK_NAME = re.compile(r"c|(c\.)?\d+(\.\d+)*")  # name of a chunk's file, or of a folder of chunks


def open_variable(path: Place, name: str, mode: Any = "r") -> ChunkFiles | zarr.Array[Any]:
    """Open a variable: as plain files if it has the layout of `create`, else through zarr.

    Raises
    ------
    InputError, ProcessingError
        As `open_array`.
    """
    return chunk_files_of(path, name) or open_array(path, name, mode)


def open_array(path: Place, name: str, mode: Any = "r") -> zarr.Array[Any]:
    """Open a variable through zarr by its own path, which takes a tenth of the time of opening the group first.

    Raises
    ------
    InputError
        If there is no such store or variable, its metadata is damaged, or it uses an unknown codec.
    ProcessingError
        If it cannot be opened for writing.
    """
    import zarr

    place = path / name
    try:
        metadata = metadata_file(place)
        missing = "" if metadata else f"it has no variable {name}" if path.exists() else "it is not there"
    except OSError as error:
        raise unreachable(place, error, writing=mode != "r") from error
    if missing:
        raise InputError(f"{name} cannot be read from {path}: {missing}; check the path, or write it again")
    try:
        with os_errors(place):
            array = zarr.open_array(
                store=place.zarr_path(),
                mode=mode,
                zarr_format=3 if metadata == "zarr.json" else 2,
                # Comparing every chunk with the fill value costs more than writing it; and a chunk then exists if and
                # only if it was written.
                config={"write_empty_chunks": True},
            )
    except Exception as error:
        if isinstance(error, OSError) and isinstance(place, ObjectPlace):
            raise unreachable(place, error, writing=mode != "r") from error
        raise InputError(f"{place} has damaged metadata ({cause_of(error)}); write it again") from error
    refuse_codecs(array, str(place))
    return array


def refuse_codecs(array: zarr.Array[Any], label: str) -> None:
    """Raise an InputError if an array uses a codec not in CODECS: an installed one could run code from the store."""
    metadata: Any = array.metadata.to_dict()
    stated = metadata.get("codecs") or [*(metadata.get("filters") or ()), metadata.get("compressor")]
    for name in _codec_names(stated):
        if name not in CODECS:
            raise InputError(
                f"{label} is encoded by {name!r}, which is not supported; write it with zstd or uncompressed"
            )


def _codec_names(codecs: Any) -> Iterator[str]:
    """List the names of the codecs in an array's metadata, version 3 or 2, including those within shards."""
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
    """Return the name of the zarr metadata file in a folder, version 3 or 2; empty if there is none."""
    if not isinstance(path, LocalPlace):
        for name in NODE_METADATA:
            with suppress(FileNotFoundError):
                (path / name).read_bytes()
                return name
        return ""
    first = ""
    for name in (*NODE_METADATA, ".zattrs"):  # all are checked, as zarr reads whichever exist
        # Not os.path.isfile: it takes a folder without permission for an empty one.
        with suppress(FileNotFoundError, NotADirectoryError):
            refuse_odd_file(os.path.join(path.path, name))
            first = first or name
    return first if first != ".zattrs" else ""


def refuse_odd_chunks(folder: str | os.PathLike[str], depth: int) -> None:
    """Raise an InputError for pipes, devices, broken links, and folders in place of chunks: zarr ignores these.

    Chunks lie `depth` levels below the variable's folder: three for c/0/0.
    """
    with os.scandir(folder) as listing:
        entries = list(listing)
    for entry in entries:
        chunk = CHUNK_NAME.fullmatch(entry.name) is not None
        if entry.is_dir():
            odd = chunk and depth == 1
            if not odd and depth > 1:
                refuse_odd_chunks(entry.path, depth - 1)
        else:
            odd = not entry.is_file() or (chunk and depth > 1)
        if odd:
            expected = "file" if depth == 1 or not chunk else "folder"
            raise InputError(f"{entry.path} should be a readable {expected}; restore it, or write the store again")


def dimension_names(array: ChunkFiles | zarr.Array[Any]) -> tuple[str | None, ...] | None:
    """Return an array's dimension names: from its metadata in version 3, from xarray's attribute in version 2."""
    if isinstance(array, ChunkFiles):
        return array.dims
    dims: Any = getattr(array.metadata, "dimension_names", None) or array.attrs.get("_ARRAY_DIMENSIONS")
    return None if dims is None else tuple(dims)


def file_shape(array: ChunkFiles | zarr.Array[Any]) -> tuple[int, ...]:
    """Return the shape of what one file of an array holds: a chunk, or a shard."""
    return array.chunks if isinstance(array, ChunkFiles) else array.shards or array.chunks


def file_name(array: ChunkFiles | zarr.Array[Any], cell: Sequence[int]) -> str:
    """Return the name of a file of an array, relative to the variable, from its number along each dimension."""
    return chunk_name(cell) if isinstance(array, ChunkFiles) else array.metadata.encode_chunk_key(tuple(cell))
