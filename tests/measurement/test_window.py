"""The sign of the phase from the energy in a window of range: a conjugated signal lies in its mirror image."""

from __future__ import annotations

import numpy as np
import pytest

from blocksar.arrays import ComplexArray
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.readers.cphd.echoes import energy_in_window

STEP, N_FREQUENCY, N_PULSE = 400e3, 256, 40  # ranges to 187 m on either side, in bins of 1.5 m
NEAR, FAR = -40.0, 120.0


def gaussian(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    return rng.standard_normal(shape) + 1j * rng.standard_normal(shape)


def spotlight(offsets: np.ndarray, *, noise: float = 0.0, seed: int = 0) -> ComplexArray:
    """Samples of targets at offsets of range (m) from a fixed point, which hardly change over the aperture."""
    rng = np.random.default_rng(seed)
    amplitude = gaussian(rng, (offsets.size,)) if offsets.size > 9 else np.ones(offsets.size)
    frequency = 9.6e9 + (np.arange(N_FREQUENCY) - N_FREQUENCY // 2) * STEP
    turn = np.linspace(-0.02, 0.02, N_PULSE)[:, None]  # of the sight, rad
    s = np.zeros((N_PULSE, N_FREQUENCY), complex)
    for a, d, across in zip(amplitude, offsets, rng.uniform(-20, 20, offsets.size), strict=True):
        s += a * np.exp(-4j * np.pi / SPEED_OF_LIGHT * (d + across * turn) * frequency)
    return (s + noise * gaussian(rng, s.shape)).astype(np.complex64)


def clutter(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(NEAR, FAR, 120)


@pytest.mark.parametrize("noise", [0.0, 3.0, 30.0])
def test_clutter_that_fills_the_window_tells_the_sign(noise: float) -> None:
    signal = spotlight(clutter(1), noise=noise)
    right = energy_in_window(signal, frequency_step=STEP, near=NEAR, far=FAR)
    wrong = energy_in_window(np.conj(signal), frequency_step=STEP, near=NEAR, far=FAR)
    assert (right.conjugated, wrong.conjugated) == ((None, None) if noise == 30.0 else (False, True))
    assert wrong.gain == pytest.approx(-right.gain, abs=1e-3)
    assert (wrong.inside, wrong.mirrored) == pytest.approx((right.mirrored, right.inside), abs=1e-4)


def test_a_window_that_follows_the_pulses_is_taken() -> None:
    rng = np.random.default_rng(3)
    near = NEAR + np.linspace(-10, 10, N_PULSE)
    signal = spotlight(rng.uniform(NEAR + 10, FAR - 10, 120))
    found = energy_in_window(signal, frequency_step=STEP, near=near, far=near + FAR - NEAR)
    assert found.conjugated is False


def test_a_window_beyond_the_ranges_that_are_told_apart_folds_back() -> None:
    span = SPEED_OF_LIGHT / 2 / STEP
    given, folded = (
        energy_in_window(spotlight(clutter(1) + by), frequency_step=STEP, near=NEAR + by, far=FAR + by)
        for by in (0.0, span)
    )
    assert folded == pytest.approx(given, rel=1e-3)
    far = energy_in_window(spotlight(clutter(1) + 200.0), frequency_step=STEP, near=NEAR + 200.0, far=FAR + 200.0)
    assert far.inside > 0.95 and far.conjugated is False


@pytest.mark.parametrize("place", [-39.0, -20.0, 0.0, 31.0, 39.9])
def test_targets_where_window_and_mirror_image_overlap_tell_nothing(place: float) -> None:
    """Their side lobes reach into either part, and more into the nearer one."""
    found = energy_in_window(spotlight(np.array([place])), frequency_step=STEP, near=NEAR, far=FAR)
    assert found.conjugated is None


def test_neither_noise_nor_a_symmetric_window_nor_zeros_tell() -> None:
    signal = spotlight(clutter(2), noise=1.0)
    assert energy_in_window(signal, frequency_step=STEP, near=-90.0, far=90.0).conjugated is None
    assert energy_in_window(np.zeros_like(signal), frequency_step=STEP, near=NEAR, far=FAR).conjugated is None
    for seed in range(10):
        noise = spotlight(np.zeros(0), noise=1.0, seed=seed)
        assert energy_in_window(noise, frequency_step=STEP, near=NEAR, far=FAR).conjugated is None


def test_an_empty_window_is_refused() -> None:
    with pytest.raises(ValueError, match="near < far"):
        energy_in_window(spotlight(np.zeros(1)), frequency_step=STEP, near=3.0, far=3.0)
