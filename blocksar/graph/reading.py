"""The tasks that read the samples of a phase history: compression of raw echoes, recovery, inspection."""

from __future__ import annotations

import time

import numpy as np

from blocksar import stores
from blocksar.arrays import ComplexArray
from blocksar.focusing.range_compression import RawCompression
from blocksar.focusing.recovery import Recovery, recover_columns
from blocksar.graph.spectrum import Window, chunk_spans, stays_cached
from blocksar.graph.tasks import sign
from blocksar.graph.writing import WritesBehind
from blocksar.inspection.samples import inspect
from blocksar.kernels import buffers
from blocksar.runs.receipts import Run, write
from blocksar.runs.record import Receipt, Written


def compress_pulses(
    run: Run, unit: str, source: stores.PhaseHistory, pulses: tuple[int, int], compression: RawCompression
) -> Receipt:
    """Range-compress pulses of a raw echo into the run's own phase history; a pulse with a gap becomes missing."""
    started = time.perf_counter()
    echo = source.read(slice(*pulses), slice(None))
    inspection = inspect(echo, range_frequency=np.zeros(echo.shape[1]), recovery=None, threads=run.threads)
    signal = compression.apply(echo, pulses=slice(*pulses), threads=run.threads)
    signal[list(inspection.missing)] = np.nan
    region = (slice(*pulses), slice(0, signal.shape[1]))
    part = write(run, run.compressed, "signal", region, signal)
    receipt = Receipt(unit=unit, stage="range-compress", written=(part,), found=inspection.as_dict())
    return sign(run, receipt, started)


def recover_group(
    run: Run,
    unit: str,
    source: stores.PhaseHistory,
    columns: tuple[int, int],
    recovery: Recovery,
    chunk: tuple[int, int],
) -> Receipt:
    """Recover the spectrum of a column group, a chunk's columns at a time; missing and impossible samples are unlit.

    Chunks are written by other threads while the next columns are recovered.
    """
    started = time.perf_counter()
    height, width = chunk
    signal = source.read(slice(None), slice(*columns))
    frequency = source.collection.carrier + source.collection.range_frequency - recovery.carrier
    inspection = inspect(
        signal, range_frequency=frequency[slice(*columns)], recovery=recovery, first_column=columns[0],
        threads=run.threads,
    )  # fmt: skip
    cached = stays_cached((recovery.doppler.size, source.collection.n_range_frequency))
    memories = [buffers.empty((recovery.doppler.size * width,)) for _ in range(min(2, -(-signal.shape[1] // width)))]
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
    receipt = Receipt(unit=unit, stage="recover", written=behind.written, found=inspection.as_dict())
    return sign(run, receipt, started)


def _write_bins(run: Run, region: Window, values: ComplexArray, *, cached: bool) -> list[Written]:
    """Write a chunk of the spectrum."""
    return [write(run, run.spectrum, "spectrum", region, values, cached=cached)]


def inspect_group(run: Run, unit: str, source: stores.PhaseHistory, columns: tuple[int, int]) -> Receipt:
    """Inspect a column group without recovery, for back-projection, which reads the samples by pulse."""
    started = time.perf_counter()
    signal = source.read(slice(None), slice(*columns))
    frequency = source.collection.range_frequency[slice(*columns)]
    inspection = inspect(signal, range_frequency=frequency, recovery=None, first_column=columns[0], threads=run.threads)
    return sign(run, Receipt(unit=unit, stage="inspect", found=inspection.as_dict()), started)
