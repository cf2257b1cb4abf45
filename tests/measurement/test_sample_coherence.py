"""The distribution of estimated coherence, against samples of it."""

from __future__ import annotations

import numpy as np
import pytest

from blocksar.collection.weighting import Weighting
from blocksar.measurement.interferometry import (
    coherence_of_median,
    independent_pixels,
    mean_estimate,
    overlap,
    threshold,
)

SAMPLES = 20_000


@pytest.mark.slow
@pytest.mark.parametrize(("looks", "coherence"), [(4, 0.0), (4, 0.5), (20, 0.3), (50, 0.9)])
def test_mean_and_quantiles_are_those_of_samples(looks: int, coherence: float) -> None:
    random = np.random.default_rng(looks)
    a, other = (random.normal(size=(SAMPLES, looks, 2)) @ [1, 1j] for _ in range(2))
    b = coherence * a + np.sqrt(1 - coherence**2) * other
    power = (np.abs(a) ** 2).sum(axis=1) * (np.abs(b) ** 2).sum(axis=1)
    estimates = np.abs((a * b.conj()).sum(axis=1)) / np.sqrt(power)
    spread = estimates.std() / np.sqrt(SAMPLES)  # of the mean; a quantile of 1 % varies several times as much
    assert mean_estimate(coherence, looks) == pytest.approx(estimates.mean(), abs=4 * spread + 2e-4)
    assert threshold(coherence, looks, 0.01) == pytest.approx(np.quantile(estimates, 0.01), abs=0.01)
    if coherence:
        assert coherence_of_median(float(np.median(estimates)), looks) == pytest.approx(coherence, abs=0.01)


@pytest.mark.parametrize("weighting", ["uniform", "taylor:4:-35"])
def test_independent_pixels_are_those_of_filtered_noise(weighting: str) -> None:
    tapers, n, window = Weighting.parse(weighting), 512, 9
    # Bands of 0.6 and 0.5 of the samples along x and y, in white noise.
    random = np.random.default_rng(5)
    spectrum = random.normal(size=(n, n, 2)) @ [1, 1j]
    frequency = np.fft.fftshift(np.fft.fftfreq(n))
    along = [np.where(np.abs(frequency) <= side / 2, taper(frequency / (side / 2)), 0.0)
             for side, taper in ((0.5, tapers.azimuth), (0.6, tapers.range))]  # fmt: skip
    power = np.abs(np.fft.ifft2(np.fft.ifftshift(spectrum * np.outer(*along)))) ** 2
    cells = power[: n // window * window, : n // window * window].reshape(n // window, window, n // window, window)
    means = cells.mean(axis=(1, 3))
    looks = means.mean() ** 2 / means.var()
    sides = np.array([0.6, 0.0]), np.array([0.0, 0.5])
    # 3136 cells tell a variance to 2.5 %.
    assert independent_pixels((window, window), (1.0, 1.0), sides, tapers) == pytest.approx(looks, rel=0.08)


def test_spectra_that_lie_apart_have_less_in_common() -> None:
    uniform = Weighting.parse("uniform")
    assert overlap((0.25, -0.5), uniform) == pytest.approx(0.75 * 0.5, abs=1e-3)
    assert overlap((1.2, 0.0), uniform) == 0.0
    # The correlation of a Hann taper with itself at a shift a: (1 - a) (2 + cos(2 pi a)) / 3 + sin(2 pi a) / (2 pi).
    assert overlap((0.25, 0.0), Weighting.parse("hann")) == pytest.approx(0.75 * 2 / 3 + 1 / (2 * np.pi), abs=1e-3)
