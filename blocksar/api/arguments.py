"""Arguments that several commands share: the source and the grid."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from blocksar import stores
from blocksar.collection.collection import Collection
from blocksar.collection.grid import Grid
from blocksar.errors import InputError
from blocksar.places import Location
from blocksar.places.place import Place

if TYPE_CHECKING:
    import xarray as xr

GridLike = Grid | tuple[tuple[float, float, float], tuple[float, float, float]]


def grid_of(grid: GridLike | None) -> Grid | None:
    """Return a Grid; two triples stand for start, end and step (m) in x and in y."""
    if grid is None or isinstance(grid, Grid):
        return grid
    return Grid(*grid[0], *grid[1])


def collection_of(source: Location | xr.Dataset) -> Collection:
    """Return the collection of a scene (a TOML file or the name of a shipped one) or of a phase history, centred."""
    text = str(source) if isinstance(source, str | Path) else ""
    if text.endswith(".toml") or (text and not Path(text).exists()):
        from blocksar.simulation.scene import Scene, shipped_scenes

        if text.endswith(".toml") or text in shipped_scenes():
            return Scene.read(text).collection().centred()
    return stores.open_phase_history(path_of(source)).collection.centred()


def path_of(source: Location | xr.Dataset) -> Location:
    """Return the path of a phase history; a dataset is used for the path that it was opened from.

    Raises
    ------
    InputError
        If the dataset was not opened from a store.
    """
    return source if isinstance(source, str | os.PathLike | Place) else _dataset_path(source)


def _dataset_path(source: xr.Dataset) -> str:
    path = source.encoding.get("source")
    if path is None:
        raise InputError(
            "source is a dataset that was not opened from a store; write it with to_zarr(path, zarr_format=3) and pass "
            "that path"
        )
    return str(path)
