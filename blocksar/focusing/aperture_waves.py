"""Weights over the aperture that differ from place to place, as short sums of waves.

Under a beam that stays on its ground all pulses light a target, but its place v in the beam still changes a little, and
with it the weight w(v). A chain sums all pulses with equal weights. In a focused block, whose value at a Doppler f is
the sum of s(t) exp(-2j pi f t) over slow time t, a wave along t is a shift along Doppler:

    w(t) = a_0 + sum_k a_k cos(2 pi k h (t - m)) + b_k sin(2 pi k h (t - m)),
    sum w s exp(-2j pi f t) = a_0 S(f) + sum_k ((a_k + 1j b_k) exp(+2j pi k h m) S(f + k h)
                                              + (a_k - 1j b_k) exp(-2j pi k h m) S(f - k h)) / 2.

h is a fraction of the Doppler resolution, and a and b change over the ground as slowly as the place in the beam does.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.focusing.ground_map import ApertureWaves, GroundMap


def sum_waves(
    correct: Callable[[float], ComplexArray],
    ground: GroundMap,
    waves: ApertureWaves,
    *,
    x: FloatArray,
    y: FloatArray,
) -> ComplexArray:
    """Ground pixels (n_y, n_x) of a block under the weights; NaN where it owns none.

    Parameters
    ----------
    correct : callable
        Ground pixels under equal weights, taken from a block at Dopplers that lie higher by so much, Hz.
    ground : GroundMap
    waves : ApertureWaves
    x, y : (n_x,), (n_y,) float
        m.
    """
    image = correct(0.0)
    rows, columns = np.nonzero(np.isfinite(image.real))
    epoch_range = ground.geometry.epoch_range(x[columns], y[rows])
    yaw = ground.middle_yaw + ground.relative_yaw(x[columns], y[rows])
    total = waves.constant(epoch_range, yaw) * image[rows, columns]
    for k, (cosine, sine) in enumerate(waves.pairs, 1):
        share = (cosine(epoch_range, yaw) + 1j * sine(epoch_range, yaw)) / 2
        for sign, factor in ((1, share), (-1, share.conj())):
            shift = sign * k * waves.step
            part = correct(shift)[rows, columns]
            total += factor * np.exp(2j * np.pi * shift * waves.middle) * part
    image[rows, columns] = total
    return image
