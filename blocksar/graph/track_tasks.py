"""The tasks of an estimate of the track's error: each reads samples or small files, and writes one small file.

Receipts have the files' checksums; what a task reads is compared with them. Samples, and chips of them, do not travel
through the scheduler.

Frozen objects of arrays and numbers, kept in files of a run's folder between tasks.

Arrays are written as numpy does, everything else as JSON in bytes; nothing is unpickled. The same object gives the same
bytes.
"""

from __future__ import annotations

import io
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from functools import lru_cache
from typing import Any, TypeVar, get_origin, get_type_hints

import numpy as np

from blocksar import stores
from blocksar.arrays import ComplexArray
from blocksar.autofocusing.anchoring import Control, anchor
from blocksar.autofocusing.chips import ChipPart, take_chips
from blocksar.autofocusing.correction import Correction
from blocksar.autofocusing.estimation import estimate
from blocksar.autofocusing.finishing import HalfEstimate, Result, estimate_half, finish
from blocksar.autofocusing.selection import Candidates, Points, find_candidates, select_points
from blocksar.autofocusing.tying import Places, find_places, tie
from blocksar.autofocusing.work import Work, begin
from blocksar.collection.geometry import Geometry, over_terrain
from blocksar.collection.grid import Grid
from blocksar.errors import InputError, ProcessingError
from blocksar.graph.tasks import sign
from blocksar.places import place
from blocksar.places.place import Place
from blocksar.runs.folder import KEPT
from blocksar.runs.receipts import Run, refuse_replaced
from blocksar.runs.record import Receipt

Files = Mapping[str, str]  # checksums by name, as receipts have them
T = TypeVar("T")
OTHER = "json"  # kind of an entry that is no array


def keep(run: Run, name: str, values: Sequence[Any]) -> dict[str, str]:
    """Write dataclasses of arrays, numbers, texts, dicts and tuples to a file; return its checksum by its path.

    Raises
    ------
    ProcessingError
        If it cannot be written, or another run has taken the folder.
    """
    refuse_replaced(run)
    name = f"{KEPT}/{name}"
    arrays: dict[str, Any] = {}
    for index, value in enumerate(values):
        for field in fields(value):
            content = getattr(value, field.name)
            if isinstance(content, np.ndarray):
                arrays[f"{index}/{field.name}"] = content
            else:
                text = json.dumps(content, default=_plain).encode()
                arrays[f"{index}/{field.name}/{OTHER}"] = np.frombuffer(text, np.uint8)
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    try:
        (run.folder / name).write_bytes(buffer.getvalue())
    except OSError as error:
        raise ProcessingError(f"{run.folder / name} cannot be written ({error.strerror or error})") from error
    return {name: stores.checksum_bytes(buffer.getvalue())}


def _plain(value: Any) -> Any:
    """A number of numpy as one of Python."""
    return value.item()


def kept(run: Run, kind: type[T], files: Files) -> list[T]:
    """Read the dataclasses of one kind that `keep` wrote to these files, in order.

    Raises
    ------
    ProcessingError
        If a file is gone, or no longer has its checksum.
    """
    hints = get_type_hints(kind)
    values = []
    for name, checksum in files.items():
        try:
            data = (run.folder / name).read_bytes()
        except OSError as error:
            raise ProcessingError(f"{run.folder / name} cannot be read ({error.strerror or error})") from error
        if stores.checksum_bytes(data) != checksum:
            raise ProcessingError(f"{run.folder / name} no longer has the checksum of its receipt")
        found: dict[int, dict[str, Any]] = {}
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            for key in archive.files:
                index, field, *other = key.split("/")
                content = json.loads(archive[key].tobytes()) if other else archive[key]
                is_tuple = bool(other) and get_origin(hints[field]) is tuple
                found.setdefault(int(index), {})[field] = tuple(content) if is_tuple else content
        values += [kind(**found[index]) for index in sorted(found)]
    return values


Span = tuple[int, int]


@lru_cache(maxsize=2)
def work_of(folder: str, identity: str, grid: Grid | None) -> Work:
    """Inputs of the stages besides samples, from the collection and the terrain in a folder; equal in all processes.

    A process keeps those of its last two estimates; `identity` tells them apart.
    """
    run = Run(folder=place(folder), identity=identity, threads=1)
    stored, _ = stores.read_collection(run.folder / "collection.zarr")
    collection = stored.centred()
    if not run.terrain.exists():
        return begin(Geometry(collection=collection), grid)
    return begin(over_terrain(collection, stores.read_terrain(run.terrain)), grid)


def _samples(run: Run, source: stores.PhaseHistory, pulses: slice) -> ComplexArray:
    """Samples of some pulses, (pulses, range frequencies); NaN where there is no number."""
    try:
        signal = source.read(pulses, slice(None))
    except InputError as error:
        if source.path == run.compressed:  # the estimate's own store, not the input
            raise ProcessingError(str(error)) from error
        raise
    signal[~np.isfinite(signal)] = np.nan
    return signal


def search_pulses(
    run: Run, unit: str, source: stores.PhaseHistory, spans: Sequence[Span], grid: Grid | None
) -> Receipt:
    """Look for prominent places in some short apertures."""
    started, work = time.perf_counter(), work_of(str(run.folder), run.identity, grid)
    found = [find_candidates(_samples(run, source, slice(*s)), work, slice(*s), threads=run.threads) for s in spans]
    return _kept(run, unit, "search", found, started)


def select(run: Run, unit: str, candidates: Sequence[Files], grid: Grid | None) -> Receipt:
    """Select the points of the estimate from the candidates of each channel, and the channel that they are of."""
    started, work = time.perf_counter(), work_of(str(run.folder), run.identity, grid)
    found = [kept(run, Candidates, files) for files in candidates]
    if not any(one.x.size for some in found for one in some):
        raise InputError(
            f"0 points stand out in the scene, but the track's error needs at least {work.settings.least_points}; "
            "give another --grid, or another collection"
        )
    chosen = select_points(found, work)
    return _kept(run, unit, "select", [chosen.points], started, channel=chosen.channel)


def chips_of_pulses(
    run: Run,
    unit: str,
    source: stores.PhaseHistory,
    pulses: Span,
    points: Files,
    correction: Files,
    grid: Grid | None,
) -> Receipt:
    """Take the points' chips of a block of pulses, along the track as corrected so far."""
    started, work = time.perf_counter(), work_of(str(run.folder), run.identity, grid)
    signal = _samples(run, source, slice(*pulses))
    missing = int(np.isnan(signal).all(axis=1).sum())
    along = _correction(run, work, correction).displacement
    part = take_chips(signal, work, _points(run, points), along, slice(*pulses), threads=run.threads)
    return _kept(run, unit, "chips", [part], started, missing=missing)


def estimate_error(run: Run, unit: str, points: Files, chips: Files, correction: Files, grid: Grid | None) -> Receipt:
    """Estimate the correction once more."""
    started, work = time.perf_counter(), work_of(str(run.folder), run.identity, grid)
    parts, last = kept(run, ChipPart, chips), _correction(run, work, correction)
    better = estimate(work, _points(run, points), parts, last, run.threads)
    return _kept(run, unit, "estimate", [better], started, finished=better.finished, loop=better.history[-1])


def estimate_from_half(
    run: Run, unit: str, number: int, points: Files, chips: Files, correction: Files, grid: Grid | None
) -> Receipt:
    """Estimate the correction from half of the points alone."""
    started, work = time.perf_counter(), work_of(str(run.folder), run.identity, grid)
    parts, last = kept(run, ChipPart, chips), _correction(run, work, correction)
    half = estimate_half(work, _points(run, points), parts, last, number, run.threads)
    return _kept(run, unit, "halves", [half], started)


def finish_estimate(
    run: Run, unit: str, points: Files, chips: Files, correction: Files, halves: Files, grid: Grid | None
) -> Receipt:
    """Test the estimate by halves of the points, and keep the corrected track."""
    started, work = time.perf_counter(), work_of(str(run.folder), run.identity, grid)
    parts, last = kept(run, ChipPart, chips), _correction(run, work, correction)
    result = finish(work, _points(run, points), parts, last, kept(run, HalfEstimate, halves))
    return _kept(run, unit, "finish", [result], started)


def anchor_track(
    run: Run, unit: str, result: Files, control: Control, chips: Files, correction: Files, grid: Grid | None
) -> Receipt:
    """Anchor a corrected track by control points."""
    started, work = time.perf_counter(), work_of(str(run.folder), run.identity, grid)
    parts, last = kept(run, ChipPart, chips), _correction(run, work, correction)
    anchored = anchor(work, kept(run, Result, result)[0], control, parts, last)
    return _kept(run, unit, "anchor", [anchored], started)


def keep_points(run: Run, unit: str, control: Control, grid: Grid | None) -> Receipt:
    """Keep the control points as points of chips."""
    started, work = time.perf_counter(), work_of(str(run.folder), run.identity, grid)
    return _kept(run, unit, "control", [control.points(work)], started)


def keep_shared(run: Run, unit: str, points: Points) -> Receipt:
    """Keep the points that two collections see."""
    started = time.perf_counter()
    return _kept(run, unit, "tie", [points], started)


def find_shared_places(
    run: Run, unit: str, points: Files, chips: Files, correction: Files, grid: Grid | None
) -> Receipt:
    """Find where a collection sees the responses in the chips of points that another one sees too."""
    started, work = time.perf_counter(), work_of(str(run.folder), run.identity, grid)
    parts, last = kept(run, ChipPart, chips), _correction(run, work, correction)
    places = find_places(work, _points(run, points), parts, last)
    return _kept(run, unit, "tie", [places], started)


def tie_track(
    run: Run, unit: str, result: Files, places: Places, chips: Files, correction: Files, grid: Grid | None
) -> Receipt:
    """Tie a corrected track to that of another collection; keep the result, and the correction as it is then."""
    started, work = time.perf_counter(), work_of(str(run.folder), run.identity, grid)
    parts, last = kept(run, ChipPart, chips), _correction(run, work, correction)
    tied = tie(work, kept(run, Result, result)[0], places, parts, last)
    files = keep(run, f"{unit}-result.npz", [tied])
    files |= keep(run, f"{unit}-correction.npz", [replace(last, displacement=-tied.track_error)])
    return sign(run, Receipt(unit=unit, stage="tie", files=files), started)


def _kept(run: Run, unit: str, stage: str, made: Sequence[object], started: float, **found: object) -> Receipt:
    """Keep what a task has made in one file, and sign its receipt."""
    return sign(
        run, Receipt(unit=unit, stage=stage, files=keep(run, f"{unit}.npz", made), found=found or None), started
    )


def _points(run: Run, files: Files) -> Points:
    return kept(run, Points, files)[0]


def _correction(run: Run, work: Work, files: Files) -> Correction:
    return kept(run, Correction, files)[0] if files else Correction.none(work)


def copy_group(run: Run, unit: str, source: Place, target: Place, versions: Mapping[str, str]) -> Receipt:
    """Copy files of the phase history to the corrected store."""
    started = time.perf_counter()
    checksums = stores.copy_files(source, target, versions)
    files = {f"{run.name_of(target)}/{name}": checksum for name, checksum in checksums.items()}
    return sign(run, Receipt(unit=unit, stage="copy", files=files), started)
