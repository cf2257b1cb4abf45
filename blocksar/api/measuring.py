"""quality: point targets measured, and chips compared with exact back-projection."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from blocksar import stores
from blocksar.api.reports import Report, Table
from blocksar.arrays import ComplexArray
from blocksar.collection.geometry import Geometry
from blocksar.errors import InputError
from blocksar.focusing.backprojection import form_image
from blocksar.focusing.range_compression import RawCompression
from blocksar.graph.cluster import machine
from blocksar.measurement.coherence import ChipComparison, coherence
from blocksar.measurement.figures import DEFINITIONS, PointResponse, as_json, measure_target, summary
from blocksar.measurement.response import Response, read_response
from blocksar.measurement.table3 import TABLE3
from blocksar.measurement.targets import Target
from blocksar.places import Location, place
from blocksar.places.place import Place
from blocksar.runs.finished import Image, open_run
from blocksar.simulation.scene import Scene

RANGES_COMPARED = (("near", 0.1), ("middle", 0.5), ("far", 0.9))  # name, share of the swath


def quality(run: Location, *, targets: Location | Sequence[Target] | None = None, reference: bool = False) -> Report:
    """Measure the point targets of a finished run, and compare chips with exact back-projection.

    Parameters
    ----------
    run : path
        Folder of a finished run.
    targets : path or sequence of Target, optional
        JSON file of {"name", "x", "y", "reflectivity"}, scene file (TOML), or the targets themselves; x and y in m in
        the scene frame. Default: the targets that the collection was simulated with.
    reference : bool
        Also back-project chips of 64 x 64 pixels at the blocks' centres, seams and swath ends from the run's input, and
        compare. Default: False.

    Returns
    -------
    Report
        `tables` has one row for each target; `result` is what RUN/quality.json holds.

    Raises
    ------
    InputError
        If the run is not finished, or the targets cannot be read.
    """
    return measure(place(run), targets, reference)[0]


def measure(
    folder: Place, targets: Location | Sequence[Target] | None, reference: bool
) -> tuple[Report, list[Response]]:
    image, collection, attrs, record = open_run(folder)
    geometry = Geometry(collection=collection)
    wanted = targets_of(targets, attrs)
    responses = [measure_target(image.read, image.x, image.y, geometry, target) for target in wanted]
    found = as_json(responses)
    tables = [_response_table(responses)] if responses else []
    lines = [] if not responses else [DEFINITIONS, *_worst_lines(responses)]
    if not responses:
        lines.append("the collection names no targets: give --targets FILE to measure some")
    if attrs.get("scene") == "table1" and responses:
        found["table3"] = {name: row._asdict() for name, row in TABLE3.items()}
        tables.append(_table3(responses))
        lines.append("paper: Table 3 of the angular-division paper; its ISLR follows another, unstated definition")
    shown = [r for t in wanted if t.name in TABLE3 and (r := read_response(image.read, image.x, image.y, geometry, t))]
    if reference:
        compared = _compare(image, geometry, record)
        found["reference"] = [
            {"place": name, "x": x, "y": y, "coherence": abs(c.coherence), "gain": c.gain, "phase": c.phase}
            for name, x, y, c in compared
        ]
        tables.append(_reference_table(compared))
        lines.append("reference: exact back-projection of the same samples; chips of 64 x 64 pixels")
    stores.write_json(folder / "quality.json", found)
    return Report(tables=tables, summary=lines, result=found), shown


def targets_of(targets: Location | Sequence[Target] | None, attrs: dict[str, Any]) -> list[Target]:
    if targets is None:
        return [Target.from_record(record) for record in attrs.get("targets") or []]
    if not isinstance(targets, str | os.PathLike | Place):
        return list(targets)
    path = place(targets)
    if path.name.endswith(".toml"):
        return [Target(*t) for t in Scene.read(str(path)).point_targets()]
    records = stores.read_json(path)
    if isinstance(records, dict):
        records = records.get("targets")
    if not isinstance(records, list):
        raise InputError(f'{path} holds no list of targets; give [{{"name": ..., "x": ..., "y": ...}}, ...]')
    return [Target.from_record(record) for record in records]


def _response_table(responses: Sequence[PointResponse]) -> Table:
    header = (
        "target", "full dwell", "range PSLR", "range ISLR", "range IRW (m)", "range IRW / theory", "azimuth PSLR",
        "azimuth ISLR", "azimuth IRW (m)", "azimuth IRW / theory", "dx (mm)", "dy (mm)", "|value|", "phase (rad)",
    )  # fmt: skip
    rows = []
    for r in responses:
        rows.append([
            r.name, "yes" if r.full_dwell else "no", f"{r.range_pslr:.2f}", f"{r.range_islr:.2f}",
            f"{r.range_irw:.3f}", f"{r.range_irw / r.range_irw_theory:.4f}", f"{r.azimuth_pslr:.2f}",
            f"{r.azimuth_islr:.2f}", f"{r.azimuth_irw:.3f}", f"{r.azimuth_irw / r.azimuth_irw_theory:.4f}",
            f"{1e3 * r.error_x:.1f}", f"{1e3 * r.error_y:.1f}", f"{abs(r.value):.4f}", f"{np.angle(r.value):.4f}",
        ])  # fmt: skip
    return header, rows


def _worst_lines(responses: Sequence[PointResponse]) -> list[str]:
    found = summary(responses)
    head = (
        f"{found.measured} of {found.full_dwell} full-dwell targets measured ({found.targets} in all); worst of them:"
    )
    return [head, *(f"  {name}: {w.value:.4f} at {w.name} (ideal {w.ideal:.4f})" for name, w in found.worst.items())]


def _table3(responses: Sequence[PointResponse]) -> Table:
    header = (
        "target", "range PSLR", "paper", "ISLR", "paper", "IRW (m)", "paper",
        "azimuth PSLR", "paper", "ISLR", "paper", "IRW (m)", "paper",
    )  # fmt: skip
    rows = []
    for r in responses:
        if (p := TABLE3.get(r.name)) is None:
            continue
        rows.append([
            r.name if r.full_dwell else f"{r.name} (part of a dwell)",
            f"{r.range_pslr:.2f}", f"{p.range_pslr:.2f}", f"{r.range_islr:.2f}", f"{p.range_islr:.2f}",
            f"{r.range_irw:.2f}", f"{p.range_irw:.2f}", f"{r.azimuth_pslr:.2f}", f"{p.azimuth_pslr:.2f}",
            f"{r.azimuth_islr:.2f}", f"{p.azimuth_islr:.2f}", f"{r.azimuth_irw:.2f}", f"{p.azimuth_irw:.2f}",
        ])  # fmt: skip
    return header, rows


Compared = list[tuple[str, float, float, ChipComparison]]


def _compare(image: Image, geometry: Geometry, record: dict[str, Any]) -> Compared:
    """Chips of the image against exact back-projection of the run's input at telling places."""
    history = stores.open_phase_history(record["input"]["path"])
    read = _pulse_reader(history)
    half = 32
    found: Compared = []
    for name, x, y in _places(geometry, record):
        column, row = (
            round((x - image.x[0]) / (image.x[1] - image.x[0])),
            round((y - image.y[0]) / (image.y[1] - image.y[0])),
        )
        rows, columns = slice(max(row - half, 0), row + half), slice(max(column - half, 0), column + half)
        if row < 0 or column < 0 or image.y[rows].size < half or image.x[columns].size < half:
            continue
        mine = image.read(rows, columns)
        if np.isfinite(mine.real).mean() < 0.5:
            continue
        exact = form_image(read, geometry, image.x[columns], image.y[rows], threads=machine()[0])
        found.append((name, float(x), float(y), coherence(mine, exact)))
    return found


def _pulse_reader(history: stores.PhaseHistory) -> Callable[[slice], ComplexArray]:
    """Range-frequency samples of a slice of pulses; of a raw echo, compressed."""
    if history.raw is None:
        return lambda pulses: history.read(pulses, slice(None))
    compression = RawCompression.of_echo(history.raw, history.collection)
    return lambda pulses: compression.apply(history.read(pulses, slice(None)), pulses=pulses)


def _places(geometry: Geometry, record: dict[str, Any]) -> list[tuple[str, float, float]]:
    """Block centres, seams, near and far range, and the last yaws of full dwell."""
    predicted = record["plan"]["predicted"]
    if not predicted:
        x0, x1, _, y0, y1, _ = record["plan"]["grid"]
        return [("image centre", (x0 + x1) / 2, (y0 + y1) / 2)]
    collection = geometry.collection
    low, high = predicted[0]["yaw"][0], predicted[-1]["yaw"][1]
    if collection.beam_width is not None and np.ptp(collection.beam_azimuth) > collection.beam_width:
        low = max(low, float(collection.beam_azimuth.min() + collection.beam_width / 2))
        high = min(high, float(collection.beam_azimuth.max() - collection.beam_width / 2))
    blocks = {b["block"]: b["yaw"] for b in predicted}
    yaws = [(f"block {index} centre", float(np.clip(sum(yaw) / 2, low, high))) for index, yaw in blocks.items()]
    yaws += [(f"seam {index}|{index + 1}", yaw[1]) for index, yaw in list(blocks.items())[:-1]]
    inset = 0.01 * (high - low)
    yaws += [("first full dwell", low + inset), ("last full dwell", high - inset)]
    parts = [[b["range"] for b in predicted if b["block"] == index] for index in blocks]
    near, far = max(ranges[0][0] for ranges in parts), min(ranges[-1][1] for ranges in parts)
    ranges = [(f"{where} range", near + share * (far - near)) for where, share in RANGES_COMPARED]
    places = [(f"{name}, {where}", yaw, rng) for name, yaw in yaws for where, rng in ranges]
    for (name, yaw), of_block in zip(yaws, parts, strict=False):  # blocks come first
        inner = [b[1] for b in of_block[:-1]]
        places += [(f"{name}, range seam {k}|{k + 1}", yaw, rng) for k, rng in enumerate(inner) if near < rng < far]
    points = [geometry.ground_point(np.array(rng), np.array(yaw)) for _, yaw, rng in places]
    return [(name, float(p[0]), float(p[1])) for (name, _, _), p in zip(places, points, strict=True)]


def _reference_table(compared: Compared) -> Table:
    header = ("place", "x (m)", "y (m)", "coherence", "gain", "phase (rad)")
    return header, [
        [name, f"{x:.0f}", f"{y:.0f}", f"{abs(c.coherence):.5f}", f"{c.gain:.4f}", f"{c.phase:.4f}"]
        for name, x, y, c in compared
    ]
