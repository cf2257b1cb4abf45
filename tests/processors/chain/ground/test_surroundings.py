"""Echoes from beyond the grid, where the beam is not steered and lights all of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from axis_beams import axis_collection

from blocksar.arrays import ComplexArray
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.processors.chain.ground.correction import correct
from blocksar.processors.chain.planning.planner import plan_collection
from blocksar.processors.chain.steps.recovery import recover_columns
from blocksar.processors.exact.sums import form_image
from blocksar.simulation.scatterers import simulate_pulses

pytestmark = pytest.mark.slow

N_PULSE, PRF = 900, 300
GRID = Grid(121.6, 208.4, 0.6, -4.48, 4.48, 0.1)


@pytest.mark.parametrize("folded", [False, True])
def test_echoes_from_beyond_the_grid_do_not_fold_into_it(folded: bool) -> None:
    """A drone 150 m high. Derotated, targets some 25 m aside have 150 Hz of Doppler, at a PRF of 300 Hz.

    Their Doppler reaches beyond the recovered spectrum, into which it would fold if the signal had as few samples in
    time; and they ring into the guard at the ends of the aperture, where they have to keep their Doppler. Those
    that fold are at other times than the block's targets, and are not summed.
    """
    time = (np.arange(N_PULSE) - N_PULSE // 2) / PRF
    track = np.stack([0 * time, 20.0 * time, np.full(N_PULSE, 150.0)], axis=1)
    collection = axis_collection(
        n_pulse=N_PULSE, carrier=9.6e9, time=time, antenna_position=track,
        range_frequency=(np.arange(160) - 80) * 0.9375e6, reference_range=np.full(N_PULSE, 240.0), beam_axis=None,
        beam_steering=None, beam_width=None,
    )  # fmt: skip
    plan = plan_collection(collection, grid=GRID, blocks=1)
    recovery = plan.recovery
    assert recovery.n_time > recovery.doppler.size
    if folded:
        recovery = replace(recovery, n_time=recovery.doppler.size)
    (block,) = plan.blocks
    x, y = np.array([150.0, 160.0, 110.0]), np.array([24.0, 26.0, 20.0])
    signal = simulate_pulses(collection, x, y, np.ones(3, complex), threads=2)
    spectrum = recover_columns(signal, range_frequency=collection.range_frequency, recovery=recovery, threads=2)
    exact = form_image(lambda pulses: signal[pulses], Geometry(collection=collection), GRID.x, GRID.y, threads=2)
    slab: ComplexArray = np.ascontiguousarray(spectrum[block.first_bin : block.first_bin + block.n_bin].T)
    for step in block.chain:
        slab = step.apply(slab, threads=2)
    error = np.abs(correct(np.ascontiguousarray(slab), block.ground, x=GRID.x, y=GRID.y, threads=2) - exact).max()
    assert error < 1e-3
