"""The facts of a report page: a run's record and its measured figures, read and checked once.

A damaged record raises here. Runs of older formats hold less; what they lack is empty or None.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from blocksar.measurement.bar import judged, rank
from blocksar.measurement.figures import PointResponse
from blocksar.measurement.targets import Target
from blocksar.products.page.words import DASH, count, number
from blocksar.runs.finished import Source

MOST_DRAWN = 9  # targets whose responses are drawn
MOST_ROWS = 300  # rows of a table, and marks on the picture


def responses_of(quality: Mapping[str, Any]) -> list[PointResponse]:
    """Read the targets of quality.json, in which null stands for NaN and [re, im] for a complex number.

    Raises
    ------
    KeyError, TypeError, ValueError
        If the record is damaged.
    """
    responses = []
    for record in quality["targets"]:
        fields = {name: _number(name, record[name]) for name in PointResponse._fields}
        responses.append(PointResponse(**fields))
    return responses


def _number(name: str, value: Any) -> Any:
    """A field of a response, of its type."""
    match name:
        case "name":
            return str(value)
        case "full_dwell" | "covered":
            return bool(value)
        case "value":
            real, imaginary = (np.nan if part is None else float(part) for part in value)
            return complex(real, imaginary)
    return np.nan if value is None else float(value)


def block_name(block: Mapping[str, Any]) -> str:
    """Name of a block in receipts: `2`, or `2.0` for a range sub-block."""
    return str(block["block"]) if block["part"] is None else f"{block['block']}.{block['part']}"


def block_of(source: Source, predicted: Sequence[Mapping[str, Any]], x: float, y: float) -> str:
    """Name of the block that owns a ground point, m, by its yaw and range; a dash if none does."""
    geometry = source.geometry
    yaw, distance = float(geometry.yaw(np.array(x), np.array(y))), float(geometry.epoch_range(np.array(x), np.array(y)))
    for block in predicted:
        (low, high), (near, far) = block["yaw"], block["range"]
        wrapped = (low + high) / 2 + np.mod(yaw - (low + high) / 2 + np.pi, 2 * np.pi) - np.pi
        if low <= wrapped <= high and (block["part"] is None or near <= distance <= far):
            return block_name(block)
    return DASH


class Facts:
    """A run's record and its measured figures.

    Attributes
    ----------
    source : Source
    record : dict
        run.json.
    predicted : list of dict
        The plan's prediction for each block. Empty for back-projection.
    planned_memory, peak_memory, memory_limit : float or None
        Of one worker, bytes.
    why : str
        Why nothing could be measured.
    receipts : list of dict
        Of units of work: unit, seconds, peak memory (bytes), seconds of steps, whether the unit was reused.
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
        Responses to which the bar applies.
    places : dict
        Name of the block that owns each response, by the response's id().
    settings, input, versions : dict
        As in run.json; empty if it has none.
    samples, centroid : str
        Results of inspecting the samples, and the distance of their Doppler centroid from that of track and beam.
    north : float or None
        Rotation of the x axis from east, degrees; None without a georeference.
    warnings : list of str
    """

    def __init__(self, source: Source, quality: Mapping[str, Any] | None, why: str = "") -> None:
        self.source, self.record = source, source.record
        self.quality, self.why = quality or {}, why
        plan = self.record.get("plan") or {}
        self.predicted = [_block(block) for block in plan.get("predicted") or []]
        self.planned_memory = _float(plan.get("memory")) or max((b["memory"] for b in self.predicted), default=None)
        self.peak_memory = _float(self.record.get("peak_memory"))
        self.memory_limit = _float(self.record.get("memory_limit"))
        self.receipts = [_receipt(receipt) for receipt in self.record.get("receipts") or []]
        self._by_unit = {receipt["unit"]: receipt for receipt in self.receipts}
        self.timings = {name: float(seconds) for name, seconds in (self.record.get("timings") or {}).items()}
        self.settings, self.input, self.versions = (
            dict(self.record.get(name) or {}) for name in ("settings", "input", "versions")
        )
        where = source.attrs.get("georeference")
        self.north = None if where is None else float(where.get("rotation_deg", 0.0))
        self.samples, self.centroid = _samples(self.record), _centroid(self.record)
        self.warnings = [str(line) for line in self.record.get("warnings") or []]
        self.chips = [_chip(chip) for chip in self.quality.get("reference") or []]
        self.responses = responses_of(quality) if quality else []
        self.judged = judged(self.responses)
        worst = sorted(self.responses, key=rank)[:MOST_ROWS]
        kept = {id(r) for r in worst}
        self.listed = [r for r in self.responses if id(r) in kept]
        self.marked: Sequence[PointResponse | Target] = self.listed or [
            Target.from_record(record) for record in list(source.attrs.get("targets") or [])[:MOST_ROWS]
        ]
        self.places = {id(r): block_of(source, self.predicted, r.x, r.y) for r in self.responses}

    def receipt(self, block: Mapping[str, Any]) -> dict[str, Any]:
        """Receipt of a block; empty if there is none."""
        return self._by_unit.get(f"block-{block_name(block)}", {})

    def choose_drawn(self) -> set[str]:
        """Names of the targets whose responses are drawn: the paper's, the two worst, and others along the list."""
        measured = [r.name for r in self.responses if r.covered]
        paper = [name for name in measured if name in (self.quality.get("table3") or {})]
        worst = [r.name for r in sorted(self.judged, key=rank)[:2]]
        even = [measured[round(i)] for i in np.linspace(0, len(measured) - 1, MOST_DRAWN)] if measured else []
        chosen = dict.fromkeys([*paper, *worst, *even])
        return set(list(chosen)[:MOST_DRAWN])


def _float(value: Any) -> float | None:
    return None if value is None else float(value)


def _block(record: Mapping[str, Any]) -> dict[str, Any]:
    """The prediction for a block, as run.json holds it."""
    numbers = ("memory", "residual_phase", "pslr", "width", "migration")
    part = record["part"]
    return {
        "block": int(record["block"]),
        "part": None if part is None else int(part),
        **{name: (float(record[name][0]), float(record[name][1])) for name in ("yaw", "range")},
        **{name: float(record[name]) for name in numbers},
    }


def _receipt(record: Mapping[str, Any]) -> dict[str, Any]:
    steps = {str(name): float(seconds) for name, seconds in (record.get("steps") or {}).items()}
    return {
        "unit": str(record["unit"]),
        "seconds": float(record["seconds"]),
        "peak_memory": float(record["peak_memory"]),
        "steps": steps,
        "reused": bool(record.get("reused")),
    }


def _samples(record: Mapping[str, Any]) -> str:
    found = record.get("samples")
    if not found:
        return ""
    missing, impossible = int(found["missing"]), int(found["impossible"])
    return f"{count(missing, 'missing sample')}, {count(impossible, 'impossible sample')}"


def _centroid(record: Mapping[str, Any]) -> str:
    found = record.get("doppler_centroid")
    if not found:
        return ""
    error, agreement = _float(found["error"]), _float(found["coherence"])
    return f"measured {number(error, 1)} Hz from that of track and beam, coherence {number(agreement)}"


def _chip(record: Mapping[str, Any]) -> dict[str, Any]:
    numbers = {name: _float(record[name]) for name in ("x", "y", "coherence", "gain", "phase")}
    return {"place": str(record["place"]), **numbers}
