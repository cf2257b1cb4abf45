"""Several collections in one image, and long strips as segments along time: each is planned by itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.collection.region import Owned, default_grid, plan_region
from blocksar.errors import InputError, OutsideSwath
from blocksar.planning.plan import Plan

MOST_NUMBERS = 1 << 15  # of blocks, which the image holds as int16


class Divided(NamedTuple):
    """How an earlier process divided a segment.

    Number of its collection, its pulses (None for all), numbers of its blocks and of range sub-blocks in each.
    """

    collection: int
    pulses: tuple[int, int] | None
    blocks: int
    parts: int


class Planner(Protocol):
    """Plans one collection: `plan_collection` with the settings of a run."""

    def __call__(
        self, collection: Collection, *, grid: Grid | None, like: Divided | None, owned: Owned | None
    ) -> Plan: ...


@dataclass(frozen=True, kw_only=True, eq=False)
class PlannedSegment:
    """A collection of several, or a part of one along time, with its plan.

    Attributes
    ----------
    collection : int
        Number of the collection.
    pulses : (first, last) or None
        Its pulses first <= p < last; None for all of them.
    plan : Plan
        Its blocks are numbered after those of the segments before it: from `first_block` on.
    """

    collection: int
    pulses: tuple[int, int] | None
    plan: Plan
    first_block: int = 0


def joint_grid(geometries: Sequence[Geometry]) -> Grid:
    """The bounding box of the default grids of collections, at the finest of their spacings.

    Raises
    ------
    InputError
        If one of them has no default grid.
    """
    grids = [default_grid(geometry, plan_region(geometry, None)) for geometry in geometries]
    if len(grids) == 1:
        return grids[0]
    step = min(grid.dx for grid in grids)

    def box(low: float, high: float) -> tuple[float, float, float]:
        return float(step * round(low / step)), float(step * round(high / step)), step

    x = box(min(grid.x0 for grid in grids), max(grid.x1 for grid in grids))
    y = box(min(grid.y0 for grid in grids), max(grid.y1 for grid in grids))
    return Grid(*x, *y)


def plan_segments(
    plan: Planner, collections: Sequence[Collection], *, grid: Grid | None, like: Sequence[Divided] | None = None
) -> tuple[PlannedSegment, ...]:
    """Plan every collection that covers some of the grid, about its own epoch.

    Parameters
    ----------
    plan : callable
    collections : sequence of Collection
    grid : Grid or None
        None: the default one of a single collection, or that of several jointly.
    like : sequence of Divided, optional
        What an earlier process planned, to be planned again.

    Raises
    ------
    InputError
        If none does, one of them cannot be focused, or there are too many blocks.
    """
    if grid is None and len(collections) > 1:
        grid = joint_grid([Geometry(collection=collection) for collection in collections])
    if like is not None:
        return number_blocks([_plan_again(plan, collections, grid, each) for each in like])
    planned: list[PlannedSegment] = []
    outside: list[OutsideSwath] = []
    for number, collection in enumerate(collections):
        try:
            whole = plan(collection, grid=grid, like=None, owned=None)
            planned.append(PlannedSegment(collection=number, pulses=None, plan=whole))
        except OutsideSwath as error:
            outside.append(error)
    if not planned:
        raise outside[0]
    return number_blocks(planned)


def _plan_again(plan: Planner, collections: Sequence[Collection], grid: Grid | None, like: Divided) -> PlannedSegment:
    whole = plan(collections[like.collection], grid=grid, like=like, owned=None)
    return PlannedSegment(collection=like.collection, pulses=None, plan=whole)


def number_blocks(segments: Sequence[PlannedSegment]) -> tuple[PlannedSegment, ...]:
    """Number the blocks of segments consecutively.

    Raises
    ------
    InputError
        If the image cannot hold their numbers.
    """
    numbered, first = [], 0
    for segment in segments:
        numbered.append(replace(segment, plan=segment.plan.numbered(first), first_block=first))
        first += segment.plan.n_blocks
    if first > MOST_NUMBERS:
        raise InputError(f"{first} blocks in all: an image numbers up to {MOST_NUMBERS}; ask for fewer --blocks")
    return tuple(numbered)
