"""Facts of a collection and of a run for `info`: rows of a name and a text, from metadata alone."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from blocksar.api.partial_pulses import WHOLE, recorded_text
from blocksar.budget import FIDELITY
from blocksar.collection.beam import NOT_STEERED, lit_yaw, wrapped
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.georeference import Georeference
from blocksar.collection.grid import Grid, ground_resolution
from blocksar.collection.region import default_grid, plan_region
from blocksar.collection.weighting import FLAT
from blocksar.constants import SPEED_OF_LIGHT, unit_of_lengths
from blocksar.errors import InputError
from blocksar.focusing.method import Method
from blocksar.places.local import LocalPlace
from blocksar.places.place import Place
from blocksar.runs.record import RunRecord
from blocksar.texts import frequency_text, size_text

Rows = list[tuple[str, str]]
PREDICTED = "predicted coherence with exact back-projection at least"
# Settings of a run that go without saying; the processor is always named.
USUAL = {
    **{name: value for name, value in Method().as_settings().items() if name != "processor"},
    "blocks": "auto", "fidelity": FIDELITY, "weighting_range": FLAT.text, "weighting_azimuth": FLAT.text,
    "surface": "plane", "pulses": WHOLE,
}  # fmt: skip
HISTORY_LINES = 3  # the newest ones are shown


def disk_size(path: Place) -> int | None:
    """Bytes that all files below a local path take; None in an object store, where listing them may take minutes."""
    return path.taken() if isinstance(path, LocalPlace) else None


def collection_rows(collection: Collection) -> Rows:
    """Band, track, beam and footprint of a collection."""
    geometry = Geometry(collection=collection.centred())
    return [
        ("pulses", _pulses(collection)),
        ("band", _band(collection)),
        *_track(geometry),
        ("beam", _beam(collection)),
        *([] if (recorded := recorded_text(geometry)) is None else [("whole pulses", recorded)]),
        *_footprint(geometry),
    ]


def _pulses(collection: Collection) -> str:
    duration = collection.n_pulse * collection.pulse_interval
    return f"{collection.n_pulse} in {duration:.4g} s, PRF {collection.prf:.6g} Hz"


def _band(collection: Collection) -> str:
    centred = collection.centred()
    resolution = SPEED_OF_LIGHT / (2 * collection.bandwidth)
    return (
        f"{frequency_text(centred.carrier)}, wavelength {100 * centred.wavelength:.3g} cm; "
        f"{frequency_text(collection.bandwidth)} in {collection.n_range_frequency} range frequencies: cells of "
        f"{resolution:.3g} m, range window {collection.range_window:.5g} m"
    )


def _track(geometry: Geometry) -> Rows:
    collection = geometry.collection
    position = collection.antenna_position
    way = float(np.linalg.norm(np.diff(position, axis=0), axis=1).sum())
    duration = float(collection.time[-1] - collection.time[0])
    height = position[:, 2] - collection.ground_height
    heading = math.degrees(math.atan2(*(position[-1] - position[0])[[1, 0]]))
    low, high = float(height.min()), float(height.max())
    heights = f"{low:.5g} m" if high - low < 0.5 else f"{low:.6g} .. {high:.6g} m"
    middle = float(np.median(collection.reference_range))
    rows = [
        (
            "track",
            f"{way:.5g} m at {way / duration:.4g} m/s, course {heading:.1f} degrees from x, {heights} above ground",
        )
    ]
    if middle > low:
        grazing = math.degrees(math.asin(low / middle))
        rows.append(("range", f"{middle:.6g} m, seen at {grazing:.1f} degrees above the horizon"))
    return rows


def _beam(collection: Collection) -> str:
    if collection.beam_width is None:
        return NOT_STEERED
    width = math.degrees(collection.beam_width)
    if collection.beam_steering is not None:
        first, last = np.degrees(collection.beam_steering[[0, -1]])
        return f"{width:.4g} degrees wide about the antenna's axis, steered from {first:.2f} to {last:.2f} degrees"
    first, last = np.degrees(collection.beam_azimuth[[0, -1]])
    velocity = collection.antenna_position[-1] - collection.antenna_position[0]
    middle = float(np.mean(collection.beam_azimuth[[0, -1]]))
    squint = 90 - abs(math.degrees(float(wrapped(middle - math.atan2(velocity[1], velocity[0])))))
    return f"{width:.4g} degrees wide, yaw from {first:.2f} to {last:.2f} degrees, squint {squint:.1f} degrees"


def _footprint(geometry: Geometry) -> Rows:
    """Find what a steered beam lights, and the grid that would cover it; nothing where neither can be said."""
    collection = geometry.collection
    if not collection.steered:
        return []
    rows: Rows = []
    with suppress(InputError):
        region = plan_region(geometry, None)
        low, high = np.degrees(region.yaw[[0, -1]] if collection.has_axis else lit_yaw(collection))
        near, far = float(region.near.min()), float(region.far.max())
        unit, metres = unit_of_lengths(far)
        ranges = f"{near / metres:.3f} .. {far / metres:.3f} {unit}"
        rows.append(("footprint", f"yaw {low:.2f} .. {high:.2f} degrees, range {ranges}"))
        middle = region.yaw.size // 2
        across, along = ground_resolution(
            geometry, float(region.near[middle] + region.far[middle]) / 2, float(region.yaw[middle])
        )
        rows.append(("resolution", f"{across:.3g} m in range, {along:.3g} m in azimuth, on the ground at its centre"))
        rows.append(("default grid", grid_text(default_grid(geometry, region))))
    return rows


def grid_text(grid: Grid) -> str:
    """A grid as --grid takes it, with its number of pixels."""
    x, y = (f"{low:g}:{high:g}:{step:g}" for low, high, step in (
        (grid.x0, grid.x1, grid.dx), (grid.y0, grid.y1, grid.dy),
    ))  # fmt: skip
    return f"{x},{y} ({grid.shape[1]} x {grid.shape[0]} pixels)"


def general_rows(attrs: Mapping[str, Any]) -> Rows:
    """Title, place on the Earth, time, source and targets, as far as the attributes of a store have them."""
    rows: Rows = []
    if title := attrs.get("title"):
        rows.append(("title", str(title)))
    with suppress(InputError):
        where = attrs.get("georeference")
        rows.append(("origin", "unknown: no georeference" if where is None else _origin(where)))
    if isinstance(source := attrs.get("source"), Mapping):
        if source.get("format"):
            channel = f", channel {source['channel']}" if source.get("channel") else ""
            rows.append(("source", f"{source['format']}{channel}"))
        if start := source.get("collection_start"):
            zero = source.get("time_zero", 0.0)
            later = f"{zero:.6g}" if isinstance(zero, int | float) else repr(zero)
            rows.append(("collection start", f"{start}, t = 0 is {later} s later"))
    # Of several channels, each has its own; the row of their names says which.
    if "polarizations" not in attrs and isinstance(polarization := attrs.get("polarization"), Mapping):
        rows.append(("polarization", f"{polarization.get('transmit', '?')}{polarization.get('receive', '?')}"))
    if targets := attrs.get("targets"):
        rows.append(("targets", f"{len(targets)} at known positions"))
    return rows


def _origin(attribute: Any) -> str:
    frame = Georeference.from_attribute(attribute)
    turned = f", x turned {frame.rotation:g} degrees from east" if frame.rotation else ", x east, y north"
    return f"{frame.latitude:.6f}, {frame.longitude:.6f} degrees, {frame.height:.1f} m above WGS 84{turned}"


def history_rows(attrs: Mapping[str, Any]) -> Rows:
    """The newest lines of a store's history: what was done to it."""
    lines = [line for line in str(attrs.get("history") or "").splitlines() if line.strip()]
    return [("done" if k == 0 else "", line.strip()) for k, line in enumerate(lines[:HISTORY_LINES])]


def run_rows(record: RunRecord) -> Rows:
    """State, input, settings, plan, cost and warnings of a run."""
    plan, settings = record.plan, record.settings
    rows: Rows = [("state", _state(record))]
    if record.input.path:
        rows.append(("input", record.input.path))
    if record.channels:
        rows.append((f"{record.dimension}s", ", ".join(record.channels)))
    chosen = [f"{name.replace('_', '-')} {value}" for name, value in settings.items() if _told(name, value)]
    if chosen:
        rows.append(("settings", ", ".join(chosen)))
    if plan.blocks is not None:
        parts = f" of {plan.parts} range sub-blocks each" if (plan.parts or 1) > 1 else ""
        kept = (
            ""
            if math.isnan(plan.least)
            else f"; predicted coherence with exact back-projection at least {plan.least:.6g}"
        )
        rows.append(("plan", f"{plan.blocks} angular blocks{parts}{kept}"))
    if plan.coherence is not None:
        rows.append(("plan", f"{PREDICTED} {plan.coherence:.8g}"))
    if plan.processor:
        rows.append(("chosen", f"processor {plan.processor}"))
    if plan.grid is not None:
        rows.append(("grid", grid_text(Grid(*plan.grid))))
    if "total" in record.timings:
        peak = f", peak memory of a worker {size_text(record.peak_memory)}" if record.peak_memory else ""
        rows.append(("took", f"{record.timings['total']:.1f} s with {record.workers} workers{peak}"))
    rows += [("note" if k == 0 else "", line) for k, line in enumerate(record.warnings)]
    return rows


def _state(record: RunRecord) -> str:
    by = f" by blocksar {record.version}" if record.version else ""
    return f"finished{by}" if record.finished else f"not finished; begun{by}"


def _told(name: str, value: Any) -> bool:
    """Whether a setting is worth a word: the grid has a row, and defaults need none."""
    return name != "grid" and USUAL.get(name) != value


def made_row(made: Sequence[str]) -> Rows:
    """Find what else lies in a run folder."""
    return [("also made", ", ".join(made))] if made else []
