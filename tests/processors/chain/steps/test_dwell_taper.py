"""The windows that give dwells their weighting."""

from __future__ import annotations

import numpy as np
import pytest

from blocksar.collection.weighting import Taper
from blocksar.kernels.fresnel import smeared_step
from blocksar.processors.chain.steps.dwell_gate import DwellTaper, HalfDwell, stepped_rise
from blocksar.processors.chain.steps.lines import RowPolynomial

ONE = RowPolynomial(series=np.ones((1, 1)), near=0.0, far=1.0, centre=0.0, scale=1.0)


@pytest.mark.slow
@pytest.mark.parametrize("taper", ["taylor:4:-35", "hann", "hamming", "kaiser:2.5", "kaiser:6"])
@pytest.mark.parametrize("slope", [2.65e-5, 2e-3])
def test_a_tapered_window_is_the_sum_of_the_smeared_steps_of_its_taper(taper: str, slope: float) -> None:
    """A rise is a step at the end of the dwell and many small ones after it; Fresnel's integral smears each.

    The second half is hardly longer than its smear, as those of looks of a TOPS beam.
    """
    length, w = 0.081, Taper.parse(taper)
    levels = w(np.linspace(-1, 0, 3001)) / w(np.array(0.0))
    middles = (np.arange(3000) + 0.5) * length / 3000
    at = np.arange(-0.02, 0.2, 2e-4)
    edge, near = smeared_step(at, slope=slope, blur=0.0), slice(None, None, 10)
    later = smeared_step(at[near, None] - middles, slope=slope, blur=0.0)
    wanted = levels[0] * edge[near] + (np.diff(levels) * later).sum(axis=1)
    found = stepped_rise(w, at, length, edge, slope=slope)[near]
    assert np.abs(found - wanted).max() < 3e-4
    assert np.sqrt(np.mean(np.abs(found - wanted) ** 2)) < 1e-4


def test_the_share_of_a_length_is_its_place_among_the_lengths() -> None:
    half = HalfDwell(length=ONE, lengths=(0.9, 1.0, 1.3))
    np.testing.assert_allclose(half.blending(np.zeros(1)), [[(1.0 - 0.9) / 0.4]])


def test_blends_are_told_of_the_windows_that_are_made() -> None:
    """Beyond a smear that is small they are those windows, blended by Lagrange's polynomials of the length."""
    taper, since, length = Taper.parse("taylor:4:-35"), np.arange(0.01, 0.6, 2e-4), 0.42
    half = HalfDwell(length=ONE, lengths=(0.3, 0.4, 0.5))
    windows = DwellTaper(taper=taper, begin=half, end=half).rises(
        half, since, slope=1e-9, step=lambda time, slope: smeared_step(time, slope=slope, blur=0.0)
    )
    made = sum(share * window for share, window in zip((-0.08, 0.96, 0.12), windows, strict=True))
    found = half.blended(taper, since, np.array([length]))
    np.testing.assert_allclose(found, made.real, atol=2e-3)
