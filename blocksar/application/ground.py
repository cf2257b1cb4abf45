"""The ground that an image is formed on: options and attributes read as a plane or a terrain under the collection."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from blocksar import stores
from blocksar.application.arguments import One, history_of, scene_of
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry, over_terrain
from blocksar.collection.georeference import Georeference
from blocksar.collection.grid import Grid
from blocksar.collection.region import check_seen, default_grid, joint_grid, plan_region
from blocksar.collection.terrain import Terrain
from blocksar.imaging.terrain_layers import Box, Sight, box_of, reach
from blocksar.places.place import Place
from blocksar.readers.heights import Ground
from blocksar.readers.terrain_earth import read_around

PLANE = Ground()


def read_ground(
    ground: Ground, collection: Collection, grid: Grid | None, source: One | dict[str, Any]
) -> Terrain | None:
    """Read the terrain under an image; None for a plane. `source` is a phase history, a scene, or their attributes.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    if ground.plane:
        return None
    attrs = source if isinstance(source, dict) else _attributes(source)
    return ground.read(Georeference.among(attrs), collection.ground_height, image_grid(collection, grid))


def ground_under(ground: Ground, source: One) -> Ground:
    """Return the ground that the user's options name, completed by that of the phase history or scene.

    Raises
    ------
    InputError
        If the phase history names an unknown one.
    """
    return ground.under(_attributes(source)) if ground.plane else ground


def _attributes(source: One) -> Mapping[str, Any]:
    """Return the attributes of a phase history, or the georeference of a scene."""
    scene = scene_of(source)
    if scene is not None:
        return {} if scene.georeference is None else {"georeference": scene.georeference.as_attribute()}
    return history_of(source).attrs


def image_grid(collection: Collection, grid: Grid | None) -> Grid:
    """Return the given grid, or by default that of the lit sector on the plane z = ground_height."""
    if grid is not None:
        return grid
    geometry = Geometry(collection=collection)
    return default_grid(geometry, plan_region(geometry, None))


def ground_settings(ground: Ground, terrain: Terrain | None, surroundings: Terrain | None) -> dict[str, Any]:
    """The ground in the settings of a run: its source, and a fingerprint of its heights."""
    named, heights = ground.terrain, [each for each in (terrain, surroundings) if each is not None]
    path = None if named is None else str(named) if isinstance(named, Place) else os.path.abspath(named)
    return {
        "surface": ground.surface or "plane",
        "terrain": path,
        "vertical": ground.vertical,
        "heights": "-".join(map(stores.terrain_fingerprint, heights)) or None,
    }


def check_ground(collections: Sequence[Collection], grid: Grid | None, *, any_grid: bool) -> None:
    """Check before the work starts that the beam lights ground; the plan would find out only after loops are compiled.

    Of several collections, those that cover nothing of a grid are left out later. Back-projection takes any grid of
    which something is seen.

    Raises
    ------
    InputError
        If the grid is missing, or lies outside the swath.
    """
    if grid is None:
        joint_grid([Geometry(collection=collection) for collection in collections])
    elif len(collections) == 1:
        geometry = Geometry(collection=collections[0])
        if any_grid:
            check_seen([geometry], grid)
        else:
            plan_region(geometry, grid)


def read_surroundings(
    ground: Ground,
    terrain: Terrain,
    collections: Sequence[Collection],
    grid: Grid,
    georeference: Georeference | None,
) -> Terrain | None:
    """Read the terrain outside the grid that shadows or overlays places of it; None if the terrain below it suffices.

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
    sights = [Sight.of(over_terrain(each, terrain), own, terrain.limits) for each in collections]

    def needed(limits: tuple[float, float]) -> Box:
        boxes = np.array([reach(sight, grid.x, grid.y, limits) for sight in sights])
        low, high = boxes[..., 0].min(axis=0), boxes[..., 1].max(axis=0)
        return (float(low[0]), float(high[0])), (float(low[1]), float(high[1]))

    return read_around(terrain, own, needed, lambda box: ground.read_box(georeference, *box, refine=False))
