"""The only Fourier transform pair of the package, with its sign convention and axes; no other module calls an FFT.

    forward:  X(f_k) = sum_n x(t_n) exp(-2j pi f_k t_n)
    inverse:  x(t_n) = 1/N sum_k X(f_k) exp(+2j pi f_k t_n)

Both axes are uniform and may start anywhere; with step_f = 1 / (N step_t) each sum is one FFT between two
vectors of phase factors, which `rows` applies. No fftshift is needed, because each axis carries its start.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from blocksar.arrays import ComplexArray, FloatArray


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


Samples = TypeVar("Samples", np.complex64, np.complex128)


@dataclass(frozen=True)
class Axis:
    """A uniform axis: start + step * index."""

    start: float
    step: float
    size: int

    @property
    def values(self) -> FloatArray:
        return np.asarray(self.start + self.step * np.arange(self.size), dtype=np.float64)

    @property
    def extent(self) -> float:
        return self.step * self.size

    @property
    def centre(self) -> float:
        return self.start + self.step * (self.size // 2)

    def position(self, value: FloatArray) -> FloatArray:
        """Fractional index of a value."""
        return (value - self.start) / self.step

    def part(self, first: int, size: int) -> Axis:
        """The axis of the samples first .. first + size - 1."""
        return Axis(self.start + first * self.step, self.step, size)


def centred(centre: float, step: float, size: int) -> Axis:
    """An axis whose middle sample (index size // 2) is `centre`."""
    return Axis(centre - step * (size // 2), step, size)


def dual(axis: Axis, *, size: int, centre: float) -> Axis:
    """The axis on the other side of a transform of `size` samples with this axis' step, centred at `centre`."""
    return centred(centre, 1.0 / (size * axis.step), size)


def fast_length(minimum: float) -> int:
    """The smallest even FFT length of at least `minimum` whose only prime factors are 2, 3 and 5.

    The library also has loops for the factors 7 and 11, but a transform with one of them takes up to a fifth longer
    than the next length without.
    """
    half = int(np.ceil(max(minimum, 2.0) / 2))
    best = 1 << (half - 1).bit_length()
    five = 1
    while five < best:
        odd = five  # 3^i 5^j
        while odd < best:
            best = min(best, odd << (-(-half // odd) - 1).bit_length())
            odd *= 3
        five *= 5
    return 2 * best


def unit_phasor(cycles: FloatArray) -> ComplexArray:
    """exp(2j pi cycles) in complex64; whole cycles are removed in float64."""
    return np.exp(2j * np.pi * (cycles - np.rint(cycles))).astype(np.complex64)


def fft_rows(group: NDArray[Samples], *, inverse: bool) -> NDArray[Samples]:
    """FFT of each row over bare indices: 1 / N in the inverse, one thread, the input is overwritten."""
    import scipy.fft  # slow to import, and a plan transforms nothing

    return np.asarray((scipy.fft.ifft if inverse else scipy.fft.fft)(group, axis=1, overwrite_x=True))
