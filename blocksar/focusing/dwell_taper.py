"""The weighting over dwells, and the windows in time that give it to them.

After the steps in Doppler, dwells differ in length from target to target, and the beam's centre need not pass amid
their ends. So a dwell is divided there, at its middle, into two halves. A window rises over one half, from its end to
the middle, and stays at the middle's weight beyond. There are windows for a few lengths of each half: the image of a
target is blended from those by its own length.

Along a half, the *share* is 0 at the end of the dwell and 1 in its middle, and v is the place in the beam, 0 in its
centre to 1 at its edge. A weighting is a function of v. Windows are made for times *since* the end of a dwell, s.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from blocksar.arrays import FloatArray
from blocksar.collection.weighting import Taper
from blocksar.focusing.lines import RowPolynomial
from blocksar.kernels.fourier import fast_length, fft_rows
from blocksar.kernels.operations import BLEND_BEYOND

Step = Callable[[FloatArray, float], NDArray[np.complex128]]  # (times since an end, s; slope, s/Hz) -> its smeared step
RISE_SAMPLES = 256  # at least, of the grid on which a window is smeared, over its half
SMEARS = 12.0  # sqrt(e) beyond which the smear is small


@dataclass(frozen=True, kw_only=True, eq=False)
class HalfDwell:
    """The half of the dwells from one end to the middle.

    Attributes
    ----------
    length : RowPolynomial
        Along Doppler, s.
    lengths : tuple of float
        Those for which windows are made, equally spaced, s.
    """

    length: RowPolynomial
    lengths: tuple[float, ...]

    def blended(self, taper: Taper, since: FloatArray, length: FloatArray) -> FloatArray:
        """What windows blended for halves of lengths (..., 1), s, give sharp echoes at times (..., n) since their end.

        Over the middle's weight.
        """
        count, total = len(self.lengths), np.zeros(np.broadcast_shapes(since.shape, length.shape))
        apart = max(self.lengths[-1] - self.lengths[0], 1e-12)
        at = np.clip((length - self.lengths[0]) / apart, *BLEND_BEYOND) * (count - 1)
        for k, window in enumerate(self.lengths):
            share = math.prod((at - other) / (k - other) for other in range(count) if other != k)
            total += share * taper(np.clip(1 - since / window, 0.0, 1.0))
        return total / float(taper(np.array(0.0)))

    def blending(self, rng: FloatArray) -> FloatArray:
        """Power coefficients along Doppler, (n, order + 1), of the place of a length among `lengths`, 0 .. 1."""
        coefficients = self.length.coefficients(rng)
        coefficients[:, 0] -= self.lengths[0]
        return coefficients / max(self.lengths[-1] - self.lengths[0], 1e-12)


@dataclass(frozen=True, kw_only=True, eq=False)
class DwellTaper:
    """The weighting over dwells, and the halves into which their middles divide them."""

    taper: Taper
    begin: HalfDwell
    end: HalfDwell

    def rises(self, half: HalfDwell, since: FloatArray, *, slope: float, step: Step) -> list[NDArray[np.complex128]]:
        """Windows over one of the halves, one for each of its lengths, (n,) each, relative to the middle's weight.

        They are convolved with the Fresnel kernel of the area `slope` > 0, s/Hz (`dwell_gate`), as `step` is.
        """
        stepped = step(since, slope)
        return [stepped_rise(self.taper, since, length, stepped, slope=slope) for length in half.lengths]


def stepped_rise(
    taper: Taper, since: FloatArray, length: float, step: NDArray[np.complex128], *, slope: float
) -> NDArray[np.complex128]:
    """A taper's first half over `length`, then 1, at uniform times since the end: (n,).

    `step` is the smeared step there, which the taper begins by. The rest is continuous, and is smeared by a transform.
    Its curvature jumps at both ends of the half: where a half is not much longer than its smear, that counts.
    """
    edge = float(taper(np.array(1.0)) / taper(np.array(0.0)))

    def rest(time: FloatArray) -> FloatArray:
        return np.where(time > 0, taper(np.clip(1 - time / length, 0, 1)) / taper(np.array(0.0)) - edge, 0.0)

    finer = math.ceil(abs(float(since[1] - since[0])) * RISE_SAMPLES / length)
    return edge * step + _smeared(rest, since, length, slope=slope, finer=finer)


def _smeared(
    profile: Callable[[FloatArray], FloatArray], since: FloatArray, length: float, *, slope: float, finer: int
) -> NDArray[np.complex128]:
    """A profile of the times since an end, convolved with the Fresnel kernel of the area `slope`: (n,).

    By a transform on a finer grid that goes on at both ends, where what the transform wraps around can fade out.
    """
    step, beyond = abs(float(since[1] - since[0])), max(length / 2, SMEARS * math.sqrt(slope))
    before = math.ceil(beyond / step)
    size = fast_length((since.size + 2 * before) * finer)
    fine = min(float(since[0]), float(since[-1])) + (np.arange(size) - before * finer) * step / finer
    values = profile(fine) * np.clip(2 * (fine[-1] - fine) / beyond, 0, 1)
    frequency = (np.arange(size) + size // 2) % size - size // 2
    kernel = np.exp(-1j * np.pi * slope * (frequency * finer / (size * step)) ** 2)
    spectrum = fft_rows(values[None].astype(np.complex128), inverse=False)
    window = fft_rows(spectrum * kernel, inverse=True)[0, before * finer :: finer][: since.size]
    return window if since[1] > since[0] else window[::-1]
