"""Figures of the looks of a run: their parts of the dwell, their spectra, and the speckle of their mean."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from blocksar.api.reports import Table, finite, rounded
from blocksar.measurement.scenery import measure_area
from blocksar.products.look_spectra import measure_looks
from blocksar.products.pictures.overview import mean_of
from blocksar.runs.finished import FinishedRun
from blocksar.spans import parse_crop


def describe_looks(looks: Sequence[FinishedRun], area: Any) -> dict[str, Any]:
    """Part of the dwell and share of power in it of each look; of an area, the equivalent numbers of looks.

    That of an area also has that of the mean power of all looks: as large as their number times that of one, if their
    speckle is independent.
    """
    found = measure_looks(looks)
    records: list[dict[str, Any]] = [{"name": look.attrs.get("look", look.folder.name)} for look in looks]
    if found is not None:
        for record, part, within in zip(records, found.parts.tolist(), found.within.tolist(), strict=True):
            record |= {"part": part, "within": within}
    result: dict[str, Any] = {"each": records}
    if area is not None:
        parts = [look.cropped(*parse_crop(area, "area"), "area") for look in looks]
        for record, part in zip(records, parts, strict=True):
            record["looks"] = finite(measure_area(part.read, part.strips(0)).looks)
        result["mean_looks"] = finite(_of_mean(parts))
    return result


def _of_mean(parts: Sequence[FinishedRun]) -> float:
    """Equivalent number of looks of the mean power of several images, NaN where not covered by all."""
    return measure_area(mean_of([part.read for part in parts]), parts[0].strips(0)).looks


def looks_table(described: dict[str, Any]) -> Table:
    """The looks, one a row."""
    records = described["each"]
    header = ["look", "part of the dwell", "power in it"]
    rows = [
        [r["name"], *(["-", "-"] if "part" not in r else
         [f"{r['part'][0]:.3f} .. {r['part'][1]:.3f}", f"{100 * r['within']:.1f} %"])]
        for r in records
    ]  # fmt: skip
    if "mean_looks" in described:
        header.append("equivalent looks")
        for row, record in zip(rows, records, strict=True):
            row.append(rounded(record["looks"], 2))
        rows.append(["mean of all", "", "", rounded(described["mean_looks"], 2)])
    return tuple(header), rows
