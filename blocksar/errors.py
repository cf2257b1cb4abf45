"""The kinds of errors: wrong input, failed processing, and systems that are not supported."""

from __future__ import annotations

import errno
import re
import reprlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

FLAGS = ("overwrite", "reference", "dry-run", "raw", "cphd", "autofocus", "discard")  # options without a value
LONG_WORD, SHORT = re.compile(r"\S{300,}"), 60  # in a message, of which as many characters at either end are shown
OPTION = re.compile(
    r"`(?:blocksar|rio|pyproj) [^`]*`|(?<![^\s(\[\"'`>])--([a-z]+(?:-[a-z]+)*)"
)  # those of a whole command stay


def printable(text: str) -> str:
    """Return text that is safe on a terminal: unprintable characters except line ends become escape sequences."""
    return "".join(c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text)


def quoted(text: object) -> str:
    """Quote user input for a message, shortened to 80 characters."""
    short = reprlib.Repr()
    short.maxstring = short.maxother = 80
    return short.repr(text)


def in_python(text: str) -> str:
    """Return a sentence that names options of the command line with the parameters of Python instead.

    Examples
    --------
    >>> in_python("use --overwrite to replace it, or another --out; --memory-limit 2GiB would do")
    'use overwrite=True to replace it, or another out; memory_limit 2GiB would do'
    >>> in_python("`blocksar focus --out` left it")
    '`blocksar focus --out` left it'
    """

    def parameter(match: re.Match[str]) -> str:
        if match[1] is None:
            return match[0]
        return match[1].replace("-", "_") + ("=True" if match[1] in FLAGS else "")

    return OPTION.sub(parameter, text)


class InputError(ValueError):
    """The user's input is wrong: one sentence with the field, the value and the remedy (exit status 2).

    Attributes
    ----------
    file : str, optional
        The file that is at fault, which the sentence begins with.
    """

    file: str | None = None

    def __init__(self, message: str) -> None:
        super().__init__(LONG_WORD.sub(lambda word: f"{word[0][:SHORT]}...{word[0][-SHORT:]}", printable(message)))


class MissingInput(InputError, FileNotFoundError):
    """Nothing lies at a path that is given: also the error that Python's own functions raise then."""


class UnknownOption(InputError, TypeError):
    """Error: a function has no argument of that name; also a TypeError, as Python raises then.

    Attributes
    ----------
    name : str
        The argument.
    """

    def __init__(self, message: str, name: str) -> None:
        super().__init__(message)
        self.name = name

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (str(self), self.name)


class Unfocusable(InputError):
    """Error: no chain forms the requested image, although the input is right; exact back-projection does."""


class PrfTooLow(Unfocusable):
    """The PRF does not hold the Doppler band of the lit scene.

    Attributes
    ----------
    needed : float
        The lowest PRF that would do, Hz.
    """

    def __init__(self, message: str, needed: float) -> None:
        super().__init__(message)
        self.needed = needed

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (str(self), self.needed)


class OutsideSwath(InputError):
    """A grid lies outside what a collection covers: of several collections, others may cover it."""


class FolderError(InputError):
    """The run folder cannot be used, while phase history and settings are fine.

    The same call may succeed later: when another process has left the folder, or the folder is writable again.

    Attributes
    ----------
    replaceable : bool
        Whether the call succeeds with `overwrite`: the folder holds another run, or a damaged one.
    """

    def __init__(self, message: str, replaceable: bool = False) -> None:
        super().__init__(message)
        self.replaceable = replaceable

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (str(self), self.replaceable)


class NoRoom(FolderError):
    """Something will not fit on the disk; nothing of it has been written yet."""


def in_the_way(path: object, state: str = "exists") -> InputError:
    """Make the error about an existing file or store that is only overwritten on request."""
    return InputError(f"{path} {state}; choose another name, or have it overwritten (--overwrite)")


def changes_while_read(path: object, detail: str = "") -> InputError:
    """Make the error about a store that changes while it is read; `detail` follows the sentence's first part."""
    return InputError(f"{path} changes while it is read{detail}; start again once nothing writes to it")


def shortened_trace(error: Exception) -> None:
    """Drop the causes and frames of the file system's error that a trace would show before `error`."""
    cause = error.__cause__
    if isinstance(cause, OSError) and cause.errno is not None:
        cause.__cause__, cause.__suppress_context__, cause.__traceback__ = None, True, None


@contextmanager
def library_for(use: str, extra: str) -> Iterator[None]:
    """Turn the error about a missing library, which is imported in the block, into an InputError.

    Examples
    --------
    >>> with library_for("pictures need", "plots"):
    ...     import no_such_library
    Traceback (most recent call last):
    blocksar.errors.InputError: no_such_library is not installed, which pictures need; install blocksar[plots]
    """
    try:
        yield
    except ModuleNotFoundError as error:
        library = str(error.name).partition(".")[0]
        raise InputError(f"{library} is not installed, which {use}; install blocksar[{extra}]") from None


class ProcessingError(RuntimeError):
    """Processing failed although the input was right (exit status 1).

    Attributes
    ----------
    resumable : bool
        Whether the message says that the same command goes on with what was finished.
    """

    def __init__(self, message: str, resumable: bool = False) -> None:
        super().__init__(printable(message))
        self.resumable = resumable


def is_full(error: BaseException | None) -> bool:
    """Whether an error says that a disk is full or broken: the same command may succeed once it is not."""
    return isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EIO)


def is_closed(error: BaseException | None) -> bool:
    """Whether an error says that a place takes no files: of another user, or read-only."""
    return isinstance(error, OSError) and error.errno in (errno.EACCES, errno.EPERM, errno.EROFS)


def no_room(what: object, error: OSError) -> ProcessingError:
    """Make the error about a file or store for which a disk has no room."""
    remedy = "see to the disk" if error.errno == errno.EIO else "make room"
    return ProcessingError(f"{what} cannot be written ({error.strerror}); {remedy}, and give the same command again")


def is_final(error: BaseException) -> bool:
    """Whether an error says that the input is wrong, so that the same command meets it again.

    A file that could not be read may be readable later, and a folder usable.
    """
    again = isinstance(error, FolderError) or isinstance(error.__cause__, OSError)
    return isinstance(error, InputError) and not again


def unwritable(what: object, error: OSError) -> InputError | ProcessingError:
    """Make the error about a file or store that cannot be written: wrong input, unless the disk is full."""
    if is_full(error):
        return no_room(what, error)
    why = error.strerror or error
    return InputError(f"{what} cannot be written ({why}); choose another place, or make it writable")


class UnsupportedSystem(ImportError):
    """The operating system lacks what blocksar needs (exit status 2)."""
