"""The division that `auto` takes: the fewest blocks and range sub-blocks that keep the fidelity."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest

from blocksar.planning.block import BlockPlan
from blocksar.planning.division import MAX_BLOCKS, MOST_DIVIDED, MOST_REFERENCES, find_division


@dataclass(frozen=True)
class Division:
    """A plan that knows its losses only."""

    count: int
    parts: int
    migration: float
    rest: float
    blocks: tuple[BlockPlan, ...] = ()
    refusal: str | None = None

    def excess(self, *, migration: bool = True) -> float:
        return self.rest + (self.migration if migration else 0.0)


def divide(
    migration: Callable[[int, int], float],
    rest: Callable[[int], float],
    *,
    workers: int = 2,
    parts: int | None = None,
    jointly: bool = False,
    refused_below: int = 0,
) -> tuple[tuple[int, int], int]:
    """Blocks and sub-blocks that are taken, and how many divisions were planned as a whole."""
    whole = set()

    def plan(count: int, n_parts: int, probe: bool) -> Division:
        if not probe:
            assert (count, n_parts) not in whole, "planned twice"
            whole.add((count, n_parts))
        refusal = "blurred" if count < refused_below else None
        return Division(count, n_parts, migration(count, n_parts), rest(count), refusal=refusal)

    division = find_division(plan, workers=workers, parts=parts, jointly=jointly)
    return (division.count, division.parts), len(whole)


def nothing(*_: int) -> float:
    return 0.0


@pytest.mark.parametrize("needed", [2, 3, 5, 9, 11])
def test_auto_takes_the_fewest_blocks_that_serve(needed: int) -> None:
    taken, whole = divide(nothing, lambda count: 0.99 if count >= needed else (needed / count) ** 2)
    assert taken == (needed, 1)
    assert whole <= 4


def test_many_blocks_are_found_to_a_twelfth() -> None:
    (count, _), _ = divide(nothing, lambda count: (26 / count) ** 2)
    assert 26 <= count <= 28


def test_the_search_ends_where_more_blocks_gain_nothing() -> None:
    (count, _), whole = divide(nothing, lambda count: 2.5 + 0.01 / count)
    assert count == 2
    assert whole == 1
    assert divide(nothing, lambda count: 3.0 - count / 100)[0][0] <= MAX_BLOCKS


@pytest.mark.parametrize(("scattered", "taken"), [(False, 7), (True, 1)])
def test_more_blocks_are_taken_on_a_terrain_only_for_more_than_the_scatter(scattered: bool, taken: int) -> None:
    """Predictions as on dense hills: without a trend, but one is the least."""
    excess, planned = {1: 2.7, 2: 2.6, 4: 2.9, 7: 1.9}, []

    def plan(count: int, n_parts: int, probe: bool) -> Division:
        planned.append(count)
        return Division(count, n_parts, 0.0, excess.get(count, 2.6) * (0.8 if probe else 1.0))

    assert find_division(plan, workers=1, parts=1, scattered=scattered).count == taken
    assert len(set(planned)) == 2 or not scattered


@pytest.mark.parametrize(("least", "most"), [(1.2, 7), (0.9, 13)])
def test_mountains_are_divided_as_long_as_it_helps(least: float, most: int) -> None:
    """The fewest blocks are 12, or where none serve those that are within the scatter of what more of them have."""

    def plan(count: int, n_parts: int, probe: bool) -> Division:
        return Division(count, n_parts, 0.0, max(12 / count, least))

    assert 7 <= find_division(plan, workers=1, parts=1, scattered=True).count <= most


def test_at_least_a_block_a_worker() -> None:
    assert divide(nothing, nothing, workers=5)[0] == (5, 1)
    assert divide(nothing, nothing, workers=1)[0] == (1, 1)


def test_migration_that_varies_with_range_takes_range_sub_blocks() -> None:
    taken, _ = divide(lambda count, parts: 20.0 / parts**2, lambda count: 0.6 / count)
    assert taken[0] == 2
    assert 5 <= taken[1] <= MOST_REFERENCES


def test_refused_divisions_do_not_tell_that_range_sub_blocks_are_of_no_use() -> None:
    """One block of a P band's wide beam was refused, whole and divided; 17 of 8 sub-blocks keep the fidelity."""

    def migration(count: int, parts: int) -> float:
        return 500.0 if count < 3 else 15.0 / parts**2 + 9.0 / count**1.5

    (_, parts), _ = divide(migration, lambda count: 0.1, workers=1, refused_below=3)
    assert parts > 1


def test_a_refused_division_does_not_end_a_search_that_has_sound_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """One of many numbers of blocks may cut a sliver of unlit ground that folds."""
    monkeypatch.setattr("blocksar.planning.division.find_folding", lambda blocks: "folds" if blocks else None)

    def plan(count: int, n_parts: int, probe: bool) -> Division:
        folds = count in (1, 4)
        refusal = "folds" if folds else None
        return Division(
            count, n_parts, 0.0, 9.0 if folds else 6.0 / count, blocks=(None,) if folds else (), refusal=refusal
        )  # type: ignore[arg-type]

    assert find_division(plan, workers=2, parts=None).count == 6
    assert find_division(plan, workers=1, parts=None).count == 1  # nothing sound comes before it


def test_migration_that_varies_with_angle_takes_blocks() -> None:
    taken, _ = divide(lambda count, parts: 20.0 / count**1.7, partial(nothing))
    assert taken == (6, 1)


def test_sub_blocks_that_were_asked_for_stay() -> None:
    assert divide(lambda count, parts: 3.0 / count / parts**2, nothing, parts=3)[0] == (2, 3)


@pytest.mark.parametrize(("by_angle", "by_range"), [(28.5, 1.3), (25.0, 2.0), (30.0, 0.5)])
def test_blocks_and_sub_blocks_reduce_migration_together_where_neither_does_alone(
    by_angle: float, by_range: float
) -> None:
    """Close to the fewest sub-blocks in all, by looking at every division."""

    def migration(count: int, parts: int) -> float:
        return (by_angle / count + by_range / parts) ** 2

    rest = 0.2
    assert migration(MAX_BLOCKS, 1) > 1
    count, parts = np.mgrid[1 : MOST_DIVIDED + 1, 1 : MOST_REFERENCES + 1]
    fewest = int((count * parts)[(by_angle / count + by_range / parts) ** 2 + rest <= 1].min())
    taken, whole = divide(migration, lambda count: rest, jointly=True)
    assert migration(*taken) + rest <= 1
    assert fewest <= taken[0] * taken[1] <= 1.15 * fewest
    assert whole == 1
    alone = divide(migration, lambda count: rest, parts=1)[0]
    assert divide(migration, lambda count: rest, jointly=True, parts=1)[0] == alone


@pytest.mark.parametrize("rest", [0.2, 1.2])
def test_no_division_jointly_where_none_keeps_the_fidelity(rest: float) -> None:
    """Sub-blocks that are too many, or another cause that costs too much: the closest of few blocks is taken."""

    def migration(count: int, parts: int) -> float:
        return (60 / count + 30 / parts) ** 2 if rest < 1 else (28.5 / count + 1.3 / parts) ** 2

    taken, whole = divide(migration, lambda count: rest, jointly=True)
    assert taken == divide(migration, lambda count: rest)[0]
    assert taken[0] <= MAX_BLOCKS and whole == 1
