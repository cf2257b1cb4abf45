"""The pulses that light a point, against a look at every pulse, under beams that turn unevenly."""

from __future__ import annotations

import numpy as np
import pytest

from blocksar.arrays import FloatArray
from blocksar.kernels.beam_passes import FoundPasses, MovingBeam, beam_table, find_first, find_passes

N, HALF = 900, 0.01


def _beam(kind: str) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Positions, axes and steering of an antenna that flies by points 9 km away."""
    t, rng = np.linspace(-1, 1, N), np.random.default_rng(4)
    position = np.stack([20 * t**2, 250 * t, 4000 - 5 * t], axis=1)
    axis = np.stack([0.04 * t, np.ones(N), 0.01 * t**2], axis=1)
    steering = {
        "even": 0.03 * t,
        "staying": -np.arctan(250 * t / 9849) + 0.008 * t**2,
        "wobbling": 0.02 * t + 0.006 * np.sin(40 * t),
        "noisy": 0.02 * t + rng.normal(0, 0.002, N),
        "jumping": np.where(t < 0, 0.0, 0.05) + 0.002 * t,
        "behind": np.full(N, 1.57),
    }[kind]
    return position, axis / np.linalg.norm(axis, axis=1, keepdims=True), steering


def _places(*, in_rows: bool = False) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Anywhere, or as the pixels of an image that follow each other; one is unknown."""
    rng = np.random.default_rng(5)
    x, y, z = rng.uniform(8500, 9500, 400), rng.uniform(-700, 700, 400), rng.uniform(-50, 300, 400)
    if in_rows:
        x, y = (part.ravel() for part in np.meshgrid(9000 + 0.5 * np.arange(40), np.linspace(-700, 700, 10)))
        z = 20 * np.sin(x / 30)
    x[7] = np.nan
    return x, y, z


@pytest.mark.parametrize("in_rows", [False, True])
@pytest.mark.parametrize("kind", ["even", "staying", "wobbling", "noisy", "jumping", "behind"])
def test_passes_are_those_of_every_pulse(kind: str, in_rows: bool) -> None:
    position, axis, steering = _beam(kind)
    x, y, z = _places(in_rows=in_rows)
    sight = np.stack([x, y, z], axis=1)[:, None] - position
    sine = (sight * axis).sum(axis=2) / np.linalg.norm(sight, axis=2)
    lit = np.abs(np.arcsin(sine) - steering) <= HALF
    assert kind == "behind" or 0.02 < lit.mean() < 0.9
    beam = MovingBeam.of(beam_table(position, axis, steering, HALF))
    passes = FoundPasses(*np.empty((2, 1, x.size), np.int64))
    most = find_passes(beam, x, y, z, passes)
    changes = np.diff(np.pad(lit, ((0, 0), (1, 1))).astype(int), axis=1)
    assert most == (changes > 0).sum(axis=1).max()
    if most > 1:  # some were not written
        passes = FoundPasses(*np.empty((2, most, x.size), np.int64))
        assert find_passes(beam, x, y, z, passes) == most
    pulse = np.arange(N)
    found = ((passes.firsts[..., None] <= pulse) & (pulse < passes.lasts[..., None])).any(axis=0)
    np.testing.assert_array_equal(found, lit)


def test_the_first_pulse_at_a_limit_is_that_of_every_pulse() -> None:
    position, axis, steering = _beam("even")
    x, y, z = (part[20:] for part in _places())
    sight = np.stack([x, y, z], axis=1)[:, None] - position
    offset = np.arcsin((sight * axis).sum(axis=2) / np.linalg.norm(sight, axis=2)) - steering
    assert (np.diff(offset) < 0).all()
    for level in (-HALF, 0.003, HALF):
        found = np.empty(x.size, np.int64)
        find_first(beam_table(position, axis, steering, level), x, y, z, np.zeros(x.size, np.bool_), found)
        reached = -offset >= level
        np.testing.assert_array_equal(found, np.where(reached.any(axis=1), reached.argmax(axis=1), N))
