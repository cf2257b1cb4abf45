"""Chains under patterns in elevation with zeros in the image, against exact back-projection of the same samples."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from axis_beams import axis_collection
from plan_images import focus

from blocksar.arrays import ComplexArray
from blocksar.collection.collection import Collection
from blocksar.collection.grid import Grid
from blocksar.collection.terrain import Terrain
from blocksar.collection.weighting import Weighting
from blocksar.errors import Unfocusable
from blocksar.measurement.coherence import coherence
from blocksar.processors.chain.planning.plan import Plan
from blocksar.processors.chain.planning.planner import plan_collection
from blocksar.processors.exact.sums import form_image
from blocksar.simulation.scatterers import field, phase_history

GRID = Grid(8910.0, 9090.0, 1.5, -50.0, 50.0, 0.9)
SIDE = 32  # pixels of a chip


def zero_at(x: float, width: float = 0.004) -> dict[str, Any]:
    """A pattern that falls to 0 for 5 m about (x, 0) on the plane, and rises to 1 within `width`, rad."""
    middle = float(np.arctan2(4000.0, x))
    return {
        "elevation": middle + np.array([-0.2, -width, -1e-4, 1e-4, width, 0.2]),
        "elevation_pattern": np.array([0.8, 1.0, 0.0, 0.0, 1.0, 0.7]),
    }


def both_images(plan: Plan, collection: Collection) -> tuple[ComplexArray, ComplexArray]:
    """Clutter as the plan's chain focuses it, and as exact back-projection does."""
    rng, n, grid = np.random.default_rng(4), 5000, plan.grid
    x, y = rng.uniform(grid.x0 - 60, grid.x1 + 60, n), rng.uniform(grid.y0 - 200, grid.y1 + 200, n)
    sigma = rng.standard_normal(n) + 1j * rng.standard_normal(n)
    signal = phase_history(field(collection, x, y, sigma, None), pulses=slice(None))
    exact = form_image(
        lambda pulses: signal[pulses], plan.geometry, grid.x, grid.y, threads=2, weighting=plan.weighting
    )
    return focus(plan, signal), exact


def check(plan: Plan, image: ComplexArray, exact: ComplexArray) -> float:
    """Compare in chips and as a whole; the least coherence of a chip."""
    np.testing.assert_array_equal(np.isnan(image), np.isnan(exact))
    whole, found = coherence(image, exact), []
    assert abs(whole.coherence) > plan.coherence - 1e-3
    assert whole.gain == pytest.approx(1.0, abs=0.01) and abs(whole.phase) < 0.005
    for row in range(0, image.shape[0] - SIDE + 1, SIDE // 2):
        for column in range(0, image.shape[1] - SIDE + 1, SIDE // 2):
            part = slice(row, row + SIDE), slice(column, column + SIDE)
            chip = coherence(image[part], exact[part])
            found.append(abs(chip.coherence))
            assert chip.gain == pytest.approx(1.0, abs=0.02)
    assert min(found) > plan.coherence - 1e-3
    return min(found)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "text"), [("stripmap", "uniform"), ("squinted", "hann")])
def test_images_are_those_of_back_projection_across_a_zero(kind: str, text: str) -> None:
    """On the plane; all are NaN where the pattern is less than a hundredth of its peak. 0.9998 was said, and 0.91
    measured: sums over lit pulses were linear between ranges, and the factor for the pattern a series."""
    collection = axis_collection(kind, n_pulse=600)
    y = float(np.hypot(9000, 4000) * np.tan(0.25)) if kind == "squinted" else 0.0
    collection = Collection(**{**collection.as_dict(), **zero_at(float(np.hypot(9000, y)))})
    grid = Grid(GRID.x0, GRID.x1, GRID.dx, y + GRID.y0, y + GRID.y1, GRID.dy)
    plan = plan_collection(collection, grid=grid, weighting=Weighting.parse(text))
    image, exact = both_images(plan, collection)
    # Elevations that change by more than the zero is wide over a dwell leave no pixel dark.
    assert (0.002 < np.isnan(exact).mean() < 0.05) == (kind != "squinted")
    assert plan.coherence > 0.999
    check(plan, image, exact)


@pytest.mark.slow
def test_unit_targets_beside_a_zero_are_one() -> None:
    """A pattern tilts the weights of a dwell, by which a chain's gain changes."""
    collection = Collection(**{**axis_collection(n_pulse=600).as_dict(), **zero_at(9000.0, 0.003)})
    columns, rows = np.array([56, 64]), np.array([80, 20])
    x, y = GRID.x[columns], GRID.y[rows]
    plan = plan_collection(collection, grid=GRID)
    for k in range(x.size):
        echo = field(collection, x[k : k + 1], y[k : k + 1], np.ones(1, complex), None)
        image = focus(plan, phase_history(echo, pulses=slice(None)))
        assert abs(image[rows[k], columns[k]]) == pytest.approx(1.0, abs=0.005)


def test_a_pattern_in_elevation_over_heights_is_refused() -> None:
    collection = Collection(**{**axis_collection(n_pulse=600).as_dict(), **zero_at(9010.0)})
    terrain = Terrain.flat(10.0, (8700.0, 9300.0), (-300.0, 300.0))
    with pytest.raises(Unfocusable, match="a pattern in elevation over a plane only"):
        plan_collection(collection, grid=GRID, terrain=terrain)


@pytest.mark.slow
def test_ranges_without_any_light_are_planned_and_stay_empty() -> None:
    """A pattern that is 0 over a third of the swath: targets there have no weight, and no focus."""
    pattern = {
        "elevation": np.arctan2(4000.0, [9500.0, 9040.0, 9030.0, 8500.0]),
        "elevation_pattern": [1.0, 1.0, 0.0, 0.0],
    }
    pattern = {name: np.array(values) for name, values in pattern.items()}
    collection = Collection(**{**axis_collection(n_pulse=600).as_dict(), **pattern})
    plan = plan_collection(collection, grid=GRID, blocks=2)
    image, exact = both_images(plan, collection)
    assert np.isnan(image).mean() == pytest.approx(0.66, abs=0.02)
    assert plan.coherence > 0.999
    assert abs(coherence(image, exact).coherence) > plan.coherence - 1e-3
    np.testing.assert_array_equal(np.isnan(image), np.isnan(exact))
