"""Ranges at which a block's targets are traced."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.polynomial import chebyshev

from blocksar import solvers
from blocksar.arrays import FloatArray
from blocksar.focusing.lines import Line

RANGE_STEPS = 3  # of the iteration that finds the targets of an apparent range
MOST_BEYOND = 1.05  # half swaths from its middle at which the series of that iteration is trusted


def nodes_between(low: float, high: float, count: int) -> FloatArray:
    """`solvers.end_nodes` from low to high."""
    return low + (high - low) * (1 + solvers.end_nodes(count)) / 2


def common_ranges(
    trace: Callable[[FloatArray], Line], line: Line, nodes: FloatArray, *, origin: float, least: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Apparent ranges that span those of lines (n_range, n_yaw), and the epoch range of each yaw's target there.

    Targets of one output row share its coefficients but not always the range at the epoch: correcting range curvature
    at a target's own Doppler moves the target by that curvature (paper C, below (5)). No epoch range is below
    `least`, m.

    Returns
    -------
    ranges : (n_range,) m from the origin, ascending
    epoch_range : (n_range, n_yaw) m
    """
    apparent = line.range.mean(axis=-1)
    ranges = nodes_between(float(apparent.min()), float(apparent.max()), nodes.size)
    # How far ranges move, as a series over the nodes; targets beyond the nodes need one step with their own lines.
    moved = solvers.node_series(apparent - (nodes[:, None] - origin), nodes.size - 1)
    epoch_range = origin + ranges[:, None] - moved[0]
    for _ in range(RANGE_STEPS):
        u = np.clip((2 * epoch_range - nodes[0] - nodes[-1]) / (nodes[-1] - nodes[0]), -MOST_BEYOND, MOST_BEYOND)
        epoch_range = origin + ranges[:, None] - chebyshev.chebval(u, moved[:, None], tensor=False)
        epoch_range = np.maximum(epoch_range, least)
    epoch_range = epoch_range + ranges[:, None] - trace(epoch_range).range.mean(axis=-1)
    return ranges, np.maximum(epoch_range, least)
