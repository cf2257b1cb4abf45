"""Copies of a phase history with another track: files byte by byte, except positions and metadata.

Chunking, compression, extra variables and the version of the zarr format stay those of the source. Metadata is written
last: until then the copy is no store.
"""

from __future__ import annotations

import json
import os
import sys
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
import xxhash

from blocksar.arrays import FloatArray
from blocksar.errors import InputError, ProcessingError, changes_while_read
from blocksar.places.local import LocalPlace
from blocksar.places.objects import ObjectPlace
from blocksar.places.place import Place
from blocksar.stores.chunk_files import METADATA, refuse_odd_file
from blocksar.stores.contract import TRACK_AND_BEAM, Variable
from blocksar.stores.creation import UNFINISHED, holds, replacing, replacing_objects
from blocksar.stores.records import checksum_bytes, nan_to_null, plain_value, unreachable

POSITION = "antenna_position"
ORIGINAL = "antenna_position_original"
PIECE = 1 << 24  # bytes of a file in memory at a time
_VARIABLES = {
    POSITION: TRACK_AND_BEAM[POSITION],
    ORIGINAL: Variable(("pulse", "axis"), "float64", "m", "antenna phase centre before the correction of the track"),
}


def files_to_copy(source: Place) -> dict[str, str]:
    """Names and versions of a store's files that a copy takes unchanged: all but metadata and positions."""
    return {
        name: f"{size} {version}"
        for name, size, version in source.files()
        if os.path.basename(name) not in METADATA and name.split("/")[0] not in _VARIABLES
    }


def copy_files(source: Place, target: Place, versions: Mapping[str, str]) -> dict[str, str]:
    """Copy files of these versions from one store to another; return their checksums by name.

    Raises
    ------
    InputError
        If one has another version, or cannot be read.
    ProcessingError
        If one cannot be written.
    """
    checksums = {}
    for name, version in versions.items():
        checksums[name] = _copy_file(source / name, target / name)
        if (source / name).version() != version:
            raise changes_while_read(source, f" ({name})")
    return checksums


def _copy_file(source: Place, target: Place) -> str:
    digest = xxhash.xxh3_128()
    if not (isinstance(source, LocalPlace) and isinstance(target, LocalPlace)):
        try:
            data = source.read_bytes()
        except OSError as error:
            raise unreachable(source, error) from error
        _put(target, data)
        return checksum_bytes(data)
    try:
        reading = open(source, "rb")  # noqa: SIM115 - closed below; its errors are those of the input
    except OSError as error:
        raise unreachable(source, error) from error
    with reading:
        try:
            target.path.parent.mkdir(parents=True, exist_ok=True)
            with open(target, "wb") as written:
                while piece := reading.read(PIECE):
                    digest.update(piece)
                    written.write(piece)
        except OSError as error:
            raise ProcessingError(f"{target} cannot be written ({error.strerror or error})") from error
    return digest.hexdigest()


def same_files(place: Place, checksums: Mapping[str, str]) -> bool:
    """Tell whether all files below a place have these checksums; reads them."""
    return all(_digest(place / name) == checksum for name, checksum in checksums.items())


def _digest(place: Place) -> str | None:
    digest = xxhash.xxh3_128()
    with suppress(OSError, InputError):
        if not isinstance(place, LocalPlace):
            return checksum_bytes(place.read_bytes())
        refuse_odd_file(place.path, sys.maxsize)
        with open(place, "rb") as file:
            while piece := file.read(PIECE):
                digest.update(piece)
        return digest.hexdigest()
    return None


def write_track(
    source: Place, target: Place, *, corrected: FloatArray, original: FloatArray, attrs: Mapping[str, Any]
) -> None:
    """Write the metadata of a copy, with its positions (n_pulse, 3), m, before and after the correction.

    Parameters
    ----------
    source, target : Place
        The store, and its copy, whose other files are there.
    attrs : dict
        Attributes that are added to those of the source, or replace them.

    Raises
    ------
    InputError
        If the source cannot be read.
    ProcessingError
        If the target cannot be written.
    """
    from zarr.core.buffer import default_buffer_prototype

    memory: dict[str, Any] = {}
    prototype = default_buffer_prototype()
    try:
        for name, _, _ in source.files():
            if os.path.basename(name) in METADATA and name.split("/")[0] not in _VARIABLES:
                memory[name] = prototype.buffer.from_bytes((source / name).read_bytes())
    except OSError as error:
        raise unreachable(source, error) from error
    consolidated = ".zmetadata" in memory
    if "zarr.json" in memory:
        consolidated = json.loads(memory["zarr.json"].to_bytes()).get("consolidated_metadata") is not None
    _change(memory, {POSITION: corrected, ORIGINAL: original}, attrs, consolidated=consolidated)
    for name in sorted(memory, key=_last):
        _put(target / name, memory[name].to_bytes())


def _change(
    memory: dict[str, Any], positions: Mapping[str, FloatArray], attrs: Mapping[str, Any], *, consolidated: bool
) -> None:
    """Replace positions and attributes in a store's metadata, consolidated as before."""
    import zarr
    from zarr.storage import MemoryStore

    version: Any = 3 if "zarr.json" in memory else 2
    store = MemoryStore(memory)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of consolidated metadata, and of variables without chunks here
        group = zarr.open_group(store, mode="r+", zarr_format=version, use_consolidated=False)
        for name, values in positions.items():
            variable = _VARIABLES[name]
            attributes: dict[str, Any] = {
                "units": variable.units,
                "long_name": variable.long_name,
                "coordinates": "time",
            }
            names: dict[str, Any] = {"dimension_names": variable.dims}
            if version == 2:
                names, attributes["_ARRAY_DIMENSIONS"] = {}, list(variable.dims)
            array = group.create_array(
                name, shape=values.shape, chunks=values.shape, dtype=variable.dtype, fill_value=np.nan,
                compressors=None, filters=None, attributes=attributes, config={"write_empty_chunks": True}, **names,
            )  # fmt: skip
            array[...] = values
        group.attrs.update({name: nan_to_null(plain_value(value, name)) for name, value in attrs.items()})
        if consolidated:
            zarr.consolidate_metadata(store, zarr_format=version)


def publish(made: Place, out: Place, *, overwrite: bool) -> None:
    """Give a complete store its final name, once it is on the disk: by renaming; in an object store by copying.

    There it is copied as `replacing_objects` says; one that `was_being_published` is gone on with.

    Raises
    ------
    InputError
        If `out` exists and `overwrite` is False, or cannot be written.
    """
    if isinstance(out, ObjectPlace):
        with replacing_objects(out, str(made).encode(), overwrite=overwrite) as check_mark:
            *files, last = sorted((name for name, _, _ in made.files()), key=_last)
            for name in files:
                (out / name).write_bytes((made / name).read_bytes())
            check_mark()
            (out / last).write_bytes((made / last).read_bytes())
        return
    assert isinstance(made, LocalPlace) and isinstance(out, LocalPlace)
    made.sweep()  # of what killed processes have left in it
    with replacing(out.path, overwrite=overwrite) as part:
        made.settle()
        os.rename(made, part)


def was_being_published(made: Place, out: Place) -> bool:
    """Tell whether a process was killed while it published this store, so that the rest may be replaced."""
    return isinstance(out, ObjectPlace) and holds(out / UNFINISHED, str(made).encode())


def _last(name: str) -> tuple[bool, str]:
    """Sort key for writing: the group's own metadata last."""
    return name in METADATA, name


def _put(place: Place, data: bytes) -> None:
    try:
        place.write_bytes(data)
    except OSError as error:
        raise ProcessingError(f"{place} cannot be written ({error.strerror or error})") from error


def groups_of(versions: Mapping[str, str], size: int) -> list[Sequence[str]]:
    """Divide files into groups of consecutive names, of about `size` bytes each."""
    groups: list[list[str]] = [[]]
    filled = 0
    for name in sorted(versions):
        if filled >= size:
            groups.append([])
            filled = 0
        groups[-1].append(name)
        filled += int(versions[name].split()[0])
    return [group for group in groups if group]
