"""Frozen objects of arrays and numbers, kept in files of a run's folder between tasks.

Arrays are written as numpy does, everything else as JSON in bytes; nothing is unpickled. The same object gives the same
bytes.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any, TypeVar, get_origin, get_type_hints

import numpy as np

from blocksar import stores
from blocksar.errors import ProcessingError
from blocksar.runs.folder import KEPT
from blocksar.runs.receipts import Run, refuse_replaced

Files = Mapping[str, str]  # checksums by name, as receipts have them
T = TypeVar("T")
OTHER = "json"  # kind of an entry that is no array


def keep(run: Run, name: str, values: Sequence[Any]) -> dict[str, str]:
    """Write dataclasses of arrays, numbers, texts, dicts and tuples to a file; return its checksum by its path.

    Raises
    ------
    ProcessingError
        If it cannot be written, or another run has taken the folder.
    """
    refuse_replaced(run)
    name = f"{KEPT}/{name}"
    arrays: dict[str, Any] = {}
    for index, value in enumerate(values):
        for field in fields(value):
            content = getattr(value, field.name)
            if isinstance(content, np.ndarray):
                arrays[f"{index}/{field.name}"] = content
            else:
                text = json.dumps(content, default=_plain).encode()
                arrays[f"{index}/{field.name}/{OTHER}"] = np.frombuffer(text, np.uint8)
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    try:
        (run.folder / name).write_bytes(buffer.getvalue())
    except OSError as error:
        raise ProcessingError(f"{run.folder / name} cannot be written ({error.strerror or error})") from error
    return {name: stores.checksum_bytes(buffer.getvalue())}


def _plain(value: Any) -> Any:
    """A number of numpy as one of Python."""
    return value.item()


def kept(run: Run, kind: type[T], files: Files) -> list[T]:
    """Read the dataclasses of one kind that `keep` wrote to these files, in order.

    Raises
    ------
    ProcessingError
        If a file is gone, or no longer has its checksum.
    """
    hints = get_type_hints(kind)
    values = []
    for name, checksum in files.items():
        try:
            data = (run.folder / name).read_bytes()
        except OSError as error:
            raise ProcessingError(f"{run.folder / name} cannot be read ({error.strerror or error})") from error
        if stores.checksum_bytes(data) != checksum:
            raise ProcessingError(f"{run.folder / name} no longer has the checksum of its receipt")
        found: dict[int, dict[str, Any]] = {}
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            for key in archive.files:
                index, field, *other = key.split("/")
                content = json.loads(archive[key].tobytes()) if other else archive[key]
                is_tuple = bool(other) and get_origin(hints[field]) is tuple
                found.setdefault(int(index), {})[field] = tuple(content) if is_tuple else content
        values += [kind(**found[index]) for index in sorted(found)]
    return values
