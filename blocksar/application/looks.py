"""Looks on request: check that they can be formed, and divide dwells into them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

from blocksar import stores
from blocksar.application.arguments import One, Source, history_of, is_scene, sources_of
from blocksar.application.ground import image_grid
from blocksar.application.pulses import recorded_lines
from blocksar.application.reports import PLAN_COLUMNS, Table
from blocksar.application.shown import PlanReport
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.collection.region import grid_extent, plan_region
from blocksar.collection.staying import beam_stays
from blocksar.collection.sublooks import checked_count, entering_side, look_of
from blocksar.constants import MIB
from blocksar.errors import InputError
from blocksar.graph.machine import Resources
from blocksar.planning import effort
from blocksar.processors.base import ImagePlan
from blocksar.processors.sentences import time_line
from blocksar.texts import digits


@dataclass(frozen=True)
class Looks:
    """Division of dwells into looks.

    Attributes
    ----------
    count : int
    sign : float
        As for `collection.sublooks.narrowed`.
    grid : Grid
        Of all looks: their beams differ, but not the ground that they show.
    notes : tuple of str
        A sentence on the part of the beam that each look sees, where it is steered.
    """

    count: int
    sign: float
    grid: Grid
    notes: tuple[str, ...]

    @property
    def names(self) -> list[str]:
        return [stores.look_name(number) for number in range(self.count)]

    def collections(self, collection: Collection) -> list[Collection]:
        """Return the collection as each look sees it: with its part of every dwell."""
        return [look_of(collection, number, self.count, self.sign) for number in range(self.count)]


def one_source(source: Source, count: int) -> One:
    """Return the only source, of one channel, from which looks are to be formed.

    Raises
    ------
    InputError
        If there are several, or it has several channels.
    """
    sources = sources_of(source)
    if len(sources) > 1:
        raise InputError(
            f"looks = {count}: looks are formed of one collection, and here are {len(sources)}; give one of them"
        )
    if not is_scene(sources[0]) and not isinstance(sources[0], stores.PhaseHistory):
        history = history_of(sources[0])
        if history.channels:
            raise InputError(
                f"looks = {count}: {history.label} has several channels ({', '.join(history.channels)}); write one of "
                "them to a store of its own"
            )
    return sources[0]


def divide_dwells(collection: Collection, count: int, grid: Grid | None) -> Looks:
    """Divide the dwells of a centred collection into looks.

    Raises
    ------
    InputError
        If there is no such number of looks, the grid is missing or lies outside the swath, or the beam stays on its
        ground: parts of its width then see parts of the ground.
    """
    count = checked_count(count, collection)
    geometry, points = Geometry(collection=collection), image_grid(collection, grid)
    if collection.beam_width is None:
        return Looks(count, 1.0, points, ())
    if collection.has_axis:
        region = plan_region(geometry, points)
        if beam_stays(geometry, region, grid_extent(geometry, region, points)):
            raise InputError(
                f"looks = {count}: the beam stays on its ground, so that parts of its width see different ground, not "
                "parts of a dwell; write the phase history without its beam (beam_axis, beam_steering, beam_width), of "
                "which looks are parts of the pulses"
            )
    sign = entering_side(geometry, (points.x0 + points.x1) / 2, (points.y0 + points.y1) / 2)
    part = math.degrees(collection.beam_width) / count
    note = f"each look sees {part:.3g} of the beam's {part * count:.3g} degrees, the first in time first"
    return Looks(count, sign, points, (note,))


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
        stored = sum(each.stored_bytes() for each in planned.values())
        lines += [
            *recorded_lines([first.pieces[0].geometry], first.grid),
            time_line(work, assumed, stored, planning),
        ]
    results = [each.result for each in planned.values()]
    return PlanReport(
        tables=[table, *(name_rows(name, each) for each in first.tables())],
        details=[table, *(name_rows(look, each) for look, plan in planned.items() for each in plan.details())],
        definitions=PLAN_COLUMNS,
        summary=lines,
        refusal=None if refused is None else f"look {refused[0]}: {refused[1]}",
        result=first.grid if not first.blocks() else tuple(results),
    )


def _of_each(plan: Callable[[Collection], ImagePlan], collection: Collection, looks: Looks) -> dict[str, ImagePlan]:
    """Plan each look; return the plans by its name."""
    planned = {}
    for name, seen in zip(looks.names, looks.collections(collection), strict=True):
        try:
            planned[name] = plan(seen)
        except InputError as error:
            raise InputError(f"look {name}: {error}") from error
    return planned


def _row(name: str, plan: ImagePlan | None) -> list[str]:
    """Return the worst figures of any block of an image, its memory and disk; empty cells if it cannot be focused."""
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
        f"{plan.stored_bytes() / MIB:.0f}",
    ]


def name_rows(name: str, table: Table) -> Table:
    """Return a table of blocks with a first column that names the look."""
    (first, *header), rows = table
    return [f"{name}: {first}", *header], rows
