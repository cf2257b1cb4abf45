"""A store created whole: metadata, coordinates and small variables at once, samples to be written by region."""

from __future__ import annotations

import json
import os
import secrets
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from zarr.storage import MemoryStore

from blocksar.errors import InputError, ProcessingError
from blocksar.places import Location
from blocksar.places import place as place_of
from blocksar.places.local import LocalPlace, temporary_name
from blocksar.places.objects import ObjectPlace
from blocksar.places.place import Place
from blocksar.stores.arrays import metadata_file
from blocksar.stores.chunk_files import Array, fill_value
from blocksar.stores.faults import ENVIRONMENT
from blocksar.stores.records import nan_to_null, plain_value
from blocksar.stores.schema import Variable

RENAMES = 32  # attempts at replacing a store that others are replacing too
UNFINISHED = ".unfinished"  # object below a prefix while the store there is made: it names its maker


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
        What it holds; one of the tables of `schema`.
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
    text = {key: nan_to_null(plain_value(value, key)) for key, value in attrs.items()}
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
            fill_value=fill_value(variable.dtype),
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


@contextmanager
def _replacing(path: Path, *, overwrite: bool) -> Iterator[LocalPlace]:
    """A temporary name beside a folder, renamed to it when the block ends well, removed when it does not."""
    part, old = temporary_name(path, "part"), temporary_name(path, "old")
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
        foreign = not folder or (any(path.iterdir()) and not metadata_file(LocalPlace(path)))
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
    if UNFINISHED not in names and not metadata_file(place):
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
