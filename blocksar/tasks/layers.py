"""Layers of an image by chunks: noise; on a terrain, height, incidence angle and visibility."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from blocksar import stores
from blocksar.arrays import FloatArray
from blocksar.chunks import STRIP_CHUNKS
from blocksar.collection.grid import Grid
from blocksar.collection.terrain import Terrain
from blocksar.imaging.noise import NoiseMap
from blocksar.imaging.terrain_layers import (
    Sight,
    Strip,
    box_about,
    box_of,
    by_owner,
    heights_and_angles,
    heights_on_grid,
    reach,
    visibility,
)
from blocksar.kernels.occlusion import UNKNOWN
from blocksar.kernels.terrain_rows import SeenGround
from blocksar.planning.tiling import Window, chunk_window
from blocksar.runs.receipts import Run, write
from blocksar.runs.record import Written


class AlikeChunks:
    """Writer of a task's image chunks, for several threads; a chunk of one value is written once and linked.

    Most chunks of layers of small whole numbers have one value. To compress it, and to make a file, takes as long as a
    tenth of the correction of the chunk's pixels.
    """

    def __init__(self, run: Run) -> None:
        self._run, self._lock = run, threading.Lock()
        self._first: dict[tuple[str, tuple[int, ...], str], Written] = {}

    def write(self, variable: str, window: Window, values: NDArray[Any] | np.generic) -> Written:
        """Write a chunk of a variable from an array, or from the one value of all its samples."""
        shape = tuple(part.stop - part.start for part in window)
        chunk = np.broadcast_to(values, shape)
        one = chunk.flat[0]
        if values.ndim and (chunk.flat[-1] != one or (chunk != one).any()):
            return self._write(variable, window, chunk)
        kind = variable, shape, one.tobytes().hex()
        with self._lock:
            if kind not in self._first:
                self._first[kind] = self._write(variable, window, chunk)
                return self._first[kind]
        first, image = self._first[kind], self._run.image
        source = tuple(slice(*span) for span in first.region)
        if stores.share_region(image, variable, window, source=image, source_region=source):
            return replace(first, region=tuple((part.start, part.stop) for part in window))
        return self._write(variable, window, chunk)

    def _write(self, variable: str, window: Window, chunk: NDArray[Any]) -> Written:
        return write(self._run, self._run.image, variable, window, np.ascontiguousarray(chunk))


def local_terrain(run: Run, grid: Grid, window: Window) -> Terrain:
    """Read the part of the run's terrain that a window of the image needs."""
    y, x = grid.y[window[0]], grid.x[window[1]]
    return stores.read_terrain(run.terrain, (float(x[0]), float(x[-1])), (float(y[0]), float(y[-1])))


class GroundHeights:
    """Heights of a run's pixels, by windows; for one thread at a time."""

    def __init__(self, run: Run, grid: Grid) -> None:
        self._grid, self._stored = grid, stores.StoredTerrain(run.terrain) if run.on_terrain else None

    def over(self, window: Window) -> FloatArray | None:
        """Heights (n_y, n_x), m, of a window of the image; None on the plane."""
        if self._stored is None:
            return None
        y, x = self._grid.y[window[0]], self._grid.x[window[1]]
        return heights_on_grid(self._stored.read(*box_of(x, y)), x, y)


def strips_of(cells: Sequence[tuple[int, int]], grid: Grid) -> Iterator[tuple[Sequence[tuple[int, int]], Strip]]:
    """Group chunks, given by row and column, into strips of a few adjacent ones."""
    first = 0
    for end in range(1, len(cells) + 1):
        row, column = cells[end - 1]
        if end == len(cells) or end - first == STRIP_CHUNKS or cells[end] != (row, column + 1):
            windows = [chunk_window(cell, grid) for cell in cells[first:end]]
            yield cells[first:end], Strip(windows[0][0], [columns for _, columns in windows])
            first = end


class StripLayers:
    """Height, local incidence angle and visibility of the windows of a strip; for one thread at a time.

    Each is found when it is first asked for, for all windows together.
    """

    def __init__(
        self, strip: Strip, grid: Grid, terrain: Terrain, around: Terrain, sights: Mapping[int, Sight]
    ) -> None:
        self._strip, self._grid, self._terrain, self._around, self._sights = strip, grid, terrain, around, sights
        self._found: dict[int, list[SeenGround]] = {}
        self._seen: dict[int, NDArray[np.uint8]] = {}

    def over(self, number: int, owner: NDArray[np.int16]) -> dict[str, NDArray[Any]]:
        """Compute the layers of window `number`, by name.

        `owner` has the block of each pixel, -1 where not covered. Shadow and layover reach as far as the terrain about
        the image is known.
        """
        incidence = by_owner(self._sights, owner, lambda sight: self._of(sight)[number].angle, np.nan)
        seen = by_owner(self._sights, owner, lambda sight: self._visibility(number, sight), UNKNOWN)
        # Heights do not depend on the sight: use those already computed.
        found = next(iter(self._found.values()), None) or self._of(next(iter(self._sights.values())))
        layers = {"height": found[number].rounded, "incidence_angle": incidence, "visibility": seen}
        return {name: layers[name].astype(kind.dtype, copy=False) for name, kind in stores.ON_TERRAIN.items()}

    def _of(self, sight: Sight) -> list[SeenGround]:
        if id(sight) not in self._found:
            self._found[id(sight)] = heights_and_angles(self._terrain, sight, self._grid, self._strip)
        return self._found[id(sight)]

    def _visibility(self, number: int, sight: Sight) -> NDArray[np.uint8]:
        if id(sight) not in self._seen:
            self._seen[id(sight)] = visibility(self._around, sight, self._grid, self._strip.whole)
        columns, first = self._strip.columns[number], self._strip.columns[0].start
        return self._seen[id(sight)][:, columns.start - first : columns.stop - first]


class TerrainLayers:
    """Layers of a run's pixels on its terrain, read by strips.

    Parameters
    ----------
    run : Run
    grid : Grid
    sights : mapping of int to Sight
        The antenna as seen from the pixels of each owner.
    """

    def __init__(self, run: Run, grid: Grid, sights: Mapping[int, Sight]) -> None:
        self._grid, self._sights = grid, sights
        self._stored = self._around = stores.StoredTerrain(run.terrain)
        if (run.surroundings / "zarr.json").exists():
            self._around = stores.StoredTerrain(run.surroundings)

    def of(self, strip: Strip) -> StripLayers:
        """Read the terrain that the layers of a strip need."""
        y, x = self._grid.y[strip.rows], self._grid.x[strip.whole[1]]
        boxes, seen_by = [box_about(self._grid, strip.whole)], {id(sight): sight for sight in self._sights.values()}
        for sight in seen_by.values():
            boxes.append(reach(sight, x, y, self._around.limits))
        (x0, x1, y0, y1) = (np.array(boxes)[:, axis, end] for axis in (0, 1) for end in (0, 1))
        around = self._around.read((float(x0.min()), float(x1.max())), (float(y0.min()), float(y1.max())))
        terrain = around if self._around is self._stored else self._stored.read(*boxes[0])
        return StripLayers(strip, self._grid, terrain, around, self._sights)


def write_layers(alike: AlikeChunks, window: Window, layers: Mapping[str, NDArray[Any]]) -> list[Written]:
    """Write the layers of an image chunk, given by name."""
    return [alike.write(name, window, values) for name, values in layers.items()]


def write_noise(
    run: Run,
    window: Window,
    owner: NDArray[np.int16],
    grid: Grid,
    noises: Mapping[int, NoiseMap],
    height: FloatArray | None,
) -> list[Written]:
    """Write the noise of an image chunk where it is covered, from the noise maps of its blocks; nothing if unknown.

    `height` (n_y, n_x) has z of the pixels, m, on a terrain.
    """
    if not noises:
        return []
    values = np.full(owner.shape, np.nan, np.float32)
    for noise in {id(noise): noise for noise in noises.values()}.values():
        own = np.isin(owner, [block for block, of in noises.items() if of is noise])
        np.copyto(values, noise.over(grid.x[window[1]], grid.y[window[0]], height), where=own)
    return [write(run, run.image, "noise_equivalent", window, values)]
