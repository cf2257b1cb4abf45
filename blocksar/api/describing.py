"""info: describe what a path holds on one page, and name the next command. Reads no samples."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from blocksar import stores
from blocksar.application.arguments import history_of, is_dataset
from blocksar.application.pulses import WHOLE, recorded_text
from blocksar.application.reports import Report
from blocksar.application.shown import is_measurable
from blocksar.arrays import FloatArray
from blocksar.budget import FIDELITY
from blocksar.collection.beam import NOT_STEERED, lit_yaw, wrapped
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.georeference import Georeference
from blocksar.collection.grid import Grid, ground_resolution
from blocksar.collection.region import default_grid, plan_region
from blocksar.collection.weighting import FLAT
from blocksar.constants import SPEED_OF_LIGHT, unit_of_lengths
from blocksar.errors import InputError, MissingInput
from blocksar.imaging.method import Method
from blocksar.places import Location, place, readable
from blocksar.places.local import LocalPlace
from blocksar.places.place import Place
from blocksar.places.ranges import Readable, WebFile
from blocksar.readers.kinds import SCENE
from blocksar.readers.registry import READERS, Reader, found_at
from blocksar.runs.folder import find_input, member
from blocksar.runs.record import RECORD, RunRecord
from blocksar.simulation import shipped_scenes
from blocksar.stores.records import unreachable
from blocksar.texts import count, frequency_text, size_text

if TYPE_CHECKING:
    import xarray as xr

# ---------------------------------------------------------------- facts of a collection and of a run

Rows = list[tuple[str, str]]
PREDICTED = "predicted coherence with exact back-projection at least"
# Default settings of a run, which are not listed; the processor always is.
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
    return f"{collection.n_pulse} in {collection.duration:.4g} s, {collection.rate_text}"


def _band(collection: Collection) -> str:
    centred = collection.centred()
    resolution = SPEED_OF_LIGHT / (2 * collection.bandwidth)
    band = collection.band
    uneven = "" if band.even else f", {band.lacking} cut out" if band.lacking else " in uneven steps"
    return (
        f"{frequency_text(centred.carrier)}, wavelength {100 * centred.wavelength:.3g} cm; "
        f"{frequency_text(collection.bandwidth)} in {collection.n_range_frequency} range frequencies{uneven}: cells of "
        f"{resolution:.3g} m, range window {collection.range_window:.5g} m"
    )


def _antenna(geometry: Geometry, name: str) -> str:
    """One of two antennas: its way, and where it stands at the epoch, seen from the scene's origin."""
    collection = geometry.collection
    position: FloatArray = getattr(collection, name)
    way = float(np.linalg.norm(np.diff(position, axis=0), axis=1).sum())
    speed, at = way / float(collection.time[-1] - collection.time[0]), position[collection.n_pulse // 2]
    moves = f"{way:.5g} m at {speed:.4g} m/s" if way else "stands still"
    return f"{moves}, at x = {at[0]:.6g}, y = {at[1]:.6g}, z = {at[2]:.6g} m in the middle"


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
    if collection.bistatic:
        return [(name.removesuffix("_position"), _antenna(geometry, name)) for name in collection.antennas]
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
    """Rows on the ground that a steered beam lights, its resolution and default grid; none if these are unknown."""
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
    return f"{grid.as_option} ({grid.shape[1]} x {grid.shape[0]} pixels)"


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
    # Several channels have a polarisation each, which the row of their names shows.
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
    """The newest lines of a store's history."""
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
        coherence = (
            ""
            if math.isnan(plan.least)
            else f"; predicted coherence with exact back-projection at least {plan.least:.6g}"
        )
        rows.append(("plan", f"{count(plan.blocks, 'angular block')}{parts}{coherence}"))
    if plan.coherence is not None:
        rows.append(("plan", f"{PREDICTED} {plan.coherence:.8g}"))
    if plan.processor:
        rows.append(("chosen", f"processor {plan.processor}"))
    if plan.grid is not None:
        rows.append(("grid", grid_text(Grid(*plan.grid))))
    if "total" in record.timings:
        peak = f", peak memory of a worker {size_text(record.peak_memory)}" if record.peak_memory else ""
        rows.append(("took", f"{record.timings['total']:.1f} s with {count(record.workers or 0, 'worker')}{peak}"))
    rows += [("note" if k == 0 else "", line) for k, line in enumerate(record.warnings)]
    return rows


def _state(record: RunRecord) -> str:
    by = f" by blocksar {record.version}" if record.version else ""
    return f"finished{by}" if record.finished else f"not finished; begun{by}"


def _told(name: str, value: Any) -> bool:
    """Tell whether a setting is listed: neither the grid, which has its own row, nor a default."""
    return name != "grid" and USUAL.get(name) != value


def made_row(made: Sequence[str]) -> Rows:
    """Return the row that lists the other files in a run folder, such as reports and pictures."""
    return [("also made", ", ".join(made))] if made else []


Following = list[list[str]]  # command lines that come next, as words after `blocksar`
PARTS = {
    "spectrum": "the recovered spectrum of a run", "height": "the terrain of a run",
    "antenna_position": "the track as flown, beside a simulated phase history",
}  # fmt: skip
# Files in a run folder, by other commands.
MADE = ("quality.json", "report.html", "mosaic.png", "contours.png", "calibration.json")


# ---------------------------------------------------------------- info


def info(path: Location | xr.Dataset) -> Report:
    """Describe a path or a dataset: its size, geometry, band, beam, grid, history, and the next command.

    Reads metadata only, and writes nothing.

    Parameters
    ----------
    path : path or xarray.Dataset
        Phase history, run folder, image, CPHD file, file or folder of the AFRL Gotcha set, scene file, or the name of a
        shipped scene; or a dataset that is a phase history or an image.

    Returns
    -------
    Report
        `tables` has one table of names and texts; `result` is a dict: `kind`, `path`, `facts` (the same as a dict) and
        `next` (command lines, as words after `blocksar`).

    Raises
    ------
    InputError
        If there is nothing, it is damaged, or it is none of these.
    """
    if is_dataset(path):
        return _dataset(path)
    if isinstance(file := readable(path), WebFile):
        return _file(file)
    where = place(path)
    if isinstance(where, LocalPlace) and not where.exists() and str(path) in shipped_scenes():
        return _report("shipped scene", str(path), *_scene(str(path)))
    try:
        names = where.names()
    except OSError as error:
        raise unreachable(where, error) from error
    if RECORD in names:
        return _run(where)
    if "zarr.json" in names or ".zgroup" in names:
        return _store(where, names)
    if isinstance(where, LocalPlace) and not where.path.is_file():
        if (found := found_at(where)) is not None and (name := found.reader) is not None and READERS.get(name).several:
            ending = Path(found.file.name).suffix
            files = [where / name for name in sorted(names) if name.endswith(ending)]
            return _described(READERS.get(name), files, str(where), f"{where / f'*{ending}'}")
        if not where.exists():
            raise MissingInput(f"{where} does not exist; check the path")
    elif not names:
        return _file(where)
    raise _unknown(where, names)


def _unknown(where: Place, names: list[str]) -> InputError:
    holds = f" (it holds {', '.join(names[:3])}{' ...' if len(names) > 3 else ''})" if names else ""
    inside = [name for name in names if name.endswith(".zarr") or (where / name / RECORD).exists()]
    if not inside and (found := found_at(where)) is not None:
        return InputError(found.sentence(where))
    files = ", ".join(reader.kind.name for reader in READERS)
    remedy = f"give a phase history, a run folder, an image.zarr, {files}, or a scene"
    remedy = f"look at {where / inside[0]}" if inside else remedy
    return InputError(f"{where} is nothing that blocksar reads or writes{holds}; {remedy}")


def _report(kind: str, name: str, rows: Rows, following: Following) -> Report:
    """Make a report of one table; `result` holds its rows as a dict, where an empty label continues the row above."""
    entries: dict[str, str] = {}
    last = ""
    for label, text in rows:
        last = label or last
        entries[last] = text if label else f"{entries[last]}\n{text}"
    result = {"kind": kind, "path": name, "facts": entries, "next": following}
    return Report(tables=[((kind, name), rows)], result=result)


# ---------------------------------------------------------------- stores


def _store(where: Place, names: list[str]) -> Report:
    if "signal" in names or "echo" in names:
        return _phase_history(stores.open_phase_history(where), where)
    if "image" in names:
        kind = "image" if "block" in names else "one block's part of a run's image"
        return _report(kind, str(where), *_image(where))
    if "reference_range" in names:
        collection, attrs = stores.read_collection(where)
        rows = [*general_rows(attrs), *collection_rows(collection), *history_rows(attrs)]
        return _report("collection (a phase history without its samples)", str(where), rows, [])
    if several := stores.collections_in(where):
        return _collections(where, several)
    for name, kind in PARTS.items():
        if name in names:
            return _report(kind, str(where), _size(where), [])
    raise _unknown(where, names)


def _collections(where: Place, several: Sequence[Place]) -> Report:
    """Describe a store of several phase histories in one frame."""
    histories = [stores.open_phase_history(each) for each in several]
    first = histories[0]
    rows = [
        ("holds", f"{len(several)} phase histories in one frame"),
        *((each.name, f"{history.attrs.get('title', '')}: {history.shape[0]} pulses x {history.shape[1]} samples")
          for each, history in zip(several, histories, strict=True)),
        *_size(where),
        ("", f"the first, {several[0].name}:"),
        *general_rows(first.attrs),
        *collection_rows(first.collection),
        *history_rows(first.attrs),
    ]  # fmt: skip
    return _report("phase histories", str(where), rows, [["plan", str(where)], ["focus", str(where), "--out", "run"]])


def _size(where: Place) -> Rows:
    size = disk_size(where)
    return [] if size is None else [("on disk", size_text(size))]


def _dataset(dataset: Any) -> Report:
    """Describe a dataset of xarray: an image or a phase history; one that was opened from a store like its store."""
    if "image" in dataset and {"x", "y"} <= set(dataset.coords):
        x, y = dataset["x"].values, dataset["y"].values
        from blocksar.products.dataset import nested  # loads xarray, as the caller has

        attrs = {name: nested(value) for name, value in dataset.attrs.items()}
        rows = [
            *general_rows(attrs), ("grid", _pixels(x, y)),
            ("in memory", size_text(dataset["image"].nbytes)), *history_rows(dataset.attrs),
        ]  # fmt: skip
        return _report("image", f"{dataset.encoding.get('source', 'a dataset')}", rows, [])
    history = history_of(dataset)
    stored = not isinstance(history, stores.DatasetHistory)
    return _phase_history(history, place(history.path) if stored else None)


def _phase_history(history: stores.PhaseHistory, where: Place | None) -> Report:
    """Describe a phase history, stored at `where` or, if that is None, in memory only."""
    pulses, columns = history.shape
    axis = "range frequencies" if history.raw is None else "fast-time samples (a raw echo, not range-compressed)"
    count = max(len(history.channels), 1)
    rows = [
        *general_rows(history.attrs),
        *([("channels", ", ".join(history.channels))] if history.channels else []),
        ("samples", f"{pulses} pulses x {columns} {axis}, {size_text(8 * pulses * columns * count)} in memory"),
        *([] if where is None else _size(where)),
        *collection_rows(history.collection),
        *history_rows(history.attrs),
    ]
    needs_grid = not history.collection.steered
    if history.collection.has_axis:
        needs_grid = not any(name == "default grid" for name, _ in rows)
    grid = ["--grid", "x0:x1:dx,y0:y1:dy"] if needs_grid else []
    following = [] if where is None else [[command, str(where), *grid] for command in ("check", "plan")]
    return _report("phase history", str(where or "a dataset"), rows, following)


def _image(where: Place) -> tuple[Rows, Following]:
    x, y = (stores.read_region(where, name, (slice(None),)) for name in ("x", "y"))
    attrs = dict(stores.open_dataset(where).attrs)
    rows = [*general_rows(attrs), ("grid", _pixels(x, y)), *_size(where), *history_rows(attrs)]
    return rows, []


def _pixels(x: Any, y: Any) -> str:
    steps = [float(axis[-1] - axis[0]) / max(axis.size - 1, 1) if axis.size else 0.0 for axis in (x, y)]
    if not (x.size and y.size and min(steps) > 0):
        return f"{x.size} x {y.size} pixels"
    ends = ((axis[0], axis[0] + axis.size * step, step) for axis, step in zip((x, y), steps, strict=True))
    (x0, x1, dx), (y0, y1, dy) = (tuple(float(np.round(number, 9)) for number in end) for end in ends)
    return grid_text(Grid(x0, x1, dx, y0, y1, dy))


def _run(where: Place) -> Report:
    record = RunRecord.read(where)
    attrs: Mapping[str, Any] = {}
    seen: Rows = []
    parts = [where, *(member(where, name, record.dimension) for name in record.channels[:1])]
    for part in (*parts, *(part / "segments" / "0" for part in parts)):  # of several, the first
        if (part / "collection.zarr").exists():
            collection, attrs = stores.read_collection(part / "collection.zarr")
            seen = collection_rows(collection)
            break
    made = [name for name in MADE if (where / name).exists()]
    skipped = {"default grid", "footprint"}
    rows = [
        *general_rows(attrs),
        *run_rows(record),
        *_size(where),
        *made_row(made),
        *(row for row in seen if row[0] not in skipped),
    ]
    if not record.finished:
        source = str(find_input(where, record.input.path)) if record.input.path else "PH.zarr"
        return _report("unfinished run", str(where), rows, [["focus", source, "--out", str(where)]])
    if not is_measurable(record):
        return _report("run", str(where), rows, [])  # of a single row or column, which nothing measures
    following = [[command, str(where)] for command, name in
                 (("quality", "quality.json"), ("report", "report.html")) if name not in made]  # fmt: skip
    return _report("run", str(where), rows, [*following, ["export", "png", str(where), "--out", f"{where.name}.png"]])


# ---------------------------------------------------------------- files


def _file(where: Readable) -> Report:
    try:
        found = found_at(where)
    except OSError as error:
        raise InputError(f"{where} cannot be read ({error.strerror or error}); check its permissions") from error
    if found is None:
        raise MissingInput(f"{where} does not exist, or is no file; check the path")
    if (name := found.reader) is not None:
        return _described(READERS.get(name), [where], str(where), str(where))
    if found.kind is SCENE and isinstance(where, LocalPlace):
        return _report("scene", str(where), *_scene(where.path))
    raise InputError(found.sentence(where))


def _described(reader: Reader, files: Sequence[Readable], name: str, given: str) -> Report:
    """Describe files by their reader; `name` is their place, `given` how the user wrote it, for the next command."""
    found = reader.describe(files, given)
    rows = [
        *found.rows,
        *general_rows(found.attributes),
        *([] if found.collection is None else collection_rows(found.collection)),
        *(("note", note) for note in found.notes),
    ]
    return _report(found.kind, name, rows, [found.command])


def _scene(source: str | Path) -> tuple[Rows, Following]:
    from blocksar.simulation.scene import Scene  # slow to load, and a store needs none of it

    scene = Scene.read(source)
    collection = scene.collection()
    n = len(scene.point_targets())
    holds = [count(n, "point target")] if n else []
    holds += [name for name, table in (
        ("clutter", scene.clutter), ("a reflectivity map", scene.reflectivity), ("noise", scene.noise),
        ("dropped pulses", scene.dropped),
    ) if table is not None]  # fmt: skip
    size = 8 * collection.n_pulse * collection.n_range_frequency
    place = scene.georeference
    rows = [
        ("title", scene.title),
        *([] if place is None else general_rows({"georeference": place.as_attribute()})),
        ("holds", ", ".join(holds) or "nothing"),
        ("samples", f"{collection.n_pulse} pulses x {collection.n_range_frequency} range frequencies, "
                    f"{size_text(size)}"),
        *collection_rows(collection),
    ]  # fmt: skip
    name = scene.name or "scene"
    return rows, [["plan", str(source)], ["simulate", str(source), "--out", f"{name}.zarr"]]
