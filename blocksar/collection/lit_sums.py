"""Numbers and weighted sums of the pulses that light ground points."""

from __future__ import annotations

import math

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.collection.beam import (
    EDGE,
    aperture,
    dwell,
    dwell_at,
    pattern_gain,
    pulse_weights,
    wrapped,
    yaw_interval,
)
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import FLAT, Taper

GAIN_PARTS = 32  # of a dwell, in each of which weights and the antenna's pattern are taken as constant


def lit_pulses(collection: Collection, yaw: FloatArray, valid: FloatArray) -> FloatArray:
    """Number of valid pulses that light points at yaws (n,): sum of `valid` (n_pulse,) over the lit ones.

    `valid` is the fraction of each pulse's samples that is there; 0 for a missing pulse. Yaws on the edge of the beam
    but for rounding (`EDGE`) are lit.
    """
    total = np.concatenate([[0.0], np.cumsum(valid)])
    first, last = yaw_interval(collection, yaw, tolerance=EDGE)
    return np.asarray(total[last] - total[first])


def weighted_pulses(collection: Collection, yaw: FloatArray, valid: FloatArray, taper: Taper) -> FloatArray:
    """Sum of `valid` (n_pulse,) times the taper over the pulses that light points at yaws (n,); see `lit_pulses`."""
    if taper.uniform:
        return lit_pulses(collection, yaw, valid)
    if collection.beam_width is None:
        return np.full(yaw.shape, float((valid * taper.samples(collection.n_pulse)).sum()))
    first, last = yaw_interval(collection, yaw, tolerance=EDGE)
    beam, half = collection.beam_azimuth, collection.beam_width / 2
    middle = float(beam[0] + beam[-1]) / 2
    point, along = wrapped(yaw - middle) / half, (beam - middle) / half
    # Each cosine of the difference is a product of two phasors, so that one running sum serves all points.
    total, (terms, frequency) = np.zeros(yaw.shape), taper.series
    for k, term in enumerate(terms):
        running = np.concatenate([[0.0], np.cumsum(valid * np.exp(-1j * np.pi * frequency * k * along))])
        total += term * (np.exp(1j * np.pi * frequency * k * point) * (running[last] - running[first])).real
    return total


def most_lit_pulses(geometry: Geometry, x: FloatArray, y: FloatArray) -> int:
    """The largest number of pulses that light any one point; under a beam about its axis, any of those at x, y, m."""
    collection = geometry.collection
    if collection.has_axis:
        first, last = dwell(geometry, x, y)
        lasts = (last - first)[np.isfinite(last - first)]  # elsewhere the terrain has no height
        return math.ceil(float(lasts.max(initial=0.0)) * collection.prf)
    return int(lit_pulses(collection, collection.beam_azimuth, np.ones(collection.n_pulse)).max())


def lit_total(
    geometry: Geometry,
    epoch_range: FloatArray,
    yaw: FloatArray,
    valid: FloatArray,
    taper: Taper = FLAT,
) -> FloatArray:
    """Sum of `valid` (n_pulse,) times taper and antenna's pattern over lit pulses: (n_range, n_yaw), at (n,) m and rad.

    Dwells begin and end between pulses here, so that the sum is continuous.
    """
    collection = geometry.collection
    shape = epoch_range.size, yaw.size
    start, _ = aperture(collection)
    first, last = dwell_at(geometry, yaw, epoch_range[:, None])
    begin, stop = (np.broadcast_to(np.clip((t - start) * collection.prf, 0, None), shape) for t in (first, last))
    before, pulse = np.concatenate([[0.0], np.cumsum(valid)]), np.arange(valid.size + 1.0)
    x, y = geometry.ground_axes(epoch_range[:, None], yaw)
    z = geometry.level(epoch_range[:, None], yaw)
    weighed = collection.has_pattern or not taper.uniform
    parts, total = GAIN_PARTS if weighed else 1, np.zeros(shape)
    for part in range(parts):
        low, high = (begin + (stop - begin) * (part + k) / parts for k in (0, 1))
        count = np.interp(high, pulse, before) - np.interp(low, pulse, before)
        if weighed:
            middle = np.clip((low + high) / 2, 0, valid.size - 1).astype(np.int64)
            weight = pulse_weights(geometry, x, y, middle, taper, z)
            count = count * weight * pattern_gain(geometry, x, y, middle, z)
        total += count
    return np.asarray(np.where((last > first) & np.isfinite(x), np.maximum(total, 0.0), 0.0))
