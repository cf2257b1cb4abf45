"""The windows that give dwells their weighting."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.fft

from blocksar.collection.weighting import Taper
from blocksar.focusing.dwell_taper import HalfDwell, stepped_rise
from blocksar.focusing.lines import RowPolynomial
from blocksar.kernels.fresnel import smeared_step

ONE = RowPolynomial(series=np.ones((1, 1)), near=0.0, far=1.0, centre=0.0, scale=1.0)


@pytest.mark.parametrize("taper", ["taylor:4:-35", "hann", "hamming", "kaiser:2.5", "kaiser:6"])
def test_a_tapered_window_is_the_fresnel_integral_of_its_taper(taper: str) -> None:
    """The convolution with exp(1j pi u^2 / e) / sqrt(1j e), by a fine transform of a long window that fades out."""
    slope, length, step, n = 2.65e-5, 0.081, 4e-6, 2**18
    t = (np.arange(n) - n // 4) * step
    w = Taper.parse(taper)
    rise = np.where(t < 0, 0.0, np.where(t < length, w(np.clip(t / length - 1, -1, 0)) / w(np.array(0.0)), 1.0))
    window = rise * np.clip((0.6 - t) / 0.1, 0, 1)
    kernel = np.exp(-1j * np.pi * slope * scipy.fft.fftfreq(n, step) ** 2)
    wanted = scipy.fft.ifft(scipy.fft.fft(window) * kernel)
    near = (t > -0.02) & (t < 0.2)
    at = t[near]
    found = stepped_rise(w, at, length, smeared_step(at, slope=slope, blur=0.0), slope=slope)
    assert np.abs(found - wanted[near]).max() < 2e-3
    assert np.sqrt(np.mean(np.abs(found - wanted[near]) ** 2)) < 5e-4


def test_the_share_of_a_length_is_its_place_among_the_lengths() -> None:
    half = HalfDwell(length=ONE, lengths=(0.9, 1.0, 1.3))
    np.testing.assert_allclose(half.blending(np.zeros(1)), [[(1.0 - 0.9) / 0.4]])
