"""The terrain about an area, whose relief casts shadow into it or overlies it."""

from __future__ import annotations

from collections.abc import Callable

from blocksar.collection.terrain import Terrain

HIGHER = 3000.0  # m: relief about an area that is looked for, above its own highest place
MOST_AROUND = 1 << 24  # heights of the terrain about an area: of a finer one, less far away

Box = tuple[tuple[float, float], tuple[float, float]]  # x and y, from .. to, m
Limits = tuple[float, float]  # lowest and highest height, m


def read_around(
    terrain: Terrain, own: Box, needed: Callable[[Limits], Box], read: Callable[[Box], Terrain]
) -> Terrain | None:
    """The terrain as far as anything on it hides or overlies places of an area; None if `terrain` is all of that.

    Parameters
    ----------
    terrain : Terrain
        What is known of it, over the area.
    own : Box
        The area.
    needed : callable
        The box on which what is seen of the area depends, for a terrain between two heights.
    read : callable
        The terrain over a box, or what there is of it.
    """
    terrain = terrain.thinned()
    low, high = terrain.limits
    around = read(_within(needed((low, high + HIGHER)), own, terrain))
    for _ in range(2):  # with heights as they are there
        around = around.window(*needed(around.limits))
    extents = (terrain.x[0], terrain.x[-1]), (terrain.y[0], terrain.y[-1])
    beyond = (around.x[0], around.x[-1]), (around.y[0], around.y[-1])
    covered = all(a[0] <= b[0] and b[1] <= a[1] for a, b in zip(extents, beyond, strict=True))
    return None if covered else around


def _within(box: Box, own: Box, terrain: Terrain) -> Box:
    """A box, drawn back towards the area's until it has no more heights than are taken."""
    share = 1.0
    while True:
        drawn = [
            (inner[0] + share * (outer[0] - inner[0]), inner[1] + share * (outer[1] - inner[1]))
            for outer, inner in zip(box, own, strict=True)
        ]
        count = [(side[1] - side[0]) / step for side, step in zip(drawn, (terrain.dx, terrain.dy), strict=True)]
        if share < 0.01 or count[0] * count[1] <= max(MOST_AROUND, terrain.heights.size):
            return drawn[0], drawn[1]
        share *= 0.8
