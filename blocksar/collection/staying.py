"""Beams that stay on their ground, as of a staring or sliding spotlight.

Gates of chains follow the ends of dwells as smooth functions of range and Doppler. Near the point on which a beam
turns that stays on its ground, ground passes it ever more slowly, and on the far side the other way: no such function
exists.
"""

from __future__ import annotations

import math

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.collection.beam import aperture
from blocksar.collection.geometry import Geometry
from blocksar.collection.region import Extent, Region

PLACES = 33  # along either side of ground, at which dwells are looked at
MOST_DWELL = 2.5  # durations of the collection for which a gate can hold ground in the beam, if it went on
LEAST_LIT = 0.5  # of the pulses that light ground, on average, where it stays


def beam_stays(geometry: Geometry, region: Region, extent: Extent) -> bool:
    """Tell whether a beam about its axis lights most of an extent and stays there too long for a gate."""
    collection = geometry.collection
    if not collection.has_axis:
        return False
    if (steady := collection.steady) is not collection:  # follow a jittering beam beyond the collection by a smooth one
        geometry = geometry.lit_by(steady)
    yaw = np.linspace(extent.low, extent.high, PLACES)
    near, far = region.at(yaw)
    near, far = np.maximum(near, extent.near), np.minimum(far, extent.far)
    ranges = near + (far - near) * np.linspace(0, 1, PLACES)[:, None]
    start, stop = aperture(geometry.collection)
    if longest_stay(geometry, ranges[:, far > near], yaw[far > near]) <= MOST_DWELL * (stop - start):
        return False
    first, last = geometry.beam.dwell_at(yaw, ranges)
    lit = (last > first) & (far > near)
    return float((last - first)[lit].mean()) >= LEAST_LIT * (stop - start)


def longest_stay(geometry: Geometry, epoch_range: FloatArray, yaw: FloatArray) -> float:
    """Longest time, s, that a beam about its axis, continued, stays on lit ground; 0 if nothing is lit.

    Infinite where ground that is lit all the time turns back in the beam. Ranges (m) and yaws (rad) are broadcast.
    """
    first, last = geometry.beam.dwell_at(yaw, epoch_range)
    begin, end = geometry.beam.dwell_at(yaw, epoch_range, uncut=True)
    start, stop = aperture(geometry.collection)
    lit, whole = last > first, (begin <= start) & (end >= stop)
    length = np.where(lit, end - begin, 0.0)
    turning = lit & whole & (length <= (stop - start) * (1 + 1e-9))  # offsets turn back: dwells are not continued
    return math.inf if turning.any() else float(length.max(initial=0.0))
