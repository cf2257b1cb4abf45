"""States of an orbit carried on for some seconds, by the Earth's gravity."""

from __future__ import annotations

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
    """That of a satellite (3,) in axes that turn with the Earth, m/s^2: gravity with its flattening, and the turn's."""
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


def reaching(orbit: Orbit, first: float, last: float) -> Orbit:
    """An orbit with states at two times besides its own, s, where these lie before or after all of them.

    Raises
    ------
    InputError
        If they lie more than LONGEST before or after.
    """
    early, late = orbit.time[0] - first, last - orbit.time[-1]
    if max(early, late) > LONGEST:
        raise InputError(
            f"states of the orbit in packets begin {early:.3g} s after the bursts do and end {late:.3g} s before their "
            "end; give the orbit's file with --orbit"
        )
    states = [(orbit.time, orbit.position, orbit.velocity)]
    for time, end in ((first, 0), (last, -1)):
        beyond = time - orbit.time[end]
        if beyond * (-1 if end == 0 else 1) > 0:
            place, speed = propagated(orbit.position[end], orbit.velocity[end], float(beyond))
            states.insert(0 if end == 0 else len(states), (np.array([time]), place[None], speed[None]))
    return Orbit(
        time=np.concatenate([each[0] for each in states]), position=np.concatenate([each[1] for each in states]),
        velocity=np.concatenate([each[2] for each in states]),
    )  # fmt: skip
