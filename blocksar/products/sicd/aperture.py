"""The aperture of scene points: lit times, lines of sight and spatial frequencies."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.collection.beam import dwell, dwell_weight
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import UNIFORM, Weighting
from blocksar.constants import SPEED_OF_LIGHT


def lit_times(geometry: Geometry, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """First and last lit slow time, s, of points (..., 3)."""
    first, last = dwell(geometry, points[..., 0], points[..., 1])
    return first, last


def centre_time(geometry: Geometry, point: FloatArray) -> float:
    """Slow time, s, of a point's (3,) centre of aperture, clipped to the collection; the epoch if it is never lit."""
    first, last = (float(t) for t in lit_times(geometry, point))
    time = geometry.collection.time
    return float(np.clip((first + last) / 2, time[0], time[-1])) if first < last else geometry.epoch


def lines_of_sight(geometry: Geometry, points: FloatArray, time: FloatArray) -> FloatArray:
    """Unit vectors (..., 3) from the antenna at slow times (...) to points (..., 3)."""
    sight = points - geometry.track.position(time)
    return np.asarray(sight / np.linalg.norm(sight, axis=-1, keepdims=True))


class Support(NamedTuple):
    """Spatial frequencies that the aperture measures of a target, and their weights.

    Attributes
    ----------
    frequencies : (n, 2) float
        K in x and y, cycles/m, at samples of range frequency and slow time.
    weights : (n,) float
        Those with which the image sums them: the weighting, and the antenna's pattern, which is in the samples.
    dwell : float
        Lit time of the target, s.
    """

    frequencies: FloatArray
    weights: FloatArray
    dwell: float


def find_support(geometry: Geometry, scp: FloatArray, weighting: Weighting = UNIFORM) -> Support:
    """Support of a target at the scene centre point (3,); over the whole collection if it is never lit."""
    first, last = (float(t) for t in lit_times(geometry, scp))
    collection = geometry.collection
    if not first < last:
        first, last = float(collection.time[0]), float(collection.time[-1])
    time = np.linspace(first, last, 129)
    sight = lines_of_sight(geometry, scp, time)
    half = collection.range_frequency[-1] + (collection.range_frequency[1] - collection.range_frequency[0]) / 2
    frequency = collection.carrier + np.linspace(-half, half, 65)
    over_dwell = np.broadcast_to(dwell_weight(geometry, scp[0], scp[1], time, weighting.azimuth), time.shape)
    if not over_dwell.any():  # at a zero of the antenna's pattern
        over_dwell = np.ones(time.shape)
    weights = np.multiply.outer(weighting.range(np.linspace(-1, 1, 65)), over_dwell)
    return Support(
        2 / SPEED_OF_LIGHT * np.multiply.outer(frequency, sight[:, :2]).reshape(-1, 2), weights.ravel(), last - first
    )


def cut_width(frequency: FloatArray, weights: FloatArray) -> float:
    """-3 dB width, m, of |mean exp(2j pi K d)| over the offset d, for frequencies K (n,), cycles/m, with weights."""
    frequency = frequency - frequency.mean()
    share = weights / weights.sum()
    half = 0.5 / np.ptp(frequency)

    def power_at(offset: float) -> float:
        return float(np.abs((share * np.exp(2j * np.pi * frequency * offset)).sum()) ** 2)

    low, high = 0.0, half
    while power_at(high) > 0.5:
        low, high = high, 1.5 * high
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if power_at(middle) > 0.5 else (low, middle)
    return 2 * low


def cut_weights(frequency: FloatArray, weights: FloatArray, count: int) -> FloatArray:
    """The weighting of a cut, (count,), at most 1: weights of frequencies (n,) summed over equal parts of the band.

    Each frequency is spread over the width of a part, so that the samples do not show as ripple.
    """
    low, high = float(frequency.min()), float(frequency.max())
    edges = np.linspace(low, high, count + 1)
    part = (high - low) / count
    order = np.argsort(frequency)
    along, running = frequency[order], np.cumsum(weights[order])
    # The running sum, smoothed over a part by its integral, has the weights as differences.
    integral = np.concatenate([[0.0], np.cumsum(running[:-1] * np.diff(along))])

    def below(at: FloatArray) -> FloatArray:
        inside = np.interp(at, along, integral)
        return np.asarray(inside + np.maximum(at - high, 0.0) * running[-1])

    smooth = (below(edges + part / 2) - below(edges - part / 2)) / part
    summed = np.diff(smooth)
    return np.asarray(np.clip(summed / summed.max(), 0.0, 1.0))
