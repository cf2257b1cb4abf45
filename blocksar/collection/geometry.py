"""Fitted track, polar frames, exact range histories and ground points.

Two epochs matter. The scene's polar frame (R, theta) is centred on the platform's nadir at t = 0; yaw and the beam are
described in it. Processing counts time from the middle of the aperture, the *epoch*, where keystone scaling distorts
least; the *epoch range* of a target is its range from the antenna at that time. Both epochs coincide where t = 0 is
the middle of the aperture.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.polynomial import Chebyshev, Polynomial, chebyshev

from blocksar import solvers
from blocksar.arrays import BoolArray, FloatArray
from blocksar.collection.beam import Beam, beam_of
from blocksar.collection.collection import Collection
from blocksar.collection.spline import Spline, fit_spline
from blocksar.collection.terrain import Terrain
from blocksar.errors import InputError

MAX_TRACK_ORDER = 12
BASE_ORDER = 5  # of the polynomial under a spline
TRACK_ACCURACY = 1e-5  # wavelengths of track misfit, too small to be visible in an image
SPLINE_ACCURACY = 2e-4  # wavelengths, a phase of 0.0025 rad: a spline need not be finer
MIN_INTERVALS, MAX_INTERVALS, PULSES_PER_INTERVAL = 8, 2048, 6  # of a spline
SPLINE_GAIN = 0.7  # a spline that leaves more of the polynomial's misfit than this is no gain: it is noise
SAME_MISFIT = 1.1  # times the misfit of the finest spline: a coarser one with less is preferred
MAX_EXTRAPOLATION = 2.0  # aperture lengths by which t = 0 may lie outside the collection


class AntennaState(NamedTuple):
    """Position (m), velocity (m/s) and acceleration (m/s^2) of the antenna, each (3, ...): axes first."""

    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray


@dataclass(frozen=True, kw_only=True, eq=False)
class Track:
    """Smooth track: a Chebyshev series over slow time per axis, plus a spline where a polynomial does not suffice.

    Attributes
    ----------
    coefficients : (order + 1, 3) float
        m, in the scaled variable u = (t - centre) / half.
    centre, half : float
        s.
    wobble : Spline or None
        What a measured track has besides the polynomial, (3,) m over slow time; None where it has nothing besides.
    misfit : (n_pulse, 3) float
        Sampled minus smooth position, m: noise.
    """

    coefficients: FloatArray
    centre: float
    half: float
    misfit: FloatArray
    wobble: Spline | None = None

    @property
    def order(self) -> int:
        return self.coefficients.shape[0] - 1

    @property
    def max_misfit(self) -> float:
        return float(np.abs(self.misfit).max())

    def __str__(self) -> str:
        spline = "" if self.wobble is None else f" and a spline of {self.wobble.n_interval} intervals"
        return f"a polynomial of order {self.order}{spline}"

    def position(self, time: FloatArray) -> FloatArray:
        """Antenna phase centre, (..., 3) m, at slow times of any shape."""
        return np.ascontiguousarray(np.moveaxis(self._derivative(time, 0), 0, -1))

    def velocity(self, time: FloatArray) -> FloatArray:
        """Antenna velocity, (..., 3) m/s, at slow times of any shape."""
        return np.ascontiguousarray(np.moveaxis(self._derivative(time, 1), 0, -1))

    def acceleration(self, time: FloatArray) -> FloatArray:
        """Antenna acceleration, (..., 3) m/s^2, at slow times of any shape."""
        return np.ascontiguousarray(np.moveaxis(self._derivative(time, 2), 0, -1))

    def motion(self, time: FloatArray) -> AntennaState:
        """Position, velocity and acceleration at slow times of any shape."""
        return AntennaState(*(self._derivative(time, n) for n in range(3)))

    @cached_property
    def base(self) -> Track:
        """The polynomial alone."""
        return replace(self, wobble=None)

    def _derivative(self, time: FloatArray, order: int) -> FloatArray:
        """Position or one of its derivatives, m/s^order, (3, ...)."""
        u = (np.asarray(time, dtype=np.float64) - self.centre) / self.half
        values = np.asarray(chebyshev.chebval(u, self._series[order]), np.float64)
        if order:
            values = values / self.half**order
        return values if self.wobble is None else values + np.moveaxis(self.wobble(time, order), -1, 0)

    @cached_property
    def _series(self) -> list[FloatArray]:
        """Series of the position and its derivatives in the scaled variable."""
        return [np.asarray(chebyshev.chebder(self.coefficients, n, axis=0), np.float64) for n in range(3)]


def fit_track(time: FloatArray, position: FloatArray, *, accuracy: float) -> Track:
    """Fit a polynomial of the lowest sufficient order to sampled positions.

    The order grows until the largest misfit is below `accuracy`, or until four more orders no longer
    halve it. If a spline describes the remaining motion, it is added to a polynomial of order BASE_ORDER. What
    remains then is noise; it is kept per pulse as `misfit`.

    Parameters
    ----------
    time : (n_pulse,) float
        s, ascending.
    position : (n_pulse, 3) float
        m.
    accuracy : float
        m.
    """
    centre, half = (time[0] + time[-1]) / 2, (time[-1] - time[0]) / 2
    u = (time - centre) / half
    # One orthogonal basis serves all orders: the basis of a lower order is its leading part.
    basis, r = solvers.orthogonal_basis(chebyshev.chebvander(u, min(MAX_TRACK_ORDER, time.size // 2 - 1)).T)
    projection, misfit = np.zeros((len(basis), 3)), position.T.copy()
    misfits = []
    for n, row in enumerate(basis):
        projection[n] = (misfit * row).sum(axis=1)
        misfit -= projection[n, :, None] * row
        misfits.append(float(np.abs(misfit).max()))
    order = len(misfits) - 1
    for n, largest in enumerate(misfits):
        if largest <= accuracy or (n >= 1 and min(misfits[n:][:5]) > largest / 2):
            order = n
            break

    def polynomial(order: int) -> Track:
        head = slice(0, order + 1)
        track = Track(
            coefficients=solvers.back_substitute(r[head, head], projection[head]),
            centre=float(centre),
            half=float(half),
            misfit=np.zeros_like(position),
        )
        return replace(track, misfit=position - track.position(time))

    track = polynomial(order)
    if track.max_misfit <= accuracy:
        return track
    base = polynomial(min(order, BASE_ORDER))
    spline = _fit_wobble(time, base.misfit, enough=accuracy * SPLINE_ACCURACY / TRACK_ACCURACY)
    if spline is None:
        return track
    noise = base.misfit - spline(time)
    return track if _rms(noise) > SPLINE_GAIN * _rms(track.misfit) else replace(base, wobble=spline, misfit=noise)


def _fit_wobble(time: FloatArray, misfit: FloatArray, *, enough: float) -> Spline | None:
    """Fit the coarsest spline that leaves at most `enough` m, or little more than the finest; None for few pulses."""
    tried: list[tuple[float, Spline]] = []
    n_interval = MIN_INTERVALS
    while n_interval <= min(time.size // PULSES_PER_INTERVAL, MAX_INTERVALS):
        spline = fit_spline(time, misfit, n_interval)
        remaining = misfit - spline(time)
        tried.append((_rms(remaining), spline))
        if np.abs(remaining).max() <= enough:
            break
        n_interval *= 2
    return next((spline for left, spline in tried if left <= SAME_MISFIT * tried[-1][0]), None)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values * values)))


@dataclass(frozen=True)
class Level:
    """A level ground at a height, m."""

    height: float

    def __call__(self, epoch_range: FloatArray, yaw: FloatArray) -> FloatArray:
        return np.full(np.broadcast_shapes(np.shape(epoch_range), np.shape(yaw)), self.height)


@dataclass(frozen=True, kw_only=True, eq=False)
class Geometry:
    """The fitted track of a collection, its nadir at t = 0 and its epoch; and the ground.

    Without a terrain the ground is the plane z = collection.ground_height. With one, a point (x, y) lies at its height,
    and the polar frame's point at a range and a yaw lies on a smooth surface that stands for the terrain.

    Attributes
    ----------
    collection : Collection
    terrain : Terrain or None
        The height at x, y.
    smooth : callable or None
        Height, m, of that surface at epoch ranges (m) and yaws (rad), broadcast; None: the plane. Planning has one for
        each block.
    """

    collection: Collection
    terrain: Terrain | None = None
    smooth: Callable[[FloatArray, FloatArray], FloatArray] | None = None

    def over(
        self, terrain: Terrain | None, smooth: Callable[[FloatArray, FloatArray], FloatArray] | None = None
    ) -> Geometry:
        """Copy over another ground, with all that was computed of the track."""
        return self._keeping_track(Geometry(collection=self.collection, terrain=terrain, smooth=smooth))

    def lit_by(self, collection: Collection) -> Geometry:
        """Copy under the beam of another collection, with all that was computed of the track."""
        return self._keeping_track(Geometry(collection=collection, terrain=self.terrain, smooth=self.smooth))

    @property
    def beam(self) -> Beam:
        """The beam over this ground."""
        return beam_of(self)

    def _keeping_track(self, other: Geometry) -> Geometry:
        kept = ("track", "tracks", "epoch", "nadir", "epoch_position", "track_powers")
        other.__dict__.update({name: self.__dict__[name] for name in kept if name in self.__dict__})
        return other

    @property
    def levels(self) -> tuple[Geometry, ...]:
        """The plane; on a terrain, planes at its lowest, mean and highest height, between which it lies."""
        if self.terrain is None:
            return (self,)
        low, high = self.terrain.limits
        return tuple(self.over(None, Level(height)) for height in (low, self.collection.ground_height, high))

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray | float:
        """Height z of ground points x, y (m), m: one number on the plane; NaN where the terrain has none."""
        return self.collection.ground_height if self.terrain is None else self.terrain(x, y)

    def known_height(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Height z of ground points x, y (m), of their shape, m, and where it is known; elsewhere it is the plane's."""
        z = np.broadcast_to(self.height(x, y), np.shape(x))
        known = np.isfinite(z)
        return z if known.all() else np.where(known, z, self.collection.ground_height), known

    def on_ground(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Points (..., 3), m, of the ground at x, y (m), broadcast."""
        x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        return np.stack([x, y, np.broadcast_to(self.height(x, y), x.shape)], axis=-1)

    def level(self, epoch_range: FloatArray, yaw: FloatArray) -> FloatArray | float:
        """Height, m, of the smooth ground at epoch ranges (m) and yaws (rad)."""
        return self.collection.ground_height if self.smooth is None else self.smooth(epoch_range, yaw)

    @cached_property
    def track(self) -> Track:
        collection = self.collection
        accuracy = TRACK_ACCURACY * collection.wavelength
        return fit_track(collection.time, collection.antenna_position, accuracy=accuracy)

    @cached_property
    def tracks(self) -> tuple[Track, ...]:
        """The tracks of the antennas: one, or those of transmitter and receiver."""
        collection = self.collection
        if not collection.bistatic:
            return (self.track,)
        accuracy = TRACK_ACCURACY * collection.wavelength
        positions = (getattr(collection, name) for name in collection.antennas)
        return tuple(fit_track(collection.time, position, accuracy=accuracy) for position in positions)

    def distance(self, point: FloatArray, time: FloatArray) -> FloatArray:
        """R of points (..., 3), m, at slow times, broadcast against the leading axes: half the way of two antennas."""
        ways = [np.linalg.norm(point - track.position(time), axis=-1) for track in self.tracks]
        return np.asarray(ways[0] if len(ways) == 1 else (ways[0] + ways[1]) / 2)

    def gradient(self, point: FloatArray, time: FloatArray) -> FloatArray:
        """Gradient (..., 3) of R at points (..., 3), m, at slow times, broadcast: of two antennas the mean of both."""
        sights = [point - track.position(time) for track in self.tracks]
        units = [sight / np.linalg.norm(sight, axis=-1, keepdims=True) for sight in sights]
        return np.asarray(units[0] if len(units) == 1 else (units[0] + units[1]) / 2)

    @cached_property
    def epoch(self) -> float:
        """Slow time of the middle pulse, s; processing counts time from here."""
        return float(self.collection.time[self.collection.n_pulse // 2])

    @cached_property
    def nadir(self) -> FloatArray:
        """Origin of the yaw, (2,) m: below the platform at t = 0.

        Raises
        ------
        InputError
            If t = 0 lies too far outside the collection to extrapolate the track.
        """
        time = self.collection.time
        outside = max(time[0], -time[-1], 0.0) / (time[-1] - time[0])
        if outside > MAX_EXTRAPOLATION:
            raise InputError(
                f"time runs from {time[0]:.6g} to {time[-1]:.6g} s: t = 0, which defines the polar frame, lies "
                f"{outside:.3g} aperture lengths outside; shift time so that t = 0 is in or near the collection"
            )
        return self.track.position(np.array(0.0))[:2]

    @cached_property
    def epoch_position(self) -> FloatArray:
        """Antenna position at the epoch, (3,) m."""
        return self.track.position(np.array(self.epoch))

    @cached_property
    def track_powers(self) -> list[FloatArray]:
        """Power coefficients of the polynomial track about the epoch, one array for each axis, m/s^n."""
        track = self.track
        axis = Polynomial([self.epoch - track.centre, 1.0]) / track.half
        return [
            np.asarray(Chebyshev(column).convert(kind=Polynomial)(axis).coef, np.float64)
            for column in track.coefficients.T
        ]

    def yaw(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Yaw of ground points about the nadir at t = 0: atan2(y - y0, x - x0), rad (paper A (33) misprints atan)."""
        return np.arctan2(y - self.nadir[1], x - self.nadir[0])

    def epoch_range(self, x: FloatArray, y: FloatArray, z: FloatArray | float | None = None) -> FloatArray:
        """Range from the antenna at the epoch to points, m; on the ground, unless z is given."""
        px, py, pz = self.epoch_position
        height = self.height(x, y) if z is None else z
        return np.asarray(np.sqrt((x - px) ** 2 + (y - py) ** 2 + (height - pz) ** 2))

    def ground_point(self, epoch_range: FloatArray, yaw: FloatArray) -> FloatArray:
        """Ground points (..., 3), m, at epoch ranges (m) and yaws (rad), broadcast; NaN where there is none.

        The point lies on the ray of that yaw from the nadir at t = 0, at the given distance from the
        antenna at the epoch. This is a quadratic equation in the distance from the nadir.
        """
        x, y = self.ground_axes(epoch_range, yaw)
        point = np.empty((*x.shape, 3))
        point[..., 0] = x
        point[..., 1] = y
        point[..., 2] = self.level(epoch_range, yaw)
        return point

    def ground_axes(self, epoch_range: FloatArray, yaw: FloatArray) -> tuple[FloatArray, FloatArray]:
        """x and y of `ground_point`, m."""
        px, py, pz = self.epoch_position
        height = self.level(epoch_range, yaw)
        cos, sin = np.cos(yaw), np.sin(yaw)
        dx, dy = px - self.nadir[0], py - self.nadir[1]
        along = cos * dx + sin * dy
        across2 = dx**2 + dy**2 - along**2
        with np.errstate(invalid="ignore"):
            distance = along + np.sqrt(epoch_range**2 - (height - pz) ** 2 - across2)
        distance = np.where(distance > 0, distance, np.nan)
        return self.nadir[0] + distance * cos, self.nadir[1] + distance * sin

    def range_history(self, point: FloatArray, time: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Exact R (m) and its rate (m/s) of points (..., 3) at slow times, broadcast against the leading axes."""
        seen = []
        for track in self.tracks:
            sight = np.moveaxis(point - track.position(time), -1, 0)
            distance = np.sqrt(_inner(sight, sight))
            seen.append((distance, -_inner(sight, np.moveaxis(track.velocity(time), -1, 0)) / distance))
        if len(seen) == 1:
            return seen[0]
        return (seen[0][0] + seen[1][0]) / 2, (seen[0][1] + seen[1][1]) / 2


def over_terrain(collection: Collection, terrain: Terrain | None) -> Geometry:
    """Put a collection over a terrain; None: over the plane z = ground_height.

    The plane that stands for the terrain in the large lies at its mean height.

    Raises
    ------
    InputError
        If that is not below the antenna.
    """
    if terrain is None:
        return Geometry(collection=collection)
    lowest = float(collection.antenna_position[:, 2].min())
    if terrain.mean >= lowest:
        raise InputError(
            f"the terrain lies at z = {terrain.mean:.6g} m on average, and the antenna falls to {lowest:.6g} m; "
            "correct the unit or the datum of its heights"
        )
    level = Collection(**{**collection.as_dict(), "ground_height": terrain.mean})
    return Geometry(collection=level, terrain=terrain)


def range_motion(
    point: tuple[FloatArray, FloatArray, FloatArray | float], antenna: AntennaState
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Range (m) of points, its rate (m/s), and the rate of that (m/s^2), as the antenna moves.

    The last is (v.v - s.a - rate^2) / range, with s the line of sight. `point` holds x, y and z (...), m, which are
    broadcast against the times of the motion.
    """
    sight, velocity = [place - at for place, at in zip(point, antenna.position, strict=True)], antenna.velocity
    distance = np.sqrt(_inner(sight, sight))
    rate = -_inner(sight, velocity) / distance
    pull = _inner(sight, antenna.acceleration)
    return distance, rate, (_inner(velocity, velocity) - pull - rate**2) / distance


def _inner(a: Sequence[FloatArray] | FloatArray, b: Sequence[FloatArray] | FloatArray) -> FloatArray:
    """Inner products of vectors whose axes (3, ...) come first: (...)."""
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])
