"""Checks of samples against metadata, before a run or by themselves."""

from __future__ import annotations

from itertools import product

import numpy as np

from blocksar import stores
from blocksar.application.pulses import pulse_reader
from blocksar.arrays import ComplexArray
from blocksar.chunks import TILE
from blocksar.collection.empty_pulses import find_real
from blocksar.collection.grid import Grid
from blocksar.collection.sampling import refuse_departures
from blocksar.collection.terrain import Terrain
from blocksar.errors import InputError
from blocksar.inspection import check as samples_check
from blocksar.inspection.verdict import Findings


def refuse_real(history: stores.PhaseHistory) -> None:
    """Refuse real samples; reads only up to the first chunk that shows whether they are complex.

    Raises
    ------
    InputError
        If they are real.
    """
    sides = zip(history.shape, TILE, strict=True)
    spans = ([slice(first, min(first + step, n)) for first in range(0, n, step)] for n, step in sides)
    parts = ((region, history.read(*region)) for region in product(*spans))
    if (reason := find_real(history.variable, history.collection, parts)) is not None:
        raise InputError(f"{history.label}: {reason}")


def check_samples(
    history: stores.PhaseHistory, grid: Grid | None, *, threads: int, thorough: bool, terrain: Terrain | None = None
) -> Findings:
    """Check samples from the middle of the band of a phase history against its metadata.

    Raises
    ------
    InputError
        If the collection is bistatic, or as `inspection.check.check`.
    """
    collection = history.collection.centred()
    refuse_departures("check", collection.two_antennas, "focus it, and look at known points")
    pulses, columns = samples_check.part_to_read(collection)
    signal = history.read(pulses, columns) if history.raw is None else _compressed(history, pulses, columns)
    part = samples_check.part_of(collection, pulses, columns)
    return samples_check.check(
        signal, part, grid=grid, threads=threads, thorough=thorough, terrain=terrain, raw=history.raw
    )


def _compressed(history: stores.PhaseHistory, pulses: slice, columns: slice) -> ComplexArray:
    """Compress a raw echo, a few pulses at a time, and return some of its range frequencies."""
    read = pulse_reader(history)
    signal = np.empty((pulses.stop - pulses.start, columns.stop - columns.start), np.complex64)
    for first in range(pulses.start, pulses.stop, TILE[0]):
        part = slice(first, min(first + TILE[0], pulses.stop))
        signal[part.start - pulses.start : part.stop - pulses.start] = read(part)[:, columns]
    return signal
