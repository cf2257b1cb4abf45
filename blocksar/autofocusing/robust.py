"""Weights of points: those that move or vibrate by themselves must not steer the estimate."""

from __future__ import annotations

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.autofocusing.chips import Chips
from blocksar.autofocusing.phase_gradient import LEAST_BAND, centred_rows

PARTS = 8  # of a dwell, in each of which a point has one phase
LEAST_PARTS = 3  # of them, not missing: a line goes through two
TOLERANCE = 2.5  # times the median of the points' own phase errors: there the weight is a half
LEAST_TOLERANCE = 0.1  # rad


def own_errors(chips: Chips) -> FloatArray:
    """Phase error (n_point,), rad rms, that each point has for itself after correction.

    From the phases of the strongest line in PARTS parts of the dwell, without their mean and line; those in a gap do
    not count.
    """
    energy = (np.abs(chips.values) ** 2).sum(axis=2, dtype=np.float64)
    strongest = energy.argmax(axis=1)
    values = np.ascontiguousarray(chips.values[np.arange(strongest.size), strongest])
    rows, _ = centred_rows(values, chips.count, LEAST_BAND)
    errors = np.full(strongest.size, np.pi)
    u, told = np.linspace(-1, 1, PARTS), chips.told
    for i, row in enumerate(rows):
        n = int(chips.count[i])
        if n < PARTS or energy[i].max() <= 0:
            continue
        sums = np.array([part.sum(dtype=np.complex128) for part in np.array_split(row[:n], PARTS)])
        there = np.array([part.any() for part in np.array_split(told[i, :n], PARTS)])  # those in a gap have no phase
        sums, at = sums[there], u[there]
        if at.size < LEAST_PARTS:
            continue
        steps = sums[1:] * np.conj(sums[:-1])
        if not there.all():  # a point may turn by more than half a turn over a gap
            apart = np.diff(np.flatnonzero(there))
            steps = steps * np.exp(-1j * apart * np.angle(steps[apart == 1].sum()))
        phase = np.concatenate([[0.0], np.cumsum(np.angle(steps))])
        share = np.abs(sums) ** 2
        share /= share.sum()
        flat = phase - (share * phase).sum()
        line = at - (share * at).sum()
        flat = flat - line * (share * line * flat).sum() / (share * line * line).sum()
        errors[i] = np.sqrt((share * flat * flat).sum())
    return errors


def point_weights(errors: FloatArray) -> FloatArray:
    """Weights (n_point,) of points with phase errors of their own: 1 / (1 + (error / tolerance)^4)."""
    tolerance = max(TOLERANCE * float(np.median(errors)), LEAST_TOLERANCE)
    return np.asarray(1 / (1 + (errors / tolerance) ** 4))
