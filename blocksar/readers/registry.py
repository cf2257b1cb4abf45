"""Readers of formats, recognised by file contents; and the one writer of their phase histories."""

from __future__ import annotations

import os
import re
import shlex
import stat
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from numbers import Real
from typing import Annotated, Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from blocksar import stores
from blocksar.collection.collection import Collection
from blocksar.collection.raw_echo import RawEcho
from blocksar.errors import InputError
from blocksar.options import Option
from blocksar.places import Location, place, readable
from blocksar.places.local import LocalPlace
from blocksar.places.objects import ObjectPlace
from blocksar.places.place import Place
from blocksar.places.ranges import Readable
from blocksar.plugins import Registry
from blocksar.progress.listening import Callback
from blocksar.readers.kinds import NOTHING, OTHERS, SAFE_IMAGES, SCENE, START, Kind, Start
from blocksar.readers.reading import Ingested
from blocksar.stores import Piece
from blocksar.version import __version__

__all__ = ["READERS", "Described", "Piece", "Reader", "ReaderOptions", "Reading", "ingest", "stated_times"]

# ---------------------------------------------------------------- times as a user states them

LONGEST = 1e9  # s from the start of a collection to slow time 0: some 30 years


def stated_times(start: str | None, zero: float | None) -> dict[str, Any]:
    """Return `collection_start` and `time_zero` as a user gives them, for the attribute `source`; empty if not given.

    Parameters
    ----------
    start : str or None
        UTC in ISO 8601, such as 2008-08-19T14:03:21.5Z; without a zone it is taken for UTC.
    zero : float or None
        Seconds from the start to slow time 0.

    Raises
    ------
    InputError
        If the start is no date with a time, or the seconds are no number, or more than LONGEST.

    Examples
    --------
    >>> stated_times("2008-08-19T16:03:21.5+02:00", 3.25)
    {'collection_start': '2008-08-19T14:03:21.500000Z', 'time_zero': 3.25}
    """
    times: dict[str, Any] = {}
    if start is not None:
        start = str(start)
        try:
            if not ("T" in start or " " in start.strip()):
                raise ValueError
            moment = datetime.fromisoformat(start.strip())
            moment = (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).astimezone(UTC)
        except (ValueError, OverflowError):
            raise InputError(
                f"--collection-start {start!r} is not a date with a time; give UTC in ISO 8601, such as "
                "2008-08-19T14:03:21.5Z"
            ) from None
        times["collection_start"] = f"{moment:%Y-%m-%dT%H:%M:%S.%f}Z"
    if zero is not None:
        if not isinstance(zero, Real) or not abs(zero) <= LONGEST:
            raise InputError(
                f"--time-zero is {zero!r} s; give the seconds from --collection-start to slow time 0, "
                f"{LONGEST:g} at most"
            )
        times["time_zero"] = float(zero)
    return times


# ---------------------------------------------------------------- readers


@dataclass(frozen=True, kw_only=True)
class ReaderOptions:
    """Options of every reader; formats add fields. `blocksar.ingest_NAME` describes them in this form.

    Attributes
    ----------
    ground_height : float
        Height z of the imaged plane in the scene frame, m. Default: 0.
    """

    ground_height: Annotated[float, Option("Height z of the imaged plane in the scene frame.", metavar="M")] = 0.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Reading:
    """A phase history in files whose samples are still to be read.

    Attributes
    ----------
    collection : Collection
    pieces : callable ()
        Begins to give the samples, a piece at a time: range-frequency samples, or echoes over the fast time of `raw`.
        Pieces follow each other from pulse to pulse; whole chunks may be given again, with what is known better then.
        Those whose samples are a function are not read if an ingestion that ended early has written them.
    attributes : mapping
        Of the store: `source`, `georeference`, `polarization`, ... (`stores.contract`).
    messages : callable ()
        What was found, a sentence each; asked once all pieces were given.
    channels : tuple of str
        Names along a leading dimension of the samples; none by default.
    raw : RawEcho or None
        Fast time and chirp of echoes that are not range-compressed.
    parts : str
        Options with which less is read, for who has no room on the disk.
    notes : mapping of str to array
        What is noted in place while pieces are read, and later pieces or messages depend on. Default: nothing.
    """

    collection: Collection
    pieces: Callable[[], Iterable[Piece]]
    attributes: Mapping[str, Any]
    messages: Callable[[], Sequence[str]]
    channels: tuple[str, ...] = ()
    raw: RawEcho | None = None
    parts: str = ""
    notes: Mapping[str, NDArray[Any]] = field(default_factory=dict)

    @property
    def n_channel(self) -> int:
        return max(len(self.channels), 1)

    @property
    def n_byte(self) -> int:
        """Bytes of the samples on a disk."""
        return stores.history_bytes(self.collection, self.n_channel, self.raw)

    def group(self, origin: str, times: Mapping[str, Any]) -> stores.Group:
        """Group of the phase history, without its samples."""
        source = dict(self.attributes.get("source", {}))
        attributes = {
            **self.attributes,
            "source": {"time_zero": 0.0, **source, **times} if times else source,
            "history": stores.history_line(f"ingested by blocksar from {origin}"),
        }
        return stores.phase_history_group(self.collection, raw=self.raw, channels=self.channels, attrs=attributes)

    def samples(self, group: str) -> stores.Samples:
        return stores.Samples(
            variable="signal" if self.raw is None else "echo", n_pulse=self.collection.n_pulse,
            n_channel=len(self.channels), pieces=self.pieces, notes=self.notes, group=group,
        )  # fmt: skip


class Described(NamedTuple):
    """Description of files by `info`: kind, names and texts of a table, and the command that ingests them, as words.

    The rows of `attributes` and of a `collection` follow its own rows, and notes those.
    """

    kind: str
    rows: list[tuple[str, str]]
    command: list[str]
    attributes: Mapping[str, Any] = {}
    collection: Collection | None = None
    notes: Sequence[str] = ()


class Reader(Protocol):
    """A format of files.

    Attributes
    ----------
    summary : str
        The help of its command, `blocksar ingest NAME`, with the name under which it is registered: a sentence, and
        after an empty line more.
    example : str
        Its words after the name, for the help.
    source : (str, str)
        Metavar and help of its argument.
    several : bool
        Whether a collection may lie in several files.
    kind : Kind
        What such a file is, and the mark that tells it.
    options : type
        A model of `blocksar.options`, with the fields of `ReaderOptions`.
    """

    summary: str
    example: str
    source: tuple[str, str]
    several: bool
    kind: Kind
    options: type

    def read(self, sources: Sequence[Location], options: Any) -> Reading | Mapping[str, Reading]:
        """Read everything but the samples; of several collections in one frame, each by its name.

        Raises
        ------
        InputError
            If a file is damaged, not supported or contradicts itself, or files do not belong together.
        """

    def describe(self, files: Sequence[Readable], given: str) -> Described:
        """Describe files, `given` as a path or pattern of paths; reads no samples.

        Raises
        ------
        InputError
            As `read`.
        """


READERS: Registry[Reader] = Registry("blocksar.readers", "reader", {
    "cphd": "blocksar.readers.cphd.reader:CPHD",
    "crsd": "blocksar.readers.crsd:CRSD",
    "nisar": "blocksar.readers.nisar:NISAR",
    "palsar": "blocksar.readers.palsar:PALSAR",
    "gotcha": "blocksar.readers.gotcha:GOTCHA",
    "sentinel1": "blocksar.readers.sentinel1.level0:SENTINEL1",
})  # fmt: skip


def ingest(
    reader: Reader,
    sources: Sequence[Location],
    out: Location,
    options: Any,
    *,
    times: Mapping[str, Any] | None = None,
    overwrite: bool = False,
    begun: Callable[[int], object] | None = None,
    progress: Callback | None = None,
) -> Ingested:
    """Turn files into a store: a phase history, or several in one frame, a group for each by its name.

    An ingestion that ended early is gone on with by one of the same files, with the same options and version.

    Parameters
    ----------
    reader : Reader
    sources : sequence of path
    out : path, URL or Place
        Of the new store.
    options : object
        Of the reader's model.
    times : mapping, optional
        What `stated_times` gives, instead of the files' own.
    overwrite : bool
        Replace an existing store.
    begun, progress
        As for `write_pieces`.

    Raises
    ------
    InputError
        If `out` exists and overwrite is False, or does not fit the disk; if times are stated for several; or from the
        reader.
    """
    origin, stated = readable(sources[0]).name if len(sources) == 1 else f"{len(sources)} files", times or {}
    reading = reader.read(sources, options)
    readings = dict(reading) if isinstance(reading, Mapping) else {"": reading}
    if len(readings) == 1:
        readings = dict(zip([""], readings.values(), strict=True))
    elif stated:
        raise InputError(
            f"--collection-start and --time-zero are one collection's, and there are {len(readings)}; leave them out"
        )
    groups = {name: each.group(origin, stated) for name, each in readings.items()}
    target, (first, *_) = place(out), readings.values()
    identity = _identity([reader.kind.name, repr(options), *map(_state, sources)], groups)
    samples = [each.samples(name) for name, each in readings.items()]
    there = 0

    def fill(store: Place) -> None:
        nonlocal there
        there = stores.write_pieces(store, samples, identity=identity, begun=begun, progress=progress)

    stores.refuse_existing(target, overwrite=overwrite or isinstance(target, ObjectPlace))
    less = f"read a part ({first.parts})" if first.parts else ""
    stores.refuse_full(target, sum(each.n_byte for each in readings.values()), less, identity=identity)
    if "" in groups:
        alone = groups[""]._asdict()
        stores.create(target, **alone, sizes={}, overwrite=overwrite, fill=fill, identity=identity)
    else:
        stores.create_collections(target, groups, origin=origin, overwrite=overwrite, fill=fill, identity=identity)
    messages = [sentence for each in readings.values() for sentence in each.messages()]
    if there:
        messages.append(f"{there} of {sum(each.total for each in samples)} pulses kept from a call that ended early")
    return Ingested(
        path=target.path if isinstance(target, LocalPlace) else target, collection=first.collection, messages=messages
    )


def _state(source: Location) -> list[str]:
    """Name and state of a file, or of all files in a folder, which change when the content does."""
    where = readable(source)
    if isinstance(where, LocalPlace) and where.path.is_dir():
        return [os.path.abspath(where.path), *(f"{name} {size} {written}" for name, size, written in where.files())]
    name = os.path.abspath(where.path) if isinstance(where, LocalPlace) else str(where)
    return [name, where.version()]


def _identity(origin: Sequence[Any], groups: Mapping[str, stores.Group]) -> str:
    """Hash everything that samples and the data stored with them depend on."""
    held = {
        name: {
            "attributes": {key: value for key, value in group.attrs.items() if key != "history"},
            "arrays": {
                key: stores.checksum(np.asarray(values)) if np.asarray(values).dtype.kind in "biufc" else list(values)
                for key, values in {**group.coords, **group.variables}.items()
            },
        }
        for name, group in groups.items()
    }
    return stores.json_checksum([__version__, list(origin), held])


KEPT = 0.5  # of the requested pulses: fewer are hardly intended


def refuse_few(kept: int, of: int, cause: str, remedy: str) -> None:
    """Raise an InputError if fewer than half of the requested pulses would be kept."""
    if kept < KEPT * of:
        raise InputError(f"{cause}, which leaves {kept} of {of} pulses, less than half; {remedy}")


MOST_FILES = 64  # of a folder, that are looked at


class Found(NamedTuple):
    """Kind of a file or folder, and the file in it that shows the kind."""

    kind: Kind
    start: Start
    file: Readable

    @property
    def reader(self) -> str | None:
        """Name of the reader of this kind; None if there is none."""
        return next((name for name, reader in READERS.sound() if reader.kind is self.kind), None)

    def sentence(self, asked: Readable, given: str | None = None) -> str:
        """Name the kind and how to convert it to a phase history; `given` is the path as the user wrote it."""
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
    """Iterate over all kinds in the order in which they are tried."""
    yield from NOTHING
    for reader in READERS:
        yield reader.kind
    yield SCENE
    yield from OTHERS


def found_at(where: Readable) -> Found | None:
    """Recognise the kind of a file or folder by its first bytes; None if absent or unknown.

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
    """Find the first file in a folder that `ingest` reads, or else one of a known kind."""
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
    """Raise an InputError that names the kind of a file, unless it is the wanted one or nothing exists there.

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
