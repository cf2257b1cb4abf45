"""Locks by which the processes of a machine divide work: each locks the part that it does."""

from __future__ import annotations

import errno
import os
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache

from blocksar.places.posix import fcntl

LOCK = "blocksar.lock"  # a file in each such folder


@contextmanager
def locked(folder: str, name: str, *, wait: bool) -> Iterator[None]:
    """Keep other processes from a part of the work that has its results in a folder; where files have no locks, do not.

    Raises
    ------
    BlockingIOError
        If another process holds the lock, without `wait`.
    """
    place = zlib.crc32(name.encode())  # a byte of the file, which need not exist, for each part
    descriptor = _open_lock(folder)
    try:
        if descriptor >= 0:
            fcntl.lockf(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB), 1, place)
    except OSError as error:
        if not wait and error.errno in (errno.EAGAIN, errno.EACCES):
            raise BlockingIOError(error.errno, f"another process does {name}") from None
        descriptor = -1
    try:
        yield
    finally:
        if descriptor >= 0:
            fcntl.lockf(descriptor, fcntl.LOCK_UN, 1, place)


@lru_cache(maxsize=16)
def _open_lock(folder: str) -> int:
    """A descriptor, -1 where there is none; it stays open: to close it would end all locks that this process holds."""
    try:
        os.makedirs(folder, exist_ok=True)
        return os.open(os.path.join(folder, LOCK), os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o644)
    except OSError:
        return -1
