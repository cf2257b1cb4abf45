"""What an image is: back-projection as its definition has it, which all processors and tests are judged by.

For reading, and for comparison with small images: it takes a second for a million pulses, frequencies and pixels each.

Examples
--------
A target of reflectivity 1 has the value 1 at its place; 5 m away are its side lobes:

>>> import numpy as np
>>> track = np.stack([np.full(64, -5e3), np.linspace(-100, 100, 64), np.full(64, 4e3)], axis=1)
>>> frequency = np.linspace(-30e6, 30e6, 32)
>>> reference = np.linalg.norm(track, axis=1)
>>> away = np.linalg.norm(track - [3.0, 4.0, 0.0], axis=1)
>>> signal = np.exp(-4j * np.pi / SPEED_OF_LIGHT * np.outer(away - reference, 10e9 + frequency))
>>> image = back_project(signal, track, 10e9 + frequency, reference, np.array([[3.0, 4.0, 0.0], [8.0, 4.0, 0.0]]))
>>> [round(float(abs(value)), 2) for value in image]
[1.0, 0.19]
"""

from __future__ import annotations

import numpy as np

from blocksar.arrays import BoolArray, Complex128Array, ComplexArray, FloatArray
from blocksar.constants import SPEED_OF_LIGHT


def back_project(
    signal: ComplexArray | Complex128Array,
    antenna: FloatArray,
    frequency: FloatArray,
    reference_range: FloatArray,
    points: FloatArray,
    *,
    lit: BoolArray | None = None,
    weights: FloatArray | None = None,
) -> Complex128Array:
    """Average samples over pulses p and frequencies f, with the phase of the way from a point and back taken out.

        image(x) = sum_pf w(x, p, f) signal(p, f) exp(+4j pi f / c (|x - antenna(p)| - reference_range(p))) / sum_pf w

    The sums have the pulses that light x, and the samples that are not NaN.

    Parameters
    ----------
    signal : (n_pulse, n_frequency) complex
        NaN where missing.
    antenna : (n_pulse, 3) float
        Phase centres, m.
    frequency : (n_frequency,) float
        Carrier and range frequency, Hz.
    reference_range : (n_pulse,) float
        Range whose phase is removed from the samples, m.
    points : (n, 3) float
        m
    lit : (n, n_pulse) bool, optional
        Which pulses light a point. Default: all.
    weights : (n, n_pulse, n_frequency) float, or what is broadcast to that, optional
        Default: 1.

    Returns
    -------
    (n,) complex
        NaN where nothing lights a point.

    Notes
    -----
    The definition of the stores' page; the phases of equation (1) of the angular-division paper, with exact ranges.
    """
    image, samples, shape = np.empty(len(points), np.complex128), np.nan_to_num(signal), (len(points), *signal.shape)
    lights = np.broadcast_to(1.0 if lit is None else lit[:, :, None], shape)
    tapers = np.broadcast_to(1.0 if weights is None else weights, shape)
    for number, point in enumerate(points):
        away = np.linalg.norm(point - antenna, axis=1) - reference_range
        turn = np.exp(4j * np.pi / SPEED_OF_LIGHT * np.outer(away, frequency))
        weight = np.isfinite(signal) * lights[number] * tapers[number]
        image[number] = (weight * samples * turn).sum() / weight.sum() if weight.any() else np.nan
    return image
