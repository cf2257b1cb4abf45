"""Levelling of amplitudes along the aperture of a beam that is not steered."""

from __future__ import annotations

import numpy as np
import pytest
from steps import collection, planned

from blocksar.collection.weighting import AxisTaper, Taper
from blocksar.processors.chain.dwells.dwell_weights import level_aperture, levelled
from blocksar.processors.chain.dwells.target_lines import Dwells
from blocksar.processors.chain.steps.step import trace


def test_levelled_lines_have_equal_amplitudes_and_the_same_sum_of_weights() -> None:
    case = planned(collection(steering_deg=None), blocks=1)
    yaw = np.linspace(case.plan.low, case.plan.high, 5)
    dwells = Dwells(geometry=case.geometry, yaw=yaw, origin=case.recovery.origin, walk=case.recovery.walk)
    lit = dwells.lines(np.linspace(29950.0, 30050.0, 3)[:, None])
    line = trace(case.plan.chain, lit)
    pulses = case.recovery.pulses
    taper = AxisTaper.over(Taper.parse("taylor:4:-35"), pulses.start, pulses.step, pulses.size)
    assert taper is not None
    level = level_aperture(line, taper)
    after = levelled(line, level)
    assert np.ptp(after.stretch / after.stretch.mean(axis=-1, keepdims=True)) < 0.1 * np.ptp(
        line.stretch / line.stretch.mean(axis=-1, keepdims=True)
    )
    times = lit.time[0, 0]
    weight = lit.weight[0, 0]
    assert (weight * level(times)).sum() == pytest.approx((weight * taper(times)).sum(), rel=1e-6)
    # What the samples are multiplied by is what the lines were: amplitude is the root of the stretch.
    ratio = level(times) / taper(times)
    np.testing.assert_allclose(after.stretch / line.stretch, np.broadcast_to(ratio**2, line.stretch.shape), rtol=1e-6)
