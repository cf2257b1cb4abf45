"""The power within reach of a chip's errors, against errors that are spread by a kernel that is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import fftconvolve

from blocksar.measurement.coherence import coherence, power_within_reach, referred

SIDE = 64
CHIP = slice(224, 224 + SIDE)
LOSS = 1e-3  # 1 - g: errors have twice that power


def clutter(rng: np.random.Generator, level: np.ndarray) -> np.ndarray:
    return level * (rng.normal(size=level.shape) + 1j * rng.normal(size=level.shape)) / np.sqrt(2)


def spread(rng: np.random.Generator, image: np.ndarray, width: tuple[float, float]) -> np.ndarray:
    """An error of the power 2 LOSS of each pixel, with random phases, that falls off along y and x from its place."""
    n = np.arange(-100, 101)
    kernel = np.exp(-np.abs(n) / width[0])[:, None] * np.exp(-np.abs(n) / width[1])
    weight = np.sqrt(2 * LOSS * kernel / kernel.sum())
    return np.asarray(fftconvolve(image, weight * np.exp(2j * np.pi * rng.uniform(size=kernel.shape)), mode="same"))


@pytest.mark.slow
@pytest.mark.parametrize("width", [(2.0, 2.0), (25.0, 1.5), (2.0, 30.0)])
@pytest.mark.parametrize("decibels", [0.0, -14.0, -26.0])
def test_a_chip_that_errs_as_predicted_is_judged_so(width: tuple[float, float], decibels: float) -> None:
    """Never below the prediction by more than what 4096 pixels of speckle leave, whatever spreads the error."""
    rng = np.random.default_rng(5)
    level = np.ones((512, 512))
    level[200:312, 200:312] = 10 ** (decibels / 20)
    exact = clutter(rng, level)
    image = exact + spread(rng, exact, width)
    found = coherence(image[CHIP, CHIP], exact[CHIP, CHIP])
    reach = power_within_reach(np.abs(image) ** 2, CHIP, CHIP)
    assert referred(abs(found.coherence), reach / found.power) >= 1 - 1.25 * LOSS
    if decibels == 0.0:  # even ground: next to nothing is forgiven
        assert reach / found.power < 1.35
        assert referred(abs(found.coherence), reach / found.power) <= 1 - 0.6 * LOSS


def test_a_chip_that_errs_by_more_is_found() -> None:
    """An error of its own, as of a wrong phase in a corner of bright ground."""
    rng = np.random.default_rng(5)
    exact = clutter(rng, np.ones((512, 512)))
    image = exact.copy()
    image[224:256, 224:256] *= np.exp(0.3j)
    found = coherence(image[CHIP, CHIP], exact[CHIP, CHIP])
    reach = power_within_reach(np.abs(image) ** 2, CHIP, CHIP)
    assert referred(abs(found.coherence), reach / found.power) < 1 - 5 * LOSS


def test_what_is_not_covered_does_not_count() -> None:
    power = np.full((300, 200), np.nan)
    power[100:200, 50:150] = 2.0
    assert power_within_reach(power, slice(110, 174), slice(60, 124)) == pytest.approx(2.0)


def test_a_chip_as_bright_as_all_about_it_keeps_its_coherence() -> None:
    assert referred(0.97, 1.0) == referred(0.97, 0.4) == 0.97
    assert np.isnan(referred(np.nan, 3.0))
