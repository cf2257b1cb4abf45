"""Small records in JSON, and checksums."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from math import isfinite
from typing import Any

import numpy as np
import xxhash

from blocksar.errors import InputError, MissingInput, ProcessingError
from blocksar.places import Location
from blocksar.places import place as place_of
from blocksar.places.local import LocalPlace
from blocksar.places.place import Place
from blocksar.stores.chunk_files import Array, refuse_odd_file

ENVIRONMENT = "AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_REGION and AWS_ENDPOINT_URL"


def unreachable(place: Place, error: OSError, *, writing: bool = False) -> InputError | ProcessingError:
    """Return the error to raise when a file system or an object store cannot be read or written."""
    if writing:
        return ProcessingError(f"{place} cannot be written ({error.strerror or error})")
    remedy = "its permissions" if isinstance(place, LocalPlace) else ENVIRONMENT
    if isinstance(error, FileNotFoundError) and not isinstance(place, LocalPlace):
        return MissingInput(f"{place} cannot be read ({error.strerror or error}); check its name, {remedy}")
    return InputError(f"{place} cannot be read ({error.strerror or error}); check {remedy}")


def cause_of(error: BaseException) -> str:
    """Describe an error of a library by its type and the beginning of its message, on one line."""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text[:200]}" if text else type(error).__name__


def write_json(path: Location, obj: Any) -> None:
    """Write JSON atomically: a reader sees the old file or the new one. Each entry of an object has a line of its own.

    Numpy numbers and arrays become numbers and lists; NaN and infinities, which JSON lacks, become null.

    Raises
    ------
    ProcessingError
        If the file cannot be written, for lack of space or permission for instance.
    ValueError
        If JSON cannot hold `obj`.
    """
    place = place_of(path)
    try:
        text = _lines_of(obj)
    except (TypeError, ValueError):  # something is to be converted, or cannot be
        text = _lines_of(nan_to_null(plain_value(obj, place.name)))
    try:
        place.write_bytes(f"{text}\n".encode())
    except OSError as error:
        raise ProcessingError(f"{place} cannot be written ({error.strerror or error})") from error


def _lines_of(obj: Any) -> str:
    """JSON with the entries of an object, and those of lists of objects in it, on lines of their own.

    The encoder that indents everything is slow: a run's record names thousands of chunks.
    """
    encode = json.JSONEncoder(allow_nan=False).encode
    if not isinstance(obj, dict):
        return encode(obj)
    entries = []
    for key, value in obj.items():
        rows = isinstance(value, list | tuple) and value and isinstance(value[0], dict)
        text = "[\n  " + ",\n  ".join(map(encode, value)) + "\n ]" if rows else encode(value)
        entries.append(f" {encode(str(key))}: {text}")
    return "{\n" + ",\n".join(entries) + "\n}" if entries else "{}"


def plain_value(value: Any, name: str) -> Any:
    """Convert a value to JSON types: numpy numbers and real arrays, paths, tuples; `name` names it in a message."""
    match value:
        case np.generic() | np.ndarray() if value.dtype.kind in "biufU":
            return plain_value(value.tolist(), name)
        case None | bool() | int() | float() | str():
            return value
        case os.PathLike() | Place():
            return str(value)
        case Mapping():
            return {str(key): plain_value(item, f"{name}.{key}") for key, item in value.items()}
        case list() | tuple():
            return [plain_value(item, name) for item in value]
    raise ValueError(f"attribute {name} = {value!r} is a {type(value).__name__}, which JSON cannot hold")


def nan_to_null(value: Any) -> Any:
    """Replace NaN and infinities by None, also within lists and dicts."""
    match value:
        case float():
            return value if isfinite(value) else None
        case dict():
            return {key: nan_to_null(item) for key, item in value.items()}
        case list():
            return [nan_to_null(item) for item in value]
    return value


def read_json(path: Location, remedy: str = "remove it, and create it again") -> Any:
    """Read JSON; `remedy` says what to do about a damaged file.

    Raises
    ------
    InputError
        If the file is missing, may not be read or is not JSON.
    """
    place = place_of(path)
    try:
        if isinstance(place, LocalPlace):
            refuse_odd_file(place.path)
        return json.loads(place.read_bytes())
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"{path} does not exist; check the path") from None
    except OSError as error:
        remedy = "the path" if isinstance(place, LocalPlace) else ENVIRONMENT
        raise InputError(f"{path} cannot be read ({error.strerror or error}); check {remedy}") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is damaged ({cause_of(error)}); {remedy}") from error


def checksum(array: Array) -> str:
    """Return the xxh3 checksum, 128 bits in hexadecimal, of an array's bytes in C order."""
    values = np.ascontiguousarray(array)
    return xxhash.xxh3_128(values.reshape(-1).view(np.uint8).data).hexdigest()


def checksum_bytes(data: bytes) -> str:
    """Return the xxh3 checksum, 128 bits in hexadecimal, of bytes."""
    return xxhash.xxh3_128(data).hexdigest()


def file_checksum(place: Place) -> str:
    """Return `checksum_bytes` of a small file.

    Raises
    ------
    InputError
        If it is no regular file, or too large.
    """
    if isinstance(place, LocalPlace):
        refuse_odd_file(place.path)
    return checksum_bytes(place.read_bytes())


def json_checksum(obj: Any) -> str:
    """Return the checksum of an object as `write_json` writes it; the order of keys does not matter.

    Raises
    ------
    ValueError
        If JSON cannot hold `obj`.
    """
    try:
        plain = json.loads(json.dumps(obj, allow_nan=False))  # whose keys are texts
    except (TypeError, ValueError):  # something is to be converted, or cannot be
        plain = nan_to_null(plain_value(obj, ""))
    return checksum_bytes(json.dumps(plain, sort_keys=True, allow_nan=False).encode())
