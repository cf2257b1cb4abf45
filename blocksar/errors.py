"""The two kinds of errors: wrong input by the user, and failed processing."""

from __future__ import annotations


def printable(text: str) -> str:
    """Escape the characters that a terminal cannot print, except line breaks."""
    return "".join(c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text)


class InputError(ValueError):
    """The user's input is wrong; the message states field, value and remedy in one sentence (exit status 2)."""

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))


class ProcessingError(RuntimeError):
    """Processing failed although the input was valid (exit status 1)."""

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))
