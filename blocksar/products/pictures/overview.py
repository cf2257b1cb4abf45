"""Reduction of an image and its block map to the size of a picture, strip by strip, and choice of the grey scale."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from blocksar import stores
from blocksar.arrays import ComplexArray, FloatArray
from blocksar.progress.listening import Callback
from blocksar.runs.finished import FinishedRun

ReadImage = Callable[[slice, slice], ComplexArray]
ReadBlock = Callable[[slice, slice], NDArray[np.int16]]
COARSER = 4 / 3  # cells of a level over those of the pixels, at most
NARROWEST, WIDEST = 25.0, 60.0  # dB between the ends of a grey scale
CLIPPED = 20.0  # dB by which the strongest cell may lie above one
LEAST_SHOWN = 0.005  # of the cells, whose power should lie within the range in dB
NOT_COVERED = "#39506b"  # slate blue: cannot be mistaken for dark ground


def reader_of(source: FinishedRun, progress: Callback | None) -> ReadImage:
    """Make a function that reads an image and reports how many of its rows are done."""

    def read(rows: slice, columns: slice) -> ComplexArray:
        if progress is not None:
            progress(min(rows.stop, source.y.size), source.y.size)
        return source.read(rows, columns)

    return read


def level_of(source: FinishedRun, level: int) -> tuple[ReadImage, FloatArray, FloatArray]:
    """Read a level of a run's pyramid like an image, with pixels of root power; also x and y, m."""

    def read(rows: slice, columns: slice) -> ComplexArray:
        power = stores.read_region(source.image, stores.level_name(level), (rows, columns))
        return np.sqrt(power).astype(np.complex64)

    n_y, n_x = stores.level_shapes((source.y.size, source.x.size))[level - 1]
    middle, side = (2**level - 1) / 2, 2**level
    (dx, dy), x, y = source.spacing, source.x[0], source.y[0]
    return read, x + dx * (middle + side * np.arange(n_x)), y + dy * (middle + side * np.arange(n_y))


def mean_of(reads: Sequence[ReadImage]) -> ReadImage:
    """Make a function that reads the root of the mean power of images on one grid; NaN unless covered by all."""

    def read(rows: slice, columns: slice) -> ComplexArray:
        power = sum(np.abs(each(rows, columns).astype(np.complex128)) ** 2 for each in reads)
        return np.sqrt(power / len(reads)).astype(np.complex64)

    return read


def level_for(source: FinishedRun, max_pixels: int) -> int:
    """Choose the coarsest level of a run's pyramid for a picture: with cells at most COARSER times those from pixels.

    0: the pixels themselves. A cell has as many pixels a side as leave at most `max_pixels` cells, and of a level a
    multiple of its own.
    """
    cell = cell_sides(source.x, source.y, max_pixels)
    sides = ((level, 2**level) for level in range(stores.levels_of(source.image), 0, -1))
    return next(
        (level for level, side in sides if all(-(-times // side) * side <= COARSER * times for times in cell)), 0
    )


def cell_sides(x: FloatArray, y: FloatArray, max_pixels: int, cell: tuple[int, int] = (1, 1)) -> tuple[int, int]:
    """Pixels along y and x of a cell, so that an image has at most `max_pixels` cells a side.

    Multiples of `cell`; where they are larger, cells are nearly square on the ground.

    Examples
    --------
    >>> cell_sides(np.arange(0.0, 8000.0, 2.0), np.arange(0.0, 8000.0, 10.0), 1000)
    (1, 4)
    """
    parts = [-(-axis.size // n) for axis, n in zip((y, x), cell, strict=True)]
    if max(parts) <= max_pixels:
        return cell
    steps = [n * abs(float(axis[-1] - axis[0])) / (axis.size - 1) if axis.size > 1 else 0.0
             for axis, n in zip((y, x), cell, strict=True)]  # fmt: skip
    side = max(n * step for n, step in zip(parts, steps, strict=True)) / max_pixels * (1 - 1e-9)
    tall, wide = (n * math.ceil(side / step) if step else n for n, step in zip(cell, steps, strict=True))
    return tall, wide


class Overview(NamedTuple):
    """An image reduced to cells.

    Attributes
    ----------
    power : (n_y, n_x) float
        |image|^2; NaN where not covered.
    block : (n_y, n_x) int, optional
        Highest block index of each cell; -1 where not covered.
    x_edges, y_edges : (n_x + 1,), (n_y + 1,) float
        Edges of the cells, m.
    """

    power: NDArray[np.floating[Any]]
    block: NDArray[np.int16] | None
    x_edges: FloatArray
    y_edges: FloatArray


def overview(
    read_image: ReadImage,
    image_x: FloatArray,
    image_y: FloatArray,
    *,
    read_block: ReadBlock | None = None,
    max_pixels: int = 1400,
    looks: Literal["max", "mean"] = "max",
    cell: tuple[int, int] = (1, 1),
    strip: int = 2**22,
) -> Overview:
    """Decimate |image|^2 to at most `max_pixels` a side, reading a bounded strip of samples at a time.

    Parameters
    ----------
    read_image : callable
        (slice of y, slice of x) -> complex pixels, NaN where not covered.
    image_x, image_y : (n_x,), (n_y,) float
        Pixel positions, m; uniform.
    read_block : callable, optional
        (slice of y, slice of x) -> block indices, -1 where not covered.
    max_pixels : int
        Cells along the longer side of the result, at most.
    looks : "max" or "mean"
        Power of a cell: that of its strongest pixel, which keeps every point target, or the mean, which has the least
        speckle.
    cell : (int, int)
        Pixels along y and along x of a cell, or of the parts of one where the result would have more cells.
    strip : int
        Pixels to read at once, at most; but always a whole row of cells.
    """
    tall, wide = cell_sides(image_x, image_y, max_pixels, cell)
    n_y, n_x = -(-image_y.size // tall), -(-image_x.size // wide)
    power = np.full((n_y, n_x), np.nan)
    block = np.full((n_y, n_x), -1, dtype=np.int16) if read_block is not None else None
    rows_at_once = max(1, strip // (tall * image_x.size))
    for first in range(0, n_y, rows_at_once):
        cells = slice(first, min(first + rows_at_once, n_y))
        rows = slice(cells.start * tall, min(cells.stop * tall, image_y.size))
        pixels = read_image(rows, slice(0, image_x.size))
        power[cells] = reduce_cells(pixels.real**2 + pixels.imag**2, (tall, wide), looks)
        if block is not None and read_block is not None:
            block[cells] = reduce_cells(read_block(rows, slice(0, image_x.size)), (tall, wide), "max")
    return Overview(power, block, cell_edges(image_x, n_x, wide), cell_edges(image_y, n_y, tall))


def reduce_cells(
    values: NDArray[np.float32] | NDArray[np.int16], cell: tuple[int, int], looks: Literal["max", "mean"]
) -> FloatArray:
    """Reduce to cells of pixels along y and x, fewer at the ends; NaN only where all pixels of a cell are NaN."""
    beyond = [(0, -n % side) for n, side in zip(values.shape, cell, strict=True)]
    padded = np.pad(values.astype(np.float32), beyond, constant_values=np.float32(np.nan))
    cells = padded.reshape(padded.shape[0] // cell[0], cell[0], padded.shape[1] // cell[1], cell[1])
    present = np.isfinite(cells)
    count = present.sum(axis=(1, 3))
    if looks == "max":
        reduced = np.where(present, cells, -np.inf).max(axis=(1, 3))
    else:
        reduced = np.where(present, cells, 0).sum(axis=(1, 3), dtype=np.float64) / np.maximum(count, 1)
    return np.where(count > 0, reduced, np.nan)


def cell_edges(axis: FloatArray, cells: int, factor: int) -> FloatArray:
    """Edges of `cells` cells, m; a single pixel is drawn 1 m wide."""
    step = float(axis[-1] - axis[0]) / (axis.size - 1) if axis.size > 1 else 1.0
    return np.asarray(axis[0] - step / 2 + step * factor * np.arange(cells + 1))


def stretch(power_db: FloatArray) -> tuple[float, float]:
    """Choose the darkest and brightest dB of a grey scale, for clutter and isolated targets.

    The top is the 99.9th percentile, but at least 12 dB above the median, so that even clutter is mid-grey, and
    at most CLIPPED dB below the strongest cell: less by as much as the median would then be below the bottom of the
    widest scale. So clutter stays visible beside strong targets, and isolated targets, about which there are only side
    lobes, are drawn with the shape of their main lobe. The bottom is the 2nd percentile, but at least NARROWEST and at
    most WIDEST dB below the top.

    Examples
    --------
    >>> stretch(np.array([-80.0] * 999 + [0.0]))[1], stretch(np.array([-30.0] * 9999 + [10.0]))[1]
    (0.0, -10.0)
    """
    finite = power_db[np.isfinite(power_db)]
    if finite.size == 0:
        return -60.0, 0.0
    low, median, high = (float(v) for v in np.percentile(finite, [2, 50, 99.9]))
    strongest = float(finite.max())
    high = max(high, median + 12, strongest - float(np.clip(median - (strongest - WIDEST), 0.0, CLIPPED)))
    return float(np.clip(low, high - WIDEST, high - NARROWEST)), high


def range_notes(power_db: FloatArray, limits: tuple[float, float]) -> list[str]:
    """Warn that a range in dB hides almost all of a picture; empty if it does not, or no cell has power."""
    finite = power_db[np.isfinite(power_db)]
    if not finite.size or ((finite > limits[0]) & (finite < limits[1])).mean() >= LEAST_SHOWN:
        return []
    side = (
        "below" if (finite <= limits[0]).mean() > 0.5 else "above" if (finite >= limits[1]).mean() > 0.5 else "outside"
    )
    low, high = stretch(power_db)
    return [
        f"note: the image lies {side} the range of {limits[0]:.1f} to {limits[1]:.1f} dB; --range={low:.0f}:{high:.0f} "
        "would suit it"
    ]
