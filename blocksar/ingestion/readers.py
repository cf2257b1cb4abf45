"""Readers: what turns files of one format into phase histories, and the one writer of their stores."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any, NamedTuple, Protocol

import numpy as np

from blocksar import stores
from blocksar.arrays import ComplexArray
from blocksar.chunks import TILE
from blocksar.collection.collection import Collection
from blocksar.collection.raw_echo import RawEcho
from blocksar.errors import InputError
from blocksar.ingestion.kinds import Kind
from blocksar.ingestion.reading import Ingested
from blocksar.options import Option
from blocksar.places import Location, place, readable
from blocksar.places.local import LocalPlace
from blocksar.places.place import REMEDY, Place, check_room
from blocksar.places.ranges import Readable
from blocksar.plugins import Registry
from blocksar.progress.listening import Callback


@dataclass(frozen=True, kw_only=True)
class ReaderOptions:
    """Options of every reader; those of a format have more fields.

    Attributes
    ----------
    ground_height : float
        z of the imaged plane in the scene frame, m.
    """

    ground_height: Annotated[float, Option("Height z of the imaged plane in the scene frame.", metavar="M")] = 0.0


class Piece(NamedTuple):
    """Samples (n_pulse, n_column) complex64 of some pulses of a channel; NaN where a pulse is missing."""

    channel: int
    pulses: slice
    samples: ComplexArray


@dataclass(frozen=True, kw_only=True, eq=False)
class Reading:
    """A phase history in files, of which the samples are still to be read.

    Attributes
    ----------
    collection : Collection
    pieces : callable ()
        Begins to read the samples, a piece at a time: range-frequency samples, or echoes over the fast time of `raw`.
        Pieces follow each other from pulse to pulse; whole chunks may be given again, with what is known better then.
    attributes : mapping
        Of the store: `source`, `georeference`, `polarization`, ... (`stores.schema`).
    messages : callable ()
        What was found, a sentence each; asked once all pieces were given.
    channels : tuple of str
        Names along a leading dimension of the samples; none by default.
    raw : RawEcho or None
        Fast time and chirp of echoes that are not range-compressed.
    parts : str
        Options with which less is read, for who has no room on the disk.
    """

    collection: Collection
    pieces: Callable[[], Iterable[Piece]]
    attributes: Mapping[str, Any]
    messages: Callable[[], Sequence[str]]
    channels: tuple[str, ...] = ()
    raw: RawEcho | None = None
    parts: str = ""


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
        """Read all but the samples; of several collections in one frame, each by its name.

        Raises
        ------
        InputError
            If a file is damaged, not supported or contradicts itself, or files do not belong together.
        """

    def describe(self, files: Sequence[Readable], given: str) -> Described:
        """Say what files hold, `given` as a path or as a pattern of paths; reads no samples.

        Raises
        ------
        InputError
            As `read`.
        """


READERS: Registry[Reader] = Registry("blocksar.readers", "reader", {
    "cphd": "blocksar.ingestion.cphd.reader:CPHD",
    "crsd": "blocksar.ingestion.crsd.reader:CRSD",
    "nisar": "blocksar.ingestion.nisar.reader:NISAR",
    "palsar": "blocksar.ingestion.palsar.reader:PALSAR",
    "gotcha": "blocksar.ingestion.gotcha.reader:GOTCHA",
    "sentinel1": "blocksar.ingestion.sentinel1.reader:SENTINEL1",
})  # fmt: skip


def ingest(
    reader: Reader,
    sources: Sequence[Location],
    out: Location,
    options: Any,
    *,
    times: Mapping[str, Any] | None = None,
    overwrite: bool = False,
    progress: Callback | None = None,
) -> Ingested:
    """Turn files into a phase history, by `read` of a reader and `store`.

    Raises
    ------
    InputError
        As these.
    """
    origin = readable(sources[0]).name if len(sources) == 1 else f"{len(sources)} files"
    reading = reader.read(sources, options)
    if isinstance(reading, Mapping):
        if len(reading) > 1:
            return store_several(reading, out, origin=origin, times=times, overwrite=overwrite, progress=progress)
        (reading,) = reading.values()
    return store(reading, out, origin=origin, times=times, overwrite=overwrite, progress=progress)


def store_several(
    readings: Mapping[str, Reading],
    out: Location,
    *,
    origin: str,
    times: Mapping[str, Any] | None = None,
    overwrite: bool = False,
    progress: Callback | None = None,
) -> Ingested:
    """Write phase histories in one frame into one store, a group for each by its name; else as `store`.

    Raises
    ------
    InputError
        As `store`; or if times are stated, which would be those of all.
    """
    if times:
        raise InputError(
            f"--collection-start and --time-zero are one collection's, and there are {len(readings)}; leave them out"
        )
    target = place(out)
    total = sum(each.collection.n_pulse * max(len(each.channels), 1) for each in readings.values())
    needed = sum(
        stores.history_bytes(each.collection, max(len(each.channels), 1), each.raw) for each in readings.values()
    )
    parts = next(iter(readings.values())).parts
    check_room(target, needed, f"make room, choose another place, or read a part ({parts})" if parts else REMEDY)

    def fill(whole: Place) -> None:
        done = 0
        for name, reading in readings.items():
            told = None if progress is None else partial(_told, progress, done, total)
            store(replace(reading, parts=""), whole / name, origin=origin, progress=told)
            done += reading.collection.n_pulse * max(len(reading.channels), 1)

    stores.create_collections(target, tuple(readings), origin=origin, overwrite=overwrite, fill=fill)
    return Ingested(
        path=target.path if isinstance(target, LocalPlace) else target,
        collection=next(iter(readings.values())).collection,
        messages=[sentence for reading in readings.values() for sentence in reading.messages()],
    )  # fmt: skip


def _told(progress: Callback, before: int, total: int, done: int, _: int) -> None:
    progress(before + done, total)


def store(
    reading: Reading,
    out: Location,
    *,
    origin: str,
    times: Mapping[str, Any] | None = None,
    overwrite: bool = False,
    progress: Callback | None = None,
) -> Ingested:
    """Write a phase history that a reader has begun to read, a piece at a time.

    Parameters
    ----------
    reading : Reading
    out : path, URL or Place
        Of the new store.
    origin : str
        What it is made from, for its history.
    times : mapping, optional
        What `stated_times` gives, instead of the files' own.
    overwrite : bool
        Replace an existing store.
    progress : callable (done, total)
        Called after each piece, with numbers of pulses.

    Raises
    ------
    InputError
        If `out` exists and overwrite is False, or does not fit the disk; or from the reader.
    """
    target, collection, names = place(out), reading.collection, reading.channels
    if reading.parts:
        less = f"read a part ({reading.parts})"
        stores.refuse_full(target, collection, max(len(names), 1), less, raw=reading.raw)
    source = dict(reading.attributes.get("source", {}))
    attributes = {
        **reading.attributes,
        "source": {"time_zero": 0.0, **source, **times} if times else source,
        "history": stores.history_line(f"ingested by blocksar from {origin}"),
    }
    name = "signal" if reading.raw is None else "echo"
    total = collection.n_pulse * max(len(names), 1)

    def fill(place: Place) -> None:
        done = 0
        for piece in _by_chunks(reading.pieces(), collection.n_pulse):
            columns = slice(0, piece.samples.shape[1])
            if names:
                region: tuple[slice, ...] = (slice(piece.channel, piece.channel + 1), piece.pulses, columns)
                stores.write_region(place, name, region, piece.samples[None])
            else:
                stores.write_region(place, name, (piece.pulses, columns), piece.samples)
            now = piece.channel * collection.n_pulse + piece.pulses.stop
            if progress is not None and now > done:
                progress(now, total)
            done = max(done, now)

    stores.create_phase_history(
        target, collection, raw=reading.raw, channels=names, attrs=attributes, overwrite=overwrite, fill=fill
    )
    return Ingested(
        path=target.path if isinstance(target, LocalPlace) else target, collection=collection,
        messages=list(reading.messages()),
    )  # fmt: skip


def _by_chunks(pieces: Iterable[Piece], n_pulse: int) -> Iterator[Piece]:
    """Cut samples into pieces that end where chunks of the store do."""
    rest: Piece | None = None
    for channel, pulses, samples in pieces:
        first, last = pulses.start if rest is None else rest.pulses.start, pulses.stop
        joined = samples if rest is None else np.concatenate([rest.samples, samples])
        whole = last if last == n_pulse else max(last - last % TILE[0], first)
        if whole > first:
            yield Piece(channel, slice(first, whole), joined[: whole - first])
        rest = Piece(channel, slice(whole, last), joined[whole - first :]) if last > whole else None
