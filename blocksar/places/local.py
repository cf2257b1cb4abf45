"""Places in a local file system, and the temporary names used to replace files atomically."""

from __future__ import annotations

import ctypes
import errno
import json
import os
import re
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Literal

from blocksar.errors import is_final
from blocksar.places.locks import describe_owner, this_process
from blocksar.places.place import Held, Place
from blocksar.places.posix import fcntl

if TYPE_CHECKING:
    from zarr.storage import StorePath


def _allocated(status: os.stat_result) -> int:
    return 512 * status.st_blocks


@dataclass(frozen=True)
class LocalPlace(Place):
    """A file or folder; os and pathlib accept it as a path."""

    path: Path

    def __fspath__(self) -> str:
        return str(self.path)

    def __str__(self) -> str:
        return str(self.path)

    @property
    def name(self) -> str:
        return self.path.name

    def __truediv__(self, name: str) -> LocalPlace:
        return LocalPlace(self.path / name)

    def exists(self) -> bool:
        return os.path.lexists(self.path)

    def names(self) -> list[str]:
        with suppress(FileNotFoundError, NotADirectoryError):
            return sorted(os.listdir(self.path))
        return []

    def _found(self) -> Iterator[tuple[str, os.stat_result]]:
        """Paths of files, in order; links that lead nowhere, and files removed meanwhile, are skipped."""
        for parent, folders, names in os.walk(self.path):
            folders.sort()
            for name in sorted(names):
                file = os.path.join(parent, name)
                with suppress(OSError):
                    yield file, os.stat(file)

    def files(self) -> Iterator[tuple[str, int, str]]:
        for file, status in self._found():
            yield os.path.relpath(file, self.path), status.st_size, str(status.st_mtime_ns)

    def written_after(self, file: Place) -> Iterator[str]:
        if isinstance(file, LocalPlace):
            time = os.stat(file.path).st_mtime_ns
            yield from (name for name, _, written in self.files() if int(written) > time)

    def version(self) -> str:
        with suppress(FileNotFoundError, NotADirectoryError):
            return file_version(os.stat(self.path))
        return ""

    def open(self) -> BinaryIO:
        return open(self.path, "rb")

    def read_bytes(self) -> bytes:
        return self.path.read_bytes()

    def write_bytes(self, data: bytes) -> None:
        os.makedirs(self.path.parent, exist_ok=True)
        with replacing_file(self.path) as part:
            Path(part).write_bytes(data)
            flush_file(part)

    def remove(self) -> None:
        if self.path.is_dir() and not self.path.is_symlink():
            with suppress(FileNotFoundError):
                shutil.rmtree(self.path)
        else:
            self.path.unlink(missing_ok=True)

    def sweep(self) -> None:
        for parent, folders, names in os.walk(self.path):
            for name in [n for n in folders if is_temporary(n)]:
                folders.remove(name)
                shutil.rmtree(os.path.join(parent, name), ignore_errors=True)
            for name in filter(is_temporary, names):
                with suppress(OSError):
                    os.unlink(os.path.join(parent, name))

    def free(self) -> int | None:
        with suppress(OSError):
            there = next(path for path in (self.path, *self.path.absolute().parents) if path.exists())
            return shutil.disk_usage(there).free
        return None

    def taken(self) -> int:
        if self.path.is_file():
            return _allocated(os.stat(self.path))
        return sum({(status.st_dev, status.st_ino): _allocated(status) for _, status in self._found()}.values())

    def settle(self) -> None:
        descriptor = os.open(self.path, os.O_RDONLY)
        try:
            # syncfs flushes this file system only; it exists on Linux alone.
            flush = getattr(ctypes.CDLL(None, use_errno=True), "syncfs", None)
            if flush is None:
                os.sync()
            elif flush(descriptor) != 0:
                number = ctypes.get_errno()
                raise OSError(number, os.strerror(number), str(self.path))
        finally:
            os.close(descriptor)

    def zarr_path(self) -> StorePath:
        from blocksar.places.zarr_paths import of_folder

        return of_folder(self.path)

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Hold the file by the kernel's lock, which ends with its process, however that ends."""
        descriptor = self._flock()
        try:
            with suppress(OSError):  # a full disk: the lock holds all the same
                os.ftruncate(descriptor, 0)
                os.write(descriptor, json.dumps(this_process()).encode())
            yield
        finally:
            with suppress(OSError):
                os.unlink(self.path)
            os.close(descriptor)

    def _flock(self) -> int:
        while True:
            descriptor = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                # The last owner may have removed the file after it was opened here: such a lock excludes nobody.
                if os.path.samestat(os.fstat(descriptor), os.stat(self.path)):
                    return descriptor
            except FileNotFoundError:
                pass
            except OSError as error:
                owner = os.pread(descriptor, 4096, 0)
                os.close(descriptor)
                if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
                    raise Held(describe_owner(owner)) from None
                raise
            os.close(descriptor)


def file_version(status: os.stat_result) -> str:
    """Return size and time of modification, as `Place.version` does."""
    return f"{status.st_size} {status.st_mtime_ns}"


@contextmanager
def held_part(
    path: str | os.PathLike[str], make: Callable[[str], object], *, begun: Callable[[str], bool] = lambda part: False
) -> Iterator[str]:
    """Make a file or folder under a temporary, locked name beside `path`; it is removed unless it was renamed.

    It is locked meanwhile, so that `sweep_beside` tells it from what killed processes have left, which goes first. What
    is `begun` (part) is taken instead of a new one, and stays if the block fails, unless that is final.
    """
    left = sweep_beside(path, spare=begun)
    part, descriptor = next(((part, lock) for part in left if (lock := _lock_abandoned(part)) is not None), ("", None))
    sweep_beside(path)
    while descriptor is None:
        part = temporary_name(path, "part")
        make(part)
        descriptor = _hold(part)
    stays = False
    try:
        yield part
    except BaseException as error:
        stays = not is_final(error) and begun(part)
        raise
    finally:
        if not stays:
            shutil.rmtree(part, ignore_errors=True)
            with suppress(OSError):
                os.unlink(part)
        os.close(descriptor)


def new_file(path: str) -> None:
    """Create an empty file, which must not exist yet."""
    with open(path, "xb"):
        pass


def _hold(part: str) -> int | None:
    """Lock a new file or folder, and return its descriptor; None if another process has taken it for abandoned."""
    try:
        descriptor = os.open(part, os.O_RDONLY | os.O_CLOEXEC)
    except FileNotFoundError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
        held = os.path.samestat(os.fstat(descriptor), os.stat(part))
    except (BlockingIOError, FileNotFoundError):
        held = False
    except OSError:  # a file system without locks, where nothing is swept
        held = True
    if held:
        return descriptor
    os.close(descriptor)
    return None


def sweep_beside(path: str | os.PathLike[str], *, spare: Callable[[str], bool] = lambda part: False) -> list[str]:
    """Remove temporary files and folders of `path` that killed processes left, except those to be spared.

    What was moved out of the way of `path` stays while nothing has its name. Returns what was spared.
    """
    folder, name = os.path.split(os.path.abspath(path))
    spared: list[str] = []
    with suppress(OSError):
        names = [other for other in os.listdir(folder) if is_temporary(other)]
        for other in names:
            if _whole(other) == _shortened(name) and (other.endswith(".part") or os.path.lexists(path)):
                _remove_abandoned(os.path.join(folder, other), spare, spared)
        for other in names:  # parts of parts
            part = _whole(other)
            ours = is_temporary(part) and _whole(part) == _shortened(name)
            if ours and not os.path.lexists(os.path.join(folder, part)):
                _remove_abandoned(os.path.join(folder, other), spare, spared)
    return spared


def _remove_abandoned(part: str, spare: Callable[[str], bool], spared: list[str]) -> None:
    """Remove a file or folder unless a living process holds it, or it is to be spared."""
    descriptor = _lock_abandoned(part)
    if descriptor is None:
        return
    with suppress(OSError):
        try:
            if spare(part):
                spared.append(part)
            else:
                LocalPlace(Path(part)).remove()
        finally:
            os.close(descriptor)


def _lock_abandoned(part: str) -> int | None:
    """Lock what a killed process has left, and return its descriptor; None if a living one holds it, or it is gone."""
    try:
        descriptor = os.open(part, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.path.samestat(os.fstat(descriptor), os.stat(part)):
            return descriptor
    except OSError:  # held by another process, or on a file system without locks
        pass
    os.close(descriptor)
    return None


def flush_file(path: str | os.PathLike[str]) -> None:
    """Flush a file to the disk, so that it survives a loss of power under the name that it gets next."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def replacing_file(path: str | os.PathLike[str]) -> Iterator[str]:
    """Yield a temporary name beside `path`: renamed to `path` if the block succeeds, removed if it fails."""
    part = temporary_name(path, "part")
    try:
        yield part
        os.replace(part, path)
    finally:
        with suppress(OSError):
            os.unlink(part)


def temporary_name(path: str | os.PathLike[str], kind: Literal["part", "old"]) -> str:
    """Return an unused name beside `path`, of the form that `Place.sweep` removes."""
    folder, name = os.path.split(path)
    return os.path.join(folder, f".{_shortened(name)}.{secrets.token_hex(4)}.{kind}")


def _shortened(name: str) -> str:
    """Shorten a name for its temporary names, since file systems limit the length of names."""
    return os.fsdecode(os.fsencode(name)[:200])


def _whole(temporary: str) -> str:
    """Return the (shortened) name that a temporary name was made from."""
    return temporary[1:].rsplit(".", 2)[0]


def is_temporary(name: str) -> bool:
    """Tell whether a name has the form that `temporary_name` gives."""
    return re.fullmatch(r"\..*\.[0-9a-f]{8}\.(part|old)", name, re.DOTALL) is not None
