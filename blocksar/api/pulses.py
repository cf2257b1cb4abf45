"""Pulses of a phase history, compressed in range if it is a raw echo."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from blocksar import stores
from blocksar.arrays import ComplexArray
from blocksar.chunks import TILE
from blocksar.collection.empty_pulses import missing_pulses
from blocksar.collection.sublooks import whole_beam
from blocksar.focusing.range_gate import RawCompression


def pulse_reader(history: stores.PhaseHistory) -> Callable[[slice], ComplexArray]:
    """Return a function that reads a slice of pulses, (pulses, range frequencies); a raw echo is compressed."""
    if history.raw is None:
        return lambda pulses: history.read(pulses, slice(None))
    compression = RawCompression.of_echo(history.raw, history.collection)
    return lambda pulses: compression.apply(history.read(pulses, slice(None)), pulses=pulses)


def lit_pulse_reader(history: stores.PhaseHistory) -> Callable[[slice], ComplexArray]:
    """Return a reader, as runs have it, with NaN in lost pulses that hold zeros (`collection.empty_pulses`)."""
    read = pulse_reader(history)
    first = history.read(slice(None), slice(0, 1))[:, 0]
    with np.errstate(invalid="ignore"):  # garbage may have signalling NaN
        empty = first == 0
    for start in range(0, empty.size, TILE[0]):
        part = slice(start, min(start + TILE[0], empty.size))
        if empty[part].any():
            empty[part] &= ~history.read(part, slice(None)).any(axis=1)
    beam = whole_beam(history.collection, history.look)
    lost = missing_pulses(empty, ~np.isnan(first), beam, lambda pulse: read(slice(pulse, pulse + 1))[0])

    def read_lit(pulses: slice) -> ComplexArray:
        signal = read(pulses)
        signal[lost[pulses]] = np.nan
        return signal

    return read_lit if lost.any() else read
