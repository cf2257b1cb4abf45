"""Polynomials of the metadata: over the image, and of the track over time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.polynomial import Chebyshev, Polynomial
from numpy.polynomial import polynomial as power

from blocksar.arrays import FloatArray
from blocksar.collection.geometry import Geometry
from blocksar.collection.georeference import Georeference

MAX_ORDER = 7  # total, in both variables


class Poly2D(NamedTuple):
    """A polynomial in two variables: coefficients (n, n) of u^i v^j, and the largest error of its fit."""

    coefficients: FloatArray
    error: float


def fit_poly2d(u: FloatArray, v: FloatArray, values: FloatArray, accuracy: float) -> Poly2D:
    """Fit values (n,) by least squares with the polynomial of lowest total order that meets `accuracy`.

    The order ends at MAX_ORDER, or where half as many coefficients as points are needed; `error` tells how well the
    last one fits.

    Parameters
    ----------
    u, v : (n,) float
        Variables: m from the scene centre point, along row and column.
    values : (n,) float
    accuracy : float
        Largest error to accept, in the unit of `values`.
    """
    scale_u, scale_v = max(float(np.abs(u).max()), 1e-9), max(float(np.abs(v).max()), 1e-9)
    for order in range(MAX_ORDER + 1):
        powers = [(i, j) for i in range(order + 1) for j in range(order + 1 - i)]
        basis = np.stack([(u / scale_u) ** i * (v / scale_v) ** j for i, j in powers], axis=1)
        scaled = np.linalg.lstsq(basis, values)[0]
        error = float(np.abs(basis @ scaled - values).max())
        if error <= accuracy or len(powers) * 2 > u.size:
            break
    coefficients = np.zeros((order + 1, order + 1))
    for (i, j), value in zip(powers, scaled, strict=True):
        coefficients[i, j] = value / scale_u**i / scale_v**j
    return Poly2D(coefficients, error)


def arp_polynomial(geometry: Geometry, frame: Georeference) -> tuple[FloatArray, float]:
    """The track as a polynomial in ECEF, and its largest distance from the recorded antenna positions.

    Returns
    -------
    ((order + 1, 3) float, float)
        Coefficients by powers of time since the first pulse, m / s^k; distance, m.
    """
    track, time = geometry.track, geometry.collection.time
    domain = [track.centre - track.half - time[0], track.centre + track.half - time[0]]
    scene = np.zeros_like(track.coefficients)
    for axis, column in enumerate(track.coefficients.T):
        powers = Chebyshev(column, domain=domain).convert(kind=Polynomial, domain=[-1, 1], window=[-1, 1])
        scene[: powers.coef.size, axis] = powers.coef
    ecef = scene @ frame.axes
    ecef[0] += frame.origin
    positions = power.polyval(time - time[0], ecef).T
    misfit = np.linalg.norm(positions - frame.to_ecef(geometry.collection.antenna_position), axis=1)
    return ecef, float(misfit.max())
