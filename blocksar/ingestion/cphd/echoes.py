"""The samples of a channel as pulses of a store: reading them, and which pulses turn out to be lost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np

from blocksar import stores
from blocksar.arrays import BoolArray, ComplexArray, IntArray
from blocksar.chunks import TILE
from blocksar.collection.collection import Collection
from blocksar.collection.empty_pulses import missing_pulses
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.ingestion.cphd.delays import Delays
from blocksar.ingestion.cphd.faults import NOT_FINITE, ZEROS, Lost
from blocksar.ingestion.cphd.files import CphdFile, reading_file
from blocksar.ingestion.cphd.samples import Resampler, phasor
from blocksar.ingestion.cphd.signs import MOST_ROWS, SignTest
from blocksar.ingestion.cphd.vectors import Pulses, VectorResampling
from blocksar.ingestion.resampling import MOST_ERROR
from blocksar.places.local import LocalPlace
from blocksar.places.place import Place
from blocksar.progress.listening import Callback

ROWS = TILE[0]  # pulses written at a time
PART = 64  # vectors resampled in frequency at a time


@dataclass(frozen=True, kw_only=True, eq=False)
class Echoes:
    """Where a channel's samples come from, and what is done with them.

    Attributes
    ----------
    slow_time : VectorResampling or None
        None if times are uniform.
    """

    file: CphdFile
    collection: Collection
    pulses: Pulses
    slow_time: VectorResampling | None
    resampler: Resampler
    delays: Delays


class Reader:
    """Reads pulses of a channel, and keeps in mind which vectors hold nothing.

    Attributes
    ----------
    empty, broken : (n_vector,) bool
        Vectors, of those read so far, whose samples are all zero; and those without a finite sample. At uneven times,
        where pulses are sums of vectors, those with any sample that is not finite, which count as zeros there.
    """

    def __init__(self, echoes: Echoes) -> None:
        self._echoes = echoes
        self.empty = np.zeros(echoes.file.shape[0], np.bool_)
        self.broken = np.zeros(echoes.file.shape[0], np.bool_)

    def read(self, stream: BinaryIO, pulses: slice) -> ComplexArray:
        """Samples of some pulses on the store's frequencies, (n, n_frequency); NaN where pulses are missing."""
        echoes, vector = self._echoes, self._echoes.pulses.vector
        slow_time = echoes.slow_time
        if slow_time is None:
            shape = pulses.stop - pulses.start, echoes.resampler.frequency.size
            block = np.full(shape, complex(np.nan, np.nan), np.complex64)
            lit = np.flatnonzero(vector[pulses] >= 0)
            block[lit] = self._read_in_parts(stream, vector[pulses][lit])
            return block
        inputs = slow_time.resampling.inputs(pulses)
        cycles = 2 / SPEED_OF_LIGHT * echoes.resampler.frequency * slow_time.range_shift[inputs, None]
        used = slow_time.vector[inputs]
        rows = self._read_in_parts(stream, used)
        rows[self.broken[used]] = 0
        return slow_time.resampling.apply((rows * phasor(cycles)).astype(np.complex64), pulses)

    def _read_in_parts(self, stream: BinaryIO, vectors: IntArray) -> ComplexArray:
        out = np.empty((vectors.size, self._echoes.resampler.frequency.size), np.complex64)
        for start in range(0, vectors.size, PART):
            out[start : start + PART] = self._read_vectors(stream, vectors[start : start + PART])
        self.empty[vectors] = ~out.any(axis=1)
        finite = np.isfinite(out)
        self.broken[vectors] = ~(finite.any(axis=1) if self._echoes.slow_time is None else finite.all(axis=1))
        return out

    def _read_vectors(self, stream: BinaryIO, rows: IntArray) -> ComplexArray:
        """Samples of some vectors, ascending: (rows.size, width), scaled and of the store's sign and reference."""
        file, resampler = self._echoes.file, self._echoes.resampler
        read = file.read(stream, int(rows[0]), int(rows[-1]) + 1, resampler.samples)[rows - rows[0]]
        if file.scaled:
            read *= file.parameter("AmpSF", rows).astype(np.float32)[:, None]
        if file.sign > 0:
            np.conjugate(read, out=read)
        out = resampler.apply(read, rows)
        middle = self._echoes.delays.middle[rows]
        if not middle.any():
            return out
        return (out * phasor(resampler.frequency_of(rows) * middle[:, None])).astype(np.complex64)

    def lost(self, stream: BinaryIO) -> tuple[BoolArray, list[Lost]]:
        """The pulses that are missing by what all of their samples are, and the vectors that are lost, by reason."""
        echoes, vector = self._echoes, self._echoes.pulses.vector
        known = vector >= 0
        empty = known & self.empty[vector]
        zeros = missing_pulses(
            empty, known, echoes.collection, lambda pulse: self.read(stream, slice(pulse, pulse + 1))[0]
        )
        vectors = np.zeros(self.empty.shape, np.bool_)
        vectors[vector[zeros]] = True
        reasons = [Lost(ZEROS, vectors), Lost(NOT_FINITE, self.broken)]
        if echoes.slow_time is None:
            return zeros | (known & self.broken[vector]), reasons
        resampling = echoes.slow_time.resampling
        taps = resampling.first[:, None] + np.arange(resampling.weights.shape[1])
        gone = (vectors | self.broken)[echoes.slow_time.vector][taps]
        return np.sqrt((resampling.weights**2 * gone).sum(axis=1)) > MOST_ERROR, reasons


@dataclass(kw_only=True, eq=False)
class Found:
    """What the samples of a channel told, once all are written."""

    lost: list[Lost]
    missing: int  # pulses
    signs: SignTest


def write_samples(store: Place, channels: Sequence[Echoes], *, named: bool, progress: Callback | None) -> list[Found]:
    """Write the samples of channels to a store, one block of pulses at a time; lost pulses are missing.

    Parameters
    ----------
    named : bool
        Whether samples of the store have a dimension of channels.
    """
    found, total = [], channels[0].pulses.vector.size
    for number, echoes in enumerate(channels):
        reader, signs = Reader(echoes), SignTest()
        columns = slice(0, echoes.resampler.frequency.size)

        def put(pulses: slice, block: ComplexArray, number: int = number, columns: slice = columns) -> None:
            lead = (slice(number, number + 1),) if named else ()
            stores.write_region(store, "signal", (*lead, pulses, columns), block[None] if named else block)

        with reading_file(LocalPlace(echoes.file.path)), open(echoes.file.path, "rb") as stream:
            blocks = [slice(first, min(first + ROWS, total)) for first in range(0, total, ROWS)]
            for pulses in blocks:
                block = reader.read(stream, pulses)
                _add(signs, echoes, pulses, block)
                put(pulses, block)
                if progress is not None:
                    progress(number * total + pulses.stop, len(channels) * total)
            missing, lost = reader.lost(stream)
            for pulses in blocks:
                if missing[pulses].any():
                    block = reader.read(stream, pulses)
                    block[missing[pulses]] = np.nan
                    put(pulses, block)
        found.append(
            Found(lost=lost, missing=int(np.count_nonzero(missing & (echoes.pulses.vector >= 0))), signs=signs)
        )
    return found


def _add(signs: SignTest, echoes: Echoes, pulses: slice, block: ComplexArray) -> None:
    """Add some of a block's pulses to a test of the sign."""
    vector, file = echoes.pulses.vector, echoes.file
    every = -(-vector.size // MOST_ROWS)
    some = np.arange(pulses.start, pulses.stop)
    some = some[(some % every == 0) & (vector[some] >= 0)]
    if file.domain == "FX" and echoes.slow_time is None and some.size:
        signs.add(
            block[some - pulses.start], step=echoes.collection.range_frequency_step,
            middle=echoes.delays.middle[vector[some]],
            early=file.parameter("TOA1", vector[some]), late=file.parameter("TOA2", vector[some]),
        )  # fmt: skip
