"""Functions of POSIX that blocksar uses: locks of files, and limits and use of resources.

Importing this module on another system raises `UnsupportedSystem`, in one sentence.
"""

from __future__ import annotations

from blocksar.errors import UnsupportedSystem

try:
    import fcntl
    import resource
except ModuleNotFoundError as error:
    raise UnsupportedSystem(
        f"this system has no {error.name}, which locks and workers need; use Linux or macOS, or on Windows the Windows "
        "Subsystem for Linux (WSL)"
    ) from None

__all__ = ["fcntl", "resource"]
