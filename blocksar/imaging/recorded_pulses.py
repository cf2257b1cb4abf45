"""Divisors of pixels whose pulses a raw echo recorded only in part.

The peak of a target is too low by the mean of `RecordedRanges.share` over the pixel's dwell, under the weights of the
image's sum. Ranges change little over a dwell compared with the length of a pulse, over which the share falls: the mean
is taken at a few times.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.collection.axis_beam import Height
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import UNIFORM, Taper, Weighting
from blocksar.kernels.groups import run_groups
from blocksar.kernels.phase import Float32Array

Tile = tuple[slice, slice]

# Smallest recorded share of a pulse that pixels are divided by: there clutter and noise rise by 10 dB under equal
# weights, and responses are 10 times as broad. Ground below it is NaN: it would show the side lobes of its neighbours.
LEAST_SHARE = 0.1
TIMES = 5  # of a dwell, both ends among them
ROUNDING = 1e-9  # of a share
MOST = 4096  # pixels together


class RecordedMeans(NamedTuple):
    """Mean recorded shares of points (...) over their dwells: under W, and under W^2; NaN if not imaged."""

    amplitude: FloatArray
    power: FloatArray


def recorded_means(
    geometry: Geometry, x: FloatArray, y: FloatArray, z: Height | None = None, *, weighting: Weighting = UNIFORM
) -> RecordedMeans:
    """Compute the means at points x, y (...), m, on the ground, or at heights z, m, of a compressed raw echo.

    NaN where the first is below LEAST_SHARE, or below 1 where only ground with whole pulses is imaged.
    """
    recorded, z = geometry.collection.recorded, geometry.height(x, y) if z is None else z
    assert recorded is not None
    with np.errstate(invalid="ignore", divide="ignore"):  # of points that are not lit
        time = _times(geometry, x, y, z)
        distance, weight = distances_at(geometry, x, y, z, time), _weights(geometry, x, y, z, time, weighting.azimuth)
        amplitude, power = (
            (weight * recorded.share(distance, weighting.range, power)).sum(axis=0) / weight.sum(axis=0)
            for power in (1, 2)
        )
    imaged = amplitude >= (LEAST_SHARE if recorded.partial else 1 - ROUNDING)
    return RecordedMeans(np.where(imaged, amplitude, np.nan), np.where(imaged, power, np.nan))


def divide_by_recorded(
    image: ComplexArray | Float32Array,
    geometry: Geometry,
    x: FloatArray,
    y: FloatArray,
    z: FloatArray | None = None,
    *,
    weighting: Weighting,
    threads: int = 1,
    divisor: Callable[[RecordedMeans], FloatArray] = attrgetter("amplitude"),
) -> None:
    """Divide pixels in place by the mean share of their pulses; NaN as for `recorded_means`.

    Parameters
    ----------
    image : (n_row, n_column) complex64 or float32
    geometry : Geometry
    x, y, z : float, optional z
        m, broadcast to the shape of the image; NaN heights where unknown.
    divisor : callable
        What of the means is divided by.
    """
    if geometry.collection.recorded is None:
        return
    points = [np.broadcast_to(axis, image.shape) for axis in (x, y, geometry.height(x, y) if z is None else z)]

    def divide(tile: Tile) -> None:
        share = divisor(recorded_means(geometry, *(axis[tile] for axis in points), weighting=weighting))
        with np.errstate(invalid="ignore"):
            image[tile] /= share.astype(np.float32)

    whole = slice(0, image.shape[0]), slice(0, image.shape[1])
    run_groups(divide, list(_doubtful(image, geometry, points, whole)), threads)


def _doubtful(
    image: ComplexArray | Float32Array, geometry: Geometry, points: Sequence[FloatArray], tile: Tile
) -> Iterator[Tile]:
    """Divide a tile down to small tiles of covered pixels, some of whose pulses may be incomplete."""
    shape = image[tile].shape
    if not np.isfinite(image[tile]).any() or _all_whole(geometry, [axis[tile] for axis in points]):
        return
    if shape[0] * shape[1] <= MOST:
        yield tile
        return
    longer = int(shape[1] > shape[0])
    ends = tile[longer].start, tile[longer].start + shape[longer] // 2, tile[longer].stop
    for first, last in pairwise(ends):
        part = slice(first, last)
        yield from _doubtful(image, geometry, points, (tile[0], part) if longer else (part, tile[1]))


def _all_whole(geometry: Geometry, points: Sequence[FloatArray]) -> bool:
    """Tell whether all points of a tile certainly have whole pulses, by a bound on their ranges."""
    recorded = geometry.collection.recorded
    assert recorded is not None
    ends = [np.array([np.nanmin(axis), np.nanmax(axis)]) for axis in points]
    away = float(np.linalg.norm([np.ptp(end) for end in ends])) / 2
    x, y, z = np.meshgrid(*ends)
    with np.errstate(invalid="ignore"):
        first, last = geometry.beam.dwell(x, y, z=z)
    if not (np.isfinite(first).all() and np.isfinite(last).all()):
        return False
    time = np.linspace(first.min(), last.max(), TIMES)
    x, y, z = (end.mean() for end in ends)
    distance = distances_at(geometry, x, y, z, time)
    away += float(np.abs(np.diff(distance)).max())  # between two times
    nearest, farthest = recorded.whole
    return bool(distance.min() - away >= nearest and distance.max() + away <= farthest)


def _times(geometry: Geometry, x: FloatArray, y: FloatArray, z: Height) -> FloatArray:
    """Select TIMES times over the dwells of points (...), s: (TIMES, ...)."""
    time = geometry.collection.time
    first, last = (
        np.broadcast_to(np.clip(end, time[0], time[-1]), np.shape(x)) for end in geometry.beam.dwell(x, y, z=z)
    )
    return np.asarray(np.linspace(first, last, TIMES))


def distances_at(geometry: Geometry, x: FloatArray, y: FloatArray, z: Height, time: FloatArray) -> FloatArray:
    """Ranges of points (...) at times (TIMES, ...), m."""
    ways = []
    for track in geometry.tracks:
        px, py, pz = np.moveaxis(track.position(time), -1, 0)
        ways.append(np.sqrt((x - px) ** 2 + (y - py) ** 2 + (z - pz) ** 2))
    return np.asarray(ways[0] if len(ways) == 1 else (ways[0] + ways[1]) / 2)


def _weights(geometry: Geometry, x: FloatArray, y: FloatArray, z: Height, time: FloatArray, taper: Taper) -> FloatArray:
    """Weights of times (TIMES, ...) in the image sum of points (...): trapezoidal rule, times w g."""
    collection = geometry.collection
    weight = np.ones(time.shape)
    weight[[0, -1]] = 0.5
    if taper.uniform and not collection.has_pattern:
        return weight
    place = np.rint(collection.pulse_place(time))
    pulse = np.clip(np.nan_to_num(place), 0, collection.n_pulse - 1).astype(np.int64)
    return weight * geometry.beam.weights(x, y, pulse, taper, z) * geometry.beam.gain(x, y, pulse, z)
