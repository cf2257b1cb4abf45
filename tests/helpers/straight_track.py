"""Lines of targets seen from a straight, squinted track, where closed forms are exact."""

from __future__ import annotations

from typing import Any

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.processors.chain.planning import coefficients
from blocksar.processors.chain.steps.lines import Line

CARRIER = 15e9
LAMBDA = SPEED_OF_LIGHT / CARRIER
SPEED, SQUINT = 300.0, np.radians(50.0)  # SPEED in m/s, SQUINT from broadside
SIN, COS = np.sin(SQUINT), np.cos(SQUINT)


def history(time: FloatArray, crossing_range: FloatArray, place: FloatArray) -> FloatArray:
    """R(t) of a target that the beam's centre crosses at place / SPEED, after range-walk correction."""
    along = SPEED * time - place
    return np.sqrt(crossing_range**2 + along**2 - 2 * crossing_range * along * SIN) + SPEED * SIN * time


def straight_lines(cell: float, places: FloatArray, *, dwell: float = 2.0) -> Line:
    """(n_place, 24) lines of targets that share an output range, R' = R0 + place sin(squint); all lit around t = 0."""
    node, weight = np.polynomial.legendre.leggauss(24)
    time = np.broadcast_to(node * dwell / 2, (places.size, node.size))
    place = places[:, None]
    crossing_range = cell - place * SIN
    along = SPEED * time - place
    distance = np.sqrt(crossing_range**2 + along**2 - 2 * crossing_range * along * SIN)
    pace = (SPEED * along - crossing_range * SPEED * SIN) / distance  # dR/dt
    return Line(
        time=time,
        doppler=-2 / LAMBDA * (pace + SPEED * SIN),
        rate=-2 / LAMBDA * (SPEED**2 - pace**2) / distance,
        phase=-2 / LAMBDA * (distance + SPEED * SIN * time),
        range=np.full_like(time, cell),
        stretch=np.ones_like(time),
        weight=np.broadcast_to(weight * dwell / 2, time.shape),
    )


def straight_series(cell: float, *, half: float = 500.0) -> FloatArray:
    """k_nm (1, 5, 5) in place at constant output range, interpolated through exact power series in time."""
    u = np.cos(np.pi * (np.arange(16) + 0.5) / 16)
    rows = []
    for place in half * u:
        crossing_range = cell - place * SIN
        squared = np.array([
            crossing_range**2 + place**2 + 2 * crossing_range * place * SIN,
            -2 * SPEED * (place + crossing_range * SIN), SPEED**2, 0, 0,
        ])  # fmt: skip
        k = np.zeros(5)
        k[0] = np.sqrt(squared[0])
        for n in range(1, 5):
            k[n] = (squared[n] - (k[1:n] * k[n - 1 : 0 : -1]).sum()) / (2 * k[0])
        k[1] += SPEED * SIN
        rows.append(k)
    powers = np.polynomial.polynomial.polyfit(u, np.array(rows), 9)[:5] / half ** np.arange(5)[:, None]
    return powers.T[None]


def levelled(line: Line, found: coefficients.ClosedForm) -> Line:
    """Apply the steps that closed-form coefficients (of one range) define to the lines."""

    def polynomial(powers: FloatArray, values: FloatArray) -> Any:
        series = np.polynomial.Polynomial(powers)
        return series(values), series.deriv()(values), series.deriv(2)(values)

    line = line.multiply_time(*polynomial(found.time[0], line.time))
    line = line.multiply_doppler(*polynomial(found.doppler[0], line.doppler))
    line = line.resample_doppler(*polynomial(found.resampling[0], line.doppler), middle=0.0)
    return line.multiply_time(*polynomial(found.deramp[0], line.time))
