"""The task that inspects samples of which no spectrum is recovered."""

from __future__ import annotations

from blocksar import stores
from blocksar.inspection.samples import zero_impossible
from blocksar.runs.receipts import Run
from blocksar.runs.record import Receipt


def inspect_group(run: Run, unit: str, source: stores.PhaseHistory, columns: tuple[int, int]) -> Receipt:
    """Inspect a column group without recovery, for back-projection, which reads by pulse."""
    signal = source.read(slice(None), slice(*columns))
    frequency = source.collection.range_frequency[slice(*columns)]
    inspection = zero_impossible(
        signal, range_frequency=frequency, recovery=None, first_column=columns[0], threads=run.threads
    )
    return Receipt(unit=unit, stage="inspect", found=inspection.as_dict())
