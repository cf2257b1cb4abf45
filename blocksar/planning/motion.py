"""The phase of motion compensation of a block, from the track's wobble and the lines of sight."""

from __future__ import annotations

import numpy as np

from blocksar import solvers
from blocksar.arrays import FloatArray
from blocksar.collection.geometry import Geometry
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.focusing.motion_phase import Motion

NODES_PER_INTERVAL = 8  # times per interval of the track's spline: linear between them, its bend errs by 0.4 %
RANGE_NODES = 4  # of the Chebyshev series of the line of sight in range


def plan_motion(geometry: Geometry, *, near: float, far: float, origin: float, yaw: float) -> Motion | None:
    """The phase for epoch ranges near .. far, m; None for a polynomial track. `yaw` is the block's middle, rad."""
    wobble = geometry.track.wobble
    if wobble is None:
        return None
    collection = geometry.collection
    n = NODES_PER_INTERVAL * wobble.n_interval + 1
    time = np.linspace(collection.time[0], collection.time[-1], n)
    beam = np.interp(time, collection.time, collection.beam_azimuth) if collection.steered else np.full(n, yaw)
    nodes = np.cos(np.pi * (np.arange(RANGE_NODES) + 0.5) / RANGE_NODES)[::-1]
    ranges = (near + far) / 2 + (far - near) / 2 * nodes
    sight = geometry.ground_point(ranges[:, None], beam) - geometry.track.position(time)
    sight /= np.sqrt((sight * sight).sum(axis=-1, keepdims=True))

    def along(vectors: FloatArray) -> FloatArray:
        """(n, n_term) Chebyshev series in range of -2 fc / c vectors . u, cycles."""
        cycles = -2 * collection.carrier / SPEED_OF_LIGHT * (sight * vectors).sum(axis=-1)
        return np.ascontiguousarray(solvers.chebyshev_series(nodes, cycles, RANGE_NODES - 1).T)

    return Motion.integrate(
        along(wobble(time, 2)),
        along(wobble(time)),
        start=float(time[0]) - geometry.epoch,
        step=float(time[1] - time[0]),
        near=near - origin,
        far=far - origin,
    )
