"""Arguments that several commands share: the source, the grid, and the resources of the machine."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from blocksar import stores
from blocksar.collection.collection import Collection
from blocksar.collection.grid import Grid
from blocksar.errors import InputError
from blocksar.graph.machine import machine
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


class Resources(NamedTuple):
    """Resources of a cluster: processes, threads in each, and memory of each in bytes."""

    workers: int
    threads: int
    memory_limit: int


def resources(workers: int | None, threads: int | None, memory_limit: int | None) -> Resources:
    """Fill in defaults: workers times threads is at most the number of cores, and workers share the memory equally.

    Raises
    ------
    InputError
        If a number is below 1.
    """
    cores, memory = machine()
    for name, value in (("workers", workers), ("threads", threads)):
        if value is not None and value < 1:
            raise InputError(f"{name} must be at least 1, got {value}")
    workers = workers or min(cores, 4)
    threads = threads or max(cores // workers, 1)
    return Resources(workers, threads, memory_limit or memory // workers)
