"""One region of one variable, read or written."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from itertools import product
from typing import Any

import numpy as np
import zarr

from blocksar.errors import InputError, ProcessingError
from blocksar.places import Location
from blocksar.places import place as place_of
from blocksar.places.local import LocalPlace
from blocksar.places.objects import ObjectPlace, os_errors
from blocksar.places.place import Place
from blocksar.stores.arrays import dimension_names, open_array
from blocksar.stores.chunk_files import Array, ChunkFiles, Region, check_out, chunk_files_of
from blocksar.stores.faults import cause_of, unreachable

OBJECTS_AT_ONCE = 16  # chunks in flight to or from an object store, by one call: what these cost is waiting
FILES_AT_ONCE = 2  # chunks in flight in one process: zarr's own 10 lose up to 1.7x to moving buffers about

zarr.config.set({"async.concurrency": FILES_AT_ONCE})


def write_region(path: Location, name: str, region: Sequence[slice], values: Array) -> None:
    """Write whole chunks of one variable: chunks nobody else writes need no lock, and may be written again.

    Parameters
    ----------
    path : path
        The store.
    name : str
        Variable.
    region : tuple of slice
        One a dimension; from one chunk's start to another's end, or the end of the array.
    values : array
        Of the region's shape; cast to the variable's dtype (complex128 to complex64, never complex to real).

    Raises
    ------
    ValueError
        If the region is not made of whole chunks, or `values` do not fit it.
    InputError
        If there is no such store or variable.
    ProcessingError
        If it cannot be written: no room, no permission.
    """
    place = place_of(path)
    array = chunk_files_of(place, name) or open_array(place, name, mode="r+")
    values = np.asarray(values)
    if len(region) != array.ndim:
        raise ValueError(f"{name} has {array.ndim} dimensions, but the region {region} has {len(region)}")
    bounds = [part.indices(n) for part, n in zip(region, array.shape, strict=True)]
    chunks = array.chunks if isinstance(array, ChunkFiles) else array.shards or array.chunks
    for (start, stop, step), n, chunk in zip(bounds, array.shape, chunks, strict=True):
        if step != 1 or start % chunk or (stop % chunk and stop != n):
            raise ValueError(
                f"{name}: {start}:{stop}:{step} is not whole chunks of {chunk} in {n}; write whole chunks only"
            )
    shape = tuple(max(stop - start, 0) for start, stop, _ in bounds)
    if values.shape != shape:
        raise ValueError(f"{name}: values have shape {values.shape}, but the region {region} has {shape}")
    if not np.can_cast(values.dtype, array.dtype, "same_kind"):
        raise ValueError(f"{name}: {values.dtype} does not go into {array.dtype}")
    try:
        whole = tuple(slice(start, stop) for start, stop, _ in bounds)
        if isinstance(array, ChunkFiles):
            array.write(whole, values)
        elif isinstance(place, LocalPlace):
            array[whole] = values
        else:
            with os_errors(place):
                _each_chunk(whole, chunks, lambda there, here: array.__setitem__(there, values[here]))
    except OSError as error:
        raise ProcessingError(f"{name} in {place} cannot be written ({error.strerror or error})") from error


def read_region(path: Location, name: str, region: Sequence[slice], out: Array | None = None) -> Array:
    """Read a region of one variable; of the samples, only the chunks it touches are read.

    Parameters
    ----------
    path : path
        The store.
    name : str
        Variable.
    region : tuple of slice
        One a dimension, of any place and ascending step.
    out : array, optional
        Of the region's shape and the variable's dtype, to be filled and returned: a view, turned or not, will do.

    Returns
    -------
    array
        In the variable's dtype; fill value where nothing was written.

    Raises
    ------
    ValueError
        If `out` does not fit the region.
    InputError
        If there is no such store or variable, or a chunk is damaged: it names the chunk.
    """
    place = place_of(path)
    array = chunk_files_of(place, name) or open_array(place, name)
    return read_array(array, tuple(region), place, f"{name} in {place}", out)


def chunk_shape(path: Location, name: str) -> tuple[int, ...]:
    """Of one variable.

    Raises
    ------
    InputError
        If there is no such store or variable.
    """
    files = chunk_files_of(place_of(path), name)
    return files.chunks if files is not None else tuple(open_array(place_of(path), name).chunks)


def share_region(path: Location, name: str, region: Region, *, source: Location, source_region: Region) -> bool:
    """Let whole chunks of a variable be those of another store's variable of that name, without copying them.

    Files are hard-linked, which is safe as nobody writes into a chunk's file: a new one takes its place.

    Returns
    -------
    bool
        False where that cannot be done: chunks do not fall together, the file system knows no hard links, or it is
        an object store.
    """
    ours, theirs = chunk_files_of(place_of(path), name), chunk_files_of(place_of(source), name)
    if ours is None or theirs is None:
        return False
    try:
        ours.link(region, theirs, source_region)
    except OSError:
        return False
    return True


def read_array(
    array: ChunkFiles | zarr.Array[Any], region: Region, where: Place, what: str, out: Array | None = None
) -> Array:
    """Read a region; where that fails, find the first chunk at fault and name it."""
    if isinstance(array, ChunkFiles):
        if len(region) == array.ndim and all(part.step in (None, 1) for part in region):
            with suppress(OSError):
                return array.read(region, out)
        # Whatever it was, zarr makes sense of it, or says what is wrong.
        array = open_array(where, os.path.basename(array.folder))
    try:
        with os_errors(where):
            values = np.asarray(array[region]) if isinstance(where, LocalPlace) else _fetch(array, region)
    except MemoryError:
        raise
    except Exception as error:
        if isinstance(error, OSError) and isinstance(where, ObjectPlace):
            raise unreachable(where, error) from error
        cause, place = error, ""
        for cell in _cells(array, region):
            try:
                array[cell]
            except Exception as first:
                dims = dimension_names(array) or tuple(f"dimension {i}" for i in range(array.ndim))
                spans = (f"{dim} {part.start}..{part.stop - 1}" for dim, part in zip(dims, cell, strict=True))
                cause, place = first, ", ".join(spans)
                break
        raise InputError(
            f"{what} cannot be read{f' at {place}' if place else ''} ({cause_of(cause)}); "
            "that chunk is damaged or out of reach: write it again"
        ) from error
    if out is None:
        return values
    check_out(out, values.shape, values.dtype)
    out[...] = values
    return out


def _fetch(array: zarr.Array[Any], region: Region) -> Array:
    """Read a region from an object store."""
    if len(region) != array.ndim or any(part.step not in (None, 1) for part in region):
        return np.asarray(array[region])
    values = np.empty([len(range(*part.indices(n))) for part, n in zip(region, array.shape, strict=True)], array.dtype)
    region = tuple(slice(*part.indices(n)) for part, n in zip(region, array.shape, strict=True))
    _each_chunk(region, array.chunks, lambda there, here: values.__setitem__(here, array[there]))
    return values


def _each_chunk(region: Region, chunks: Sequence[int], move: Callable[[Region, Region], None]) -> None:
    """Call `move` for every chunk of a region, many at a time, with where it is in the array and in the region.

    zarr's own number of chunks in flight is set for files, and for all of a process.
    """
    spans = [range(part.start, part.stop) for part in region]
    there = [
        [slice(max(i, span.start), min(i + n, span.stop)) for i in range(span.start - span.start % n, span.stop, n)]
        for span, n in zip(spans, chunks, strict=True)
    ]
    here = [[slice(p.start - s.start, p.stop - s.start) for p in parts] for parts, s in zip(there, spans, strict=True)]
    with ThreadPoolExecutor(OBJECTS_AT_ONCE) as pool:
        for _ in pool.map(move, product(*there), product(*here)):
            pass


def _cells(array: zarr.Array[Any], region: Region) -> Iterator[Region]:
    """The chunks that a region touches."""
    spans = []
    for part, n, chunk in zip(region, array.shape, array.chunks, strict=True):
        start, stop, _ = part.indices(n)
        spans.append([slice(i, min(i + chunk, n)) for i in range(start - start % chunk, stop, chunk)])
    yield from product(*spans)
