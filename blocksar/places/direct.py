"""Files of samples, written and read past the page cache where the file system supports it.

A run writes each sample once and reads it at most once more. Copies in the page cache would fill the machine's memory,
take a third of all processor time where memory comes from a hypervisor, and all wait to be flushed when the run ends.
Direct transfers need aligned memory, so samples pass through a small aligned buffer, one for each thread.

Files that are read again soon, and that take little of the memory, may stay in the page cache: they are read while the
disk still writes them.
"""

from __future__ import annotations

import errno
import mmap
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from blocksar.constants import MIB
from blocksar.places.posix import fcntl

ALIGNMENT = 4096  # bytes: a multiple of every disk's sectors
BUFFER = 2 * MIB
DIRECT = getattr(os, "O_DIRECT", 0)  # Linux's


class _Buffers(threading.local):
    """Page-aligned buffers, one for each thread.

    In one huge page, where the system has them: a transfer of hundreds of scattered pages is split into several
    requests to the disk, and takes half as long again.
    """

    def __init__(self) -> None:
        buffer = mmap.mmap(-1, BUFFER, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        if hasattr(mmap, "MADV_HUGEPAGE"):
            with suppress(OSError):
                buffer.madvise(mmap.MADV_HUGEPAGE)
        self.view = memoryview(buffer)


_buffers = _Buffers()


def _open(path: str, flags: int, *, cached: bool = False) -> int:
    """Open a file for direct transfers; for cached ones if `cached`, or if the file system has no direct ones."""
    if cached:
        return os.open(path, flags | os.O_CLOEXEC, 0o666)
    try:
        return os.open(path, flags | DIRECT | os.O_CLOEXEC, 0o666)
    except OSError as error:
        if error.errno != errno.EINVAL or not DIRECT:
            raise
    return os.open(path, flags | os.O_CLOEXEC, 0o666)


def _without_direct(descriptor: int) -> None:
    """Switch a file to cached transfers, which need no alignment."""
    if DIRECT:
        fcntl.fcntl(descriptor, fcntl.F_SETFL, fcntl.fcntl(descriptor, fcntl.F_GETFL) & ~DIRECT)


class Writer:
    """A new file that is written from its beginning to its end."""

    def __init__(self, descriptor: int, buffer: memoryview) -> None:
        self._descriptor, self._buffer = descriptor, buffer
        self._filled = 0

    def write(self, data: memoryview | bytes) -> None:
        """Append bytes.

        Raises
        ------
        OSError
            If they cannot be written.
        """
        source = memoryview(data).cast("B")
        while len(source):
            n = min(len(source), BUFFER - self._filled)
            self._buffer[self._filled : self._filled + n] = source[:n]
            self._filled, source = self._filled + n, source[n:]
            if self._filled == BUFFER:
                self._flush(0, BUFFER)
                self._filled = 0

    def _flush(self, first: int, last: int) -> None:
        """Write a part of the buffer."""
        left = self._buffer[first:last]
        while len(left):
            try:
                left = left[os.write(self._descriptor, left) :]
            except OSError as error:
                if error.errno != errno.EINVAL:
                    raise
                _without_direct(self._descriptor)
                left = left[os.write(self._descriptor, left) :]

    def finish(self) -> None:
        """Write the rest: whole sectors, and the remainder of the last one through the page cache.

        To write that sector as a whole and cut the file takes longer: the system reads it again for the cut.
        """
        whole = self._filled - self._filled % ALIGNMENT
        self._flush(0, whole)
        if whole != self._filled:
            _without_direct(self._descriptor)
            self._flush(whole, self._filled)


def _begin_to_flush(descriptor: int) -> None:
    """Start writing a file's cached pages to the disk, which the system would otherwise delay.

    Linux does so on the advice that the cache is not needed: it drops only what is on the disk already.
    """
    if hasattr(os, "posix_fadvise"):
        with suppress(OSError):
            os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)


@contextmanager
def writing(path: str, *, cached: bool = False) -> Iterator[Writer]:
    """Create a file that one thread at a time writes; through the page cache if `cached`.

    Raises
    ------
    OSError
        If it cannot be created or written.
    """
    descriptor = _open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, cached=cached)
    try:
        writer = Writer(descriptor, _buffers.view)
        yield writer
        writer.finish()
        if cached:
            _begin_to_flush(descriptor)
    finally:
        os.close(descriptor)


class DirectReader:
    """A file whose parts are read in ascending order."""

    def __init__(self, descriptor: int, buffer: memoryview) -> None:
        self._descriptor, self._buffer = descriptor, buffer
        self._place = self._first = self._last = 0  # where to read next, and the part of the file in the buffer

    def fileno(self) -> int:
        return self._descriptor

    def seek(self, place: int) -> None:
        """Let the next part begin at this byte."""
        self._place = place

    def readinto(self, target: memoryview) -> int:
        """Fill `target`; returns the number of bytes, fewer at the end of the file.

        Raises
        ------
        OSError
            If the file cannot be read.
        """
        target, done = target.cast("B"), 0
        while done < len(target):
            if not self._first <= self._place < self._last:
                self._fill(len(target) - done)
                if self._place >= self._last:
                    break
            start = self._place - self._first
            n = min(len(target) - done, self._last - self._place)
            target[done : done + n] = self._buffer[start : start + n]
            done, self._place = done + n, self._place + n
        return done

    def _fill(self, wanted: int) -> None:
        """Read the part of the file from the next byte on into the buffer, `wanted` bytes if it holds as many."""
        self._first = self._place - self._place % ALIGNMENT
        end = -(-(self._place + wanted) // ALIGNMENT) * ALIGNMENT
        part = self._buffer[: min(end - self._first, BUFFER)]
        try:
            n = os.preadv(self._descriptor, [part], self._first)
        except OSError as error:
            if error.errno != errno.EINVAL:
                raise
            _without_direct(self._descriptor)
            n = os.preadv(self._descriptor, [part], self._first)
        self._last = self._first + n


@contextmanager
def reading(path: str) -> Iterator[DirectReader]:
    """Open a file to read parts of it in ascending order.

    Raises
    ------
    OSError
        If it cannot be opened.
    """
    descriptor = _open(path, os.O_RDONLY)
    try:
        yield DirectReader(descriptor, _buffers.view)
    finally:
        with suppress(OSError):
            os.close(descriptor)
