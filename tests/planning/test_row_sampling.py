"""Wide apertures: the deramp moves range frequencies, and rows have to be dense enough for that."""

from __future__ import annotations

import numpy as np
import pytest
from axis_beams import axis_collection

from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.focusing.backprojection import form_image
from blocksar.focusing.correction import correct
from blocksar.focusing.recovery import recover_columns
from blocksar.measurement.coherence import coherence
from blocksar.planning.planner import plan_collection
from blocksar.simulation.scatterers import simulate_pulses

GRID = Grid(785.0, 815.0, 1.5, -8.0, 8.0, 0.1)
BAND = 128 * 400e3  # Hz


def wide_collection(half_angle: float) -> Collection:
    """A pass at 1 km of a beam that is not steered, over so many radians on either side of broadside."""
    n_pulse, reach = 900, 1000 * np.tan(half_angle)
    along = np.linspace(-reach, reach, n_pulse)
    return axis_collection(
        n_pulse=n_pulse,
        time=along / 100,
        antenna_position=np.stack([0 * along, along, np.full(n_pulse, 600.0)], axis=1),
        range_frequency=(np.arange(128) - 64) * 400e3,
        reference_range=np.full(n_pulse, 1000.0),
        beam_axis=None,
        beam_steering=None,
        beam_width=None,
    )


@pytest.mark.parametrize("half_angle", [0.05, 0.1])
def test_wide_apertures_are_focused_as_back_projection_does(half_angle: float) -> None:
    collection = wide_collection(half_angle)
    rng = np.random.default_rng(5)
    x, y = rng.uniform(775, 825, 1000), rng.uniform(-14, 14, 1000)
    signal = simulate_pulses(collection, x, y, rng.standard_normal(1000) + 1j * rng.standard_normal(1000), threads=2)
    plan = plan_collection(collection, grid=GRID, blocks=2)
    spectrum = recover_columns(signal, range_frequency=collection.range_frequency, recovery=plan.recovery, threads=2)
    image = np.full(GRID.shape, np.nan, np.complex64)
    for block in plan.blocks:
        # The Doppler rate is proportional to 1 / R, so that phases at the ends turn by (1 - cos) 2 / lambda a metre.
        moved = (1 - np.cos(half_angle)) * 2 * collection.carrier  # of the band, Hz: half of it to either side
        filled = block.sampling.range_occupancy * block.sampling.range_period
        assert filled == pytest.approx(128 * (1 + moved / BAND), rel=0.15)
        slab = np.ascontiguousarray(spectrum[block.first_bin : block.first_bin + block.n_bin].T)
        for step in block.chain:
            slab = step.apply(slab, threads=2)
        part = correct(np.ascontiguousarray(slab), block.ground, x=GRID.x, y=GRID.y, threads=2)
        image[~np.isnan(part)] = part[~np.isnan(part)]
    exact = form_image(lambda pulses: signal[pulses], Geometry(collection=collection), GRID.x, GRID.y, threads=2)
    found = coherence(image, exact)
    assert np.isfinite(image).all()
    assert abs(found.coherence) > max(plan.coherence - 1e-3, 0.999) and abs(found.gain - 1) < 0.01
