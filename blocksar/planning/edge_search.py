"""Edges of dwells that are as long as the plan of a division shows that they have to be.

`planning.edges` has the length that suits an even beam. Where the ends of dwells move unevenly along Doppler, as under
a beam on a curved track, steps in Doppler smear them by more than the gate follows, and no division helps: edges that
are a few times as long fade out over more than that smear.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeVar

from blocksar.collection.geometry import Geometry
from blocksar.planning.division import Planned

MOST_TIMES = 4.0  # the least length that edges may have
LONGER_SHARE = 0.5  # of the allowed loss that ends may take before edges are longer
LEAST_FADE = 4  # half dwells over edges, up to which they are doubled


class Dwelling(Planned, Protocol):
    """What the search asks of a plan."""

    @property
    def fade(self) -> int: ...

    @property
    def fidelity(self) -> float: ...

    @property
    def parts(self) -> int: ...

    @property
    def coherence(self) -> float: ...

    @property
    def n_blocks(self) -> int: ...

    @property
    def refusal(self) -> str | None: ...

    @property
    def geometry(self) -> Geometry: ...


P = TypeVar("P", bound=Dwelling)


def find_edges(plan: Callable[[float, int, int, bool], P], choose: Callable[[float], P]) -> tuple[float, P]:
    """The plan that `choose` finds with edges as long as they have to be, and how many times the least that is.

    By one rule for a number of blocks that is given and one that is found: a resumed run plans the same.

    Parameters
    ----------
    plan : callable
        Plan for edges of a number of times their least length, 0 to have none without need, for a number of blocks and
        of range sub-blocks in each; True for a probe.
    choose : callable
        The division that serves best with such edges.
    """

    def settle(count: int, parts: int, times: float = 0.0) -> float:
        while (longer := _times(plan(times, count, parts, times > 0), times)) > times:
            times = longer
        return times

    times, first = 0.0, choose(0.0)
    while (needed := settle(first.n_blocks, first.parts, times)) > times:
        times = needed if times or first.fade else 1.0
        again = choose(times)
        found = settle(again.n_blocks, again.parts)
        if found < times:
            settled = plan(found, again.n_blocks, again.parts, False)
            if found and settled.excess() <= 1.0:
                return found, settled
            times = settle(first.n_blocks, first.parts)
            return times, plan(times, first.n_blocks, first.parts, False)
        first = again
    return times, first


def _times(plan: Dwelling, times: float) -> float:
    """How many times their least length edges should have, where they have `times` of it.

    Whole dwells under a beam about its axis, or with a pattern in elevation, need edges where their ends lose more than
    the fidelity allows in all: these may move unevenly along Doppler, so that no gate is the best one that `plan_edges`
    counts with, or have larger weights than all the rest of their dwells.
    """
    if plan.refusal is not None:
        return times
    lost, allowed = max(block.prediction.dispersion_loss for block in plan.blocks), 1 - plan.fidelity
    collection = plan.geometry.collection
    if not plan.fade:
        uneven = collection.has_axis or collection.elevation_pattern is not None
        return 1.0 if times == 0 and uneven and lost > allowed else times
    twice = 2 * max(times, 1.0)
    spare = lost <= LONGER_SHARE * allowed or 1 - plan.coherence <= allowed
    return times if spare or twice > MOST_TIMES or plan.fade < 2 * LEAST_FADE else twice
