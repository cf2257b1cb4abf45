"""Collections in the inbox, files of measured data that become some, and acquisitions of several."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from hashlib import blake2b
from typing import Any, NamedTuple

from blocksar import stores
from blocksar.errors import InputError
from blocksar.places.local import LocalPlace
from blocksar.places.place import Place
from blocksar.readers.registry import READERS, found_at

MANIFEST = ".acquisition.json"  # ending of a file of the inbox that lists the collections of an acquisition


class Part(NamedTuple):
    """What lies in the inbox, and its phase history: the same, or the store that is ingested from it."""

    source: Place
    store: Place

    @property
    def measured(self) -> bool:
        """Whether it is measured data that must be ingested."""
        return self.source is not self.store


@dataclass(frozen=True)
class Arrival:
    """A complete collection in the inbox, or several of one acquisition. `written` (ns) is used for the order only."""

    name: str
    parts: tuple[Part, ...]
    written: int

    @property
    def stores(self) -> list[Place]:
        """The phase histories; those of measured data are not there before these are ingested."""
        return [part.store for part in self.parts]

    @property
    def source(self) -> str:
        """The paths in the inbox, for people."""
        return ", ".join(str(part.source) for part in self.parts)

    @property
    def measured(self) -> list[Part]:
        """What must be ingested."""
        return [part for part in self.parts if part.measured]

    @property
    def gone(self) -> bool:
        """Whether something has been removed from the inbox since."""
        return not all(part.source.exists() for part in self.parts)

    def fingerprint(self) -> str:
        """Hash of every file's name, size and version (time or tag) in the inbox; a damaged store has one as well.

        If what is hashed here changes, every finished collection counts as a new one.
        """
        digest = blake2b(digest_size=16)
        try:
            for source, _ in self.parts:
                if len(self.parts) > 1:
                    digest.update(os.fsencode(f"{source.name}\n"))
                files = sorted(source.files()) or [("", 0, source.version())]
                for file in files:
                    digest.update(os.fsencode(repr(file)))
        except OSError as error:  # a store that cannot be listed: the error stands for its contents
            digest.update(os.fsencode(str(error)))
        return digest.hexdigest()


class Listing(NamedTuple):
    """What an inbox holds.

    Attributes
    ----------
    arrivals : list of Arrival
        Complete, oldest first.
    waiting : list of str
        Names of what is not complete so far.
    ignored : dict of str to str
        Name and reason of all else, which no sweep focuses; names that begin with a dot are not listed.
    """

    arrivals: list[Arrival]
    waiting: list[str]
    ignored: dict[str, str]


def list_inbox(inbox: Place, ingested: Callable[[str], Place], group: re.Pattern[str] | None = None) -> Listing:
    """List the inbox.

    Collections that a manifest lists, or from whose names `group` takes the same text, are one acquisition. It is
    complete when all of them are.

    Parameters
    ----------
    ingested : callable (name)
        Where the phase history of measured data lies, by the name that it has.

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
    stored = [name for name in found if name.endswith(".zarr")]
    for store in (inbox / name for name in stored):
        try:
            complete[store.name] = Arrival(store.name, (Part(store, store),), _time_written(store / "zarr.json"))
        except (FileNotFoundError, NotADirectoryError):
            waiting.append(store.name)
        except OSError:  # `focus` reports the cause
            complete[store.name] = Arrival(store.name, (Part(store, store),), 0)
    ignored = {}
    for other in (inbox / name for name in found if not name.endswith((".zarr", MANIFEST))):
        name = f"{other.name}.zarr"
        try:
            if (reason := _why_ignored(other, name in stored)) is None:
                complete[name] = Arrival(name, (Part(other, ingested(name)),), _time_written(other))
                continue
        except OSError as error:
            reason = f"it cannot be read ({error.strerror or error}); check its permissions"
        ignored[other.name] = reason
    names = [*complete, *waiting]
    manifests = [name for name in found if name.endswith(MANIFEST)]
    members = {_name(name.removesuffix(MANIFEST), names): _members(inbox / name) for name in manifests}
    members |= _by_pattern(
        [name for name in names if name not in {n for some in members.values() for n in some}], group
    )
    for name, some in members.items():
        if all(member in complete for member in some):
            arrivals = [complete[member] for member in some]
            joined = tuple(arrival.parts[0] for arrival in arrivals)
            complete[name] = Arrival(name, joined, max(arrival.written for arrival in arrivals))
        else:
            waiting.append(name)
    taken = {member for some in members.values() for member in some}
    arrivals = [arrival for name, arrival in complete.items() if name not in taken]
    return Listing(sorted(arrivals, key=lambda arrival: (arrival.written, arrival.name)), waiting, ignored)


def _why_ignored(what: Place, stored: bool) -> str | None:
    """Why a file or folder that is no store is not ingested; None if a reader takes it.

    Raises
    ------
    OSError
        If it cannot be read.
    """
    found = found_at(what)
    if found is None:
        return "it is no phase-history store NAME.zarr, and nothing in it is of a kind that is known"
    if found.reader is None or (found.file is not what and not READERS.get(found.reader).several):
        return f"it is no phase-history store NAME.zarr: {found.sentence(what)}"
    return f"{what.name}.zarr lies beside it and is taken; rename one of them" if stored else None


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
    """Modification time of a local file or folder, ns; 0 for an object: a bucket is processed in the order of names."""
    if isinstance(file, LocalPlace):
        return os.stat(file).st_mtime_ns
    if not file.exists():
        raise FileNotFoundError(file)
    return 0
