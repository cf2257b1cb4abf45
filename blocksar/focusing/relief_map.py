"""The ground map of a block on a terrain: surfaces with the height over a smooth ground as third coordinate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.focusing.lines import Focus, Line, focus
from blocksar.focusing.surfaces import Surface, sum_layers

BEYOND = 1.2  # half extents of its domain from its middle, at which a smooth ground ends
ASIDE = 0.02  # of the range, from the point below the antenna to the nearest that is traced
SHORT = 0.05  # of the fourth moment of the longest dwells: half of their length
QUANTITIES = 6  # range offset, Doppler, phase, gain, time and bend


@dataclass(frozen=True, kw_only=True)
class Depth:
    """How deep points of an epoch range can lie: those of a yaw, below an antenna at x and y, m, from the nadir, and z.

    Close to the nadir no point lies as low as the lowest ground of a block. What is traced there lies a little aside of
    the point below the antenna, `ASIDE` of the range.
    """

    x: float
    y: float
    z: float

    def __call__(self, epoch_range: FloatArray, yaw: FloatArray) -> FloatArray:
        """The least z (m) of points at epoch ranges (m) and yaws (rad), broadcast."""
        along = np.cos(yaw) * self.x + np.sin(yaw) * self.y
        across2 = self.x**2 + self.y**2 - along**2
        aside = np.maximum(-along, 0.0) + ASIDE * epoch_range
        return np.asarray(self.z - np.sqrt(np.maximum(epoch_range**2 - across2 - aside**2, 0.0)))


@dataclass(frozen=True, kw_only=True, eq=False)
class SmoothGround:
    """A smooth ground that stands for a block's terrain: height, m, over ground range and yaw, and an offset, m.

    It goes on level beyond `ends`, half extents of its domain from its middle, and is nowhere deeper than points are.
    """

    surface: Surface
    depth: Depth
    offset: float = 0.0
    ends: float = BEYOND

    def __call__(self, epoch_range: FloatArray, yaw: FloatArray) -> FloatArray:
        places = self.surface.along.place(epoch_range), self.surface.across(yaw)
        height = self.surface.at(*(np.clip(place, -self.ends, self.ends) for place in places)) + self.offset
        return np.maximum(height, self.depth(epoch_range, yaw))


@dataclass(frozen=True, kw_only=True, eq=False)
class NodeHeights:
    """A smooth ground with heights over it at nodes, m, for arguments of the nodes' shape; without for others."""

    smooth: SmoothGround
    over: FloatArray

    def __call__(self, epoch_range: FloatArray, yaw: FloatArray) -> FloatArray:
        height = self.smooth(epoch_range, yaw)
        if height.shape != self.over.shape:
            return height
        return np.maximum(height + self.over, self.smooth.depth(epoch_range, yaw))


@dataclass(frozen=True, kw_only=True, eq=False)
class ReliefMap:
    """Where and how points of a block's terrain focus, by epoch range, yaw and height over the smooth ground.

    Attributes
    ----------
    smooth : SmoothGround
    low, high : float
        Least and greatest height over the smooth ground, m.
    lowest, highest : float
        Least and greatest z, m.
    layers : tuple of tuples of Surface
        For range offset, Doppler, phase, gain and time as in `GroundMap`, and the bend: the terms of a Chebyshev series
        in the height over the smooth ground, each a surface; all have one domain and one shape. The bend is the phase
        that the line has, quadratic in time from the middle of its dwell, cycles/s^2.
    most_bend : float
        Largest magnitude of the bend, cycles/s^2.
    turns : tuple of Surface
        Under a beam about its axis, terms of a series as in `layers`: by how much the point of the smooth ground that
        has the same range and place in the beam lies at a greater yaw, rad. Sums over lit pulses are known there.
    """

    smooth: SmoothGround
    low: float
    high: float
    lowest: float
    highest: float
    layers: tuple[tuple[Surface, ...], ...]
    most_bend: float
    turns: tuple[Surface, ...] = ()

    def __call__(self, epoch_range: FloatArray, yaw: FloatArray, z: FloatArray) -> list[FloatArray]:
        """The quantities of points at epoch ranges (m), yaws (rad) and heights z (m), all of the ranges' shape.

        Points that differ in the first axis only may share a yaw, whose shape then lacks this axis. Last the turn; 0
        where there is none.
        """
        u, v, w = self._coordinates(epoch_range, yaw, z)
        series = self._series
        n_level = w.shape[0] if v.ndim < w.ndim else 1
        values = np.empty((series.shape[0], n_level, v.size))
        sum_layers(series, u.reshape(n_level, -1), v.ravel(), w.reshape(n_level, -1), values)
        known = [row.reshape(w.shape) for row in values]
        return known if self.turns else [*known, np.zeros_like(w)]

    def turn(self, epoch_range: FloatArray, yaw: FloatArray, z: FloatArray) -> FloatArray:
        """The turn alone of points (...), rad."""
        if not self.turns:
            return np.zeros(np.shape(z))
        u, v, w = self._coordinates(epoch_range, yaw, z)
        terms = np.array([[term.series for term in self.turns]])
        values = np.empty((1, 1, w.size))
        sum_layers(terms, u.reshape(1, -1), v.ravel(), w.reshape(1, -1), values)
        return values.reshape(w.shape)

    def _coordinates(self, epoch_range: FloatArray, yaw: FloatArray, z: FloatArray) -> tuple[FloatArray, ...]:
        """Range, yaw and height over the smooth ground, each from -1 to 1 over the domain of all surfaces."""
        first = self.layers[0][0]
        return (
            first.along.place(epoch_range),
            first.across(yaw),
            (2 * (z - self.smooth(epoch_range, yaw)) - self.low - self.high) / (self.high - self.low),
        )

    @cached_property
    def _series(self) -> FloatArray:
        """All series (n_quantity, n_term, ..), which have the same domain."""
        every = (*self.layers, *([self.turns] if self.turns else []))
        return np.array([[term.series for term in terms] for terms in every])


def straighten(line: Line, about: Callable[[Focus], FloatArray]) -> tuple[Line, FloatArray, Focus]:
    """Lines without the phase that is quadratic in time, (...) cycles/s^2, and their focus.

    The interpolation along Doppler takes this phase out; it is `about` the time (...), s, about which it interpolates.
    That may lie off the middle of weights that tilt; the quadratic is found about their middle, where it is orthogonal
    to a constant and a slope.
    """
    spots = focus(line)
    offset = line.time - spots.time[..., None]
    weight = line.weight * np.sqrt(np.maximum(line.stretch, 1e-3))
    total = weight.sum(axis=-1)

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray((values * weight).sum(axis=-1) / total)

    level = line.phase - spots.doppler[..., None] * line.time
    # The quadratic that is orthogonal to a constant and a slope.
    square = offset**2
    square = square - mean(square)[..., None] - (mean(square * offset) / mean(offset**2))[..., None] * offset
    # A dwell that is cut short has no bend worth the name.
    power = mean(square**2)
    bend = mean(level * square) / np.maximum(power, SHORT * power.max())
    bent, offset = bend[..., None], line.time - about(spots)[..., None]
    straight = line.multiply_time(-bent * offset**2, -2 * bent * offset, np.broadcast_to(-2 * bent, offset.shape))
    return straight, bend, focus(straight)
