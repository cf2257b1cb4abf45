"""Arrays of a store: opening, and reading and writing of regions.

Arrays may come from other programs: codecs, metadata and chunk names are checked.

zarr is loaded for those only that are not plain files in the layout of `create`.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from blocksar.errors import InputError, ProcessingError
from blocksar.places import Location
from blocksar.places import place as place_of
from blocksar.places.local import LocalPlace
from blocksar.places.objects import ObjectPlace, os_errors
from blocksar.places.place import Place
from blocksar.stores.chunk_files import (
    COMPRESSION,
    NODE_METADATA,
    ZSTD_LEVEL,
    Array,
    ChunkFiles,
    Region,
    check_out,
    chunk_files_of,
    chunk_name,
    refuse_odd_file,
)
from blocksar.stores.records import cause_of, unreachable

if TYPE_CHECKING:
    import zarr

# ---------------------------------------------------------------- opening

CODECS = {  # the only ones accepted: other codecs could run code while decoding, by unpickling for instance
    *("adler32", "bitround", "blosc", "bytes", "bz2", "crc32", "crc32c", "delta", "fixedscaleoffset", "fletcher32"),
    *("gzip", "lz4", "lzma", "packbits", "sharding_indexed", "shuffle", "transpose", "vlen-bytes", "vlen-utf8"),
    *("zlib", "zstd"),
}
CHUNK_NAME = re.compile(r"c|(c\.)?\d+(\.\d+)*")  # name of a chunk's file, or of a folder of chunks


def open_variable(path: Place, name: str, mode: Any = "r") -> ChunkFiles | zarr.Array[Any]:
    """Open a variable: as plain files if it has the layout of `create`, otherwise through zarr.

    Raises
    ------
    InputError, ProcessingError
        As `open_array`.
    """
    return chunk_files_of(path, name) or open_array(path, name, mode)


def open_array(path: Place, name: str, mode: Any = "r") -> zarr.Array[Any]:
    """Open a variable through zarr by its own path, ten times as fast as via its group.

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
    """Refuse an array with a codec not in CODECS: an installed codec could run code from the store."""
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
    """Return the shape of the contents of one file of an array: a chunk, or a shard."""
    return array.chunks if isinstance(array, ChunkFiles) else array.shards or array.chunks


def file_name(array: ChunkFiles | zarr.Array[Any], cell: Sequence[int]) -> str:
    """Return the name of a file of an array, relative to the variable, from its number along each dimension."""
    return chunk_name(cell) if isinstance(array, ChunkFiles) else array.metadata.encode_chunk_key(tuple(cell))


# ---------------------------------------------------------------- regions

OBJECTS_AT_ONCE = 16  # chunks in flight per call, to or from an object store: latency dominates


def write_region(path: Location, name: str, region: Sequence[slice], values: Array, *, cached: bool = False) -> None:
    """Write whole chunks of one variable, without locks: no other task writes them, and a retry may write them again.

    Parameters
    ----------
    path : path
        The store.
    name : str
        Variable.
    region : tuple of slice
        One per dimension, from the start of a chunk to the end of a chunk or of the array.
    values : array
        In the region's shape; cast to the variable's dtype (complex128 to complex64, never complex to real).
    cached : bool
        True: through the page cache, for files that are read again soon.

    Raises
    ------
    ValueError
        If the region is not made of whole chunks, or `values` do not fit it.
    InputError
        If there is no such store or variable.
    ProcessingError
        If it cannot be written, for lack of space or permission for instance.
    """
    place = place_of(path)
    array = open_variable(place, name, mode="r+")
    values = np.asarray(values)
    if len(region) != array.ndim:
        raise ValueError(f"{name} has {array.ndim} dimensions, but the region {region} has {len(region)}")
    bounds = [part.indices(n) for part, n in zip(region, array.shape, strict=True)]
    chunks = file_shape(array)
    for (start, stop, step), n, chunk in zip(bounds, array.shape, chunks, strict=True):
        if step != 1 or start % chunk or (stop % chunk and stop != n):
            raise ValueError(
                f"{name}: {start}:{stop}:{step} of {n} is not made of whole chunks of {chunk}; write whole chunks only"
            )
    shape = tuple(max(stop - start, 0) for start, stop, _ in bounds)
    if values.shape != shape:
        raise ValueError(f"{name}: values have shape {values.shape}, but the region {region} has {shape}")
    if not np.can_cast(values.dtype, array.dtype, "same_kind"):
        raise ValueError(f"{name}: {values.dtype} does not go into {array.dtype}; convert the values")
    try:
        whole = tuple(slice(start, stop) for start, stop, _ in bounds)
        if isinstance(array, ChunkFiles):
            array.write(whole, values, cached=cached)
        elif isinstance(place, LocalPlace):
            array[whole] = values
        else:
            with os_errors(place):
                fast = _at_own_level(array)
                for_each_chunk(whole, chunks, lambda in_array, in_region: fast.__setitem__(in_array, values[in_region]))
    except OSError as error:
        raise ProcessingError(f"{name} in {place} cannot be written ({error.strerror or error})") from error


def _at_own_level(array: zarr.Array[Any]) -> zarr.Array[Any]:
    """Return the array with compression level ZSTD_LEVEL for writing, if its metadata are ours."""
    import zarr
    from zarr.codecs import ZstdCodec

    metadata: Any = array.metadata
    stated = ZstdCodec(**COMPRESSION["configuration"])
    if metadata.zarr_format != 3 or stated not in metadata.codecs:
        return array
    own = replace(stated, level=ZSTD_LEVEL)
    fast = replace(metadata, codecs=tuple(own if codec == stated else codec for codec in metadata.codecs))
    return zarr.Array(zarr.AsyncArray(fast, array.store_path, {"write_empty_chunks": True}))


def read_region(
    path: Location, name: str, region: Sequence[slice], out: Array | None = None, *, cached: bool = True
) -> Array:
    """Read a region of one variable; only the chunks that it touches are read.

    Parameters
    ----------
    path : path
        The store.
    name : str
        Variable.
    region : tuple of slice
        One per dimension, with any bounds and an ascending step.
    out : array, optional
        Filled and returned; in the region's shape and the variable's dtype. It may be a view, also a transposed one.
    cached : bool
        False: past the page cache, for files that were written past it and are read once.

    Returns
    -------
    array
        Of the region's shape, in the variable's dtype; the fill value in chunks that were never written.

    Raises
    ------
    ValueError
        If `out` does not fit the region.
    InputError
        If there is no such store or variable, or a chunk is damaged; the message names the chunk.
    """
    place = place_of(path)
    return read_array(open_variable(place, name), tuple(region), place, name, out, cached=cached)


def chunk_shape(path: Location, name: str) -> tuple[int, ...]:
    """Return the shape of a variable's chunks.

    Raises
    ------
    InputError
        If there is no such store or variable.
    """
    return tuple(open_variable(place_of(path), name).chunks)


def share_region(path: Location, name: str, region: Region, *, source: Location, source_region: Region) -> bool:
    """Share whole chunks of a variable with the variable of that name in another store, without copying them.

    The files are hard-linked, which is safe because a chunk's file is only ever replaced, not written into.

    Returns
    -------
    bool
        False if that is impossible: the chunks do not coincide, the file system has no hard links, or a store lies in
        an object store.
    """
    files, source_files = chunk_files_of(place_of(path), name), chunk_files_of(place_of(source), name)
    if files is None or source_files is None:
        return False
    try:
        files.link(region, source_files, source_region)
    except OSError:
        return False
    return True


def read_array(
    array: ChunkFiles | zarr.Array[Any],
    region: Region,
    store: Place,
    name: str,
    out: Array | None = None,
    *,
    label: str = "",
    seen: Callable[[str, str], None] | None = None,
    cached: bool = True,
) -> Array:
    """Read a region of an open array, as `read_region`. If that fails, name the first damaged chunk.

    `name` is that of the variable; `label` names it in messages. `seen` is told the name of each chunk's file, relative
    to the variable, and the version that was read.
    """
    if isinstance(array, ChunkFiles):
        if len(region) == array.ndim and all(part.step in (None, 1) for part in region):
            with suppress(OSError):
                return array.read(region, out, seen=seen, cached=cached)
        # Otherwise let zarr read it, or say what is wrong.
        array = open_array(store, name)
    label = label or f"{name} in {store}"
    try:
        with os_errors(store):
            values = np.asarray(array[region]) if isinstance(store, LocalPlace) else _fetch(array, region)
    except MemoryError:
        raise
    except Exception as error:
        if isinstance(error, OSError) and isinstance(store, ObjectPlace):
            raise unreachable(store, error) from error
        cause, position = error, ""
        for cell in _cells(array, region):
            try:
                array[cell]
            except Exception as first:
                dims = dimension_names(array) or tuple(f"dimension {i}" for i in range(array.ndim))
                spans = (f"{dim} {part.start}..{part.stop - 1}" for dim, part in zip(dims, cell, strict=True))
                cause, position = first, ", ".join(spans)
                break
        raise InputError(
            f"{label} cannot be read{f' at {position}' if position else ''} ({cause_of(cause)}); "
            "that chunk is damaged or unreachable: write it again"
        ) from error
    if seen is not None:
        with os_errors(store):
            for chunk in chunk_names(array, region):
                seen(chunk, (store / name / chunk).version())
    if out is None:
        return values
    check_out(out, values.shape, values.dtype)
    out[...] = values
    return out


def _fetch(array: zarr.Array[Any], region: Region) -> Array:
    """Read a region from an object store, many chunks at a time."""
    if len(region) != array.ndim or any(part.step not in (None, 1) for part in region):
        return np.asarray(array[region])
    values = np.empty([len(range(*part.indices(n))) for part, n in zip(region, array.shape, strict=True)], array.dtype)
    region = tuple(slice(*part.indices(n)) for part, n in zip(region, array.shape, strict=True))
    for_each_chunk(region, array.chunks, lambda in_array, in_region: values.__setitem__(in_region, array[in_array]))
    return values


def for_each_chunk(region: Region, chunks: Sequence[int], move: Callable[[Region, Region], None]) -> None:
    """Call `move` for every chunk of a region, many at a time, with its slices in the array and in the region.

    zarr's own number of chunks in flight suits files, and holds for the whole process.
    """
    spans = [range(part.start, part.stop) for part in region]
    in_array = [
        [slice(max(i, span.start), min(i + n, span.stop)) for i in range(span.start - span.start % n, span.stop, n)]
        for span, n in zip(spans, chunks, strict=True)
    ]
    in_region = [
        [slice(part.start - span.start, part.stop - span.start) for part in parts]
        for parts, span in zip(in_array, spans, strict=True)
    ]
    with ThreadPoolExecutor(OBJECTS_AT_ONCE) as pool:
        for _ in pool.map(move, product(*in_array), product(*in_region)):
            pass


def chunk_names(array: ChunkFiles | zarr.Array[Any], region: Region) -> Iterator[str]:
    """Iterate over the files that hold a region of step 1, by name relative to the variable."""
    cells = []
    for part, n, side in zip(region, array.shape, file_shape(array), strict=True):
        start, stop, _ = part.indices(n)
        cells.append(range(start // side, -(-stop // side)))
    for cell in product(*cells):
        yield file_name(array, cell)


def _cells(array: zarr.Array[Any], region: Region) -> Iterator[Region]:
    """Iterate over the chunks that a region touches."""
    spans = []
    for part, n, chunk in zip(region, array.shape, array.chunks, strict=True):
        start, stop, _ = part.indices(n)
        spans.append([slice(i, min(i + chunk, n)) for i in range(start - start % chunk, stop, chunk)])
    yield from product(*spans)
