"""Pulses of a phase history, compressed in range if it is a raw echo."""

from __future__ import annotations

from collections.abc import Callable

from blocksar import stores
from blocksar.arrays import ComplexArray
from blocksar.focusing.range_compression import RawCompression


def pulse_reader(history: stores.PhaseHistory) -> Callable[[slice], ComplexArray]:
    """Return a function that reads a slice of pulses, (pulses, range frequencies); a raw echo is compressed."""
    if history.raw is None:
        return lambda pulses: history.read(pulses, slice(None))
    compression = RawCompression.of_echo(history.raw, history.collection)
    return lambda pulses: compression.apply(history.read(pulses, slice(None)), pulses=pulses)
