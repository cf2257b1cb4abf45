"""A small collection as a user has it: arrays of numpy, made from the signal model alone."""

from __future__ import annotations

from typing import Any

import numpy as np

SPEED_OF_LIGHT = 299792458.0
TARGETS = [
    {"name": "A", "x": 0.0, "y": 0.0},
    {"name": "B", "x": 30.0, "y": 12.0},
    {"name": "C", "x": -25.0, "y": -10.0},
]
GRID = ((-45.0, 45.0, 0.5), (-25.0, 25.0, 0.5))


def arrays(n_pulse: int = 400, n_frequency: int = 96, *, steered: bool = True) -> dict[str, Any]:
    """Arguments of `blocksar.collection`: three targets seen broadside from 10 km at 10 GHz with 96 MHz."""
    time = (np.arange(n_pulse) - n_pulse // 2) / 800.0
    frequency = (np.arange(n_frequency) - n_frequency // 2) * 1e6
    track = np.stack([np.full(n_pulse, -9000.0), 150 * time, np.full(n_pulse, 4400.0)], axis=1)
    reference, beam, width = float(np.hypot(9000.0, 4400.0)), 0.10 * time, 0.02
    signal = np.zeros((n_pulse, n_frequency), complex)
    for target in TARGETS:
        distance = np.linalg.norm(track - [target["x"], target["y"], 0.0], axis=1) - reference
        echo = np.exp(-4j * np.pi / SPEED_OF_LIGHT * np.outer(distance, 10e9 + frequency))
        yaw = np.arctan2(target["y"], target["x"] + 9000.0)
        signal += echo * (abs(yaw - beam) <= width / 2)[:, None] if steered else echo
    return {
        "signal": signal, "time": time, "range_frequency": frequency, "antenna_position": track,
        "reference_range": reference, "carrier_frequency": 10e9, "title": "three targets", "targets": TARGETS,
        **({"beam_azimuth": beam, "beam_width": width} if steered else {}),
    }  # fmt: skip
