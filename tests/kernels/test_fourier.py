"""Centred axes, FFT lengths and the Fourier transform."""

from __future__ import annotations

import numpy as np
import pytest
from samples import noise

from blocksar.kernels import fourier

# -- axes ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [1, 2, 7, 8])
def test_a_centred_axis_contains_its_centre_and_its_parts_contain_its_samples(size: int) -> None:
    axis = fourier.centred(3.0, 0.25, size)
    assert axis.values[size // 2] == 3.0
    assert axis.centre == 3.0
    assert axis.extent == 0.25 * size
    np.testing.assert_allclose(axis.position(axis.values), np.arange(size), atol=1e-12)
    part = axis.part(size // 2, size - size // 2)
    np.testing.assert_allclose(part.values, axis.values[size // 2 :], rtol=0, atol=1e-12)
    assert fourier.dual(axis, size=12, centre=-1.0).step == pytest.approx(1 / 3)


def test_the_fast_length_is_the_smallest_even_length_without_large_prime_factors() -> None:
    def smooth(n: int) -> bool:
        for prime in (2, 3, 5):
            while n % prime == 0:
                n //= prime
        return n == 1

    for minimum in [0.3, 1, 2, 3, 26, 26.5, 97, 127.9, 128, 131, 1023, 4097.2]:
        least = next(n for n in range(2, 10_000, 2) if n >= minimum and smooth(n))
        assert fourier.fast_length(minimum) == least


def test_the_array_transform_and_the_phasor() -> None:
    x = noise(3, 20)
    np.testing.assert_allclose(fourier.fft_rows(x.copy(), inverse=False), np.fft.fft(x, axis=1), atol=2e-5)
    np.testing.assert_allclose(fourier.fft_rows(x.copy(), inverse=True), np.fft.ifft(x, axis=1), atol=1e-6)
    cycles = np.array([0.0, 0.25, -0.5, 1e6 + 0.125])
    found = fourier.unit_phasor(cycles)
    assert found.dtype == np.complex64
    np.testing.assert_allclose(found, [1, 1j, -1, np.exp(0.25j * np.pi)], atol=1e-6)
