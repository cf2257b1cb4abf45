"""Sums of the antenna's pattern, times weights, over the lit pulses of pixels: what back-projection divides by."""

from __future__ import annotations

import numpy as np
from numba import njit, types

from blocksar.arrays import FloatArray, IntArray
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import FLAT, Taper
from blocksar.constants import TURN
from blocksar.kernels.loops import loop
from blocksar.kernels.signatures import REAL_ROW, REAL_ROWS

_NONE = np.zeros(1), np.ones(1)  # angles and amplitudes of no pattern
_PULSES = types.Array(types.int64, 2, "C", readonly=True)


def add_gains(
    total: FloatArray,
    geometry: Geometry,
    x: FloatArray,
    y: FloatArray,
    height: FloatArray | None = None,
    *,
    first: IntArray,
    last: IntArray,
    pulses: slice,
    valid: IntArray | FloatArray,
    taper: Taper = FLAT,
) -> None:
    """Add valid[p] w(pixel, p) g(pixel, p) over a block's lit pulses, in place.

    w and g are those of `collection.beam.pulse_weights` and `pattern_gain`.

    Parameters
    ----------
    total : (n_row, n_column) float
    x, y : (n_row, n_column) float
        m, scene frame.
    height : (n_row, n_column) float, optional
        Over the plane z = ground_height, m. None: on it.
    first, last : (n_row, n_column) int
        Lit pulses, of the collection.
    pulses : slice
        The block.
    valid : (n,) int or float
        Number of valid samples of each pulse of the block, or the sum of their weights.
    taper : Taper
        Weighting over a steered beam.
    """
    collection = geometry.collection
    n = pulses.stop - pulses.start
    yaw, azimuth = np.zeros(x.shape), np.zeros(n)
    axis, steering = np.zeros((n, 3)), np.zeros(n)
    if collection.beam_axis is not None and collection.beam_steering is not None:
        axis, steering = collection.beam_axis[pulses], collection.beam_steering[pulses]
    elif collection.beam_pattern is not None or not taper.uniform:
        yaw, azimuth = geometry.yaw(x, y), collection.beam_azimuth[pulses]
    across = (collection.beam_offset, collection.beam_pattern)
    down = (collection.elevation, collection.elevation_pattern)
    tables = [np.array(values) for pair in (across, down) for values in (_NONE if pair[1] is None else pair)]
    antenna = collection.antenna_position[pulses] - np.array([0.0, 0.0, collection.ground_height])
    # Copies: the loop is compiled for one layout of its arrays.
    over = np.zeros(x.shape) if height is None else height
    places = [np.array(values, order="C") for values in (x, y, over, yaw)]
    lit = [np.array(values, np.int64, order="C") for values in (first, last)]
    antenna, sums = np.array(antenna, order="C"), np.array(total, order="C")
    beam = [np.array(values, order="C") for values in (axis, steering, azimuth)]
    terms, frequency = taper.series
    pace = 2 * np.pi * frequency / (collection.beam_width or np.inf)  # of the cosines, per rad off the beam's centre
    _add_gains(
        sums, *places, *lit, antenna, *beam, np.array(valid, np.float64), pulses.start, collection.has_axis,
        *tables, np.array(terms), pace,
    )  # fmt: skip
    total[...] = sums


@njit(inline="always")
def _between(angle, angles, values):  # type: ignore[no-untyped-def]
    """Linear interpolation, constant beyond the ends, as `np.interp`; fast where the angles are about uniform."""
    n = angles.size
    k = int(min(max((angle - angles[0]) / (angles[n - 1] - angles[0]), 0.0), 1.0) * (n - 1))
    k = min(k, n - 2)
    while k > 0 and angles[k] > angle:
        k -= 1
    while k < n - 2 and angles[k + 1] < angle:
        k += 1
    part = min(max((angle - angles[k]) / (angles[k + 1] - angles[k]), 0.0), 1.0)
    return values[k] + part * (values[k + 1] - values[k])


@loop(
    types.float64[:, ::1], *[REAL_ROWS] * 4, *[_PULSES] * 2, *[REAL_ROWS] * 2, *[REAL_ROW] * 3, types.int64,
    types.boolean, *[REAL_ROW] * 5, types.float64, nogil=True,
)  # fmt: skip
def _add_gains(  # type: ignore[no-untyped-def]
    total, x, y, over, yaw, first, last, antenna, axis, steering, azimuth, valid, start, has_axis, offsets, pattern,
    elevations, elevation_pattern, terms, pace,
):  # fmt: skip
    """The sum of `add_gains`; the antenna's heights (n, 3) are above the ground."""
    n = antenna.shape[0]
    for row in range(x.shape[0]):
        for column in range(x.shape[1]):
            for p in range(max(first[row, column] - start, 0), min(last[row, column] - start, n)):
                dx, dy = x[row, column] - antenna[p, 0], y[row, column] - antenna[p, 1]
                height = antenna[p, 2] - over[row, column]
                gain = 1.0
                if pattern.size > 1 or terms.size > 1:
                    if has_axis:
                        along = dx * axis[p, 0] + dy * axis[p, 1] - height * axis[p, 2]
                        offset = np.arcsin(along / np.sqrt(dx * dx + dy * dy + height * height)) - steering[p]
                    else:
                        offset = yaw[row, column] - azimuth[p]
                        offset -= TURN * np.rint(offset / TURN)
                    if pattern.size > 1:
                        gain *= _between(offset, offsets, pattern)
                    cosine = np.cos(pace * offset)
                    after, weight = 0.0, 0.0
                    for k in range(terms.size - 1):  # Clenshaw's recurrence
                        after, weight = weight, terms[terms.size - 1 - k] + 2.0 * cosine * weight - after
                    gain *= terms[0] + cosine * weight - after
                if elevation_pattern.size > 1:
                    down = np.arctan2(height, np.sqrt(dx * dx + dy * dy))
                    gain *= _between(down, elevations, elevation_pattern)
                total[row, column] += valid[p] * gain
