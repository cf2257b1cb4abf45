"""Files of other programs: what can be wrong with reading them, in one sentence, and what is made of them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from blocksar.collection.collection import Collection
from blocksar.errors import InputError, ProcessingError, printable
from blocksar.places.place import Place


@dataclass(frozen=True, kw_only=True, eq=False)
class Ingested:
    """A phase history made from files, and what there is to say of it."""

    path: Path | Place
    collection: Collection
    said: list[str]


@contextmanager
def reading(path: Place, *, damaged: str, remedy: str) -> Iterator[None]:
    """Whatever the bytes of a file do to the libraries below, one InputError that names it comes out.

    `damaged` is what is said of a file that a library fails on, and `remedy` what to do about it. A want of memory and
    a fault of what is being written are no fault of the file, and pass.
    """
    try:
        yield
    except InputError as error:
        text = str(error)
        raise InputError(text if str(path) in text else f"{path}: {text}") from error.__cause__
    except FileNotFoundError as error:
        raise InputError(f"{path} does not exist; check the path") from error
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror or error}); check it and its permissions") from error
    except (MemoryError, ProcessingError):
        raise
    except Exception as error:
        cause = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise InputError(f"{path} is {damaged} ({printable(cause)}); {remedy}") from error
