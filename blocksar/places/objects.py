"""Places in an object store (S3), and its errors as OSError."""

from __future__ import annotations

import errno
import json
import os
import re
import secrets
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime, timedelta
from functools import lru_cache
from typing import TYPE_CHECKING, Any, BinaryIO

from blocksar.errors import changes_while_read
from blocksar.places.locks import describe_owner, is_alive, this_process
from blocksar.places.place import Held, Place
from blocksar.places.ranges import in_ranges

if TYPE_CHECKING:
    from obstore.store import S3Store
    from zarr.storage import StorePath

LEASE = 60.0  # s: a lock that has not been renewed for this long has lost its owner
RETRIES = 5  # attempts to repeat a request if the object store is overloaded or unreachable
PATIENCE = 30.0  # s, for all attempts together
REQUEST = "20s"  # timeout of one attempt


@dataclass(frozen=True)
class ObjectPlace(Place):
    """An object, or all objects below a prefix. An object is written as a whole or not at all."""

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
                obstore.head(open_bucket(self.bucket), self.key)
                return True
            except FileNotFoundError:
                return bool(self.names())

    def names(self) -> list[str]:
        import obstore

        with os_errors(self):
            listing = obstore.list_with_delimiter(open_bucket(self.bucket), self.key or None)
        paths = [*listing["common_prefixes"], *(entry["path"] for entry in listing["objects"])]
        return sorted({path.rstrip("/").rpartition("/")[2] for path in paths})

    def files(self) -> Iterator[tuple[str, int, str]]:
        import obstore

        first = len(self.key) + 1 if self.key else 0
        with os_errors(self):
            for page in obstore.list(open_bucket(self.bucket), self.key or None):
                for entry in page:
                    yield entry["path"][first:], entry["size"], str(entry["e_tag"])

    def version(self) -> str:
        import obstore

        with suppress(FileNotFoundError), os_errors(self):
            entry = obstore.head(open_bucket(self.bucket), self.key)
            return f"{entry['size']} {entry['e_tag']}"
        return ""

    def open(self) -> BinaryIO:
        import obstore

        with os_errors(self):
            found = obstore.head(open_bucket(self.bucket), self.key)

        def fetch(start: int, stop: int) -> bytes:
            options: Any = {"range": (start, stop), "if_match": found["e_tag"]}
            try:
                with os_errors(self):
                    return bytes(obstore.get(open_bucket(self.bucket), self.key, options=options).bytes())
            except FileExistsError as error:  # what `os_errors` makes of a tag that does not match
                raise changes_while_read(self) from error

        return in_ranges(int(found["size"]), fetch)

    def read_bytes(self) -> bytes:
        import obstore

        with os_errors(self):
            return bytes(obstore.get(open_bucket(self.bucket), self.key).bytes())

    def write_bytes(self, data: bytes) -> None:
        import obstore

        with os_errors(self):
            obstore.put(open_bucket(self.bucket), self.key, data)

    def remove(self) -> None:
        import obstore

        with os_errors(self):
            below = [f"{self.key}/{name}" if self.key else name for name, _, _ in self.files()]
            for first in range(0, len(below), 1000):
                obstore.delete(open_bucket(self.bucket), below[first : first + 1000])
            if self.key:
                with suppress(FileNotFoundError):
                    obstore.delete(open_bucket(self.bucket), self.key)

    def sweep(self) -> None:
        pass  # objects have no temporary names

    def settle(self) -> None:
        pass  # an object store keeps what it has acknowledged

    def zarr_path(self) -> StorePath:
        from blocksar.places.zarr_paths import of_objects

        return of_objects(open_bucket(self.bucket), self.key)

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Hold the lock by an object that is created only if there is none, and renewed while its owner lives."""
        owner = json.dumps(this_process() | {"token": secrets.token_hex(8)}).encode()
        tag = self._acquire(owner)
        ended = threading.Event()
        renewal = threading.Thread(target=self._renew, args=(owner, tag, ended), name="lock", daemon=True)
        renewal.start()
        try:
            yield
        finally:
            ended.set()
            renewal.join()
            with suppress(OSError):
                if self._current()[2] == owner:  # unless another process has taken over an expired lock
                    self.remove()

    def _acquire(self, owner: bytes) -> str:
        for _ in range(RETRIES):
            with suppress(FileExistsError):
                return self._put(owner, "create")
            try:
                tag, renewed, holder = self._current()
            except FileNotFoundError:
                continue  # released just now
            if holder == owner:  # written by an earlier attempt, whose reply was lost
                return tag
            if is_alive(holder) and self._now() - renewed < timedelta(seconds=LEASE):
                raise Held(describe_owner(holder))
            with suppress(FileExistsError):
                return self._put(owner, {"e_tag": tag})
        raise Held("another process, at this moment")

    def _renew(self, owner: bytes, tag: str, ended: threading.Event) -> None:
        while not ended.wait(LEASE / 4):
            # If the endpoint is unreachable, try again until the lease expires and another process may take it.
            with suppress(OSError):
                tag = self._put(owner, {"e_tag": tag})

    def _put(self, owner: bytes, mode: Any) -> str:
        import obstore

        with os_errors(self):
            result = obstore.put(open_bucket(self.bucket), self.key, owner, mode=mode)
        return str(result["e_tag"])

    def _current(self) -> tuple[str, datetime, bytes]:
        """Return the lock's version, when it was last renewed, and its owner."""
        import obstore

        with os_errors(self):
            response = obstore.get(open_bucket(self.bucket), self.key)
            return str(response.meta["e_tag"]), response.meta["last_modified"], bytes(response.bytes())

    def _now(self) -> datetime:
        """Return the time by the object store's clock, which dates its objects."""
        import obstore

        probe = f"{self.key}.{secrets.token_hex(4)}"
        with os_errors(self):
            obstore.put(open_bucket(self.bucket), probe, b"")
            now = obstore.head(open_bucket(self.bucket), probe)["last_modified"]
            obstore.delete(open_bucket(self.bucket), probe)
        return now


@lru_cache(maxsize=64)
def open_bucket(bucket: str) -> S3Store:
    """Return the bucket's client; there is one per bucket, so that its connections are reused."""
    from obstore.store import S3Store

    plain = os.environ.get("AWS_ENDPOINT_URL", "").startswith("http://")  # plain HTTP only on request
    return S3Store(
        bucket,
        client_options={"timeout": REQUEST, "connect_timeout": "5s", "allow_http": plain},
        retry_config={"max_retries": RETRIES, "retry_timeout": timedelta(seconds=PATIENCE)},
    )


@contextmanager
def os_errors(where: Place) -> Iterator[None]:
    """Raise errors of the object store as the OSError that a file system would raise, with a message of one line."""
    if not isinstance(where, ObjectPlace):
        yield
        return
    from obstore import exceptions

    try:
        yield
    except exceptions.AlreadyExistsError as error:
        raise FileExistsError(errno.EEXIST, "it exists already", str(where)) from error
    except exceptions.PreconditionError as error:
        raise FileExistsError(errno.EEXIST, "another process has written it", str(where)) from error
    except FileNotFoundError as error:
        if error.errno is not None:
            raise  # already converted
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
        if re.search(
            r"//169\.254\.|/latest/(api|meta-data)", text
        ):  # the metadata service, asked only without credentials in the environment
            what = "there are no credentials for it, neither in the environment nor from the machine"
            raise PermissionError(errno.EACCES, what, str(where)) from error
        if "403 Forbidden" in text or "401 Unauthorized" in text:  # listing raises no specific error for this
            raise PermissionError(errno.EACCES, "the object store refuses these credentials", str(where)) from error
        if "error sending request" in text:
            endpoint = os.environ.get("AWS_ENDPOINT_URL", "AWS")
            raise OSError(errno.EHOSTUNREACH, f"the object store at {endpoint} does not answer", str(where)) from error
        sentence = " ".join(re.sub(r"<[^>]*>", " ", text.split("\n\nDebug source:", maxsplit=1)[0]).split())
        raise OSError(errno.EIO, sentence[:300], str(where)) from error
