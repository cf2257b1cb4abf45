"""Division of the scene: the fewest angular blocks and range sub-blocks that keep the fidelity.

Blocks reduce all errors that vary with angle. Range migration may vary with range instead, where a swath is wide for
its distance, or where a track wobbles close by: then range sub-blocks reduce it, since each has a reference of its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Protocol, TypeVar

from blocksar.errors import InputError
from blocksar.planning.block import BlockPlan
from blocksar.planning.refusal import find_folding

MAX_BLOCKS = 32  # that `auto` tries
GROWTH = 0.6  # power of the excess by which the number of blocks grows at a time
MOST_GROWTH, LEAST_GROWTH = 4.0, 1.2  # excess above which it grows no faster; factor by which it grows at least
FINE = 12  # the fewest blocks are found to one in as many
MOST_REFERENCES = 8  # range sub-blocks of a block, for the sake of migration
USEFUL, LATER = (
    0.9,
    4,
)  # excess that a division in range may leave, to be tried again; else with so many times the blocks
MIGRATION_SHARE = 0.7  # of the allowed loss that migration may take when a block is divided in range
FALL, PATIENCE = 0.97, 3  # factor by which the excess has to fall, and so many numbers without it end the search
ALIKE = 1.03  # times the least excess: among divisions within that, the one with the fewest blocks is taken
MOST_DIVIDED = 2 * MAX_BLOCKS  # that `auto` tries where blocks and range sub-blocks have to reduce migration together
MOST_TRIES = 3  # of these
RESERVE, MORE = 1.03, 1.1  # of blocks, over those that the two parts of migration ask for; and from try to try
# The same on a terrain: each division is predicted at other places of it, so that predictions scatter by this factor
# (excess 1.5 .. 3.0 from 1 to 10 blocks of hills of 60 m every 450 m under Table 1, without a trend).
SCATTER = 1.5


class Planned(Protocol):
    """What the search asks of a plan."""

    @property
    def blocks(self) -> tuple[BlockPlan, ...]: ...

    @property
    def refusal(self) -> str | None: ...

    def excess(self, *, migration: bool = True) -> float: ...


P = TypeVar("P", bound=Planned)


def find_division(
    plan: Callable[[int, int, bool], P],
    *,
    workers: int,
    parts: int | None,
    scattered: bool = False,
    jointly: bool = False,
    exceeds: Callable[[int, int, float], bool] | None = None,
) -> P:
    """The plan with the fewest blocks that keep the fidelity, at least one a worker; without one, the closest.

    Numbers grow with the excess; once one serves, those in between are tried by bisection. Probes of the outermost
    blocks and the middle one decide while plans are far from the fidelity. The search ends without success if PATIENCE
    numbers in a row have gained nothing, since margins do not shrink with the blocks.

    Parameters
    ----------
    plan : callable
        Plan for a number of blocks and of range sub-blocks in each; True for a probe.
    workers : int
    parts : int or None
        Number of range sub-blocks; None to take as many as migration needs.
    scattered : bool
        Whether predictions scatter from division to division, as on a terrain: more blocks are then a gain only beyond
        that scatter. Then the search does not begin where a probe of the last of PATIENCE numbers gains nothing.
    jointly : bool
        Whether to try more blocks, of range sub-blocks, where neither keep the fidelity by themselves.
    exceeds : callable, optional
        Whether the excess of a probe is above a limit, by fewer blocks where these tell.
    """
    plan = cache(plan)
    exceeds = exceeds or (lambda count, n_parts, limit: plan(count, n_parts, True).excess() > limit)
    tried: list[tuple[float, int, int]] = []
    failed, count, n_parts, stale = 0, min(max(workers, 1), MAX_BLOCKS), parts or 1, 0
    useless_at, fall, sound = 0, 1 / SCATTER if scattered else FALL, False
    while True:
        division = plan(count, n_parts, True)
        if division.excess() <= 1.0:
            division = plan(count, n_parts, False)
        excess, rest = division.excess(), division.excess(migration=False)
        if excess <= 1.0:
            return _fewest_between(plan, failed, count, n_parts)
        sound = sound or division.refusal is None
        if not sound and find_folding(division.blocks) is not None:
            return plan(count, n_parts, False)
        stale = stale + 1 if tried and excess > fall * min(tried)[0] else 0
        tried.append((excess, count, n_parts))
        if stale == PATIENCE or count == MAX_BLOCKS:
            least, n, m = min(tried)
            most = (SCATTER if scattered else ALIKE) * least
            if jointly and parts is None and (joint := _divide_jointly(plan, least)) is not None:
                return joint
            if scattered and tried[0][0] > most:  # a probe looks at fewer places of a terrain than the whole plan
                most = SCATTER * plan(n, m, False).excess()
            return plan(*min((n, m) for e, n, m in tried if e <= most), False)
        failed, growth = count, max(min(excess, MOST_GROWTH) ** GROWTH, LEAST_GROWTH)
        by_migration = parts is None and count >= LATER * useless_at and rest < excess / 2
        if scattered and len(tried) == 1 and not by_migration:
            far = min(math.ceil(count * growth**PATIENCE), MAX_BLOCKS)
            if exceeds(far, n_parts, fall * excess):
                return plan(count, n_parts, False)
        count = min(math.ceil(count * growth), MAX_BLOCKS)
        if by_migration:  # it costs the most: by angle or by range?
            more = math.ceil(n_parts * max(math.sqrt((excess - rest) / MIGRATION_SHARE), 1.1))
            more = min(more, MOST_REFERENCES)
            divided = plan(failed, more, True).excess()
            if division.refusal is None and divided >= USEFUL * excess:  # a refused one tells nothing of what is gained
                useless_at = failed
            by_angle = _worth(excess, plan(count, n_parts, True).excess(), count / failed)
            if more > n_parts and _worth(excess, divided, more / n_parts) > by_angle:
                failed, count, n_parts = failed - 1, failed, more


def _divide_jointly(plan: Callable[[int, int, bool], P], least: float) -> P | None:
    """The plan with the fewest sub-blocks in all that keep the fidelity; None where these cannot, or gain too little.

    The parts of migration from angle and from range are those that probes of the most blocks tell, whole and divided;
    `least` is the least excess of other divisions.
    """
    try:
        whole, divided = plan(MOST_DIVIDED, 1, True), plan(MOST_DIVIDED, MOST_REFERENCES, True)
    except InputError:  # so narrow that no block holds a point of the grid
        return None
    rest = max(whole.excess(migration=False), divided.excess(migration=False))
    if rest >= 1.0:
        return None
    left, least_left = (math.sqrt(max(each.excess() - each.excess(migration=False), 0.0)) for each in (whole, divided))
    by_range = min(max((left - least_left) / (1 - 1 / MOST_REFERENCES), 0.0), left)
    by_angle, room = MOST_DIVIDED * (left - by_range), math.sqrt(1 - rest)
    needed = [
        (math.ceil(RESERVE * by_angle / (room - by_range / n_parts)), n_parts)
        for n_parts in range(1, MOST_REFERENCES + 1)
        if by_range < room * n_parts
    ]
    needed = [(max(n, 1), n_parts) for n, n_parts in needed if n <= MOST_DIVIDED]
    if not needed:
        return None
    count, n_parts = min(needed, key=lambda each: (each[0] * each[1], each))
    tried: list[tuple[float, int, int]] = []
    while len(tried) < MOST_TRIES and count <= MOST_DIVIDED:
        division = plan(count, n_parts, True)
        if division.excess() <= 1.0:
            division = plan(count, n_parts, False)
            if division.excess() <= 1.0:
                return division
        tried.append((division.excess(), count, n_parts))
        count = math.ceil(MORE * count)
    excess, count, n_parts = min(tried)
    return plan(count, n_parts, False) if excess < USEFUL * least else None


def _worth(before: float, after: float, growth: float) -> float:
    """How much a division gains for what it adds: the power of its growth by which the excess falls."""
    return math.log(before / max(after, 1e-9)) / math.log(growth)


def _fewest_between(plan: Callable[[int, int, bool], P], failed: int, serving: int, parts: int) -> P:
    """The plan with the fewest blocks above `failed` and up to `serving`, which serves."""
    while serving - failed > max(1, serving // FINE) and failed:
        count = (failed + serving) // 2
        if plan(count, parts, True).excess() <= 1.0 and plan(count, parts, False).excess() <= 1.0:
            serving = count
        else:
            failed = count
    return plan(serving, parts, False)
