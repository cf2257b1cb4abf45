"""The ideal response of a point target, summed pulse by pulse."""

from __future__ import annotations

import numpy as np
from scipy.special import diric

from blocksar.arrays import Complex128Array, FloatArray
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import UNIFORM, Taper, Weighting
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.measurement.targets import Target


def summed_response(
    geometry: Geometry, target: Target, x: FloatArray, y: FloatArray, weighting: Weighting = UNIFORM
) -> Complex128Array:
    """The exact back-projection of one target's noise-free signal at ground points (n,), m.

    The mean over a pixel's lit pulses and all range frequencies of
    sigma exp(4j pi (fc + f)/c (R_p - R_q)); the sum over the uniform range frequencies has a closed form. This is
    the reference for one isolated target, including side lobes and carrier phase. Under a weighting both sums have its
    weights. With antenna patterns the first is weighted by that of the target besides, and the second by that of the
    pixel. NaN where a pixel is never lit.
    """
    collection = geometry.collection
    x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    point = geometry.on_ground(x, y)[:, None, :]
    origin = geometry.on_ground(np.array(target.x), np.array(target.y))
    if target.z is not None:
        origin[2] = target.z
    middle = collection.carrier + float(collection.range_frequency[0] + collection.range_frequency[-1]) / 2
    total, count = np.zeros(x.shape, dtype=np.complex128), np.zeros(x.shape)
    for first in range(0, collection.n_pulse, 64):
        pulses = slice(first, first + 64)
        time = collection.time[pulses]
        of_pixel = geometry.beam.is_lit(x, y, pulses)
        at_target = np.array([target.x]), np.array([target.y])
        weights = of_pixel * geometry.beam.weights(x[:, None], y[:, None], pulses, weighting.azimuth)
        lit = weights * geometry.beam.is_lit(*at_target, pulses, origin[2:])
        if collection.has_pattern:
            weights = weights * geometry.beam.gain(x[:, None], y[:, None], pulses)
            lit = lit * geometry.beam.gain(*at_target, pulses, origin[2:])
        count += weights.sum(axis=1)
        if not lit.any():
            continue
        delay = (geometry.range_history(point, time)[0] - geometry.range_history(origin, time)[0]) * 2 / SPEED_OF_LIGHT
        comb = band_response(delay * collection.range_frequency_step, collection.n_range_frequency, weighting.range)
        total += (lit * comb * np.exp(2j * np.pi * middle * delay)).sum(axis=1)
    with np.errstate(invalid="ignore"):
        return np.asarray(target.reflectivity * total / count)


def band_response(turns: FloatArray, n: int, taper: Taper) -> FloatArray:
    """Weighted mean of exp(2j pi turns (k - (n - 1) / 2)) over k < n: each cosine of the taper shifts a comb twice."""
    terms, frequency = taper.series
    shifts = np.arange(terms.size) * frequency / n
    combs = [diric(2 * np.pi * (turns + s), n) + diric(2 * np.pi * (turns - s), n) for s in shifts]
    return np.asarray(sum(term * comb for term, comb in zip(terms / 2, combs, strict=True)) / taper.samples(n).mean())
