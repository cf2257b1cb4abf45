"""Heights between the samples of a terrain: against a slow twin, its windows, its edges, and what it must reproduce."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from blocksar.arrays import FloatArray
from blocksar.collection.terrain import Terrain
from blocksar.errors import InputError


def rough(seed: int = 0) -> Terrain:
    heights = np.random.default_rng(seed).uniform(-300, 300, (23, 31))
    return Terrain(x0=-400.0, dx=30.0, y0=1000.0, dy=25.0, heights=heights)


def keys(terrain: Terrain, x: float, y: float) -> float:
    """Cubic convolution with a = -1/2, sample by sample."""

    def weight(s: float) -> float:
        s = abs(s)
        return 1.5 * s**3 - 2.5 * s**2 + 1 if s < 1 else -0.5 * s**3 + 2.5 * s**2 - 4 * s + 2 if s < 2 else 0.0

    return sum(
        weight((x - at_x) / terrain.dx) * weight((y - at_y) / terrain.dy) * float(terrain.heights[j, i])
        for j, at_y in enumerate(terrain.y)
        for i, at_x in enumerate(terrain.x)
    )


def inner(terrain: Terrain, n: int, seed: int = 1) -> tuple[FloatArray, FloatArray]:
    random = np.random.default_rng(seed)
    x, y = terrain.x, terrain.y
    return random.uniform(x[1], x[-2], n), random.uniform(y[1], y[-2], n)


def test_heights_are_those_of_the_slow_twin() -> None:
    terrain = rough()
    x, y = inner(terrain, 50)
    assert terrain(x, y) == pytest.approx([keys(terrain, *at) for at in zip(x, y, strict=True)], abs=1e-9)


def test_samples_are_kept_and_a_paraboloid_is_exact_up_to_the_edge() -> None:
    terrain = rough()
    assert np.abs(terrain(terrain.x, terrain.y[:, None]) - terrain.heights).max() < 1e-9
    x, y = np.meshgrid(terrain.x, terrain.y)

    def bowl(x: FloatArray, y: FloatArray) -> FloatArray:
        return 5 + 0.1 * x - 0.2 * y + 1e-3 * x**2 - 2e-3 * x * y + 5e-4 * y**2

    smooth = Terrain(x0=-400.0, dx=30.0, y0=1000.0, dy=25.0, heights=bowl(x, y))
    random = np.random.default_rng(2)
    x, y = random.uniform(-400, 500, 200), random.uniform(1000, 1550, 200)
    assert smooth(x, y) == pytest.approx(bowl(x, y), abs=1e-9)
    slope = smooth.slope(20.0, 1200.0)
    assert slope == pytest.approx((0.1 + 0.04 - 2.4, -0.2 - 0.04 + 1.2), abs=1e-9)


def test_slopes_on_a_grid_are_differences_of_heights() -> None:
    """Also in the outermost intervals, and unknown where heights are."""
    terrain, h = rough(), 1e-3
    x, y = np.linspace(-399, 499, 41), np.linspace(1001, 1549, 37)
    along_x = (terrain.on_grid(x + h, y) - terrain.on_grid(x - h, y)) / (2 * h)
    along_y = (terrain.on_grid(x, y + h) - terrain.on_grid(x, y - h)) / (2 * h)
    found = terrain.slopes_on_grid(x, y)
    assert found[0] == pytest.approx(along_x, abs=1e-3) and np.abs(along_x).max() > 10
    assert found[1] == pytest.approx(along_y, abs=1e-3)
    terrain.heights[10, 10] = np.nan
    for slope in terrain.slopes_on_grid(x, y):
        np.testing.assert_array_equal(np.isnan(slope), np.isnan(terrain.on_grid(x, y)))


def test_grids_and_windows_have_the_same_bits_as_points() -> None:
    terrain = rough()
    x, y = np.linspace(-500, 700, 97), np.linspace(950, 1700, 71)
    expected = terrain(x, y[:, None])
    assert np.isnan(expected).any() and np.isfinite(expected).any()
    np.testing.assert_array_equal(terrain.on_grid(x, y), expected)
    for columns, rows in ((slice(10, 30), slice(20, 40)), (slice(0, 97), slice(0, 71)), (slice(0, 3), slice(69, 71))):
        box = (x[columns][0], x[columns][-1]), (y[rows][0], y[rows][-1])
        window = terrain.window(*box)
        np.testing.assert_array_equal(window.on_grid(x[columns], y[rows]), expected[rows, columns])
        again = window.window(*box)
        np.testing.assert_array_equal(again(x[columns], y[rows][:, None]), expected[rows, columns])
    assert terrain.window((0.0, 10.0), (1200.0, 1210.0)).heights.size < 100


def test_windows_of_a_refined_terrain_are_thinned_to_the_same_samples() -> None:
    fine = replace(rough(), refined=2)
    whole = fine.thinned()
    assert (whole.dx, whole.refined, whole.heights.shape) == (60.0, 1, (12, 16))
    for x, y in (((-200.0, -100.0), (1200.0, 1300.0)), ((111.0, 112.0), (1333.0, 1334.0)), ((0.0, 300.0), (1e3, 2e3))):
        part = fine.window(x, y).thinned()
        assert part.x[0] <= x[0] - 30 and part.x[-1] >= x[1] + 30
        rows, columns = (slice(at, at + n) for at, n in zip((part.row, part.column), part.heights.shape, strict=True))
        assert np.array_equal(part.heights, whole.heights[rows, columns])
        assert np.array_equal(part.x, whole.x[columns]) and np.array_equal(part.y, whole.y[rows])


def test_holes_spread_no_further_than_the_taps() -> None:
    terrain = rough()
    terrain.heights[10, 12] = np.nan
    at_x, at_y = float(terrain.x[12]), float(terrain.y[10])
    assert np.isnan(terrain(np.array(at_x + 59.0), np.array(at_y)))
    assert np.isfinite(terrain(np.array(at_x + 61.0), np.array(at_y)))
    assert terrain.limits == (np.nanmin(terrain.heights), np.nanmax(terrain.heights))


@pytest.mark.parametrize(
    ("change", "message"), [({"dx": 0.0}, "uniform steps"), ({"heights": np.zeros((3, 9))}, "few")]
)
def test_no_terrain(change: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Terrain(**{"x0": 0.0, "dx": 1.0, "y0": 0.0, "dy": 1.0, "heights": np.zeros((5, 5)), **change})  # type: ignore[arg-type]
