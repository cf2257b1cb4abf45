"""Collections in the inbox."""

from __future__ import annotations

import os
from dataclasses import dataclass
from hashlib import blake2b

from blocksar.errors import InputError
from blocksar.places.local import LocalPlace
from blocksar.places.place import Place


@dataclass(frozen=True)
class Arrival:
    """A complete collection in the inbox. `written` (ns) is used for the order of arrivals only."""

    store: Place
    written: int

    @property
    def name(self) -> str:
        return self.store.name

    def fingerprint(self) -> str:
        """Hash of every file's name, size and version (time or tag); a damaged store has one as well.

        If what is hashed here changes, every finished collection counts as a new one.
        """
        digest = blake2b(digest_size=16)
        try:
            for file in sorted(self.store.files()):
                digest.update(os.fsencode(repr(file)))
        except OSError as error:  # a store that cannot be listed: the error stands for its contents
            digest.update(os.fsencode(str(error)))
        return digest.hexdigest()


def list_arrivals(inbox: Place) -> tuple[list[Arrival], list[str]]:
    """List the inbox: complete collections, oldest first, and the names of those without a zarr.json so far.

    Raises
    ------
    InputError
        If the inbox cannot be listed.
    """
    arrivals, waiting = [], []
    try:
        if isinstance(inbox, LocalPlace):
            os.scandir(inbox).close()  # a bucket without objects is empty, but a missing folder is an error
        names = [name for name in inbox.names() if name.endswith(".zarr") and not name.startswith(".")]
    except OSError as error:
        raise InputError(f"INBOX {inbox} cannot be listed ({error.strerror}); give a readable folder") from None
    for store in (inbox / name for name in names):
        try:
            arrivals.append(Arrival(store, _time_written(store / "zarr.json")))
        except (FileNotFoundError, NotADirectoryError):
            waiting.append(store.name)
        except OSError:  # `focus` reports the cause
            arrivals.append(Arrival(store, 0))
    return sorted(arrivals, key=lambda arrival: (arrival.written, arrival.name)), waiting


def _time_written(file: Place) -> int:
    """Modification time of a local file, ns; 0 for an object, as a bucket is processed in the order of names."""
    if isinstance(file, LocalPlace):
        return os.stat(file).st_mtime_ns
    if not file.exists():
        raise FileNotFoundError(file)
    return 0
