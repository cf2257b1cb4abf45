"""Least-squares fits along rows: what is known of targets becomes a polynomial of Doppler for each range row."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev

from blocksar import solvers
from blocksar.arrays import BoolArray, FloatArray
from blocksar.focusing.lines import Focus, RowPolynomial
from blocksar.kernels.fourier import Axis


class RowFit(NamedTuple):
    """Where polynomials along rows lie: ranges, m, and the centre and scale of Doppler, Hz."""

    near: float
    far: float
    centre: float
    scale: float

    @classmethod
    def over(cls, rows: Axis, spots: Focus) -> RowFit:
        """Over the rows of an image, and the Doppler at which targets focus."""
        doppler = spots.doppler
        scale = max(float(np.ptp(doppler) / 2), 1e-6)
        centre = float((doppler.min() + doppler.max()) / 2)
        return cls(rows.start, rows.start + rows.extent, centre=centre, scale=scale)

    def polynomial(self, series: FloatArray) -> RowPolynomial:
        return RowPolynomial(series=series, near=self.near, far=self.far, centre=self.centre, scale=self.scale)

    def fit(self, spots: Focus, values: FloatArray, degrees: tuple[int, int]) -> list[FloatArray]:
        """Fit values (n, n_range, n_yaw), s, where targets focus: series in range of powers of z, one for each."""
        u = (2 * spots.range.ravel() - self.near - self.far) / (self.far - self.near)
        z = (spots.doppler.ravel() - self.centre) / self.scale
        basis = np.asarray(chebyshev.chebvander2d(u, z, degrees).T, np.float64)
        fitted = solvers.least_squares(basis, values.reshape(values.shape[0], -1), damping=1e-20 * u.size)
        shape = degrees[0] + 1, degrees[1] + 1
        return [solvers.product(row.reshape(shape), _to_powers(degrees[1])) for row in fitted.T]

    def fit_amid(self, rng: FloatArray, values: FloatArray, which: BoolArray, *, degree: int) -> FloatArray:
        """Fit a series in range amid those of values (n_range, n_yaw) at each range that are chosen by `which`."""
        whole = which.any(axis=1)
        rows = [(values[i, which[i]], rng[i, which[i]].mean()) for i in np.flatnonzero(whole)]
        u = np.array([(2 * mean - self.near - self.far) / (self.far - self.near) for _, mean in rows])
        middles = np.array([(row.min() + row.max()) / 2 for row, _ in rows])
        terms = chebyshev.chebvander(u, min(degree, (len(rows) - 1) // 2)).T
        return np.asarray(solvers.least_squares(terms, middles, damping=1e-20 * u.size))

    def integral(self, series: FloatArray) -> RowPolynomial:
        """The polynomial whose derivative has these coefficients (n, order + 1): cycles."""
        integral = np.zeros((series.shape[0], series.shape[1] + 1))
        integral[:, 1:] = series / np.arange(1, series.shape[1] + 1) * self.scale
        return self.polynomial(integral)

    def slope(self, series: FloatArray) -> RowPolynomial:
        """The linear coefficient, per Hz."""
        return self.polynomial(series[:, 1:2] / self.scale)


@lru_cache
def _to_powers(most: int) -> FloatArray:
    """Power coefficients of the Chebyshev polynomials of degrees 0 .. most, one a row; read-only."""
    powers = np.zeros((most + 1, most + 1))
    for degree, row in enumerate(np.eye(most + 1)):
        powers[degree, : degree + 1] = chebyshev.cheb2poly(row[: degree + 1])
    powers.flags.writeable = False
    return powers
