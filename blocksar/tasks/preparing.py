"""Preparation of samples, before any processor's stages: range compression of raw echoes, interference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from blocksar import stores
from blocksar.chunks import TILE
from blocksar.collection.collection import Collection
from blocksar.errors import InputError, ProcessingError
from blocksar.graph.units import Executor, Unit
from blocksar.imaging.compression import RawCompression
from blocksar.imaging.interference import cut_interference
from blocksar.imaging.method import Cutting
from blocksar.inspection.samples import count_zero_gaps, zero_impossible
from blocksar.planning.tiling import chunk_spans
from blocksar.runs.receipts import Run, write
from blocksar.runs.record import Receipt
from blocksar.tasks.segments import Segment, by_collection

# Keys of findings in receipts: interference cut from a group of pulses, and zeros that look like gaps in its echo.
CUT, ZERO_GAPS = "interference", "zero_gaps"


def prepare_pulses(
    run: Run,
    unit: str,
    source: stores.PhaseHistory,
    pulses: tuple[int, int],
    compression: RawCompression | None,
    interference: Cutting | None,
) -> Receipt:
    """Write prepared pulses into the run's own phase history: range-compressed if raw, then without interference.

    Gaps in the pulses of an echo are divided out, see `RawCompression`; a pulse without a number is missing.
    """
    signal, found, cycles = source.read(slice(*pulses), slice(None)), dict[str, Any](), None
    if compression is not None:
        gaps = ~np.isfinite(signal)
        inspection = zero_impossible(
            signal, range_frequency=np.zeros(signal.shape[1]), recovery=None, threads=run.threads
        )
        found, cycles = inspection.as_dict(), compression.cycles(slice(*pulses))
        if zeros := count_zero_gaps(signal):
            found[ZERO_GAPS] = zeros
        if inspection.missing:
            signal[gaps] = np.nan
        signal = compression.apply(signal, pulses=slice(*pulses), threads=run.threads)
    if interference is not None:
        signal = np.ascontiguousarray(signal) if signal.flags.writeable else signal.copy()
        found[CUT] = cut_interference(signal, method=interference, cycles=cycles).as_dict()
    region = (slice(*pulses), slice(0, signal.shape[1]))
    part = write(run, run.compressed, "signal", region, signal)
    stage = "interference" if compression is None else "range-compress"
    return Receipt(unit=unit, stage=stage, written=(part,), found=found)


def prepare_samples(
    executor: Executor, segments: Sequence[Segment], run: Run
) -> tuple[list[Segment], list[list[Receipt]]]:
    """Range-compress raw echoes and cut interference where needed, once for each collection.

    Returns the segments as they are then read, and receipts of each.

    The receipts are those of the segment's whole collection, with its first segment only.
    """
    units: list[Unit] = []
    for first, *_ in by_collection(segments).values():
        raw = first.source.raw
        if raw is None and first.interference is None:
            continue
        own, whole = first.of(run), first.source
        run.establish(own.compressed, partial(_create_compressed, own, whole.collection, raw is not None))
        compression = None if raw is None else RawCompression.of_echo(raw, whole.collection)
        step = "interference" if compression is None else "compress"
        for pulses in chunk_spans(0, whole.collection.n_pulse, TILE[0]):
            arguments = whole.within(pulses=slice(*pulses)), pulses, compression, first.interference
            name = own.unit_of_collection(f"pulses-{pulses[0]}")
            units.append(Unit(step, own, name, prepare_pulses, arguments, reads_input=True))
    if not units:
        return list(segments), [[] for _ in segments]
    stage = "interference" if all(segment.source.raw is None for segment in segments) else "range-compress"
    receipts: dict[int | None, list[Receipt]] = {unit.run.collection: [] for unit in units}
    for unit, receipt in zip(units, executor.run_units(stage, units, per_worker=2), strict=True):
        receipts[unit.run.collection].append(receipt)
    try:
        opened = {
            number: replace(stores.open_phase_history(group[0].of(run).compressed).pinned(), look=group[0].source.look)
            for number, group in by_collection(segments).items()
            if number in receipts
        }
    except InputError as error:  # about the run's own store, not about the input
        raise ProcessingError(str(error)) from error
    ready = [replace(segment, source=opened.get(segment.collection, segment.source)) for segment in segments]
    return ready, [receipts.pop(segment.collection, []) for segment in segments]


def _create_compressed(run: Run, collection: Collection, of_echo: bool) -> None:
    # The noise of an echo is that of its samples, not of the signal's.
    stored = Collection(**{**collection.as_dict(), "noise_power": None}) if of_echo else collection
    stores.create_phase_history(run.compressed, stored, overwrite=True)
