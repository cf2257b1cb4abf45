"""Where stores and runs lie: a folder of a local file system, or a prefix of an object store (s3://bucket/prefix).

A place is a name, as a path is: making one touches nothing. What both kinds can do is what a run needs: bytes that
are the old ones or the new ones and never half of either, a list of what lies below, removal, a lock that tells a
living owner from a dead one. Chunks of arrays go through zarr, or, locally, straight into files (`stores`).

Credentials and endpoint of an object store are read where its users keep them, in the environment: AWS_ACCESS_KEY_ID,
AWS_SECRET_ACCESS_KEY, AWS_SESSION_TOKEN, AWS_REGION, AWS_ENDPOINT_URL; or from the machine that it runs on.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import json
import os
import re
import secrets
import shutil
import socket
import threading
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import psutil

from blocksar.parameters import InputError, printable

if TYPE_CHECKING:
    from obstore.store import S3Store
    from zarr.storage import StorePath

LEASE = 60.0  # seconds: the lock of an object store that has not been renewed for so long has lost its owner
RETRIES = 5  # of a request to an object store that is overloaded or out of reach
PATIENCE = 30.0  # seconds over all of them
REQUEST = "20s"  # of one


class Held(Exception):
    """A lock has a living owner, who is described."""

    def __init__(self, owner: str) -> None:
        super().__init__(owner)


class Place(ABC):
    """A store, a run or a file in either. All methods raise OSError where reading or writing fails."""

    def __format__(self, spec: str) -> str:
        """In messages, as one line."""
        return printable(str(self)).replace("\n", "\\n")

    @property
    @abstractmethod
    def name(self) -> str:
        """The last part."""

    @abstractmethod
    def __truediv__(self, name: str) -> Place:
        """What lies below under a name, or under names with '/' between."""

    @abstractmethod
    def exists(self) -> bool:
        """Whether a file or a folder is there; an object store has a folder where something lies below."""

    @abstractmethod
    def names(self) -> list[str]:
        """What lies right below, files and folders, sorted; nothing where there is no folder."""

    @abstractmethod
    def files(self) -> Iterator[tuple[str, int, str]]:
        """All files below: name relative to here, bytes, and a version that changes when the file is written."""

    @abstractmethod
    def read_bytes(self) -> bytes:
        """Of a file."""

    @abstractmethod
    def write_bytes(self, data: bytes) -> None:
        """Put a file here, on the disk when this returns: whoever reads it finds the old one or the new one."""

    @abstractmethod
    def remove(self) -> None:
        """Remove the file or folder; nothing happens where there is none."""

    @abstractmethod
    def sweep(self) -> None:
        """Remove what killed processes left behind below: temporary names."""

    @abstractmethod
    def settle(self) -> None:
        """Return once all that was written below is on the disk, whatever happens to the power."""

    @abstractmethod
    def zarr_path(self) -> StorePath:
        """The same for zarr: a store of its, and a path in it."""

    @abstractmethod
    @contextmanager
    def lock(self) -> Iterator[None]:
        """Hold this file as a lock; it is gone afterwards. The lock of a dead process is no lock.

        Raises
        ------
        Held
            If a living process has it.
        """


Location = str | os.PathLike[str] | Place  # what people give: a path, the URL of an object store, or a place


def place(path: Location) -> Place:
    """A path, or the URL of an object store, as a place.

    Raises
    ------
    InputError
        If a URL names no bucket, or what reads it is not installed.
    """
    if isinstance(path, Place):
        return path
    text = os.fspath(path)
    if "\0" in text:
        raise InputError(f"{text} is no name: it has a zero byte")
    if (found := re.fullmatch(r"s3://([^/]*)/*(.*?)/*", text, re.DOTALL)) is None:
        return LocalPlace(Path(os.path.abspath(text)))
    if not found[1]:
        raise InputError(f"{text} names no bucket; give s3://bucket/name")
    if any(part in ("", ".", "..") for part in found[2].split("/")) and found[2]:
        raise InputError(f"{text} is no plain name below a bucket; leave out empty parts, '.' and '..'")
    try:
        import obstore  # noqa: F401  (asked for here, where a sentence can be made of it)
    except ModuleNotFoundError:
        raise InputError(f"{text} needs obstore, which is not installed; install blocksar[s3]") from None
    return ObjectPlace(found[1], found[2])


# ---------------------------------------------------------------- local


@dataclass(frozen=True)
class LocalPlace(Place):
    """A file or folder. It is itself a path: os and pathlib take it."""

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

    def files(self) -> Iterator[tuple[str, int, str]]:
        for parent, folders, names in os.walk(self.path):
            folders.sort()
            for name in sorted(names):
                file = os.path.join(parent, name)
                status = os.stat(file)
                yield os.path.relpath(file, self.path), status.st_size, str(status.st_mtime_ns)

    def read_bytes(self) -> bytes:
        return self.path.read_bytes()

    def write_bytes(self, data: bytes) -> None:
        os.makedirs(self.path.parent, exist_ok=True)
        with replacing_file(self.path) as part, open(part, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())

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

    def settle(self) -> None:
        descriptor = os.open(self.path, os.O_RDONLY)
        try:
            # syncfs is Linux's own: of this file system alone.
            flush = getattr(ctypes.CDLL(None, use_errno=True), "syncfs", None)
            if flush is None:
                os.sync()
            elif flush(descriptor) != 0:
                number = ctypes.get_errno()
                raise OSError(number, os.strerror(number), str(self.path))
        finally:
            os.close(descriptor)

    def zarr_path(self) -> StorePath:
        from zarr.storage import LocalStore, StorePath

        return StorePath(LocalStore(self.path))  # by name it would take '://' and '::' for URLs

    @contextmanager
    def lock(self) -> Iterator[None]:
        """The kernel's own lock: it goes with its process, however that ends."""
        descriptor = self._flock()
        try:
            with suppress(OSError):  # a full disk: it is a lock all the same
                os.ftruncate(descriptor, 0)
                os.write(descriptor, json.dumps(_owner()).encode())
            yield
        finally:
            with suppress(OSError):
                os.unlink(self.path)
            os.close(descriptor)

    def _flock(self) -> int:
        while True:
            descriptor = os.open(self.path, os.O_RDWR | os.O_CREAT, 0o666)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                # Its last owner may have removed the file after it was opened here: that lock locks nothing.
                if os.path.samestat(os.fstat(descriptor), os.stat(self.path)):
                    return descriptor
            except FileNotFoundError:
                pass
            except OSError as error:
                owner = os.pread(descriptor, 4096, 0)
                os.close(descriptor)
                if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
                    raise Held(_describe(owner)) from None
                raise
            os.close(descriptor)


@contextmanager
def replacing_file(path: str | os.PathLike[str]) -> Iterator[str]:
    """A temporary name beside `path`, renamed to it when the block ends well, removed when it does not."""
    part = temporary(path, "part")
    try:
        yield part
        os.replace(part, path)
    finally:
        with suppress(OSError):
            os.unlink(part)


def temporary(path: str | os.PathLike[str], kind: str) -> str:
    """A name beside `path` that nobody has, and that `Place.sweep` knows: kind is part or old."""
    folder, name = os.path.split(path)
    # The name is there for people: a long one must not make this longer than a file system takes.
    short = os.fsdecode(os.fsencode(name)[:200])
    return os.path.join(folder, f".{short}.{secrets.token_hex(4)}.{kind}")


def is_temporary(name: str) -> bool:
    """Whether `temporary` gave it."""
    return re.fullmatch(r"\..*\.[0-9a-f]{8}\.(part|old)", name, re.DOTALL) is not None


# ---------------------------------------------------------------- object stores


@dataclass(frozen=True)
class ObjectPlace(Place):
    """An object, or all objects below a prefix. An object is put as a whole or not at all."""

    bucket: str
    key: str

    def __str__(self) -> str:
        return f"s3://{self.bucket}/{self.key}"

    @property
    def name(self) -> str:
        return self.key.rpartition("/")[2]

    def __truediv__(self, name: str) -> ObjectPlace:
        return ObjectPlace(self.bucket, f"{self.key}/{name}" if self.key else name)

    def exists(self) -> bool:
        import obstore

        with os_errors(self):
            try:
                obstore.head(_bucket(self.bucket), self.key)
                return True
            except FileNotFoundError:
                return bool(self.names())

    def names(self) -> list[str]:
        import obstore

        with os_errors(self):
            found = obstore.list_with_delimiter(_bucket(self.bucket), self.key or None)
        paths = [*found["common_prefixes"], *(entry["path"] for entry in found["objects"])]
        return sorted({path.rstrip("/").rpartition("/")[2] for path in paths})

    def files(self) -> Iterator[tuple[str, int, str]]:
        import obstore

        first = len(self.key) + 1 if self.key else 0
        with os_errors(self):
            for page in obstore.list(_bucket(self.bucket), self.key or None):
                for entry in page:
                    yield entry["path"][first:], entry["size"], str(entry["e_tag"])

    def read_bytes(self) -> bytes:
        import obstore

        with os_errors(self):
            return bytes(obstore.get(_bucket(self.bucket), self.key).bytes())

    def write_bytes(self, data: bytes) -> None:
        import obstore

        with os_errors(self):
            obstore.put(_bucket(self.bucket), self.key, data)

    def remove(self) -> None:
        import obstore

        with os_errors(self):
            below = [f"{self.key}/{name}" if self.key else name for name, _, _ in self.files()]
            for first in range(0, len(below), 1000):
                obstore.delete(_bucket(self.bucket), below[first : first + 1000])
            if self.key:
                with suppress(FileNotFoundError):
                    obstore.delete(_bucket(self.bucket), self.key)

    def sweep(self) -> None:
        pass  # nothing has a temporary name

    def settle(self) -> None:
        pass  # what an object store has acknowledged, it keeps

    def zarr_path(self) -> StorePath:
        from zarr.storage import ObjectStore, StorePath

        return StorePath(ObjectStore(_bucket(self.bucket)), self.key)

    @contextmanager
    def lock(self) -> Iterator[None]:
        """An object that is created only where none is, and renewed while its owner lives."""
        owner = json.dumps(_owner() | {"token": secrets.token_hex(8)}).encode()
        tag = self._acquire(owner)
        ended = threading.Event()
        renewed = threading.Thread(target=self._renew, args=(owner, tag, ended), name="lock", daemon=True)
        renewed.start()
        try:
            yield
        finally:
            ended.set()
            renewed.join()
            with suppress(OSError):
                if self._current()[2] == owner:  # not somebody else's, who took it for dead
                    self.remove()

    def _acquire(self, owner: bytes) -> str:
        for _ in range(RETRIES):
            with suppress(FileExistsError):
                return self._put(owner, "create")
            try:
                tag, when, found = self._current()
            except FileNotFoundError:
                continue  # given back in this moment
            if found == owner:  # put here by a request whose answer was lost, and that was sent again
                return tag
            if _alive(found) and self._now() - when < timedelta(seconds=LEASE):
                raise Held(_describe(found))
            with suppress(FileExistsError):
                return self._put(owner, {"e_tag": tag})
        raise Held("somebody else, this very moment")

    def _renew(self, owner: bytes, tag: str, ended: threading.Event) -> None:
        while not ended.wait(LEASE / 4):
            # An endpoint out of reach: tried again, until the lease is over and somebody else may have it.
            with suppress(OSError):
                tag = self._put(owner, {"e_tag": tag})

    def _put(self, owner: bytes, mode: Any) -> str:
        import obstore

        with os_errors(self):
            done = obstore.put(_bucket(self.bucket), self.key, owner, mode=mode)
        return str(done["e_tag"])

    def _current(self) -> tuple[str, datetime, bytes]:
        import obstore

        with os_errors(self):
            found = obstore.get(_bucket(self.bucket), self.key)
            return str(found.meta["e_tag"]), found.meta["last_modified"], bytes(found.bytes())

    def _now(self) -> datetime:
        """By the object store's clock, which dates its objects."""
        import obstore

        probe = f"{self.key}.{secrets.token_hex(4)}"
        with os_errors(self):
            obstore.put(_bucket(self.bucket), probe, b"")
            when = obstore.head(_bucket(self.bucket), probe)["last_modified"]
            obstore.delete(_bucket(self.bucket), probe)
        return when


@lru_cache(maxsize=64)
def _bucket(bucket: str) -> S3Store:
    """One client a bucket: its connections are used again and again."""
    from obstore.store import S3Store

    plain = os.environ.get("AWS_ENDPOINT_URL", "").startswith("http://")  # asked for by name
    return S3Store(
        bucket,
        client_options={"timeout": REQUEST, "connect_timeout": "5s", "allow_http": plain},
        retry_config={"max_retries": RETRIES, "retry_timeout": timedelta(seconds=PATIENCE)},
    )


@contextmanager
def os_errors(where: Place) -> Iterator[None]:
    """What an object store answers, as the OSError that a file system would raise; one line of it."""
    if not isinstance(where, ObjectPlace):
        yield
        return
    from obstore import exceptions

    try:
        yield
    except exceptions.AlreadyExistsError as error:
        raise FileExistsError(errno.EEXIST, "it exists already", str(where)) from error
    except exceptions.PreconditionError as error:
        raise FileExistsError(errno.EEXIST, "somebody else has written it", str(where)) from error
    except FileNotFoundError as error:
        if error.errno is not None:
            raise  # it has been through here
        what = "the bucket does not exist" if "NoSuchBucket" in str(error) else "it does not exist"
        raise FileNotFoundError(errno.ENOENT, what, str(where)) from error
    except (exceptions.PermissionDeniedError, exceptions.UnauthenticatedError, PermissionError) as error:
        if isinstance(error, OSError) and error.errno is not None:
            raise
        raise PermissionError(errno.EACCES, "the object store refuses these credentials", str(where)) from error
    except exceptions.BaseError as error:
        text = str(error)
        if "NoSuchBucket" in text:
            raise FileNotFoundError(errno.ENOENT, "the bucket does not exist", str(where)) from error
        if re.search(r"//169\.254\.|/latest/(api|meta-data)", text):  # what it asks where the environment says nothing
            what = "there are no credentials for it, neither in the environment nor from the machine"
            raise PermissionError(errno.EACCES, what, str(where)) from error
        if "403 Forbidden" in text or "401 Unauthorized" in text:  # of a list, which has no error of its own for this
            raise PermissionError(errno.EACCES, "the object store refuses these credentials", str(where)) from error
        if "error sending request" in text:
            endpoint = os.environ.get("AWS_ENDPOINT_URL", "AWS")
            raise OSError(errno.EHOSTUNREACH, f"the object store at {endpoint} does not answer", str(where)) from error
        sentence = " ".join(re.sub(r"<[^>]*>", " ", text.split("\n\nDebug source:", maxsplit=1)[0]).split())
        raise OSError(errno.EIO, sentence[:300], str(where)) from error


# ---------------------------------------------------------------- who holds a lock


def _owner() -> dict[str, Any]:
    return {
        "pid": os.getpid(),
        "host": socket.gethostname(),
        "process_started": psutil.Process().create_time(),
        "since": f"{datetime.now(UTC):%Y-%m-%d %H:%M:%S} UTC",
    }


def _describe(owner: bytes) -> str:
    try:
        found = json.loads(owner)
        return f"process {found['pid']} on {found['host']} since {found['since']}"
    except (ValueError, KeyError, TypeError):
        return "another process"


def _alive(owner: bytes) -> bool:
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
