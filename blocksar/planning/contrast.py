"""Dark places beside bright ones: what a pattern in elevation makes of the ends of dwells on a terrain.

Places that have the same range but other heights lie at other elevations, so that a pattern in elevation may be near a
zero at one of them and large at another. Both are brought to the same level, and with the dark one what others leave
there. By the ends of their dwells these leave an error all over the band that is lit at a time: the mean of g^2 over
places of equal range within a beam's width, relative to g^2 of a pixel, is the contrast C by which it loses more there
than on the plane, where places of equal range have one elevation. The far side lobes of the others come up as well, in
back-projection too: a share s of their energy. In a chip the loss is thus mean(C) / mean(1 + s C) times what ends lose
at C = 1.
"""

from __future__ import annotations

import math

import numpy as np

from blocksar.arrays import FloatArray, IntArray
from blocksar.collection.beam import lit_passes, wrapped
from blocksar.collection.collection import Collection
from blocksar.collection.weighting import Taper
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.focusing.pattern_sums import mean_elevations
from blocksar.planning.relief import Samples, bins_of
from blocksar.planning.sector import Sector

MOST_PLACES = 1 << 16  # of a block's terrain that are looked at
FEWEST_PLACES = 32  # of equal range
CHIP = 20.0  # range cells along the sides of chips
MOST_CHIPS = 256  # along each side of a block
BEAM_PLACES = 65  # of the mean weight over a beam


def dark_contrast(sector: Sector, epoch_range: FloatArray, yaw: FloatArray) -> FloatArray | None:
    """The factor by which ends of dwells lose more in the worst chip about each target (n_range, n_yaw); 1 or more.

    None on the plane and without a pattern in elevation.

    Parameters
    ----------
    sector : Sector
    epoch_range, yaw : (n_range,), (n_yaw,) float
        Ascending, m and rad.
    """
    collection = sector.geometry.collection
    if sector.relief is None or collection.elevation_pattern is None:
        return None
    u, v, power = _look_at_terrain(sector, sector.relief.samples)
    cell = SPEED_OF_LIGHT / (2 * collection.bandwidth)
    # Places of equal range: a few cells of it where there are not many places.
    n_equal = int(np.clip((sector.far - sector.near) / cell, 1, max(power.size // FEWEST_PLACES, 1)))
    equal, side = bins_of(u, n_equal), CHIP * cell
    contrast, own = _means(power, equal, n_equal)[equal] / power, np.abs(v) <= 1
    u, v, contrast = u[own], v[own], contrast[own]
    n_row = _number((sector.far - sector.near) / side)
    n_column = _number((sector.near + sector.far) / 2 * (sector.high - sector.low) / side)
    row, column = bins_of(u, n_row), bins_of(v, n_column)
    chip = row * n_column + column
    mean = _means(contrast, chip, n_row * n_column)
    worse = mean / (1 + _far_share(collection, sector.taper) * mean)
    places = 2 * (np.arange(n_row) + 0.5) / n_row - 1, 2 * (np.arange(n_column) + 0.5) / n_column - 1
    nearest = [_nearest(axis, at) for axis, at in zip((epoch_range, yaw), places, strict=True)]
    factor = np.ones((epoch_range.size, yaw.size))
    np.maximum.at(factor, tuple(np.meshgrid(*nearest, indexing="ij")), worse.reshape(n_row, n_column))
    return factor


def _look_at_terrain(sector: Sector, samples: Samples) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Of places of a terrain (n,): where they lie in range and yaw, -1 .. 1 in the block, and the pattern's square.

    They have the block's ranges, and lie in it or within a beam's width on either side; those that an image shows.
    """
    geometry, half = sector.geometry, (sector.high - sector.low) / 2
    turn = wrapped(samples.yaw - (sector.low + sector.high) / 2)
    u = (2 * samples.epoch_range - sector.near - sector.far) / (sector.far - sector.near)
    some = np.flatnonzero((np.abs(u) <= 1) & (np.abs(turn) <= half + (geometry.collection.beam_width or 0.0)))
    some = some[:: max(math.ceil(some.size / MOST_PLACES), 1)]
    z = samples.z[some]
    x, y = geometry.over(None, lambda *_: z).ground_axes(samples.epoch_range[some], samples.yaw[some])
    known = np.isfinite(x)
    x, y, z, u, turn = (each[known] for each in (x, y, z, u[some], turn[some]))
    passes = lit_passes(geometry, x[None], y[None], z[None])
    means = mean_elevations(geometry, x[None], y[None], z[None] - geometry.collection.ground_height, passes=passes)
    shown = ~means.dark(geometry)[0]
    return u[shown], turn[shown] / half, means.plain[0, shown] ** 2


def _far_share(collection: Collection, taper: Taper) -> float:
    """The share of a target's energy that lies in side lobes farther than a chip, by the weights at the dwell's ends.

    With equal weights the side lobes have the mean power 1 / (2 (pi u)^2) at u resolution cells, on either side.
    """
    v = np.linspace(-1, 1, BEAM_PLACES)
    weights = taper(v)
    if collection.beam_offset is not None and collection.beam_pattern is not None:
        half = (collection.beam_width or 0.0) / 2
        weights = weights * np.interp(v * half, collection.beam_offset, collection.beam_pattern)
    ends = float(np.mean(weights[[0, -1]] ** 2))
    return ends / float(np.mean(weights**2)) / (np.pi**2 * CHIP)


def _number(chips: float) -> int:
    return int(np.clip(round(chips), 1, MOST_CHIPS))


def _means(values: FloatArray, which: IntArray, n: int) -> FloatArray:
    """Means (n,) of values by number; 0 where there are none."""
    return np.asarray(np.bincount(which, values, n) / np.maximum(np.bincount(which, minlength=n), 1))


def _nearest(axis: FloatArray, places: FloatArray) -> IntArray:
    """The nodes of an axis that are nearest to places from -1 to 1 between its ends."""
    at = (2 * axis - axis[0] - axis[-1]) / (axis[-1] - axis[0])
    return np.searchsorted((at[1:] + at[:-1]) / 2, places)
