"""Division of the scene: the fewest angular blocks and range sub-blocks that keep the fidelity.

Blocks reduce all errors that vary with angle. Range migration may vary with range instead, where a swath is wide for
its distance, or where a track wobbles close by: then range sub-blocks reduce it, since each has a reference of its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import Generic, NamedTuple, Protocol, TypeVar

from blocksar.errors import InputError
from blocksar.planning.block import BlockPlan
from blocksar.planning.refusal import find_folding

MAX_BLOCKS = 32  # that `auto` tries
GROWTH = 0.6  # power of the excess by which the number of blocks grows at a time
MOST_GROWTH, LEAST_GROWTH = 4.0, 1.2  # excess above which it grows no faster; factor by which it grows at least
FINE = 12  # the fewest blocks are found to one in as many
MOST_REFERENCES = 8  # range sub-blocks of a block, for the sake of migration
USEFUL = 0.9  # of the excess, that a division in range may leave, to be tried again;
LATER = 4  # else it is with so many times the blocks
MIGRATION_SHARE = 0.7  # of the allowed loss that migration may take when a block is divided in range
FALL, PATIENCE = 0.97, 3  # factor by which the excess has to fall, and so many numbers without it end the search
ALIKE = 1.03  # times the least excess: among divisions within that, the one with the fewest blocks is taken
MOST_DIVIDED = 2 * MAX_BLOCKS  # that `auto` tries where blocks and range sub-blocks have to reduce migration together
MOST_TRIES = 3  # of these
REFUSED = 2  # divisions in a row, after which the finest one tells whether any will do
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
    refuses: Callable[[int, int], bool] | None = None,
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
    refuses : callable, optional
        Whether a probe is refused, likewise.
    """
    plan = cache(plan)
    exceeds = exceeds or (lambda count, n_parts, limit: plan(count, n_parts, True).excess() > limit)
    refuses = refuses or (lambda count, n_parts: plan(count, n_parts, True).refusal is not None)
    search = _Search(plan=plan, exceeds=exceeds, refuses=refuses, parts=parts, scattered=scattered, jointly=jointly)
    return search.find(min(max(workers, 1), MAX_BLOCKS))


class _Tried(NamedTuple):
    """A division that was tried, and its excess: of several, the least is the one that is closest."""

    excess: float
    blocks: int
    parts: int


@dataclass(kw_only=True)
class _Search(Generic[P]):
    """The search of `find_division`, and what it has found so far.

    Attributes
    ----------
    tried : list of _Tried
    stale : int
        Number of the last of these, in a row, that have gained nothing.
    failed : int
        The most blocks known not to keep the fidelity, with as many range sub-blocks as are tried now.
    useless_at : int
        Blocks at which a division in range gained too little.
    sound : bool
        Whether any division was not refused.
    """

    plan: Callable[[int, int, bool], P]
    exceeds: Callable[[int, int, float], bool]
    refuses: Callable[[int, int], bool]
    parts: int | None
    scattered: bool
    jointly: bool
    tried: list[_Tried] = field(default_factory=list)
    stale: int = 0
    failed: int = 0
    useless_at: int = 0
    sound: bool = False

    def find(self, count: int) -> P:
        """The plan, beginning with so many blocks."""
        n_parts = self.parts or 1
        while True:
            division = _probe(self.plan, count, n_parts)
            if division.excess() <= 1.0:
                return _fewest_between(self.plan, self.failed, count, n_parts)
            self.sound = self.sound or division.refusal is None
            if not self.sound and find_folding(division.blocks) is not None:  # more blocks share their Doppler as well
                return self.plan(count, n_parts, False)
            self._note(_Tried(division.excess(), count, n_parts))
            if self.stale == PATIENCE or count == MAX_BLOCKS or (len(self.tried) == REFUSED and self._is_refused()):
                return self._closest()
            by_migration = self._is_by_migration(division, count)
            if self.scattered and len(self.tried) == 1 and not by_migration and self._gains_nothing(count, n_parts):
                return self.plan(count, n_parts, False)
            more = self._divided(division, count, n_parts) if by_migration else n_parts
            if more > n_parts:  # as many blocks once more, divided in range
                self.failed, n_parts = count - 1, more
            else:
                self.failed, count = count, _next(count, division.excess())

    @property
    def _fall(self) -> float:
        """Factor by which the excess has to fall."""
        return 1 / SCATTER if self.scattered else FALL

    @property
    def _finest(self) -> int:
        """The most blocks that are tried."""
        return MOST_DIVIDED if self.jointly and self.parts is None else MAX_BLOCKS

    def _is_refused(self) -> bool:
        """Whether all divisions are refused, and the finest one would be."""
        return not self.sound and self.refuses(self._finest, self.parts or MOST_REFERENCES)

    def _note(self, division: _Tried) -> None:
        gained = not self.tried or division.excess <= self._fall * min(self.tried).excess
        self.stale = 0 if gained else self.stale + 1
        self.tried.append(division)

    def _closest(self) -> P:
        """The plan that comes closest to the fidelity; among those alike, the one with the fewest blocks."""
        least, count, n_parts = min(self.tried)
        if self._is_refused():
            return self.plan(count, n_parts, True)  # which has the reason, and nothing else is asked of it
        most = (SCATTER if self.scattered else ALIKE) * least
        if self.jointly and self.parts is None and (joint := _divide_jointly(self.plan, least)) is not None:
            return joint
        # A probe looks at fewer places of a terrain than the whole plan.
        if self.scattered and self.tried[0].excess > most:
            most = SCATTER * self.plan(count, n_parts, False).excess()
        return self.plan(*min((tried.blocks, tried.parts) for tried in self.tried if tried.excess <= most), False)

    def _is_by_migration(self, division: P, count: int) -> bool:
        """Whether migration costs the most, which a division in range may reduce."""
        return (
            self.parts is None
            and count >= LATER * self.useless_at
            and division.excess(migration=False) < division.excess() / 2
        )

    def _gains_nothing(self, count: int, n_parts: int) -> bool:
        """Whether the last of PATIENCE numbers of blocks after the first gains nothing."""
        excess = self.tried[0].excess
        far = min(math.ceil(count * _growth(excess) ** PATIENCE), MAX_BLOCKS)
        return self.exceeds(far, n_parts, self._fall * excess)

    def _divided(self, division: P, count: int, n_parts: int) -> int:
        """The range sub-blocks to go on with: more, where these are worth more than more blocks."""
        excess, rest = division.excess(), division.excess(migration=False)
        more = math.ceil(n_parts * max(math.sqrt((excess - rest) / MIGRATION_SHARE), 1.1))
        more = min(more, MOST_REFERENCES)
        divided = self.plan(count, more, True).excess()
        if division.refusal is None and divided >= USEFUL * excess:  # a refused one tells nothing of what is gained
            self.useless_at = count
        further = _next(count, excess)
        by_angle = _worth(excess, self.plan(further, n_parts, True).excess(), further / count)
        return more if more > n_parts and _worth(excess, divided, more / n_parts) > by_angle else n_parts


def _probe(plan: Callable[[int, int, bool], P], count: int, n_parts: int) -> P:
    """A probe of a division; the whole plan if the probe keeps the fidelity."""
    probe = plan(count, n_parts, True)
    return plan(count, n_parts, False) if probe.excess() <= 1.0 else probe


def _growth(excess: float) -> float:
    """Factor by which the number of blocks grows."""
    return float(max(min(excess, MOST_GROWTH) ** GROWTH, LEAST_GROWTH))


def _next(count: int, excess: float) -> int:
    """The number of blocks to try after one with that excess."""
    return min(math.ceil(count * _growth(excess)), MAX_BLOCKS)


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
    tried: list[_Tried] = []
    while len(tried) < MOST_TRIES and count <= MOST_DIVIDED:
        division = _probe(plan, count, n_parts)
        if division.excess() <= 1.0:
            return division
        tried.append(_Tried(division.excess(), count, n_parts))
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
