"""The result of an ingestion, and a guard that turns every failure to read a foreign file into an InputError."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from textwrap import shorten

from blocksar.collection.collection import Collection
from blocksar.errors import InputError, MissingInput, ProcessingError, printable
from blocksar.places.place import Place
from blocksar.places.ranges import Readable


@dataclass(frozen=True, kw_only=True, eq=False)
class Ingested:
    """A phase history made from files, and messages about it for the user."""

    path: Path | Place
    collection: Collection
    messages: list[str]


@contextmanager
def reading(path: Readable, *, damaged: str, remedy: str) -> Iterator[None]:
    """Turn any error of the libraries that read a file into one InputError that names the file.

    Where another file is read meanwhile, its error names that one.

    `damaged` describes a file that a library fails on, and `remedy` says what to do about it. MemoryError and
    ProcessingError are not the file's fault, and pass unchanged.
    """
    try:
        yield
        return
    except (MemoryError, ProcessingError):
        raise
    except InputError as error:
        if error.file is not None:
            raise
        kind, cause = MissingInput if isinstance(error, MissingInput) else InputError, error.__cause__
        found = kind(str(error) if str(path) in str(error) else f"{path}: {error}")
    except FileNotFoundError as error:
        found, cause = MissingInput(f"{path} does not exist; check the path"), error
    except OSError as error:
        found = InputError(f"{path} cannot be read ({error.strerror or error}); check it and its permissions")
        cause = error
    except Exception as error:
        what = printable(shorten(f"{type(error).__name__}: {error}", 200, placeholder=" ..."))
        found, cause = InputError(f"{path} is {damaged} ({what}); {remedy}"), error
    found.file = str(path)
    raise found from cause
