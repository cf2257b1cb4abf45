"""The grid of an image's pixels."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.constants import SINC_WIDTH, SPEED_OF_LIGHT
from blocksar.errors import InputError

MAX_POINTS = 1 << 21  # of one axis of a grid; more are taken for a typing error
FOLDS = 8  # images of a spectrum to either side that are looked at
NEARLY = 0.999  # of a side, from which on two spectra lie side by side


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
    def as_option(self) -> str:
        """The grid as text for the option --grid."""
        x, y = (self.x0, self.x1, self.dx), (self.y0, self.y1, self.dy)
        return ",".join(":".join(f"{number:.10g}" for number in axis) for axis in (x, y))

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


def ground_spectrum(geometry: Geometry, epoch_range: float, yaw: float) -> tuple[FloatArray, FloatArray]:
    """Sides (2,) of a target's spectrum on the ground, cycles/m along x and y: by its band, and over its own dwell.

    The spectrum is the parallelogram that they span about 2 / wavelength times the mean gradient of range.
    """
    first, _, last = _gradients(geometry, np.array(epoch_range), np.array(yaw))
    return _sides(geometry.collection, first, last)


def _gradients(geometry: Geometry, epoch_range: FloatArray, yaw: FloatArray) -> FloatArray:
    """Gradients (3, ..., 2) of targets' ranges on the ground at the begin, the middle and the end of their dwells."""
    first, last = geometry.beam.dwell_at(yaw, epoch_range)
    times = np.stack([first, (first + last) / 2, last])
    return np.asarray(geometry.gradient(geometry.ground_point(epoch_range, yaw), times)[..., :2])


def _sides(collection: Collection, first: FloatArray, last: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Sides of the spectrum by band and dwell, cycles/m, from the gradients of range at the ends of the dwell."""
    by_band = collection.bandwidth / SPEED_OF_LIGHT * (first + last)
    return by_band, 2 / collection.wavelength * (last - first)


def ground_resolution(geometry: Geometry, epoch_range: float, yaw: float) -> tuple[float, float]:
    """-3 dB widths of a target's response on the ground over its own dwell, across and along iso-range lines, m."""
    by_band, by_dwell = ground_spectrum(geometry, epoch_range, yaw)
    length = float(np.hypot(*by_band))
    turned = abs(float(by_band[0] * by_dwell[1] - by_band[1] * by_dwell[0])) / length
    return SINC_WIDTH / length, SINC_WIDTH / max(turned, 1e-12)


def ground_steps(geometry: Geometry, epoch_range: FloatArray, yaw: FloatArray) -> tuple[float, float]:
    """Half the -3 dB widths of a target's response along x and along y, m: the least of those at some places (n,).

    The spectrum's extent along an axis is taken for the root sum square of those of its sides (`ground_spectrum`) and
    of the bow of the dwell between them: the width where band and dwell lie along the axes, and for a square spectrum
    the same whichever way it is turned.
    """
    first, middle, last = _gradients(geometry, epoch_range, yaw)
    by_band, by_dwell = _sides(geometry.collection, first, last)
    bow = 2 / geometry.collection.wavelength * (middle - (first + last) / 2)
    x, y = SINC_WIDTH / 2 / np.sqrt(by_band**2 + by_dwell**2 + bow**2).max(axis=0)
    return float(x), float(y)


def folds(sides: tuple[FloatArray, FloatArray], dx: float, dy: float) -> bool:
    """Whether a spectrum of these sides (`ground_spectrum`) overlaps one of its images on a grid of steps dx, dy, m.

    Images lie whole numbers of 1 / dx and 1 / dy apart. Two parallelograms overlap where the way from one to the other
    is less than a side along either.
    """
    first, second = sides
    area = float(first[0] * second[1] - first[1] * second[0])
    if area == 0:
        return False
    by_x, by_y = (each.ravel() for each in np.meshgrid(np.arange(-FOLDS, FOLDS + 1) / dx, np.arange(FOLDS + 1) / dy))
    along_first, along_second = (by_x * second[1] - by_y * second[0]) / area, (by_y * first[0] - by_x * first[1]) / area
    within = (np.abs(along_first) < NEARLY) & (np.abs(along_second) < NEARLY)
    return bool((within & ((by_x != 0) | (by_y != 0))).any())
