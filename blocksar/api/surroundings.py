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
from blocksar.ingestion.terrain.around import read_around
from blocksar.ingestion.terrain.reading import Ground


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

    def needed(limits: tuple[float, float]) -> Box:
        boxes = np.array([reach(sight, grid.x, grid.y, limits) for sight in sights])
        low, high = boxes[..., 0].min(axis=0), boxes[..., 1].max(axis=0)
        return (float(low[0]), float(high[0])), (float(low[1]), float(high[1]))

    return read_around(terrain, own, needed, lambda box: ground.read_box(georeference, *box, refine=False))
