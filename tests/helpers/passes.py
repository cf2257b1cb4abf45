"""Two passes over one scene of scatterers, focused exactly on one grid."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import blocksar
from blocksar.collection.collection import Collection
from blocksar.simulation.scatterers import field, phase_history

CARRIER = 9.6e9
N = 96  # pulses
GRID = ((-40.0, 40.0, 0.6), (-36.0, 36.0, 0.6))
SCENE = 46.0  # half of the side of the ground that has clutter, m


class Points(NamedTuple):
    """Scatterers (n,): places, m, and reflectivities."""

    x: Any
    y: Any
    z: Any
    reflectivity: Any


def points(*places: tuple[float, float, float], reflectivity: complex = 1.0) -> Points:
    x, y, z = np.array(places, np.float64).T
    return Points(x, y, z, np.full(x.size, reflectivity))


def clutter(seed: int, *, power: float = 1.0, places: int = 7) -> Points:
    """White clutter: the same `places` give the same places, the seeds independent reflectivities."""
    random, drawn = np.random.default_rng(places), np.random.default_rng(seed)
    n = 12 * int(SCENE) ** 2
    x, y = random.uniform(-SCENE, SCENE, (2, n))
    values = drawn.normal(size=(2, n)) * np.sqrt(power / 2 / 3)  # three of them in a square metre
    return Points(x, y, np.zeros(n), values[0] + 1j * values[1])


def together(*parts: Points) -> Points:
    return Points(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def flight(offset: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Collection:
    """A squinted pass, displaced as a whole; 4.9 km from the scene, resolution about 1.2 m x 1.4 m."""
    time = (np.arange(N) - N // 2) / 60.0
    track = np.array([-3800.0, -700.0, 3000.0]) + time[:, None] * np.array([6.0, 33.0, -1.5]) + np.array(offset)
    return Collection(
        carrier=CARRIER, time=time, range_frequency=(np.arange(96) - 48) * 1.6e6,
        reference_range=np.linalg.norm(track, axis=1), antenna_position=track,
        beam_azimuth=np.full(N, np.nan), beam_width=None,
    )  # fmt: skip


def fly(scene: Points, offset: tuple[float, float, float] = (0.0, 0.0, 0.0), **more: Any) -> Any:
    """The phase history of a scene from a pass, as `blocksar.collection` builds it."""
    pass_ = flight(offset)
    scatterers = field(pass_, scene.x, scene.y, scene.reflectivity, scene.z)
    signal = phase_history(scatterers, pulses=slice(0, N), threads=2)
    noise = more.pop("noise", None)
    if noise is not None:
        random = np.random.default_rng(more.pop("seed"))
        signal = signal + np.sqrt(noise / 2) * (random.normal(size=(2, *signal.shape)).T @ [1, 1j]).T
        more["noise_power"] = noise
    return blocksar.collection(
        signal=signal.astype(np.complex64), time=pass_.time, range_frequency=pass_.range_frequency,
        reference_range=pass_.reference_range, antenna_position=pass_.antenna_position, carrier_frequency=CARRIER,
        **more,
    )  # fmt: skip


def focus(history: Any, out: Path, **settings: Any) -> Path:
    blocksar.focus(
        history, out, **{"grid": GRID, "processor": "backprojection", "workers": 0, "progress": False} | settings
    )
    return out
