"""What more than one test file needs."""

from __future__ import annotations

import numpy as np
import pytest

from blocksar.collection.collection import Collection


@pytest.fixture(scope="session")
def small_collection() -> Collection:
    """A squint-TOPS collection in small: the beam scans from 48 to 52 degrees while the aircraft flies 13 m."""
    n_pulse, n_frequency, prf = 256, 128, 4000.0
    time = (np.arange(n_pulse) - n_pulse // 2) / prf  # s
    track = np.stack([200 * time, 3 * time + 2 * time**2, 5000 - 10 * time], axis=1)  # m
    return Collection(
        carrier=9.6e9,
        time=time,
        range_frequency=(np.arange(n_frequency) - n_frequency // 2) * 400e3,  # Hz
        reference_range=np.full(n_pulse, 12_000.0),
        antenna_position=track,
        beam_azimuth=np.radians(50) + 1.0 * time,
        beam_width=0.02,
        ground_height=0.0,
        title="small squint-TOPS collection",
    )
