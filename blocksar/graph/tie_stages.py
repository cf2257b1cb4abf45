"""The stages that tie the tracks of several collections where they overlap, after the estimate of each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import combinations

from distributed import Client

from blocksar import stores
from blocksar.autofocusing.finishing import Result
from blocksar.autofocusing.selection import Points
from blocksar.autofocusing.tying import LEAST, Places, control_of, places_seen, shared_points, tie_in_turn
from blocksar.autofocusing.work import Work
from blocksar.collection.grid import Grid
from blocksar.graph.kept import Files, kept
from blocksar.graph.track_stages import Estimated, chip_units, files_of, run_stage
from blocksar.graph.track_tasks import find_shared_places, keep_points, keep_shared, tie_track, work_of
from blocksar.graph.units import single_task
from blocksar.progress import Listener
from blocksar.runs.receipts import Run
from blocksar.runs.record import Receipt


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
