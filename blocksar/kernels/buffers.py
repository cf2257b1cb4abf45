"""Large arrays whose memory is kept and used again by the next ones of this process.

The system clears every page of new memory, which takes a tenth of the time of a run, and more on a virtual machine that
has returned the memory to its host. Kept and used memory together never exceed the most that has been in use at once,
and what is kept is given back once nothing was allocated for a while: a worker may outlive the run. A stage that needs
less of it than another holds on to the rest, so that on a cluster that is used again, recovery has what blocks had.

Arrays of all sizes share segments of address space, which are larger than what is in use: the system backs only pages
that were written. So a buffer of another size, or two small ones, take the pages of the one before.
"""

from __future__ import annotations

import mmap
import threading
import time
import weakref
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import groupby
from typing import NamedTuple

import numpy as np

from blocksar.arrays import ComplexArray
from blocksar.constants import MIB

SMALLEST = 4 * MIB  # bytes of an array that is worth it
IDLE = 20.0  # s without use after which memory is given back
GRAIN = MIB // 16  # bytes, of which arrays take a multiple
SEGMENT = 256 * MIB  # bytes of address space that are asked for at once, or more


class _Span(NamedTuple):
    """A part of a segment: the bytes from first to last are those of an array, else they are free."""

    first: int
    last: int
    used: bool
    written: bool  # whether the system may back it; always, of an array

    @property
    def size(self) -> int:
        return self.last - self.first


class Segment:
    """Some address space, divided into spans in ascending order; free spans that lie side by side differ."""

    def __init__(self, size: int) -> None:
        room = max(SEGMENT, 1 << (size - 1).bit_length())
        try:
            self.memory = map_pages(room)
        except OSError:  # a system that lends no more than it has
            room = size
            self.memory = map_pages(room)
        self.spans = [_Span(0, room, used=False, written=False)]

    @property
    def kept(self) -> int:
        """Bytes that are free, but may be backed."""
        return sum(span.size for span in self.spans if span.written and not span.used)

    @property
    def in_use(self) -> bool:
        return any(span.used for span in self.spans)

    def place(self, size: int) -> tuple[int, int] | None:
        """Where an array fits such that the fewest bytes are written for the first time: how many, and the place."""
        best = None
        for used, run in groupby(self.spans, key=lambda span: span.used):
            spans = list(run)
            first = spans[0].first
            if not used and spans[-1].last - first >= size:
                fresh = sum(
                    min(span.last, first + size) - span.first
                    for span in spans
                    if not span.written and span.first < first + size
                )
                best = min(best or (fresh, first), (fresh, first))
        return best

    def mark(self, first: int, last: int, *, used: bool, written: bool) -> None:
        """Let the bytes from first to last be a span of this kind, whatever they were."""
        spans = []
        for span in self.spans:
            if span.first < first:
                spans.append(span._replace(last=min(span.last, first)))
            if span.first <= first < span.last:
                spans.append(_Span(first, last, used, written))
            if span.last > last:
                spans.append(span._replace(first=max(span.first, last)))
        self.spans = []
        for span in spans:
            before = self.spans[-1] if self.spans else None
            if before is not None and not before.used and not span.used and before.written == span.written:
                self.spans[-1] = before._replace(last=span.last)
            else:
                self.spans.append(span)

    def give_back(self, wanted: int) -> None:
        """Give back so many of the bytes that are kept, or all of them, the last ones first."""
        for span in reversed(self.spans):
            if span.written and not span.used and wanted > 0:
                first = max(span.first, span.last - -(-wanted // GRAIN) * GRAIN)
                with suppress(AttributeError, OSError):
                    self.memory.madvise(mmap.MADV_DONTNEED, first, span.last - first)
                self.mark(first, span.last, used=False, written=False)
                wanted -= span.last - first


class Memory:
    """Memory of arrays, used or kept; safe for several threads."""

    def __init__(self, idle: float = IDLE) -> None:
        self._idle, self._last_use, self._watch = idle, time.monotonic(), False
        self._lock = threading.Lock()
        # Spans of arrays that are gone: an array may go while its thread holds the lock.
        self._gone: deque[tuple[Segment, int, int]] = deque()
        self._segments: list[Segment] = []
        self._used = self._most_used = 0

    def empty(self, shape: tuple[int, ...]) -> ComplexArray:
        """Return an array of complex64, not initialised; its memory is kept once it and all views are gone."""
        size = 8 * int(np.prod(shape))
        if size < SMALLEST:
            return np.empty(shape, np.complex64)
        with self._locked():
            segment, first, last = self._take(-(-size // GRAIN) * GRAIN)
        # All views refer to `whole`, directly or not: it dies with the last of them.
        whole = np.frombuffer(segment.memory, np.complex64, size // 8, first)
        weakref.finalize(whole, self._keep, segment, first, last).atexit = False
        return whole.reshape(shape)

    def release(self) -> None:
        """Give back what is kept."""
        with self._locked():
            self._most_used = self._used
            self._shrink(self._used)

    @property
    def used(self) -> int:
        """Bytes of the arrays that are alive."""
        with self._locked():
            return self._used

    @property
    def kept(self) -> int:
        """Bytes that no array has, but the system may back."""
        with self._locked():
            return self._kept

    @property
    def _kept(self) -> int:
        return sum(segment.kept for segment in self._segments)

    @contextmanager
    def _locked(self) -> Iterator[None]:
        """Hold the lock; what has gone before or meanwhile is taken back."""
        with self._lock:
            self._take_back()
            yield
        self._settle()

    def _settle(self) -> None:
        """Take back what has gone, unless the lock is held, whose holder does it."""
        while self._gone and self._lock.acquire(blocking=False):
            try:
                self._take_back()
            finally:
                self._lock.release()

    def _take(self, size: int) -> tuple[Segment, int, int]:
        places = [(place, segment) for segment in self._segments if (place := segment.place(size)) is not None]
        if places:
            (_, first), segment = min(places, key=lambda found: (found[0], len(found[1].memory)))
        else:
            first, segment = 0, Segment(size)
            self._segments.append(segment)
        segment.mark(first, first + size, used=True, written=True)
        self._used += size
        self._most_used = max(self._most_used, self._used)
        self._shrink(self._most_used)
        self._last_use = time.monotonic()
        return segment, first, first + size

    def _keep(self, segment: Segment, first: int, last: int) -> None:
        self._gone.append((segment, first, last))
        self._settle()

    def _take_back(self) -> None:
        """Keep the memory of the arrays that are gone."""
        while self._gone:
            segment, first, last = self._gone.popleft()
            self._used -= last - first
            segment.mark(first, last, used=False, written=True)
            self._shrink(self._most_used)
            self._last_use = time.monotonic()
        if self._kept and not self._watch:
            self._watch_for(self._idle)

    def _watch_for(self, seconds: float) -> None:
        """See after some seconds whether the memory is idle."""
        timer = threading.Timer(seconds, self._expire)
        timer.daemon = self._watch = True
        timer.start()

    def _expire(self) -> None:
        with self._locked():
            self._watch = False
            left = self._last_use + self._idle - time.monotonic()
            if left > 0:
                self._watch_for(left)
                return
        self.release()

    def _shrink(self, total: int) -> None:
        """Give back what is kept, of small segments first, until kept and used memory is at most `total` bytes."""
        for segment in sorted(self._segments, key=lambda segment: len(segment.memory)):
            if (excess := self._used + self._kept - total) > 0:
                segment.give_back(excess)
        self._segments = [segment for segment in self._segments if segment.in_use or segment.kept]


def map_pages(size: int) -> mmap.mmap:
    memory = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    with suppress(AttributeError, OSError):  # in pages of 2 MiB, where the system has them
        memory.madvise(mmap.MADV_HUGEPAGE)
    return memory


empty = Memory().empty
