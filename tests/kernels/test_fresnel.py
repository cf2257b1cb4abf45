"""The integral of the Fresnel integrals."""

from __future__ import annotations

import numpy as np
import pytest

from blocksar.kernels.fresnel import FAR, fresnel_integral


@pytest.mark.parametrize("end", [0.5, 2.0, FAR - 1e-6, FAR + 1e-6, 12.0, 40.0])
def test_the_fresnel_integral_is_that_of_its_slope(end: float) -> None:
    """Its second derivative is exp(1j pi z^2 / 2), here integrated twice by Gauss-Legendre quadrature in short pieces.

    From zero, the double integral is that of (end - z) exp(1j pi z^2 / 2).
    """
    nodes, weights = np.polynomial.legendre.leggauss(40)
    edges = np.linspace(0.0, end, 4 + int(4 * end**2))
    half = np.diff(edges)[:, None] / 2
    z = (edges[:-1, None] + edges[1:, None]) / 2 + half * nodes
    wanted = (half * weights * (end - z) * np.exp(0.5j * np.pi * z**2)).sum()
    for sign in (-1, 1):
        found = np.diff(fresnel_integral(np.array([0.0, sign * end])))[0]
        assert abs(found - wanted) < 1e-12
