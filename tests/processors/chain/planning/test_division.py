"""The division that `auto` takes: the fewest blocks that keep the fidelity."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest

from blocksar.processors.chain.planning.block import BlockPlan
from blocksar.processors.chain.planning.planner import MAX_BLOCKS, find_division


@dataclass(frozen=True)
class Division:
    """A plan that knows its excess only."""

    count: int
    over: float
    blocks: tuple[BlockPlan, ...] = ()
    refusal: str | None = None

    def excess(self) -> float:
        return self.over


def divide(excess: Callable[[int], float], *, workers: int = 2) -> tuple[int, int]:
    """Blocks that are taken, and how many divisions were planned as a whole."""
    whole = set()

    def plan(count: int, probe: bool) -> Division:
        if not probe:
            assert count not in whole, "planned twice"
            whole.add(count)
        return Division(count, excess(count))

    return find_division(plan, workers=workers).count, len(whole)


@pytest.mark.parametrize("needed", [2, 3, 5, 9, 11])
def test_auto_takes_the_fewest_blocks_that_serve(needed: int) -> None:
    taken, whole = divide(lambda count: 0.99 if count >= needed else (needed / count) ** 2)
    assert taken == needed
    assert whole <= 4


def test_many_blocks_are_found_to_a_twelfth() -> None:
    count, _ = divide(lambda count: (26 / count) ** 2)
    assert 26 <= count <= 28


def test_the_search_ends_where_more_blocks_gain_nothing() -> None:
    seen: list[int] = []

    def excess(count: int) -> float:
        seen.append(count)
        return 2.5 + 0.01 / count

    assert divide(excess) == (2, 1)
    assert {*seen} == {2, MAX_BLOCKS}, "the most blocks tell that those in between do not serve either"
    assert divide(lambda count: 3.0 - count / 100)[0] <= MAX_BLOCKS


def test_one_division_among_scattered_ones_serves() -> None:
    """Predictions as on dense hills: without a trend, but one is the least, and the most blocks do not serve."""
    assert divide(lambda count: {5: 0.9}.get(count, 1.3), workers=1)[0] == 5
    assert divide(lambda count: {5: 0.9}.get(count, 1.6), workers=1)[0] == 1  # given up: more than the scatter


@pytest.mark.parametrize(("least", "taken"), [(1.2, 7), (0.9, 12)])
def test_mountains_are_divided_as_long_as_it_helps(least: float, taken: int) -> None:
    """The fewest blocks are 12, or where none serve those that are about as good as more of them."""
    assert divide(lambda count: max(12 / count, least), workers=1)[0] == taken


def test_at_least_a_block_a_worker() -> None:
    assert divide(lambda _: 0.0, workers=5)[0] == 5
    assert divide(lambda _: 0.0, workers=1)[0] == 1


def test_a_refused_division_does_not_end_a_search_that_has_sound_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """One of many numbers of blocks may cut a sliver of unlit ground that folds."""
    monkeypatch.setattr(
        "blocksar.processors.chain.planning.planner.find_folding", lambda blocks: "folds" if blocks else None
    )

    def plan(count: int, probe: bool) -> Division:
        folds = count in (1, 5)
        refusal = "folds" if folds else None
        blocks: Any = (None,) if folds else ()
        return Division(count, 9.0 if folds else 6.0 / count, blocks=blocks, refusal=refusal)

    assert find_division(plan, workers=2).count == 6
    assert find_division(plan, workers=1).count == 1  # nothing sound comes before it
