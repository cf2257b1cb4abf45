"""The stages of an estimate of the track's error, and of the store that it corrects, as task graphs.

What each step writes lies in the folder of the estimate, with receipts as in a run, so that a killed estimate goes on
where it was.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, combinations, islice
from typing import Any

from distributed import Client

from blocksar import stores
from blocksar.autofocusing.anchoring import Control
from blocksar.autofocusing.finishing import Result
from blocksar.autofocusing.selection import Points
from blocksar.autofocusing.tying import LEAST, Places, control_of, places_seen, shared_points, tie_in_turn
from blocksar.autofocusing.work import Work
from blocksar.chunks import COPY_BYTES
from blocksar.collection.grid import Grid
from blocksar.collection.terrain import Terrain
from blocksar.errors import InputError
from blocksar.focusing.method import Cutting
from blocksar.graph.segments import Segment
from blocksar.graph.stages import prepare_samples
from blocksar.graph.track_tasks import (
    Files,
    anchor_track,
    chips_of_pulses,
    copy_group,
    estimate_error,
    estimate_from_half,
    find_shared_places,
    finish_estimate,
    keep_points,
    keep_shared,
    kept,
    search_pulses,
    select,
    tie_track,
    work_of,
)
from blocksar.graph.units import Unit, run_units, single_task, spans
from blocksar.places.place import Place
from blocksar.progress import Listener
from blocksar.runs.receipts import Run
from blocksar.runs.record import Receipt

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
