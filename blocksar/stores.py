"""zarr and xarray: what every store holds, and how to create, read and write one region of it.

The tables below are the one statement of every store's schema; writing and checking both go by them. Metadata is
created once, before any task; after that each task writes whole chunks that nobody else writes, so there are no
locks. A chunk that was never written reads as NaN (-1 for integers), never as zero: "not there" is not "dark".

`phase_history.zarr` is a public contract, and other programs write it: reading it trusts nothing. Chunking,
compression, attribute types and extra variables are theirs to choose; what the contract fixes is checked, and every
disagreement is one `InputError`.

zarr reads and writes whatever it understands. Chunks laid out as `create` lays them out are plain files, which
`ChunkFiles` reads and writes itself, several times as fast.

A store lies in a folder or below a prefix of an object store: every path may be an `s3://` URL or a `Place`.
"""

from __future__ import annotations

import json
import os
import re
import secrets
import shutil
import stat
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
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
from zarr.storage import MemoryStore

from blocksar.parameters import (
    UNIFORM_TOLERANCE,
    Collection,
    ComplexArray,
    FloatArray,
    InputError,
    ProcessingError,
    check_axis,
)
from blocksar.places import LocalPlace, Location, ObjectPlace, Place, os_errors, replacing_file, temporary
from blocksar.places import place as place_of

if TYPE_CHECKING:
    import xarray as xr

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
MAX_METADATA = 1 << 26  # bytes of one file of metadata: the same
MAX_CHUNK = 1 << 34  # bytes of one chunk: the same
MAX_CHUNKS = 1 << 15  # of a variable that is read as a whole: more take minutes, or are nowhere but in the metadata
CODECS = {  # all that may decode a chunk: of others who knows what they do with it, such as unpickling
    *("adler32", "bitround", "blosc", "bytes", "bz2", "crc32", "crc32c", "delta", "fixedscaleoffset", "fletcher32"),
    *("gzip", "lz4", "lzma", "packbits", "sharding_indexed", "shuffle", "transpose", "vlen-bytes", "vlen-utf8"),
    *("zlib", "zstd"),
}
METADATA = ("zarr.json", ".zgroup", ".zarray")
GROUP_METADATA = (".zattrs", ".zgroup", ".zmetadata", "zarr.json")
CHUNK_NAME = re.compile(r"c|(c\.)?\d+(\.\d+)*")  # what a chunk's file, or a folder of them, is called
SLAB = 1 << 19  # bytes copied at a time between a chunk's file and memory of another layout: they stay in the L2 cache
TURN = 64  # columns copied at a time where rows become columns: more than these touch more pages than the TLB knows
FILLS = {"complex64": ["NaN", "NaN"], "float64": "NaN", "int16": -1}  # of the tables above, as metadata state them
UNFINISHED = ".unfinished"  # object below a prefix while the store there is made: it names its maker
ENVIRONMENT = "AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_REGION and AWS_ENDPOINT_URL"
OBJECTS_AT_ONCE = 16  # chunks in flight to or from an object store, by one call: what these cost is waiting
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
    path: Location,
    schema: Mapping[str, Variable],
    *,
    sizes: Mapping[str, int],
    coords: Mapping[str, Array],
    attrs: Mapping[str, Any],
    chunks: Mapping[str, int],
    variables: Mapping[str, Array] | None = None,
    overwrite: bool = False,
    fill: Callable[[Place], None] | None = None,
) -> None:
    """Create a store: metadata, coordinates and small variables now, large arrays empty, to be written by region.

    A half-made store is never taken for a finished one: a folder is written under a temporary name and renamed; below
    a prefix the group's metadata come last, without which there is no store, and what is overwritten goes first.
    Samples are not compressed (noise does not compress). `xarray.open_zarr` opens it.

    Parameters
    ----------
    path : path
        Directory to be; its parents are made. Or prefix to be.
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
    fill : callable (place)
        Writes samples, by region, to the place that it is given: the store is not there before they are.

    Raises
    ------
    InputError
        If `path` exists and `overwrite` is False, or what is there is no zarr store, or it cannot be written.
    ProcessingError
        If an object store does not answer, or somebody else has begun to write the same store.
    ValueError
        If names, dimensions or shapes do not fit the schema, or an attribute is not JSON.
    """
    given = {**coords, **(variables or {})}
    lengths = _lengths(schema, sizes, given)
    text = {key: _finite(_plain(value, key)) for key, value in attrs.items()}
    kept: dict[str, Any] = {}
    group = zarr.create_group(store=MemoryStore(kept), zarr_format=3, attributes=text)
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
    files = {key: data.to_bytes() for key, data in kept.items() if key != "zarr.json"}
    metadata = _consolidated(kept["zarr.json"].to_bytes(), {name: files[f"{name}/zarr.json"] for name in schema})
    place = place_of(path)
    if isinstance(place, ObjectPlace):
        _create_objects(place, files, metadata, fill, overwrite=overwrite)
        return
    assert isinstance(place, LocalPlace)
    with _replacing(place.path, overwrite=overwrite) as part:
        for key, data in {**files, "zarr.json": metadata}.items():
            _put_file(part / key, data)
        if fill is not None:
            fill(part)


def _consolidated(group: bytes, variables: Mapping[str, bytes]) -> bytes:
    """Copy the variables' metadata into the group's, as zarr's own consolidation does, which warns as it does so.

    Without the copy xarray.open_zarr(path) warns; nothing changes metadata after creation, so it cannot go stale.
    """
    metadata = json.loads(group)
    inline = {name: json.loads(text) for name, text in variables.items()}
    metadata["consolidated_metadata"] = {"kind": "inline", "must_understand": False, "metadata": inline}
    return json.dumps(metadata, indent=2).encode()


def _put_file(place: LocalPlace, data: bytes) -> None:
    os.makedirs(place.path.parent, exist_ok=True)
    place.path.write_bytes(data)


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
def _replacing(path: Path, *, overwrite: bool) -> Iterator[LocalPlace]:
    """A temporary name beside a folder, renamed to it when the block ends well, removed when it does not."""
    part, old = temporary(path, "part"), temporary(path, "old")
    try:
        _refuse_existing(path, overwrite=overwrite)
        path.parent.mkdir(parents=True, exist_ok=True)
        yield LocalPlace(Path(part))
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
        raise InputError(f"{path} exists; choose another name, or have it overwritten (--overwrite)")
    try:
        folder = not path.is_symlink() and path.is_dir()
        foreign = not folder or (any(path.iterdir()) and not _metadata_file(LocalPlace(path)))
    except FileNotFoundError:
        return  # another process is replacing it
    # What another process has just moved aside is no folder either.
    if foreign and os.path.lexists(path):
        raise InputError(
            f"{path} exists and is not a zarr store, so it is not overwritten; remove it, or choose another name"
        )


def _create_objects(
    place: ObjectPlace,
    files: Mapping[str, bytes],
    metadata: bytes,
    fill: Callable[[Place], None] | None,
    *,
    overwrite: bool,
) -> None:
    """As `create`, where nothing can be renamed: a store begins with a mark, and ends with the group's metadata.

    A maker who does not find his own mark at the end has lost the place to another.
    """
    mark, token = place / UNFINISHED, secrets.token_bytes(16)
    try:
        _refuse_objects(place, overwrite=overwrite)
        mark.write_bytes(token)
        try:
            _clear(place)
            for key, data in files.items():
                (place / key).write_bytes(data)
            if fill is not None:
                fill(place)
            if not _holds(mark, token):
                raise ProcessingError(f"{place} is being written by somebody else too; write each store once")
            (place / "zarr.json").write_bytes(metadata)
        except BaseException:
            with suppress(OSError):
                if _holds(mark, token):
                    _clear(place)
                    mark.remove()
            raise
        mark.remove()
    except (FileNotFoundError, PermissionError) as error:
        raise InputError(f"{place} cannot be written ({error.strerror}); check {ENVIRONMENT}") from error
    except OSError as error:
        raise ProcessingError(f"{place} cannot be written ({error.strerror or error})") from error


def _refuse_objects(place: ObjectPlace, *, overwrite: bool) -> None:
    names = place.names()
    if not names and not place.exists():
        return
    if not overwrite:
        found = "exists" if UNFINISHED not in names else "is being written, or was left unfinished"
        raise InputError(f"{place} {found}; choose another name, or have it overwritten (--overwrite)")
    if UNFINISHED not in names and not _metadata_file(place):
        raise InputError(
            f"{place} exists and is not a zarr store, so it is not overwritten; remove it, or choose another name"
        )


def _clear(place: ObjectPlace) -> None:
    """Remove what lies below but for the mark, the group's metadata first: the rest is no store without them."""
    for name in sorted(place.names(), key=lambda name: name != "zarr.json"):
        if name != UNFINISHED:
            (place / name).remove()


def _holds(mark: ObjectPlace, token: bytes) -> bool:
    with suppress(FileNotFoundError):
        return mark.read_bytes() == token
    return False


def _plain(value: Any, name: str) -> Any:
    """What JSON holds, of what people put into attributes: numpy numbers and real arrays, paths, tuples."""
    match value:
        case np.generic() | np.ndarray() if value.dtype.kind in "biufU":
            return _plain(value.tolist(), name)
        case None | bool() | int() | float() | str():
            return value
        case os.PathLike() | Place():
            return str(value)
        case Mapping():
            return {str(key): _plain(item, f"{name}.{key}") for key, item in value.items()}
        case list() | tuple():
            return [_plain(item, name) for item in value]
    raise ValueError(f"attribute {name} = {value!r} is a {type(value).__name__}, which JSON does not hold")


# One region at a time


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
    array = _chunk_files(place, name) or _open_array(place, name, mode="r+")
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
    array = _chunk_files(place, name) or _open_array(place, name)
    return _read(array, tuple(region), place, f"{name} in {place}", out)


def chunk_shape(path: Location, name: str) -> tuple[int, ...]:
    """Of one variable.

    Raises
    ------
    InputError
        If there is no such store or variable.
    """
    files = _chunk_files(place_of(path), name)
    return files.chunks if files is not None else tuple(_open_array(place_of(path), name).chunks)


def share_region(path: Location, name: str, region: Region, *, source: Location, source_region: Region) -> bool:
    """Let whole chunks of a variable be those of another store's variable of that name, without copying them.

    Files are hard-linked, which is safe as nobody writes into a chunk's file: a new one takes its place.

    Returns
    -------
    bool
        False where that cannot be done: chunks do not fall together, the file system knows no hard links, or it is
        an object store.
    """
    ours, theirs = _chunk_files(place_of(path), name), _chunk_files(place_of(source), name)
    if ours is None or theirs is None:
        return False
    try:
        ours.link(region, theirs, source_region)
    except OSError:
        return False
    return True


def _open_array(path: Place, name: str, mode: Any = "r") -> zarr.Array[Any]:
    """Open a variable by its own path: a tenth of the time of opening the group first."""
    place = path / name
    try:
        found = _metadata_file(place)
        missing = "" if found else f"it has no variable {name}" if path.exists() else "it is not there"
    except OSError as error:
        raise _unreachable(place, error, writing=mode != "r") from error
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
            raise _unreachable(place, error, writing=mode != "r") from error
        raise InputError(f"{place} has damaged metadata ({_cause(error)}); write it again") from error
    _refuse_codecs(array, str(place))
    return array


def _unreachable(place: Place, error: OSError, *, writing: bool = False) -> InputError | ProcessingError:
    """What a file system or an object store says when it does not do as it is told, in one sentence."""
    if writing:
        return ProcessingError(f"{place} cannot be written ({error.strerror or error})")
    remedy = "its permissions" if isinstance(place, LocalPlace) else ENVIRONMENT
    return InputError(f"{place} cannot be read ({error.strerror or error}); check {remedy}")


def _refuse_codecs(array: zarr.Array[Any], what: str) -> None:
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


def _read(
    array: ChunkFiles | zarr.Array[Any], region: Region, where: Place, what: str, out: Array | None = None
) -> Array:
    """Read a region; where that fails, find the first chunk at fault and name it."""
    if isinstance(array, ChunkFiles):
        if len(region) == array.ndim and all(part.step in (None, 1) for part in region):
            with suppress(OSError):
                return array.read(region, out)
        # Whatever it was, zarr makes sense of it, or says what is wrong.
        array = _open_array(where, os.path.basename(array.folder))
    try:
        with os_errors(where):
            values = np.asarray(array[region]) if isinstance(where, LocalPlace) else _fetch(array, region)
    except MemoryError:
        raise
    except Exception as error:
        if isinstance(error, OSError) and isinstance(where, ObjectPlace):
            raise _unreachable(where, error) from error
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


def _metadata_file(path: Place) -> str:
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
            _refuse_odd_file(os.path.join(path.path, name))
            found = found or name
    return found if found != ".zattrs" else ""


def _refuse_odd_file(path: str | os.PathLike[str], largest: int = MAX_METADATA) -> None:
    """Refuse what is not a file, or not of a size that can be: a pipe would hang its reader, a device never end."""
    status = os.stat(path)
    if not stat.S_ISREG(status.st_mode):
        raise InputError(f"{os.fspath(path)} is no regular file; put the file back, or write it again")
    if status.st_size > largest:
        raise InputError(f"{os.fspath(path)} has {status.st_size} bytes, which no such file has; write it again")


def _refuse_odd_chunks(folder: str | os.PathLike[str], depth: int) -> None:
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
                _refuse_odd_chunks(entry.path, depth - 1)
        else:
            odd = not entry.is_file() or (chunk and depth > 1)
        if odd:
            right = "file" if depth == 1 or not chunk else "folder"
            raise InputError(f"{entry.path} should be a {right} that can be read; put it back, or write it again")


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
        InputError
            If it is no file at all.
        """
        spans = [range(*part.indices(n)) for part, n in zip(region, self.shape, strict=True)]
        shape = tuple(len(span) for span in spans)
        values = np.empty(shape, self.dtype) if out is None else out
        _check_out(values, shape, self.dtype)
        slab = self._slab()
        for file, inside, outside in self._parts(spans):
            try:
                _refuse_odd_file(file, sys.maxsize)
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


def _chunk_files(path: Place, name: str) -> ChunkFiles | None:
    """The variable's chunk files; None where it is laid out in another way, missing or damaged: zarr knows which."""
    if not isinstance(path, LocalPlace):
        return None
    folder = os.path.join(path.path, name)
    metadata = os.path.join(folder, "zarr.json")
    try:
        _refuse_odd_file(metadata)
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
    path : Place
        A place as its user named it is also what `str` gives.
    collection : Collection
        Of a raw echo: range_frequency is `raw.range_frequency`, what recovery compresses it to.
    raw : RawEcho or None
        None where the samples are `signal`, over range frequency; else they are `echo`, over fast time.
    attrs : dict
        Attributes of the store that are not in collection or raw: title, history, targets, scene, georeference ...
    """

    path: Place
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
        samples = _read(array, (pulses, columns), self.path, f"{self.variable} in {self.path}")
        with np.errstate(over="ignore"):
            return samples.astype(np.complex64, copy=False)

    def fingerprint(self) -> str:
        """Hash that tells one input from another without reading its samples.

        Of metadata, axes, track and beam all the bytes; of the samples the chunks' names, sizes and times, or what an
        object store calls a version of each.

        Raises
        ------
        InputError
            If a file cannot be read.
        """
        digest = xxhash.xxh3_128()
        try:
            for name, chunk, file in self._files():
                digest.update(os.fsencode(f"{name}\n"))
                if chunk:
                    digest.update(f"{chunk}\n".encode())
                    continue
                if isinstance(file, LocalPlace):
                    _refuse_odd_file(file.path, sys.maxsize)
                digest.update(file.read_bytes())
        except OSError as error:
            raise _unreachable(self.path, error) from error
        return digest.hexdigest()

    def _files(self) -> Iterator[tuple[str, str, Place]]:
        """Files of the group and of every variable: name, size and version if it is a chunk of samples, and where."""
        there = self.path.names()
        yield from ((name, "", self.path / name) for name in GROUP_METADATA if name in there)
        for variable in sorted(PHASE_HISTORY if self.raw is None else RAW_ECHO):
            found = sorted((self.path / variable).files(), key=lambda file: file[0].split("/"))
            for name, size, version in found:
                chunk = variable == self.variable and name not in ("zarr.json", ".zarray", ".zattrs")
                yield f"{variable}/{name}", f"{size} {version}" if chunk else "", self.path / variable / name


def create_phase_history(
    path: Location,
    collection: Collection,
    *,
    raw: RawEcho | None = None,
    attrs: Mapping[str, Any] | None = None,
    overwrite: bool = False,
    fill: Callable[[Place], None] | None = None,
) -> None:
    """Create `phase_history.zarr` with all but the samples: `fill` writes those by region, in chunks of `TILE`.

    Without it they may be written later, and until then a store is found whose pulses are all missing.

    Parameters
    ----------
    path : path
    collection : Collection
    raw : RawEcho, optional
        Given for a raw echo: the samples are then `echo` over its fast_time.
    attrs : dict
        Beyond what `collection` and `raw` tell: history, targets, scene, georeference ...
    overwrite, fill
        As for `create`.

    Raises
    ------
    InputError, ProcessingError
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
        fill=fill,
    )


def write_collection(path: Location, collection: Collection, attrs: Mapping[str, Any] | None = None) -> None:
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


def open_phase_history(path: Location) -> PhaseHistory:
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
            there = ", ".join(name for name in place.names() if _metadata_file(place / name)) or "nothing"
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


def read_collection(path: Location) -> tuple[Collection, dict[str, Any]]:
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


def open_dataset(path: Location) -> xr.Dataset:
    """Open any store lazily, as `xarray.open_zarr` does.

    Raises
    ------
    InputError
        If there is no such store, or it is damaged.
    """
    import xarray as xr  # half a second, and only here

    with _reading(path) as place:
        group = _open_group(place)
        for child in place.names() if isinstance(place, LocalPlace) else []:
            _metadata_file(place / child)  # a pipe would hang zarr
        with os_errors(place):
            for name, array in group.arrays():
                _refuse_codecs(array, f"{place}/{name}")
            zarr_path = place.zarr_path()
            dataset = xr.open_zarr(zarr_path.store, group=zarr_path.path or None, consolidated=False, chunks=None)
        dataset.encoding["source"] = str(place)  # as xarray itself says of a path
        return dataset


@contextmanager
def _reading(path: Location) -> Iterator[Place]:
    """Whatever the bytes on disk do to the libraries below, one InputError that names the store comes out."""
    place = place_of(path)
    try:
        yield place
    except InputError as error:
        text = str(error)
        raise InputError(text if str(place) in text else f"{place}: {text}") from error.__cause__
    except Exception as error:
        if isinstance(error, OSError) and isinstance(place, ObjectPlace):
            raise _unreachable(place, error) from error
        if isinstance(error, PermissionError):
            what = error.filename or place
            raise InputError(f"{what} may not be read by this user; change its permissions") from error
        raise InputError(f"{place} is damaged, or no store of this kind ({_cause(error)}); write it again") from error


def _open_group(place: Place) -> zarr.Group:
    if isinstance(place, LocalPlace) and place.exists():
        if not place.path.is_dir():
            raise InputError(
                f"{place} is not a directory; give the path of a zarr store, which is one (blocksar ingest makes it of "
                "a CPHD or Gotcha file)"
            )
        os.listdir(place)  # PermissionError says more than the missing metadata would
    metadata = _metadata_file(place)
    if not metadata:
        if not place.exists():
            raise InputError(f"{place} does not exist; check the path")
        if isinstance(place, ObjectPlace) and (place / UNFINISHED).exists():
            raise InputError(f"{place} is being written, or was left unfinished; wait, or write it again")
        raise InputError(f"{place} is not a zarr store: it has no zarr.json; check the path, or write it again")
    try:
        kind = json.loads((place / metadata).read_bytes())
        if metadata == ".zarray" or kind.get("node_type", "group") != "group":
            raise InputError(f"{place} is a single zarr array, not a group; give the path of the store that holds it")
        # Consolidated metadata are a copy that may be stale.
        with os_errors(place):
            return zarr.open_group(store=place.zarr_path(), mode="r", use_consolidated=False)
    except (InputError, PermissionError):
        raise
    except Exception as error:
        if isinstance(error, OSError) and isinstance(place, ObjectPlace):
            raise
        raise InputError(f"{place / metadata} is damaged ({_cause(error)}); write the store again") from error


def _attrs(group: zarr.Group) -> dict[str, Any]:
    # xarray lists names of variables here; they mean nothing in another store.
    return {name: value for name, value in group.attrs.asdict().items() if name != "coordinates"}


def _read_collection(place: Place, attrs: Mapping[str, Any], range_frequency: FloatArray | None) -> Collection:
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


def _read_raw(place: Place, attrs: Mapping[str, Any]) -> RawEcho:
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


def _checked(place: Place, name: str) -> zarr.Array[Any]:
    """Open a variable of the contract, and check what does not need its values."""
    variable = {**PHASE_HISTORY, **RAW_ECHO}[name]
    if not _metadata_file(place / name):
        raise InputError(f"variable {name} ({', '.join(variable.dims)}) is missing; write it, in {variable.units}")
    array = _open_array(place, name)
    if isinstance(place, LocalPlace):
        _refuse_odd_chunks(place / name, len(array.metadata.encode_chunk_key((0,) * array.ndim).split("/")))
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
    chunks = array.shards or array.chunks
    if not 0 < prod(chunks) * array.dtype.itemsize <= MAX_CHUNK:
        raise InputError(f"{name} claims chunks of {chunks}; its metadata are damaged, write it again")
    count = prod(-(-n // chunk) for n, chunk in zip(array.shape, chunks, strict=True))
    if count > MAX_CHUNKS and name not in ("signal", "echo"):
        raise InputError(f"{name} is in {count} chunks, but is read as a whole; write it in at most {MAX_CHUNKS}")
    attrs = array.attrs.asdict()
    units = attrs.get("units")
    if units is not None and variable.units in UNITS and str(units).strip().lower() not in UNITS[variable.units]:
        raise InputError(f"{name} is in {units!r}, but must be in {variable.units}; convert it")
    packed = [key for key, idle in (("scale_factor", 1), ("add_offset", 0)) if attrs.get(key, idle) != idle]
    if packed:
        raise InputError(f"{name} is packed with {packed[0]} = {attrs[packed[0]]!r}; write its values as they are")
    return array


def _real(place: Place, name: str) -> FloatArray:
    array = _checked(place, name)
    values = _read(array, (slice(None),) * array.ndim, place, name)
    return np.asarray(values, dtype=np.float64)


# Small files


def write_json(path: Location, obj: Any) -> None:
    """Write JSON so that whoever reads it finds the old file or the new one, never half of either.

    Numpy numbers and arrays become numbers and lists; NaN and infinities become null: JSON has none.

    Raises
    ------
    ProcessingError
        If it cannot be written: no room, no permission.
    ValueError
        If `obj` holds what JSON does not.
    """
    place = place_of(path)
    text = json.dumps(_finite(_plain(obj, place.name)), indent=1, allow_nan=False)
    try:
        place.write_bytes(f"{text}\n".encode())
    except OSError as error:
        raise ProcessingError(f"{place} cannot be written ({error.strerror or error})") from error


def _finite(value: Any) -> Any:
    match value:
        case float():
            return value if isfinite(value) else None
        case dict():
            return {key: _finite(item) for key, item in value.items()}
        case list():
            return [_finite(item) for item in value]
    return value


def read_json(path: Location) -> Any:
    """Read JSON.

    Raises
    ------
    InputError
        If the file is missing, may not be read or is not JSON.
    """
    place = place_of(path)
    try:
        if isinstance(place, LocalPlace):
            _refuse_odd_file(place.path)
        return json.loads(place.read_bytes())
    except FileNotFoundError:
        raise InputError(f"{path} does not exist; check the path") from None
    except OSError as error:
        remedy = "the path" if isinstance(place, LocalPlace) else ENVIRONMENT
        raise InputError(f"{path} cannot be read ({error.strerror or error}); check {remedy}") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is damaged ({_cause(error)}); remove it, and make it again") from error


def checksum(array: Array) -> str:
    """xxh3, 128 bits in hexadecimal, of the array's bytes in C order."""
    values = np.ascontiguousarray(array)
    return xxhash.xxh3_128(values.reshape(-1).view(np.uint8).data).hexdigest()


def checksum_bytes(data: bytes) -> str:
    """xxh3, 128 bits in hexadecimal."""
    return xxhash.xxh3_128(data).hexdigest()


def json_checksum(obj: Any) -> str:
    """Of what `write_json` writes and `read_json` reads, whichever way its keys stand.

    Raises
    ------
    ValueError
        If `obj` holds what JSON does not.
    """
    return checksum_bytes(json.dumps(_finite(_plain(obj, "")), sort_keys=True, allow_nan=False).encode())
