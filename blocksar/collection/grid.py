"""The grid of an image's pixels."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.collection.beam import dwell_at
from blocksar.collection.geometry import Geometry
from blocksar.constants import SINC_WIDTH, SPEED_OF_LIGHT
from blocksar.errors import InputError

MAX_POINTS = 1 << 21  # of one axis of a grid; more are taken for a typing error


@dataclass(frozen=True)
class Grid:
    """A grid of ground pixels: x = x0, x0 + dx, ... < x1 and likewise y, m."""

    x0: float
    x1: float
    dx: float
    y0: float
    y1: float
    dy: float

    def __post_init__(self) -> None:
        for name, low, high, step in (("x", self.x0, self.x1, self.dx), ("y", self.y0, self.y1, self.dy)):
            if not all(np.isfinite([low, high, step])) or step <= 0:
                raise InputError(f"grid {name}: {low:g}:{high:g}:{step:g} needs finite ends and a step above 0 m")
            if high <= low:
                raise InputError(f"grid {name}: {low:g}:{high:g} is empty; the end must lie above the start")
            # In floating point: the count may exceed any integer type, and a step may vanish against the coordinates.
            if not (high - low) / step < MAX_POINTS or low + step == low or high + step == high:
                raise InputError(
                    f"grid {name}: {low:g}:{high:g}:{step:g} has more than {MAX_POINTS} points; give a larger step"
                )

    @staticmethod
    def _axis(low: float, high: float, step: float) -> FloatArray:
        count = int(np.ceil((high - low) / step - 1e-9))
        return np.asarray(low + step * np.arange(max(count, 1)), dtype=np.float64)

    @cached_property
    def x(self) -> FloatArray:
        return self._axis(self.x0, self.x1, self.dx)

    @cached_property
    def y(self) -> FloatArray:
        return self._axis(self.y0, self.y1, self.dy)

    @property
    def shape(self) -> tuple[int, int]:
        return self.y.size, self.x.size


def spacing(axis: FloatArray) -> float:
    """Step of a uniform axis (n,), m; 0 for one pixel, which extends nowhere."""
    return float(axis[1] - axis[0]) if axis.size > 1 else 0.0


def outline(grid: Grid) -> tuple[FloatArray, FloatArray]:
    """x, y (260,), m, of points along the border of the grid, 65 a side."""
    t = np.linspace(0, 1, 65)
    x0, x1, y0, y1 = grid.x[0], grid.x[-1], grid.y[0], grid.y[-1]
    x = np.concatenate([x0 + (x1 - x0) * t, np.full(65, x1), x1 - (x1 - x0) * t, np.full(65, x0)])
    y = np.concatenate([np.full(65, y0), y0 + (y1 - y0) * t, np.full(65, y1), y1 - (y1 - y0) * t])
    return x, y


def ground_resolution(geometry: Geometry, epoch_range: float, yaw: float) -> tuple[float, float]:
    """-3 dB widths of a target's response on the ground over its own dwell, across and along iso-range lines, m."""
    collection = geometry.collection
    point = geometry.ground_point(np.array(epoch_range), np.array(yaw))
    ends = np.array(dwell_at(geometry, np.array(yaw), np.array(epoch_range)))
    sight = point - geometry.track.position(ends)
    gradient = (sight / np.linalg.norm(sight, axis=1, keepdims=True))[:, :2]
    mean = gradient.mean(axis=0)
    along = np.array([-mean[1], mean[0]]) / np.hypot(*mean)
    turned = abs(float(((gradient[1] - gradient[0]) * along).sum()))
    azimuth = SINC_WIDTH * collection.wavelength / 2 / max(turned, 1e-12)
    return SINC_WIDTH * SPEED_OF_LIGHT / (2 * collection.bandwidth) / float(np.hypot(*mean)), azimuth
