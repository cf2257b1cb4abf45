"""What looks do to the prediction: the plan of each, as `focus` makes it, beside that of whole dwells."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TypeVar

from blocksar.api import definitions
from blocksar.api.looks import Looks
from blocksar.api.partial_pulses import recorded_lines
from blocksar.api.plan_lines import exact_line, outside_window, plan_lines, time_line
from blocksar.api.plan_tables import block_table, digits, plan_details
from blocksar.api.reports import Table
from blocksar.api.shown import PlanReport
from blocksar.collection.collection import Collection
from blocksar.constants import MIB
from blocksar.errors import InputError
from blocksar.graph.machine import Resources
from blocksar.planning import effort
from blocksar.planning.disk import run_bytes
from blocksar.planning.plan import Plan

HEADER = (
    "image", "blocks", "coherence", "residual phase (rad)", "PSLR (dB)", "azimuth width (m)", "migration (cells)",
    "memory (MiB)", "disk (MiB)",
)  # fmt: skip
Plans = Sequence[Plan]  # of the segments of one collection
Planned = TypeVar("Planned")


def report_looks(
    plan: Callable[[Collection], Plans], collection: Collection, looks: Looks, assumed: Resources
) -> PlanReport:
    """Plan whole dwells and each look; report the figures of all, and the blocks of the first look.

    `result` is a tuple with the plans of the looks, one after the other. Where whole dwells cannot be focused, looks
    may be: their band in Doppler is narrower.

    Raises
    ------
    InputError
        If a look cannot be planned; the message names it.
    """
    whole: Plans = []
    with suppress(InputError):
        whole = plan(collection)
    started = time.perf_counter()
    planned = _of_each(plan, collection, looks)
    planning = time.perf_counter() - started
    table = HEADER, [_row("whole dwell", whole), *(_row(name, plans) for name, plans in planned.items())]
    (name, first), *_ = planned.items()
    lines = [*looks.notes, f"{looks.count} looks ({', '.join(planned)}), focused one after the other; {name}:"]
    lines += [f"  {line}" for each in first for line in plan_lines(each)]
    every = [each for plans in planned.values() for each in plans]
    refused = next(((look, p.refusal) for look, plans in planned.items() for p in plans if p.refusal is not None), None)
    if refused is None:
        work = effort.together([effort.of_plan(each, workers=assumed.workers) for each in every])
        lines += [
            *recorded_lines([first[0].geometry], first[0].grid),
            *outside_window(whole or first),
            time_line(work, assumed, planning),
            *exact_line(every, work, assumed, planning),
        ]
    return PlanReport(
        tables=[table, name_rows(name, block_table(first))],
        details=[table, *(name_rows(look, each) for look, plans in planned.items() for each in plan_details(plans))],
        definitions=definitions.PLAN,
        summary=lines,
        refusal=None if refused is None else f"look {refused[0]}: {refused[1]}",
        result=tuple(every),
        geometry=first[0].geometry,
    )


def report_exact_looks(plan: Callable[[Collection], PlanReport], collection: Collection, looks: Looks) -> PlanReport:
    """Report the back-projection of whole dwells, and of each look; `result` is the grid of all.

    Raises
    ------
    InputError
        If a look cannot be planned; the message names it.
    """
    whole, planned = plan(collection), _of_each(plan, collection, looks)
    lines = [f"{name}: {each.summary[0]}" for name, each in (("whole dwell", whole), *planned.items())]
    (name, first), *_ = planned.items()
    each = [f"  {line}" for line in first.summary[1:]]
    return replace(first, summary=[*looks.notes, *lines, f"looks are formed one after the other; {name}:", *each])


def _of_each(plan: Callable[[Collection], Planned], collection: Collection, looks: Looks) -> dict[str, Planned]:
    """What is planned for each look, by its name."""
    planned = {}
    for name, seen in zip(looks.names, looks.collections(collection), strict=True):
        try:
            planned[name] = plan(seen)
        except InputError as error:
            raise InputError(f"look {name}: {error}") from error
    return planned


def _row(name: str, plans: Plans) -> list[str]:
    """The worst figures of any block of an image, and its memory and disk; none where it cannot be focused."""
    if not plans or any(plan.refusal is not None for plan in plans):
        return [name, *["-"] * (len(HEADER) - 1)]
    blocks = [block.prediction for plan in plans for block in plan.blocks]
    return [
        name,
        str(sum(plan.n_blocks for plan in plans)),
        digits(min(p.coherence for p in blocks)),
        f"{max(p.residual_phase for p in blocks):.4f}",
        f"{max(p.pslr for p in blocks):.2f}",
        " .. ".join(dict.fromkeys(f"{end(p.resolution for p in blocks):.2f}" for end in (min, max))),
        f"{max(p.migration for p in blocks):.3f}",
        f"{max(plan.memory for plan in plans) / MIB:.0f}",
        f"{sum(size for plan in plans for size in run_bytes(plan).values()) / MIB:.0f}",
    ]


def name_rows(name: str, table: Table) -> Table:
    """A table of blocks whose first column says which look they are of."""
    (first, *header), rows = table
    return [f"{name}: {first}", *header], rows
