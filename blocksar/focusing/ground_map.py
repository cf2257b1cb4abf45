"""The ground map of a block: surfaces of range, Doppler, phase, gain and dwell time over the ground."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.collection.beam import lit_passes, wrapped
from blocksar.collection.geometry import Geometry
from blocksar.collection.lit_sums import lit_total, weighted_pulses
from blocksar.collection.region import Region
from blocksar.collection.weighting import Taper
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.focusing.lines import Focus, RowPolynomial
from blocksar.focusing.pattern_sums import ElevationMeans, mean_elevations
from blocksar.focusing.relief_map import ReliefMap
from blocksar.focusing.surfaces import GroundRange, Surface, fit_surface
from blocksar.kernels.fourier import Axis

LIT_RANGES = 33  # of the sum over lit pulses, where that depends on range
LEAST_LIT = 0.3  # pulses at the peak of the pattern: with a smaller sum a pixel counts as not lit
LEAST_WEIGHT = 0.007  # of a whole dwell under a taper: a share of 10 % under hann, 4 % under hamming, 2 % under taylor
WHOLE_DWELLS = 64  # directions in which the longest dwell is looked for
ELEVATIONS_AT_ONCE = 1 << 16  # points at which means of a pattern in elevation are taken together
TILE_EXTENT, TILE_SHARE = 150.0, 1 / 8  # m, and of a block along range and yaw: see `tile_extent`
YAW_STEPS = 4096  # of the range window's limits and the number of lit pulses along yaw


@dataclass(frozen=True, kw_only=True, eq=False)
class GroundMap:
    """The position of each ground point in a block's image, and the complex value of a unit target there.

    Attributes
    ----------
    geometry : Geometry
    low, high : float
        Yaw interval of this block, [low, high), rad.
    near, far : float
        Epoch ranges of this block, [near, far), m.
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
        """Number of lit pulses at each yaw (n,), missing ones left out: the sum of `valid` times the taper.

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
        return lit_total(geometry, ranges, self.yaw_axis, valid, taper)

    @property
    def levels(self) -> tuple[float, float]:
        """Least and greatest z of the block's ground, m."""
        if self.relief is None:
            return self.geometry.collection.ground_height, self.geometry.collection.ground_height
        return self.relief.lowest, self.relief.highest

    @property
    def least_lit(self) -> float:
        """The sum over lit pulses below which a pixel is not lit."""
        return LEAST_LIT * self.geometry.collection.peak_gain

    @cached_property
    def weight(self) -> FloatArray:
        """What a pixel's sum is divided by, as a table over range and yaw; or one over that, (1, n), over yaw alone."""
        if self.lit.ndim > 1:
            return self.lit * self.scale
        weight = (1.0 / np.maximum(self.lit, 1e-9) / self.scale)[None]
        weight[:, self.lit <= self._least_weight] = np.nan
        return weight

    @property
    def _least_weight(self) -> float:
        """The sum of a taper's weights up to which a pixel counts as not lit: it would divide what others leave."""
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

    def elevation_means(self, x: FloatArray, y: FloatArray, z: FloatArray | None) -> ElevationMeans:
        """Means over lit pulses of the pattern in elevation at ground points (...), m: `lit` is multiplied by them."""
        flat, shape = [np.ravel(axis)[None] for axis in (x, y, *([] if z is None else [z]))], np.shape(x)
        means = np.empty((len(ElevationMeans._fields), flat[0].size))
        for part in (slice(first, first + ELEVATIONS_AT_ONCE) for first in range(0, flat[0].size, ELEVATIONS_AT_ONCE)):
            means[:, part] = self._elevation_means(*(axis[:, part] for axis in flat))
        return ElevationMeans(*(each.reshape(shape) for each in means))

    def _elevation_means(self, x: FloatArray, y: FloatArray, z: FloatArray | None = None) -> FloatArray:
        """The same of points (1, n): (3, n)."""
        geometry, settings = self.geometry, dict[str, Any](valid=self.valid, taper=self.taper)
        at: Any = x, y, None if z is None else z - geometry.collection.ground_height
        means = mean_elevations(geometry, *at, passes=lit_passes(geometry, x, y, z), **settings)
        return np.concatenate(means)

    def tilted_gain(self, x: FloatArray, y: FloatArray, z: FloatArray | None, tilt: FloatArray) -> FloatArray:
        """What the gain is multiplied by at ground points (...), m, whose dwells a pattern in elevation tilts."""
        if self.tilt is None:
            return np.ones(np.shape(x))
        yaw = self.middle_yaw + self.relative_yaw(x, y)
        return 1 + self.tilt(self.geometry.epoch_range(x, y, z), yaw) * tilt

    def widened(self, region: Region, room: float) -> GroundMap:
        """The same with limits and sums over lit pulses known `room`, rad, beyond the block."""
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
    """The side of a block's tiles of pixels at most, m, and by how much they reach beyond its yaws low .. high, rad.

    Over a tile each quantity of the map is a polynomial of `pixel_rows.TILE_DEGREE`, which holds to a millicycle over
    TILE_EXTENT. It goes through places anywhere in the tile, of which the block may own a corner only.
    """
    point = geometry.ground_point(np.array(near), np.array((low + high) / 2))
    narrow = float(np.hypot(*(point[:2] - geometry.nadir)))
    side = min(TILE_EXTENT, TILE_SHARE * (high - low) * narrow, TILE_SHARE * (far - near))
    return side, float(np.arcsin(min(np.sqrt(2) * side / narrow, 1.0)))


def by_range(geometry: Geometry) -> bool:
    """Whether the sum over lit pulses depends on range."""
    return geometry.collection.has_axis or geometry.collection.beam_pattern is not None


def surfaces(
    focus: Focus, *, time: FloatArray, along: GroundRange, epoch_range: FloatArray, yaw: FloatArray, origin: float,
    carrier: float, degree: tuple[int, int],
) -> tuple[Surface, Surface, Surface, Surface, Surface]:  # fmt: skip
    """Range offset, Doppler, phase, gain and time over the ground from lines at the nodes `along` it, and their focus.

    `time` (n_range, n_yaw), s, is that about which responses are interpolated along Doppler.
    """
    offset = (epoch_range - origin)[:, None]
    carrier_cycles = -2 * carrier / SPEED_OF_LIGHT * offset
    grid = {"along": along, "yaw": yaw, "degree": degree}
    return (
        fit_surface(focus.range - offset, **grid),  # type: ignore[arg-type]
        fit_surface(focus.doppler, **grid),  # type: ignore[arg-type]
        fit_surface(focus.phase - carrier_cycles, **grid),  # type: ignore[arg-type]
        fit_surface(focus.gain, **grid),  # type: ignore[arg-type]
        fit_surface(time, **grid),  # type: ignore[arg-type]
    )
