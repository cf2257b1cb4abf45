"""Empty folders, in which all measurements start alike."""

from __future__ import annotations

import os
import time
from pathlib import Path

SETTLING = 5.0  # s


def empty_folder(path: Path) -> Path:
    """Make an empty folder in place of an old one and wait some seconds, so that all measurements start alike.

    A virtual machine returns freed memory to its host after a while; to get it back costs more than to write it.
    Whatever runs right after a deletion would be several times faster. The old files keep names elsewhere, without
    contents: ext4 takes no inode that was freed within a minute, and looks at each of them for every new file.
    """
    if path.exists():
        old = path.with_name(f"old-{time.monotonic_ns()}")
        path.rename(old)
        for file in old.rglob("*"):
            if file.is_file():
                os.truncate(file, 0)
    path.mkdir(parents=True)
    time.sleep(SETTLING)
    return path
