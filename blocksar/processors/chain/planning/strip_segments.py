"""Several collections in one image, and long strips divided along time: segments planned one by one.

Strips that one epoch cannot serve are divided into segments along time, each planned about its own middle.

Under a beam about the antenna's axis, a strip may be any number of dwells long, but range histories that are expanded
about one epoch serve a few of them only. Segments overlap by more than the longest dwell: ground in the middle of what
two share has its full dwell in both, and there the seam runs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from blocksar.collection.beam import aperture
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.collection.region import Owned, joint_grid
from blocksar.errors import InputError, OutsideSwath, Unfocusable
from blocksar.processors.base import PlannedSegment
from blocksar.processors.chain.dwells.dwell_ends import GUARD
from blocksar.processors.chain.dwells.steadiness import PLACES
from blocksar.processors.chain.planning.plan import Plan
from blocksar.processors.chain.planning.planner import ALIKE, GROWTH, excess_of

OVERLAP = 0.3  # dwells by which segments overlap besides the dwell, since its ends ring
LEAST_LENGTH = 2.5  # overlaps that a segment has at least
POINTS_EACH = 6  # and for each segment besides, to see whether it has ground there

Span = tuple[int, int]  # pulses first <= p < last


def longest_dwell(collection: Collection, grid: Grid) -> float:
    """Longest uncut dwell, s, of ground in a grid that the collection lights; 0 if it lights none."""
    geometry = Geometry(collection=collection)
    places = np.linspace(grid.x[0], grid.x[-1], PLACES), np.linspace(grid.y[0], grid.y[-1], PLACES)
    first, last = geometry.beam.dwell(*np.meshgrid(*places), uncut=True)
    start, end = aperture(collection)
    lit = (last > start) & (first < end) & (last > first)
    return float(np.where(lit, last - first, 0.0).max())


def cuts(collection: Collection, dwell_time: float) -> Iterator[list[Span]]:
    """Iterate over divisions into ever more segments of equal length, as spans, until they are too short."""
    overlap = math.ceil((1 + OVERLAP) * dwell_time * collection.prf)
    count, n = 2, collection.n_pulse
    while overlap:
        length = math.ceil((n + (count - 1) * overlap) / count)
        if length < LEAST_LENGTH * overlap:
            return
        firsts = [round(k * (n - length) / (count - 1)) for k in range(count)]
        yield [(first, first + length) for first in firsts]
        count = math.ceil(count * GROWTH)


def within(collection: Collection, spans: Sequence[Span], grid: Grid) -> list[Span]:
    """Select the segments that some ground of a grid is deepest inside, in time."""
    count = PLACES + POINTS_EACH * len(spans)
    x, y = np.meshgrid(np.linspace(grid.x[0], grid.x[-1], count), np.linspace(grid.y[0], grid.y[-1], count))
    margins = np.array([Geometry(collection=collection.segment(*span)).beam.margin(x, y) for span in spans])
    seen = margins.max(axis=0) > -1.0
    return [span for k, span in enumerate(spans) if (seen & (margins.argmax(axis=0) == k)).any()]


def owned_by(collection: Collection, spans: Sequence[Span], number: int) -> Owned:
    """Make the test of which ground a segment images: where its neighbours see less deep inside, with some overlap."""
    own, *others = (
        Geometry(collection=collection.segment(*spans[k]))
        for k in (number, number - 1, number + 1)
        if 0 <= k < len(spans)
    )

    def owned(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        margin = own.beam.margin(x, y)
        beyond = [other.beam.margin(x, y) for other in others]
        with np.errstate(invalid="ignore"):
            return (margin > -1.0) & (margin >= np.max(beyond, axis=0, initial=-np.inf) - GUARD)

    return owned


USEFUL = 0.9  # of the excess of fewer segments, that more have to leave at most
MOST_NUMBERS = int(np.iinfo(np.int16).max) + 1  # of blocks, as the image holds them


Planner = Callable[..., Plan]  # of one collection: `plan_collection` with the settings of a run


def plan_segments(
    plan: Planner,
    collections: Sequence[Collection],
    *,
    grid: Grid | None,
    cut: bool = True,
) -> tuple[PlannedSegment, ...]:
    """Plan every collection that covers some of the grid, about its own epoch.

    Parameters
    ----------
    plan : callable
    collections : sequence of Collection
    grid : Grid or None
        None: the default one of a single collection, or that of several jointly.
    cut : bool
        Whether strips whose plan does not keep the fidelity are cut into segments along time.

    Raises
    ------
    InputError
        If none does, one of them cannot be focused, or there are too many blocks.
    """
    if grid is None and len(collections) > 1:
        grid = joint_grid([Geometry(collection=collection) for collection in collections])
    planned: list[PlannedSegment] = []
    outside: list[OutsideSwath] = []
    for number, collection in enumerate(collections):
        try:
            whole = plan(collection, grid=grid)
        except OutsideSwath as error:
            outside.append(error)
            continue
        except InputError as error:
            if len(collections) == 1:
                raise
            kind = Unfocusable if isinstance(error, Unfocusable) else InputError
            raise kind(f"collection {number}{f' ({collection.title})' if collection.title else ''}: {error}") from None
        segments = _cut(plan, collection, whole, number) if cut and collection.has_axis else []
        planned += segments or [PlannedSegment(collection=number, geometry=whole.geometry, plan=whole)]
    if not planned:
        raise outside[0]
    return number_blocks(planned)


def _cut(plan: Planner, collection: Collection, whole: Plan, number: int) -> list[PlannedSegment]:
    """Divide a strip that one epoch does not serve into segments; empty if it does, or division gains nothing.

    The fewest segments that keep the fidelity, judged by one in the middle; else as many as gain.
    """
    if excess_of(whole) <= 1.0:
        return []
    best, probe, spans = excess_of(whole), None, []
    for every in cuts(collection, longest_dwell(collection, whole.grid)):
        trial = within(collection, every, whole.grid)
        middle = _first_inside(plan, collection, whole.grid, trial)
        if middle is None or excess_of(middle) > max(USEFUL * best, 1.0):
            break
        best, probe, spans = excess_of(middle), middle, trial
        if best <= 1.0:
            break
    if probe is None or probe.refusal is not None:
        return []
    segments = []
    for k, span in enumerate(spans):
        own, owned = collection.segment(*span), owned_by(collection, spans, k)
        try:
            planned = plan(own, grid=whole.grid, owned=owned, blocks=probe.n_blocks, parts=probe.parts)
            if excess_of(planned) > (1.0 if best <= 1.0 else ALIKE * best):
                planned = plan(own, grid=whole.grid, owned=owned)
        except OutsideSwath:
            continue
        segments.append(PlannedSegment(collection=number, pulses=span, geometry=planned.geometry, plan=planned))
    return segments


def _first_inside(plan: Planner, collection: Collection, grid: Grid, spans: Sequence[Span]) -> Plan | None:
    """Plan the segment closest to the middle that covers some of the grid; None if none does."""
    for k in sorted(range(len(spans)), key=lambda k: abs(k - len(spans) // 2)):
        with suppress(OutsideSwath):
            own = collection.segment(*spans[k])
            return plan(own, grid=grid, owned=owned_by(collection, spans, k))
    return None


def number_blocks(segments: Sequence[PlannedSegment]) -> tuple[PlannedSegment, ...]:
    """Number the blocks of segments consecutively.

    Raises
    ------
    InputError
        If the image cannot hold their numbers.
    """
    numbered, first = [], 0
    for segment in segments:
        plan = segment.plan
        numbered.append(replace(segment, plan=plan and plan.numbered(first), first_block=first))
        first += 1 if plan is None else plan.n_blocks
    if first > MOST_NUMBERS:
        raise InputError(f"{first} blocks in all: an image numbers up to {MOST_NUMBERS}; ask for fewer --blocks")
    return tuple(numbered)
