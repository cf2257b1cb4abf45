"""Predictions for looks: the plan of each, as `focus` makes it, beside that of whole dwells."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress

from blocksar.api import definitions
from blocksar.api.looks import Looks
from blocksar.api.partial_pulses import recorded_lines
from blocksar.api.reports import Table
from blocksar.api.shown import PlanReport
from blocksar.collection.collection import Collection
from blocksar.constants import MIB
from blocksar.errors import InputError
from blocksar.graph.machine import Resources
from blocksar.planning import effort
from blocksar.processors.base import ImagePlan
from blocksar.processors.chain_tables import digits
from blocksar.processors.lines import time_line

HEADER = (
    "image", "blocks", "coherence", "residual phase (rad)", "PSLR (dB)", "azimuth width (m)", "migration (cells)",
    "memory (MiB)", "disk (MiB)",
)  # fmt: skip


def report_looks(
    plan: Callable[[Collection], ImagePlan], collection: Collection, looks: Looks, assumed: Resources
) -> PlanReport:
    """Plan whole dwells and each look; report the figures of all, and the plan of the first look.

    `result` is a tuple with the plans of the looks, one after the other; of a processor without blocks, the grid of
    all. Where whole dwells cannot be focused, looks may be: their band in Doppler is narrower.

    Raises
    ------
    InputError
        If a look cannot be planned; the message names it.
    """
    whole: ImagePlan | None = None
    with suppress(InputError):
        whole = plan(collection)
    started = time.perf_counter()
    planned = _of_each(plan, collection, looks)
    planning = time.perf_counter() - started
    (name, first), *_ = planned.items()
    refused = next(((look, p.refusal) for look, p in planned.items() if p.refusal is not None), None)
    table = HEADER, [_row("whole dwell", whole), *(_row(look, each) for look, each in planned.items())]
    each = [] if first.blocks() else [("whole dwell", whole), *planned.items()]  # tables tell less of them
    lines = [*looks.notes, *(f"{look}: {plan.headline()}" for look, plan in each if plan is not None)]
    lines += [f"{looks.count} looks ({', '.join(planned)}), formed one after the other; {name}:"]
    lines += [f"  {line}" for line in first.lines()]
    if refused is None:
        work = effort.together([{**each.work(), **effort.of_pyramid(each.grid)} for each in planned.values()])
        lines += [
            *recorded_lines([first.pieces[0].geometry], first.grid),
            time_line(work, assumed, planning),
        ]
    results = [each.result for each in planned.values()]
    return PlanReport(
        tables=[table, *(name_rows(name, each) for each in first.tables())],
        details=[table, *(name_rows(look, each) for look, plan in planned.items() for each in plan.details())],
        definitions=definitions.PLAN,
        summary=lines,
        refusal=None if refused is None else f"look {refused[0]}: {refused[1]}",
        result=first.grid if not first.blocks() else tuple(results),
    )


def _of_each(plan: Callable[[Collection], ImagePlan], collection: Collection, looks: Looks) -> dict[str, ImagePlan]:
    """The plan of each look, by its name."""
    planned = {}
    for name, seen in zip(looks.names, looks.collections(collection), strict=True):
        try:
            planned[name] = plan(seen)
        except InputError as error:
            raise InputError(f"look {name}: {error}") from error
    return planned


def _row(name: str, plan: ImagePlan | None) -> list[str]:
    """The worst figures of any block of an image, and its memory and disk; none where it cannot be focused."""
    if plan is None or plan.refusal is not None:
        return [name, *["-"] * (len(HEADER) - 1)]
    blocks = plan.blocks()
    figures = ["-", "-", "-", "-"]
    if blocks:
        figures = [
            f"{max(b.residual_phase for b in blocks):.4f}",
            f"{max(b.pslr for b in blocks):.2f}",
            " .. ".join(dict.fromkeys(f"{end(b.resolution for b in blocks):.2f}" for end in (min, max))),
            f"{max(b.migration for b in blocks):.3f}",
        ]
    return [
        name,
        str(len({b.block for b in blocks}) or "-"),
        digits(plan.coherence),
        *figures,
        f"{plan.memory(1) / MIB:.0f}",
        f"{sum(plan.stored().values()) / MIB:.0f}",
    ]


def name_rows(name: str, table: Table) -> Table:
    """A table of blocks whose first column says which look they are of."""
    (first, *header), rows = table
    return [f"{name}: {first}", *header], rows
