"""What the plan of a chain cannot be better than, known from one block of it: whether it is worth to be made.

Blocks reduce all errors that vary with angle, and segments along time those that grow along a strip. Where a block of
the finest division does not keep the fidelity, none of the divisions does. On a terrain each division is predicted at
other places of it: there, only where the excess is more than that of divisions that are alike (`planner.ALIKE`).

Finer divisions take longer, since blocks overlap: a run takes at least the time of the coarsest, and of its recovery.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.errors import OutsideSwath
from blocksar.planning.plan import Plan
from blocksar.planning.planner import (
    ALIKE,
    MAX_BLOCKS,
    DivisionPlanner,
    excess_of,
    fewest_blocks,
    prepare_division,
)
from blocksar.planning.strip_segments import Span, cuts, longest_dwell, owned_by


def find_shortfall(planner: DivisionPlanner, collection: Collection, *, workers: int) -> Plan | None:
    """A block that shows that no division of a collection keeps the fidelity, as a plan; None where one may.

    Parameters
    ----------
    planner : DivisionPlanner
        Of the whole collection.
    collection : Collection
    workers : int
    """
    grid = planner.grid
    spans = [*cuts(collection, longest_dwell(collection, grid))] if collection.has_axis else []
    if spans:
        finest = _middle_of_shortest(planner, collection, spans[-1])
    else:
        coarsest = planner.middle(fewest_blocks(workers))
        if coarsest is None or excess_of(coarsest) <= 1.0:
            return None
        finest = planner.middle(MAX_BLOCKS)
    sure = 1.0 if planner.geometry.terrain is None else ALIKE
    return finest if finest is not None and excess_of(finest) > sure else None


def _middle_of_shortest(planner: DivisionPlanner, collection: Collection, spans: Sequence[Span]) -> Plan | None:
    """The middle block of the segment that sees the middle of the grid deepest inside its time; None if it sees none.

    Finely divided, a segment has the errors of the shortest dwells that a chain can be given.
    """
    grid, time = planner.grid, collection.time
    x, y = grid.x[[grid.x.size // 2]], grid.y[[grid.y.size // 2]]
    first, last = Geometry(collection=collection).beam.dwell(x, y, uncut=True)
    lit = float((first[0] + last[0]) / 2)
    number = min(range(len(spans)), key=lambda k: abs(float(time[spans[k][0]] + time[spans[k][1] - 1]) / 2 - lit))
    with suppress(OutsideSwath):
        segment = prepare_division(
            collection.segment(*spans[number]), method=planner.method, fidelity=planner.fidelity, grid=grid,
            weighting=planner.weighting, owned=owned_by(collection, spans, number), terrain=planner.geometry.terrain,
        )  # fmt: skip
        return segment.middle(MAX_BLOCKS)
    return None
