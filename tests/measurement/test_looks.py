"""Looks: means over whole cells, their speckle against theory, and a point's amplitude."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from blocksar.errors import InputError
from blocksar.measurement.multilooking import checked_looks, decibels, multilook, power_of


def clutter(shape: tuple[int, int], occupied: tuple[float, float], seed: int = 0) -> Any:
    """Gaussian clutter whose spectrum is flat over a part of each axis' band."""
    rng = np.random.default_rng(seed)
    spectrum = rng.standard_normal(shape) + 1j * rng.standard_normal(shape)
    for axis, (n, part) in enumerate(zip(shape, occupied, strict=True)):
        outside = np.abs(np.fft.fftfreq(n)) >= part / 2
        spectrum[outside if axis == 0 else (slice(None), outside)] = 0
    return np.fft.ifft2(spectrum).astype(np.complex64)


def test_cells_are_means_of_whole_cells_and_never_mix_covered_with_not_covered() -> None:
    rng = np.random.default_rng(1)
    power = rng.random((11, 9)).astype(np.float32)
    power[3, 4] = np.nan
    found = multilook(power, (3, 2))
    assert found.shape == (3, 4) and found.dtype == np.float32
    for i, j in np.ndindex(found.shape):
        wanted = np.mean([float(power[3 * i + m, 2 * j + n]) for m in range(3) for n in range(2)])
        np.testing.assert_allclose(found[i, j], wanted, rtol=1e-6)
    assert np.isnan(found).sum() == 1 and np.isnan(found[1, 2])
    assert multilook(power, (1, 1)).tobytes() == power.tobytes()


@pytest.mark.parametrize(("looks", "occupied"), [((1, 1), (0.8, 0.6)), ((4, 4), (1.0, 1.0)), ((6, 3), (0.5, 0.8))])
def test_speckle_of_cells_is_that_of_theory(looks: tuple[int, int], occupied: tuple[float, float]) -> None:
    """The power of Gaussian pixels has the covariance |rho|^2, with rho the sinc of the occupied band."""
    power = multilook(power_of(clutter((1200, 1200), occupied)), looks).astype(float)
    correlated = 1.0
    for n, part in zip(looks, occupied, strict=True):
        lag = np.arange(n)[:, None] - np.arange(n)
        correlated *= float((np.sinc(part * lag) ** 2).sum()) / n**2
    assert power.mean() ** 2 / power.var() == pytest.approx(1 / correlated, rel=0.05)


def test_a_point_keeps_its_energy() -> None:
    """A point of amplitude 1 spread by a band of b cycles per pixel has the energy 1 / b along each axis."""
    occupied = (0.5, 0.4)
    axes = [np.sinc(part * (np.arange(600) - 300.3)) for part in occupied]
    power = power_of(np.outer(*axes).astype(np.complex64))
    found = multilook(power, (5, 6))
    assert float(found.astype(float).sum()) * 30 == pytest.approx(1 / np.prod(occupied), rel=0.01)
    assert found.max() < power.max() <= 1


def test_zero_is_dark_and_not_missing() -> None:
    assert decibels(np.array([1.0, 0.0, 100.0], np.float32)).tolist() == pytest.approx([0.0, -300.0, 20.0], abs=1e-4)


@pytest.mark.parametrize("looks", [(0, 1), (2,), (1.5, 2), (True, 2), ("a", 2), (60, 1), (1, 60)])
def test_wrong_looks_are_refused(looks: Any) -> None:
    with pytest.raises(InputError, match="looks"):
        checked_looks(looks, (100, 100))
