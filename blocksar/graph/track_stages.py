"""The stages of an estimate of the track's error, and of the store that it corrects, as task graphs.

What each step writes lies in the folder of the estimate, with receipts as in a run, so that a killed estimate goes on
where it was.

The tasks of an estimate of the track's error: each reads samples or small files, and writes one small file.

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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache, partial
from itertools import chain, combinations, islice
from typing import Any, TypeVar, get_origin, get_type_hints

import numpy as np
from distributed import Client

from blocksar import stores
from blocksar.arrays import ComplexArray
from blocksar.autofocusing.anchoring import Control, anchor
from blocksar.autofocusing.chips import ChipPart, take_chips
from blocksar.autofocusing.correction import Correction
from blocksar.autofocusing.estimation import estimate
from blocksar.autofocusing.finishing import HalfEstimate, Result, estimate_half, finish
from blocksar.autofocusing.selection import Candidates, Points, find_candidates, select_points
from blocksar.autofocusing.tying import (
    LEAST,
    Places,
    control_of,
    find_places,
    places_seen,
    shared_points,
    tie,
    tie_in_turn,
)
from blocksar.autofocusing.work import Work, begin
from blocksar.chunks import COPY_BYTES
from blocksar.collection.geometry import Geometry, over_terrain
from blocksar.collection.grid import Grid
from blocksar.collection.terrain import Terrain
from blocksar.errors import InputError, ProcessingError
from blocksar.focusing.method import Cutting
from blocksar.graph.segments import Segment
from blocksar.graph.stages import prepare_samples
from blocksar.graph.tasks import sign
from blocksar.graph.units import Unit, run_units, single_task, spans
from blocksar.places import place
from blocksar.places.place import Place
from blocksar.progress import Listener
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


SEARCHED = 4  # short apertures that a task searches
MISSING = 1 / 3  # of the pulses; with more of them missing, the error cannot be followed across the gaps


@dataclass(frozen=True, kw_only=True, eq=False)
class Estimated:
    """The estimate of a track, and what it was made from.

    Attributes
    ----------
    receipts : list of Receipt
    result : Result
    run : Run
        Of the estimate.
    source : PhaseHistory
        The samples of the channel that was taken, range-compressed.
    points, correction, finished : mapping of str to str
        Files of the points, of the correction with which chips are taken, and of the result.
    token : str
        Hash of everything that the correction depends on.
    """

    receipts: list[Receipt]
    result: Result
    run: Run
    source: stores.PhaseHistory
    points: Files
    correction: Files
    finished: Files
    token: str


def estimate_track(
    client: Client,
    channels: Sequence[stores.PhaseHistory],
    run: Run,
    grid: Grid | None,
    control: Control | None,
    listener: Listener,
    threads: int,
    terrain: Terrain | None = None,
    interference: Cutting | None = None,
) -> Estimated:
    """Estimate the error of a phase history's track.

    Its channels have one track: it is estimated from the one that `select_points` takes. Control points, if there are
    some, anchor what the samples alone do not tell. A task that runs alone has `threads`. Points stand on the terrain,
    by default on the plane z = ground_height. Interference is cut first, if that is asked for.

    Raises
    ------
    InputError
        If the samples do not tell of it.
    """
    collection, store = channels[0].collection, run.folder / "collection.zarr"
    run.establish(store, lambda: stores.write_collection(store, collection))
    if terrain is not None:
        run.establish(run.terrain, partial(stores.write_terrain, run.terrain, terrain))
    work = work_of(str(run.folder), run.identity, grid)
    chosen, source, receipts = _select(client, channels, run, work, grid, listener, interference)
    points, stage = files_of(receipts[-1:]), partial(run_stage, client, run, listener)
    alone = replace(run, threads=threads)
    correction: Files = {}
    for loop in range(1, work.settings.loops + 1):
        chips = stage(f"chips-{loop}", _chips(client, run, source, work, points, correction, str(loop), grid))
        if loop == 1:
            _refuse_gaps(chips, collection.n_pulse)
        arguments = (points, files_of(chips), correction, grid)
        estimated = stage(
            f"estimate-{loop}",
            [single_task(client, alone, "estimate", f"correction-{loop}", estimate_error, *arguments)],
        )
        receipts += [*chips, *estimated]
        correction = estimated[0].files
        if (estimated[0].found or {})["finished"]:
            break
    last = (points, files_of(chips), correction)
    halves = stage(
        "halves", [single_task(client, run, "halves", f"half-{n}", estimate_from_half, n, *last, grid) for n in (0, 1)]
    )
    finished = stage(
        "test", [single_task(client, run, "test", "track", finish_estimate, *last, files_of(halves), grid)]
    )
    receipts += [*halves, *finished]
    if control is not None:
        known = stage("control", [single_task(client, run, "control", "control", keep_points, control, grid)])
        chips = stage("control-chips", _chips(client, run, source, work, files_of(known), correction, "control", grid))
        given = (files_of(finished), control, files_of(chips), correction, grid)
        finished = stage("anchor", [single_task(client, run, "anchor", "anchored", anchor_track, *given)])
        receipts += [*known, *chips, *finished]
    result = kept(run, Result, finished[0].files)[0]
    if len(channels) > 1:
        result = replace(result, figures={**result.figures, "channel": channels[0].channels[chosen]})
    return Estimated(
        receipts=receipts, result=result, run=run, source=source, points=points, correction=correction,
        finished=files_of(finished), token=run.identity,
    )  # fmt: skip


def _select(
    client: Client,
    channels: Sequence[stores.PhaseHistory],
    run: Run,
    work: Work,
    grid: Grid | None,
    listener: Listener,
    interference: Cutting | None,
) -> tuple[int, stores.PhaseHistory, list[Receipt]]:
    """Select points and the channel that they are of: its number, its samples, and receipts, the last of the points."""
    numbers = range(len(channels)) if len(channels) > 1 else [None]
    segments, compressed = prepare_samples(
        client,
        [
            Segment(collection=number, source=source, geometry=work.geometry, plan=None, interference=interference)
            for number, source in zip(numbers, channels, strict=True)
        ],
        run,
        listener,
    )
    stage = partial(run_stage, client, run, listener)
    searches = [_search(client, run, segment, work, grid) for segment in segments]
    searched = stage("search", list(chain(*searches)))
    done = iter(searched)
    candidates = [files_of(list(islice(done, len(some)))) for some in searches]
    selected = stage("select", [single_task(client, run, "select", "points", select, candidates, grid)])
    chosen = (selected[0].found or {})["channel"]
    return chosen, segments[chosen].source, [*chain(*compressed), *searched, *selected]


def run_stage(client: Client, run: Run, listener: Listener, name: str, units: Sequence[Unit]) -> list[Receipt]:
    """Run the units of a stage, which read samples of the input."""
    # A refusal by any stage is about the samples, also where they are those of a raw echo, compressed.
    return run_units(client, name, units, run, listener, per_worker=2, reading_input=[unit for unit, _ in units])


def files_of(receipts: Sequence[Receipt]) -> Files:
    """The files of units, with their checksums."""
    return {name: checksum for receipt in receipts for name, checksum in receipt.files.items()}


def _search(client: Client, run: Run, segment: Segment, work: Work, grid: Grid | None) -> list[Unit]:
    """The search in the short apertures of a channel, which is a segment's source and has its `collection` number."""
    units, source = [], segment.source
    of = "" if segment.collection is None else f"-of-channel-{segment.collection}"
    for first, end in spans(len(work.apertures), SEARCHED):
        pulses = [(one.start, one.stop) for one in work.apertures[first:end]]
        within = source.within(pulses=slice(pulses[0][0], pulses[-1][1]))
        units.append(single_task(client, run, "search", f"candidates-{first}{of}", search_pulses, within, pulses, grid))
    return units


def chip_units(client: Client, one: Estimated, points: Files, name: str, grid: Grid | None) -> list[Unit]:
    """The units that take chips of other points along a corrected track; `name` tells them apart."""
    work = work_of(str(one.run.folder), one.run.identity, grid)
    return _chips(client, one.run, one.source, work, points, one.correction, name, grid)


def _chips(
    client: Client,
    run: Run,
    source: stores.PhaseHistory,
    work: Work,
    points: Files,
    correction: Files,
    name: str,
    grid: Grid | None,
) -> list[Unit]:
    return [
        single_task(
            client, run, "chips", f"chips-{name}-{pulses.start}", chips_of_pulses, source.within(pulses=pulses),
            (pulses.start, pulses.stop), points, correction, grid,
        )
        for pulses in work.blocks
    ]  # fmt: skip


def _refuse_gaps(chips: Sequence[Receipt], n_pulse: int) -> None:
    missing = sum(int((receipt.found or {}).get("missing", 0)) for receipt in chips)
    if missing > MISSING * n_pulse:
        raise InputError(
            f"signal is NaN in {missing} of {n_pulse} pulses, and the track's error cannot be followed where more than "
            f"{MISSING:.0%} are missing; give the part of the collection that has its pulses"
        )


def copy_store(client: Client, source: Place, target: Place, run: Run, listener: Listener) -> list[Receipt]:
    """Copy the files of a store, all but its metadata and positions, to a place in the run's folder."""
    versions = stores.files_to_copy(source)
    units = []
    for group in stores.groups_of(versions, COPY_BYTES):
        some: dict[str, Any] = {name: versions[name] for name in group}
        units.append(
            single_task(client, run, "copy", f"copy-{group[0].replace('/', '-')}", copy_group, source, target, some)
        )
    return run_stage(client, run, listener, "copy", units)


def tie_tracks(
    client: Client, estimates: Sequence[Estimated], labels: Sequence[str], grid: Grid | None, listener: Listener
) -> list[Estimated]:
    """Move the tracks of several collections, so that their images agree in place where they overlap.

    The order is that of `tie_in_turn`. `labels` are what the results' figures call the collections.
    """
    works = [work_of(str(one.run.folder), one.run.identity, grid) for one in estimates]
    points = [kept(one.run, Points, one.points)[0] for one in estimates]
    shared = {
        (i, j): shared_points(works[i], works[j], [points[i], points[j]]).x.size
        for i, j in combinations(range(len(estimates)), 2)
    }
    tied = list(estimates)

    def attempt(one: int, other: int) -> bool:
        known = shared_points(works[one], works[other], [points[one], points[other]])
        tied[other] = _tie(client, tied[one], tied[other], works[other], known, labels[one], grid, listener)
        return bool(tied[other].result.figures["tied"]["points"])

    for apart in tie_in_turn(len(estimates), shared, attempt):
        tied[apart] = _alone(tied[apart])
    return tied


def _alone(one: Estimated) -> Estimated:
    return replace(one, result=_noted(one.result, {"points": 0}))


def _noted(result: Result, tied: dict[str, object]) -> Result:
    return replace(result, figures={**result.figures, "tied": tied})


def _tie(
    client: Client,
    one: Estimated,
    other: Estimated,
    work: Work,
    shared: Points,
    label: str,
    grid: Grid | None,
    listener: Listener,
) -> Estimated:
    """Tie the track of another collection, with this `work`, to that of the first by the points that both see."""
    # What is found depends on both, and on what the first is tied to.
    token = stores.checksum_bytes(f"{one.token} {other.run.identity}".encode())[:12]
    known = _one(client, one.run, listener, f"shared-{token}", keep_shared, shared)
    chips = run_stage(
        client, one.run, listener, "tie", chip_units(client, one, files_of([known]), f"shared-{token}", grid)
    )
    given = (files_of([known]), files_of(chips), one.correction, grid)
    found = _one(client, one.run, listener, f"places-{token}", find_shared_places, *given)
    receipts = [*other.receipts, known, *chips, found]
    places = places_seen(work, kept(one.run, Places, found.files)[0])
    if places.x.size < LEAST:
        return _alone(replace(other, receipts=receipts))
    points = _one(client, other.run, listener, f"tied-points-{token}", keep_points, control_of(places), grid)
    chips = run_stage(
        client, other.run, listener, "tie", chip_units(client, other, files_of([points]), f"tied-{token}", grid)
    )
    given_ = (other.finished, places, files_of(chips), other.correction, grid)
    done = _one(client, other.run, listener, f"tied-{token}", tie_track, *given_)
    result, correction = (_named(done.files, name) for name in ("result", "correction"))
    moved = kept(other.run, Result, result)[0]
    figures = {**other.result.figures, **moved.figures}
    figures["tied"] = {**figures["tied"], "to": label}
    return replace(
        other, receipts=[*receipts, points, *chips, done], token=token, correction=correction,
        result=replace(moved, figures=figures),
    )  # fmt: skip


def _one(
    client: Client, run: Run, listener: Listener, unit: str, task: Callable[..., Receipt], *given: object
) -> Receipt:
    """Run a single task."""
    return run_stage(client, run, listener, "tie", [single_task(client, run, "tie", unit, task, *given)])[0]


def _named(files: Files, word: str) -> Files:
    return {name: checksum for name, checksum in files.items() if name.endswith(f"{word}.npz")}
