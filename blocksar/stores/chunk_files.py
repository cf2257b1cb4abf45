"""Chunks as plain files: of all that touches samples, only this takes a store for a folder of a local file system."""

from __future__ import annotations

import json
import os
import stat
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from math import prod
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from blocksar.errors import InputError
from blocksar.places.local import LocalPlace, replacing_file
from blocksar.places.place import Place

Region = tuple[slice, ...]
Array = NDArray[Any]
MAX_METADATA = 1 << 26  # bytes of one file of metadata: the same
SLAB = 1 << 19  # bytes copied at a time between a chunk's file and memory of another layout: they stay in the L2 cache
TURN = 64  # columns copied at a time where rows become columns: more than these touch more pages than the TLB knows
FILLS = {"complex64": ["NaN", "NaN"], "float64": "NaN", "int16": -1}  # of the tables above, as metadata state them


def fill_value(dtype: str) -> Any:
    kind = np.dtype(dtype).kind
    return complex(np.nan, np.nan) if kind == "c" else np.nan if kind == "f" else -1


def refuse_odd_file(path: str | os.PathLike[str], largest: int = MAX_METADATA) -> None:
    """Refuse what is not a file, or not of a size that can be: a pipe would hang its reader, a device never end."""
    status = os.stat(path)
    if not stat.S_ISREG(status.st_mode):
        raise InputError(f"{os.fspath(path)} is no regular file; put the file back, or write it again")
    if status.st_size > largest:
        raise InputError(f"{os.fspath(path)} has {status.st_size} bytes, which no such file has; write it again")


def check_out(out: Array, shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
    if out.shape != shape or not np.can_cast(dtype, out.dtype, "equiv"):
        raise ValueError(f"out is {out.dtype} of shape {out.shape}, but the region is {dtype} of shape {shape}")


@dataclass(frozen=True)
class ChunkFiles:
    """A variable laid out as `create` lays it out: chunk (i, j) is the file c/i/j, its samples in C order and no more.

    zarr reads and writes the same files, at a fraction of the speed: it opens the array anew for each region, and
    takes the samples through fresh memory. Here they go straight between file and array where a chunk is contiguous
    there, else through a slab that stays in the cache.

    Attributes
    ----------
    folder : str
        Of the variable.
    shape, chunks : tuple of int
        Of the array, and of one chunk; chunks at the far edges are as long as any, padded with the fill value.
    dtype : numpy dtype
        In the machine's byte order.
    """

    folder: str
    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    dtype: np.dtype[Any]

    @property
    def ndim(self) -> int:
        return len(self.shape)

    @property
    def row_bytes(self) -> int:
        """Of one row of a chunk: all that has the same first index."""
        return self.dtype.itemsize * prod(self.chunks[1:])

    def read(self, region: Region, out: Array | None = None) -> Array:
        """Read a region of step 1, into `out` if given.

        Raises
        ------
        OSError
            If a file cannot be read, or is not as long as a chunk.
        InputError
            If it is no file at all.
        """
        spans = [range(*part.indices(n)) for part, n in zip(region, self.shape, strict=True)]
        shape = tuple(len(span) for span in spans)
        values = np.empty(shape, self.dtype) if out is None else out
        check_out(values, shape, self.dtype)
        slab = self._slab()
        for file, inside, outside in self._parts(spans):
            try:
                refuse_odd_file(file, sys.maxsize)
                with open(file, "rb") as stream:
                    self._read_chunk(stream, inside, values[outside], slab)
            except FileNotFoundError:
                values[outside] = fill_value(self.dtype.name)
        return values

    def write(self, region: Region, values: Array) -> None:
        """Write a region of whole chunks; a chunk's file is the old one or the new one, never half of either.

        Raises
        ------
        OSError
            If a file cannot be written.
        """
        spans = [range(*part.indices(n)) for part, n in zip(region, self.shape, strict=True)]
        slab = self._slab()
        for file, _, outside in self._parts(spans):
            os.makedirs(os.path.dirname(file), exist_ok=True)
            with replacing_file(file) as part, open(part, "wb") as stream:
                if os.path.exists(file):
                    # When a file takes another's place, ext4 sends it to the disk at once, unless it has its room.
                    with suppress(OSError, AttributeError):
                        os.posix_fallocate(stream.fileno(), 0, self.row_bytes * self.chunks[0])
                self._write_chunk(stream, values[outside], slab)

    def link(self, region: Region, source: ChunkFiles, source_region: Region) -> None:
        """Let whole chunks be the very files of another array's chunks.

        Raises
        ------
        OSError
            If the file system does not do that, or the chunks do not fall together.
        """
        ours, theirs = self._whole(region), source._whole(source_region)
        if (self.chunks, self.dtype, *map(len, ours)) != (source.chunks, source.dtype, *map(len, theirs)):
            raise OSError("other chunks")
        for (file, _, _), (other, _, _) in zip(self._parts(ours), source._parts(theirs), strict=True):
            os.makedirs(os.path.dirname(file), exist_ok=True)
            with replacing_file(file) as part:
                os.link(other, part)

    def _whole(self, region: Region) -> list[range]:
        spans = [range(*part.indices(n)) for part, n in zip(region, self.shape, strict=True)]
        for span, n, chunk in zip(spans, self.shape, self.chunks, strict=True):
            if span.start % chunk or (span.stop % chunk and span.stop != n):
                raise OSError("not whole chunks")
        return spans

    def _parts(self, spans: Sequence[range]) -> Iterator[tuple[str, Region, Region]]:
        """File of every chunk that a region touches, what of the chunk is in the region, and where in the region."""
        if not all(spans):
            return
        cells: list[list[tuple[str, slice, slice]]] = []
        for span, chunk in zip(spans, self.chunks, strict=True):
            cells.append([])
            for i in range(span.start // chunk, (span.stop - 1) // chunk + 1):
                start, stop = max(span.start, i * chunk), min(span.stop, (i + 1) * chunk)
                inside = slice(start - i * chunk, stop - i * chunk)
                cells[-1].append((str(i), inside, slice(start - span.start, stop - span.start)))
        for cell in product(*cells):
            keys, inside_chunk, inside_region = zip(*cell, strict=True)
            yield os.path.join(self.folder, "c", *keys), inside_chunk, inside_region

    def _read_chunk(self, stream: BinaryIO, inside: Region, values: Array, slab: Array) -> None:
        length = os.fstat(stream.fileno()).st_size
        if length != self.row_bytes * self.chunks[0]:
            raise OSError(f"{length} bytes in a chunk of {self.row_bytes * self.chunks[0]}")
        stream.seek(self.row_bytes * inside[0].start)
        if values.flags.c_contiguous and values.shape[1:] == self.chunks[1:]:
            _read_into(stream, values)
            return
        for first in range(0, len(values), len(slab)):
            rows = values[first : first + len(slab)]
            _read_into(stream, slab[: len(rows)])
            _copy(slab[(slice(len(rows)), *inside[1:])], rows)

    def _write_chunk(self, stream: BinaryIO, values: Array, slab: Array) -> None:
        if values.flags.c_contiguous and values.shape == self.chunks and values.dtype == self.dtype:
            stream.write(values.data)
            return
        if values.shape != self.chunks:
            slab[...] = fill_value(self.dtype.name)
        for first in range(0, self.chunks[0], len(slab)):
            rows = values[first : first + len(slab)]
            _copy(rows, slab[tuple(slice(n) for n in rows.shape)])
            slab[len(rows) :] = fill_value(self.dtype.name)
            stream.write(slab[: self.chunks[0] - first].data)

    def _slab(self) -> Array:
        """Some rows of a chunk."""
        rows = min(max(SLAB // self.row_bytes, 1), self.chunks[0])
        return np.empty((rows, *self.chunks[1:]), self.dtype)


def chunk_files_of(path: Place, name: str) -> ChunkFiles | None:
    """The variable's chunk files; None where it is laid out in another way, missing or damaged: zarr knows which."""
    if not isinstance(path, LocalPlace):
        return None
    folder = os.path.join(path.path, name)
    metadata = os.path.join(folder, "zarr.json")
    try:
        refuse_odd_file(metadata)
        with open(metadata, "rb") as file:
            layout = _layout(file.read())
    except (OSError, ValueError):
        return None
    return None if layout is None else ChunkFiles(folder, *layout)


@lru_cache(maxsize=256)
def _layout(metadata: bytes) -> tuple[tuple[int, ...], tuple[int, ...], np.dtype[Any]] | None:
    """Shape, chunks and dtype of an array whose metadata say nothing that `create` does not; None for all others."""
    try:
        found = json.loads(metadata)
    except (ValueError, RecursionError):
        return None
    match found:
        case {
            "shape": [*shape],
            "data_type": str(dtype),
            "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [*chunks]}},
            **rest,
        } if len(shape) == len(chunks) > 0 and all(type(n) is int and n > 0 for n in (*shape, *chunks)):
            for key in ("attributes", "dimension_names"):
                rest.pop(key, None)
            plain = {
                "zarr_format": 3,
                "node_type": "array",
                "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
                "fill_value": FILLS.get(dtype),
                "codecs": [{"name": "bytes", "configuration": {"endian": sys.byteorder}}],
                "storage_transformers": [],
            }
            return (tuple(shape), tuple(chunks), np.dtype(dtype)) if dtype in FILLS and rest == plain else None
    return None


def _read_into(stream: BinaryIO, values: Array) -> None:
    if stream.readinto(values.data) != values.nbytes:  # type: ignore[attr-defined]
        raise OSError("a chunk that became shorter while it was read")


def _copy(source: Array, target: Array) -> None:
    turned = source.ndim == 2 and (source.strides[0] < source.strides[1]) != (target.strides[0] < target.strides[1])
    step = TURN if turned else max(source.shape[-1], 1)
    for first in range(0, source.shape[-1], step):
        target[..., first : first + step] = source[..., first : first + step]
