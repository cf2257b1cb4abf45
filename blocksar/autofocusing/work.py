"""Inputs of an estimate: the geometry, the short apertures, the blocks of pulses and the samples of chips."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.collection.region import Region, plan_region
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError


@dataclass(frozen=True, kw_only=True)
class EstimatorSettings:
    """Settings of the estimator.

    Attributes
    ----------
    points : int
        Prominent points that are kept.
    least_points : int
        With fewer, nothing is estimated.
    lines : int
        Range lines of a chip, odd.
    line_spacing : float
        Range cells between them.
    speed : float
        Line-of-sight speeds within +- this keep a point inside the Doppler band of its chip, m/s.
    narrow_speed : float
        Likewise after the phase gradient.
    acceleration : float
        Line-of-sight acceleration that a short aperture bears, m/s^2.
    intervals : int
        Of the finest spline, at most.
    roughness : float
        Acceleration of the error, m/s^2 rms, at which the smoothness prior costs `prior`.
    displacement : float
        Error, m rms, that likewise costs `prior`.
    prior : float
        Entropy, in nats a chip.
    loops : int
        At most; chips are taken anew for each.
    step : float
        Loops end when one changes the phases by less, rad rms.
    halves : float
        Two estimates from disjoint halves of the points may differ by this, rad rms.
    """

    points: int = 75
    least_points: int = 20
    lines: int = 7
    line_spacing: float = 0.8
    speed: float = 2.0
    narrow_speed: float = 0.6
    acceleration: float = 4.0
    intervals: int = 128
    roughness: float = 4.0
    displacement: float = 0.2
    prior: float = 0.02
    loops: int = 6
    step: float = 0.03
    halves: float = 0.2


BLOCK = 512  # pulses whose samples are in memory at a time, about
LEAST_PULSES = 64
LEAST_SAMPLES = 4096  # of a chip over the collection, if it has enough pulses: a random walk needs them
COARSE_SAMPLES = 1024  # likewise where only smooth errors are looked for
APERTURES = 5  # short ones within a dwell
FILTER_LENGTH = 7  # decimated samples: of the low-pass filter; odd, so that it lies about a sample's centre
FILTER_BAND = 0.8  # of a chip's sampling rate
FILTER_BETA = 5.0  # of its Kaiser window


@dataclass(frozen=True, kw_only=True, eq=False)
class Work:
    """Geometry, region and settings of an estimate, and the divisions that follow; samples are not included.

    Attributes
    ----------
    geometry : Geometry
        With the track as stated. On a terrain points stand on it; they are looked for on the plane z = ground_height.
    region : Region
        In which points are looked for.
    settings : EstimatorSettings
    """

    geometry: Geometry
    region: Region
    settings: EstimatorSettings = field(default_factory=EstimatorSettings)

    @cached_property
    def wavenumber(self) -> float:
        """4 pi f / c at the middle frequency, rad/m: phase over range."""
        collection = self.geometry.collection
        middle = collection.range_frequency[collection.n_range_frequency // 2]
        return float(4 * np.pi * (collection.carrier + middle) / SPEED_OF_LIGHT)

    @cached_property
    def plane(self) -> Geometry:
        """Geometry over the plane, without the terrain."""
        return self.geometry.over(None)

    @cached_property
    def cell(self) -> float:
        """Range cell, m."""
        return SPEED_OF_LIGHT / (2 * self.geometry.collection.bandwidth)

    @cached_property
    def dwell(self) -> int:
        """Largest number of pulses that light a point."""
        yaw = np.linspace(self.region.yaw[0], self.region.yaw[-1], 33)
        near, far = self.region.at(yaw)
        x, y = self.plane.ground_axes((near + far) / 2, yaw)
        lit = np.isfinite(x)
        return max(min(self.plane.beam.most_lit_pulses(x[lit], y[lit]), self.geometry.collection.n_pulse), 1)

    @cached_property
    def short(self) -> int:
        """Number of pulses of a short aperture, over which the assumed acceleration turns the phase by 1 rad."""
        seconds = math.sqrt(8 / (self.wavenumber * self.settings.acceleration))
        return int(np.clip(round(seconds * self.geometry.collection.prf), 8, max(self.dwell // 4, 8)))

    @cached_property
    def apertures(self) -> tuple[slice, ...]:
        """Short apertures, as slices of pulses, in which points are searched for."""
        n, size = self.geometry.collection.n_pulse, self.short
        count = max(math.ceil(APERTURES * n / self.dwell), 1)
        starts = {round((k + 0.5) / count * n - size / 2) for k in range(count)}
        return tuple(slice(first, first + size) for first in sorted(starts) if first >= 0 and first + size <= n)

    @cached_property
    def blocks(self) -> tuple[slice, ...]:
        """Blocks of pulses from which chips are taken; each pulse belongs to one."""
        n = self.geometry.collection.n_pulse
        return tuple(slice(first, min(first + BLOCK, n)) for first in range(0, n, BLOCK))

    @cached_property
    def decimation(self) -> int:
        """Number of pulses for each sample of a chip."""
        collection = self.geometry.collection
        return max(min(int(collection.prf / self._rate), collection.n_pulse // LEAST_SAMPLES), 1)

    @property
    def coarse(self) -> int:
        """Number of chip samples for each sample of the search for smooth errors."""
        rate = self.geometry.collection.prf / self.decimation
        return max(min(int(rate / self._rate), self.n_sample // COARSE_SAMPLES), 1)

    @property
    def _rate(self) -> float:
        """Sampling rate, Hz, that holds errors of `EstimatorSettings.speed`."""
        return self.settings.speed * self.wavenumber / np.pi / FILTER_BAND

    @cached_property
    def n_sample(self) -> int:
        """Number of samples of a chip over the whole collection."""
        return self.geometry.collection.n_pulse // self.decimation

    def chip_bytes(self, least_points: int = 0) -> int:
        """Upper bound of the memory of all points' chips, bytes."""
        samples = -(-min(self.dwell, self.geometry.collection.n_pulse) // self.decimation)
        return 8 * max(self.settings.points, least_points) * self.settings.lines * samples

    @cached_property
    def sample_pulses(self) -> FloatArray:
        """Centres of the chips' samples (n_sample,), in pulses."""
        return np.asarray(np.arange(self.n_sample) * float(self.decimation) + (self.decimation - 1) / 2, np.float64)

    @cached_property
    def sample_times(self) -> FloatArray:
        """Slow times of the chips' samples (n_sample,), s."""
        collection = self.geometry.collection
        return np.asarray(np.interp(self.sample_pulses, np.arange(collection.n_pulse), collection.time))


def low_pass(decimation: int) -> FloatArray:
    """Weights (n,) of samples about the middle of each `decimation` of them; one of 1 if that is 1."""
    if decimation == 1:
        return np.ones(1)
    n = FILTER_LENGTH * decimation
    at = (np.arange(n) - (n - 1) / 2) / decimation
    weights = np.asarray(np.sinc(FILTER_BAND * at) * np.kaiser(n, FILTER_BETA), np.float64)
    return weights / float(weights.sum())


def begin(geometry: Geometry, grid: Grid | None = None, settings: EstimatorSettings | None = None) -> Work:
    """Prepare an estimate from a collection's geometry.

    Raises
    ------
    InputError
        From `plan_region`, or if there are too few pulses.
    """
    n = geometry.collection.n_pulse
    if n < LEAST_PULSES:
        raise InputError(f"time has {n} pulses, but the track's error cannot be told from fewer than {LEAST_PULSES}")
    return Work(
        geometry=geometry, region=plan_region(geometry.over(None), grid), settings=settings or EstimatorSettings()
    )
