"""A small spotlight collection with bright points, and one whose stated track is wrong."""

from __future__ import annotations

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray, IntArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.simulation.scatterers import simulate_pulses

CENTRE = np.array([6000.0, 0.0, 0.0])  # m
SIZE = 130.0  # m, of the square with points
GRID = Grid(CENTRE[0] - SIZE / 2, CENTRE[0] + SIZE / 2, 0.5, -SIZE / 2, SIZE / 2, 0.5)


def spotlight(*, n_pulse: int = 512) -> Collection:
    """A collection at 2 cm, as its navigation states it."""
    prf, n_frequency = 400.0, 168
    time = (np.arange(n_pulse) - n_pulse // 2) / prf
    position = np.stack([2 * time, 120 * time + 0.4 * time**2, 3000 - 3 * time - time**2], axis=1)
    return Collection(
        carrier=15e9,
        time=time,
        range_frequency=(np.arange(n_frequency) - n_frequency // 2) * 0.72e6,
        reference_range=np.linalg.norm(CENTRE - position, axis=1),
        antenna_position=position,
        beam_azimuth=np.full(n_pulse, np.nan),
    )


def error(time: FloatArray) -> FloatArray:
    """Where the antenna really was, less where it is stated to be, (n, 3), m."""
    u = time / np.abs(time).max()
    return np.stack(
        [
            0.02 * u**2 + 0.004 * np.sin(2 * np.pi * 2 * time),
            0.03 * u**2 + 0.01 * np.sin(2 * np.pi * time),
            0.05 * u**2 + 0.006 * np.sin(2 * np.pi * 3 * time + 1),
        ],
        axis=1,
    )


def echoes(stated: Collection, displacement: FloatArray, *, points: int = 120, seed: int = 1) -> ComplexArray:
    """Samples of points, as taken along the track that differs from the stated one by a displacement (n_pulse, 3)."""
    random = np.random.default_rng(seed)
    x, y = CENTRE[0] + random.uniform(-SIZE / 2, SIZE / 2, points), random.uniform(-SIZE / 2, SIZE / 2, points)
    amplitude = 10 ** (random.uniform(-10, 10, points) / 20) * np.exp(2j * np.pi * random.uniform(size=points))
    true = Collection(**{**stated.as_dict(), "antenna_position": stated.antenna_position + displacement})
    signal = simulate_pulses(true, x, y, amplitude)
    signal.flags.writeable = False
    return signal


def residual_phase(
    geometry: Geometry, wrong: FloatArray, places: FloatArray, pulses: IntArray | None = None
) -> FloatArray:
    """Phase that a wrong position (n_pulse, 3), m, leaves at places (n, 2): rms less a constant and the best shift.

    Of all pulses, or of some.
    """
    collection = geometry.collection
    at = np.arange(collection.n_pulse) if pulses is None else pulses
    wavenumber = 4 * np.pi / collection.wavelength
    left = []
    for x, y in places:
        sight = np.array([x, y, collection.ground_height]) - collection.antenna_position[at]
        sight /= np.linalg.norm(sight, axis=1, keepdims=True)
        terms = np.stack([np.ones(at.size), sight[:, 0], sight[:, 1]], axis=1)
        basis, _ = np.linalg.qr(terms)
        phase = wavenumber * (sight * wrong[at]).sum(axis=1)
        left.append(np.sqrt(np.mean((phase - basis @ (basis.T @ phase)) ** 2)))
    return np.array(left)
