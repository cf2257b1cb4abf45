"""Whether a staring beam stays on the ground of a plan, as in a spotlight, which chains do not focus.

A dwell gate follows the ends of dwells as smooth functions of range and Doppler. Near the point on which a beam turns,
ground passes it ever more slowly, and on the far side the other way: no such function exists.
"""

from __future__ import annotations

import math

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.collection.beam import aperture, dwell_at
from blocksar.collection.geometry import Geometry
from blocksar.collection.region import Extent, Region

MOST_DWELL = 2.5  # durations of the collection for which a gate can hold ground in the beam, if it went on
LEAST_LIT = 0.5  # of the pulses that light ground, on average, where it stays
INTERVALS = 4  # of the splines that a beam which wobbles is taken to follow: where it goes on is seen at its ends
PLACES = 17, 65  # ranges and yaws at which dwells are looked at


def beam_stays(geometry: Geometry, region: Region, extent: Extent) -> bool:
    """Whether a beam about its axis stays on ground of an extent for too long for a gate, and lights the most of it."""
    collection = geometry.collection
    if not collection.has_axis:
        return False
    if collection.steady is not collection:
        geometry = geometry.lit_by(collection.steadied(INTERVALS))
    yaw = np.linspace(extent.low, extent.high, PLACES[1])
    near, far = region.at(yaw)
    near, far = np.maximum(near, extent.near), np.minimum(far, extent.far)
    ranges = near + (far - near) * np.linspace(0, 1, PLACES[0])[:, None]
    start, stop = aperture(geometry.collection)
    if longest_stay(geometry, ranges[:, far > near], yaw[far > near]) <= MOST_DWELL * (stop - start):
        return False
    first, last = dwell_at(geometry, yaw, ranges)
    lit = (last > first) & (far > near)
    return float((last - first)[lit].mean()) >= LEAST_LIT * (stop - start)


def longest_stay(geometry: Geometry, epoch_range: FloatArray, yaw: FloatArray) -> float:
    """The longest time for which a beam about its axis would stay on lit ground, if it went on, s; 0 if none is lit.

    Infinite where ground that is lit all the time turns back in the beam. Ranges (m) and yaws (rad) are broadcast.
    """
    first, last = dwell_at(geometry, yaw, epoch_range)
    begin, end = dwell_at(geometry, yaw, epoch_range, uncut=True)
    start, stop = aperture(geometry.collection)
    lit, whole = last > first, (begin <= start) & (end >= stop)
    length = np.where(lit, end - begin, 0.0)
    turning = lit & whole & (length <= (stop - start) * (1 + 1e-9))  # offsets turn back: dwells are not continued
    return math.inf if turning.any() else float(length.max(initial=0.0))
