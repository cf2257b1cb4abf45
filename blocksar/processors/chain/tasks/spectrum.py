"""Reading of the spectrum and of gated spectra with checks, and writing behind the computation."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from math import prod
from types import TracebackType
from typing import Any, TypeVar

import numpy as np

from blocksar import stores
from blocksar.arrays import ComplexArray
from blocksar.chunks import SPECTRUM_BYTES, WRITES_AT_ONCE, WRITES_PER_THREAD
from blocksar.errors import ProcessingError
from blocksar.graph.machine import machine
from blocksar.places.place import Place
from blocksar.runs.record import Written

T = TypeVar("T")


class WritesBehind:
    """Writing behind the computation by a few turns; leaving the `with` block waits for the last write.

    Parameters
    ----------
    held : int, optional
        Turns whose results are held at a time: those that are computed, and those that are written meanwhile. Default:
        so many that neither waits for the other.
    threads : int
        Threads that compute, by `in_threads`.

    Attributes
    ----------
    held : int
    waited : float
        Seconds for which turns have waited.
    """

    def __init__(self, held: int | None = None, *, threads: int = 1) -> None:
        writers = writes_at_once(threads)
        self.held, self.waited = held or turns_at_once(threads) + writers, 0.0
        self._pool = ThreadPoolExecutor(writers)
        self._turns: list[ComputeTurn] = []

    def __enter__(self) -> WritesBehind:
        return self

    def __exit__(self, *error: type[BaseException] | BaseException | TracebackType | None) -> None:
        self._pool.shutdown(wait=True)

    def turn(self) -> ComputeTurn:
        """Begin a turn, once the earlier turn whose buffer it reuses has been written."""
        if len(self._turns) >= self.held:
            began = time.perf_counter()
            self._turns[-self.held].wait()
            self.waited += time.perf_counter() - began
        self._turns.append(ComputeTurn(self._pool, len(self._turns) % self.held))
        return self._turns[-1]

    @property
    def written(self) -> tuple[Written, ...]:
        """Wait for all writes; return their results in the order of the turns."""
        return tuple(part for turn in self._turns for part in turn.wait())


class ComputeTurn:
    """Unit of computation whose results are written while the next one is computed.

    Attributes
    ----------
    memory : int
        Number of the memory that its results may take: 0 .. held - 1.
    """

    def __init__(self, pool: ThreadPoolExecutor, memory: int) -> None:
        self.memory = memory
        self._pool, self._writes = pool, list[Future[Sequence[Written]]]()

    def submit(self, write: Callable[..., Sequence[Written]], *arguments: Any, **options: Any) -> None:
        """Submit a write of results of this turn."""
        self._writes.append(self._pool.submit(write, *arguments, **options))

    def wait(self) -> list[Written]:
        """Wait until this turn's writes have ended; return their results."""
        return [part for write in self._writes for part in write.result()]


def writes_at_once(threads: int) -> int:
    """Number of threads that write while `threads` compute."""
    return max(WRITES_AT_ONCE, math.ceil(WRITES_PER_THREAD * threads))


def turns_at_once(threads: int) -> int:
    """Number of turns that `in_threads` begins before it yields one."""
    return threads + 1 if threads > 1 else 1


def in_threads(jobs: Iterable[Callable[[], T]], threads: int) -> Iterator[T]:
    """Yield the results of jobs in order, computed in `threads` threads; by the caller if that is 1.

    Job k is asked for when all before job k - turns_at_once(threads) + 1 have been used.
    """
    if threads == 1:
        for job in jobs:
            yield job()
        return
    with ThreadPoolExecutor(threads) as pool:
        yield from ahead(pool, jobs, threads)


def ahead(pool: ThreadPoolExecutor, jobs: Iterable[Callable[[], T]], count: int) -> Iterator[T]:
    """Yield the results of jobs in order; up to `count` jobs run in the pool ahead of use."""
    coming: deque[Future[T]] = deque()
    for job in jobs:
        coming.append(pool.submit(job))
        if len(coming) > count:
            yield coming.popleft().result()
    while coming:
        yield coming.popleft().result()


Window = tuple[slice, slice]  # rows and columns
CACHED_SHARE = 1 / 8  # of the memory that a recovered spectrum may take of the page cache


def stays_cached(shape: tuple[int, int]) -> bool:
    """Tell whether a spectrum of a shape is small enough to stay in this machine's page cache."""
    return 8 * prod(shape) <= CACHED_SHARE * machine()[1]


def chunk_spans(first: int, last: int, size: int) -> Iterator[tuple[int, int]]:
    """Divide first .. last at multiples of `size`, the borders of a store's chunks."""
    return pairwise(sorted({first, *range(first - first % size + size, last, size), last}))


@dataclass(frozen=True)
class SpectrumChunks:
    """The chunks of a spectrum's store that a task reads, with the checksums of their receipts.

    Attributes
    ----------
    store : Place
    first_bin : int
        The Doppler bin of its first row: 0, except for the gated spectrum of a sub-block.
    shape, chunk : (int, int)
        Doppler bins and range frequencies of the spectrum, and of a chunk.
    checksums : mapping
        By first row and first column.
    recovered : bool
        Written by recovery, which may leave it in the page cache; not by the range gates.
    """

    store: Place
    first_bin: int
    shape: tuple[int, int]
    chunk: tuple[int, int]
    checksums: Mapping[tuple[int, int], str]
    recovered: bool = False

    @classmethod
    def of(
        cls, store: Place, written: Sequence[Written], *, first_bin: int = 0, shape: tuple[int, int],
        chunk: tuple[int, int], recovered: bool = False,
    ) -> SpectrumChunks:  # fmt: skip
        """All chunks of a store, from the receipts of what was written to it."""
        checksums = {(part.region[0][0], part.region[1][0]): part.checksum for part in written}
        return cls(store, first_bin, shape, chunk, checksums, recovered)

    def within(self, first_bin: int, last_bin: int) -> SpectrumChunks:
        """Select the chunks with some of the bins first_bin .. last_bin - 1."""
        rows = first_bin - self.first_bin, last_bin - self.first_bin
        first = rows[0] - rows[0] % self.chunk[0]
        checksums = {place: checksum for place, checksum in self.checksums.items() if first <= place[0] < rows[1]}
        return replace(self, checksums=checksums)

    def read(self, region: Window) -> ComplexArray:
        """Read a region (n_bin, n_column), complex64; its columns are whole chunks.

        Raises
        ------
        ProcessingError
            If a chunk that it touches does not have its checksum.
        """
        (bins, columns), (height, width) = region, self.chunk
        start, stop = bins.start - self.first_bin, bins.stop - self.first_bin
        first, last = start - start % height, min(-(-stop // height) * height, self.shape[0])
        rows = slice(start - first, stop - first)
        at_once = max(SPECTRUM_BYTES // (8 * (last - first) * width), 1) * width
        if columns.stop - columns.start <= at_once:
            return self._checked((first, last), (columns.start, columns.stop))[rows]
        values = np.empty((stop - start, columns.stop - columns.start), np.complex64)
        for c, d in chunk_spans(columns.start, columns.stop, at_once):
            values[:, c - columns.start : d - columns.start] = self._checked((first, last), (c, d))[rows]
        return values

    def _checked(self, rows: tuple[int, int], columns: tuple[int, int]) -> ComplexArray:
        """Read whole chunks, and compare their checksums with the receipts'."""
        values = np.empty((rows[1] - rows[0], columns[1] - columns[0]), np.complex64)
        cached = self.recovered and stays_cached(self.shape)
        stores.read_region(self.store, "spectrum", (slice(*rows), slice(*columns)), values, cached=cached)
        for a, b in chunk_spans(*rows, self.chunk[0]):
            for c, d in chunk_spans(*columns, self.chunk[1]):
                chunk = values[a - rows[0] : b - rows[0], c - columns[0] : d - columns[0]]
                if stores.checksum(chunk) != self.checksums.get((a, c)):
                    raise ProcessingError(
                        f"{self.store} no longer has the checksum of its receipt at doppler {a}..{b - 1}, "
                        f"range_frequency {c}..{d - 1}"
                    )
        return values


def read_ahead(spectrum: SpectrumChunks, regions: Sequence[Window]) -> Iterator[tuple[Window, ComplexArray, float]]:
    """Read regions ahead of their use; yield each with the seconds spent waiting for it."""
    with ThreadPoolExecutor(1) as pool:
        coming = ahead(pool, (partial(spectrum.read, region) for region in regions), 1)
        for region in regions:
            started = time.perf_counter()
            part = next(coming)
            yield region, part, time.perf_counter() - started
            del part
