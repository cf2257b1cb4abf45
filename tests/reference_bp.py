"""The slow twin of back-projection: the contract's formula, pixel by pixel and pulse by pulse, in float64."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry


def back_projection(
    collection: Collection, signal: NDArray[Any], x: NDArray[Any], y: NDArray[Any]
) -> NDArray[np.complex128]:
    """Mean over lit pulses and all frequencies of signal exp(+4j pi (fc + f) / c (R - reference_range)).

    NaN samples are left out of the mean. The image is NaN where nothing valid is lit, or where a lit pulse sees the
    pixel outside |R - reference_range| <= c / (4 df).

    Parameters
    ----------
    collection : Collection
    signal : (n_pulse, n_range_frequency) complex
    x, y : (...) float
        m, of one shape.

    Returns
    -------
    (...) complex128
    """
    light = 299_792_458.0
    frequency = collection.carrier + collection.range_frequency
    half_window = light / (4 * collection.range_frequency_step)
    theta = Geometry(collection=collection).yaw(x, y)
    image = np.empty(x.shape, np.complex128)
    for pixel in np.ndindex(x.shape):
        total, count, outside = 0j, 0, False
        for pulse in range(collection.n_pulse):
            if collection.beam_width is not None:
                away = theta[pixel] - collection.beam_azimuth[pulse]
                away = away - 2 * np.pi * np.rint(away / (2 * np.pi))
                if not abs(away) <= collection.beam_width / 2:
                    continue
            point = np.array([x[pixel], y[pixel], collection.ground_height])
            distance = np.linalg.norm(point - collection.antenna_position[pulse])
            distance -= collection.reference_range[pulse]
            outside = outside or abs(distance) > half_window
            terms = signal[pulse] * np.exp(4j * np.pi * frequency / light * distance)
            valid = ~np.isnan(terms)
            total += terms[valid].sum()
            count += np.count_nonzero(valid)
        image[pixel] = total / count if count and not outside else np.nan
    return image
