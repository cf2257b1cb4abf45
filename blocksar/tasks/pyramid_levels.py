"""The pyramid of an image, built from its chunks: mean power of covered pixels, each level half the size."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np
from numpy.typing import NDArray

from blocksar import stores
from blocksar.chunks import IMAGE_CHUNK, PYRAMID_LEVELS
from blocksar.graph.units import Executor, Unit
from blocksar.kernels.halving import halve
from blocksar.planning.tiling import Window
from blocksar.runs.receipts import Run, write
from blocksar.runs.record import Receipt, Written

Power = NDArray[np.float32]


def build_pyramid(executor: Executor, run: Run, shape: tuple[int, int]) -> list[Receipt]:
    """Write the pyramid's levels after the first for an image of (n_y, n_x) pixels; return the receipts.

    The first is written with the image, by `tasks.write_level`. A unit makes those up to PYRAMID_LEVELS of as much as
    fills a chunk of the last of them; one more makes the few that remain.
    """
    levels = len(stores.level_shapes(shape)) if run.pyramid else 0
    if levels < 2:
        return []
    side = IMAGE_CHUNK * 2 ** (PYRAMID_LEVELS - 1)  # cells of the first level
    n_y, n_x = stores.level_shapes(shape)[0]
    parts = {f"pyramid-{y // side}-{x // side}": (y, x) for y, x in product(range(0, n_y, side), range(0, n_x, side))}
    units = [
        Unit("pyramid", run, name, reduce_part, (first, shape), title=f"pyramid of {name}")
        for name, first in parts.items()
    ]
    receipts = executor.run_units("pyramid", units, per_worker=2)
    if levels > PYRAMID_LEVELS:
        top = Unit("pyramid-top", run, "pyramid-top", reduce_levels, (shape,), title="top of the pyramid")
        receipts += executor.run_units("pyramid-top", [top])
    return receipts


def reduce_part(run: Run, unit: str, first: tuple[int, int], shape: tuple[int, int]) -> Receipt:
    """Write levels from 2 on from the part of level 1 that begins at row and column `first`."""
    shapes = stores.level_shapes(shape)[:PYRAMID_LEVELS]
    written: list[Written] = []
    finer: dict[tuple[int, int], Power] = {}
    for level, size in enumerate(shapes[1:], 2):
        coarser: dict[tuple[int, int], Power] = {}
        at = first[0] >> (level - 1), first[1] >> (level - 1)
        for window in _windows(at, size, 2 ** (PYRAMID_LEVELS - level)):
            source = _doubled(window, shapes[level - 2])
            before = _laid(finer, source) if finer else _read(run, 1, source)
            coarser[window[0].start, window[1].start] = power = halve(before)
            written += _write(run, level, window, power)
        finer = coarser
    return Receipt(unit=unit, stage="pyramid", written=tuple(written))


def reduce_levels(run: Run, unit: str, shape: tuple[int, int]) -> Receipt:
    """Write the levels after the first, each chunk from those of the level before."""
    shapes, written = stores.level_shapes(shape), list[Written]()
    for level in range(PYRAMID_LEVELS + 1, len(shapes) + 1):
        for window in _windows((0, 0), shapes[level - 1], None):
            source = _doubled(window, shapes[level - 2])
            written += _write(run, level, window, halve(_read(run, level - 1, source)))
    return Receipt(unit=unit, stage="pyramid-top", written=tuple(written))


def _windows(first: tuple[int, int], shape: tuple[int, int], count: int | None) -> Iterator[Window]:
    """Iterate over chunks of a level (n_y, n_x) from row and column `first` on, up to `count` along each axis."""
    spans = []
    for start, n in zip(first, shape, strict=True):
        end = n if count is None else min(start + count * IMAGE_CHUNK, n)
        spans.append([slice(k, min(k + IMAGE_CHUNK, n)) for k in range(start, end, IMAGE_CHUNK)])
    yield from product(*spans)


def _doubled(window: Window, shape: tuple[int, int]) -> Window:
    """Window of the previous level, of a shape, that a window's cells are averaged from."""
    rows, columns = (slice(2 * part.start, min(2 * part.stop, n)) for part, n in zip(window, shape, strict=True))
    return rows, columns


def _read(run: Run, level: int, window: Window) -> Power:
    return stores.read_region(run.image, stores.level_name(level), window)


def _laid(parts: dict[tuple[int, int], Power], window: Window) -> Power:
    """Assemble a window of a level from its chunks, given by first row and column."""
    rows, columns = window
    laid = np.empty((rows.stop - rows.start, columns.stop - columns.start), np.float32)
    for y, x in product(range(rows.start, rows.stop, IMAGE_CHUNK), range(columns.start, columns.stop, IMAGE_CHUNK)):
        part = parts[y, x]
        top, left = y - rows.start, x - columns.start
        laid[top : top + part.shape[0], left : left + part.shape[1]] = part
    return laid


def _write(run: Run, level: int, window: Window, power: Power) -> list[Written]:
    """Write a chunk of a level, unless none of it is covered."""
    if not np.isfinite(power).any():
        return []
    return [write(run, run.image, stores.level_name(level), window, power, cached=True)]
