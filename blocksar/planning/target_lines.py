"""Time-frequency lines of targets in the recovered spectrum."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from blocksar import solvers
from blocksar.arrays import BoolArray, FloatArray
from blocksar.collection.geometry import AntennaState, Geometry, range_motion
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.focusing.lines import Focus, Line
from blocksar.focusing.recovery import NO_COMMON_RANGE, CommonRange
from blocksar.planning.dwell_ends import Moments, dwell_ends
from blocksar.planning.dwell_weights import DwellWeights


@dataclass(frozen=True, kw_only=True, eq=False)
class TracedTargets:
    """Targets at epoch ranges (n_range,) and yaws (n_yaw,), traced through a whole chain.

    Attributes
    ----------
    geometry : Geometry
        Its ground is the one on which they lie.
    epoch_range, yaw : (n_range,), (n_yaw,) float
        m and rad.
    line : Line
        (n_range, n_yaw, n), after all steps.
    spots : Focus
        (n_range, n_yaw), where and how the lines focus.
    weights : DwellWeights
        At the nodes of the lines.
    uncut : pair of (n_yaw,) or (n_range, n_yaw) float
        Slow time at which the dwells would begin and end if the collection did not cut them, s from the epoch.
    rate : (n_range, n_yaw, n) float
        The lines' Doppler rate before the steps in Doppler, Hz/s.
    scaled_about : float or None
        Time, s from the epoch, about which a keystone scales time with range frequency; None without one.
    moves : (n_range, n_yaw, n) float or None
        From `dwell_ends.band_moves`, s; None with a keystone.
    """

    geometry: Geometry
    epoch_range: FloatArray
    yaw: FloatArray
    line: Line
    spots: Focus
    weights: DwellWeights
    uncut: Moments
    rate: FloatArray
    scaled_about: float | None
    moves: FloatArray | None

    @cached_property
    def lit(self) -> Moments:
        """Slow times at which the targets are first and last lit, (n_yaw,) or (n_range, n_yaw) s."""
        return self.geometry.beam.dwell_at(self.yaw, self.epoch_range[:, None])

    @cached_property
    def cut(self) -> BoolArray:
        """Whether an end of the collection cuts the begin and the end of dwells, (n_yaw, 2) or (n_range, n_yaw, 2)."""
        collection = self.geometry.collection
        return np.asarray(np.abs(np.stack(self.lit, axis=-1) - collection.time[[0, -1]]) < collection.pulse_interval)

    @cached_property
    def ends(self) -> Moments:
        """Times at which the dwells begin and end after all steps, (n_range, n_yaw) s."""
        return dwell_ends(self.line)

    def moved(self, end: int) -> FloatArray:
        """Time by which relative range frequency moves the begin (0) or the end (-1) of dwells, s."""
        if self.moves is not None:
            return self.moves[..., end]
        if self.scaled_about is None:
            return np.zeros(self.yaw.shape)
        return np.asarray(self.lit[end] - self.geometry.epoch - self.scaled_about)


LINE_NODES = 16  # of a line along a polynomial track
NODES_PER_INTERVAL, MOST_NODES = 0.75, 256  # of a line along a spline, whose intervals are a fraction of its waves
TAIL_ENERGY = 1e-3  # fraction of a target's energy that may lie outside its block's Doppler support


class Nodes(NamedTuple):
    """Gauss-Legendre nodes of dwells, and what does not depend on the targets' ranges.

    Attributes
    ----------
    slow : (..., n) float
        Slow time from the epoch, s.
    weight : (..., n) float
        Quadrature weights: seconds of lit time.
    antenna : Motion
        Of the antenna at these times.
    removed : (..., n) float, three of them
        Range (m) that recovery removes from all targets, its rate and that rate's.
    """

    slow: FloatArray
    weight: FloatArray
    antenna: AntennaState
    removed: tuple[FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True, kw_only=True, eq=False)
class Dwells:
    """Dwells of targets at some yaws.

    Attributes
    ----------
    yaw : (...) float
        rad.
    origin, walk : float
        Range origin (m) and unified range walk (m/s).
    common : CommonRange
    coarsely : bool
        Trace a spline's waves with nodes enough to see them, not to integrate them.
    least_nodes : int
        Along a line.
    as_many : int or None
        Nodes along a line, as those of other lines have; None: as many as the track needs over these dwells.
    """

    geometry: Geometry
    yaw: FloatArray
    origin: float
    walk: float
    common: CommonRange
    coarsely: bool
    least_nodes: int
    as_many: int | None = None

    def lines(self, epoch_range: FloatArray) -> Line:
        """Lines of targets in the recovered signal; `epoch_range` and the yaws are broadcast."""
        nodes = self._nodes(epoch_range) if self.geometry.beam.by_range else self._of_all_ranges
        x, y = self.geometry.ground_axes(epoch_range, self.yaw)
        z = self.geometry.level(epoch_range, self.yaw)
        point = x[..., None], y[..., None], z if isinstance(z, float) else z[..., None]
        rng, rate, curvature = range_motion(point, nodes.antenna)
        rho = rng - nodes.removed[0]
        to_cycles = -2 * self.geometry.collection.carrier / SPEED_OF_LIGHT
        return Line(
            time=np.broadcast_to(nodes.slow, rho.shape),
            doppler=to_cycles * (rate - nodes.removed[1]),
            rate=to_cycles * (curvature - nodes.removed[2]),
            phase=to_cycles * rho,
            range=rho,
            stretch=np.ones_like(rho),
            weight=np.broadcast_to(nodes.weight, rho.shape),
        )

    @cached_property
    def _of_all_ranges(self) -> Nodes:
        """The nodes where dwells do not depend on range."""
        return self._nodes(np.zeros(1))

    def _nodes(self, epoch_range: FloatArray) -> Nodes:
        geometry, yaw = self.geometry, self.yaw
        collection = geometry.collection
        first, last = geometry.beam.dwell_at(yaw if collection.steered else np.zeros((1,) * np.ndim(yaw)), epoch_range)
        longest = float(np.max(last - first))
        n_node = self.as_many or max(_line_nodes(geometry, longest, coarsely=self.coarsely), self.least_nodes)
        nodes, weights = solvers.gauss_legendre(n_node)
        shortest = 0.05 * longest
        middle = np.clip((first + last) / 2, collection.time[0] + shortest / 2, collection.time[-1] - shortest / 2)
        length = np.maximum(last - first, shortest)[..., None]
        time = middle[..., None] + length / 2 * nodes
        slow = time - geometry.epoch
        removed = (
            self.origin + self.walk * slow + self.common.at(slow),
            self.walk + self.common.at(slow, 1),
            self.common.at(slow, 2),
        )
        return Nodes(slow, length / 2 * weights, geometry.track.motion(time), removed)


def find_dwells(
    geometry: Geometry,
    *,
    yaw: FloatArray,
    origin: float,
    walk: float,
    common: CommonRange = NO_COMMON_RANGE,
    coarsely: bool = False,
    least_nodes: int = LINE_NODES,
    as_many: int | None = None,
) -> Dwells:
    """The dwells at yaws (...), rad.

    Along a spline, lines have nodes enough to integrate its waves; `coarsely`, to see them. Or `as_many` as others.

    Dwells cut by the ends of the collection are traced as cut. Targets lit for less than a twentieth of the longest
    dwell are traced over that much, inside the collection.
    """
    return Dwells(
        geometry=geometry, yaw=yaw, origin=origin, walk=walk, common=common, coarsely=coarsely, least_nodes=least_nodes,
        as_many=as_many,
    )  # fmt: skip


def _line_nodes(geometry: Geometry, longest: float, *, coarsely: bool) -> int:
    """Nodes along a dwell of at most `longest` s: more where a spline bends the track within it."""
    wobble = geometry.track.wobble
    if wobble is None:
        return LINE_NODES
    density = NODES_PER_INTERVAL / 2 if coarsely else NODES_PER_INTERVAL
    return min(max(LINE_NODES, math.ceil(density * longest / wobble.step) + 8), MOST_NODES)


def tail_margin(duration: float) -> float:
    """Doppler margin beyond a line's ends that holds all but TAIL_ENERGY of a target lit for `duration`, Hz.

    A chirp that starts and stops sharply has spectral tails 1 / (2 pi f) at either end. The fraction of its energy
    beyond f is 1 / (pi^2 f duration).
    """
    return 1.0 / (np.pi**2 * TAIL_ENERGY * duration)


def middle_line(u: FloatArray, doppler: FloatArray, *, order: int) -> FloatArray:
    """Chebyshev series through the middle of the lit band at each time u in [-1, 1], for the derotation to follow.

    Paper A (8) follows the beam's centre at the reference range. The middle of all that is lit at a time needs a
    slightly lower PRF, and coincides with it where the swath is narrow.
    """
    bins = np.clip(((u + 1) / 2 * 48).astype(int), 0, 47)
    low, high, count = np.full(48, np.inf), np.full(48, -np.inf), np.zeros(48)
    np.minimum.at(low, bins, doppler)
    np.maximum.at(high, bins, doppler)
    np.add.at(count, bins, 1)
    filled = count > 0
    # The middle of a time bin, not of its samples: a bin cut by the aperture's end would bias the fit.
    bin_centre = ((np.arange(48) + 0.5) / 24 - 1)[filled]
    middle = (low[filled] + high[filled]) / 2
    return solvers.chebyshev_series(bin_centre, middle, min(order, int(filled.sum()) - 1))
