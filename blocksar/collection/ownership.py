"""Which of several collections, or segments of one, an image's pixel comes from: the one that saw more of its dwell.

The share of a point's dwell that a collection saw is 1 + margin / dwell, with the margin by which the dwell lies inside
the collection's time, below 0 where an end of the collection cuts it. Where several saw all of it, the one with the
larger margin counts, so that a seam runs through the middle of what they share.
"""

from __future__ import annotations

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.collection.beam import aperture, dwell
from blocksar.collection.geometry import Geometry

NODES = 33  # places along each side of a part of an image at which margins are computed; linear in between


def dwell_margin(geometry: Geometry, x: FloatArray, y: FloatArray) -> FloatArray:
    """Margin by which the dwell of points x, y (...), m, lies inside the collection, over the dwell; see above.

    0 where the beam is not steered, or lights a point all the time; -inf where it never does.
    """
    start, end = aperture(geometry.collection)
    first, last = dwell(geometry, x, y, uncut=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        margin = np.minimum(first - start, end - last) / (last - first)
    margin = np.where((first <= start) & (last >= end), 0.0, margin)
    return np.where(last > first, margin, -np.inf)


def margins_over(geometry: Geometry, x: FloatArray, y: FloatArray) -> FloatArray:
    """Margins at NODES x NODES places of a part of an image with axes x and y, m: (NODES, NODES), rows along y."""
    places = np.linspace(x[0], x[-1], NODES), np.linspace(y[0], y[-1], NODES)
    return dwell_margin(geometry, *np.meshgrid(*places))


def expand(margins: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Margins at all pixels of that part, (n_y, n_x), linear between places; -inf around places that are never lit."""
    with np.errstate(invalid="ignore"):
        for axis, n in enumerate(shape):
            place = np.linspace(0, NODES - 1, n) if n > 1 else np.zeros(1)
            below = np.minimum(place.astype(np.int64), NODES - 2)
            part = (place - below)[:, None] if axis == 0 else place - below
            low, high = np.take(margins, below, axis), np.take(margins, below + 1, axis)
            margins = np.asarray(low * (1 - part) + high * part)
    return np.nan_to_num(margins, nan=-np.inf, posinf=np.inf, neginf=-np.inf)
