"""info: what a path holds, in a page, and which command comes next. Reads no samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from blocksar import stores
from blocksar.api import facts
from blocksar.api.arguments import history_of, is_dataset
from blocksar.api.facts import Rows
from blocksar.api.reports import Report
from blocksar.api.shown import is_measurable
from blocksar.collection.grid import Grid
from blocksar.errors import InputError
from blocksar.ingestion.found import found_at
from blocksar.ingestion.kinds import SCENE
from blocksar.ingestion.readers import READERS, Reader
from blocksar.places import Location, place, readable
from blocksar.places.local import LocalPlace
from blocksar.places.place import Place
from blocksar.places.ranges import Readable, WebFile
from blocksar.runs.folder import member
from blocksar.runs.record import RECORD, RunRecord
from blocksar.simulation.scene import Scene
from blocksar.simulation.shipped import shipped_scenes
from blocksar.texts import count, size_text

if TYPE_CHECKING:
    import xarray as xr

Following = list[list[str]]  # command lines that come next, as words after `blocksar`
PARTS = {
    "spectrum": "the recovered spectrum of a run", "height": "the terrain of a run",
    "antenna_position": "the track as flown, beside a simulated phase history",
}  # fmt: skip
MADE = ("quality.json", "report.html", "mosaic.png", "contours.png")  # in a run folder, by other commands


def info(path: Location | xr.Dataset) -> Report:
    """Say what a path or a dataset holds: its size, geometry, band, beam, grid, what was done to it, what comes next.

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
        raise InputError(f"{where} cannot be read ({error.strerror or error}); check its permissions") from error
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
            raise InputError(f"{where} does not exist; check the path")
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
    """A report of one table, and its rows as a dict, in which an empty name goes on with the row above."""
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
        rows = [*facts.general_rows(attrs), *facts.collection_rows(collection), *facts.history_rows(attrs)]
        return _report("collection (a phase history without its samples)", str(where), rows, [])
    if several := stores.collections_in(where):
        return _collections(where, several)
    for name, kind in PARTS.items():
        if name in names:
            return _report(kind, str(where), _size(where), [])
    raise _unknown(where, names)


def _collections(where: Place, several: Sequence[Place]) -> Report:
    """A store of several phase histories in one frame."""
    histories = [stores.open_phase_history(each) for each in several]
    first = histories[0]
    rows = [
        ("holds", f"{len(several)} phase histories in one frame"),
        *((each.name, f"{history.attrs.get('title', '')}: {history.shape[0]} pulses x {history.shape[1]} samples")
          for each, history in zip(several, histories, strict=True)),
        *_size(where),
        ("", f"the first, {several[0].name}:"),
        *facts.general_rows(first.attrs),
        *facts.collection_rows(first.collection),
        *facts.history_rows(first.attrs),
    ]  # fmt: skip
    return _report("phase histories", str(where), rows, [["plan", str(where)], ["focus", str(where), "--out", "run"]])


def _size(where: Place) -> Rows:
    size = facts.disk_size(where)
    return [] if size is None else [("on disk", size_text(size))]


def _dataset(dataset: Any) -> Report:
    """A dataset that is a phase history or an image; one as it was opened from a store is what the store is."""
    if "image" in dataset and {"x", "y"} <= set(dataset.coords):
        x, y = dataset["x"].values, dataset["y"].values
        rows = [
            *facts.general_rows(dataset.attrs), ("grid", _pixels(x, y)),
            ("in memory", size_text(dataset["image"].nbytes)), *facts.history_rows(dataset.attrs),
        ]  # fmt: skip
        return _report("image", f"{dataset.encoding.get('source', 'a dataset')}", rows, [])
    history = history_of(dataset)
    stored = not isinstance(history, stores.DatasetHistory)
    return _phase_history(history, place(history.path) if stored else None)


def _phase_history(history: stores.PhaseHistory, where: Place | None) -> Report:
    """A phase history at a place; None: it is in memory only."""
    pulses, columns = history.shape
    axis = "range frequencies" if history.raw is None else "fast-time samples (a raw echo, not range-compressed)"
    count = max(len(history.channels), 1)
    rows = [
        *facts.general_rows(history.attrs),
        *([("channels", ", ".join(history.channels))] if history.channels else []),
        ("samples", f"{pulses} pulses x {columns} {axis}, {size_text(8 * pulses * columns * count)} in memory"),
        *([] if where is None else _size(where)),
        *facts.collection_rows(history.collection),
        *facts.history_rows(history.attrs),
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
    rows = [*facts.general_rows(attrs), ("grid", _pixels(x, y)), *_size(where), *facts.history_rows(attrs)]
    return rows, []


def _pixels(x: Any, y: Any) -> str:
    steps = [float(axis[-1] - axis[0]) / max(axis.size - 1, 1) if axis.size else 0.0 for axis in (x, y)]
    if not (x.size and y.size and min(steps) > 0):
        return f"{x.size} x {y.size} pixels"
    ends = ((axis[0], axis[0] + axis.size * step, step) for axis, step in zip((x, y), steps, strict=True))
    (x0, x1, dx), (y0, y1, dy) = (tuple(float(np.round(number, 9)) for number in end) for end in ends)
    return facts.grid_text(Grid(x0, x1, dx, y0, y1, dy))


def _run(where: Place) -> Report:
    record = RunRecord.read(where)
    attrs: Mapping[str, Any] = {}
    seen: Rows = []
    parts = [where, *(member(where, name, record.dimension) for name in record.channels[:1])]
    for part in (*parts, *(part / "segments" / "0" for part in parts)):  # of several, the first
        if (part / "collection.zarr").exists():
            collection, attrs = stores.read_collection(part / "collection.zarr")
            seen = facts.collection_rows(collection)
            break
    made = [name for name in MADE if (where / name).exists()]
    skipped = {"default grid", "footprint"}
    rows = [
        *facts.general_rows(attrs),
        *facts.run_rows(record),
        *_size(where),
        *facts.made_row(made),
        *(row for row in seen if row[0] not in skipped),
    ]
    if not record.finished:
        source = record.input.path or "PH.zarr"
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
        raise InputError(f"{where} does not exist, or is no file; check the path")
    if (name := found.reader) is not None:
        return _described(READERS.get(name), [where], str(where), str(where))
    if found.kind is SCENE and isinstance(where, LocalPlace):
        return _report("scene", str(where), *_scene(where.path))
    raise InputError(found.sentence(where))


def _described(reader: Reader, files: Sequence[Readable], name: str, given: str) -> Report:
    """Find what a reader says of files, which lie at a place of this name, and are given so to its command."""
    found = reader.describe(files, given)
    rows = [
        *found.rows,
        *facts.general_rows(found.attributes),
        *([] if found.collection is None else facts.collection_rows(found.collection)),
        *(("note", note) for note in found.notes),
    ]
    return _report(found.kind, name, rows, [found.command])


def _scene(source: str | Path) -> tuple[Rows, Following]:
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
        *([] if place is None else facts.general_rows({"georeference": place.as_attribute()})),
        ("holds", ", ".join(holds) or "nothing"),
        ("samples", f"{collection.n_pulse} pulses x {collection.n_range_frequency} range frequencies, "
                    f"{size_text(size)}"),
        *facts.collection_rows(collection),
    ]  # fmt: skip
    name = scene.name or "scene"
    return rows, [["plan", str(source)], ["simulate", str(source), "--out", f"{name}.zarr"]]
