"""Cubic splines on uniform knots against scipy's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import make_lsq_spline

from blocksar.collection.geometry import fit_track
from blocksar.collection.spline import fit_spline


@pytest.mark.parametrize("n_interval", [1, 7, 40])
def test_the_fit_is_the_least_squares_spline(n_interval: int) -> None:
    rng = np.random.default_rng(1)
    at = np.sort(rng.uniform(2.0, 5.0, 400))
    values = rng.standard_normal((400, 2))
    knots = np.linspace(at[0], at[-1], n_interval + 1)
    wanted = make_lsq_spline(at, values, np.r_[[at[0]] * 3, knots, [at[-1]] * 3], 3)
    found = fit_spline(at, values, n_interval)
    places = np.linspace(at[0], at[-1], 301)
    for derivative in range(3):
        size = np.abs(wanted(places, derivative)).max()
        np.testing.assert_allclose(found(places, derivative), wanted(places, derivative), atol=1e-7 * size)


def wobbling(time: np.ndarray, *, noise: float) -> np.ndarray:
    smooth = np.stack([3e3 + 100 * time, 5 * time**2, 7e3 - 0 * time], axis=1)
    wobble = np.stack([0.03 * np.sin(2 * np.pi * f * time + f) for f in (0.5, 1.3, 4.2)], axis=1)
    return smooth + wobble + noise * np.random.default_rng(2).standard_normal(smooth.shape)


@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_a_measured_track_is_a_polynomial_and_a_spline(noise: float) -> None:
    time = np.linspace(-3.0, 3.0, 3001)
    track = fit_track(time, wobbling(time, noise=noise), accuracy=2e-7)
    assert track.wobble is not None and track.order <= 5
    inner = time[200:-200]
    true = wobbling(inner, noise=0.0)
    assert np.abs(track.position(inner) - true).max() <= max(1.5 * noise, 1e-5)
    if noise:  # what remains is the noise, and not more
        assert np.std(track.misfit) == pytest.approx(noise, rel=0.1)
    step = 1e-5
    slope = (track.position(inner + step) - track.position(inner - step)) / (2 * step)
    np.testing.assert_allclose(track.velocity(inner), slope, atol=1e-5)
    bend = (track.velocity(inner + step) - track.velocity(inner - step)) / (2 * step)
    np.testing.assert_allclose(track.acceleration(inner), bend, atol=1e-2)


def test_noise_alone_is_no_wobble() -> None:
    time = np.linspace(-0.3, 0.3, 2000)
    smooth = np.stack([1e3 * time, 5 * time**2, 0 * time], axis=1)
    noisy = smooth + 1e-3 * np.random.default_rng(3).standard_normal(smooth.shape)
    assert fit_track(time, noisy, accuracy=2e-7).wobble is None
