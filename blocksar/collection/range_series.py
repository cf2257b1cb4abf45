"""Power series of range histories in slow time and yaw."""

from __future__ import annotations

import numpy as np

from blocksar import solvers
from blocksar.arrays import FloatArray
from blocksar.collection.geometry import Geometry


def range_series(geometry: Geometry, epoch_range: FloatArray, yaw: FloatArray, *, order: int) -> FloatArray:
    """Taylor coefficients k_n of a target's range about the epoch, (..., order + 1), m/s^n (paper A (1)).

    The squared range is a short polynomial in t. A power-series recursion takes its square root, exact to
    machine precision for any polynomial track.
    """
    point = geometry.ground_point(epoch_range, yaw)
    squared = np.zeros((*point.shape[:-1], order + 1))
    sight = np.zeros((3, *point.shape[:-1], order + 1))
    for i, column in enumerate(geometry.track_powers):
        n_term = min(order + 1, column.size)
        sight[i, ..., :n_term] = -column[:n_term]
        sight[i, ..., 0] += point[..., i]
    for n in range(order + 1):
        x, y, z = (sight[..., : n + 1] * sight[..., n::-1]).sum(axis=-1)
        squared[..., n] = x + y + z
    k = np.zeros_like(squared)
    k[..., 0] = np.sqrt(squared[..., 0])
    for n in range(1, order + 1):
        cross = (k[..., 1:n] * k[..., n - 1 : 0 : -1]).sum(axis=-1)
        k[..., n] = (squared[..., n] - cross) / (2 * k[..., 0])
    return k


YAW_NODES = np.cos(np.pi * (np.arange(9) + 0.5) / 9)  # Chebyshev nodes over a block's yaws, scaled to -1 .. 1


def yaw_series(geometry: Geometry, epoch_range: FloatArray, yaw: float, *, order: int, half_width: float) -> FloatArray:
    """k_nm of paper A (2): k_n(R, dtheta) = sum_m k_nm dtheta^m, (n_range, order + 1, 5).

    The dependence on yaw is interpolated through Chebyshev nodes over the block and converted to powers. epoch_range
    is (n_range,), or (n_range, 9) where it changes with yaw, given at yaw + half_width YAW_NODES.
    """
    epoch_range = epoch_range.reshape(epoch_range.shape[0], -1)
    k = range_series(geometry, epoch_range, yaw + half_width * YAW_NODES, order=order)
    fitted = solvers.chebyshev_series(YAW_NODES, np.moveaxis(k, 1, 0).reshape(9, -1), 8)
    to_powers = np.zeros((9, 9))
    for degree in range(9):
        to_powers[degree, : degree + 1] = np.polynomial.chebyshev.cheb2poly(np.eye(9)[degree, : degree + 1])
    powers = solvers.product(fitted.T, to_powers)[:, :5] / half_width ** np.arange(5)
    return powers.reshape(epoch_range.shape[0], order + 1, 5)
