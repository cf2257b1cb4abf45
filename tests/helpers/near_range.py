"""A rail radar as a user has it: arrays of numpy, made from the signal model alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

SPEED_OF_LIGHT = 299792458.0
CARRIER, BANDWIDTH = 10e9, 2e9  # Hz
RANGE = 8.0  # m, removed
TARGETS = [(0.0, 0.0, 0.0), (-0.8, 0.5, 0.0), (0.6, -0.6, 0.0)]


def near_range(
    n_pulse: int = 300,
    n_frequency: int = 256,
    *,
    track: Any = None,
    targets: Sequence[tuple[float, float, float]] = TARGETS,
) -> dict[str, Any]:
    """Arguments of `blocksar.collection`: targets of 1 seen from 8 m, over a rail of 1 m or a track (n_pulse, 3)."""
    if track is None:
        along = np.linspace(-0.5, 0.5, n_pulse)
        track = np.stack([np.full(n_pulse, -7.9), along, np.full(n_pulse, 1.2)], axis=1)
    frequency = (np.arange(n_frequency) - n_frequency // 2) * BANDWIDTH / n_frequency
    signal = np.zeros((len(track), n_frequency), complex)
    for target in targets:
        distance = np.linalg.norm(track - target, axis=1) - RANGE
        signal += np.exp(-4j * np.pi / SPEED_OF_LIGHT * np.outer(distance, CARRIER + frequency))
    return {
        "signal": signal, "time": (np.arange(len(track)) - len(track) // 2) / 100.0, "range_frequency": frequency,
        "antenna_position": track, "reference_range": RANGE, "carrier_frequency": CARRIER,
    }  # fmt: skip
