"""Piecewise writing of phase histories' samples, resumable after an interruption.

An unfinished store has a ledger: its *identity*, a hash of everything it is made from, and the pieces already written,
in order, with checksums. A later write of a store with the same identity skips the pieces that are intact.
"""

from __future__ import annotations

import base64
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache, partial
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from blocksar.arrays import ComplexArray
from blocksar.chunks import SAMPLE, TILE
from blocksar.constants import MIB
from blocksar.errors import InputError
from blocksar.places.place import Place
from blocksar.progress.listening import Callback
from blocksar.stores.records import checksum, read_json, write_json
from blocksar.stores.regions import read_region, write_region

LEDGER = ".written.json"  # in an unfinished store
AT_ONCE = 64 * MIB  # bytes of samples, about


class Piece(NamedTuple):
    """Samples of some pulses of a channel: (n_pulse, n_column) complex64, NaN where a pulse is missing.

    `samples` may be a function that reads them, which is called unless they are in the store already.
    """

    channel: int
    pulses: slice
    samples: ComplexArray | Callable[[], ComplexArray]


class Samples(NamedTuple):
    """The samples of a phase history.

    Attributes
    ----------
    variable : str
    n_pulse, n_channel : int
        0 channels: there is no such dimension.
    pieces : callable ()
        Begins to give them, channel after channel, from pulse to pulse; whole chunks may be given again. The same
        pieces come in the same order each time.
    notes : mapping of str to array
        What is noted in place of the samples that were read, and pieces that follow depend on: kept in the ledger, and
        put back where it is gone on with.
    group : str
        In the store; empty: the store itself.
    """

    variable: str
    n_pulse: int
    n_channel: int
    pieces: Callable[[], Iterable[Piece]]
    notes: Mapping[str, NDArray[Any]] = {}
    group: str = ""

    @property
    def total(self) -> int:
        """Number of pulses of all channels."""
        return self.n_pulse * max(self.n_channel, 1)

    def within(self, store: Place) -> Place:
        return store / self.group if self.group else store

    def region(self, channel: int, first: int, stop: int) -> tuple[slice, ...]:
        lead = (slice(channel, channel + 1),) if self.n_channel else ()
        return (*lead, slice(first, stop), slice(None))


class _Written(NamedTuple):
    """Entry of the ledger: samples, channel and pulses of a written piece, and checksums of its chunks."""

    of: int
    channel: int
    first: int
    stop: int
    sums: list[str]

    @property
    def chunks(self) -> Iterator[tuple[tuple[int, int, int], str]]:
        """Iterate over the chunks of a piece, with checksums."""
        for first, value in zip(range(self.first, self.stop, TILE[0]), self.sums, strict=True):
            yield (self.of, self.channel, first), value


class Ledger:
    """List of the pieces already written to an unfinished store."""

    def __init__(self, store: Place, identity: str, samples: Sequence[Samples], written: list[_Written]) -> None:
        self.store, self.identity, self.samples, self.written = store, identity, samples, written

    @classmethod
    def begin(cls, store: Place, identity: str, samples: Sequence[Samples]) -> Self:
        """Begin the ledger of a store, or resume it as far as the store agrees with it."""
        stored, written = ledger_of(store), []
        if stored is not None and stored.get("identity") == identity:
            try:
                written = [_Written(*entry) for entry in stored["written"]]
                for each, notes in zip(samples, stored["notes"], strict=True):
                    for name, values in each.notes.items():
                        data = zlib.decompress(base64.b64decode(notes[name]))
                        values[...] = np.frombuffer(data, values.dtype).reshape(values.shape)
            except (KeyError, TypeError, ValueError, zlib.error):
                written = []
        ledger = cls(store, identity, samples, written)
        del written[ledger._intact() :]
        ledger._save()
        return ledger

    def _intact(self) -> int:
        """Count the leading pieces whose samples in the store still have the checksums last recorded."""
        last = {chunk: value for entry in self.written for chunk, value in entry.chunks}
        for number, entry in enumerate(self.written):
            each = self.samples[entry.of]
            region = each.region(entry.channel, entry.first, entry.stop)
            try:
                values = read_region(each.within(self.store), each.variable, region, cached=False)
            except InputError:
                return number
            sums = _sums(values[0] if each.n_channel else values)
            if sums != [last[chunk] for chunk, _ in entry.chunks]:
                return number
        return len(self.written)

    def has(self, number: int, of: int, piece: Piece) -> bool:
        """Tell whether a piece is written; an entry of that number for another piece is dropped with all after it."""
        if number >= len(self.written):
            return False
        same = self.written[number][:4] == (of, piece.channel, piece.pulses.start, piece.pulses.stop)
        if not same:
            del self.written[number:]
        return same

    def add(self, of: int, piece: Piece, values: ComplexArray) -> None:
        """Record a written piece."""
        entry = _Written(of, piece.channel, piece.pulses.start, piece.pulses.stop, _sums(values))
        self.written.append(entry)
        self._save()

    def _save(self) -> None:
        notes = [
            {name: base64.b64encode(zlib.compress(values.tobytes(), 1)).decode() for name, values in each.notes.items()}
            for each in self.samples
        ]
        write_json(
            self.store / LEDGER, {"identity": self.identity, "written": [*map(list, self.written)], "notes": notes}
        )


def ledger_of(store: Place) -> dict[str, Any] | None:
    """Read the ledger of an unfinished store; None if there is none."""
    try:
        ledger = read_json(store / LEDGER)
    except InputError:
        return None
    return ledger if isinstance(ledger, dict) else None


def is_begun(store: Place, identity: str) -> bool:
    """Tell whether a store is an unfinished one of this identity."""
    ledger = ledger_of(store)
    return ledger is not None and ledger.get("identity") == identity


def _sums(values: ComplexArray) -> list[str]:
    """Checksums of samples by chunks of pulses, as they are stored."""
    values = values.astype(np.complex64, copy=False)
    return [checksum(values[first : first + TILE[0]]) for first in range(0, len(values), TILE[0])]


def write_pieces(
    store: Place,
    samples: Sequence[Samples],
    *,
    identity: str,
    begun: Callable[[int], object] | None = None,
    progress: Callback | None = None,
) -> int:
    """Write samples to a store that `create` has begun with the same identity.

    Parameters
    ----------
    store : Place
        What `fill` of `create` receives.
    samples : sequence of Samples
    identity : str
        Hash of all that the samples depend on.
    begun : callable (done)
        Told once how many pulses are there, before any is read.
    progress : callable (done, total)
        Told numbers of pulses after each piece, and before the first if some are there.

    Returns
    -------
    int
        Number of pulses that were there.

    Raises
    ------
    ProcessingError
        If it cannot be written.
    """
    ledger = Ledger.begin(store, identity, samples)
    before, done, number, total = 0, 0, 0, sum(each.total for each in samples)
    there: int | None = None

    def tell(done: int) -> None:
        if progress is not None and done:
            progress(done, total)

    def begin() -> int:
        if begun is not None:
            begun(done)
        tell(done)
        return done

    for of, each in enumerate(samples):
        for piece in _by_chunks(each.pieces(), each.n_pulse):
            now = before + piece.channel * each.n_pulse + piece.pulses.stop
            if not ledger.has(number, of, piece):
                there = begin() if there is None else there
                values = _read(piece)
                region = each.region(piece.channel, piece.pulses.start, piece.pulses.stop)
                write_region(each.within(store), each.variable, region, values[None] if each.n_channel else values)
                ledger.add(of, piece, values)
                if now > done:
                    tell(now)
            done, number = max(done, now), number + 1
        before += each.total
    return begin() if there is None else there


def _read(piece: Piece) -> ComplexArray:
    return piece.samples() if callable(piece.samples) else piece.samples


def blocks_of(n_pulse: int, n_column: int) -> list[slice]:
    """Pulses in blocks of whole chunks, each of about `AT_ONCE` bytes of samples.

    Examples
    --------
    >>> blocks_of(1200, 8192)
    [slice(0, 1024, None), slice(1024, 1200, None)]
    """
    rows = max(AT_ONCE // (SAMPLE * n_column * TILE[0]), 1) * TILE[0]
    return [slice(first, min(first + rows, n_pulse)) for first in range(0, n_pulse, rows)]


def _by_chunks(pieces: Iterable[Piece], n_pulse: int) -> Iterator[Piece]:
    """Cut pieces at the borders of the store's chunks, reading each only when it is requested."""
    parts: list[Piece] = []  # those that are not given yet
    for piece in pieces:
        parts.append(piece._replace(samples=cache(partial(_read, piece))))
        first, last = parts[0].pulses.start, piece.pulses.stop
        whole = last if last == n_pulse else max(last - last % TILE[0], first)
        if whole > first:
            yield Piece(piece.channel, slice(first, whole), partial(_joined, parts, whole))
            rest = parts[-1]._replace(pulses=slice(whole, last), samples=partial(_end, parts[-1], last - whole))
            parts = [rest] if last > whole else []


def _joined(parts: Sequence[Piece], stop: int) -> ComplexArray:
    """Concatenate the samples of consecutive parts up to pulse `stop`."""
    read = [_read(part)[: stop - part.pulses.start] for part in parts]
    return read[0] if len(read) == 1 else np.concatenate(read)


def _end(piece: Piece, count: int) -> ComplexArray:
    return _read(piece)[-count:]
