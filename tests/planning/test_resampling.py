"""A Doppler resampling that is fitted on a narrow block, and applied to all of its Doppler bins."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import blocksar
from blocksar.focusing.azimuth_steps import DopplerResampling
from blocksar.kernels.phase import unit
from blocksar.measurement.coherence import coherence
from blocksar.planning.plan import Plan

# Targets of a block reach over a tenth of its Doppler bins: a beam of 1.7 degrees that turns fast, 40 pulses a dwell.
NARROW = """
[radar]
carrier = 1.88878409e9
bandwidth = 69.8e6
range_sampling = 75.6e6
prf = 67.75
[track]
position = [-15055.4548, 19199.7827, 1948.70496]
velocity = [-40.1926778, 20.2808182, -10.8641479]
acceleration = [-0.872851864, 0.863142014, 0.577205335]
[time]
pulses = 202
[beam]
mode = "tops"
width_deg = 1.73317152
axis_yaw_deg = 154.498837
axis_pitch_deg = -13.0532417
squint_deg = 32.5479962
rate_deg = -3.61439671
[scene]
swath = [3125.8, 3222.1]
centre_yaw_deg = 213.210968
[[targets]]
name = "middle"
range = 3173.9
yaw_deg = 213.2
"""

# h' reaches from 0.8 to 1.9 over the Doppler of a block.
UNEVEN = """
[radar]
carrier = 35.2e9
bandwidth = 600e6
range_sampling = 700e6
prf = 1800.0
[track]
position = [0.0, 0.0, 600.0]
velocity = [42.0, 3.0, -6.0]
acceleration = [-3.0, 6.0, 4.0]
jerk = [1.0, -2.0, 1.0]
[time]
pulses = 1700
[scene]
swath = [1450.0, 1550.0]
centre_yaw_deg = -40.0
reference_range = "scene_centre"
"""


def test_an_uneven_resampling_is_inverted_to_a_thousandth_of_a_bin(tmp_path: Path) -> None:
    """A polynomial of degree 9 erred by a quarter of a bin, of which the traced lines know nothing: 0.959 for 0.999."""
    (tmp_path / "s.toml").write_text(UNEVEN)
    plan = blocksar.plan(
        tmp_path / "s.toml", processor="keystone-resampling", blocks=3, grid=((1015, 1100, 0.2), (-925, -840, 0.2))
    ).result
    orders = []
    for block in plan.blocks:
        (step,) = (step for step in block.chain if isinstance(step, DopplerResampling))
        assert block.even
        f = step.axes.doppler.values
        for row in (0, step.n_row // 2, step.n_row - 1):
            at = np.polynomial.polynomial.polyval(unit(f.size), step.positions[row])
            origin = step.axes.doppler.start + step.axes.doppler.step * at
            offset, _, _ = step.shift.evaluate(step.axes.rows.values[row : row + 1], origin[None])
            assert np.abs(origin + offset[0] - f).max() < 2e-3 * step.axes.doppler.step
        orders.append(step.positions.shape[1] - 1)
    assert max(orders) > 9


def test_a_resampling_that_would_fold_doppler_beyond_the_targets_has_fewer_orders(tmp_path: Path) -> None:
    """It was planned with all orders, and failed when it was applied."""
    (tmp_path / "s.toml").write_text(NARROW)
    store = blocksar.simulate(tmp_path / "s.toml", tmp_path / "s.zarr")
    x, y = -15055.4548 + 2505.3 * np.cos(np.radians(213.2)), 19199.7827 + 2505.3 * np.sin(np.radians(213.2))
    asked = {"grid": ((x - 20, x + 20, 1.0), (y - 20, y + 20, 1.0)), "workers": 0}
    chosen = {"processor": "keystone-resampling", "blocks": 1}
    plan = blocksar.plan(store, **asked, **chosen).result
    assert isinstance(plan, Plan)
    assert plan.blocks[0].even and plan.blocks[0].choice.candidate.resampling < 3
    images = []
    for name, how in (("run", chosen), ("exact", {"processor": "backprojection"})):
        blocksar.focus(store, tmp_path / name, **asked, **how)
        images.append(blocksar.open(tmp_path / name).image.values)
    assert abs(images[0]).max() > 0.9
    assert abs(coherence(*images).coherence) > 0.99
