"""Creation of stores: metadata, coordinates and small variables at once, samples later by region."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from blocksar.chunks import TILE, stored_bytes
from blocksar.collection.collection import Collection
from blocksar.collection.raw_echo import ATTRIBUTE as RECORDED
from blocksar.collection.raw_echo import RawEcho
from blocksar.errors import InputError, ProcessingError, in_the_way, is_final, is_full, no_room, unwritable
from blocksar.places import Location
from blocksar.places import place as place_of
from blocksar.places.local import LocalPlace, held_part, sweep_beside, temporary_name
from blocksar.places.objects import ObjectPlace
from blocksar.places.place import REMEDY, Held, Place, check_room
from blocksar.stores.channels import check_channels, with_channels
from blocksar.stores.chunk_files import (
    COMPRESSION,
    Array,
    VariableLayout,
    array_metadata,
    chunk_name,
    encode,
    group_metadata,
    metadata_bytes,
)
from blocksar.stores.contract import (
    COLLECTION,
    COLLECTION_ATTRS,
    CONVENTIONS,
    PHASE_HISTORY,
    RAW_ECHO,
    Variable,
    stated,
)
from blocksar.stores.pieces import LEDGER, is_begun
from blocksar.stores.records import ENVIRONMENT, nan_to_null, plain_value
from blocksar.stores.regions import metadata_file

RENAMES = 32  # attempts to replace a store that other processes replace at the same time
UNFINISHED = ".unfinished"  # object in a store that is being created; it identifies the creating process
LOCK = ".lock"  # suffix of the object that locks another while it is written


class Group(NamedTuple):
    """A group of a store: the arguments of `create` for it."""

    schema: Mapping[str, Variable]
    coords: Mapping[str, Array]
    attrs: Mapping[str, Any]
    chunks: Mapping[str, int]
    variables: Mapping[str, Array] = {}


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
    groups: Mapping[str, Group] | None = None,
    identity: str | None = None,
) -> None:
    """Create a store: metadata, coordinates and small variables now; large arrays empty, to be written by region.

    An unfinished store is never taken for a finished one: a folder is written under a temporary name and then renamed;
    in an object store metadata of groups is written last, and the objects of an overwritten store are removed first.
    A store that is complete by then is flushed to the disk before it gets its name: also a loss of power leaves none
    that only looks complete.
    Only what the schema says is compressed. `xarray.open_zarr` opens the store.

    Parameters
    ----------
    path : path
        Folder to create, with its parents; or prefix in an object store.
    schema : dict of Variable
        The store's variables: one of the tables in the module `contract`.
    sizes : dict of int
        Length of every dimension that has no coordinate or variable.
    coords, variables : dict of array
        Written at once, in one chunk each, in the schema's dtype.
    attrs : dict
        Attributes of the store: JSON values, numpy scalars and arrays of real numbers; NaN becomes null.
    chunks : dict of int
        Chunk length by dimension, for the arrays that are created empty; default: the whole dimension.
    overwrite : bool
        Replace an existing store.
    fill : callable (place)
        Writes samples by region to the place it receives; the store does not exist under its name before that.
    groups : dict of Group, optional
        Groups below it, by path. Default: none.
    identity : str, optional
        Hash of all that the store is made from, for a `fill` by `write_pieces`: what one that ended early has left of a
        store of this identity stays, and is gone on with. Default: it is removed.

    Raises
    ------
    InputError
        If `path` exists and `overwrite` is False, or is not a zarr store, or cannot be written.
    ProcessingError
        If the disk is full or broken, an object store does not answer, or another process has begun to write the same
        store.
    ValueError
        If names, dimensions or shapes do not fit the schema, or JSON cannot hold an attribute.
    """
    files, metadata = _metadata(schema, sizes, coords, variables or {}, attrs, chunks, groups or {})
    place = place_of(path)
    if isinstance(place, ObjectPlace):
        last = {f"{path}/zarr.json": files.pop(f"{path}/zarr.json") for path in groups or {}}
        _create_objects(place, files, {**last, "zarr.json": metadata}, fill, overwrite=overwrite, identity=identity)
        return
    assert isinstance(place, LocalPlace)
    with replacing(place.path, overwrite=overwrite, identity=identity) as part:
        for key, data in {**files, "zarr.json": metadata}.items():
            put_file(part / key, data)
        if fill is not None:
            fill(part)
            (part / LEDGER).remove()
        if fill is not None or schema.keys() <= {*coords, *(variables or {})}:
            part.settle()


def _metadata(
    schema: Mapping[str, Variable],
    sizes: Mapping[str, int],
    coords: Mapping[str, Array],
    variables: Mapping[str, Array],
    attrs: Mapping[str, Any],
    chunks: Mapping[str, int],
    groups: Mapping[str, Group],
) -> tuple[dict[str, bytes], bytes]:
    """Return the files of a new store by name, small arrays included, and the group's metadata."""
    files, arrays, attributes = _arrays(schema, sizes, coords, variables, attrs, chunks)
    for path, group in groups.items():
        below, inner, own = _arrays(group.schema, {}, group.coords, group.variables, group.attrs, group.chunks)
        files |= {f"{path}/{name}": data for name, data in below.items()}
        arrays[path] = {"attributes": own, "zarr_format": 3, "node_type": "group"}
        arrays |= {f"{path}/{name}": value for name, value in inner.items()}
    for path in groups:
        beneath = {
            name.removeprefix(f"{path}/"): value for name, value in arrays.items() if name.startswith(f"{path}/")
        }
        files[f"{path}/zarr.json"] = metadata_bytes(group_metadata(arrays[path]["attributes"], beneath))
    return files, metadata_bytes(group_metadata(attributes, arrays))


def _arrays(
    schema: Mapping[str, Variable],
    sizes: Mapping[str, int],
    coords: Mapping[str, Array],
    variables: Mapping[str, Array],
    attrs: Mapping[str, Any],
    chunks: Mapping[str, int],
) -> tuple[dict[str, bytes], dict[str, Any], dict[str, Any]]:
    """Return the files of a group's arrays by name, the metadata of these, and its attributes."""
    small = {**coords, **variables}
    lengths = _lengths(schema, sizes, small)
    attributes = {key: nan_to_null(plain_value(value, key)) for key, value in attrs.items()}
    files: dict[str, bytes] = {}
    metadata: dict[str, Any] = {}
    for name, variable in schema.items():
        shape = tuple(lengths[dim] for dim in variable.dims)
        whole = tuple(max(n, 1) for n in shape)
        tile = tuple(max(min(chunks.get(dim, n), n), 1) for dim, n in zip(variable.dims, shape, strict=True))
        layout = VariableLayout(
            shape=shape,
            chunks=whole if name in small else tile,
            dtype=np.dtype(variable.dtype),
            compression=COMPRESSION if variable.compressed else None,
            dims=variable.dims,
            attrs=_variable_attrs(name, variable, schema, coords),
        )
        metadata[name] = array_metadata(layout)
        files[f"{name}/zarr.json"] = metadata_bytes(metadata[name])
        if name in small and 0 not in shape:
            values = np.ascontiguousarray(small[name], layout.dtype)
            files[f"{name}/{chunk_name([0] * len(shape))}"] = b"".join(encode(values, compressed=variable.compressed))
    return files, metadata, attributes


def put_file(place: LocalPlace, data: bytes) -> None:
    os.makedirs(place.path.parent, exist_ok=True)
    place.path.write_bytes(data)


def _lengths(schema: Mapping[str, Variable], sizes: Mapping[str, int], arrays: Mapping[str, Array]) -> dict[str, int]:
    """Return the length of every dimension, from `sizes` and from the arrays, which must agree."""
    lengths = dict(sizes)
    for name, values in arrays.items():
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
    attrs: dict[str, Any] = {"units": variable.units, "long_name": variable.long_name, **variable.attrs}
    if variable.flags:  # CF conventions, 3.5
        attrs["flag_values"], attrs["flag_meanings"] = list(range(len(variable.flags))), " ".join(variable.flags)
    # xarray recognises a coordinate that is named as its dimension; others (time over pulse) must be listed.
    listed = [c for c in coords if schema[c].dims != (c,) and set(schema[c].dims) <= set(variable.dims)]
    if listed and name not in coords:
        attrs["coordinates"] = " ".join(listed)
    return attrs


@contextmanager
def replacing(path: Path, *, overwrite: bool, identity: str | None = None) -> Iterator[LocalPlace]:
    """Yield an empty folder with a temporary name: it replaces `path` if the block succeeds, else it is removed.

    What killed processes have left of such a folder goes first; that of a store of this `identity` is yielded instead.
    """
    try:
        _refuse_existing(path, overwrite=overwrite)
        path.parent.mkdir(parents=True, exist_ok=True)
        with held_part(path, os.mkdir, begun=_beginning(identity)) as part:
            yield LocalPlace(Path(part))
            _put_in_place(part, path, overwrite=overwrite)
        sweep_beside(path)
    except ProcessingError as error:  # of a part that cannot be written, by the name that the user gave
        cause = error.__cause__
        if isinstance(cause, OSError) and is_full(cause):
            raise no_room(path, cause) from error
        raise
    except OSError as error:
        raise unwritable(path, error) from error


def _beginning(identity: str | None) -> Callable[[str], bool]:
    """Make a function that tells whether a folder is an unfinished store of this identity."""
    return lambda part: identity is not None and is_begun(LocalPlace(Path(part)), identity)


def _put_in_place(part: str, path: Path, *, overwrite: bool) -> None:
    """Rename a folder, then remove what it replaces; on failure the old one stays."""
    old = temporary_name(path, "old")
    try:
        for attempt in range(RENAMES):
            if overwrite:
                shutil.rmtree(old, ignore_errors=True)
                with suppress(FileNotFoundError):
                    os.rename(path, old)
            try:
                os.rename(part, path)
                break
            except OSError:
                # Another process created it in the meantime: try again if it may be overwritten.
                _refuse_existing(path, overwrite=overwrite)
                if attempt == RENAMES - 1 or not os.path.lexists(part):
                    raise
    finally:
        if os.path.lexists(old):
            if not os.path.lexists(path):
                os.rename(old, path)
            shutil.rmtree(old, ignore_errors=True)


def refuse_existing(place: Place, *, overwrite: bool) -> None:
    """Raise an InputError if something exists at a place and may not be replaced by a store."""
    if isinstance(place, ObjectPlace):
        _refuse_objects(place, overwrite=overwrite)
    elif isinstance(place, LocalPlace):
        _refuse_existing(place.path, overwrite=overwrite)


def _refuse_existing(path: Path, *, overwrite: bool) -> None:
    """Raise an InputError if a folder exists and may not be replaced."""
    if not os.path.lexists(path):
        return
    if not overwrite:
        raise in_the_way(path)
    try:
        folder = not path.is_symlink() and path.is_dir()
        foreign = not folder or (any(path.iterdir()) and not metadata_file(LocalPlace(path)))
    except FileNotFoundError:
        return  # another process is replacing it
    # A folder that another process has just moved away would look foreign too.
    if foreign and os.path.lexists(path):
        raise _not_a_store(path)


def _not_a_store(path: object) -> InputError:
    return InputError(
        f"{path} exists and is not a zarr store, so it is not overwritten; remove it, or choose another name"
    )


def _create_objects(
    place: ObjectPlace,
    files: Mapping[str, bytes],
    last: Mapping[str, bytes],
    fill: Callable[[Place], None] | None,
    *,
    overwrite: bool,
    identity: str | None,
) -> None:
    """Write metadata, samples, and last the files that complete the store."""
    token = secrets.token_bytes(16) if identity is None else identity.encode()
    with replacing_objects(place, token, overwrite=overwrite, identity=identity) as check_mark:
        for key, data in files.items():
            (place / key).write_bytes(data)
        if fill is not None:
            fill(place)
        check_mark()
        for key, data in last.items():
            (place / key).write_bytes(data)
        if identity is not None:
            (place / LEDGER).remove()


@contextmanager
def replacing_objects(
    place: ObjectPlace, token: bytes, *, overwrite: bool, identity: str | None = None
) -> Iterator[Callable[[], None]]:
    """Create a store in an object store, which cannot rename: a mark is written first, the group's metadata last.

    The mark is this process's `token`; one that was left with the same token is gone on with: anew, or as `create` says
    of a store of an `identity`. Yields the function that checks the mark, to be called before the group's metadata is
    written: if it has changed, another process has begun to write the same store.
    """
    mark = place / UNFINISHED

    def check_mark() -> None:
        if not holds(mark, token):
            raise ProcessingError(f"{place} is also being written by somebody else; write each store only once")

    try:
        with nullcontext() if identity is None else _locked(place):
            ours = holds(mark, token)
            _refuse_objects(place, overwrite=overwrite or ours)
            mark.write_bytes(token)
            try:
                if identity is None or not (ours and is_begun(place, identity)):
                    _clear(place)
                yield check_mark
            except BaseException as error:
                with suppress(OSError):
                    stays = identity is not None and not is_final(error) and is_begun(place, identity)
                    if not stays and holds(mark, token):
                        _clear(place)
                        mark.remove()
                raise
            mark.remove()
    except (FileNotFoundError, PermissionError) as error:
        raise InputError(f"{place} cannot be written ({error.strerror}); check {ENVIRONMENT}") from error
    except OSError as error:
        raise ProcessingError(f"{place} cannot be written ({error.strerror or error})") from error


@contextmanager
def _locked(place: ObjectPlace) -> Iterator[None]:
    """Lock an unfinished store, so that no other process resumes it at the same time.

    Raises
    ------
    InputError
        If another process writes there.
    """
    try:
        with place_of(f"{str(place).rstrip('/')}{LOCK}").lock():
            yield
    except Held as owner:
        raise InputError(f"{place} is being written by {owner}; wait for it, or choose another name") from None


def _refuse_objects(place: ObjectPlace, *, overwrite: bool) -> None:
    """Raise an InputError if objects exist below a prefix and may not be replaced."""
    names = place.names()
    if not names and not place.exists():
        return
    if not overwrite:
        state = "exists" if UNFINISHED not in names else "is being written, or was left unfinished"
        raise in_the_way(place, state)
    if UNFINISHED not in names and not metadata_file(place):
        raise _not_a_store(place)


def _clear(place: ObjectPlace) -> None:
    """Remove all objects except the mark, the group's metadata first: without it the rest is not a store."""
    for name in sorted(place.names(), key=lambda name: name != "zarr.json"):
        if name != UNFINISHED:
            (place / name).remove()


def holds(mark: Place, token: bytes) -> bool:
    """Tell whether a mark was written with this token."""
    with suppress(FileNotFoundError):
        return mark.read_bytes() == token
    return False


def create_phase_history(
    path: Location,
    collection: Collection,
    *,
    raw: RawEcho | None = None,
    channels: Sequence[str] = (),
    attrs: Mapping[str, Any] | None = None,
    overwrite: bool = False,
    fill: Callable[[Place], None] | None = None,
    identity: str | None = None,
) -> None:
    """Create a phase history without its samples: `fill` writes those by region, in chunks of `TILE`.

    Without `fill` they may be written later; until then all pulses of the store are missing.

    Parameters
    ----------
    path : path
    collection, raw, channels, attrs
        As for `phase_history_group`.
    overwrite, fill, identity
        As for `create`.

    Raises
    ------
    InputError, ProcessingError
        As for `create`, and if the disk has no room for the samples that are filled in.
    """
    if fill is not None:
        refuse_full(path, history_bytes(collection, max(len(channels), 1), raw), identity=identity)
    group = phase_history_group(collection, raw=raw, channels=channels, attrs=attrs)
    create(path, **group._asdict(), sizes={}, overwrite=overwrite, fill=fill, identity=identity)


def phase_history_group(
    collection: Collection,
    *,
    raw: RawEcho | None = None,
    channels: Sequence[str] = (),
    attrs: Mapping[str, Any] | None = None,
) -> Group:
    """Make the group of a phase history within a store.

    Parameters
    ----------
    collection : Collection
    raw : RawEcho, optional
        For a raw echo, whose samples are `echo` over its fast_time.
    channels : sequence of str
        Names along a leading dimension of the samples; none by default.
    attrs : dict
        In addition to those of `collection` and `raw`: history, targets, scene, georeference ...
    """
    column, axis = ("range_frequency", collection.range_frequency) if raw is None else ("fast_time", raw.fast_time)
    schema, angles, variables = stated(collection, PHASE_HISTORY if raw is None else RAW_ECHO)
    named: dict[str, Any] = {}
    if channels:
        schema = with_channels(schema, "signal" if raw is None else "echo")
        named = {"channel": np.asarray(check_channels(channels), "T")}
    return Group(
        schema=schema, coords={"time": collection.time, column: axis, **angles, **named}, variables=variables,
        attrs=_collection_attrs(collection, raw, attrs),
        chunks={"channel": 1, "pulse": TILE[0], column: TILE[1]},
    )  # fmt: skip


def refuse_full(path: Location, needed: int, other: str = "", *, identity: str | None = None) -> None:
    """Check the free space of a disk after removing what killed processes have left there.

    `other` is what else would make them fit. What there is of a store of an `identity` stays, and is room as well.

    Raises
    ------
    InputError
        If it has not, with both figures.
    """
    where = place_of(path)
    remedy = f"make room, choose another place, or {other}" if other else REMEDY
    left = sweep_beside(where.path, spare=_beginning(identity)) if isinstance(where, LocalPlace) else []
    there = sum(LocalPlace(Path(part)).taken() for part in left)
    check_room(where, needed - there, remedy)


def history_bytes(collection: Collection, n_channel: int, raw: RawEcho | None) -> int:
    """Bytes that the samples of a phase history take on a disk."""
    columns = collection.n_range_frequency if raw is None else raw.fast_time.size
    return n_channel * stored_bytes((collection.n_pulse, columns))


def write_collection(path: Location, collection: Collection, attrs: Mapping[str, Any] | None = None) -> None:
    """Write a collection: a phase history without samples. An existing store is replaced.

    Raises
    ------
    InputError
        As for `create`.
    """
    schema, angles, variables = stated(collection, COLLECTION)
    create(
        path,
        schema,
        sizes={},
        coords={"time": collection.time, "range_frequency": collection.range_frequency, **angles},
        variables=variables,
        attrs=_collection_attrs(collection, None, attrs),
        chunks={},
        overwrite=True,
    )


def _collection_attrs(collection: Collection, raw: RawEcho | None, attrs: Mapping[str, Any] | None) -> dict[str, Any]:
    own = {name: getattr(collection, field) for name, field in COLLECTION_ATTRS.items()}
    if raw is not None:
        own |= {name: getattr(raw, name) for name in ("chirp_rate", "pulse_width")}
    elif collection.recorded is not None:
        own[RECORDED] = collection.recorded.as_attribute()
    general = {
        "Conventions": CONVENTIONS,
        "title": collection.title,
        "history": history_line("created by blocksar"),
        **(attrs or {}),
    }
    if collection.title:
        general["title"] = collection.title
    return {**general, **{name: value for name, value in own.items() if value is not None}}


def history_line(action: str, earlier: Any = None) -> str:
    """Return the history attribute: the action with the time, above the earlier history."""
    line = f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ} {action}"
    return f"{line}\n{earlier}" if earlier else line
