"""Probes of a chain: a few blocks, by which it is known whether a plan of all is worth to be made.

Blocks reduce all errors that vary with angle, and segments along time those that grow along a strip; what ends of
dwells lose stays. So the finest division has the least excess over what the fidelity allows. Where the beam is
described by its yaw, narrow blocks lose a little more again: 0.38 with 8 blocks of Table 1, but 0.51 with 32 (coherence
0.999). There a division in between tells as well, if it may be alike (`planner.ALIKE`). On a terrain each division is
predicted at other places of it, and only an excess tells that is more than alike.

Finer divisions take longer as a rule, since blocks overlap: by the coarsest it is judged what a run takes at least.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress

from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.errors import OutsideSwath
from blocksar.processors.chain.planning.plan import Plan
from blocksar.processors.chain.planning.planner import ALIKE, MAX_BLOCKS, DivisionPlanner, excess_of, fewest_blocks
from blocksar.processors.chain.planning.strip_segments import cuts, longest_dwell, owned_by

Prepare = Callable[..., DivisionPlanner]  # of one collection: `prepare_division` with the settings of a run


def prepare_segment(prepare: Prepare, collection: Collection, grid: Grid | None) -> DivisionPlanner | None:
    """Prepare the shortest segment of a strip that sees the middle of the grid; None where nothing is cut or seen."""
    if grid is None or not collection.has_axis:
        return None
    *_, spans = [], *cuts(collection, longest_dwell(collection, grid))
    if not spans:
        return None
    x, y = grid.x[[grid.x.size // 2]], grid.y[[grid.y.size // 2]]
    first, last = Geometry(collection=collection).beam.dwell(x, y, uncut=True)
    lit, ends = float((first[0] + last[0]) / 2), collection.time
    number = min(range(len(spans)), key=lambda k: abs(float(ends[spans[k][0]] + ends[spans[k][1] - 1]) / 2 - lit))
    with suppress(OutsideSwath):
        return prepare(collection.segment(*spans[number]), owned=owned_by(collection, spans, number))
    return None


def find_shortfall(division: DivisionPlanner, coarse: Plan | None = None) -> Plan | None:
    """A block that shows that no division keeps the fidelity, as a plan; None where one may: see above.

    `coarse` is one of the coarsest division, unless that is out of question.
    """
    if coarse is not None and excess_of(coarse) <= 1.0:
        return None
    best = division.middle(MAX_BLOCKS)
    if best is None or (best.refusal is not None and coarse is not None and coarse.refusal is None):
        return None
    if coarse is not None and not division.geometry.collection.has_axis and excess_of(best) <= ALIKE:
        between = division.middle(round(math.sqrt(coarse.n_blocks * MAX_BLOCKS)))
        if between is None:
            return None
        best = min(best, between, key=excess_of)
    sure = 1.0 if division.geometry.terrain is None else ALIKE
    return best if excess_of(best) > sure else None


def plan_coarsest(division: DivisionPlanner, workers: int) -> Plan:
    """A plan of the coarsest division that is tried, or of some blocks of it."""
    with suppress(OutsideSwath):
        return division.plan(fewest_blocks(workers), 1, True)
    return division.undivided()
