"""What a report page knows of a run: its record, what was measured, and whether that meets the bar."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from blocksar.collection.beam import turned_near
from blocksar.constants import SINC_PSLR
from blocksar.measurement.bar import BARS, rank, select_judged, worst_excess
from blocksar.measurement.figures import PointResponse
from blocksar.measurement.targets import Target
from blocksar.products.page.words import DASH, SPACE, TIMES, count, memory, number
from blocksar.runs.finished import FinishedRun
from blocksar.runs.record import PredictedBlock, Receipt, RunRecord, block_unit

SHOWN = 9  # targets whose responses are drawn
EDGE = 16  # pixels at the rim of an image in which a response may not be measured
MOST_ROWS = 300  # of a table, and marks on the picture
BAR = (
    f"side lobes within {BARS['range_pslr'].text} of {number(SINC_PSLR)} dB and widths within {BARS['range_irw'].text} "
    f"of theory, in range and in azimuth; position within {BARS['error_x'].text} in x and in y; amplitude within "
    f"{BARS['amplitude'].text}, phase within {BARS['phase'].text}"
)


def responses_of(found: Mapping[str, Any]) -> list[PointResponse]:
    """Targets as quality.json holds them: null stands for NaN, [re, im] for a complex number.

    Raises
    ------
    KeyError, TypeError, ValueError
        If it holds no such thing.
    """
    made = []
    for record in found["targets"]:
        fields = {name: _number(name, record[name]) for name in PointResponse._fields}
        made.append(PointResponse(**fields))
    return made


def _number(name: str, value: Any) -> Any:
    match name:
        case "name":
            return str(value)
        case "full_dwell" | "covered":
            return bool(value)
        case "value":
            real, imaginary = (np.nan if part is None else float(part) for part in value)
            return complex(real, imaginary)
    return np.nan if value is None else float(value)


# ---------------------------------------------------------------- blocks


def block_of(source: FinishedRun, predicted: Sequence[PredictedBlock], x: float, y: float) -> str:
    """Which block owns a point of the ground, by its yaw and range; a dash if none does."""
    geometry = source.geometry
    yaw, distance = float(geometry.yaw(np.array(x), np.array(y))), float(geometry.epoch_range(np.array(x), np.array(y)))
    for block in predicted:
        (low, high), (near, far) = block.yaw, block.range
        if low <= turned_near(yaw, (low + high) / 2) <= high and (block.part is None or near <= distance <= far):
            return block.name
    return DASH


# ---------------------------------------------------------------- what is known of a run


class Verdict(NamedTuple):
    """One part of the first line."""

    good: bool
    said: str


class Facts:
    """A run's record and what was measured, as the page needs them; runs of older formats know less.

    Attributes
    ----------
    source : FinishedRun
    record : RunRecord
    predicted : tuple of PredictedBlock
        What the plan predicts of each block. Empty for back-projection.
    planned_memory, peak_memory, memory_limit : float or None
        Of a worker, bytes.
    why : str
        Why nothing could be measured.
    receipts : tuple of Receipt
    timings : dict of float
        Of the stages, s.
    chips : list of dict
        Comparisons with back-projection.
    responses : list of PointResponse
    shown : list of PointResponse
        Those in the table: all, or the worst where they are many.
    marked : list of PointResponse or Target
        Those marked in the picture: what was measured, or, where nothing could be, what should have been.
    judged : list of PointResponse
        Those that the bar is for.
    places : dict
        Names of the blocks that own the responses, by their id().
    settings, versions : mapping
        Empty if unknown.
    samples, centroid : str
        What was found in the samples, and how far their Doppler centroid is from that of track and beam.
    north : float or None
        Of the x axis from east, degrees; None if nobody knows where on the Earth it is.
    warnings : list of str
    """

    def __init__(self, source: FinishedRun, found: Mapping[str, Any] | None, why: str = "") -> None:
        self.source, self.record = source, source.record
        self.found, self.why = found or {}, why
        plan = self.record.plan
        self.predicted = plan.predicted
        self.planned_memory = plan.memory or max((block.memory for block in self.predicted), default=None)
        self.peak_memory, self.memory_limit = self.record.peak_memory, self.record.memory_limit
        self.receipts = self.record.receipts
        self._by_unit = {receipt.unit: receipt for receipt in self.receipts}
        self.timings, self.settings, self.versions = self.record.timings, self.record.settings, self.record.versions
        where = source.attrs.get("georeference")
        self.north = None if where is None else float(where.get("rotation_deg", 0.0))
        self.samples, self.centroid = _samples(self.record), _centroid(self.record)
        self.warnings = list(self.record.warnings)
        self.chips = [_chip(chip) for chip in self.found.get("reference") or []]
        self.responses = responses_of(found) if found else []
        self.judged = select_judged(self.responses)
        worst = sorted(self.responses, key=rank)[:MOST_ROWS]
        kept = {id(r) for r in worst}
        self.shown = [r for r in self.responses if id(r) in kept]
        self.marked: Sequence[PointResponse | Target] = self.shown or [
            Target.from_record(record) for record in list(source.attrs.get("targets") or [])[:MOST_ROWS]
        ]
        self.places = {id(r): block_of(source, self.predicted, r.x, r.y) for r in self.responses}

    def receipt(self, block: PredictedBlock) -> Receipt | None:
        """Return the receipt of a block, if there is one."""
        return self._by_unit.get(block_unit(block.name))

    def drawn(self) -> set[str]:
        """Names of the targets whose responses are drawn: the paper's, or the worst and others spread over the list."""
        measured = [r.name for r in self.responses if r.covered]
        paper = [name for name in measured if name in (self.found.get("table3") or {})]
        worst = [r.name for r in sorted(self.judged, key=rank)[:2]]
        even = [measured[round(i)] for i in np.linspace(0, len(measured) - 1, SHOWN)] if measured else []
        chosen = dict.fromkeys([*paper, *worst, *even])
        return set(list(chosen)[:SHOWN])

    def subtitle(self) -> str:
        blocks = len({block.block for block in self.predicted})
        dx, dy = self.source.spacing
        spacing = f"{dx:.4g} m" if abs(dx - dy) < 1e-9 * dx else f"{dx:.4g} m {TIMES} {dy:.4g} m"
        size = f"{number(self.source.x.size, 0)} {TIMES} {number(self.source.y.size, 0)} pixels of {spacing}"
        carrier = f"{self.source.collection.carrier / 1e9:.4g} GHz"
        processor = str(self.settings.get("processor", "blocksar"))
        return ", ".join([processor, *([count(blocks, "block")] if blocks else []), size, carrier])

    def verdicts(self) -> list[Verdict]:
        return [self._verdict_targets(), self._verdict_warnings(), self._verdict_memory()]

    def _verdict_targets(self) -> Verdict:
        if self.why:
            return Verdict(False, "targets could not be measured")
        if not self.responses:
            return Verdict(True, "no targets to measure")
        full = [r for r in self.responses if r.full_dwell]
        within = [r for r in self.judged if worst_excess(r) <= 1]
        if not full:
            return Verdict(False, "no target is lit over its full dwell")
        counted = len(self.judged) + sum(self._in_a_gap(r) for r in full)
        if not counted:
            return Verdict(True, "no fully lit target to judge in this image")
        return Verdict(len(within) == counted, f"{len(within)} of {count(counted, 'fully lit target')} within the bar")

    def _in_a_gap(self, response: PointResponse) -> bool:
        """Whether the image lacks a target's place though it reaches well around it; beyond the grid none is missed."""
        if response.covered or np.isfinite(response.value):
            return False
        places = ((response.x, self.source.x), (response.y, self.source.y))
        return all(
            axis[0] + EDGE * step < value < axis[-1] - EDGE * step
            for (value, axis), step in zip(places, self.source.spacing, strict=True)
        )

    def _verdict_warnings(self) -> Verdict:
        return Verdict(not self.warnings, count(len(self.warnings), "warning"))

    def _verdict_memory(self) -> Verdict:
        peak, planned = self.peak_memory, self.planned_memory
        if peak is None or planned is None:
            return Verdict(True, f"peak memory of a worker {memory(peak)}")
        return Verdict(
            peak <= planned,
            f"peak memory of a worker {memory(peak)}, {number(100 * peak / planned, 0)}{SPACE}% of the plan",
        )

    def memory_words(self) -> str:
        planned, limit = self.planned_memory, self.memory_limit
        said = [f"Peak of a worker: {memory(self.peak_memory)}"]
        said += [f"planned: {memory(planned)}"] if planned is not None else []
        said += [f"limit: {memory(limit)}"] if limit is not None else []
        workers, threads = self.record.workers, self.record.threads
        if workers is not None and threads is not None:
            said.append(f"{count(workers, 'worker')} with {count(threads, 'thread')} each")
        return f"{'; '.join(said)}."

    def plan_words(self) -> str:
        if self.predicted:
            return (
                "What tracing the scene's time-frequency lines promised for the worst target of each block, beside "
                "what was measured at the fully lit targets in it. Memory is that of a worker, interpreter and "
                "libraries included."
            )
        return "Exact back-projection approximates nothing, so nothing had to be predicted."


def _float(value: Any) -> float | None:
    return None if value is None else float(value)


def _samples(record: RunRecord) -> str:
    if (counts := record.samples) is None:
        return ""
    return f"{count(counts.missing, 'missing sample')}, {count(counts.impossible, 'impossible sample')}"


def _centroid(record: RunRecord) -> str:
    if (offset := record.doppler_centroid) is None:
        return ""
    return f"measured {number(offset.error, 1)} Hz from that of track and beam, coherence {number(offset.coherence)}"


def _chip(record: Mapping[str, Any]) -> dict[str, Any]:
    numbers = {name: _float(record[name]) for name in ("x", "y", "coherence", "gain", "phase")}
    return {"place": str(record["place"]), **numbers}
