"""Looks that are asked for: whether they can be formed, and how dwells are divided into them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from blocksar import stores
from blocksar.api.arguments import One, Source, history_of, is_scene, sources_of
from blocksar.api.ground import image_grid
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.collection.region import grid_extent, plan_region
from blocksar.collection.sublooks import checked_count, entering_side, look_of
from blocksar.errors import InputError
from blocksar.planning.planner import beam_stays


@dataclass(frozen=True)
class Looks:
    """How dwells are divided into looks.

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
        """The collection as each look sees it."""
        return [look_of(collection, number, self.count, self.sign) for number in range(self.count)]


def one_source(source: Source, count: int) -> One:
    """Return the only source, of one channel, of which looks are to be formed.

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
