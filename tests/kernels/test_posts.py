"""Heights between posts: exact for polynomials, also beside unknown posts, which spread no further than one post."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.polynomial import polynomial
from scipy.interpolate import BarycentricInterpolator

from blocksar.arrays import FloatArray
from blocksar.kernels.posts import continued, heights_between

SHAPE = (14, 17)
ROWS, COLUMNS = np.indices(SHAPE).astype(float)


def places(n: int = 400) -> tuple[FloatArray, FloatArray]:
    random = np.random.default_rng(0)
    return random.uniform(0, SHAPE[0] - 1, n), random.uniform(0, SHAPE[1] - 1, n)


def between(posts: FloatArray, row: FloatArray, column: FloatArray) -> FloatArray:
    return heights_between(posts, continued(posts), row=row, column=column)


def test_heights_are_those_of_polynomials_through_six_posts() -> None:
    posts = np.random.default_rng(1).uniform(-300, 300, SHAPE)
    row, column = (values[:30] for values in places())
    found = between(posts, row, column)
    for i, j, value in zip(row, column, found, strict=True):
        if not (2 <= i < SHAPE[0] - 3 and 2 <= j < SHAPE[1] - 3):
            continue
        first, left = int(i) - 2, int(j) - 2
        along = [BarycentricInterpolator(np.arange(6.0), posts[first + k, left : left + 6])(j - left) for k in range(6)]
        assert value == pytest.approx(float(BarycentricInterpolator(np.arange(6.0), along)(i - first)), abs=1e-9)
    assert between(posts, ROWS.ravel(), COLUMNS.ravel()) == pytest.approx(posts.ravel(), abs=1e-9)
    quintic = polynomial.polyval2d(ROWS - 6, COLUMNS - 8, np.random.default_rng(2).uniform(-1, 1, (6, 6)))
    inside = (row >= 2) & (row < SHAPE[0] - 3) & (column >= 2) & (column < SHAPE[1] - 3)
    wanted = polynomial.polyval2d(row - 6, column - 8, np.random.default_rng(2).uniform(-1, 1, (6, 6)))
    np.testing.assert_allclose(between(quintic, row, column)[inside], wanted[inside], rtol=1e-9)


@pytest.mark.parametrize(
    "hole", [(slice(6, 8), slice(5, 9)), (slice(0, 1), slice(3, 4)), (slice(9, None), slice(0, 6))]
)
def test_beside_unknown_posts_a_parabola_is_exact(hole: tuple[slice, slice]) -> None:
    series = np.array([[3.0, -0.4, 0.05], [0.7, 0.02, 0.0], [-0.06, 0.0, 0.0]])
    posts = polynomial.polyval2d(ROWS, COLUMNS, series)
    posts[hole] = np.nan
    row, column = places()
    found = between(posts, row, column)
    i, j = row.astype(int), column.astype(int)
    unknown = np.isnan(posts[i, j] + posts[i + 1, j] + posts[i, j + 1] + posts[i + 1, j + 1])
    assert (np.isnan(found) == unknown).all() and 0 < unknown.sum() < 250
    np.testing.assert_allclose(found[~unknown], polynomial.polyval2d(row, column, series)[~unknown], atol=1e-9)


def test_places_beyond_the_posts_are_unknown() -> None:
    row, column = np.array([-0.01, 13.01, 5.0, np.nan, 13.0]), np.array([3.0, 3.0, 16.5, 4.0, 16.0])
    found = between(np.ones(SHAPE), row, column)
    assert np.isnan(found[:4]).all() and found[4] == pytest.approx(1.0)
