"""Least squares, series and orthogonal bases against numpy's; what leads to plans and images uses nothing else."""

from __future__ import annotations

import ast
from pathlib import Path

import numpy as np
import pytest

import blocksar
from blocksar import solvers

PACKAGE = Path(blocksar.__file__).parent
TO_IMAGES = (
    "collection",
    "imaging",
    "kernels",
    "planning",
    "processors",
)  # what leads from axes and samples to plans and images
# Not reproducible to the bit: they call BLAS or LAPACK. A norm along an axis is a plain sum.
LIBRARY = {
    "chebfit",
    "polyfit",
    "legfit",
    "leggauss",
    "dot",
    "vdot",
    "inner",
    "matmul",
    "tensordot",
    "lstsq",
    "inv",
    "qr",
    "solve",
}


@pytest.mark.parametrize("shape", [(50,), (7, 50), (2, 3, 50)])
def test_least_squares_minimises_the_residual(shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(1)
    terms, values = rng.standard_normal((4, 50)), rng.standard_normal(shape)
    wanted = np.linalg.lstsq(terms.T, values.reshape(-1, 50).T, rcond=None)[0].reshape(4, *shape[:-1])
    np.testing.assert_allclose(solvers.least_squares(terms, values), wanted, atol=1e-12)


def test_least_squares_of_an_ill_conditioned_system() -> None:
    """The normal equations of interpolation taps, with a condition number of 1e9: the residual is at rounding."""
    lag = np.arange(16)[:, None] - np.arange(16)
    gram = np.sinc(0.5 * lag) + 1e-9 * np.eye(16)
    x = solvers.least_squares(gram, np.sinc(0.5 * (np.arange(16) - 7.5)))
    assert np.abs(gram @ x - np.sinc(0.5 * (np.arange(16) - 7.5))).max() < 1e-13


def test_damping_decides_between_dependent_terms() -> None:
    terms = np.ones((2, 10))
    np.testing.assert_allclose(solvers.least_squares(terms, np.full(10, 4.0), damping=1e-12), [2.0, 2.0], rtol=1e-6)


def test_product_is_the_matrix_product() -> None:
    rng = np.random.default_rng(3)
    a, b = rng.standard_normal((5, 2, 4)), rng.standard_normal((4, 3))
    np.testing.assert_allclose(solvers.product(a, b), a @ b, atol=1e-14)


def test_chebyshev_series_is_that_of_numpy() -> None:
    rng = np.random.default_rng(4)
    u, values = np.linspace(-1, 1, 40), rng.standard_normal((40, 3))
    wanted = np.polynomial.chebyshev.chebfit(u, values, 9)
    np.testing.assert_allclose(solvers.chebyshev_series(u, values, 9), wanted, atol=1e-12)


@pytest.mark.parametrize("degree", [3, 8, 11])
def test_a_series_at_nodes_is_that_of_weighted_least_squares(degree: int) -> None:
    u, values = solvers.end_nodes(12), np.random.default_rng(6).standard_normal((12, 3, 2))
    assert u[0] == -1 and u[-1] == 1
    weights = np.r_[0.5, np.ones(10), 0.5]
    wanted = np.polynomial.chebyshev.chebfit(u, values.reshape(12, 6), degree, w=np.sqrt(weights))
    np.testing.assert_allclose(solvers.node_series(values, degree).reshape(-1, 6), wanted, atol=1e-12)


def test_an_orthogonal_basis_spans_the_terms() -> None:
    terms = np.polynomial.chebyshev.chebvander(np.linspace(-1, 1, 300), 40).T
    q, r = solvers.orthogonal_basis(terms)
    np.testing.assert_allclose(q @ q.T, np.eye(41), atol=1e-14)
    np.testing.assert_allclose(r.T @ q, terms, atol=1e-12)
    assert np.all(r == np.triu(r))
    right = np.random.default_rng(5).standard_normal((41, 3))
    np.testing.assert_allclose(solvers.back_substitute(r, right), np.linalg.solve(r, right), rtol=1e-9)


@pytest.mark.parametrize("n", [2, 16, 17, 200])
def test_quadrature_is_that_of_numpy(n: int) -> None:
    wanted = np.polynomial.legendre.leggauss(n)
    for found, values in zip(solvers.gauss_legendre(n), wanted, strict=True):
        np.testing.assert_allclose(found, values, atol=1e-14)


def test_power_coefficients_through_nodes() -> None:
    rng = np.random.default_rng(2)
    wanted = rng.standard_normal((10, 3))
    nodes = np.polynomial.chebyshev.chebpts1(10)
    found = solvers.through_nodes(np.polynomial.polynomial.polyval(nodes, wanted).T)
    np.testing.assert_allclose(found, wanted, atol=1e-11)


@pytest.mark.slow
def test_nothing_that_leads_to_an_image_calls_blas_or_lapack() -> None:
    wrong = []
    for path in sorted(path for room in TO_IMAGES for path in (PACKAGE / room).rglob("*.py")):
        # For products only; and `--interference eigen`, which says that it does not repeat to the bit.
        if path.name in {"georeference.py", "interference.py"}:
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.BinOp) and isinstance(node.op, ast.MatMult):
                wrong.append(f"{path.relative_to(PACKAGE)}:{node.lineno}: @")
            if isinstance(node, ast.Attribute) and node.attr in LIBRARY:
                wrong.append(f"{path.relative_to(PACKAGE)}:{node.lineno}: {node.attr}")
    assert wrong == []
