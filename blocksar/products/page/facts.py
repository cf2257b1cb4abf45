"""Facts for a report page: a run's record and its measured figures."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from blocksar.collection.beam import turned_near
from blocksar.constants import MIB
from blocksar.measurement.figures import PointResponse, rank, select_judged
from blocksar.measurement.targets import Target
from blocksar.runs.finished import FinishedRun
from blocksar.runs.record import PredictedBlock, Receipt, RunRecord, block_unit
from blocksar.texts import count

DASH, MINUS, TIMES = "\N{EN DASH}", "\N{MINUS SIGN}", "\N{MULTIPLICATION SIGN}"
SPACE = "\N{NARROW NO-BREAK SPACE}"


def number(value: float | None, digits: int = 2) -> str:
    """Format a number with a typographic minus sign; a dash if it is None or not finite.

    Examples
    --------
    >>> number(-13.264), number(float("nan")), number(16413.1468, 1)
    ('−13.26', '–', '16\u202f413.1')
    """
    if value is None or not np.isfinite(value):
        return DASH
    text = f"{value:,.{digits}f}"
    if not float(text.replace(",", "")):
        text = text.lstrip("-")  # no minus zero
    return text.replace("-", MINUS).replace(",", SPACE)


def memory(value: float | None) -> str:
    """Format bytes in MiB; a dash if None."""
    return DASH if value is None else f"{number(value / MIB, 0)} MiB"


def keep_units(text: str) -> str:
    """Replace the spaces between numbers and units, so that no line breaks there.

    Examples
    --------
    >>> keep_units("within 1 % of 5 mm")
    'within 1\u202f% of 5\u202fmm'
    """
    return re.sub(r"(?<=\d) (?=(%|dB|mm|MiB|rad)\b|%)", SPACE, text)


def describe(response: PointResponse) -> str:
    """Alternative text for a response's pictures."""
    parts = [
        f"{axis} side lobes {number(getattr(response, f'{axis}_pslr'))} dB, "
        f"width {number(getattr(response, f'{axis}_irw'), 3)} m, "
        f"in theory {number(getattr(response, f'{axis}_irw_theory'), 3)} m"
        for axis in ("range", "azimuth")
    ]
    return "; ".join(parts)


MOST_DRAWN = 9  # targets whose responses are drawn
MOST_ROWS = 300  # rows of a table, and marks on the picture


def responses_of(quality: Mapping[str, Any]) -> list[PointResponse]:
    """Read the targets of quality.json, where null stands for NaN and [re, im] for a complex number.

    Raises
    ------
    KeyError, TypeError, ValueError
        If the record is damaged.
    """
    responses = []
    for record in quality["targets"]:
        fields = {name: _number(name, record[name]) for name in PointResponse._fields if name in record}
        responses.append(PointResponse(**fields))
    return responses


def _number(name: str, value: Any) -> Any:
    """Convert a field of a response to its type."""
    match name:
        case "name":
            return str(value)
        case "full_dwell" | "covered":
            return bool(value)
        case "value":
            real, imaginary = (np.nan if part is None else float(part) for part in value)
            return complex(real, imaginary)
    return np.nan if value is None else float(value)


def block_of(source: FinishedRun, predicted: Sequence[PredictedBlock], x: float, y: float) -> str:
    """Name of the block that owns a ground point, m, by its yaw and range; a dash if none does."""
    geometry = source.geometry_at(x, y)
    yaw, distance = float(geometry.yaw(np.array(x), np.array(y))), float(geometry.epoch_range(np.array(x), np.array(y)))
    for block in predicted:
        (low, high), (near, far) = block.yaw, block.range
        if source.geometry_of(block.block) is not geometry:
            continue
        if low <= turned_near(yaw, (low + high) / 2) <= high and (block.part is None or near <= distance <= far):
            return block.name
    return DASH


class Facts:
    """A run's record and its measured figures.

    Attributes
    ----------
    source : FinishedRun
    record : RunRecord
    predicted : tuple of PredictedBlock
        The plan's prediction for each block. Empty for back-projection.
    planned_memory, peak_memory, memory_limit : float or None
        Of one worker, bytes.
    why : str
        Why nothing could be measured.
    receipts : tuple of Receipt
    timings : dict of float
        Duration of each stage, s.
    chips : list of dict
        Comparisons of image chips with exact back-projection.
    responses : list of PointResponse
    listed : list of PointResponse
        Rows of the table: all responses, or the worst MOST_ROWS.
    marked : list of PointResponse or Target
        Marked in the picture: the listed responses or, if nothing was measured, the targets of the collection.
    judged : list of PointResponse
        Responses to which the limits apply.
    places : dict
        Name of the block that owns each response, by the response's id().
    settings, versions : mapping
        Empty if unknown.
    samples, centroid : str
        Results of inspecting the samples, and the distance of their Doppler centroid from that of track and beam.
    north : float or None
        Rotation of the x axis from east, degrees; None without a georeference.
    warnings : list of str
    """

    def __init__(self, source: FinishedRun, quality: Mapping[str, Any] | None, why: str = "") -> None:
        self.source, self.record = source, source.record
        self.quality, self.why = quality or {}, why
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
        self.chips = [_chip(chip) for chip in self.quality.get("reference") or []]
        self.responses = responses_of(quality) if quality else []
        self.judged = select_judged(self.responses)
        worst = sorted(self.responses, key=rank)[:MOST_ROWS]
        listed = {id(r) for r in worst}
        self.listed = [r for r in self.responses if id(r) in listed]
        self.marked: Sequence[PointResponse | Target] = self.listed or [
            Target.from_record(record) for record in list(source.attrs.get("targets") or [])[:MOST_ROWS]
        ]
        self.places = {id(r): block_of(source, self.predicted, r.x, r.y) for r in self.responses}

    def receipt(self, block: PredictedBlock) -> Receipt | None:
        """Return the receipt of a block; None if there is none."""
        return self._by_unit.get(block_unit(block.name))

    def choose_drawn(self) -> set[str]:
        """Choose the targets whose responses are drawn: the paper's, the two worst, and others along the list."""
        measured = [r.name for r in self.responses if r.covered]
        paper = [name for name in measured if name in (self.quality.get("table3") or {})]
        worst = [r.name for r in sorted(self.judged, key=rank)[:2]]
        even = [measured[round(i)] for i in np.linspace(0, len(measured) - 1, MOST_DRAWN)] if measured else []
        chosen = dict.fromkeys([*paper, *worst, *even])
        return set(list(chosen)[:MOST_DRAWN])


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
    numbers["judged"] = _float(record.get("judged", record["coherence"]))  # quality.json of earlier versions lacks it
    return {"place": str(record["place"]), **numbers}
