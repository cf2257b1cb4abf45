"""The folder for compiled loops where the package's own is not writable, and the time spent compiling."""

from __future__ import annotations

import os
import stat
import sys

VARIABLE = "NUMBA_CACHE_DIR"
MODULES = os.path.join(os.path.dirname(os.path.abspath(__file__)), "kernels")  # as other folders with loops


_spent = [0.0]


def note_compilation(seconds: float) -> None:
    """Count the seconds in which this process compiled loops, or waited for other processes to do so."""
    _spent[0] += seconds


def compilation_seconds() -> float:
    """Return the seconds counted by `note_compilation` since this process began."""
    return _spent[0]


def choose_cache() -> None:
    """Set NUMBA_CACHE_DIR for this process and those that it starts, unless it is set or loops are kept by the modules.

    numba defines no loop that it cannot keep. The folder is `blocksar` among the user's caches, or else one in the
    folder for temporary files.
    """
    package_cache = os.path.join(MODULES, "__pycache__")
    if os.environ.get(VARIABLE) or os.access(package_cache if os.path.isdir(package_cache) else MODULES, os.W_OK):
        return
    folder = _user_folder() or _temporary_folder()
    if folder is not None:
        os.environ[VARIABLE] = folder
        if (numba := sys.modules.get("numba")) is not None:  # it has read the variable already
            numba.config.CACHE_DIR = folder


def _user_folder() -> str | None:
    caches = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    folder = os.path.join(caches, "blocksar")
    try:
        os.makedirs(folder, exist_ok=True)
    except OSError:
        return None
    return folder if os.access(folder, os.W_OK) else None


def _temporary_folder() -> str | None:
    """Return a folder that no other user can write to, since the loops in it are executed; None if there is none.

    It has one name for each user, so that the next command finds the loops; where another owns that name, one for this
    process.
    """
    import atexit
    import shutil
    import tempfile

    user = os.getuid()
    try:
        folder = os.path.join(tempfile.gettempdir(), f"blocksar-{user}")
        try:
            os.mkdir(folder, 0o700)
        except FileExistsError:
            found = os.lstat(folder)
            if not stat.S_ISDIR(found.st_mode) or found.st_uid != user or found.st_mode & 0o022:
                folder = tempfile.mkdtemp(prefix="blocksar-")
                atexit.register(shutil.rmtree, folder, ignore_errors=True)
    except OSError:
        return None
    return folder
