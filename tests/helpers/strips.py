"""Long strips of a fixed beam about the antenna's axis, many dwells long, close by."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from blocksar import stores
from blocksar.collection.collection import Collection
from blocksar.collection.grid import Grid
from blocksar.simulation.scatterers import simulate_pulses

DISTANCE = float(np.sqrt(1000.0**2 - 400.0**2))  # m, of ground at the reference range from the track
TIME_ZERO = 100.0  # s, from the start of the collection to slow time 0
CLUTTER_STEP = 2.0  # m along the strip between scatterers, on average


def strip_collection(duration: float, *, prf: float = 2000.0, curve: float = 0.5) -> Collection:
    """A pass along y at 200 m/s, 400 m high, with dwells of 0.15 s; `curve` is its acceleration across, m/s^2."""
    n, n_frequency = round(duration * prf), 64
    time = (np.arange(n) - n // 2) / prf
    track = np.stack([curve * time**2 / 2, 200 * time, np.full(n, 400.0)], axis=1)
    velocity = np.gradient(track, time, axis=0)
    return Collection(
        carrier=9.6e9,
        time=time,
        range_frequency=(np.arange(n_frequency) - n_frequency // 2) * 1e6,
        reference_range=np.full(n, 1000.0),
        antenna_position=track,
        beam_azimuth=np.full(n, np.nan),
        beam_width=0.03,
        beam_axis=velocity / np.linalg.norm(velocity, axis=1, keepdims=True),
        beam_steering=np.zeros(n),
        title="strip",
    )


def write_strip(folder: Path, collection: Collection, grid: Grid) -> Path:
    """Store the phase history of clutter in and around a grid."""
    rng = np.random.default_rng(7)
    n = round((grid.y1 - grid.y0 + 60) / CLUTTER_STEP) * 8
    x, y = rng.uniform(grid.x0 - 10, grid.x1 + 10, n), rng.uniform(grid.y0 - 30, grid.y1 + 30, n)
    sigma = rng.standard_normal(n) + 1j * rng.standard_normal(n)
    path = folder / "strip.zarr"
    stores.create_phase_history(path, collection, attrs={"source": {"time_zero": TIME_ZERO}})
    for first in range(0, collection.n_pulse, 1024):
        pulses = slice(first, min(first + 1024, collection.n_pulse))
        signal = simulate_pulses(collection, x, y, sigma, pulses=pulses, threads=1)
        stores.write_region(path, "signal", (pulses, slice(0, signal.shape[1])), signal)
    return path
