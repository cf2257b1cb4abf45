"""Side lobes and width of a sampled response along azimuth."""

from __future__ import annotations

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray

LOBES = 5.0  # widths 1 / dwell on either side of the peak: within are the highest side lobes of all weightings
SAMPLES = 501


def responses(time: FloatArray, *weights: FloatArray | ComplexArray) -> list[FloatArray]:
    """Magnitudes (SAMPLES,) of the sums of `weights` (n,) at times (n,), s, over frequencies about zero."""
    offsets = np.linspace(-LOBES, LOBES, SAMPLES) / _extent(time)
    waves = np.exp(-2j * np.pi * offsets[:, None] * time)
    return [np.abs((waves * weight).sum(axis=1)) for weight in weights]


def side_lobe(response: FloatArray) -> float:
    """Highest side lobe over the peak, dB."""
    peak = int(np.argmax(response))
    left, right = peak, peak
    while left > 0 and response[left - 1] < response[left]:
        left -= 1
    while right < response.size - 1 and response[right + 1] < response[right]:
        right += 1
    side = max(response[:left].max(initial=0.0), response[right + 1 :].max(initial=0.0))
    return float(20 * np.log10(max(side, 1e-12) / response[peak]))


def lobe_width(response: FloatArray, time: FloatArray) -> float:
    """Distance between the outermost crossings of 3 dB below the peak, Hz, of a response over those times."""
    above = np.concatenate([[-1.0], response / response.max() - np.sqrt(0.5), [-1.0]])
    first, last = np.flatnonzero(above >= 0)[[0, -1]]
    left, right = above[first] - above[first - 1], above[last] - above[last + 1]
    samples = float(last - first + above[first] / left + above[last] / right)
    return samples * 2 * LOBES / (SAMPLES - 1) / _extent(time)


def _extent(time: FloatArray) -> float:
    return max(float(np.ptp(time)), 1e-9)
