"""Reading of the spectrum and of gated spectra with checks, and writing behind the computation."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from math import prod

import numpy as np

from blocksar import stores
from blocksar.arrays import ComplexArray
from blocksar.chunks import SPECTRUM_BYTES
from blocksar.errors import ProcessingError
from blocksar.graph.machine import machine
from blocksar.places.place import Place
from blocksar.planning.tiling import Window, chunk_spans
from blocksar.runs.record import Written
from blocksar.tasks.writing import ahead

CACHED_SHARE = 1 / 8  # of the memory that a recovered spectrum may take of the page cache


def stays_cached(shape: tuple[int, int]) -> bool:
    """Tell whether a spectrum of a shape is small enough to stay in this machine's page cache."""
    return 8 * prod(shape) <= CACHED_SHARE * machine()[1]


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
