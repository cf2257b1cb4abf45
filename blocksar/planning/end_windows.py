"""Windows at the ends of whole dwells: how far a keystone spreads these over the band, and what targets lose by it.

A keystone scales time with range frequency, so that ends of dwells lie at +-`spread` at the edges of the band. Windows
rise there as the mean of steps over +-`blur` does. At range frequencies where a target is lit beyond its window it
loses, and where the window reaches beyond the target it gains nothing: for an end at d, |d| < b, the mean step S loses

    integral of 1 - S beyond d = (b - d)^2 / 4 b,    on average over the band (b^2 + mean of d^2) / 4 b,

of the weight at the end: b / 3 with equal weights over the band and b the spread. All targets lose that, and it changes
their side lobes, by a fifth under `hamming` and a band of 7 %. So windows are raised just inside the end, by a triangle
from 0 to 4 b. With the height h its area is 2 b h, of which half of the ends, those at d > 0, lack h d^2 / 4 b. What
remains is that the middle of the triangle lies 2 b inside the end, and its energy, h^2 4 b / 3, which is a tenth of
that by which the ends differ.
"""

from __future__ import annotations

import math

import numpy as np

from blocksar import solvers
from blocksar.arrays import FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.weighting import FLAT, Taper

BAND_NODES = 32  # of a mean over the band


def band_spread(collection: Collection, uncut: tuple[FloatArray, FloatArray], *, scaled_about: float | None) -> float:
    """Half of the time over which a keystone about a time spreads the ends of dwells, s; 0 without one.

    `uncut` are the ends, s from the epoch, as if the collection did not cut them.
    """
    if scaled_about is None:
        return 0.0
    return float(np.abs(np.array(uncut) - scaled_about).mean()) * collection.bandwidth / 2 / collection.carrier


def gate_blur(collection: Collection, spread: float) -> float:
    """Half of the time over which the ends of dwells are spread, s: over the band, and by the grid of pulses."""
    return math.hypot(spread, collection.pulse_interval / 2)


def end_lift(blur: float, spread: float, band: Taper = FLAT) -> float:
    """`DwellGate.lift`: the height h of the triangle, for ends at +-`spread`, s, over a band with a weighting."""
    if not spread:
        return 0.0
    nodes, weights = solvers.gauss_legendre(BAND_NODES)
    shares = weights * band(nodes)
    squared = spread**2 * float((shares * nodes**2).sum() / shares.sum())
    return (blur**2 + squared) / (4 * blur) / (2 * blur - squared / (8 * blur))


def at_ends(blur: float, lift: float, time: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """What raised windows change in sums over dwells whose pulses count `weight` (..., 2) at the ends, at `time`, s.

    Times (..., 4), s, and weights (..., 4), s, to be summed like the nodes of a quadrature.
    """
    inside, area = time + 2 * blur * np.array([1.0, -1.0]), 2 * blur * lift
    return np.concatenate([time, inside], axis=-1), area * np.concatenate([-weight, weight], axis=-1)


def lift_energy(blur: float, lift: float) -> float:
    """Energy by which raised windows differ from others at one end, s."""
    return 4 / 3 * blur * lift**2
