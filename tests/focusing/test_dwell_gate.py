"""The dwell gate's windows: the integral of the Fresnel integrals."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.fft

from blocksar.collection.weighting import Taper
from blocksar.focusing.dwell_gate import FAR, HalfDwell, fresnel_integral, smeared_step
from blocksar.focusing.lines import RowPolynomial

ONE = RowPolynomial(series=np.ones((1, 1)), near=0.0, far=1.0, centre=0.0, scale=1.0)


@pytest.mark.parametrize("end", [0.5, 2.0, FAR - 1e-6, FAR + 1e-6, 12.0, 40.0])
def test_the_fresnel_integral_is_that_of_its_slope(end: float) -> None:
    """Its second derivative is exp(1j pi z^2 / 2), here integrated twice by Gauss-Legendre quadrature in short pieces.

    From zero, the double integral is that of (end - z) exp(1j pi z^2 / 2).
    """
    nodes, weights = np.polynomial.legendre.leggauss(40)
    edges = np.linspace(0.0, end, 4 + int(4 * end**2))
    half = np.diff(edges)[:, None] / 2
    z = (edges[:-1, None] + edges[1:, None]) / 2 + half * nodes
    wanted = (half * weights * (end - z) * np.exp(0.5j * np.pi * z**2)).sum()
    for sign in (-1, 1):
        found = np.diff(fresnel_integral(np.array([0.0, sign * end])))[0]
        assert abs(found - wanted) < 1e-12


@pytest.mark.parametrize("taper", ["taylor:4:-35", "hann", "hamming", "kaiser:2.5", "kaiser:6"])
def test_a_tapered_window_is_the_fresnel_integral_of_its_taper(taper: str) -> None:
    """The convolution with exp(1j pi u^2 / e) / sqrt(1j e), by a fine transform of a long window that fades out."""
    slope, length, step, n = 2.65e-5, 0.081, 4e-6, 2**18
    half = HalfDwell(length=ONE, lengths=(length,))
    t = (np.arange(n) - n // 4) * step
    w = Taper.parse(taper)
    rise = np.where(t < 0, 0.0, np.where(t < length, w(np.clip(t / length - 1, -1, 0)) / w(np.array(0.0)), 1.0))
    window = rise * np.clip((0.6 - t) / 0.1, 0, 1)
    kernel = np.exp(-1j * np.pi * slope * scipy.fft.fftfreq(n, step) ** 2)
    wanted = scipy.fft.ifft(scipy.fft.fft(window) * kernel)
    near = (t > -0.02) & (t < 0.2)
    at = t[near]
    found = half.rise(at, length, smeared_step(at, slope=slope, blur=0.0), taper=w, slope=slope)
    assert np.abs(found - wanted[near]).max() < 2e-3
    assert np.sqrt(np.mean(np.abs(found - wanted[near]) ** 2)) < 5e-4


def test_the_share_of_a_length_is_its_place_among_the_lengths() -> None:
    half = HalfDwell(length=ONE, lengths=(0.9, 1.0, 1.3))
    np.testing.assert_allclose(half.share(np.zeros(1)), [[(1.0 - 0.9) / 0.4]])
