"""Short apertures, whose targets have a small product of time and band: steps in Doppler smear the pulses widely."""

from __future__ import annotations

import numpy as np
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

N_PULSE = 360
PLACES = Grid(3060.0, 3072.0, 1.5, -220.0, 220.0, 2.0)


def short_collection() -> Collection:
    """0.63 s at 3.8 km and 54 m/s: half a degree of aperture; the platform brakes and turns. Not steered."""
    time = (np.arange(N_PULSE) - N_PULSE // 2) / 570
    track = np.outer(time, [0.0, 54.0, 12.0]) + np.outer(time**2 / 2, [3.0, -6.0, 2.0]) + [0.0, 0.0, 2250.0]
    return axis_collection(
        n_pulse=N_PULSE, carrier=9.6e9, time=time, antenna_position=track,
        range_frequency=(np.arange(64) - 32) * 0.8e6, reference_range=np.full(N_PULSE, 3800.0), beam_axis=None,
        beam_steering=None, beam_width=None,
    )  # fmt: skip


def test_ends_of_short_apertures_are_summed_to_the_end_of_their_smear() -> None:
    collection = short_collection()
    rng = np.random.default_rng(3)
    x, y = rng.uniform(3030, 3100, 2000), rng.uniform(-230, 230, 2000)
    signal = simulate_pulses(collection, x, y, rng.standard_normal(2000) + 1j * rng.standard_normal(2000), threads=2)
    plan = plan_collection(collection, grid=PLACES, blocks=4)
    spectrum = recover_columns(signal, range_frequency=collection.range_frequency, recovery=plan.recovery, threads=2)
    exact = form_image(lambda pulses: signal[pulses], Geometry(collection=collection), PLACES.x, PLACES.y, threads=2)
    assert plan.coherence > 0.9999
    for block in plan.blocks:
        slab = np.ascontiguousarray(spectrum[block.first_bin : block.first_bin + block.n_bin].T)
        for step in block.chain:
            slab = step.apply(slab, threads=2)
        part = correct(np.ascontiguousarray(slab), block.ground, x=PLACES.x, y=PLACES.y, threads=2)
        found = coherence(part, exact)
        assert abs(found.coherence) > plan.coherence - 1e-4 and abs(found.gain - 1) < 2e-3
