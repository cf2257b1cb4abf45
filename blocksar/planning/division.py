"""Division of the scene: the fewest angular blocks that keep the fidelity.

Blocks reduce all errors that vary with angle. Where they do not suffice, hierarchical back-projection does.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from typing import Protocol, TypeVar

from blocksar.errors import OutsideSwath
from blocksar.planning.block import BlockPlan
from blocksar.planning.refusal import find_folding

MAX_BLOCKS = 32  # that `auto` tries
GROWTH = 0.6  # power of the excess by which the number of blocks grows at a time
MOST_GROWTH, LEAST_GROWTH = 4.0, 1.2  # excess above which it grows no faster; factor by which it grows at least
FINE = 12  # the fewest blocks are found to one in as many
FALL, PATIENCE = 0.97, 3  # factor by which the excess has to fall, and so many numbers without it end the search
ALIKE = 1.03  # times the least excess: among divisions within that, the one with the fewest blocks is taken
REFUSED = 2  # divisions in a row, after which the finest one tells whether any will do
# The same on a terrain: each division is predicted at other places of it, so that predictions scatter by this factor
# (excess 1.5 .. 3.0 from 1 to 10 blocks of hills of 60 m every 450 m under Table 1, without a trend).
SCATTER = 1.5


class Planned(Protocol):
    """What the search asks of a plan."""

    @property
    def blocks(self) -> tuple[BlockPlan, ...]: ...

    @property
    def refusal(self) -> str | None: ...

    def excess(self) -> float: ...


P = TypeVar("P", bound=Planned)


def find_division(plan: Callable[[int, bool], P], *, workers: int, scattered: bool = False) -> P:
    """The plan with the fewest blocks that keep the fidelity, at least one a worker; without one, the closest.

    Numbers grow with the excess; once one serves, those in between are tried by bisection. Probes of the outermost
    blocks and the middle one decide while plans are far from the fidelity. The search ends without success if PATIENCE
    numbers in a row have gained nothing, since margins do not shrink with the blocks.

    Parameters
    ----------
    plan : callable
        Plan for a number of blocks; True for a probe.
    workers : int
    scattered : bool
        Whether predictions scatter from division to division, as on a terrain: more blocks are then a gain only beyond
        that scatter.
    """
    plan = cache(plan)
    fall, alike = (1 / SCATTER, SCATTER) if scattered else (FALL, ALIKE)
    tried: list[tuple[float, int]] = []  # excess and number of blocks
    count, stale, failed, sound = min(max(workers, 1), MAX_BLOCKS), 0, 0, False
    while True:
        division = _probe(plan, count)
        excess = division.excess()
        if excess <= 1.0:
            return _fewest_between(plan, failed, count)
        sound = sound or division.refusal is None
        if not sound and find_folding(division.blocks) is not None:  # more blocks share their Doppler as well
            return plan(count, False)
        stale = 0 if not tried or excess <= fall * min(tried)[0] else stale + 1
        tried.append((excess, count))
        if not sound and len(tried) >= REFUSED and finest_is_refused(plan):
            return plan(min(tried)[1], True)  # which has the reason, and nothing else is asked of it
        if stale == PATIENCE or count == MAX_BLOCKS:
            break
        growth = max(min(excess, MOST_GROWTH) ** GROWTH, LEAST_GROWTH)
        failed, count = count, min(math.ceil(count * growth), MAX_BLOCKS)
    least, count = min(tried)
    # A probe looks at fewer places of a terrain than the whole plan.
    most = alike * (plan(count, False).excess() if scattered else least)
    return plan(min(count for excess, count in tried if excess <= most), False)


def finest_is_refused(plan: Callable[[int, bool], P]) -> bool:
    """Whether the most blocks that are tried are refused; not where a grid has no point in any that is looked at."""
    with suppress(OutsideSwath):
        return plan(MAX_BLOCKS, True).refusal is not None
    return False


def _probe(plan: Callable[[int, bool], P], count: int) -> P:
    """A probe of a division; the whole plan if the probe keeps the fidelity."""
    probe = plan(count, True)
    return plan(count, False) if probe.excess() <= 1.0 else probe


def _fewest_between(plan: Callable[[int, bool], P], failed: int, serving: int) -> P:
    """The plan with the fewest blocks above `failed` and up to `serving`, which serves."""
    while serving - failed > max(1, serving // FINE) and failed:
        count = (failed + serving) // 2
        if plan(count, True).excess() <= 1.0 and plan(count, False).excess() <= 1.0:
            serving = count
        else:
            failed = count
    return plan(serving, False)
