"""What ends of whole dwells lose, against sums over pulses and integrals over time of every echo that is lit."""

from __future__ import annotations

import numpy as np
import pytest

from blocksar import solvers
from blocksar.arrays import FloatArray
from blocksar.kernels.fresnel import smeared_step
from blocksar.processors.chain.dwells.dwell_ends import lit_energy

INTERVAL = 1.0 / 3000  # s
FINE = 24  # samples of the integral over an interval


def _summed(area: float, displaced: float, blur: float, doppler: FloatArray) -> FloatArray:
    """|sum over pulses - integral over time|^2 (n,), s^2, over an end; the other one, far away, fades out in both."""
    step, total = INTERVAL / FINE, np.zeros(doppler.size)
    t = (np.arange(-200 * FINE, 400 * FINE) + 0.5) * step
    fall = np.cos(np.pi / 2 * np.clip((t / INTERVAL - 150) / 240, 0, 1)) ** 2
    start = np.cos(np.pi / 2 * np.clip((-t / INTERVAL - 100) / 90, 0, 1)) ** 2  # of what the smear leaves before
    waves = np.exp(2j * np.pi * np.outer(doppler, t))
    for sign in (1, -1):
        made = waves @ (smeared_step(t - sign * displaced, slope=area, blur=blur) * fall * start) * step
        for first in range(0, FINE, 3):
            at = slice(200 * FINE + first, None, FINE)
            wanted = waves[:, at] @ fall[at] * INTERVAL
            total += np.abs(wanted - made) ** 2 / (2 * FINE / 3)
    return total


@pytest.mark.slow
@pytest.mark.parametrize("lit_band", [200.0, 1900.0])  # Hz
@pytest.mark.parametrize(
    ("area", "displaced", "blur"), [(1e-9, 0.0, INTERVAL / 2), (3e-5, 1e-4, 5e-4), (2e-6, 1e-3, 2e-4)]
)
def test_an_end_loses_what_sums_over_pulses_differ_by(
    area: float, displaced: float, blur: float, lit_band: float
) -> None:
    nodes, weights = solvers.gauss_legendre(80)
    doppler, shares = lit_band * (1 + nodes) / 2, weights * lit_band / 2
    pattern = 0.3 + 0.7 * np.cos(np.pi / 2 * nodes)
    energy = _summed(area, displaced, blur, doppler)
    gain = np.asarray(np.polynomial.legendre.legfit(nodes, pattern**2, 15))
    for power, series in ((np.ones(1), None), (pattern**2, gain)):
        found = lit_energy(
            np.array(area), np.array(displaced), np.zeros(()), blur=blur, pulse_interval=INTERVAL, lit_band=lit_band,
            band=(np.zeros(1), np.ones(1)), gain=series,
        )  # fmt: skip
        assert float(found) == pytest.approx(float((shares * power * energy).sum()), rel=0.04)


def test_the_band_moves_ends() -> None:
    """An end that the keystone moves loses the mean over those that are displaced so."""
    nodes, shares = np.array([-0.8, -0.2, 0.4]), np.array([0.2, 0.5, 0.3])
    area, spread = np.array([1e-6, 4e-6]), np.array([2e-4, 8e-4])

    def lost(displaced: FloatArray, spread: FloatArray, band: tuple[FloatArray, FloatArray]) -> FloatArray:
        return lit_energy(area, displaced, spread, blur=1e-4, pulse_interval=INTERVAL, lit_band=500.0, band=band)

    apart = [lost(-spread * node, np.zeros(2), (np.zeros(1), np.ones(1))) for node in nodes]
    np.testing.assert_allclose(lost(np.zeros(2), spread, (nodes, shares)), shares @ np.array(apart), rtol=1e-3)
