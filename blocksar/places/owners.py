"""Who owns a lock: a process, described and looked for."""

from __future__ import annotations

import json
import os
import socket
from datetime import UTC, datetime
from typing import Any

import psutil

# ---------------------------------------------------------------- who holds a lock


def this_process() -> dict[str, Any]:
    return {
        "pid": os.getpid(),
        "host": socket.gethostname(),
        "process_started": psutil.Process().create_time(),
        "since": f"{datetime.now(UTC):%Y-%m-%d %H:%M:%S} UTC",
    }


def describe_owner(owner: bytes) -> str:
    try:
        found = json.loads(owner)
        return f"process {found['pid']} on {found['host']} since {found['since']}"
    except (ValueError, KeyError, TypeError):
        return "another process"


def is_alive(owner: bytes) -> bool:
    """False only for what is known to be dead: a process of this very machine."""
    try:
        found = json.loads(owner)
        if found["host"] != socket.gethostname():
            return True
        return bool(abs(psutil.Process(found["pid"]).create_time() - found["process_started"]) < 1)
    except psutil.NoSuchProcess:
        return False
    except (ValueError, KeyError, TypeError):
        return True
