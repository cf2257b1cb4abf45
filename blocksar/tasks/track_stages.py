"""Stages that estimate a track's error and write the corrected store, as lists of units.

Each task reads samples or small files, and writes a small file in the folder of the estimate: frozen objects of arrays
and numbers. Arrays are written as numpy does, everything else as JSON in bytes; nothing is unpickled. The same object
gives the same bytes. Receipts have the files' checksums, and what a task reads is compared with them: neither samples
nor chips of them travel through the scheduler, and a killed estimate goes on where it was.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache, partial
from itertools import chain, combinations
from typing import Any, NamedTuple, TypeVar, get_origin, get_type_hints

import numpy as np

from blocksar import stores
from blocksar.arrays import ComplexArray
from blocksar.autofocusing.anchoring import Control, anchor
from blocksar.autofocusing.chips import ChipPart, take_chips
from blocksar.autofocusing.estimation import estimate
from blocksar.autofocusing.finishing import HalfEstimate, Result, estimate_half, finish
from blocksar.autofocusing.selection import Candidates, Points, find_candidates, select_points
from blocksar.autofocusing.track_correction import Correction
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
from blocksar.graph.units import Executor, Unit
from blocksar.imaging.method import Cutting
from blocksar.places import place
from blocksar.places.place import Place
from blocksar.planning.tiling import chunk_spans
from blocksar.runs.folder import KEPT
from blocksar.runs.receipts import Run, refuse_replaced
from blocksar.runs.record import Receipt
from blocksar.tasks.preparing import prepare_samples
from blocksar.tasks.segments import Segment

Files = Mapping[str, str]  # checksums by name, as receipts have them
T = TypeVar("T")
OTHER = "json"  # kind of an entry that is no array


def keep(run: Run, name: str, values: Sequence[Any]) -> dict[str, str]:
    """Save dataclasses to a file; return {path: checksum}.

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
    """Convert a numpy number to a Python one."""
    return value.item()


def kept(run: Run, kind: type[T], files: Files) -> list[T]:
    """Load dataclasses of one kind that `keep` saved to files, in order.

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
    """Make the inputs of the stages from the collection and terrain in a folder; equal in all processes.

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


class ChipFiles(NamedTuple):
    """Paths of saved points, chips and correction; `grid` is where points are searched."""

    points: Files
    chips: Files
    correction: Files
    grid: Grid | None

    def read(self, run: Run) -> tuple[Work, Points, list[ChipPart], Correction]:
        """Load the files of an estimate in a run's folder."""
        work = work_of(str(run.folder), run.identity, self.grid)
        known = kept(run, Correction, self.correction)[0] if self.correction else Correction.none(work)
        return work, kept(run, Points, self.points)[0], kept(run, ChipPart, self.chips), known


def search_pulses(
    run: Run, unit: str, source: stores.PhaseHistory, spans: Sequence[Span], grid: Grid | None
) -> Receipt:
    """Search for prominent places in some short apertures."""
    work = work_of(str(run.folder), run.identity, grid)
    found = [find_candidates(_samples(run, source, slice(*s)), work, slice(*s), threads=run.threads) for s in spans]
    return _kept(run, unit, "search", found)


def select(run: Run, unit: str, candidates: Sequence[Files], grid: Grid | None) -> Receipt:
    """Select the points of the estimate from the candidates of each channel, and the channel that they are of."""
    work = work_of(str(run.folder), run.identity, grid)
    found = [kept(run, Candidates, files) for files in candidates]
    if not any(one.x.size for some in found for one in some):
        raise InputError(
            f"0 points stand out in the scene, but the track's error needs at least {work.settings.least_points}; "
            "give another --grid, or another collection"
        )
    chosen = select_points(found, work)
    return _kept(run, unit, "select", [chosen.points], channel=chosen.channel)


def chips_of_pulses(run: Run, unit: str, source: stores.PhaseHistory, pulses: Span, given: ChipFiles) -> Receipt:
    """Take the points' chips from a block of pulses, along the track as corrected so far."""
    signal, (work, points, _, known) = _samples(run, source, slice(*pulses)), given.read(run)
    missing = int(np.isnan(signal).all(axis=1).sum())
    part = take_chips(signal, work, points, known.displacement, slice(*pulses), threads=run.threads)
    return _kept(run, unit, "chips", [part], missing=missing)


def estimate_error(run: Run, unit: str, given: ChipFiles) -> Receipt:
    """Estimate the correction once more."""
    better = estimate(*given.read(run), run.threads)
    return _kept(run, unit, "estimate", [better], finished=better.finished, loop=better.history[-1])


def estimate_from_half(run: Run, unit: str, given: ChipFiles, number: int) -> Receipt:
    """Estimate the correction from half of the points."""
    return _kept(run, unit, "halves", [estimate_half(*given.read(run), number, run.threads)])


def finish_estimate(run: Run, unit: str, given: ChipFiles, halves: Files) -> Receipt:
    """Compare the estimates from halves of the points, and save the corrected track."""
    return _kept(run, unit, "finish", [finish(*given.read(run), kept(run, HalfEstimate, halves))])


def anchor_track(run: Run, unit: str, given: ChipFiles, result: Files, control: Control) -> Receipt:
    """Anchor a corrected track by control points."""
    work, _, parts, last = given.read(run)
    return _kept(run, unit, "anchor", [anchor(work, kept(run, Result, result)[0], control, parts, last)])


def keep_points(run: Run, unit: str, stage: str, points: Points) -> Receipt:
    """Save control points, or those seen by two collections, as points to take chips of."""
    return _kept(run, unit, stage, [points])


def find_shared_places(run: Run, unit: str, given: ChipFiles) -> Receipt:
    """Find the places where a collection sees responses at points that another one also sees."""
    return _kept(run, unit, "tie", [find_places(*given.read(run))])


def tie_track(run: Run, unit: str, given: ChipFiles, result: Files, places: Places) -> Receipt:
    """Tie a corrected track to that of another collection; save the result and the correction that it leads to."""
    work, _, parts, last = given.read(run)
    tied = tie(work, kept(run, Result, result)[0], places, parts, last)
    files = keep(run, f"{unit}-result.npz", [tied])
    files |= keep(run, f"{unit}-correction.npz", [replace(last, displacement=-tied.track_error)])
    return Receipt(unit=unit, stage="tie", files=files)


def _kept(run: Run, unit: str, stage: str, made: Sequence[object], **found: object) -> Receipt:
    """Save the result of a task to one file; return the receipt with its checksum."""
    return Receipt(unit=unit, stage=stage, files=keep(run, f"{unit}.npz", made), found=found or None)


def copy_group(run: Run, unit: str, source: Place, target: Place, versions: Mapping[str, str]) -> Receipt:
    """Copy files of the phase history to the corrected store."""
    checksums = stores.copy_files(source, target, versions)
    files = {f"{run.name_of(target)}/{name}": checksum for name, checksum in checksums.items()}
    return Receipt(unit=unit, stage="copy", files=files)


SEARCHED = 4  # short apertures that a task searches
MISSING = 1 / 3  # of the pulses; with more of them missing, the error cannot be followed across the gaps


class Stages:
    """Runner of an estimate's stages, in a run's folder, that collects the receipts of all units.

    Points are looked for in the grid.
    """

    def __init__(self, executor: Executor, run: Run, grid: Grid | None) -> None:
        self.executor, self.run, self.grid = executor, run, grid
        self.receipts: list[Receipt] = []

    @cached_property
    def work(self) -> Work:
        return work_of(str(self.run.folder), self.run.identity, self.grid)

    def unit(self, step: str, name: str, task: Callable[..., Receipt], *arguments: object, threads: int = 0) -> Unit:
        """Make a unit of the estimate; `threads` overrides the run's."""
        run = replace(self.run, threads=threads or self.run.threads)
        # A refusal by any stage is about the samples, also where they are those of a raw echo, compressed.
        return Unit(step, run, name, task, arguments, reads_input=True)

    def run_units(self, stage: str, *units: Unit) -> list[Receipt]:
        """Run a stage; return its receipts."""
        done = self.executor.run_units(stage, units, per_worker=2)
        self.receipts.extend(done)
        return done

    def run_one(
        self, stage: str, name: str, task: Callable[..., Receipt], *arguments: object, threads: int = 0
    ) -> Receipt:
        """Run a stage of one unit; return its receipt."""
        [done] = self.run_units(stage, self.unit(stage, name, task, *arguments, threads=threads))
        return done

    def take_chips(
        self, stage: str, name: str, source: stores.PhaseHistory, points: Files, correction: Files
    ) -> ChipFiles:
        """Take chips of points along a corrected track; `name` distinguishes several sets."""
        given = ChipFiles(points, {}, correction, self.grid)
        done = self.run_units(
            stage,
            *(
                self.unit(
                    "chips", f"{name}-{pulses.start}", chips_of_pulses, source.within(pulses=pulses),
                    (pulses.start, pulses.stop), given,
                )
                for pulses in self.work.blocks
            ),
        )  # fmt: skip
        return given._replace(chips=files_of(done))


@dataclass(frozen=True, kw_only=True, eq=False)
class Estimated:
    """Estimate of a track, with its source and files.

    Attributes
    ----------
    receipts : list of Receipt
    result : Result
    stages : Stages
    source : PhaseHistory
        The samples of the channel that was taken, range-compressed.
    points, correction, finished : mapping of str to str
        Files of the points, of the correction with which chips are taken, and of the result.
    token : str
        Hash of everything that the correction depends on.
    """

    receipts: list[Receipt]
    result: Result
    stages: Stages
    source: stores.PhaseHistory
    points: Files
    correction: Files
    finished: Files
    token: str


def estimate_track(
    executor: Executor,
    channels: Sequence[stores.PhaseHistory],
    run: Run,
    grid: Grid | None,
    control: Control | None,
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
    stages = Stages(executor, run, grid)
    sources = _prepare(stages, channels, interference)
    chosen, points = _select(stages, sources)
    source = sources[chosen].source
    correction: Files = {}
    for loop in range(1, stages.work.settings.loops + 1):
        given = stages.take_chips(f"chips-{loop}", f"chips-{loop}", source, points, correction)
        if loop == 1:
            _refuse_gaps(stages.receipts, collection.n_pulse)
        better = stages.run_one(f"estimate-{loop}", f"correction-{loop}", estimate_error, given, threads=threads)
        correction = better.files
        if (better.found or {})["finished"]:
            break
    last = given._replace(correction=correction)
    halves = [stages.unit("halves", f"half-{n}", estimate_from_half, last, n) for n in (0, 1)]
    finished = stages.run_one("test", "track", finish_estimate, last, files_of(stages.run_units("halves", *halves)))
    if control is not None:
        known = stages.run_one("control", "control", keep_points, "control", control.points(stages.work))
        given = stages.take_chips("control-chips", "chips-control", source, known.files, correction)
        finished = stages.run_one("anchor", "anchored", anchor_track, given, finished.files, control)
    result = kept(run, Result, finished.files)[0]
    if len(channels) > 1:
        result = replace(result, figures={**result.figures, "channel": channels[0].channels[chosen]})
    return Estimated(
        receipts=stages.receipts[:], result=result, stages=stages, source=source, points=points, correction=correction,
        finished=finished.files, token=run.identity,
    )  # fmt: skip


def _prepare(stages: Stages, channels: Sequence[stores.PhaseHistory], interference: Cutting | None) -> list[Segment]:
    """Range-compress channels and cut interference; returns each as a segment, its number as `collection`."""
    numbers = range(len(channels)) if len(channels) > 1 else [None]
    segments, compressed = prepare_samples(
        stages.executor,
        [
            Segment(collection=number, source=source, geometry=stages.work.geometry, interference=interference)
            for number, source in zip(numbers, channels, strict=True)
        ],
        stages.run,
    )
    stages.receipts.extend(chain(*compressed))
    return segments


def _select(stages: Stages, channels: Sequence[Segment]) -> tuple[int, Files]:
    """Select points; return the number of the channel they are from, and their file."""
    searches = [
        (
            number,
            stages.unit(
                "search",
                f"candidates-{first}" + ("" if channel.collection is None else f"-of-channel-{channel.collection}"),
                search_pulses,
                channel.source.within(pulses=slice(pulses[0][0], pulses[-1][1])),
                pulses,
                stages.grid,
            ),
        )
        for number, channel in enumerate(channels)
        for first, pulses in _search_spans(stages.work)
    ]
    found = stages.run_units("search", *(unit for _, unit in searches))
    candidates = [
        files_of(receipt for (number, _), receipt in zip(searches, found, strict=True) if number == channel)
        for channel in range(len(channels))
    ]
    selected = stages.run_one("select", "points", select, candidates, stages.grid)
    return (selected.found or {})["channel"], selected.files


def _search_spans(work: Work) -> list[tuple[int, list[Span]]]:
    """Short apertures of each task of the search, with the number of the first."""
    apertures = [(one.start, one.stop) for one in work.apertures]
    return [(first, apertures[first:end]) for first, end in chunk_spans(0, len(apertures), SEARCHED)]


def files_of(receipts: Iterable[Receipt]) -> Files:
    """Collect the files of units, with checksums."""
    return {name: checksum for receipt in receipts for name, checksum in receipt.files.items()}


def _refuse_gaps(receipts: Sequence[Receipt], n_pulse: int) -> None:
    """Refuse samples with too many missing pulses, as counted in the receipts of chips."""
    missing = sum(int((receipt.found or {}).get("missing", 0)) for receipt in receipts if receipt.stage == "chips")
    if missing > MISSING * n_pulse:
        raise InputError(
            f"signal is NaN in {missing} of {n_pulse} pulses, and the track's error cannot be followed where more than "
            f"{MISSING:.0%} are missing; give the part of the collection that has its pulses"
        )


def copy_store(executor: Executor, source: Place, target: Place, run: Run) -> list[Receipt]:
    """Copy the files of a store, all but its metadata and positions, to a place in the run's folder."""
    versions, stages = stores.files_to_copy(source), Stages(executor, run, None)
    units = []
    for group in stores.groups_of(versions, COPY_BYTES):
        some: dict[str, Any] = {name: versions[name] for name in group}
        units.append(stages.unit("copy", f"copy-{group[0].replace('/', '-')}", copy_group, source, target, some))
    return stages.run_units("copy", *units)


def tie_tracks(estimates: Sequence[Estimated], labels: Sequence[str]) -> list[Estimated]:
    """Tie the tracks of several collections, so that their images agree in place where they overlap.

    The order is that of `tie_in_turn`. `labels` are what the results' figures call the collections.
    """
    works = [one.stages.work for one in estimates]
    points = [kept(one.stages.run, Points, one.points)[0] for one in estimates]

    def common(i: int, j: int) -> Points:
        return shared_points(works[i], works[j], [points[i], points[j]])

    shared = {(i, j): common(i, j).x.size for i, j in combinations(range(len(estimates)), 2)}
    tied = list(estimates)

    def attempt(one: int, other: int) -> bool:
        tied[other] = _tie(tied[one], tied[other], common(one, other), labels[one])
        return bool(tied[other].result.figures["tied"]["points"])

    for apart in tie_in_turn(len(estimates), shared, attempt):
        tied[apart] = _alone(tied[apart])
    return tied


def _alone(one: Estimated) -> Estimated:
    return replace(one, result=_noted(one.result, {"points": 0}))


def _noted(result: Result, tied: dict[str, object]) -> Result:
    return replace(result, figures={**result.figures, "tied": tied})


def _tie(one: Estimated, other: Estimated, shared: Points, label: str) -> Estimated:
    """Tie the track of another collection to that of the first by points that both see."""
    first, second = one.stages, other.stages
    before = len(first.receipts), len(second.receipts)
    # What is found depends on both, and on what the first is tied to.
    token = stores.checksum_bytes(f"{one.token} {second.run.identity}".encode())[:12]
    known = first.run_one("tie", f"shared-{token}", keep_points, "tie", shared)
    given = first.take_chips("tie", f"chips-shared-{token}", one.source, known.files, one.correction)
    found = first.run_one("tie", f"places-{token}", find_shared_places, given)
    receipts = [*other.receipts, *first.receipts[before[0] :]]
    places = places_seen(second.work, kept(first.run, Places, found.files)[0])
    if places.x.size < LEAST:
        return _alone(replace(other, receipts=receipts))
    control = control_of(places).points(second.work)
    points = second.run_one("tie", f"tied-points-{token}", keep_points, "control", control)
    given = second.take_chips("tie", f"chips-tied-{token}", other.source, points.files, other.correction)
    done = second.run_one("tie", f"tied-{token}", tie_track, given, other.finished, places)
    result, correction = (_named(done.files, name) for name in ("result", "correction"))
    moved = kept(second.run, Result, result)[0]
    figures = {**other.result.figures, **moved.figures}
    figures["tied"] = {**figures["tied"], "to": label}
    return replace(
        other, receipts=[*receipts, *second.receipts[before[1] :]], token=token, correction=correction,
        result=replace(moved, figures=figures),
    )  # fmt: skip


def _named(files: Files, word: str) -> Files:
    return {name: checksum for name, checksum in files.items() if name.endswith(f"{word}.npz")}
