"""A small spotlight scene whose track is wrong by centimetres, and what a correction leaves of the error."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import blocksar
from blocksar import stores
from blocksar.arrays import FloatArray
from blocksar.collection.collection import Collection
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.simulation.simulate import truth_place

GRID = ((-75.0, 75.0, 0.75), (-75.0, 75.0, 0.75))
SCENE = """
title = "small spotlight"
[radar]
carrier = 10e9
bandwidth = 120e6
range_sampling = 144e6
prf = 200
pulse_width = 2e-6
[track]
position = [-4000.0, 0.0, 3000.0]
velocity = [0.0, 100.0, 0.0]
[time]
pulses = 800
[scene]
swath = [4930.0, 5070.0]
centre_yaw_deg = 0.0
reference_range = "scene_centre"
"""
ERROR = """
[track.error]
drift = [0.05, 0.04, -0.05]
[[track.error.oscillation]]
amplitude = [0.006, 0.0, 0.008]
frequency = 0.7
"""


def targets(count: int = 30, seed: int = 1) -> str:
    """Point targets at random places."""
    places = np.random.default_rng(seed).uniform(-60, 60, (count, 2))
    return "".join(f'[[targets]]\nname = "P{i}"\nx = {x:.3f}\ny = {y:.3f}\n' for i, (x, y) in enumerate(places))


def make(folder: Path, text: str = "", *, raw: bool = False, error: str = ERROR, top: str = "") -> Path:
    """Simulate the scene with more tables, and lines on top, into folder/ph.zarr."""
    (folder / "scene.toml").write_text(top + SCENE + error + (text or targets()))
    return Path(blocksar.simulate(folder / "scene.toml", folder / "ph.zarr", raw=raw))


def phase_errors(store: Path | Collection, truth: Path) -> FloatArray:
    """What the track's error leaves of the phases of twelve places, (12, n_pulse), rad."""
    with stores.open_dataset(truth_place(truth)) as flown:
        true = np.array(flown["antenna_position"])
    collection = store if isinstance(store, Collection) else stores.open_phase_history(store).collection
    wavenumber = 4 * np.pi * collection.carrier / SPEED_OF_LIGHT
    errors = []
    for x, y in np.random.default_rng(9).uniform(-60, 60, (12, 2)):
        sight = np.array([x, y, 0.0]) - true
        sight /= np.linalg.norm(sight, axis=1, keepdims=True)
        errors.append(wavenumber * (sight * (collection.antenna_position - true)).sum(axis=1))
    return np.array(errors)


def residual_phase(store: Path | Collection, truth: Path) -> float:
    """The same without constant and line, rms over aperture and places, rad."""
    phases = phase_errors(store, truth)
    lines = np.stack([np.ones(phases.shape[1]), np.linspace(-1, 1, phases.shape[1])], axis=1)
    left = [phase - lines @ np.linalg.lstsq(lines, phase, rcond=None)[0] for phase in phases]
    return float(np.sqrt(np.mean(np.square(left))))
