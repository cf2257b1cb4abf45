"""A raw echo of targets over the whole swath, near both ends of which only parts of pulses are recorded."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

SPEED_OF_LIGHT = 299792458.0
CARRIER, RATE, PULSE, SAMPLING, PRF = 10e9, 10e12, 5e-6, 60e6, 400.0  # 50 MHz, of which a pulse has 250 cycles
N_TIME, N_PULSE = 1024, 192
RANGE, HEIGHT, SPEED = 10e3, 5e3, 100.0
HALF = N_TIME / SAMPLING * SPEED_OF_LIGHT / 4  # of the window, m of slant range
LENGTH = PULSE * SPEED_OF_LIGHT / 2  # of the pulse
TIME = (np.arange(N_PULSE) - N_PULSE // 2) / PRF
NADIR = -np.sqrt(RANGE**2 - HEIGHT**2)
TRACK = np.stack([np.full(N_PULSE, NADIR), SPEED * TIME, np.full(N_PULSE, HEIGHT)], axis=1)
FAST_TIME = 2 * RANGE / SPEED_OF_LIGHT + (np.arange(N_TIME) - N_TIME // 2) / SAMPLING
STEP = 2.0  # m: targets lie on whole multiples


class Target(NamedTuple):
    """A target of reflectivity 1, and the part of its pulses that is recorded."""

    x: float
    y: float
    part: float


def ground(slant: float) -> float:
    """x of the ground at a slant range, m."""
    return float(NADIR + np.sqrt(slant**2 - HEIGHT**2))


def slant(x: float) -> float:
    return float(np.hypot(x - NADIR, HEIGHT))


def part_of(x: float) -> float:
    """The recorded part of pulses from x: the overlap of two intervals of ranges, over the length of the pulse."""
    first, last = max(slant(x) - LENGTH / 2, RANGE - HALF), min(slant(x) + LENGTH / 2, RANGE + HALF)
    return max(last - first, 0.0) / LENGTH


def target_with(part: float, side: int, y: float) -> Target:
    """A target at the near (-1) or far (1) end of the swath, with about this part of its pulses recorded."""
    x = STEP * round(ground(RANGE + side * (HALF - (part - 0.5) * LENGTH)) / STEP)
    return Target(x, y, min(part_of(x), 1.0))


TARGETS = (
    Target(0.0, 0.0, 1.0), target_with(0.5, -1, 4.0), target_with(0.6, 1, -6.0), target_with(0.3, 1, 10.0),
    target_with(0.28, -1, -12.0),
)  # fmt: skip


def echo_of(targets: tuple[Target, ...], *, rate: float = RATE) -> NDArray[np.complex64]:
    """By the definition in the store's page."""
    echo = np.zeros((N_PULSE, N_TIME), np.complex128)
    for x, y, _ in targets:
        away = np.linalg.norm(TRACK - [x, y, 0.0], axis=1)[:, None]
        delay = FAST_TIME - 2 * away / SPEED_OF_LIGHT
        phase = np.pi * rate * delay**2 - 4 * np.pi * CARRIER / SPEED_OF_LIGHT * (away - RANGE)
        echo += np.where(np.abs(delay) <= PULSE / 2, np.exp(1j * phase), 0)
    return echo.astype(np.complex64)


def strip(targets: tuple[Target, ...] = TARGETS, *, rate: float = RATE, **more: Any) -> dict[str, Any]:
    """Arguments of `blocksar.collection`."""
    return {
        "echo": echo_of(targets, rate=rate), "fast_time": FAST_TIME, "chirp_rate": rate, "pulse_width": PULSE,
        "time": TIME, "antenna_position": TRACK, "reference_range": RANGE, "carrier_frequency": CARRIER, **more,
    }  # fmt: skip
