"""zarr and xarray: what every store holds, and how to create, read and write one region of it.

The tables below are the one statement of every store's schema; writing and checking both go by them. Metadata is
created once, before any task; after that each task writes whole chunks that nobody else writes, so there are no
locks. A chunk that was never written reads as NaN (-1 for integers), never as zero: "not there" is not "dark".

`phase_history.zarr` is a public contract, and other programs write it: reading it trusts nothing. Chunking,
compression, attribute types and extra variables are theirs to choose; what the contract fixes is checked, and every
disagreement is one `InputError`.

zarr reads and writes whatever it understands. Chunks laid out as `create` lays them out are plain files, which
`ChunkFiles` reads and writes itself, several times as fast.
"""

from __future__ import annotations

import json
import os
import secrets
import shutil
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import lru_cache
from itertools import product
from math import isfinite, prod
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
import xxhash
import zarr
from numpy.typing import NDArray

from blocksar.parameters import (
    UNIFORM_TOLERANCE,
    Collection,
    ComplexArray,
    FloatArray,
    InputError,
    ProcessingError,
    check_axis,
)

if TYPE_CHECKING:
    import xarray as xr

StorePath = str | os.PathLike[str]
Region = tuple[slice, ...]
Array = NDArray[Any]


@dataclass(frozen=True)
class Variable:
    """One variable of a store: its dimensions, numpy dtype, units and long name."""

    dims: tuple[str, ...]
    dtype: str
    units: str
    long_name: str


TIME = Variable(("pulse",), "float64", "s", "slow time")
FAST_TIME = Variable(("fast_time",), "float64", "s", "fast time, two-way delay")
RANGE_FREQUENCY = Variable(("range_frequency",), "float64", "Hz", "baseband range frequency")
DOPPLER = Variable(("doppler",), "float64", "Hz", "Doppler frequency")
X = Variable(("x",), "float64", "m", "scene-frame x")
Y = Variable(("y",), "float64", "m", "scene-frame y")

TRACK_AND_BEAM = {
    "reference_range": Variable(("pulse",), "float64", "m", "range whose phase was removed"),
    "antenna_position": Variable(
        ("pulse", "axis"), "float64", "m", "antenna phase centre in the scene frame (x, y, z), z up"
    ),
    "beam_azimuth": Variable(("pulse",), "float64", "rad", "beam-centre yaw; NaN where the beam is not steered"),
}
COLLECTION = {"time": TIME, "range_frequency": RANGE_FREQUENCY, **TRACK_AND_BEAM}
PHASE_HISTORY = {
    "signal": Variable(("pulse", "range_frequency"), "complex64", "1", "range-frequency signal; NaN where missing"),
    **COLLECTION,
}
RAW_ECHO = {
    "echo": Variable(("pulse", "fast_time"), "complex64", "1", "raw chirped echo; NaN where missing"),
    "time": TIME,
    "fast_time": FAST_TIME,
    **TRACK_AND_BEAM,
}
SPECTRUM = {
    "spectrum": Variable(("doppler", "range_frequency"), "complex64", "1", "recovered Doppler spectrum"),
    "lit": Variable(("pulse",), "float64", "1", "fraction of the pulse's samples that are valid"),
    "doppler": DOPPLER,
    "range_frequency": RANGE_FREQUENCY,
}
PATCH = {
    "image": Variable(("y", "x"), "complex64", "1", "focused block on the ground; NaN where not covered"),
    "x": X,
    "y": Y,
}
IMAGE = {
    "image": Variable(("y", "x"), "complex64", "1", "calibrated complex image; NaN where not covered"),
    "block": Variable(("y", "x"), "int16", "1", "angular block the pixel comes from; -1 where not covered"),
    "x": X,
    "y": Y,
}

TILE = (512, 1024)  # pulses by columns of a phase history: 4 MiB, whole in either direction of reading
CONVENTIONS = "CF-1.11"
RENAMES = 32  # attempts at replacing a store that others are replacing too
MAX_AXIS = 1 << 26  # samples of one axis: metadata that claim more are damaged, and would eat the memory
SLAB = 1 << 19  # bytes copied at a time between a chunk's file and memory of another layout: they stay in the L2 cache
TURN = 64  # columns copied at a time where rows become columns: more than these touch more pages than the TLB knows
FILLS = {"complex64": ["NaN", "NaN"], "float64": "NaN", "int16": -1}  # of the tables above, as metadata state them
FILES_AT_ONCE = 2  # chunks in flight in one process: zarr's own 10 lose up to 1.7x to moving buffers about
COLLECTION_ATTRS = ("carrier_frequency", "beam_width", "ground_height")
RAW_ATTRS = ("chirp_rate", "pulse_width")
UNITS = {  # spellings that mean the contract's unit
    "s": ("s", "sec", "second", "seconds"),
    "Hz": ("hz", "hertz", "s-1", "1/s"),
    "m": ("m", "metre", "metres", "meter", "meters"),
    "rad": ("rad", "radian", "radians"),
}

zarr.config.set({"async.concurrency": FILES_AT_ONCE})


# Creating


def create(
    path: StorePath,
    schema: Mapping[str, Variable],
    *,
    sizes: Mapping[str, int],
    coords: Mapping[str, Array],
    attrs: Mapping[str, Any],
    chunks: Mapping[str, int],
    variables: Mapping[str, Array] | None = None,
    overwrite: bool = False,
) -> None:
    """Create a store: metadata, coordinates and small variables now, large arrays empty, to be written by region.

    It is written under a temporary name and renamed, so a half-made store is never taken for a finished one.
    Samples are not compressed (noise does not compress). `xarray.open_zarr` opens it.

    Parameters
    ----------
    path : path
        Directory to be; its parents are made.
    schema : dict of Variable
        What it holds; one of the tables of this module.
    sizes : dict of int
        Length of every dimension that no coordinate or variable tells.
    coords, variables : dict of array
        Written at once, in one chunk each, in the schema's dtype.
    attrs : dict
        Attributes of the store: anything JSON holds, numpy scalars and arrays of real numbers; NaN becomes null.
    chunks : dict of int
        Chunk length by dimension, of the arrays that are created empty; the whole dimension where absent.
    overwrite : bool
        Replace a store that is there.

    Raises
    ------
    InputError
        If `path` exists and `overwrite` is False, or what is there is no zarr store, or it cannot be written.
    ValueError
        If names, dimensions or shapes do not fit the schema, or an attribute is not JSON.
    """
    given = {**coords, **(variables or {})}
    lengths = _lengths(schema, sizes, given)
    text = {key: _finite(_plain(value, key)) for key, value in attrs.items()}
    with replacing(Path(path), overwrite=overwrite) as part:
        group = zarr.create_group(store=str(part), zarr_format=3, attributes=text)
        for name, variable in schema.items():
            shape = tuple(lengths[dim] for dim in variable.dims)
            whole = tuple(max(n, 1) for n in shape)
            tile = tuple(max(min(chunks.get(dim, n), n), 1) for dim, n in zip(variable.dims, shape, strict=True))
            array = group.create_array(
                name,
                shape=shape,
                chunks=whole if name in given else tile,
                dtype=variable.dtype,
                fill_value=_fill(variable.dtype),
                compressors=None,
                filters=None,
                dimension_names=variable.dims,
                attributes=_variable_attrs(name, variable, schema, coords),
                # Comparing every chunk with the fill value costs more than writing it, and "chunk exists" then
                # means "chunk was written".
                config={"write_empty_chunks": True},
            )
            if name in given:
                array[...] = np.asarray(given[name], dtype=variable.dtype)
        _consolidate(part, schema)


def _consolidate(path: Path, names: Iterable[str]) -> None:
    """Copy the variables' metadata into the group's, as zarr's own consolidation does, which warns as it does so.

    Without the copy xarray.open_zarr(path) warns; nothing changes metadata after creation, so it cannot go stale.
    """
    metadata = json.loads((path / "zarr.json").read_bytes())
    variables = {name: json.loads((path / name / "zarr.json").read_bytes()) for name in names}
    metadata["consolidated_metadata"] = {"kind": "inline", "must_understand": False, "metadata": variables}
    (path / "zarr.json").write_text(json.dumps(metadata, indent=2), encoding="utf-8")


def _lengths(schema: Mapping[str, Variable], sizes: Mapping[str, int], given: Mapping[str, Array]) -> dict[str, int]:
    """Length of every dimension, told by sizes and by the arrays given, which must agree."""
    lengths = dict(sizes)
    for name, values in given.items():
        if name not in schema:
            raise ValueError(f"{name} is not in the schema, which has {', '.join(schema)}")
        dims, shape = schema[name].dims, np.shape(values)
        if len(dims) != len(shape):
            raise ValueError(f"{name} has shape {shape}, but its dimensions are {dims}")
        for dim, n in zip(dims, shape, strict=True):
            if lengths.setdefault(dim, n) != n:
                raise ValueError(f"{name} has {n} values along {dim}, but {dim} has length {lengths[dim]}")
    for name, variable in schema.items():
        missing = [dim for dim in variable.dims if dim not in lengths]
        if missing:
            raise ValueError(f"{name} needs the length of {', '.join(missing)}; give it in sizes")
    return lengths


def _variable_attrs(
    name: str, variable: Variable, schema: Mapping[str, Variable], coords: Mapping[str, Array]
) -> dict[str, Any]:
    attrs = {"units": variable.units, "long_name": variable.long_name}
    # xarray takes a variable named as its dimension for a coordinate; others (time over pulse) it must be told.
    beside = [c for c in coords if schema[c].dims != (c,) and set(schema[c].dims) <= set(variable.dims)]
    if beside and name not in coords:
        attrs["coordinates"] = " ".join(beside)
    return attrs


def _fill(dtype: str) -> Any:
    kind = np.dtype(dtype).kind
    return complex(np.nan, np.nan) if kind == "c" else np.nan if kind == "f" else -1


@contextmanager
def replacing(path: Path, *, overwrite: bool) -> Iterator[Path]:
    """A temporary name beside `path`, renamed to it when the block ends well, removed when it does not."""
    path = Path(os.path.abspath(path))
    token = secrets.token_hex(4)
    part, old = (path.with_name(f".{path.name}.{token}.{suffix}") for suffix in ("part", "old"))
    try:
        _refuse_existing(path, overwrite=overwrite)
        path.parent.mkdir(parents=True, exist_ok=True)
        yield part
        for attempt in range(RENAMES):
            if overwrite:
                shutil.rmtree(old, ignore_errors=True)
                with suppress(FileNotFoundError):
                    os.rename(path, old)
            try:
                os.rename(part, path)
                break
            except OSError:
                # Another process created it in the meantime: whoever overwrites tries again.
                _refuse_existing(path, overwrite=overwrite)
                if attempt == RENAMES - 1 or not os.path.lexists(part):
                    raise
    except OSError as error:
        raise InputError(
            f"{path} cannot be written ({error.strerror or error}); choose another place, or make room or permission"
        ) from error
    finally:
        shutil.rmtree(part, ignore_errors=True)
        if os.path.lexists(old):
            if not os.path.lexists(path):
                os.rename(old, path)
            shutil.rmtree(old, ignore_errors=True)


def _refuse_existing(path: Path, *, overwrite: bool) -> None:
    if not os.path.lexists(path):
        return
    if not overwrite:
        raise InputError(f"{path} exists; choose another name, or ask for it to be overwritten")
    try:
        foreign = path.is_symlink() or not path.is_dir() or (any(path.iterdir()) and not _metadata_file(path))
    except FileNotFoundError:
        return  # another process is replacing it
    # What another process has just moved aside is no folder either.
    if foreign and os.path.lexists(path):
        raise InputError(
            f"{path} exists and is not a zarr store, so it is not overwritten; remove it, or choose another name"
        )


def _plain(value: Any, name: str) -> Any:
    """What JSON holds, of what people put into attributes: numpy numbers and real arrays, paths, tuples."""
    match value:
        case np.generic() | np.ndarray() if value.dtype.kind in "biufU":
            return _plain(value.tolist(), name)
        case None | bool() | int() | float() | str():
            return value
        case os.PathLike():
            return os.fspath(value)
        case Mapping():
            return {str(key): _plain(item, f"{name}.{key}") for key, item in value.items()}
        case list() | tuple():
            return [_plain(item, name) for item in value]
    raise ValueError(f"attribute {name} = {value!r} is a {type(value).__name__}, which JSON does not hold")


# One region at a time


def write_region(path: StorePath, name: str, region: Sequence[slice], values: Array) -> None:
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
    array = _chunk_files(path, name) or _open_array(path, name, mode="r+")
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
        else:
            array[whole] = values
    except OSError as error:
        raise ProcessingError(f"{name} in {os.fspath(path)} cannot be written ({error.strerror or error})") from error


def read_region(path: StorePath, name: str, region: Sequence[slice], out: Array | None = None) -> Array:
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
    array = _chunk_files(path, name) or _open_array(path, name)
    return _read(array, tuple(region), f"{name} in {os.fspath(path)}", out)


def share_region(path: StorePath, name: str, region: Region, *, source: StorePath, source_region: Region) -> bool:
    """Let whole chunks of a variable be those of another store's variable of that name, without copying them.

    Files are hard-linked, which is safe as nobody writes into a chunk's file: a new one takes its place.

    Returns
    -------
    bool
        False where that cannot be done: chunks do not fall together, or the file system knows no hard links.
    """
    ours, theirs = _chunk_files(path, name), _chunk_files(source, name)
    if ours is None or theirs is None:
        return False
    try:
        ours.link(region, theirs, source_region)
    except OSError:
        return False
    return True


def _open_array(path: StorePath, name: str, mode: Any = "r") -> zarr.Array[Any]:
    """Open a variable by its own path: a tenth of the time of opening the group first."""
    place = os.path.join(os.path.abspath(path), name)
    try:
        found = _metadata_file(place)
    except OSError as error:
        raise InputError(f"{place} cannot be read ({error.strerror}); check its permissions") from error
    if not found:
        missing = "it is not there" if not os.path.lexists(os.path.abspath(path)) else f"it has no variable {name}"
        raise InputError(f"{name} cannot be read from {os.fspath(path)}: {missing}; check the path, or write it again")
    try:
        array = zarr.open_array(store=place, mode=mode, config={"write_empty_chunks": True})
        return array
    except Exception as error:
        raise InputError(f"{place} has damaged metadata ({_cause(error)}); write it again") from error


def _read(array: ChunkFiles | zarr.Array[Any], region: Region, what: str, out: Array | None = None) -> Array:
    """Read a region; where that fails, find the first chunk at fault and name it."""
    if isinstance(array, ChunkFiles):
        if len(region) == array.ndim and all(part.step in (None, 1) for part in region):
            with suppress(OSError):
                return array.read(region, out)
        # Whatever it was, zarr makes sense of it, or says what is wrong.
        array = _open_array(*os.path.split(array.folder))
    try:
        values = np.asarray(array[region])
    except MemoryError:
        raise
    except Exception as error:
        cause, place = error, ""
        for cell in _cells(array, region):
            try:
                array[cell]
            except Exception as first:
                dims = _dims(array) or tuple(f"dimension {i}" for i in range(array.ndim))
                spans = (f"{dim} {part.start}..{part.stop - 1}" for dim, part in zip(dims, cell, strict=True))
                cause, place = first, ", ".join(spans)
                break
        raise InputError(
            f"{what} cannot be read{f' at {place}' if place else ''} ({_cause(cause)}); "
            "that chunk is damaged or out of reach: write it again"
        ) from error
    if out is None:
        return values
    _check_out(out, values.shape, values.dtype)
    out[...] = values
    return out


def _check_out(out: Array, shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
    if out.shape != shape or not np.can_cast(dtype, out.dtype, "equiv"):
        raise ValueError(f"out is {out.dtype} of shape {out.shape}, but the region is {dtype} of shape {shape}")


def _cells(array: zarr.Array[Any], region: Region) -> Iterator[Region]:
    """The chunks that a region touches."""
    spans = []
    for part, n, chunk in zip(region, array.shape, array.chunks, strict=True):
        start, stop, _ = part.indices(n)
        spans.append([slice(i, min(i + chunk, n)) for i in range(start - start % chunk, stop, chunk)])
    yield from product(*spans)


def _metadata_file(path: StorePath) -> str:
    """Name of the zarr metadata in a directory, version 3 or 2; empty if there is none."""
    for name in ("zarr.json", ".zgroup", ".zarray"):
        # Not os.path.isfile: to that, a folder one may not enter is an empty one.
        with suppress(FileNotFoundError, NotADirectoryError):
            os.stat(os.path.join(path, name))
            return name
    return ""


def _dims(array: zarr.Array[Any]) -> tuple[str | None, ...] | None:
    """Dimension names: in the metadata since version 3, an attribute of xarray's before."""
    dims: Any = getattr(array.metadata, "dimension_names", None) or array.attrs.get("_ARRAY_DIMENSIONS")
    return None if dims is None else tuple(dims)


def _cause(error: BaseException) -> str:
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text[:200]}" if text else type(error).__name__


# Chunks as plain files: of all that touches samples, only this takes a store for a folder of a local file system


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
        """
        spans = [range(*part.indices(n)) for part, n in zip(region, self.shape, strict=True)]
        shape = tuple(len(span) for span in spans)
        values = np.empty(shape, self.dtype) if out is None else out
        _check_out(values, shape, self.dtype)
        slab = self._slab()
        for file, inside, outside in self._parts(spans):
            try:
                with open(file, "rb") as stream:
                    self._read_chunk(stream, inside, values[outside], slab)
            except FileNotFoundError:
                values[outside] = _fill(self.dtype.name)
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
            with _replacing_file(file) as part, open(part, "wb") as stream:
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
            with _replacing_file(file) as part:
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
            slab[...] = _fill(self.dtype.name)
        for first in range(0, self.chunks[0], len(slab)):
            rows = values[first : first + len(slab)]
            _copy(rows, slab[tuple(slice(n) for n in rows.shape)])
            slab[len(rows) :] = _fill(self.dtype.name)
            stream.write(slab[: self.chunks[0] - first].data)

    def _slab(self) -> Array:
        """Some rows of a chunk."""
        rows = min(max(SLAB // self.row_bytes, 1), self.chunks[0])
        return np.empty((rows, *self.chunks[1:]), self.dtype)


def _chunk_files(path: StorePath, name: str) -> ChunkFiles | None:
    """The variable's chunk files; None where it is laid out in another way, missing or damaged: zarr knows which."""
    folder = os.path.join(os.path.abspath(path), name)
    try:
        with open(os.path.join(folder, "zarr.json"), "rb") as file:
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


@contextmanager
def _replacing_file(path: StorePath) -> Iterator[str]:
    """A temporary name beside `path`, renamed to it when the block ends well, removed when it does not."""
    folder, name = os.path.split(path)
    part = os.path.join(folder, f".{name}.{secrets.token_hex(4)}.part")
    try:
        yield part
        os.replace(part, path)
    finally:
        with suppress(OSError):
            os.unlink(part)


# Phase histories


@dataclass(frozen=True, kw_only=True, eq=False)
class RawEcho:
    """What a raw echo has beyond a `Collection`. The pulse is rect(tau / T) exp(j pi K tau^2), about the delay 2 R / c.

    Attributes
    ----------
    fast_time : (n_fast_time,) float
        Two-way delay, s; uniform, ascending.
    chirp_rate : float
        K, Hz/s; negative for a down-chirp.
    pulse_width : float
        T, s.
    sampling_rate : float
        Hz.

    Raises
    ------
    InputError
        If fast_time is not uniform, is shorter than the pulse, or sampled more slowly than the chirp is wide.
    """

    fast_time: FloatArray
    chirp_rate: float
    pulse_width: float
    sampling_rate: float

    def __post_init__(self) -> None:
        time = np.array(self.fast_time, dtype=np.float64)
        time.flags.writeable = False
        object.__setattr__(self, "fast_time", time)
        check_axis(time, "fast_time", "s")
        if not (isfinite(self.chirp_rate) and self.chirp_rate):
            raise InputError(f"chirp_rate must be a finite number of Hz/s other than 0, got {self.chirp_rate!r}")
        span = float(time[-1] - time[0])
        if not 0 < self.pulse_width <= span:
            raise InputError(
                f"pulse_width is {self.pulse_width:.6g} s, but must be above 0 and within the {span:.6g} s of fast_time"
            )
        # Not half a step off over the whole axis, else the frequencies below are not those of the samples.
        if not abs(self.sampling_rate * span - (time.size - 1)) < 0.5:
            raise InputError(
                f"sampling_rate is {self.sampling_rate:.9g} Hz, but fast_time is sampled at "
                f"{(time.size - 1) / span:.9g} Hz; make them agree"
            )
        if self.bandwidth > self.sampling_rate * (1 + UNIFORM_TOLERANCE):
            raise InputError(
                f"chirp_rate times pulse_width is {self.bandwidth:.6g} Hz, but fast_time is sampled at only "
                f"{self.sampling_rate:.6g} Hz; sample faster, or correct chirp_rate or pulse_width"
            )

    @property
    def bandwidth(self) -> float:
        """Of the chirp, Hz."""
        return abs(self.chirp_rate) * self.pulse_width

    @property
    def range_frequency(self) -> FloatArray:
        """Grid of the transform over fast_time, centred at 0 and cut to the chirp's band, Hz."""
        n = self.fast_time.size
        grid = (np.arange(n) - n // 2) * (self.sampling_rate / n)
        # The band's edge may itself be a grid point: rounding must not decide whether it is in.
        return grid[np.abs(grid) <= self.bandwidth / 2 * (1 + 1e-9)]


@dataclass(frozen=True, kw_only=True, eq=False)
class PhaseHistory:
    """An open phase history: its collection, and its samples on demand. Holds no file open, and pickles small.

    Attributes
    ----------
    path : Path
    collection : Collection
        Of a raw echo: range_frequency is `raw.range_frequency`, what recovery compresses it to.
    raw : RawEcho or None
        None where the samples are `signal`, over range frequency; else they are `echo`, over fast time.
    attrs : dict
        Attributes of the store that are not in collection or raw: title, history, targets, scene, georeference ...
    """

    path: Path
    collection: Collection
    raw: RawEcho | None = None
    attrs: dict[str, Any] = field(default_factory=dict)

    @property
    def variable(self) -> str:
        """Name of the samples: `signal` or `echo`."""
        return "signal" if self.raw is None else "echo"

    @property
    def shape(self) -> tuple[int, int]:
        """Pulses, and columns: range frequencies, or fast-time samples of a raw echo."""
        columns = self.collection.range_frequency if self.raw is None else self.raw.fast_time
        return self.collection.n_pulse, int(columns.size)

    @property
    def chunks(self) -> tuple[int, int]:
        """Pulses and columns of one chunk."""
        pulse, column = _open_array(self.path, self.variable).chunks
        return int(pulse), int(column)

    def read(self, pulses: slice, columns: slice) -> ComplexArray:
        """Samples of some pulses and columns.

        Returns
        -------
        (n_pulse, n_column) complex64
            NaN rows where pulses are missing.

        Raises
        ------
        InputError
            If a chunk is damaged (it names the chunk), or the store has changed since it was opened.
        """
        array = _chunk_files(self.path, self.variable) or _open_array(self.path, self.variable)
        if array.shape != self.shape:
            raise InputError(
                f"{self.variable} in {self.path} now has shape {array.shape}, not {self.shape}; it changed since it "
                "was opened: start again"
            )
        samples = _read(array, (pulses, columns), f"{self.variable} in {self.path}")
        with np.errstate(over="ignore"):
            return samples.astype(np.complex64, copy=False)

    def fingerprint(self) -> str:
        """Hash that tells one input from another without reading its samples.

        Of metadata, axes, track and beam all the bytes; of the samples the chunks' names, sizes and times.

        Raises
        ------
        InputError
            If a file cannot be read.
        """
        digest = xxhash.xxh3_128()
        schema = PHASE_HISTORY if self.raw is None else RAW_ECHO
        try:
            for name in (".", *sorted(schema)):
                for file in _files(self.path / name, deep=name != "."):
                    digest.update(f"{file.relative_to(self.path)}\n".encode())
                    if name == self.variable and file.name not in ("zarr.json", ".zarray", ".zattrs"):
                        status = file.stat()
                        digest.update(f"{status.st_size} {status.st_mtime_ns}\n".encode())
                    else:
                        digest.update(file.read_bytes())
        except OSError as error:
            raise InputError(f"{self.path} cannot be read ({_cause(error)}); check its permissions") from error
        return digest.hexdigest()


def _files(folder: Path, *, deep: bool) -> list[Path]:
    found = []
    for parent, folders, names in os.walk(folder):
        found += [Path(parent, name) for name in names]
        if not deep:
            folders.clear()
    return sorted(found)


def create_phase_history(
    path: StorePath,
    collection: Collection,
    *,
    raw: RawEcho | None = None,
    attrs: Mapping[str, Any] | None = None,
    overwrite: bool = False,
) -> None:
    """Create `phase_history.zarr` with all but the samples; write those by region, in chunks of `TILE`.

    Parameters
    ----------
    path : path
    collection : Collection
    raw : RawEcho, optional
        Given for a raw echo: the samples are then `echo` over its fast_time.
    attrs : dict
        Beyond what `collection` and `raw` tell: history, targets, scene, georeference ...

    Raises
    ------
    InputError
        As for `create`.
    """
    column, axis = ("range_frequency", collection.range_frequency) if raw is None else ("fast_time", raw.fast_time)
    create(
        path,
        PHASE_HISTORY if raw is None else RAW_ECHO,
        sizes={},
        coords={"time": collection.time, column: axis},
        variables={name: getattr(collection, name) for name in TRACK_AND_BEAM},
        attrs=_collection_attrs(collection, raw, attrs),
        chunks={"pulse": TILE[0], column: TILE[1]},
        overwrite=overwrite,
    )


def write_collection(path: StorePath, collection: Collection, attrs: Mapping[str, Any] | None = None) -> None:
    """Write a phase history less the samples; a store that is there is replaced.

    Raises
    ------
    InputError
        As for `create`.
    """
    create(
        path,
        COLLECTION,
        sizes={},
        coords={"time": collection.time, "range_frequency": collection.range_frequency},
        variables={name: getattr(collection, name) for name in TRACK_AND_BEAM},
        attrs=_collection_attrs(collection, None, attrs),
        chunks={},
        overwrite=True,
    )


def _collection_attrs(collection: Collection, raw: RawEcho | None, attrs: Mapping[str, Any] | None) -> dict[str, Any]:
    own: dict[str, Any] = {
        "carrier_frequency": collection.carrier,
        "beam_width": collection.beam_width,
        "ground_height": collection.ground_height,
    }
    if raw is not None:
        own |= {"chirp_rate": raw.chirp_rate, "pulse_width": raw.pulse_width}
    text = {
        "Conventions": CONVENTIONS,
        "title": collection.title,
        "history": history_line("created by blocksar"),
        **(attrs or {}),
    }
    if collection.title:
        text["title"] = collection.title
    return {**text, **{name: value for name, value in own.items() if value is not None}}


def history_line(what: str, earlier: Any = None) -> str:
    """The history attribute: what was done now, above what was done before."""
    line = f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ} {what}"
    return f"{line}\n{earlier}" if earlier else line


def open_phase_history(path: StorePath) -> PhaseHistory:
    """Open a phase history, whoever wrote it, and check all of it but the samples against the contract.

    Raises
    ------
    InputError
        If there is no such store, it is damaged, or it departs from the contract: one sentence that says where.
    """
    with _reading(path) as place:
        group = _open_group(place)
        names = [name for name in ("signal", "echo") if _metadata_file(place / name)]
        if len(names) != 1:
            there = ", ".join(sorted(p.name for p in place.iterdir() if _metadata_file(p))) or "nothing"
            raise InputError(
                f"it holds {'both' if names else 'neither'} signal {'and' if names else 'nor'} echo (it holds "
                f"{there}); a phase history has the one or the other"
            )
        attrs = _attrs(group)
        raw = _read_raw(place, attrs) if names == ["echo"] else None
        collection = _read_collection(place, attrs, None if raw is None else raw.range_frequency)
        column = "range_frequency" if raw is None else "fast_time"
        columns = collection.n_range_frequency if raw is None else raw.fast_time.size
        samples = _checked(place, names[0])
        if samples.shape != (collection.n_pulse, columns):
            raise InputError(
                f"{names[0]} has shape {samples.shape}, but time and {column} have {collection.n_pulse} and {columns} "
                "values; make them agree"
            )
        own = (*COLLECTION_ATTRS, *(RAW_ATTRS if raw is not None else ()))
        rest = {name: value for name, value in attrs.items() if name not in own}
        return PhaseHistory(path=place, collection=collection, raw=raw, attrs=rest)


def read_collection(path: StorePath) -> tuple[Collection, dict[str, Any]]:
    """Read what `write_collection` wrote: the collection, and the attributes beyond it.

    Raises
    ------
    InputError
        As for `open_phase_history`.
    """
    with _reading(path) as place:
        attrs = _attrs(_open_group(place))
        collection = _read_collection(place, attrs, None)
        return collection, {name: value for name, value in attrs.items() if name not in COLLECTION_ATTRS}


def open_dataset(path: StorePath) -> xr.Dataset:
    """Open any store lazily, as `xarray.open_zarr` does.

    Raises
    ------
    InputError
        If there is no such store, or it is damaged.
    """
    import xarray as xr  # half a second, and only here

    with _reading(path) as place:
        _open_group(place)
        return xr.open_zarr(str(place), consolidated=False, chunks=None)


@contextmanager
def _reading(path: StorePath) -> Iterator[Path]:
    """Whatever the bytes on disk do to the libraries below, one InputError that names the store comes out."""
    place = Path(os.path.abspath(path))
    try:
        yield place
    except InputError as error:
        text = str(error)
        raise InputError(text if str(place) in text else f"{place}: {text}") from error.__cause__
    except PermissionError as error:
        raise InputError(f"{error.filename or place} may not be read by this user; change its permissions") from error
    except Exception as error:
        raise InputError(f"{place} is damaged, or no store of this kind ({_cause(error)}); write it again") from error


def _open_group(place: Path) -> zarr.Group:
    if not os.path.lexists(place):
        raise InputError(f"{place} does not exist; check the path")
    if not place.is_dir():
        raise InputError(f"{place} is not a directory; give the path of a zarr store, which is one")
    os.listdir(place)  # PermissionError says more than the missing metadata would
    metadata = _metadata_file(place)
    if not metadata:
        raise InputError(f"{place} is not a zarr store: it has no zarr.json; check the path, or write it again")
    try:
        kind = json.loads((place / metadata).read_bytes())
        if metadata == ".zarray" or kind.get("node_type", "group") != "group":
            raise InputError(f"{place} is a single zarr array, not a group; give the path of the store that holds it")
        # Consolidated metadata are a copy that may be stale.
        return zarr.open_group(store=str(place), mode="r", use_consolidated=False)
    except (InputError, PermissionError):
        raise
    except Exception as error:
        raise InputError(f"{place / metadata} is damaged ({_cause(error)}); write the store again") from error


def _attrs(group: zarr.Group) -> dict[str, Any]:
    # xarray lists names of variables here; they mean nothing in another store.
    return {name: value for name, value in group.attrs.asdict().items() if name != "coordinates"}


def _read_collection(place: Path, attrs: Mapping[str, Any], range_frequency: FloatArray | None) -> Collection:
    time = _real(place, "time")
    if not _metadata_file(place / "beam_azimuth"):
        beam_azimuth = np.full(time.shape, np.nan)
    else:
        beam_azimuth = _real(place, "beam_azimuth")
    beam_width = _number(attrs, "beam_width", "rad", None)
    if beam_width is not None and np.isnan(beam_width) and np.isnan(beam_azimuth).all():
        beam_width = None
    carrier = _number(attrs, "carrier_frequency", "Hz")
    ground_height = _number(attrs, "ground_height", "m", 0.0)
    return Collection(
        carrier=carrier,
        time=time,
        range_frequency=_real(place, "range_frequency") if range_frequency is None else range_frequency,
        reference_range=_real(place, "reference_range"),
        antenna_position=_real(place, "antenna_position"),
        beam_azimuth=beam_azimuth,
        beam_width=beam_width,
        ground_height=ground_height,
        title=str(attrs.get("title") or ""),
    )


def _read_raw(place: Path, attrs: Mapping[str, Any]) -> RawEcho:
    fast_time = _real(place, "fast_time")
    check_axis(fast_time, "fast_time", "s")
    return RawEcho(
        fast_time=fast_time,
        chirp_rate=_number(attrs, "chirp_rate", "Hz/s"),
        pulse_width=_number(attrs, "pulse_width", "s"),
        sampling_rate=float((fast_time.size - 1) / (fast_time[-1] - fast_time[0])),
    )


def _number(attrs: Mapping[str, Any], name: str, unit: str, default: Any = ...) -> Any:
    """A number among the attributes; without a default it must be there."""
    value = attrs.get(name)
    if value is None:
        if default is not ...:
            return default
        raise InputError(f"attribute {name} is missing; add it, in {unit}")
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"attribute {name} is {value!r}; it must be a number, in {unit}")
    try:
        return float(value)
    except OverflowError:
        raise InputError(f"attribute {name} is a whole number of hundreds of digits; correct it, in {unit}") from None


def _checked(place: Path, name: str) -> zarr.Array[Any]:
    """Open a variable of the contract, and check what does not need its values."""
    variable = {**PHASE_HISTORY, **RAW_ECHO}[name]
    if not _metadata_file(place / name):
        raise InputError(f"variable {name} ({', '.join(variable.dims)}) is missing; write it, in {variable.units}")
    array = _open_array(place, name)
    found = _dims(array)
    if found != variable.dims:
        have = "none" if found is None else f"({', '.join(map(str, found))})"
        remedy = "transpose it" if found and sorted(map(str, found)) == sorted(variable.dims) else "name them so"
        raise InputError(f"{name} has dimensions {have}, but must have ({', '.join(variable.dims)}); {remedy}")
    kinds = "c" if variable.dtype == "complex64" else "fiu"
    if array.dtype.kind not in kinds:
        raise InputError(f"{name} is {array.dtype}, but must be {variable.dtype}; write it as that")
    if max(array.shape) > MAX_AXIS:
        raise InputError(f"{name} claims the shape {array.shape}, beyond {MAX_AXIS} an axis; its metadata are damaged")
    attrs = array.attrs.asdict()
    units = attrs.get("units")
    if units is not None and variable.units in UNITS and str(units).strip().lower() not in UNITS[variable.units]:
        raise InputError(f"{name} is in {units!r}, but must be in {variable.units}; convert it")
    packed = [key for key, idle in (("scale_factor", 1), ("add_offset", 0)) if attrs.get(key, idle) != idle]
    if packed:
        raise InputError(f"{name} is packed with {packed[0]} = {attrs[packed[0]]!r}; write its values as they are")
    return array


def _real(place: Path, name: str) -> FloatArray:
    array = _checked(place, name)
    values = _read(array, (slice(None),) * array.ndim, name)
    return np.asarray(values, dtype=np.float64)


# Small files


def write_json(path: StorePath, obj: Any) -> None:
    """Write JSON so that whoever reads it finds the old file or the new one, never half of either.

    Numpy numbers and arrays become numbers and lists; NaN and infinities become null: JSON has none.

    Raises
    ------
    ProcessingError
        If it cannot be written: no room, no permission.
    ValueError
        If `obj` holds what JSON does not.
    """
    path = Path(os.path.abspath(path))
    text = json.dumps(_finite(_plain(obj, path.name)), indent=1, allow_nan=False)
    try:
        with _replacing_file(path) as part, open(part, "w", encoding="utf-8") as file:
            file.write(text + "\n")
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise ProcessingError(f"{path} cannot be written ({error.strerror or error})") from error


def _finite(value: Any) -> Any:
    match value:
        case float():
            return value if isfinite(value) else None
        case dict():
            return {key: _finite(item) for key, item in value.items()}
        case list():
            return [_finite(item) for item in value]
    return value


def read_json(path: StorePath) -> Any:
    """Read JSON.

    Raises
    ------
    InputError
        If the file is missing, may not be read or is not JSON.
    """
    try:
        return json.loads(Path(path).read_bytes())
    except FileNotFoundError:
        raise InputError(f"{os.fspath(path)} does not exist; check the path") from None
    except OSError as error:
        raise InputError(f"{os.fspath(path)} cannot be read ({error.strerror or error}); check the path") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{os.fspath(path)} is damaged ({_cause(error)}); remove it, and make it again") from error


def checksum(array: Array) -> str:
    """xxh3, 128 bits in hexadecimal, of the array's bytes in C order."""
    values = np.ascontiguousarray(array)
    return xxhash.xxh3_128(values.reshape(-1).view(np.uint8).data).hexdigest()
