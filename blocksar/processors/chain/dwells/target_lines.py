"""Sector of ground that a block owns, and the time-frequency lines of its targets in the recovered signal."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from blocksar import solvers
from blocksar.arrays import FloatArray
from blocksar.budget import FIDELITY, IMAGE_TAP_ERROR
from blocksar.collection import range_series
from blocksar.collection.geometry import AntennaState, Geometry, range_motion
from blocksar.collection.region import Region
from blocksar.collection.weighting import UNIFORM, Taper, Weighting
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.processors.chain.dwells.dwell_weights import taper_over_dwells
from blocksar.processors.chain.dwells.steadiness import scans_evenly
from blocksar.processors.chain.ground.relief import Relief
from blocksar.processors.chain.ground.surfaces import GroundRange
from blocksar.processors.chain.steps.lines import Line
from blocksar.processors.chain.steps.recovery import NO_COMMON_RANGE, CommonRange, Recovery

LINE_NODES = 16  # of a line along a polynomial track
NODES_PER_INTERVAL, MOST_NODES = 0.75, 256  # of a line along a spline, whose intervals are a fraction of its waves
TAIL_ENERGY = 1e-3  # fraction of a target's energy that may lie outside its block's Doppler support


class Nodes(NamedTuple):
    """Gauss-Legendre nodes over dwells, with quantities that do not depend on the targets' ranges.

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

    Dwells cut by the ends of the collection are traced as cut. Targets lit for less than a twentieth of the longest
    dwell are traced over that much, inside the collection.

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
    common: CommonRange = NO_COMMON_RANGE
    coarsely: bool = False
    least_nodes: int = LINE_NODES
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
        """Nodes shared by all ranges where dwells do not depend on range."""
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


def _line_nodes(geometry: Geometry, longest: float, *, coarsely: bool) -> int:
    """Number of nodes along a dwell of at most `longest` s: more if a spline bends the track within it."""
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
    """Chebyshev series, for the derotation, through the middle of the lit Doppler band at times u in [-1, 1].

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


REFERENCE_ORDER = 8  # of the range series of a block's centre


@dataclass(frozen=True, kw_only=True, eq=False)
class Sector:
    """The ground that a block owns: yaws [low, high), rad, at epoch ranges [near, far), m.

    With the weighting of its image and the fidelity that it keeps, and the error that the interpolation of the focused
    block may have. On a terrain the geometry is over the smooth part of it, and `relief` has the rest. Where gates
    follow a smoothed beam, this loses `beam_loss` of coherence (`processors.chain.dwells.steadiness`). The grid spans
    the yaws `imaged`.
    """

    geometry: Geometry
    recovery: Recovery
    region: Region
    low: float
    high: float
    near: float
    far: float
    weighting: Weighting = UNIFORM
    fidelity: float = FIDELITY
    tap_error: float = IMAGE_TAP_ERROR
    relief: Relief | None = None
    beam_loss: float = 0.0
    imaged: tuple[float, float] = (-np.inf, np.inf)

    @property
    def ground_range(self) -> GroundRange:
        """Ground range coordinate of the sector's epoch ranges."""
        return ground_range(self.geometry, self.near, self.far)

    @property
    def taper(self) -> Taper:
        """The weighting over dwells."""
        return taper_over_dwells(self.geometry.collection, self.weighting)

    def lit_band(self, lit: Line, uncut: tuple[FloatArray, FloatArray]) -> FloatArray:
        """Doppler band, Hz, that is lit at any one time at targets (...).

        After derotation the beam keeps its Doppler, and a target passes through all of it in its dwell.
        """
        recovery = self.recovery
        passed = lit.doppler[..., [0, -1]] - recovery.derotation_rate(lit.time[..., [0, -1]])
        over = lit.time[..., -1] - lit.time[..., 0]
        dwell = np.maximum(uncut[1] - uncut[0], recovery.pulses.step)
        band = np.abs(passed[..., 1] - passed[..., 0]) * dwell / np.maximum(over, 1e-12)
        return np.clip(band, 1 / dwell, 1 / recovery.pulses.step)

    def dwells(self, yaw: FloatArray, *, coarsely: bool = False, like: Line | None = None) -> Dwells:
        """Dwells of targets at yaws (...), rad, for lines in the recovered signal, with as many nodes as `like` has."""
        recovery = self.recovery
        return Dwells(
            geometry=self.geometry, yaw=yaw, origin=recovery.origin, walk=recovery.walk, common=recovery.common,
            coarsely=coarsely, as_many=None if like is None else like.time.shape[-1],
        )  # fmt: skip

    def passing(self, epoch_range: FloatArray, yaw: FloatArray) -> FloatArray | None:
        """Times at which the beam's centre passes targets, s from the epoch, as tapers need; None: in mid-dwell."""
        if self.taper.uniform or scans_evenly(self.geometry.collection):
            return None
        return np.asarray(self.geometry.beam.passing_at(yaw, epoch_range, 0.0) - self.geometry.epoch)

    @property
    def gates_by_height(self) -> bool:
        """Whether the dwell of a target depends on its height besides its range and Doppler.

        Under a beam about its axis it hardly does: places of equal range and Doppler see the axis at the same angle.
        """
        return self.relief is not None and not self.geometry.beam.by_range

    def reference(self) -> FloatArray:
        """Range series of the sector's centre, m/s^n, less the common range that recovery removes."""
        middle = np.array((self.near + self.far) / 2), np.array((self.low + self.high) / 2)
        series = range_series.range_series(self.geometry, *middle, order=REFERENCE_ORDER)
        return np.asarray(series - self.recovery.common.taylor(REFERENCE_ORDER))


def ground_range(geometry: Geometry, near: float, far: float) -> GroundRange:
    """Ground range coordinate from near to far, m; it allows for mountains nearer than the nadir."""
    height = float(geometry.epoch_position[2] - geometry.collection.ground_height)
    return GroundRange(near=near, far=far, height=min(height, near))
