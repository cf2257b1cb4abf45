"""The terrain about an image, whose relief casts shadow into it or overlies it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from blocksar.api.ground import geometry_over
from blocksar.collection.collection import Collection
from blocksar.collection.georeference import Georeference
from blocksar.collection.grid import Grid
from blocksar.collection.terrain import Terrain
from blocksar.focusing.terrain_layers import Box, Sight, box_of, reach
from blocksar.ingestion.terrain.reading import Ground

HIGHER = 3000.0  # m: relief about an image that is looked for, above its own highest place
MOST_AROUND = 1 << 24  # heights of the terrain about an image: of a finer one, less far away


def read_surroundings(
    ground: Ground,
    terrain: Terrain,
    collections: Sequence[Collection],
    grid: Grid,
    georeference: Georeference | None,
) -> Terrain | None:
    """The terrain as far as anything on it hides or overlies places of the grid; None if that is all under it.

    Parameters
    ----------
    ground : Ground
    terrain : Terrain
        What has been read of it, under the grid.
    collections : sequence of Collection
        That see the grid.
    """
    if ground.terrain is None:
        return None
    own = box_of(grid.x, grid.y)
    sights = [Sight.of(geometry_over(each, terrain), own, terrain.limits) for each in collections]
    low, high = terrain.limits
    box = _within(_reach(sights, grid, (low, high + HIGHER)), own, terrain)
    around = ground.read_box(georeference, *box)
    for _ in range(2):  # with heights as they are there
        needed = _reach(sights, grid, around.limits)
        around = around.window(*needed)
    extents = (terrain.x[0], terrain.x[-1]), (terrain.y[0], terrain.y[-1])
    beyond = (around.x[0], around.x[-1]), (around.y[0], around.y[-1])
    covered = all(a[0] <= b[0] and b[1] <= a[1] for a, b in zip(extents, beyond, strict=True))
    return None if covered else around


def _reach(sights: Sequence[Sight], grid: Grid, limits: tuple[float, float]) -> Box:
    """What `reach` says of all of a grid, for all who see it."""
    boxes = np.array([reach(sight, grid.x, grid.y, limits) for sight in sights])
    low, high = boxes[..., 0].min(axis=0), boxes[..., 1].max(axis=0)
    return (float(low[0]), float(high[0])), (float(low[1]), float(high[1]))


def _within(box: Box, own: Box, terrain: Terrain) -> Box:
    """A box, drawn back towards the grid's until it has no more heights than are taken."""
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
