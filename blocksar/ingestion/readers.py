"""Readers: what turns files of one format into phase histories, and the one writer of their stores."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from blocksar import stores
from blocksar.collection.collection import Collection
from blocksar.collection.raw_echo import RawEcho
from blocksar.errors import InputError
from blocksar.ingestion.kinds import Kind
from blocksar.ingestion.reading import Ingested
from blocksar.options import Option
from blocksar.places import Location, place, readable
from blocksar.places.local import LocalPlace
from blocksar.places.objects import ObjectPlace
from blocksar.places.place import Place
from blocksar.places.ranges import Readable
from blocksar.plugins import Registry
from blocksar.progress.listening import Callback
from blocksar.stores import Piece
from blocksar.version import __version__

__all__ = ["READERS", "Described", "Piece", "Reader", "ReaderOptions", "Reading", "ingest"]


@dataclass(frozen=True, kw_only=True)
class ReaderOptions:
    """Options of every reader; those of a format have more fields. `blocksar.ingest_NAME` describes them in this way.

    Attributes
    ----------
    ground_height : float
        Height z of the imaged plane in the scene frame, m. Default: 0.
    """

    ground_height: Annotated[float, Option("Height z of the imaged plane in the scene frame.", metavar="M")] = 0.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Reading:
    """A phase history in files, of which the samples are still to be read.

    Attributes
    ----------
    collection : Collection
    pieces : callable ()
        Begins to give the samples, a piece at a time: range-frequency samples, or echoes over the fast time of `raw`.
        Pieces follow each other from pulse to pulse; whole chunks may be given again, with what is known better then.
        Those whose samples are a function are not read if an ingestion that ended early has written them.
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
        """The phase history without its samples."""
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
        messages.append(f"{there} of {sum(each.total for each in samples)} pulses were there from one that ended early")
    return Ingested(
        path=target.path if isinstance(target, LocalPlace) else target, collection=first.collection, messages=messages
    )


def _state(source: Location) -> list[str]:
    """Name and state of a file, or of all below a folder: another state, another content."""
    where = readable(source)
    if isinstance(where, LocalPlace) and where.path.is_dir():
        return [os.path.abspath(where.path), *(f"{name} {size} {written}" for name, size, written in where.files())]
    name = os.path.abspath(where.path) if isinstance(where, LocalPlace) else str(where)
    return [name, where.version()]


def _identity(origin: Sequence[Any], groups: Mapping[str, stores.Group]) -> str:
    """Hash of all that samples depend on, and of what is stored beside them."""
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
