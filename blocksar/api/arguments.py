"""Arguments that several commands share: the source and the grid."""

from __future__ import annotations

import os
import sys
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
        from blocksar.simulation.scene import Scene
        from blocksar.simulation.shipped import shipped_scenes

        if text.endswith(".toml") or text in shipped_scenes():
            return Scene.read(text).collection().centred()
    return history_of(source).collection.centred()


def history_of(source: Location | xr.Dataset) -> stores.PhaseHistory:
    """Open the phase history that a path names, or that a dataset is.

    Raises
    ------
    InputError
        If there is none, or it departs from the contract.
    """
    if isinstance(source, str | os.PathLike | Place):
        return stores.open_phase_history(source)
    if _is_dataset(source):
        return stores.history_of(source)
    what = f"{type(source).__module__.partition('.')[0]}.{type(source).__name__}".removeprefix("builtins.")
    raise InputError(
        f"source is a {what}; give the path of a phase history, or a dataset, which blocksar.collection builds from "
        "arrays"
    )


def _is_dataset(source: object) -> bool:
    xarray = sys.modules.get("xarray")  # who has a dataset has loaded it
    return xarray is not None and isinstance(source, xarray.Dataset)
