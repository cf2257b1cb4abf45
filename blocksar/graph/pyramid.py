"""The pyramid of an image, from its whole chunks: the mean power of covered pixels, halved in size level by level."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import product

import numpy as np
from distributed import Client
from numpy.typing import NDArray

from blocksar import stores
from blocksar.chunks import IMAGE_CHUNK, PYRAMID_LEVELS
from blocksar.graph.spectrum import Window
from blocksar.graph.tasks import naming_failures, sign
from blocksar.graph.units import run_units, single_task
from blocksar.graph.writing import in_threads
from blocksar.kernels.halving import halve
from blocksar.progress import Listener
from blocksar.runs.receipts import Run, write
from blocksar.runs.record import Receipt, Written

Power = NDArray[np.float32]


def build_pyramid(
    client: Client, run: Run, shape: tuple[int, int], formed: Sequence[Receipt], listener: Listener
) -> list[Receipt]:
    """Write the pyramid of the image, (n_y, n_x) pixels, if its store has one; return the receipts.

    `formed` are those of the image, which tell the chunks that are there; nothing is read for the others.
    A unit makes the first PYRAMID_LEVELS of as much of the image as fills a chunk of the last of them; one more makes
    the few that remain.
    """
    if not stores.levels_of(run.image):
        return []
    side, covered = IMAGE_CHUNK * 2**PYRAMID_LEVELS, _covered(run, formed)
    parts: dict[tuple[int, int], set[tuple[int, int]]] = {}
    for y, x in covered:
        parts.setdefault((y // side * side, x // side * side), set()).add((y, x))
    units = [
        single_task(client, run, "pyramid", f"pyramid-{y // side}-{x // side}", reduce_image, (y, x), shape, some)
        for (y, x), some in sorted(parts.items())
    ]
    receipts = run_units(client, "pyramid", units, run, listener, per_worker=2)
    if len(stores.level_shapes(shape)) <= PYRAMID_LEVELS:
        return receipts
    top = single_task(client, run, "pyramid-top", "pyramid-top", reduce_levels, shape)
    return [*receipts, *run_units(client, "pyramid-top", [top], run, listener)]


@naming_failures(lambda run, unit, *_: f"pyramid of {unit}")
def reduce_image(
    run: Run, unit: str, first: tuple[int, int], shape: tuple[int, int], covered: set[tuple[int, int]]
) -> Receipt:
    """Write the first levels of a part of the image that begins at row and column `first`.

    `covered` has the first row and column of those of its chunks that are there.
    """
    started = time.perf_counter()
    shapes = stores.level_shapes(shape)[:PYRAMID_LEVELS]
    windows = list(_windows((first[0] // 2, first[1] // 2), shapes[0], 2 ** (PYRAMID_LEVELS - 1)))
    jobs = (partial(_first_level, run, window, shape, covered) for window in windows)
    finer: dict[tuple[int, int], Power] = {}
    written: list[Written] = []
    for window, (power, parts) in zip(windows, in_threads(jobs, run.threads), strict=True):
        finer[window[0].start, window[1].start] = power
        written += parts
    for level, size in enumerate(shapes[1:], 2):
        coarser: dict[tuple[int, int], Power] = {}
        at = first[0] >> level, first[1] >> level
        for window in _windows(at, size, 2 ** (PYRAMID_LEVELS - level)):
            power = halve(_laid(finer, window, shapes[level - 2]))
            coarser[window[0].start, window[1].start] = power
            written += _write(run, level, window, power)
        finer = coarser
    return sign(run, Receipt(unit=unit, stage="pyramid", written=tuple(written)), started)


@naming_failures(lambda *_: "top of the pyramid")
def reduce_levels(run: Run, unit: str, shape: tuple[int, int]) -> Receipt:
    """Write the levels after the first, each a chunk at a time from that before it."""
    started = time.perf_counter()
    shapes, written = stores.level_shapes(shape), list[Written]()
    for level in range(PYRAMID_LEVELS + 1, len(shapes) + 1):
        for window in _windows((0, 0), shapes[level - 1], None):
            source = _doubled(window, shapes[level - 2])
            finer = stores.read_region(run.image, stores.level_name(level - 1), source, cached=False)
            written += _write(run, level, window, halve(finer))
    return sign(run, Receipt(unit=unit, stage="pyramid-top", written=tuple(written)), started)


def _windows(first: tuple[int, int], shape: tuple[int, int], count: int | None) -> Iterator[Window]:
    """The chunks of a level (n_y, n_x) from row and column `first` on, at most `count` along either axis; None: all."""
    spans = []
    for start, n in zip(first, shape, strict=True):
        end = n if count is None else min(start + count * IMAGE_CHUNK, n)
        spans.append([slice(k, min(k + IMAGE_CHUNK, n)) for k in range(start, end, IMAGE_CHUNK)])
    yield from product(*spans)


def _doubled(window: Window, shape: tuple[int, int]) -> Window:
    """Where the cells of a window lie in the level before, of a shape."""
    rows, columns = (slice(2 * part.start, min(2 * part.stop, n)) for part, n in zip(window, shape, strict=True))
    return rows, columns


def _covered(run: Run, formed: Sequence[Receipt]) -> set[tuple[int, int]]:
    """First row and column of the chunks of the image that receipts tell of."""
    image = run.name_of(run.image)
    parts = (part for receipt in formed for part in receipt.written if part.store == image and part.variable == "image")
    return {(part.region[0][0], part.region[1][0]) for part in parts}


def _first_level(
    run: Run, window: Window, shape: tuple[int, int], covered: set[tuple[int, int]]
) -> tuple[Power, list[Written]]:
    """The power of a chunk of the first level, from those of the image that are there."""
    power = np.full([part.stop - part.start for part in window], np.nan, np.float32)
    rows, columns = _doubled(window, shape)
    for y, x in product(range(rows.start, rows.stop, IMAGE_CHUNK), range(columns.start, columns.stop, IMAGE_CHUNK)):
        if (y, x) in covered:
            part = slice(y, min(y + IMAGE_CHUNK, rows.stop)), slice(x, min(x + IMAGE_CHUNK, columns.stop))
            half = halve(stores.read_region(run.image, "image", part, cached=False))
            top, left = (y - rows.start) // 2, (x - columns.start) // 2
            power[top : top + half.shape[0], left : left + half.shape[1]] = half
    return power, _write(run, 1, window, power)


def _laid(parts: dict[tuple[int, int], Power], window: Window, shape: tuple[int, int]) -> Power:
    """The cells of the level before, of a shape, that those of a window are made of, from its chunks."""
    rows, columns = _doubled(window, shape)
    laid = np.empty((rows.stop - rows.start, columns.stop - columns.start), np.float32)
    for y, x in product(range(rows.start, rows.stop, IMAGE_CHUNK), range(columns.start, columns.stop, IMAGE_CHUNK)):
        part = parts[y, x]
        n_y, n_x = part.shape
        top, left = y - rows.start, x - columns.start
        laid[top : top + n_y, left : left + n_x] = part
    return laid


def _write(run: Run, level: int, window: Window, power: Power) -> list[Written]:
    """Write a chunk of a level, if any of it is covered."""
    if not np.isfinite(power).any():
        return []
    return [write(run, run.image, stores.level_name(level), window, power)]
