"""Chunks as plain files of a local file system: reading, writing and linking them without zarr.

Their layout is the one that `create` writes: zarr's metadata, version 3, written and recognised without zarr.

Loading zarr takes 0.1 to 0.3 s, and creating a store through it 4 to 9 ms instead of 1 ms: every run would wait.
"""

from __future__ import annotations

import json
import os
import stat
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import dropwhile, product
from math import prod
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple

import numpy as np
import xxhash
from numpy.typing import NDArray

from blocksar.errors import InputError
from blocksar.places import direct
from blocksar.places.local import LocalPlace, file_version, replacing_file
from blocksar.places.place import Place

if TYPE_CHECKING:
    from numcodecs.vlen import VLenUTF8  # type: ignore[import-untyped]
    from numcodecs.zstd import Zstd  # type: ignore[import-untyped]

METADATA = (".zarray", ".zattrs", ".zgroup", ".zmetadata", "zarr.json")  # all names of files of metadata
NODE_METADATA = ("zarr.json", ".zgroup", ".zarray")  # one of which each group and array has
# Compression of images: noise does not compress and passes at the speed of memory; uncovered parts take no space. The
# checksum lets every reader notice an altered chunk. Chunks are written at ZSTD_LEVEL. Readers do not need the level,
# but GDAL (3.12) refuses arrays that state a negative one, so the metadata state the level of a program that appends.
ZSTD_LEVEL = -5
COMPRESSION: dict[str, Any] = {"name": "zstd", "configuration": {"level": 1, "checksum": True}}
HIGHEST_LEVEL = 22  # of zstd
# Fill values by data type, as in the metadata; numpy's names are the same, except that of text.
FILLS = {"complex64": ["NaN", "NaN"], "float64": "NaN", "float32": "NaN", "int16": -1, "uint8": 255, "string": ""}


class VariableLayout(NamedTuple):
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


def array_metadata(layout: VariableLayout) -> dict[str, Any]:
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
def layout_of(content: bytes) -> VariableLayout | None:
    """Return the layout that a variable's metadata file states, if `create` writes such, at any compression level."""
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
            layout = VariableLayout(tuple(shape), tuple(chunks), dtype, codec, tuple(dims), attrs)
            return layout if metadata == array_metadata(layout) else None
    return None


def _is_zstd(codec: Any) -> bool:
    """Tell whether a codec's metadata describe zstd, in a form that zarr accepts."""
    match codec:
        case {"name": "zstd", "configuration": {"level": int(level), "checksum": bool()}}:
            return level <= HIGHEST_LEVEL and len(codec) == len(codec["configuration"]) == 2
    return False


def group_attrs(metadata: Any) -> dict[str, Any] | None:
    """Return the attributes in a store's metadata; None if it is not as `create` writes it, or zarr's consolidation."""
    match metadata:
        # A copy of the variables' metadata may be out of date, and is ignored.
        case {"attributes": dict(attrs), "zarr_format": 3, "node_type": "group", **rest}:
            return attrs if rest.keys() <= {"consolidated_metadata"} else None
    return None


Region = tuple[slice, ...]
Array = NDArray[Any]
MAX_METADATA = 1 << 24  # bytes of a metadata file: a larger one is damaged, and could exhaust the memory
MAX_FRAME = 1 << 12  # bytes of a compressed chunk beyond those of its samples, and one in 64 of these
SLAB = 1 << 19  # bytes copied at a time between a chunk's file and memory of another layout: they stay in the L2 cache
TRANSPOSED_COLUMNS = 64  # columns copied at a time in a transposition: more would touch more pages than the TLB holds
CLOCK, COARSE_CLOCK = 100_000_000, 2_500_000_000  # ns: steps of files' times, at most; and of those of whole seconds
FRAME_MAGIC, FRAME_BLOCK = b"\x28\xb5\x2f\xfd", 1 << 17  # of zstd; bytes of a block, at most
DENSE_SAMPLE, DENSE_PARTS = 1 << 10, 4  # numbers of each of the parts of a chunk that tell whether it compresses


def refuse_odd_file(path: str | os.PathLike[str], largest: int = MAX_METADATA) -> os.stat_result:
    """Return a file's status.

    Raises
    ------
    InputError
        If it is not a regular file or too large: reading a pipe or a device could never end.
    """
    status = os.stat(path)
    if not stat.S_ISREG(status.st_mode):
        raise InputError(f"{os.fspath(path)} is not a regular file; restore the file, or write it again")
    if status.st_size > largest:
        raise InputError(f"{os.fspath(path)} has {status.st_size} bytes, too many for such a file; write it again")
    return status


def check_out(out: Array, shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
    """Raise a ValueError if a region of that shape and dtype cannot be read into `out`."""
    if out.shape != shape or not np.can_cast(dtype, out.dtype, "equiv"):
        raise ValueError(f"out is {out.dtype} of shape {out.shape}, but the region is {dtype} of shape {shape}")


@dataclass(frozen=True)
class ChunkFiles:
    """A variable in the layout of `create`: chunk (i, j) is the file c/i/j, its samples in C order, maybe compressed.

    zarr reads and writes the same files much more slowly: it opens the array for each region, and copies the samples
    through newly allocated memory. Here they go directly between file and array if the chunk is contiguous in the
    array, otherwise through a slab that stays in the cache.

    Attributes
    ----------
    folder : str
        The variable's folder.
    shape, chunks : tuple of int
        Shape of the array, and of a chunk; chunks at the far edges have full size, padded with the fill value.
    dtype : numpy dtype
        In the machine's byte order.
    compressed : bool
        As COMPRESSION says; reading takes any level.
    dims : tuple of str
        Names of the dimensions.
    attrs : dict
        Attributes; not to be changed.
    """

    folder: str
    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    dtype: np.dtype[Any]
    compressed: bool = False
    dims: tuple[str, ...] = ()
    attrs: Mapping[str, Any] = field(default_factory=dict, compare=False)

    @property
    def ndim(self) -> int:
        return len(self.shape)

    @property
    def row_bytes(self) -> int:
        """Bytes of one row of a chunk: the samples with the same first index."""
        return self.dtype.itemsize * prod(self.chunks[1:])

    @property
    def _encoded(self) -> bool:
        """Whether a file holds something else than the samples as they are in memory."""
        return self.compressed or self.dtype.kind == "T"

    def read(
        self,
        region: Region,
        out: Array | None = None,
        *,
        seen: Callable[[str, str], None] | None = None,
        cached: bool = True,
    ) -> Array:
        """Read a region of step 1, into `out` if given; past the page cache if not `cached`.

        `seen` is told the name of each chunk, relative to the folder, and the version that was read; see
        `Place.version`.

        Raises
        ------
        OSError
            If a file cannot be read, or does not have the length of a chunk.
        InputError
            If a chunk is not a regular file.
        """
        spans = [range(*part.indices(n)) for part, n in zip(region, self.shape, strict=True)]
        shape = tuple(len(span) for span in spans)
        values = np.empty(shape, self.dtype) if out is None else out
        check_out(values, shape, self.dtype)
        slab = self._slab()
        for file, inside, outside in self._parts(spans):
            try:
                refuse_odd_file(file, sys.maxsize)
                with open(file, "rb") if cached else direct.reading(file) as stream:
                    self._read_chunk(stream, inside, values[outside], slab)
                    version = file_version(os.fstat(stream.fileno()))
            except FileNotFoundError:
                values[outside], version = fill_value(self.dtype), ""
            if seen is not None:
                seen(os.path.relpath(file, self.folder), version)
        return values

    def write(self, region: Region, values: Array, *, cached: bool = False) -> None:
        """Write a region of whole chunks, each atomically; through the page cache if `cached`.

        Raises
        ------
        OSError
            If a file cannot be written.
        """
        spans = [range(*part.indices(n)) for part, n in zip(region, self.shape, strict=True)]
        slab = self._slab()
        for file, _, outside in self._parts(spans):
            os.makedirs(os.path.dirname(file), exist_ok=True)
            with replacing_file(file) as part, direct.writing(part, cached=cached) as stream:
                self._write_chunk(stream, values[outside], slab)

    def link(self, region: Region, source: ChunkFiles, source_region: Region) -> None:
        """Make whole chunks hard links to another array's chunks.

        Raises
        ------
        OSError
            If the file system has no hard links, or the chunks of the two arrays do not coincide.
        """
        spans, source_spans = self._whole(region), source._whole(source_region)
        layouts = [(_flat(files.chunks), files.dtype, files.compressed) for files in (self, source)]
        if layouts[0] != layouts[1] or _flat([*map(len, spans)]) != _flat([*map(len, source_spans)]):
            raise OSError("the chunks differ")
        for (file, _, _), (other, _, _) in zip(self._parts(spans), source._parts(source_spans), strict=True):
            os.makedirs(os.path.dirname(file), exist_ok=True)
            with replacing_file(file) as part:
                os.link(other, part)

    def _whole(self, region: Region) -> list[range]:
        """Indices of a region by dimension; raises an OSError unless it consists of whole chunks."""
        spans = [range(*part.indices(n)) for part, n in zip(region, self.shape, strict=True)]
        for span, n, chunk in zip(spans, self.shape, self.chunks, strict=True):
            if span.start % chunk or (span.stop % chunk and span.stop != n):
                raise OSError("not whole chunks")
        return spans

    def _parts(self, spans: Sequence[range]) -> Iterator[tuple[str, Region, Region]]:
        """Iterate over a region's chunks: file, the part of the chunk in the region, and its position in the region."""
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

    def _read_chunk(self, stream: BinaryIO | direct.DirectReader, inside: Region, values: Array, slab: Array) -> None:
        length = os.fstat(stream.fileno()).st_size
        if self._encoded:
            decode = self._decode_text if self.dtype.kind == "T" else self._decode
            copy_values(decode(stream, length)[inside], values)
            return
        if length != self.row_bytes * self.chunks[0]:
            raise OSError(f"a chunk has {length} bytes instead of {self.row_bytes * self.chunks[0]}")
        stream.seek(self.row_bytes * inside[0].start)
        if values.flags.c_contiguous and values.shape[1:] == self.chunks[1:]:
            _read_into(stream, values)
            return
        for first in range(0, len(values), len(slab)):
            rows = values[first : first + len(slab)]
            _read_into(stream, slab[: len(rows)])
            copy_values(slab[(slice(len(rows)), *inside[1:])], rows)

    def _decode(self, stream: BinaryIO | direct.DirectReader, length: int) -> Array:
        """Read a compressed chunk as a whole.

        Raises
        ------
        OSError
            If it is damaged.
        InputError
            If it declares more samples than a chunk has.
        """
        size = self.row_bytes * self.chunks[0]
        if length > size + size // 64 + MAX_FRAME:
            raise OSError(f"a compressed chunk of {size} bytes has {length}")
        data = np.empty(length, np.uint8)
        _read_into(stream, data)
        if (declared := _declared_size(data[:18].tobytes())) > size:
            # Not left to zarr, which would allocate so much.
            raise InputError(f"{self.folder} has a chunk of {declared} bytes instead of {size}; write it again")
        try:
            decoded = zstd().decode(data)
        except (RuntimeError, ValueError) as error:
            raise OSError(str(error)) from error
        if len(decoded) != size:
            raise OSError(f"a chunk has {len(decoded)} bytes instead of {size}")
        return np.frombuffer(decoded, self.dtype).reshape(self.chunks)

    def _decode_text(self, stream: BinaryIO | direct.DirectReader, length: int) -> Array:
        """Read a chunk of text as a whole: the number of texts, and each after its length in bytes.

        Raises
        ------
        OSError
            If it is damaged.
        """
        number = prod(self.chunks)
        if not 4 * (1 + number) <= length <= MAX_METADATA:
            raise OSError(f"a chunk of {number} texts has {length} bytes")
        data = np.empty(length, np.uint8)
        _read_into(stream, data)
        if int.from_bytes(data[:4].tobytes(), "little") != number:
            raise OSError(f"a chunk has another number of texts than {number}")
        try:
            return np.asarray(_vlen_utf8().decode(data), self.dtype).reshape(self.chunks)
        except ValueError as error:
            raise OSError(str(error)) from error

    def _write_chunk(self, stream: direct.Writer, values: Array, slab: Array) -> None:
        whole = values.flags.c_contiguous and values.shape == self.chunks and values.dtype == self.dtype
        if self._encoded:
            chunk = values
            if not whole:
                chunk = np.full(self.chunks, fill_value(self.dtype), self.dtype)
                chunk[tuple(slice(n) for n in values.shape)] = values
            for part in encode(chunk, compressed=self.compressed):
                stream.write(part)
            return
        if whole:
            stream.write(values.data)
            return
        if values.shape != self.chunks:
            slab[...] = fill_value(self.dtype)
        for first in range(0, self.chunks[0], len(slab)):
            rows = values[first : first + len(slab)]
            copy_values(rows, slab[tuple(slice(n) for n in rows.shape)])
            slab[len(rows) :] = fill_value(self.dtype)
            stream.write(slab[: self.chunks[0] - first].data)

    def _slab(self) -> Array:
        """Allocate a buffer of SLAB bytes, in whole rows of a chunk."""
        rows = min(max(SLAB // self.row_bytes, 1), self.chunks[0])
        return np.empty((rows, *self.chunks[1:]), self.dtype)


def chunk_files_of(path: Place, name: str) -> ChunkFiles | None:
    """Return a variable's chunk files; None if its layout is another, or it is missing or damaged: zarr tells which."""
    if not isinstance(path, LocalPlace):
        return None
    folder = os.path.join(path.path, name)
    metadata = os.path.join(folder, "zarr.json")
    try:
        status = refuse_odd_file(metadata)
        layout = (_layout_in if _is_settled(status) else _layout_in.__wrapped__)(metadata, file_version(status))
    except (OSError, ValueError):
        return None
    if layout is None:
        return None
    compressed = layout.compression is not None
    return ChunkFiles(folder, layout.shape, layout.chunks, layout.dtype, compressed, layout.dims, layout.attrs)


@lru_cache(maxsize=256)
def _layout_in(metadata: str, version: str) -> VariableLayout | None:
    """Read the layout from the metadata file of a variable; `version` is the file's, for the cache."""
    with open(metadata, "rb") as file:
        return layout_of(file.read())


def _is_settled(status: os.stat_result) -> bool:
    """Tell whether a file is old enough that a further change would alter its modification time."""
    step = CLOCK if status.st_mtime_ns % 1_000_000_000 else COARSE_CLOCK
    return time.time_ns() - status.st_mtime_ns > step


def chunk_name(cell: Sequence[int]) -> str:
    """Name of a chunk's file relative to its variable, from its number along each dimension."""
    return "/".join(("c", *map(str, cell)))


def encode(chunk: Array, *, compressed: bool) -> Iterable[bytes | memoryview]:
    """Return the content of a chunk's file, in parts, from the samples (contiguous)."""
    if chunk.dtype.kind == "T":
        return [_vlen_utf8().encode(chunk)]
    if not compressed:
        return [chunk.data]
    return _frame(chunk) if _is_dense(chunk.reshape(-1)) else [zstd().encode(chunk)]


@lru_cache(maxsize=1)
def _vlen_utf8() -> VLenUTF8:
    from numcodecs.vlen import VLenUTF8  # as `zstd`

    return VLenUTF8()


@lru_cache(maxsize=1)
def zstd() -> Zstd:
    """The codec of compressed chunks; the first call imports it."""
    from numcodecs.zstd import Zstd  # zarr's own

    return Zstd(level=ZSTD_LEVEL, checksum=COMPRESSION["configuration"]["checksum"])


def _is_dense(chunk: Array) -> bool:
    """Tell whether zstd would not shrink a chunk: float32 or complex64, finite, with incompressible parts.

    Noise, and heights and angles, smooth numbers whose last bits are noise: it would take as long as to compute them.
    """
    if chunk.dtype not in (np.float32, np.complex64) or chunk.size < 2 * DENSE_PARTS * DENSE_SAMPLE:
        return False
    parts = chunk[: chunk.size // DENSE_PARTS * DENSE_PARTS].reshape(DENSE_PARTS, -1)[:, -DENSE_SAMPLE:].copy()
    # View real and imaginary parts as real numbers: numpy takes twice as long for complex ones.
    return len(zstd().encode(parts)) > parts.nbytes and bool(np.isfinite(chunk.view(np.float32)).all())


def _frame(chunk: Array) -> Iterator[bytes | memoryview]:
    """A zstd frame (RFC 8878, 3.1.1) of raw blocks, with the checksum of the content."""
    data = np.ascontiguousarray(chunk).reshape(-1).view(np.uint8).data
    # Magic number; one segment with a checksum, whose size has four bytes; that size.
    yield FRAME_MAGIC + b"\xa4" + len(data).to_bytes(4, "little")
    for first in range(0, len(data), FRAME_BLOCK):
        block = data[first : first + FRAME_BLOCK]
        last = first + FRAME_BLOCK >= len(data)
        yield (len(block) << 3 | last).to_bytes(3, "little")
        yield block
    yield (xxhash.xxh64(data).intdigest() & 0xFFFFFFFF).to_bytes(4, "little")


def _declared_size(header: bytes) -> int:
    """Bytes that a zstd frame says it holds (RFC 8878, 3.1.1.1); 0 if it does not say, is too short, or is none."""
    if len(header) < 18 or not header.startswith(FRAME_MAGIC):
        return 0
    single, width = header[4] >> 5 & 1, (0, 2, 4, 8)[header[4] >> 6]
    start = 6 - single + (0, 1, 2, 4)[header[4] & 3]
    width = width or single
    return int.from_bytes(header[start : start + width], "little") + 256 * (width == 2)


def _flat(lengths: Sequence[int]) -> tuple[int, ...]:
    """Drop leading ones of a shape: a chunk of one channel has the same bytes as one without channels."""
    return tuple(dropwhile(lambda n: n == 1, lengths))


def _read_into(stream: BinaryIO | direct.DirectReader, values: Array) -> None:
    if stream.readinto(values.data) != values.nbytes:  # type: ignore[union-attr]
        raise OSError("a chunk became shorter while it was read")


def copy_values(source: Array, target: Array) -> None:
    """Copy an array by strips of columns, which is fast if rows become columns."""
    transposed = source.ndim == 2 and (source.strides[0] < source.strides[1]) != (target.strides[0] < target.strides[1])
    step = TRANSPOSED_COLUMNS if transposed else max(source.shape[-1], 1)
    for first in range(0, source.shape[-1], step):
        target[..., first : first + step] = source[..., first : first + step]
