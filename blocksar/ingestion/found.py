"""Kinds of what lies at a place, told by its first bytes, and what reads it."""

from __future__ import annotations

import os
import re
import shlex
import stat
from collections.abc import Iterator
from contextlib import suppress
from typing import NamedTuple

from blocksar.errors import InputError
from blocksar.ingestion.kinds import NOTHING, OTHERS, SAFE_IMAGES, SCENE, START, Kind, Start
from blocksar.ingestion.readers import READERS
from blocksar.places.local import LocalPlace
from blocksar.places.ranges import Readable

MOST_FILES = 64  # of a folder, that are looked at


class Found(NamedTuple):
    """Kind of what lies at a place, and the file that shows it, if that is in a folder."""

    kind: Kind
    start: Start
    file: Readable

    @property
    def reader(self) -> str | None:
        """The name of what reads it, if anything does."""
        return next((name for name, reader in READERS.sound() if reader.kind is self.kind), None)

    def sentence(self, asked: Readable, given: str | None = None) -> str:
        """Say what it is, and what leads from there to a phase history; `given` is the path as the user gave it."""
        path = given if given is not None and self.file is asked else str(self.file)
        plain = re.sub(r"\.(gz|z|bz2|xz|zst|lz4)$", "", path, flags=re.IGNORECASE)
        stem = self.file.name.partition(".")[0] or "phase_history"
        fields = {
            "path": shlex.quote(path), "store": shlex.quote(f"{stem}.zarr"),
            "plain": shlex.quote(plain if plain != path else f"{path}.unpacked"),
        }  # fmt: skip
        name = self.kind.name.format(detail=self.kind.detail(self.start))
        what = f"{self.file} is {name}; {self.kind.remedy.format(**fields)}"
        return what if self.file is asked else f"{asked} is a folder, no phase history: {what}"


def _kinds() -> Iterator[Kind]:
    """All kinds, in the order in which they are tried."""
    yield from NOTHING
    for reader in READERS:
        yield reader.kind
    yield SCENE
    yield from OTHERS


def found_at(where: Readable) -> Found | None:
    """Tell what lies at a place from first bytes; None if nothing does, or nothing that can be told.

    Raises
    ------
    OSError
        If it cannot be read.
    """
    if isinstance(where, LocalPlace):
        if where.path.is_dir():
            return _in_folder(where)
        if not where.path.exists() or not stat.S_ISREG(os.stat(where.path).st_mode):
            return None
    try:
        with where.open() as file:
            data = file.read(START + 1)
    except FileNotFoundError:
        return None
    start = Start(where.name, data[:START], len(data) <= START)
    return Found(next(kind for kind in _kinds() if kind.mark(start)), start, where)


def _in_folder(folder: LocalPlace) -> Found | None:
    """Find what a folder holds: the first file that `ingest` reads, or else of which the kind is known."""
    names = folder.names()
    if "manifest.safe" in names and "_RAW_" not in folder.name:
        return Found(SAFE_IMAGES, Start(folder.name, b"", whole=True), folder)
    seen: list[Found] = []
    for name in names[:MOST_FILES]:
        file = folder / name
        with suppress(OSError):  # of others that can be read
            if not file.path.is_dir() and (found := found_at(file)) is not None:
                seen.append(found)
    seen.sort(key=lambda found: (found.reader is None, found.kind.beside))
    return seen[0] if seen and not seen[0].kind.beside else None


def refuse_others(where: Readable, wanted: Kind) -> None:
    """Raise an InputError that says what lies at a place, unless it is of that kind, or nothing lies there.

    Raises
    ------
    InputError
        If it is of another kind, or no regular file.
    OSError
        If it cannot be read.
    """
    found = found_at(where)
    if found is not None and (found.kind is not wanted or found.file is not where):
        raise InputError(found.sentence(where))
    if found is None and isinstance(where, LocalPlace) and where.path.exists():
        raise InputError(f"{where} is no regular file; give the path of {wanted.name}")
