"""Owners of locks: the record that identifies a process, its description, and whether the process is alive."""

from __future__ import annotations

import json
import os
import socket
import sys
from datetime import UTC, datetime
from typing import Any

import psutil


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
    """When a process was started, s; on Linux after the boot: a clock that is set moves the time of day of both."""
    return process.create_time() - (psutil.boot_time() if sys.platform == "linux" else 0.0)
