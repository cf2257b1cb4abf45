"""Linear solvers."""

from __future__ import annotations

import numpy as np

from blocksar.kernels import solvers


def test_least_squares_minimises_the_residual() -> None:
    rng = np.random.default_rng(1)
    terms, values = rng.standard_normal((4, 50)), rng.standard_normal(50)
    wanted = np.linalg.lstsq(terms.T, values, rcond=None)[0]
    np.testing.assert_allclose(solvers.least_squares(terms, values), wanted, atol=1e-12)


def test_power_coefficients_through_nodes() -> None:
    rng = np.random.default_rng(2)
    wanted = rng.standard_normal((10, 3))
    nodes = np.polynomial.chebyshev.chebpts1(10)
    found = solvers.through_nodes(np.polynomial.polynomial.polyval(nodes, wanted).T)
    np.testing.assert_allclose(found, wanted, atol=1e-11)
