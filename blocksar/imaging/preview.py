"""Previews: coarse pictures from short apertures and a part of the band, exact in geometry, without aliasing.

The resolution is chosen a little coarser than the pixels, so that no bright point falls between them. A part of the
band of c / (2 d) gives cells of d along the line of sight with the full range window, since the steps between range
frequencies stay as they are. Neighbouring pulses over which the line of sight turns by lambda / (2 d) give cells of d
across it. Each such aperture is back-projected exactly to the pixels that it lights, and the power of all apertures is
averaged: every pixel gets several looks out of its own dwell.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from blocksar.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid, ground_resolution
from blocksar.collection.weighting import Taper, Weighting
from blocksar.imaging.backprojection import accumulate
from blocksar.imaging.profiles import range_profiles
from blocksar.imaging.recorded_pulses import divide_by_recorded
from blocksar.kernels.groups import run_groups
from blocksar.kernels.phase import Float32Array
from blocksar.kernels.projection import LitPixels

ReadPart = Callable[[slice, slice], ComplexArray]  # samples of some pulses and range frequencies
COARSER = 1.3  # resolution over pixel: with less, points fall between pixels
LOOKS = 8  # out of each dwell, at most
MOST_UPDATES = 1.2e9  # pixels times pulses, for all looks; at least one look is formed
LEAST_COLUMNS, LEAST_PULSES = 4, 2
TAPER = Taper("taylor", (4, -35.0))  # over the band and over each aperture
BROADER = 1.19  # width of its response over that of the whole band


@dataclass(frozen=True, eq=False)
class Preview:
    """Plan of a preview: its samples and grid.

    Attributes
    ----------
    geometry : Geometry
        Of the part of the band.
    columns : slice
        Range frequencies, in the middle of the band.
    apertures : list of slice
        Pulses of each short aperture.
    grid : Grid
        Coarse.
    resolution : (float, float)
        m on the ground at the middle of the grid, across and along lines of equal range.
    """

    geometry: Geometry
    columns: slice
    apertures: list[slice]
    grid: Grid
    resolution: tuple[float, float]


def plan_preview(geometry: Geometry, grid: Grid, *, size: int) -> Preview:
    """Choose pixels, apertures and a part of the band.

    Parameters
    ----------
    geometry : Geometry
        Of the whole collection.
    grid : Grid
        Ground to show; no pixel becomes smaller than its own.
    size : int
        Pixels along the longer side, at most.
    """
    collection = geometry.collection
    step = max(grid.dx, grid.dy, max(grid.x1 - grid.x0, grid.y1 - grid.y0) / size)
    coarse = replace(grid, dx=step, dy=step)
    width, dwell = _at_the_middle(geometry, coarse)
    wanted = COARSER * step
    columns = _middle(collection.n_range_frequency, width[0] * BROADER / wanted, LEAST_COLUMNS)
    share = min(width[1] * BROADER / wanted, 1.0)  # of the dwell that an aperture takes
    n = min(max(math.ceil(share * dwell), LEAST_PULSES), collection.n_pulse)
    updates = coarse.shape[0] * coarse.shape[1] * n
    looks = int(np.clip(min(LOOKS, MOST_UPDATES / updates, dwell / n), 1, LOOKS))
    spaced = max((dwell - n) // looks, n) if collection.steered else max((collection.n_pulse - n) // looks, n)
    count = max(-(-(collection.n_pulse - n) // spaced), 0) + 1
    first = np.unique(np.linspace(0, collection.n_pulse - n, count).round().astype(int))
    part = columns.stop - columns.start
    return Preview(
        geometry=Geometry(collection=_band_of(collection, columns)),
        columns=columns,
        apertures=[slice(int(start), int(start) + n) for start in first],
        grid=coarse,
        resolution=(width[0] * BROADER * collection.n_range_frequency / part, width[1] * BROADER * max(dwell / n, 1.0)),
    )


def _at_the_middle(geometry: Geometry, grid: Grid) -> tuple[tuple[float, float], int]:
    """Widths of a response, and pulses of the dwell, of a lit point near the middle of the grid."""
    x, y = (axis.ravel() for axis in np.meshgrid(*(np.linspace(0.05, 0.95, 19) for _ in range(2))))
    x, y = grid.x0 + (grid.x1 - grid.x0) * x, grid.y0 + (grid.y1 - grid.y0) * y
    first, last = geometry.beam.longest_pass(x, y)
    dwell = last - first
    off = np.hypot(x - (grid.x0 + grid.x1) / 2, y - (grid.y0 + grid.y1) / 2)
    chosen = int(np.argmin(np.where(2 * dwell >= dwell.max(), off, np.inf)))
    rng, yaw = geometry.epoch_range(x, y)[chosen], geometry.yaw(x, y)[chosen]
    return ground_resolution(geometry, float(rng), float(yaw)), max(int(dwell[chosen]), 1)


def _middle(n: int, share: float, least: int) -> slice:
    """Select the middle of n columns, a `share` of them but at least `least`; all if `share` is 1 or more."""
    width = min(max(math.ceil(share * n), least), n)
    first = (n - width) // 2
    return slice(first, first + width)


def _band_of(collection: Collection, columns: slice) -> Collection:
    return replace(collection, range_frequency=collection.range_frequency[columns])


def form_preview(
    read: ReadPart, preview: Preview, *, threads: int, progress: Callable[[int, int], None] | None = None
) -> Float32Array:
    """Form the picture.

    Parameters
    ----------
    read : callable
        Samples (n, n_column) complex64 of a slice of pulses and a slice of range frequencies.
    progress : callable, optional
        Called with the numbers of finished and of all apertures.

    Returns
    -------
    (n_y, n_x) float32
        Mean power over that of unit reflectivity; NaN where no aperture lights the pixel within the range window.
        Antenna patterns are not taken out.
    """
    geometry, grid = preview.geometry, preview.grid
    x, y = (np.ascontiguousarray(axis) for axis in np.meshgrid(grid.x, grid.y))
    z, _ = geometry.known_height(x, y)
    lit = _lit(geometry, x, y, threads)
    power, weight = np.zeros(x.shape, np.float32), np.zeros(x.shape, np.float32)
    for done, pulses in enumerate(preview.apertures, 1):
        pixels = LitPixels(x, y, z, np.maximum(lit[0], pulses.start), np.minimum(lit[1], pulses.stop))
        if (box := _box(pixels.first < pixels.last)) is not None:
            _add_look(power[box], weight[box], read, preview, pulses, pixels.of(box), threads)
        if progress is not None:
            progress(done, len(preview.apertures))
    power = np.where(weight > 0, power / np.maximum(weight, 1), np.nan).astype(np.float32)
    divide_by_recorded(
        power, geometry, x, y, weighting=Weighting(range=TAPER), threads=threads,
        divisor=lambda means: means.amplitude**2,
    )  # fmt: skip
    return power


def _lit(geometry: Geometry, x: FloatArray, y: FloatArray, threads: int) -> tuple[IntArray, IntArray]:
    first, last = np.empty(x.shape, np.int64), np.empty(x.shape, np.int64)

    def work(rows: slice) -> None:
        first[rows], last[rows] = geometry.beam.longest_pass(x[rows], y[rows])

    run_groups(work, [slice(row, row + 16) for row in range(0, x.shape[0], 16)], threads)
    return first, last


def _box(inside: BoolArray) -> tuple[slice, slice] | None:
    """Rows and columns of the bounding box of a mask; None if it is empty."""
    rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    if rows.size == 0:
        return None
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


def _add_look(
    power: Float32Array,
    weight: Float32Array,
    read: ReadPart,
    preview: Preview,
    pulses: slice,
    pixels: LitPixels,
    threads: int,
) -> None:
    """Add one aperture's power times its weights of valid pulses to `power`, and the weights to `weight`, in place."""
    geometry = preview.geometry
    never = pixels.first >= pixels.last
    first, last = (np.where(never, 0, ends) for ends in (pixels.first, pixels.last))
    signal = read(pulses, preview.columns)
    profiles = range_profiles(signal, collection=geometry.collection, pulses=pulses, threads=threads, taper=TAPER)
    weights = TAPER.samples(pulses.stop - pulses.start)
    weights /= weights.mean()
    np.multiply(profiles.values, weights.astype(np.float32)[:, None], out=profiles.values)
    image, outside = np.zeros(never.shape, np.complex64), np.zeros(never.shape, np.bool_)
    lit = pixels._replace(first=first, last=last)
    accumulate(image, outside, profiles, geometry=geometry, pixels=lit, threads=threads)
    valid = np.concatenate(([0.0], np.cumsum(profiles.valid * weights))) / geometry.collection.n_range_frequency
    at = [np.clip(ends - pulses.start, 0, valid.size - 1) for ends in (first, last)]
    count = np.where(never | outside, 0.0, valid[at[1]] - valid[at[0]])
    seen = count > 0
    power[seen] += (np.abs(image[seen]) ** 2 / count[seen]).astype(np.float32)
    weight[seen] += count[seen].astype(np.float32)
