"""Locks: records of the process that owns one, and locks by which processes of a machine divide work."""

from __future__ import annotations

import errno
import json
import os
import socket
import sys
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from functools import lru_cache
from typing import Any

import psutil

from blocksar.places.posix import fcntl


def this_process() -> dict[str, Any]:
    """Return the record that a lock held by this process contains."""
    return {
        "pid": os.getpid(),
        "host": socket.gethostname(),
        "process_started": _start_of(psutil.Process()),
        "since": f"{datetime.now(UTC):%Y-%m-%d %H:%M:%S} UTC",
    }


def describe_owner(owner: bytes) -> str:
    """Describe the owner that a lock's record names, for a message."""
    try:
        record = json.loads(owner)
        return f"process {record['pid']} on {record['host']} since {record['since']}"
    except (ValueError, KeyError, TypeError):
        return "another process"


def is_alive(owner: bytes) -> bool:
    """Return False only if the owner was a process of this machine and has ended; True if that is unknown."""
    try:
        record = json.loads(owner)
        if record["host"] != socket.gethostname():
            return True
        return bool(abs(_start_of(psutil.Process(record["pid"])) - record["process_started"]) < 1)
    except psutil.NoSuchProcess:
        return False
    except (ValueError, KeyError, TypeError):
        return True


def _start_of(process: psutil.Process) -> float:
    """Start of a process, s; on Linux since the boot, so that it does not change when the clock is set."""
    return process.create_time() - (psutil.boot_time() if sys.platform == "linux" else 0.0)


# ---------------------------------------------------------------- shared work

LOCK = "blocksar.lock"  # a file in each such folder


@contextmanager
def locked(folder: str, name: str, *, wait: bool) -> Iterator[None]:
    """Lock a part of the work whose results lie in a folder; without effect if files cannot be locked there.

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
    """Open the lock file, -1 if impossible; it stays open, since closing it would release all locks of this process."""
    try:
        os.makedirs(folder, exist_ok=True)
        return os.open(os.path.join(folder, LOCK), os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o644)
    except OSError:
        return -1
