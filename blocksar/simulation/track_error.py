"""Errors of the track: how the antenna really moved off the track that the phase history states.

The scene's track is what the navigation says. Samples are simulated from the track plus its error; the store has the
track, and a reference range that follows the track. The track as flown is kept beside the store, see `phase_history`.
"""

from __future__ import annotations

from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from blocksar.arrays import FloatArray
from blocksar.simulation.fields import Pair, Positive, Seed, Table, Vector

LINES = 64  # sine waves that a vibration is the sum of
NOTHING = (0.0, 0.0, 0.0)


class WobbleTable(Table):
    amplitude: Vector = Field(description="[x, y, z], m")
    frequency: Positive = Field(description="Hz")
    phase_deg: Vector = Field(NOTHING, description="[x, y, z] at t = 0, of a sine")

    def positions(self, time: FloatArray) -> FloatArray:
        """Return the displacement (n, 3), m, at slow times (n,), s."""
        angle = 2 * np.pi * self.frequency * time[:, None] + np.radians(self.phase_deg)
        return np.asarray(np.array(self.amplitude) * np.sin(angle))


class VibrationTable(Table):
    rms: Vector = Field(description="[x, y, z], m")
    band: Pair = Field(description="[low, high] Hz, in which it is noise")

    @model_validator(mode="after")
    def _check(self) -> Self:
        low, high = self.band
        if not 0 < low < high:
            raise ValueError(f"band = [{low:g}, {high:g}]: must be [low, high] with 0 < low < high, Hz")
        return self

    def positions(self, time: FloatArray, random: np.random.Generator) -> FloatArray:
        """Return the displacement (n, 3), m: sine waves of random frequency and phase, one axis by itself."""
        frequency = random.uniform(*self.band, (LINES, 3))
        phase = random.uniform(0, 2 * np.pi, (LINES, 3))
        waves = sum(np.sin(2 * np.pi * f * time[:, None] + p) for f, p in zip(frequency, phase, strict=True))
        return np.asarray(np.array(self.rms) * np.sqrt(2 / LINES) * waves)


class ErrorTable(Table):
    """Where the antenna really was, less where the phase history says: the sum of all that is given."""

    offset: Vector = Field(NOTHING, description="[x, y, z], m, constant")
    velocity: Vector = Field(NOTHING, description="[x, y, z], m/s, about the middle of the collection")
    drift: Vector = Field(
        NOTHING, description="[x, y, z], m: reached at both ends of the collection, with the square of time"
    )
    oscillation: Annotated[tuple[WobbleTable, ...], Field(strict=False)] = Field((), description="sine waves")
    vibration: Annotated[tuple[VibrationTable, ...], Field(strict=False)] = Field(
        (), description="noise within a band of frequencies"
    )
    velocity_random_walk: Vector = Field(
        NOTHING, description="[x, y, z], m rms over the collection: of a velocity that walks from pulse to pulse"
    )
    position_random_walk: Vector = Field(
        NOTHING, description="[x, y, z], m rms over the collection: of a position that walks from pulse to pulse"
    )
    seed: Seed | None = Field(None, description="seed of random walks and vibrations; needed with them")

    @model_validator(mode="after")
    def _check(self) -> Self:
        random = [name for name in ("velocity_random_walk", "position_random_walk") if any(getattr(self, name))]
        random += ["vibration"] if self.vibration else []
        if random and self.seed is None:
            raise ValueError(f"seed missing: {' and '.join(random)} need{'s' if len(random) == 1 else ''} one")
        return self

    def positions(self, time: FloatArray) -> FloatArray:
        """Return the error (n, 3), m, at the pulses' slow times (n,), s.

        Mean and line of a random walk are taken out: they are `offset` and `velocity`. Each part has random numbers of
        its own, so that none changes with another.
        """
        middle, half = (time[0] + time[-1]) / 2, (time[-1] - time[0]) / 2
        since = (time - middle)[:, None]
        total = np.array(self.offset) + np.array(self.velocity) * since + np.array(self.drift) * (since / half) ** 2
        for wave in self.oscillation:
            total += wave.positions(time)
        for index, noise in enumerate(self.vibration):
            total += noise.positions(time, self._random(2 + index))
        for index, rms in enumerate((self.position_random_walk, self.velocity_random_walk)):
            if any(rms):
                steps = self._random(index).standard_normal((time.size, 3))
                total += np.array(rms) * _walk(steps, since[:, 0], sums=1 + index)
        return total

    def _random(self, part: int) -> np.random.Generator:
        assert self.seed is not None  # checked when read
        return np.random.Generator(np.random.Philox(key=np.array([self.seed, part], dtype=np.uint64)))


def _walk(steps: FloatArray, since: FloatArray, *, sums: int) -> FloatArray:
    """Sum steps (n, 3) once or twice, take out mean and line over time (n,) from its middle, and scale to rms 1."""
    for _ in range(sums):
        steps = np.cumsum(steps, axis=0)
    steps = steps - steps.mean(axis=0)
    steps = steps - since[:, None] * ((since[:, None] * steps).sum(axis=0) / (since * since).sum())
    return np.asarray(steps / np.sqrt((steps * steps).mean(axis=0)))
