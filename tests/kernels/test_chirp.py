"""The spectrum of the chirp."""

from __future__ import annotations

import numpy as np
import pytest

from blocksar.kernels.fourier import chirp_spectrum


def test_chirp_spectrum_is_its_fourier_integral() -> None:
    rate, width = 5e13, 2e-6
    f = np.array([-70e6, -50e6, -1e6, 0.0, 30e6, 50e6])
    tau = (np.arange(400_000) + 0.5) / 400_000 * width - width / 2
    integral = np.exp(1j * np.pi * rate * tau**2) @ np.exp(-2j * np.pi * tau[:, None] * f) * width / tau.size
    assert chirp_spectrum(f, chirp_rate=rate, pulse_width=width) == pytest.approx(integral, abs=1e-6 * width)
