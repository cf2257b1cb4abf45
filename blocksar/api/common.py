"""What the commands share: how they answer, what they take for a source, a grid, the resources of a machine."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from blocksar import graph, runs, stores
from blocksar.cluster import machine
from blocksar.parameters import Collection, ComplexArray, FloatArray, InputError
from blocksar.places import Location, Place
from blocksar.planning import MEMORY_SHARE
from blocksar.progress import Updated as Progress
from blocksar.progress import listener
from blocksar.region import Grid
from blocksar.scene import Scene, shipped_scenes

if TYPE_CHECKING:
    import xarray as xr

GridLike = Grid | tuple[tuple[float, float, float], tuple[float, float, float]]
Table = tuple[Sequence[str], Sequence[Sequence[str]]]

MIB = 2**20


def only_stage(progress: Progress | None, stage: str) -> Callable[[int, int], None]:
    """A command's only stage begins: what its parts are told to."""
    told = listener(progress)
    told.begin(stage)
    return partial(told.update, stage)


@dataclass(frozen=True)
class Report:
    """What a command tells a person: tables, then sentences. `refusal` says why a plan cannot be carried out."""

    tables: list[Table] = field(default_factory=list)
    summary: list[str] = field(default_factory=list)
    refusal: str | None = None
    result: Any = None

    def table(self) -> list[Table]:
        return self.tables


def grid_of(grid: GridLike | None) -> Grid | None:
    if grid is None or isinstance(grid, Grid):
        return grid
    return Grid(*grid[0], *grid[1])


def collection_of(source: Location | xr.Dataset) -> Collection:
    text = str(source) if isinstance(source, str | Path) else ""
    if text.endswith(".toml") or (text in shipped_scenes() and not Path(text).exists()):
        return Scene.read(text).collection().centred()
    return stores.open_phase_history(path_of(source)).collection.centred()


def path_of(source: Location | xr.Dataset) -> Location:
    return source if isinstance(source, str | os.PathLike | Place) else _dataset_path(source)


def _dataset_path(source: xr.Dataset) -> str:
    path = source.encoding.get("source")
    if path is None:
        raise InputError(
            "source is a dataset that lies in no store; write it with to_zarr(path, zarr_format=3) and pass that path"
        )
    return str(path)


def resources(workers: int | None, threads: int | None, memory_limit: int | None) -> tuple[int, int, int]:
    """Workers, threads a worker, bytes a worker: by default workers x threads is the number of cores."""
    cores, memory = machine()
    for name, value in (("workers", workers), ("threads", threads)):
        if value is not None and value < 1:
            raise InputError(f"{name} must be at least 1, got {value}")
    workers = workers or min(cores, 4)
    threads = threads or max(cores // workers, 1)
    return workers, threads, memory_limit or memory // workers


def back_projection_memory(collection: Collection, grid: Grid, threads: int, memory_limit: int) -> int:
    """Peak of a worker, bytes; refuses what the limit does not hold."""
    memory = graph.back_projection_memory(collection, grid, threads=threads)
    return checked_memory("back-projection", memory, memory_limit)


def checked_memory(what: str, memory: int, memory_limit: int) -> int:
    """So many bytes of a worker, unless its limit does not hold them."""
    if memory > MEMORY_SHARE * memory_limit:
        raise InputError(
            f"memory limit {memory_limit / MIB:.0f} MiB a worker is too low: {what} needs about "
            f"{math.ceil(memory / MEMORY_SHARE / MIB)} MiB; raise --memory-limit"
        )
    return memory


@dataclass(frozen=True, eq=False)
class Image:
    """A finished run's image, read by window."""

    path: Place
    x: FloatArray
    y: FloatArray

    def read(self, rows: slice, columns: slice) -> ComplexArray:
        return stores.read_region(self.path, "image", (rows, columns))

    def block(self, rows: slice, columns: slice) -> Any:
        return stores.read_region(self.path, "block", (rows, columns))


def finished_record(run: Place) -> dict[str, Any]:
    """What run.json says of a finished run.

    Raises
    ------
    InputError
        If the run is not finished.
    """
    record = stores.read_json(run / "run.json")
    if not isinstance(record, dict) or record.get("status") != runs.FINISHED:
        raise InputError(f"{run} is not finished; run `blocksar focus` again with the same settings")
    return record


def open_run(run: Place) -> tuple[Image, Collection, dict[str, Any], dict[str, Any]]:
    if not (run / "run.json").exists():
        raise InputError(f"{run} holds no run.json; give the folder that `blocksar focus --out` left")
    record = finished_record(run)
    collection, attrs = stores.read_collection(run / "collection.zarr")
    x, y = (stores.read_region(run / "image.zarr", name, (slice(None),)) for name in ("x", "y"))
    if x.size and y.size and min(x.size, y.size) < 2:
        raise InputError(
            f"the image of {run} has {y.size} x {x.size} pixels (y, x), and products and measurements take 2 at least "
            "in each direction; focus on a larger --grid"
        )
    if any(axis.size < 2 or not (np.diff(axis) > 0).all() for axis in (x, y)):
        raise InputError(f"x or y in {run / 'image.zarr'} is damaged; focus again with --overwrite")
    return Image(run / "image.zarr", x, y), collection.centred(), attrs, record
