"""Chips of an image compared with exact back-projection of the run's input."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from blocksar import stores
from blocksar.application.pulses import PARTS, lit_pulse_reader
from blocksar.application.reports import Table
from blocksar.arrays import ComplexArray
from blocksar.collection.beam import full_dwell_yaw
from blocksar.collection.geometry import Geometry, over_terrain
from blocksar.collection.grid import Grid
from blocksar.collection.region import plan_region
from blocksar.errors import InputError
from blocksar.graph.machine import machine
from blocksar.measurement.coherence import ChipComparison, coherence, joint_coherence, power_within_reach, referred
from blocksar.places import place
from blocksar.places.place import Place
from blocksar.processors.exact.sums import form_chips
from blocksar.runs.finished import FinishedRun
from blocksar.runs.folder import INPUT, find_input
from blocksar.runs.record import RunPlan

FULL_DWELL_YAWS = 257  # at which full dwells are looked for under a beam about its axis
RANGES_COMPARED = (("near", 0.1), ("middle", 0.5), ("far", 0.9))  # name, share of the swath
SURROUNDINGS = 256  # pixels about a chip, whose side lobes and errors may reach it

FIGURES = {"coherence": 5, "judged": 5, "gain": 4, "phase": 4}  # of a chip, and their decimals
SPREAD = 1 / 6, 1 / 2, 5 / 6  # of an image's sides, where no place of the plan lies in it

Compared = list[tuple[str, float, float, ChipComparison, float]]  # the last: power within reach over that of the chip
Chips = list[tuple[str, float, float, ComplexArray, slice, slice]]


def compare_with_exact(
    run: FinishedRun, result: dict[str, Any], source: Place | None = None
) -> tuple[Table, list[str]]:
    """Add chips, least and joint coherence to `result`; return a table of the chips, and sentences.

    `source` is where the input is, if not where it was; see `find_input`.

    Raises
    ------
    InputError
        If the input is unknown, gone, or another one, or the plan of the run is unknown.
    """
    inputs = _open_inputs(run, source)
    compared = _compare(run, inputs)
    chips: list[dict[str, Any]] = [
        {
            "place": name, "x": x, "y": y, "full_dwell": bool(run.geometry_at(x, y).beam.has_full_dwell(x, y)),
            "coherence": abs(c.coherence), "judged": referred(abs(c.coherence), ratio), "gain": c.gain,
            "phase": c.phase, "power": c.power, "power_within_reach": ratio * c.power,
        }
        for name, x, y, c, ratio in compared
    ]  # fmt: skip
    result["reference"] = chips
    lines = ["reference: exact back-projection of the same samples; chips of 64 x 64 pixels"]
    moved = [path for path, history in inputs.items() if str(history.path) != path and f"/{INPUT}" not in path]
    if moved:
        lines.append(f"its samples are those of {', '.join(str(inputs[path].path) for path in moved)}")
    changed = [path for path, history in inputs.items() if _has_changed(run, path, history)]
    if changed and not moved:
        lines[0] = f"{', '.join(changed)} has changed since the run: the reference is of other samples than the image"
    elif changed:
        lines.append("whose files were written at other times than the run's input, as copies are: see that it is this")
    if changed:
        result["changed_input"] = changed
    if not chips:
        lines.append("nothing was compared: the image is too small, or hardly covered")
    predicted = run.record.plan.least
    full = [chip for chip in chips if chip["full_dwell"] and not math.isnan(chip["coherence"])]
    if full and not math.isnan(predicted):
        worst = min(full, key=lambda chip: chip["judged"])
        result["least_coherence"] = {"measured": worst["judged"], "predicted": predicted}
        result["joint_coherence"] = joint_coherence(
            each[3] for chip, each in zip(chips, compared, strict=True) if chip["full_dwell"]
        )
        lines.append(
            f"least coherence at full dwells: {worst['judged']:.4f} measured, {predicted:.4f} predicted; "
            f"all their chips as one, each by its power: {result['joint_coherence']:.4f}"
        )
    return _table(chips), lines


def _open_inputs(run: FinishedRun, source: Place | None) -> dict[str, stores.PhaseHistory]:
    """Open the phase histories that a run was made from, of its channel, by the paths in its record.

    Raises
    ------
    InputError
        If the input is unknown or gone, or has not the run's pulses and range frequencies.
    """
    if not run.record.inputs:
        raise InputError(f"run.json of {run.folder} does not name the input (input.path); focus again with --overwrite")
    inputs, names = {}, run.record.inputs
    for path in names:
        found = find_input(run.folder, path, source)
        if not found.exists():
            raise InputError(
                f"{found}, which the run was made from, does not exist, nor does {found.name} beside {run.folder}; "
                "give its place with --source"
            )
        if len(names) > 1 and found == source:
            raise InputError(
                f"source is {source}, but the run was made from {len(names)} phase histories; give the folder that "
                f"holds {', '.join(place(each).name for each in names)}"
            )
        history = stores.open_phase_history(found)
        if run.record.settings.get("pulses") == PARTS:
            history = history.with_partial_pulses()
        _check_size(run, history)
        inputs[path] = history.of_channel(run.attrs.get("channel") if history.channels else None)
    return inputs


def _check_size(run: FinishedRun, history: stores.PhaseHistory) -> None:
    """Refuse a phase history whose size differs from that of the run's input, as far as that is known."""
    own, found = run.collection, history.collection
    sizes = [(each.n_pulse, each.n_range_frequency) for each in (own, found)]
    if not run.segments and sizes[0] != sizes[1]:
        raise InputError(
            f"{history.path} has {sizes[1][0]} pulses of {sizes[1][1]} range frequencies, and {run.folder} was made "
            f"from {sizes[0][0]} of {sizes[0][1]}; give the run's own phase history with --source"
        )


def _has_changed(run: FinishedRun, path: str, history: stores.PhaseHistory) -> bool:
    """Tell whether a phase history has changed since the run began.

    Not told of what came from memory, nor of looks: their fingerprints cover more than the store.
    """
    known = run.record.fingerprint_of(path)
    if not known or f"/{INPUT}" in path or "look" in run.attrs:
        return False
    return known != history.fingerprint()


def _compare(run: FinishedRun, inputs: Mapping[str, stores.PhaseHistory]) -> Compared:
    """Compare chips of the image with exact back-projection of the run's input.

    Of chips around a place with full dwell, those pixels are compared that have it too.

    Raises
    ------
    InputError
        If the plan of the run is unknown.
    """
    compared: Compared = []
    for path, history in inputs.items():
        geometry = whole_geometry(run, history)
        chips = _chips(run, path, geometry)
        read, axes = lit_pulse_reader(history), [(run.x[columns], run.y[rows]) for *_, rows, columns in chips]
        exact = form_chips(read, geometry, axes, threads=machine()[0], weighting=run.weighting)
        for (name, x, y, chip, rows, columns), one in zip(chips, exact, strict=True):
            found = coherence(chip, one)
            ratio = _within_reach(run, rows, columns) / found.power if found.power else 1.0
            compared.append((name, x, y, found, max(ratio, 1.0)))
    return compared


def _within_reach(run: FinishedRun, rows: slice, columns: slice) -> float:
    """Return the mean power near a chip that its side lobes could come from; see `measurement.coherence`."""
    spans = [
        slice(max(span.start - SURROUNDINGS, 0), min(span.stop + SURROUNDINGS, size))
        for span, size in ((rows, run.y.size), (columns, run.x.size))
    ]
    pixels = run.read(*spans)
    chip = (
        slice(span.start - around.start, span.stop - around.start)
        for span, around in zip((rows, columns), spans, strict=True)
    )
    return power_within_reach(pixels.real.astype(np.float64) ** 2 + pixels.imag.astype(np.float64) ** 2, *chip)


def whole_geometry(run: FinishedRun, history: stores.PhaseHistory) -> Geometry:
    """The geometry of a whole collection, of which a run may have segments."""
    if not run.segments:
        return run.geometry
    return over_terrain(history.collection.centred(), run.segments[0].terrain)


def _chips(run: FinishedRun, path: str, geometry: Geometry) -> Chips:
    """Chips to compare: name, x and y (m), pixels, rows and columns; pixels of other collections are NaN.

    `geometry` is that of the whole collection at `path`. Where none of the plan's places lies in the image, which may
    be a small part of what the blocks own, they are spread over the image.
    """
    return _chips_at(_places_of(run, path), run, path, geometry) or _chips_at(_spread(run), run, path, geometry)


def _spread(run: FinishedRun) -> list[tuple[str, float, float]]:
    """Name, x and y (m) of places over an image: its centre, and at a sixth of its sides from the edges."""
    x, y = (low + (high - low) * np.array(SPREAD) for low, high in ((run.x[0], run.x[-1]), (run.y[0], run.y[-1])))
    return [(f"image, column {i + 1}, row {j + 1} of 3", float(x[i]), float(y[j])) for j in range(3) for i in range(3)]


def _chips_at(places: Sequence[tuple[str, float, float]], run: FinishedRun, path: str, geometry: Geometry) -> Chips:
    """The chips about some places; see `_chips`."""
    half, chips = 32, []
    for name, x, y in places:
        row, column = run.pixel_at(x, y)
        rows, columns = slice(max(row - half, 0), row + half), slice(max(column - half, 0), column + half)
        if row < 0 or column < 0 or run.y[rows].size < half or run.x[columns].size < half:
            continue
        chip = run.read(rows, columns)
        if len(run.record.inputs) > 1:
            chip = np.where(run.read_input(rows, columns) == run.record.inputs.index(path), chip, np.nan)
        if np.isfinite(chip.real).mean() < 0.5:
            continue
        if geometry.beam.has_full_dwell(x, y):  # its neighbours may be lit for a few pulses only
            chip = np.where(geometry.beam.has_full_dwell(run.x[columns], run.y[rows, None]), chip, np.nan)
        chips.append((name, float(x), float(y), chip, rows, columns))
    return chips


def _places_of(run: FinishedRun, path: str) -> list[tuple[str, float, float]]:
    """`reference_places` of the segments of the collection at `path`."""
    if not run.segments:
        return reference_places(run.geometry, run.record.plan)
    places = []
    for number, (geometry, segment) in enumerate(zip(run.segments, run.record.segments, strict=True)):
        if segment.path == path:
            own = [block for block in run.record.plan.predicted if run.segment_of(block.block) == number]
            for name, x, y in reference_places(geometry, replace(run.record.plan, predicted=tuple(own))):
                places.append((f"segment {number}, {name}", x, y))
    return places


def reference_places(geometry: Geometry, plan: RunPlan) -> list[tuple[str, float, float]]:
    """Return name, x and y (m) of places to compare: block centres, seams, near and far range, ends of full dwell.

    Raises
    ------
    InputError
        If neither blocks nor grid are known.
    """
    predicted = plan.predicted
    if not predicted:
        if plan.grid is None:
            raise InputError("run.json does not hold the grid (plan.grid); focus again with --overwrite")
        x0, x1, _, y0, y1, _ = plan.grid
        return [("image centre", (x0 + x1) / 2, (y0 + y1) / 2)]
    collection = geometry.collection
    low, high = predicted[0].yaw[0], predicted[-1].yaw[1]
    if collection.has_axis:
        middle = (predicted[0].range[0] + predicted[-1].range[1]) / 2
        tried = np.linspace(low, high, FULL_DWELL_YAWS)
        full = tried[geometry.beam.has_full_dwell(*geometry.ground_axes(np.array(middle), tried))]
        low, high = (float(full[0]), float(full[-1])) if full.size > 1 else (low, high)
    elif collection.steered:
        first, last = full_dwell_yaw(collection)
        low, high = (max(low, first), min(high, last)) if first < last else (low, high)
    blocks = {b.block: b.yaw for b in predicted}
    yaws = [(f"block {index} centre", float(np.clip(sum(yaw) / 2, low, high))) for index, yaw in blocks.items()]
    yaws += [(f"seam {index}|{index + 1}", yaw[1]) for index, yaw in list(blocks.items())[:-1]]
    inset = 0.01 * (high - low)
    yaws += [("first full dwell", low + inset), ("last full dwell", high - inset)]
    parts = [[b.range for b in predicted if b.block == index] for index in blocks]
    near, far = max(ranges[0][0] for ranges in parts), min(ranges[-1][1] for ranges in parts)
    places = []
    for (name, yaw), low, high in zip(yaws, *_window_at(geometry, plan, [yaw for _, yaw in yaws]), strict=True):
        nearest, farthest = max(near, low), min(far, high)
        for where, share in RANGES_COMPARED:
            places.append((f"{name}, {where} range", yaw, nearest + share * (farthest - nearest)))
    for (name, yaw), of_block in zip(yaws, parts, strict=False):  # blocks come first
        inner = [b[1] for b in of_block[:-1]]
        places += [(f"{name}, range seam {k}|{k + 1}", yaw, rng) for k, rng in enumerate(inner) if near < rng < far]
    points = [geometry.ground_point(np.array(rng), np.array(yaw)) for _, yaw, rng in places]
    return [(name, float(p[0]), float(p[1])) for (name, _, _), p in zip(places, points, strict=True)]


def _window_at(geometry: Geometry, plan: RunPlan, yaw: Sequence[float]) -> tuple[list[float], list[float]]:
    """Nearest and farthest range, m, in the range window at each yaw: over a wide block the window slants."""
    region = plan_region(geometry, None if plan.grid is None else Grid(*plan.grid))
    near, far = region.at(np.array(yaw))
    return near.tolist(), far.tolist()


def _table(chips: list[dict[str, Any]]) -> Table:
    header = (
        "place", "x (m)", "y (m)", "full dwell", "power (dB)", "within reach (dB)", "coherence", "judged", "gain",
        "phase (rad)",
    )  # fmt: skip
    brightest = max((chip["power"] for chip in chips), default=0.0)
    rows = []
    for c in chips:
        powers = [
            f"{10 * math.log10(c[name] / brightest):.1f}" if c[name] > 0 else "-"
            for name in ("power", "power_within_reach")
        ]
        figures = (*powers, *(f"{c[name]:.{digits}f}" for name, digits in FIGURES.items()))
        rows.append([c["place"], f"{c['x']:.0f}", f"{c['y']:.0f}", "yes" if c["full_dwell"] else "no", *figures])
    return header, rows
