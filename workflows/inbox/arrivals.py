"""Collections in the inbox, and acquisitions of several."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from hashlib import blake2b
from typing import Any

from blocksar import stores
from blocksar.errors import InputError
from blocksar.ingestion.readers import found_at
from blocksar.places.local import LocalPlace
from blocksar.places.place import Place

MANIFEST = ".acquisition.json"  # ending of a file of the inbox that lists the collections of an acquisition


@dataclass(frozen=True)
class Arrival:
    """A complete collection in the inbox, or several of one acquisition. `written` (ns) is used for the order only."""

    name: str
    stores: tuple[Place, ...]
    written: int

    @property
    def source(self) -> str:
        """The paths, for people."""
        return ", ".join(map(str, self.stores))

    @property
    def gone(self) -> bool:
        """Whether a collection has been removed since."""
        return not all(store.exists() for store in self.stores)

    def fingerprint(self) -> str:
        """Hash of every file's name, size and version (time or tag); a damaged store has one as well.

        If what is hashed here changes, every finished collection counts as a new one.
        """
        digest = blake2b(digest_size=16)
        try:
            for store in self.stores:
                if len(self.stores) > 1:
                    digest.update(os.fsencode(f"{store.name}\n"))
                for file in sorted(store.files()):
                    digest.update(os.fsencode(repr(file)))
        except OSError as error:  # a store that cannot be listed: the error stands for its contents
            digest.update(os.fsencode(str(error)))
        return digest.hexdigest()


def list_ignored(inbox: Place) -> dict[str, str]:
    """Name and reason of all else that lies in the inbox, which no sweep focuses; names that begin with a dot are not
    listed.

    Raises
    ------
    OSError
        If the inbox cannot be listed.
    """
    return {
        name: _why_ignored(inbox / name)
        for name in sorted(inbox.names())
        if not name.startswith(".") and not name.endswith((".zarr", MANIFEST))
    }


def _why_ignored(what: Place) -> str:
    found = None
    with suppress(OSError):
        found = found_at(what)
    if found is not None:
        return f"no phase-history store NAME.zarr: {found.sentence(what)}"
    return "no phase-history store NAME.zarr, nor of a kind that is known; rename it if it is one"


def list_arrivals(inbox: Place, group: re.Pattern[str] | None = None) -> tuple[list[Arrival], list[str]]:
    """List the inbox: complete collections, oldest first, and the names of what is not complete so far.

    Collections that a manifest lists, or from whose names `group` takes the same text, are one acquisition. It is
    complete when all of them are.

    Raises
    ------
    InputError
        If the inbox cannot be listed, or a manifest cannot be read.
    """
    complete: dict[str, Arrival] = {}
    waiting = []
    try:
        if isinstance(inbox, LocalPlace):
            os.scandir(inbox).close()  # a bucket without objects is empty, but a missing folder is an error
        found = [name for name in inbox.names() if not name.startswith(".")]
    except OSError as error:
        raise InputError(f"INBOX {inbox} cannot be listed ({error.strerror}); give a readable folder") from None
    names = [name for name in found if name.endswith(".zarr")]
    for store in (inbox / name for name in names):
        try:
            complete[store.name] = Arrival(store.name, (store,), _time_written(store / "zarr.json"))
        except (FileNotFoundError, NotADirectoryError):
            waiting.append(store.name)
        except OSError:  # `focus` reports the cause
            complete[store.name] = Arrival(store.name, (store,), 0)
    manifests = [name for name in found if name.endswith(MANIFEST)]
    members = {_name(name.removesuffix(MANIFEST), names): _members(inbox / name) for name in manifests}
    members |= _by_pattern(
        [name for name in names if name not in {n for some in members.values() for n in some}], group
    )
    for name, some in members.items():
        if all(member in complete for member in some):
            arrivals = [complete[member] for member in some]
            joined = tuple(arrival.stores[0] for arrival in arrivals)
            complete[name] = Arrival(name, joined, max(arrival.written for arrival in arrivals))
        else:
            waiting.append(name)
    taken = {member for some in members.values() for member in some}
    arrivals = [arrival for name, arrival in complete.items() if name not in taken]
    return sorted(arrivals, key=lambda arrival: (arrival.written, arrival.name)), waiting


def _members(manifest: Place) -> Sequence[str]:
    """Names of the collections that a manifest lists.

    Raises
    ------
    InputError
        If it does not list any.
    """
    value: Any = stores.read_json(manifest)
    names = value.get("collections") if isinstance(value, dict) else None
    if not isinstance(names, list) or not names or not all(isinstance(n, str) and n.endswith(".zarr") for n in names):
        raise InputError(f'{manifest} lists no collections; write {{"collections": ["NAME.zarr", ...]}}')
    return names


def _by_pattern(names: Sequence[str], group: re.Pattern[str] | None) -> dict[str, list[str]]:
    """Acquisitions of several collections from whose names a pattern takes the same text, by that text."""
    if group is None:
        return {}
    members: dict[str, list[str]] = {}
    for name in sorted(names):
        if (match := group.fullmatch(name.removesuffix(".zarr"))) is not None:
            members.setdefault(match[1] if group.groups else match[0], []).append(name)
    return {_name(text, names): some for text, some in members.items() if len(some) > 1}


def _name(text: str, names: Sequence[str]) -> str:
    """Name of an acquisition, which no collection has."""
    return f"{text}.zarr" if f"{text}.zarr" not in names else f"{text}.all.zarr"


def _time_written(file: Place) -> int:
    """Modification time of a local file, ns; 0 for an object, as a bucket is processed in the order of names."""
    if isinstance(file, LocalPlace):
        return os.stat(file).st_mtime_ns
    if not file.exists():
        raise FileNotFoundError(file)
    return 0
