"""The phase of motion compensation of a block, from the track's wobble and the lines of sight."""

from __future__ import annotations

import numpy as np
from numpy.polynomial import chebyshev

from blocksar import solvers
from blocksar.arrays import FloatArray
from blocksar.collection.beam import centre_yaw
from blocksar.collection.geometry import Geometry
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.focusing.motion_phase import Motion

NODES_PER_INTERVAL = 8  # times per interval of the track's spline: linear between them, its bend errs by 0.4 %
RANGE_NODES = 4  # of the Chebyshev series of the line of sight in range


def plan_motion(
    geometry: Geometry, *, near: float, far: float, origin: float, low: float, high: float
) -> Motion | None:
    """The phase for epoch ranges near .. far, m, and yaws low .. high, rad; None for a polynomial track."""
    wobble = geometry.track.wobble
    if wobble is None:
        return None
    collection = geometry.collection
    n = NODES_PER_INTERVAL * wobble.n_interval + 1
    time = np.linspace(collection.time[0], collection.time[-1], n)
    nodes = chebyshev.chebpts1(RANGE_NODES)
    ranges = (near + far) / 2 + (far - near) / 2 * nodes
    beam = centre_yaw(geometry, time, ranges, low, high)
    point, step = geometry.ground_point(ranges[:, None], beam), float(time[1] - time[0])

    def sight(at: FloatArray) -> FloatArray:
        """Unit vectors (n_range, n, 3) at times (n,) to the points that are in the beam's centre at `time`."""
        away = point - geometry.track.base.position(at)
        return np.asarray(away / np.sqrt((away * away).sum(axis=-1, keepdims=True)))

    def series(lengths: FloatArray) -> FloatArray:
        """(n, n_term) Chebyshev series in range of -2 fc / c times lengths (n_range, n, 3), summed over the axes."""
        cycles = -2 * collection.carrier / SPEED_OF_LIGHT * lengths.sum(axis=-1)
        return np.ascontiguousarray(solvers.chebyshev_series(nodes, cycles, RANGE_NODES - 1).T)

    before, now, after = (sight(time + offset) for offset in (-step, 0.0, step))
    turn, bend = (after - before) / (2 * step), (after - 2 * now + before) / step**2
    shift, rate, pull = (wobble(time, derivative) for derivative in range(3))
    return Motion.integrate(
        series(pull * now + 2 * rate * turn + shift * bend),
        series(shift * now),
        start=float(time[0]) - geometry.epoch,
        step=step,
        near=near - origin,
        far=far - origin,
    )
