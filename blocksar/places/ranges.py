"""Files read in parts: on a disk, in an object store, or on a web server."""

from __future__ import annotations

import errno
import io
import re
import time
import urllib.error
import urllib.request
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from http.client import HTTPException
from typing import TYPE_CHECKING, BinaryIO, cast

from blocksar.constants import MIB
from blocksar.errors import InputError, changes_while_read, printable

if TYPE_CHECKING:
    from http.client import HTTPResponse

AHEAD = MIB  # bytes: least that one request fetches
RETRIES = 4  # of a request that a web server does not answer, or puts off
PAUSE = 0.5  # s before the first of them; doubled before each
REQUEST = 30.0  # s without any answer


class Readable(ABC):
    """A file that can be read in parts. All methods raise OSError if reading fails."""

    def __format__(self, spec: str) -> str:
        """Format the name for messages: printable, on one line."""
        return printable(str(self)).replace("\n", "\\n")

    @property
    @abstractmethod
    def name(self) -> str:
        """The last part of the name."""

    @abstractmethod
    def open(self) -> BinaryIO:
        """Open the file; only the parts that are read are fetched."""

    @abstractmethod
    def version(self) -> str:
        """Return size and version of a file: a text that changes when it is written; empty if there is none."""


class Ranges(io.RawIOBase):
    """A file whose parts are fetched by one request each: `fetch(start, stop)` returns these bytes."""

    def __init__(self, size: int, fetch: Callable[[int, int], bytes]) -> None:
        super().__init__()
        self._size, self._fetch, self._place = size, fetch, 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self._place = offset + (0, self._place, self._size)[whence]
        return self._place

    def tell(self) -> int:
        return self._place

    def readinto(self, buffer: object) -> int:
        target = memoryview(cast("bytearray", buffer)).cast("B")
        count = max(min(len(target), self._size - self._place), 0)
        if count:
            data = self._fetch(self._place, self._place + count)
            if len(data) != count:
                raise OSError(errno.EIO, f"{len(data)} bytes came instead of {count}")
            target[:count] = data
            self._place += count
        return count


def in_ranges(size: int, fetch: Callable[[int, int], bytes]) -> BinaryIO:
    """Open a file of `size` bytes whose parts `fetch(start, stop)` gets, with some read-ahead."""
    return cast("BinaryIO", io.BufferedReader(Ranges(size, fetch), AHEAD))


@dataclass(frozen=True)
class WebFile(Readable):
    """A file on a web server that sends parts of it (HTTP range requests)."""

    url: str

    def __str__(self) -> str:
        return self.url.partition("?")[0]  # what follows may be a signature, which no message repeats

    @property
    def name(self) -> str:
        return str(self).rstrip("/").rpartition("/")[2]

    def open(self) -> BinaryIO:
        return in_ranges(self._found[0], self._fetch)

    def version(self) -> str:
        return "{} {}".format(*self._found)

    @cached_property
    def _found(self) -> tuple[int, str]:
        """Size and version."""
        return self._get(0, 1)[0]

    def _fetch(self, start: int, stop: int) -> bytes:
        found, data = self._get(start, stop)
        if found != self._found:
            raise changes_while_read(self)
        return data

    def _get(self, start: int, stop: int) -> tuple[tuple[int, str], bytes]:
        """Request bytes start .. stop - 1: (size, version) of the file and the bytes; retried if the server is busy."""
        request = urllib.request.Request(self.url, headers={"Range": f"bytes={start}-{stop - 1}"})
        for attempt in range(RETRIES + 1):
            try:
                with urllib.request.urlopen(request, timeout=REQUEST) as reply:
                    return self._whole(reply), reply.read()
            except urllib.error.HTTPError as error:
                if error.code == 416:  # Range Not Satisfiable: there is no first byte
                    raise InputError(f"{self} is empty; get it again") from error
                if error.code < 500 or attempt == RETRIES:
                    raise _as_os_error(error, self) from error
            except (urllib.error.URLError, TimeoutError, ConnectionError, HTTPException) as error:
                if attempt == RETRIES:
                    why = getattr(error, "reason", error)
                    raise OSError(errno.EHOSTUNREACH, f"the server does not answer: {why}", str(self)) from error
            time.sleep(PAUSE * 2**attempt)
        raise AssertionError  # the last attempt returns or raises

    def _whole(self, reply: HTTPResponse) -> tuple[int, str]:
        """Read size and version of the whole file from the headers of a reply."""
        total = re.fullmatch(r"bytes \d+-\d+/(\d+)", reply.headers.get("Content-Range", ""))
        if total is None:
            raise InputError(f"{self} is on a server that sends no parts of files; download it, and give the file")
        return int(total[1]), reply.headers.get("ETag") or reply.headers.get("Last-Modified") or ""


def _as_os_error(error: urllib.error.HTTPError, file: WebFile) -> OSError:
    if error.code in (404, 410):
        return FileNotFoundError(errno.ENOENT, "it does not exist", str(file))
    if error.code in (401, 403):
        return PermissionError(
            errno.EACCES,
            f"the server refuses: {error.code} {error.reason}; ask for a link that is still valid",
            str(file),
        )
    return OSError(errno.EIO, f"the server says {error.code} {error.reason}", str(file))
