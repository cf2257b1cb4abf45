"""Figures that `quality` measures without a list of targets: bright points, an area, the noise floor, ambiguities."""

from __future__ import annotations

import math
from typing import Any

from blocksar.application.reports import Table, finite, rounded
from blocksar.errors import InputError
from blocksar.measurement import scenery
from blocksar.measurement.axes import response_axes
from blocksar.measurement.figures import measure
from blocksar.measurement.response import read_response
from blocksar.measurement.scenery import BrightPoint
from blocksar.measurement.targets import Target
from blocksar.runs.finished import FinishedRun
from blocksar.spans import parse_crop
from blocksar.texts import count

MOST_FOUND = 1000
ORDERS = (-1, 1)  # of azimuth ambiguities, PRFs


def find_points(run: FinishedRun, count: int) -> list[dict[str, Any]]:
    """Measure the brightest isolated points of an image; records hold null where a figure could not be measured.

    Raises
    ------
    InputError
        If the count is not from 1 to 1000, or the pixels are too far apart to measure in.
    """
    if count not in range(1, MOST_FOUND + 1):
        raise InputError(f"found = {count!r}: ask for 1 to {MOST_FOUND} points")
    bright = scenery.find_bright(run.read, run.x, run.y, run.strips(0), run.geometry_at, run.weighting, count)
    return [_record(run, point, number) for number, point in enumerate(bright, 1)]


def _record(run: FinishedRun, point: BrightPoint, number: int) -> dict[str, Any]:
    """The figures of a point, at the peak of its response."""
    geometry = run.geometry_at(point.x, point.y)
    target = Target(f"F{number}", point.x, point.y)
    read = run.reader_at(point.x, point.y)
    first = read_response(read, run.x, run.y, geometry, target, run.weighting)
    peak = first.peak if first is not None else (point.x, point.y)
    if not all(map(math.isfinite, peak)):
        peak = (point.x, point.y)
    target = target._replace(x=peak[0], y=peak[1])
    record: dict[str, Any] = {
        "name": target.name, "x": target.x, "y": target.y, "power": 10 * math.log10(point.power),
        "prominence": 10 * math.log10(point.prominence),
    }  # fmt: skip
    response = read_response(read, run.x, run.y, geometry, target, run.weighting)
    if response is not None:
        figures = measure(response)
        names = (
            f"{axis}_{figure}" for axis in ("range", "azimuth") for figure in ("pslr", "islr", "irw", "irw_theory")
        )
        record |= {name: finite(getattr(figures, name)) for name in names}
        record["full_dwell"] = bool(figures.full_dwell)
        if (power := _decibels(abs(figures.value) ** 2)) is not None:  # the image may end before the peak's place
            record["power"] = power
    record["ambiguities"] = _ambiguities(run, target, 10 ** (record["power"] / 10))
    return record


def _ambiguities(run: FinishedRun, target: Target, power: float) -> list[dict[str, Any]]:
    """Find the places of a point's first azimuth ambiguities, and the strongest power near them over its own, dB."""
    geometry, found = run.geometry_at(target.x, target.y), []
    axes = response_axes(geometry, target.x, target.y, run.weighting)
    for order in ORDERS:
        place = scenery.ambiguity_place(geometry, target.x, target.y, order)
        if place is None or axes is None:
            continue
        strongest = scenery.strongest_about(run.read, run.x, run.y, place, axes)
        level = None if strongest is None else _decibels(strongest / power)
        found.append({"order": order, "x": place[0], "y": place[1], "level": level})
    return found


def describe_area(run: FinishedRun, area: Any) -> dict[str, Any]:
    """Mean power and equivalent number of looks of a part of the image, `x0:x1,y0:y1` or two pairs, m.

    Raises
    ------
    InputError
        If it is none, or holds fewer than two rows, columns or covered pixels.
    """
    x, y = parse_crop(area, "area")
    part = run.cropped(x, y, "area")
    found = scenery.measure_area(part.read, part.strips(0))
    if found.pixels < 2:
        raise InputError(f"area {area}: the image covers {found.pixels} pixels there; give a part that it covers")
    middle = sum(x) / 2, sum(y) / 2
    axes = response_axes(run.geometry_at(*middle), *middle, run.weighting)
    dx, dy = run.spacing
    cells = None if axes is None else found.pixels * dx * dy / axes.area
    return {
        "x": list(x), "y": list(y), "pixels": found.pixels, "cells": cells, "mean": _decibels(found.mean),
        "per_m2": None if axes is None else _decibels(found.mean / axes.area), "looks": finite(found.looks),
    }  # fmt: skip


def floor_of(run: FinishedRun) -> float | None:
    """Return the noise floor, dB: the mean power that 1 % of the image's cells of 16 x 16 pixels stay below."""
    return _decibels(scenery.noise_floor(run.read, run.strips(0)))


def area_sentence(area: dict[str, Any]) -> str:
    """Describe an area's figures in a sentence."""
    looks = "unknown" if area["looks"] is None else f"{area['looks']:.2f}"
    per_area = "" if area["per_m2"] is None else f" ({area['per_m2']:.1f} dB per m2)"
    cells = "" if area["cells"] is None else f", {area['cells']:.0f} resolution cells"
    mean = rounded(area["mean"], 1)
    return f"area: {count(area['pixels'], 'pixel')}{cells}; mean power {mean} dB{per_area}, {looks} equivalent looks"


def floor_sentence(floor: float | None) -> str:
    """Describe the noise floor in a sentence."""
    return f"noise floor {rounded(floor, 1)} dB: a hundredth of the cells of 16 x 16 pixels has less power"


def found_table(points: list[dict[str, Any]]) -> Table:
    """The points that were found, one a row."""
    header = (
        "found", "x (m)", "y (m)", "power (dB)", "range PSLR", "azimuth PSLR", "range IRW / theory",
        "azimuth IRW / theory", "ambiguity (dB)",
    )  # fmt: skip
    rows = []
    for point in points:
        levels = [ghost["level"] for ghost in point["ambiguities"] if ghost["level"] is not None]
        widths = [
            None if point.get(f"{axis}_irw") is None else point[f"{axis}_irw"] / point[f"{axis}_irw_theory"]
            for axis in ("range", "azimuth")
        ]
        rows.append([
            point["name"], f"{point['x']:.2f}", f"{point['y']:.2f}", rounded(point["power"], 1),
            rounded(point.get("range_pslr"), 2), rounded(point.get("azimuth_pslr"), 2), rounded(widths[0], 3),
            rounded(widths[1], 3), rounded(max(levels, default=None), 1),
        ])  # fmt: skip
    return header, rows


def _decibels(power: float) -> float | None:
    return 10 * math.log10(power) if power > 0 else None
