"""Apertures of beams that are not steered, wide and short, against exact back-projection of the same samples."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from axis_beams import axis_collection
from plan_images import focus

from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.measurement.coherence import coherence
from blocksar.processors.chain.planning.plan import Plan
from blocksar.processors.chain.planning.planner import plan_collection
from blocksar.processors.exact.sums import form_image
from blocksar.simulation.scatterers import simulate_pulses

pytestmark = pytest.mark.slow

BAND = 128 * 400e3  # Hz


def unsteered(n_pulse: int, **fields: Any) -> Collection:
    return axis_collection(n_pulse=n_pulse, **fields, beam_axis=None, beam_steering=None, beam_width=None)


def compare(collection: Collection, grid: Grid, blocks: int, off: float) -> Plan:
    """Compare clutter, as a whole and in quarters along y, with back-projection; the plan."""
    rng, n = np.random.default_rng(5), 1500
    x, y = rng.uniform(grid.x0 - 10, grid.x1 + 10, n), rng.uniform(grid.y0 - 8, grid.y1 + 8, n)
    signal = simulate_pulses(collection, x, y, rng.standard_normal(n) + 1j * rng.standard_normal(n), threads=2)
    plan = plan_collection(collection, grid=grid, blocks=blocks)
    image = focus(plan, signal)
    exact = form_image(lambda pulses: signal[pulses], Geometry(collection=collection), grid.x, grid.y, threads=2)
    assert np.isfinite(image).all()
    for rows in [slice(None), *np.array_split(np.arange(grid.shape[0]), 4)]:
        found = coherence(image[rows], exact[rows])
        assert abs(found.coherence) > plan.coherence - off and abs(found.gain - 1) < 0.01
    return plan


@pytest.mark.parametrize("half_angle", [0.05, 0.1])
def test_rows_are_dense_enough_for_the_range_frequencies_that_a_deramp_moves(half_angle: float) -> None:
    """A pass at 1 km, over so many radians on either side of broadside."""
    along = np.linspace(-1, 1, 900) * 1000 * np.tan(half_angle)
    collection = unsteered(
        900, time=along / 100, antenna_position=np.stack([0 * along, along, 0 * along + 600.0], axis=1),
        range_frequency=(np.arange(128) - 64) * BAND / 128, reference_range=np.full(900, 1000.0),
    )  # fmt: skip
    plan = compare(collection, Grid(785.0, 815.0, 1.5, -8.0, 8.0, 0.1), 2, 1e-3)
    assert plan.coherence > 0.999
    for block in plan.blocks:
        # The Doppler rate is proportional to 1 / R, so that phases at the ends turn by (1 - cos) 2 / lambda a metre.
        moved = (1 - np.cos(half_angle)) * 2 * collection.carrier  # of the band, Hz: half of it to either side
        filled = block.sampling.range_occupancy * block.sampling.range_period
        assert filled == pytest.approx(128 * (1 + moved / BAND), rel=0.15)


def test_ends_of_short_apertures_are_summed_to_the_end_of_their_smear() -> None:
    """0.63 s at 3.8 km, half a degree: a small product of time and band smears pulses widely. The platform turns."""
    time = (np.arange(360) - 180) / 570
    track = np.outer(time, [0.0, 54.0, 12.0]) + np.outer(time**2 / 2, [3.0, -6.0, 2.0]) + [0.0, 0.0, 2250.0]
    collection = unsteered(
        360, carrier=9.6e9, time=time, antenna_position=track, range_frequency=(np.arange(64) - 32) * 0.8e6,
        reference_range=np.full(360, 3800.0),
    )  # fmt: skip
    assert compare(collection, Grid(3060.0, 3072.0, 1.5, -220.0, 220.0, 2.0), 4, 1e-4).coherence > 0.9999
