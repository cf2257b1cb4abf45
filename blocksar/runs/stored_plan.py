"""The plan of an unfinished run, stored in its folder, so that a resumed run continues with the same plan.

It is a pickle, which holds objects of this package, of other packages' processors and of numpy, and is never loaded
unless the record has its checksum. As a run folder may come from elsewhere, nothing else is made from it, no function
is called but those that make arrays, and no module is imported.
"""

from __future__ import annotations

import copyreg
import io
import pickle
import sys
import zlib
from dataclasses import is_dataclass
from enum import Enum
from functools import cached_property
from typing import Any, TypeVar

from blocksar import stores
from blocksar.errors import FolderError, ProcessingError
from blocksar.places.place import Place
from blocksar.runs.folder import PLAN

T = TypeVar("T")
# Functions that pickles of numpy call, in addition to types of this package.
_NUMPY = {
    ("numpy._core.multiarray", "_reconstruct"), ("numpy._core.multiarray", "scalar"),
    ("numpy._core.numeric", "_frombuffer"), ("numpy", "ndarray"), ("numpy", "dtype"),
}  # fmt: skip
_BUILTINS = {"complex", "frozenset", "range", "set", "slice"}


def pack(plan: object) -> bytes:
    """Serialise a plan to compressed bytes."""
    file = io.BytesIO()
    _Pickler(file, protocol=5).dump(plan)
    return zlib.compress(file.getvalue(), level=1)


def write(folder: Place, packed: bytes) -> None:
    """Write a plan into the folder of a run.

    Raises
    ------
    ProcessingError
        If it cannot be written.
    """
    try:
        (folder / PLAN).write_bytes(packed)
    except OSError as error:
        raise ProcessingError(f"{folder / PLAN} cannot be written ({error.strerror or error})") from error


def read(folder: Place, checksum: str, kind: type[T]) -> tuple[T, bytes]:
    """Read the plan of a run to be resumed, and check it against its checksum; also return its bytes.

    Raises
    ------
    FolderError
        If it is not the one that was written.
    """
    try:
        packed = (folder / PLAN).read_bytes()
        if stores.checksum_bytes(packed) == checksum:
            plan = _Unpickler(io.BytesIO(zlib.decompress(packed))).load()
            if isinstance(plan, kind):
                return plan, packed
    except (OSError, zlib.error, pickle.UnpicklingError, AttributeError, ImportError, EOFError, TypeError, ValueError):
        pass
    raise damaged(folder)


def damaged(folder: Place) -> FolderError:
    """Make the error about a stored plan that is damaged or of another run."""
    return FolderError(
        f"{folder} is damaged: its run.json does not have the plan that the run began with, or {PLAN} is another; use "
        "--overwrite to begin it again",
        replaceable=True,
    )


class _Pickler(pickle.Pickler):
    """Pickler that omits cached values, so that the bytes do not depend on what was computed from a plan."""

    def reducer_override(self, obj: Any) -> Any:
        if not is_dataclass(obj) or isinstance(obj, type):
            return NotImplemented
        computed = {
            name
            for each in type(obj).__mro__
            for name, value in vars(each).items()
            if isinstance(value, cached_property)
        }
        return copyreg.__newobj__, (type(obj),), {k: v for k, v in vars(obj).items() if k not in computed}  # type: ignore[attr-defined]


class _Unpickler(pickle.Unpickler):
    """Unpickler that creates only frozen dataclasses, named tuples, enumerations and arrays, and imports nothing."""

    def find_class(self, module: str, name: str) -> Any:
        found = getattr(sys.modules.get(module), name, None)
        plain = isinstance(found, type) and (is_dataclass(found) or issubclass(found, Enum | tuple))
        if plain or (module, name) in _NUMPY or (module == "builtins" and name in _BUILTINS):
            return found
        raise pickle.UnpicklingError(f"{module}.{name} is no part of a plan")
