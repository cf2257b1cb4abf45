"""The log: progress as JSON lines, for programs."""

from __future__ import annotations

import errno
import json
import math
import os
import stat
from collections.abc import Mapping
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from blocksar.errors import InputError

METADATA = ("zarr.json", ".zgroup", ".zarray")  # one of which each folder of a zarr store has


class Log:
    """Appends JSON objects (RFC 8259) to a file, one per line. A full disk costs lines, but does not stop the run.

    Raises
    ------
    InputError
        If the file cannot be written, or holds something else than a log.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = path
        self.trouble: str | None = None  # the first failure to write, if any
        if (store := _store_about(path)) is not None:
            raise InputError(f"--json-log {str(path)!r} lies in the store {str(store)!r}; give a file outside it")
        try:
            self._file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
        except (OSError, ValueError) as error:
            why = error.strerror if isinstance(error, OSError) else error
            raise InputError(f"--json-log {str(path)!r} cannot be written ({why}); give another file") from None
        self._regular = stat.S_ISREG(os.fstat(self._file).st_mode)
        if self._regular and not self._is_log():
            os.close(self._file)
            raise InputError(f"--json-log {str(path)!r} holds something else than a log; give another file")
        self._broken = self._regular and self._cut_short()

    def _is_log(self) -> bool:
        """Tell whether the file is empty or begins as JSON objects do: lines would spoil a scene or a picture."""
        with suppress(OSError), open(self.path, "rb") as file:
            return file.read(2) in (b"", b"{", b'{"')
        return True

    def _cut_short(self) -> bool:
        """Tell whether the last line is incomplete, as after a loss of power."""
        with suppress(OSError), open(self.path, "rb") as file:
            if file.seek(0, os.SEEK_END):
                file.seek(-1, os.SEEK_END)
                return file.read(1) != b"\n"
        return False

    def write(self, event: str, **facts: Any) -> None:
        """Append a line, whole or not at all. It takes no lock: other threads may have been stopped."""
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        text = json.dumps(_valid({"time": now, "event": event, **facts}), allow_nan=False)
        line = b"\n" * self._broken + text.encode() + b"\n"
        try:
            written = os.write(self._file, line)
            if written < len(line):
                self._broken = True
                if self._regular:
                    os.ftruncate(self._file, os.fstat(self._file).st_size - written)
                    self._broken = False
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            self._broken = False
        except OSError as error:
            self.trouble = self.trouble or f"{self.path} cannot be written ({error.strerror or error})"

    def close(self) -> None:
        with suppress(OSError):
            os.close(self._file)


def _store_about(path: str | Path) -> Path | None:
    """The zarr store that a path lies in; None if it lies in none. A log would be a stranger among its chunks."""
    with suppress(OSError, ValueError):
        folders = Path(os.path.realpath(path)).parents
        return next((each for each in folders if any((each / name).exists() for name in METADATA)), None)
    return None


def _valid(value: Any) -> Any:
    """Convert a value to one that JSON can hold: no NaN, no incomplete characters."""
    match value:
        case None | bool() | int():
            return value
        case float():
            return value if math.isfinite(value) else None
        case Mapping():
            return {str(name): _valid(item) for name, item in value.items()}
        case list() | tuple():
            return [_valid(item) for item in value]
        case _:
            return str(value).encode("utf-8", "backslashreplace").decode()
