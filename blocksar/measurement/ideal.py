"""The ideal response of a point target, summed pulse by pulse."""

from __future__ import annotations

import numpy as np
from scipy.special import diric

from blocksar.arrays import BoolArray, FloatArray
from blocksar.collection.beam import is_lit, pattern_gain
from blocksar.collection.geometry import Geometry
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.measurement.response import Complex128Array
from blocksar.measurement.targets import Target


def ideal_response(geometry: Geometry, target: Target, x: FloatArray, y: FloatArray) -> Complex128Array:
    """The exact back-projection of one target's noise-free signal at ground points (n,), m.

    The mean over a pixel's lit pulses and all range frequencies of
    sigma exp(4j pi (fc + f)/c (R_p - R_q)); the sum over the uniform range frequencies has a closed form. This is
    the reference for one isolated target, including side lobes and carrier phase. With antenna patterns the sum is
    weighted by that of the target, and divided by the sum of the pixel's. NaN where a pixel is never lit.
    """
    collection = geometry.collection
    x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    point = np.stack([x, y, np.full(x.shape, collection.ground_height)], axis=-1)[:, None, :]
    origin = np.array([target.x, target.y, collection.ground_height])
    middle = collection.carrier + float(collection.range_frequency[0] + collection.range_frequency[-1]) / 2
    total, count = np.zeros(x.shape, dtype=np.complex128), np.zeros(x.shape)
    for first in range(0, collection.n_pulse, 64):
        pulses = slice(first, first + 64)
        time = collection.time[pulses]
        of_pixel = is_lit(geometry, x, y, pulses)
        at_target = np.array([target.x]), np.array([target.y])
        lit: BoolArray | FloatArray = of_pixel & is_lit(geometry, *at_target, pulses)
        if collection.has_pattern:
            count += (of_pixel * pattern_gain(geometry, x[:, None], y[:, None], pulses)).sum(axis=1)
            lit = lit * pattern_gain(geometry, *at_target, pulses)
        else:
            count += of_pixel.sum(axis=1)
        if not lit.any():
            continue
        delay = (geometry.range_history(point, time)[0] - geometry.range_history(origin, time)[0]) * 2 / SPEED_OF_LIGHT
        comb = diric(2 * np.pi * collection.range_frequency_step * delay, collection.n_range_frequency)
        total += (lit * comb * np.exp(2j * np.pi * middle * delay)).sum(axis=1)
    with np.errstate(invalid="ignore"):
        return np.asarray(target.reflectivity * total / count)
