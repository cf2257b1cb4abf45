"""A Doppler resampling that is fitted on a narrow block, and applied to all of its Doppler bins."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import blocksar
from blocksar.kernels.phase import unit
from blocksar.processors.chain.steps.azimuth_steps import DopplerResampling

pytestmark = pytest.mark.slow

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
