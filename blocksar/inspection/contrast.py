"""The contrast of an echo's surroundings, and how likely a gain of it is by chance.

Contrast is m = N sum(I^2) / (sum I)^2 over the N cells of a small image about an echo, formed over its whole dwell. It
needs no targets: of speckle m is 2 wherever it is smeared to, of points in focus N over a few, and what blurs an image,
in range or along the track, takes contrast from points, edges and texture alike. Gains are of the same echoes, as given
and under an alternative, in dB.

Chance
------
What is not in focus is speckle, I_k = s_k E_k with exponential E_k of unit mean. As E(I^n) = n! s^n, the variances of
the sums are known from the intensities themselves: of T = sum I^2 it is 5/6 sum I^4, of S = sum I it is T / 2, and
their covariance 2/3 sum I^3. So

    var(m) / m^2 = 5/6 sum(I^4) / T^2 + 2 T / S^2 - 8/3 sum(I^3) / (T S),

which is 1 / N for homogeneous speckle, and grows as fewer cells dominate. A lone target has none of that; but the side
lobes of others, of the amplitude a = 0.217 (-13.3 dB) for the first of a neighbour as strong, change its power by the
factor 1 + 2 a cos(phase), of the variance 2 a^2. That adds 2 a^2 sum(I^4) / T^2: 1.4 dB and more to a lone target.
If an alternative is no better than what is given, the gains of n echoes have a mean of zero at most, and

    z = sum(gain) / sqrt(sum(var given + var alternative))

exceeds SIGNIFICANT = 5 by chance once in 3.5 million. Images of exact data change less than that: a mirrored image has
the same speckle and the same side lobes, but is counted as if both were drawn anew.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from blocksar.arrays import FloatArray

SIGNIFICANT = 5.0  # standard deviations
SIDE_LOBE = 2 * 0.217**2  # relative variance of a target's power under the first side lobe of one as strong
SPECKLE = 10 * np.log10(2.0)  # dB
DECIBEL = 10 / np.log(10)


class Contrast(NamedTuple):
    """Contrast of a small image, dB, and the variance that speckle gives it, dB^2."""

    decibels: float
    variance: float


UNLIT = Contrast(float(SPECKLE), 0.0)  # of an echo that a hypothesis does not light: no contrast


def contrast(power: FloatArray, *, oversampling: float) -> Contrast:
    """Contrast of an image.

    Parameters
    ----------
    power : (...) float
        |image|^2.
    oversampling : float
        Samples to an independent cell.
    """
    scaled = power / max(float(power.max()), 1e-300)
    first, second, third, fourth = (float((scaled**n).sum()) for n in (1, 2, 3, 4))
    if first == 0.0:
        return UNLIT
    relative = (
        SIDE_LOBE * fourth / second**2
        + 5 / 6 * fourth / second**2
        + 2 * second / first**2
        - 8 / 3 * third / (second * first)
    )
    variance = DECIBEL**2 * oversampling * max(relative, 1 / power.size)
    return Contrast(float(10 * np.log10(power.size * second / first**2)), variance)


def deviations(given: Sequence[Contrast], other: Sequence[Contrast]) -> float:
    """z of the gains from the contrasts of echoes as given to those of the same echoes under an alternative."""
    gain = sum(b.decibels - a.decibels for a, b in zip(given, other, strict=True))
    variance = sum(a.variance + b.variance for a, b in zip(given, other, strict=True))
    return gain / max(variance, 1e-12) ** 0.5
