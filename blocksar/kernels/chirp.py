"""The spectrum of a linear chirp, from which its matched filter follows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from blocksar.arrays import FloatArray


def chirp_spectrum(frequency: FloatArray, *, chirp_rate: float, pulse_width: float) -> NDArray[np.complex128]:
    """Fourier transform of exp(j pi K tau^2), |tau| <= T / 2, in closed form (Fresnel integrals), s.

    P(f) = exp(-j pi f^2 / K) / sqrt(2K) [Z(u+) - Z(u-)],  u+- = sqrt(2K) (+-T/2 - f/K),  Z = C + jS.
    A down-chirp (K < 0) is the conjugate of the up-chirp.
    """
    from scipy.special import fresnel  # slow to import, and only raw echoes need it

    rate = abs(chirp_rate)
    scale, centre = np.sqrt(2 * rate), frequency / rate
    upper_sine, upper_cosine = fresnel(scale * (pulse_width / 2 - centre))
    lower_sine, lower_cosine = fresnel(scale * (-pulse_width / 2 - centre))
    integral = (upper_cosine - lower_cosine) + 1j * (upper_sine - lower_sine)
    spectrum = np.exp(-1j * np.pi * frequency**2 / rate) * integral / scale
    return np.asarray(spectrum if chirp_rate > 0 else spectrum.conj())
