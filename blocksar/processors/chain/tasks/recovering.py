"""The tasks that recover the spectrum, and gate it in range."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from blocksar import stores
from blocksar.arrays import ComplexArray
from blocksar.inspection.samples import zero_impossible
from blocksar.kernels.rows import Program
from blocksar.planning.tiling import Window, chunk_spans
from blocksar.processors.chain.steps.range_gate import RangeGate
from blocksar.processors.chain.steps.recovery import Recovery, recover_columns
from blocksar.processors.chain.tasks.spectrum import SpectrumChunks, stays_cached
from blocksar.runs.receipts import Run, write
from blocksar.runs.record import Receipt, Written
from blocksar.tasks.writing import WritesBehind


@dataclass(frozen=True)
class Gated:
    """A range sub-block and its gated spectrum.

    Attributes
    ----------
    block : str
        Its name.
    gate : RangeGate
    first_bin : int
        Doppler bin at which the gate begins.
    store_bin : int
        Doppler bin of the first row of the store.
    chunk : (int, int)
        Doppler bins and range frequencies of a chunk of the store.
    """

    block: str
    gate: RangeGate
    first_bin: int
    store_bin: int
    chunk: tuple[int, int]

    def common(self, first: int, last: int) -> tuple[int, int]:
        """Intersect Doppler bins first .. last - 1 with the gate's; first >= last if they share none."""
        return max(first, self.first_bin), min(last, self.first_bin + self.gate.n_row)

    def within(self, first: int, last: int) -> Gated:
        """Limit the gate to the bins first .. last - 1."""
        first, last = self.common(first, last)
        gate = self.gate.within(first - self.first_bin, last - self.first_bin)
        return replace(self, gate=gate, first_bin=first)


def gate_bins(
    run: Run, unit: str, bins: tuple[int, int], spectrum: SpectrumChunks, targets: Sequence[Gated]
) -> Receipt:
    """Gate Doppler bins in range, whole chunks of the spectrum, for all sub-blocks that contain some of them.

    Chunks are written by other threads while the next ones are computed.
    """
    started = time.perf_counter()
    values = spectrum.read((slice(*bins), slice(0, spectrum.shape[1])))
    reading = time.perf_counter() - started
    transform, group = targets[0].gate.to_delay, targets[0].chunk[0]
    to_delay = Program([transform], source=transform.source, n_row=group)
    delays = np.empty((group, transform.period), np.complex64)
    with WritesBehind() as behind:
        for first, last in chunk_spans(*bins, group):
            touched = [target for target in targets if target.common(first, last)[1] > target.common(first, last)[0]]
            if touched:
                to_delay.run(values[first - bins[0] : last - bins[0]], out=delays, threads=run.threads)
            for target in touched:
                turn = behind.turn()
                rows = _gate(target, delays, (first, last), threads=run.threads)
                turn.submit(_write_rows, run, target, rows, first)
        computed = time.perf_counter()
    steps = {
        "read-spectrum": reading,
        RangeGate.name: computed - started - reading - behind.waited,
        "write-gated": time.perf_counter() - computed + behind.waited,
    }
    return Receipt(unit=unit, stage="gate", written=behind.written, steps=steps)


def _gate(target: Gated, delays: ComplexArray, bins: tuple[int, int], *, threads: int) -> ComplexArray:
    """Compute the gated rows of bins from their delays; zero outside the slab."""
    first, last = target.common(*bins)
    part = delays[first - bins[0] : last - bins[0]]
    rows = target.gate.from_delay.run(part, first=first - target.first_bin, threads=threads)
    if (first, last) == bins:
        return rows
    whole = np.empty((bins[1] - bins[0], rows.shape[1]), np.complex64)
    whole[: first - bins[0]] = 0
    whole[first - bins[0] : last - bins[0]] = rows
    whole[last - bins[0] :] = 0
    return whole


def _write_rows(run: Run, target: Gated, rows: ComplexArray, first: int) -> list[Written]:
    """Write rows that start at a Doppler bin, by the store's chunks of columns."""
    bins = slice(first - target.store_bin, first - target.store_bin + rows.shape[0])
    return [
        write(run, run.gated(target.block), "spectrum", (bins, slice(a, b)), np.ascontiguousarray(rows[:, a:b]))
        for a, b in chunk_spans(0, rows.shape[1], target.chunk[1])
    ]


def recover_group(
    run: Run,
    unit: str,
    source: stores.PhaseHistory,
    columns: tuple[int, int],
    recovery: Recovery,
    chunk: tuple[int, int],
) -> Receipt:
    """Recover the spectrum of a column group by chunks of columns; missing and impossible samples count as unlit.

    Chunks are written by other threads while the next columns are recovered.
    """
    height, width = chunk
    signal = source.read(slice(None), slice(*columns))
    frequency = source.collection.carrier + source.collection.range_frequency - recovery.carrier
    inspection = zero_impossible(
        signal, range_frequency=frequency[slice(*columns)], recovery=recovery, first_column=columns[0],
        threads=run.threads,
    )  # fmt: skip
    cached = stays_cached((recovery.doppler.size, source.collection.n_range_frequency))
    memories = [
        np.empty(recovery.doppler.size * width, np.complex64) for _ in range(min(2, -(-signal.shape[1] // width)))
    ]
    with WritesBehind(len(memories)) as behind:
        for first in range(columns[0], columns[1], width):
            turn, part = behind.turn(), slice(first, min(first + width, columns[1]))
            shape = (recovery.doppler.size, part.stop - part.start)
            spectrum = recover_columns(
                signal[:, part.start - columns[0] : part.stop - columns[0]],
                range_frequency=frequency[part],
                recovery=recovery,
                threads=run.threads,
                out=memories[turn.memory][: shape[0] * shape[1]].reshape(shape),
            )
            # One entry for each chunk, so that a block can check those that it reads.
            for bins in chunk_spans(0, shape[0], height):
                turn.submit(_write_bins, run, (slice(*bins), part), spectrum[slice(*bins)], cached=cached)
    return Receipt(unit=unit, stage="recover", written=behind.written, found=inspection.as_dict())


def _write_bins(run: Run, region: Window, values: ComplexArray, *, cached: bool) -> list[Written]:
    """Write part of the spectrum."""
    return [write(run, run.spectrum, "spectrum", region, values, cached=cached)]
