"""The two kinds of errors: the user's input is wrong, or processing failed."""

from __future__ import annotations


def printable(text: str) -> str:
    """Text that a terminal may be given: of what cannot be printed, lines excepted, the escape sequences."""
    return "".join(c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text)


class InputError(ValueError):
    """The user's input is wrong: one sentence with the field, the value and the remedy (exit status 2)."""

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))


class ProcessingError(RuntimeError):
    """Processing failed although the input was right (exit status 1)."""

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))
