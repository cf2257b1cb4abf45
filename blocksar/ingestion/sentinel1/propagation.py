"""States of an orbit carried on for some seconds, by the Earth's gravity."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.errors import InputError
from blocksar.ingestion.strips.orbit import SPIN, Orbit

GRAVITY = 3.986004418e14  # m^3/s^2
OBLATENESS = 1.08262668e-3  # J2
RADIUS = 6378137.0  # m
STEP = 1.0  # s
LONGEST = 15.0  # s: what J2 leaves out, 3e-5 m/s^2, moves a satellite by 3 mm


def acceleration(position: FloatArray, velocity: FloatArray) -> FloatArray:
    """Acceleration (3,) of a satellite in axes that turn with the Earth, m/s^2, with its flattening."""
    distance = float(np.linalg.norm(position))
    lift = 5 * position[2] ** 2 / distance**2
    flattened = 1.5 * OBLATENESS * (RADIUS / distance) ** 2 * (np.array([1.0, 1.0, 3.0]) - lift)
    fall = -GRAVITY / distance**3 * position * (1 + flattened)
    turn = np.array([2 * velocity[1], -2 * velocity[0], 0.0]) + SPIN * np.array([position[0], position[1], 0.0])
    return np.asarray(fall + SPIN * turn)


def propagated(position: FloatArray, velocity: FloatArray, seconds: float) -> tuple[FloatArray, FloatArray]:
    """Position and velocity (3,) so many seconds later, m and m/s, by Runge-Kutta's method of order 4."""
    steps = max(int(np.ceil(abs(seconds) / STEP)), 1)
    h = seconds / steps
    r, v = np.array(position, float), np.array(velocity, float)
    for _ in range(steps):
        rates = [(v, acceleration(r, v))]
        for part in (h / 2, h / 2, h):
            dr, dv = rates[-1]
            rates.append((v + part * dv, acceleration(r + part * dr, v + part * dv)))
        r = r + h / 6 * sum(w * dr for w, (dr, _) in zip((1, 2, 2, 1), rates, strict=True))
        v = v + h / 6 * sum(w * dv for w, (_, dv) in zip((1, 2, 2, 1), rates, strict=True))
    return r, v


class States(NamedTuple):
    """Positions and velocities (n, 3), Earth-centred, Earth-fixed, m and m/s, at ascending times (n,), s."""

    time: FloatArray
    position: FloatArray
    velocity: FloatArray

    def reaching(self, first: float, last: float) -> Orbit:
        """The orbit of these, with a state at each of two times, s, that lies before or after all of them.

        Raises
        ------
        InputError
            If one lies more than LONGEST before or after, or the states are no satellite's.
        """
        early, late = float(self.time[0]) - first, last - float(self.time[-1])
        if max(early, late) > LONGEST:
            raise InputError(
                f"states of the orbit in packets begin {early:.3g} s after the bursts do and end {late:.3g} s before "
                "their end; give the orbit's file with --orbit"
            )
        states = [self]
        if early > 0:
            states.insert(0, self._carried(0, first))
        if late > 0:
            states.append(self._carried(-1, last))
        time, position, velocity = (np.concatenate(each) for each in zip(*states, strict=True))
        return Orbit(time=time, position=position, velocity=velocity)

    def _carried(self, end: int, time: float) -> States:
        """The first or last state carried to a time."""
        place, velocity = propagated(self.position[end], self.velocity[end], time - float(self.time[end]))
        return States(np.array([time]), place[None], velocity[None])
