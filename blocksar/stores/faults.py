"""Errors of file systems and libraries, turned into messages about stores."""

from __future__ import annotations

from blocksar.errors import InputError, ProcessingError
from blocksar.places.local import LocalPlace
from blocksar.places.place import Place

ENVIRONMENT = "AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_REGION and AWS_ENDPOINT_URL"


def unreachable(place: Place, error: OSError, *, writing: bool = False) -> InputError | ProcessingError:
    """Return the error to raise when a file system or an object store cannot be read or written."""
    if writing:
        return ProcessingError(f"{place} cannot be written ({error.strerror or error})")
    remedy = "its permissions" if isinstance(place, LocalPlace) else ENVIRONMENT
    return InputError(f"{place} cannot be read ({error.strerror or error}); check {remedy}")


def cause_of(error: BaseException) -> str:
    """Describe an error of a library by its type and the beginning of its message, on one line."""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text[:200]}" if text else type(error).__name__
