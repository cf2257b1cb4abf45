"""The ground map of a block: surfaces of range, Doppler, phase, gain and dwell time over the ground."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.collection.beam import weighted_pulses, wrapped
from blocksar.collection.geometry import Geometry
from blocksar.collection.region import Region
from blocksar.collection.weighting import Taper
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.imaging.pattern_sums import ElevationMeans, mean_elevations
from blocksar.kernels.fourier import Axis
from blocksar.processors.chain.ground.surfaces import Surface, sum_layers
from blocksar.processors.chain.steps.lines import Focus, Line, RowPolynomial, focus

BEYOND = 1.2  # half extents of its domain from its middle, at which a smooth ground ends
ASIDE = 0.02  # of the range, from the point below the antenna to the nearest that is traced
SHORT = 0.05  # of the fourth moment of the longest dwells: half of their length
QUANTITIES = 6  # range offset, Doppler, phase, gain, time and bend


@dataclass(frozen=True, kw_only=True)
class Depth:
    """Lowest height that points can have at an epoch range and yaw, below an antenna at x, y, z, m, from the nadir.

    Close to the nadir no point lies as low as the lowest ground of a block. What is traced there lies a little aside of
    the point below the antenna, `ASIDE` of the range.
    """

    x: float
    y: float
    z: float

    def __call__(self, epoch_range: FloatArray, yaw: FloatArray) -> FloatArray:
        """Lowest z (m) of points at epoch ranges (m) and yaws (rad), broadcast."""
        along = np.cos(yaw) * self.x + np.sin(yaw) * self.y
        across2 = self.x**2 + self.y**2 - along**2
        aside = np.maximum(-along, 0.0) + ASIDE * epoch_range
        return np.asarray(self.z - np.sqrt(np.maximum(epoch_range**2 - across2 - aside**2, 0.0)))


@dataclass(frozen=True, kw_only=True, eq=False)
class SmoothGround:
    """A smooth ground that stands for a block's terrain: height, m, over ground range and yaw, and an offset, m.

    It goes on level beyond BEYOND, and is nowhere deeper than points are.
    """

    surface: Surface
    depth: Depth
    offset: float = 0.0

    def __call__(self, epoch_range: FloatArray, yaw: FloatArray) -> FloatArray:
        places = self.surface.along.place(epoch_range), self.surface.across(yaw)
        height = self.surface.at(*(np.clip(place, -BEYOND, BEYOND) for place in places)) + self.offset
        return np.maximum(height, self.depth(epoch_range, yaw))


@dataclass(frozen=True, kw_only=True, eq=False)
class NodeHeights:
    """Smooth ground plus heights at nodes, m; the heights are added only to arguments of the nodes' shape."""

    smooth: SmoothGround
    over: FloatArray

    def __call__(self, epoch_range: FloatArray, yaw: FloatArray) -> FloatArray:
        height = self.smooth(epoch_range, yaw)
        if height.shape != self.over.shape:
            return height
        return np.maximum(height + self.over, self.smooth.depth(epoch_range, yaw))


@dataclass(frozen=True, kw_only=True, eq=False)
class ReliefMap:
    """Focus of points on a block's terrain by epoch range, yaw and height over the smooth ground.

    Attributes
    ----------
    smooth : SmoothGround
    low, high : float
        Least and greatest height over the smooth ground, m.
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
        """Turn of the phase of points (...), rad."""
        if not self.turns:
            return np.zeros(np.shape(z))
        u, v, w = self._coordinates(epoch_range, yaw, z)
        terms = np.array([[term.series for term in self.turns]])
        values = np.empty((1, 1, w.size))
        sum_layers(terms, u.reshape(1, -1), v.ravel(), w.reshape(1, -1), values)
        return values.reshape(w.shape)

    def _coordinates(self, epoch_range: FloatArray, yaw: FloatArray, z: FloatArray) -> tuple[FloatArray, ...]:
        """Range, yaw and height over the smooth ground, each scaled to -1 .. 1 over the surfaces' domain."""
        first = self.layers[0][0]
        return (
            first.along.place(epoch_range),
            first.across(yaw),
            (2 * (z - self.smooth(epoch_range, yaw)) - self.low - self.high) / (self.high - self.low),
        )

    @cached_property
    def _series(self) -> FloatArray:
        """Stack all series (n_quantity, n_term, ..), which share one domain."""
        every = (*self.layers, *([self.turns] if self.turns else []))
        return np.array([[term.series for term in terms] for terms in every])


def straighten(line: Line, about: Callable[[Focus], FloatArray]) -> tuple[Line, FloatArray, Focus]:
    """Remove the quadratic phase of lines; return these, its coefficient (...), cycles/s^2, and their focus.

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
    # The bend of a dwell that is cut short is negligible.
    power = mean(square**2)
    bend = mean(level * square) / np.maximum(power, SHORT * power.max())
    bent, offset = bend[..., None], line.time - about(spots)[..., None]
    straight = line.multiply_time(-bent * offset**2, -2 * bent * offset, np.broadcast_to(-2 * bent, offset.shape))
    return straight, bend, focus(straight)


LIT_RANGES = 33  # of the sum over lit pulses, where that depends on range
LEAST_LIT = 0.3  # pulses at the peak of the pattern: with a smaller sum a pixel counts as not lit
LEAST_WEIGHT = 0.007  # of a whole dwell under a taper: a share of 10 % under hann, 4 % under hamming, 2 % under taylor
WHOLE_DWELLS = 64  # directions in which the longest dwell is looked for
ELEVATIONS_AT_ONCE = 1 << 16  # points at which means of a pattern in elevation are taken together
TILE_EXTENT, TILE_SHARE = 150.0, 1 / 8  # m, and of a block along range and yaw: see `tile_extent`
YAW_STEPS = 4096  # of the range window's limits and the number of lit pulses along yaw


@dataclass(frozen=True, kw_only=True, eq=False)
class GroundMap:
    """Map of ground points to a block's image: position and complex value of a unit target's peak.

    Attributes
    ----------
    geometry : Geometry
    low, high : float
        Yaw interval of this block, [low, high), rad.
    near, far : float
        Epoch ranges of this block, [near, far), m.
    levels : (float, float)
        Least and greatest z of its ground, m.
    origin : float
        Range origin, m.
    rows, doppler : Axis
        Axes of the focused block.
    range_offset : Surface
        Apparent range of the focus less (epoch range - origin), m.
    doppler_focus : Surface
        Doppler of the focus, Hz.
    phase : Surface
        Phase of the focus, cycles, less the carrier's -2 fc / c (epoch range - origin).
    gain : Surface
        Gain of the focus, near 1.
    time : Surface
        Middle of the dwell after all steps, s: the carrier of a target's response along Doppler.
    common : RowPolynomial or None
        Phase of the image along Doppler that the dwell gate leaves in all rows, cycles.
    yaw_axis : (n,) float
        Uniform yaws from low to high, rad, for the two limits and the number of lit pulses.
    near_limit, far_limit : (n,) float
        Epoch ranges at the ends of the range window at each yaw, m.
    taper, range_taper : Taper
        Weighting over the dwells, and over the band.
    scale : float
        n_range_frequency / period of the range transform, times the mean weight over range frequency.
    range_taps, doppler_taps : (int, float)
        Taps of the interpolation, and the occupied fraction of the sampling rate.
    tap_error : float
        What the taps may err by, from `budget.image_tap_error`.
    relief : ReliefMap or None
        The same with the height as third coordinate, which a terrain needs in place of the five surfaces.
    valid : (n_pulse,) float or None
        The fraction of each pulse's samples that is there; None: all of them.
    tilt : Surface or None
        Where there is a pattern in elevation: how fast what the chain makes of echoes grows over the dwell, from -1 to
        1, over its mean, the gain.
    """

    geometry: Geometry
    low: float
    high: float
    near: float
    far: float
    levels: tuple[float, float]
    origin: float
    rows: Axis
    doppler: Axis
    range_offset: Surface
    doppler_focus: Surface
    phase: Surface
    gain: Surface
    time: Surface
    common: RowPolynomial | None
    yaw_axis: FloatArray
    near_limit: FloatArray
    far_limit: FloatArray
    taper: Taper
    range_taper: Taper
    scale: float
    range_taps: tuple[int, float]
    doppler_taps: tuple[int, float]
    tap_error: float
    relief: ReliefMap | None = None
    valid: FloatArray | None = None
    tilt: Surface | None = None

    @cached_property
    def lit(self) -> FloatArray:
        """Sum of `valid` times the taper over the lit pulses, at each yaw (n,).

        Where dwells depend on range, or the antenna has a pattern over the beam, which weighs the pulses besides:
        (n_range, n), at LIT_RANGES from near to far. A pattern in elevation does not
        count: see `elevation_means`. Only a block that is focused needs them, not one that is planned.
        """
        geometry, taper = self.geometry, self.taper
        if geometry.collection.elevation_pattern is not None:
            geometry = geometry.lit_by(geometry.collection.without_elevation)
        valid = np.ones(geometry.collection.n_pulse) if self.valid is None else self.valid
        if not by_range(geometry):
            return weighted_pulses(geometry.collection, self.yaw_axis, valid, taper)
        ranges = np.linspace(self.near, self.far, LIT_RANGES)
        return geometry.beam.lit_total(ranges, self.yaw_axis, valid, taper)

    @property
    def least_lit(self) -> float:
        """Smallest sum over lit pulses of a pixel that counts as lit."""
        return LEAST_LIT * self.geometry.collection.peak_gain

    @cached_property
    def weight(self) -> FloatArray:
        """Divisor of pixels as a table over range and yaw; if it depends on yaw alone, its reciprocal, (1, n)."""
        if self.lit.ndim > 1:
            return self.lit * self.scale
        weight = (1.0 / np.maximum(self.lit, 1e-9) / self.scale)[None]
        weight[:, self.lit <= self._least_weight] = np.nan
        return weight

    @property
    def _least_weight(self) -> float:
        """Smallest sum of a taper's weights of a pixel that counts as lit: dividing by less would amplify residues."""
        collection = self.geometry.collection
        if self.taper.uniform or not collection.steered:
            return 0.0
        beam = collection.beam_azimuth[:: max(collection.n_pulse // WHOLE_DWELLS, 1)]
        return LEAST_WEIGHT * float(weighted_pulses(collection, beam, np.ones(collection.n_pulse), self.taper).max())

    @property
    def middle_yaw(self) -> float:
        return (self.low + self.high) / 2

    def relative_yaw(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Yaw less the block's middle, wrapped to +-pi."""
        return wrapped(self.geometry.yaw(x, y) - self.middle_yaw)

    def elevation_means(self, x: FloatArray, y: FloatArray) -> ElevationMeans:
        """Means over lit pulses of the pattern in elevation at ground points (...), m: `lit` is multiplied by them."""
        flat, shape = [np.ravel(axis)[None] for axis in (x, y)], np.shape(x)
        means = np.empty((len(ElevationMeans._fields), flat[0].size))
        for part in (slice(first, first + ELEVATIONS_AT_ONCE) for first in range(0, flat[0].size, ELEVATIONS_AT_ONCE)):
            means[:, part] = self._elevation_means(*(axis[:, part] for axis in flat))
        return ElevationMeans(*(each.reshape(shape) for each in means))

    def _elevation_means(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Means of points (1, n) under a pattern in elevation: (3, n)."""
        geometry, (z, _) = self.geometry, self.geometry.known_height(x, y)
        passes = geometry.beam.passes(x, y, z)
        return np.concatenate(mean_elevations(geometry, x, y, z, passes=passes, valid=self.valid, taper=self.taper))

    def tilted_gain(self, x: FloatArray, y: FloatArray, tilt: FloatArray) -> FloatArray:
        """Factor of the gain at ground points (...), m, from the tilt of the dwell by a pattern in elevation."""
        if self.tilt is None:
            return np.ones(np.shape(x))
        yaw = self.middle_yaw + self.relative_yaw(x, y)
        return 1 + self.tilt(self.geometry.epoch_range(x, y), yaw) * tilt

    def widened(self, region: Region, room: float) -> GroundMap:
        """Copy with limits and sums over lit pulses extended by `room`, rad, beyond the block."""
        yaw = np.linspace(self.low - room, self.high + room, self.yaw_axis.size)
        near_limit, far_limit = region.at(yaw)
        return replace(self, yaw_axis=yaw, near_limit=near_limit, far_limit=far_limit)

    def doppler_slope(self) -> FloatArray:
        """Doppler of the focus per yaw, Hz/rad, over the block's ranges and yaws (9, 33)."""
        rng = np.linspace(self.near, self.far, 9)
        yaw = np.linspace(self.low, self.high, 33)
        rng_, yaw_ = np.meshgrid(rng, yaw, indexing="ij")
        return np.gradient(self.doppler_focus(rng_, yaw_), yaw, axis=1)

    def locate(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, ...]:
        """Row and Doppler index, phase (cycles), 1 / gain, relative yaw and dwell time (cycles per Doppler sample)."""
        geometry = self.geometry
        epoch_range = geometry.epoch_range(x, y)
        turn = self.relative_yaw(x, y)
        yaw = self.middle_yaw + turn
        offset = epoch_range - self.origin
        rng = offset + self.range_offset(epoch_range, yaw)
        doppler = self.doppler_focus(epoch_range, yaw)
        carrier = -2 * geometry.collection.carrier / SPEED_OF_LIGHT * offset
        cycles, time = carrier + self.phase(epoch_range, yaw), self.time(epoch_range, yaw)
        if self.common is not None:
            common, rate, _ = self.common.evaluate(rng, doppler[..., None])
            cycles, time = cycles + common[..., 0], time - rate[..., 0]
        return (
            self.rows.position(rng),
            self.doppler.position(doppler),
            cycles,
            1 / self.gain(epoch_range, yaw),
            turn,
            time * self.doppler.step,
        )


def tile_extent(geometry: Geometry, low: float, high: float, near: float, far: float) -> tuple[float, float]:
    """Largest side of a block's tiles of pixels, m, and how far they reach beyond the yaws low .. high, rad.

    Over a tile each quantity of the map is a polynomial of `pixel_rows.TILE_DEGREE`, which holds to a millicycle over
    TILE_EXTENT. It goes through places anywhere in the tile, of which the block may own a corner only.
    """
    point = geometry.ground_point(np.array(near), np.array((low + high) / 2))
    narrow = float(np.hypot(*(point[:2] - geometry.nadir)))
    side = min(TILE_EXTENT, TILE_SHARE * (high - low) * narrow, TILE_SHARE * (far - near))
    return side, float(np.arcsin(min(np.sqrt(2) * side / narrow, 1.0)))


def by_range(geometry: Geometry) -> bool:
    """Tell whether the sum over lit pulses depends on range."""
    return geometry.beam.by_range or geometry.collection.beam_pattern is not None
