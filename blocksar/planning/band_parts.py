"""Parts of the band for which a dwell gate is made, and how a keystone scales time at each of them."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.polynomial import legendre

from blocksar import solvers
from blocksar.arrays import FloatArray


class Scaling(NamedTuple):
    """What a keystone does to times at a range frequency: t -> about + (t - about) factor."""

    about: float = 0.0  # s from the epoch
    factor: float = 1.0

    def __call__(self, time: FloatArray) -> FloatArray:
        return time if self.factor == 1 else self.about + (time - self.about) * self.factor


NO_SCALING = Scaling()


class GateParts(NamedTuple):
    """Places over the band, -1 .. 1, for which gates are made, and Lagrange's polynomials through them.

    Row k of `series` is the Legendre series of the polynomial that is 1 at node k.
    """

    nodes: FloatArray
    series: FloatArray

    def at(self, place: float) -> FloatArray:
        """The polynomials (n,) at a place."""
        return np.asarray(legendre.legval(place, self.series.T))


@lru_cache
def gate_parts(n: int) -> GateParts:
    """Of a gate of n parts, at Gauss-Legendre nodes."""
    nodes, weights = solvers.gauss_legendre(n)
    orders = np.arange(n)
    return GateParts(nodes, weights[:, None] * (orders + 0.5) * legendre.legvander(nodes, n - 1))
