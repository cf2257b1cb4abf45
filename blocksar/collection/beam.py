"""Beams: the pulses that light a ground point, their times, and their weights.

A `YawScan` lights a point while |wrapped(yaw - beam_azimuth)| <= beam_width / 2, where yaw is the point's angle about
the platform's nadir at t = 0. An `AxisScan`, about the antenna's own axis (`axis_beam`), lights it while
|asin(u . beam_axis) - beam_steering| <= beam_width / 2, with u the unit vector from the antenna to the point, on the
side of the track that the antenna lights, if that is known. Points on the very edge are lit. An `Unsteered` beam lights
every point with every pulse. `Geometry.beam` is one of the three.

`in_beam` is the first rule for plain angles; compiled loops wrap it by `numba.njit(inline="always")`. `is_lit` and
`passes` compare without tolerance; `dwell_at`, `yaw_interval` and the sums over lit pulses allow for the rounding of
computed yaws (`EDGE`).
Points x, y lie on the ground, or at heights z, m, which count under a beam about its axis and in elevation patterns.

Where several collections, or segments of one, see a pixel, the one that saw more of its dwell forms it.

The share of a point's dwell that a collection saw is 1 + margin / dwell, with the margin by which the dwell lies inside
the collection's time, below 0 where an end of the collection cuts it. Where several saw all of it, the one with the
larger margin counts, so that a seam runs through the middle of what they share.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Protocol, TypeVar

import numpy as np

from blocksar.arrays import BoolArray, FloatArray, IntArray
from blocksar.collection.axis_beam import (
    GroundPoints,
    Height,
    axis_dwell,
    axis_offset,
    axis_passes,
    axis_passing,
    on_lit_side,
)
from blocksar.collection.collection import Collection
from blocksar.collection.weighting import FLAT, Taper
from blocksar.constants import TURN
from blocksar.errors import InputError

Angle = TypeVar("Angle", float, FloatArray)
Pulses = slice | IntArray | int

# rad; 3 micrometres at 30 km. The only tolerance, for yaws that were themselves computed from the beam's edge: they
# carry rounding errors (4e-16 at pi, 1e-14 at 100 rad, 1e-11 where coordinates are large) and still count as on it.
STILL = 1e-9  # rad: a beam that turns by less stands still
EDGE = 1e-10
CENTRE_NODES = 65  # yaws between which the centre of a beam about its axis is interpolated
GAIN_PARTS = 32  # of a dwell, in each of which weights and the antenna's pattern are taken as constant
NOT_STEERED = "not steered: it lights everything all the time, so that a grid is needed"  # of a beam, for people


# ---------------------------------------------------------------- angles


def wrapped(angle: Angle) -> Angle:
    """Wrap an angle to [-pi, pi], rad; exactly the input where it lies there already."""
    return angle - TURN * np.rint(angle / TURN)


def turned_near(angle: Angle, centre: float) -> Angle:
    """Turn an angle by whole circles to within pi of `centre`, rad."""
    # Not centre + wrapped(angle - centre): plans depend on this rounding, and must repeat to the bit.
    return centre + np.mod(angle - centre + np.pi, TURN) - np.pi


def in_beam(yaw: FloatArray | float, azimuth: FloatArray | float, half_width: float) -> BoolArray:
    """Whether |wrapped(yaw - azimuth)| <= half_width, for numbers or arrays (broadcast), rad.

    `wrapped` is written out, so that numba compiles this function as it is.
    """
    away = yaw - azimuth
    return np.abs(away - TURN * np.rint(away / TURN)) <= half_width


# ---------------------------------------------------------------- beams


class Lit(Protocol):
    """Geometry as far as beams need it: a collection over its ground; see `collection.geometry.Geometry`."""

    @property
    def collection(self) -> Collection: ...

    @property
    def beam(self) -> Beam: ...

    def yaw(self, x: FloatArray, y: FloatArray) -> FloatArray: ...

    def ground_axes(self, epoch_range: FloatArray, yaw: FloatArray) -> tuple[FloatArray, FloatArray]: ...

    def level(self, epoch_range: FloatArray, yaw: FloatArray) -> FloatArray | float: ...

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray | float: ...

    def lit_by(self, collection: Collection) -> Lit: ...


def beam_of(geometry: Lit) -> Beam:
    """The beam of a collection over its ground."""
    collection = geometry.collection
    kind = Unsteered if collection.beam_width is None else YawScan if collection.beam_axis is None else AxisScan
    return kind(geometry)


@dataclass(frozen=True)
class Beam(ABC):
    """A beam over the ground of a geometry: the pulses that light a point, and their weights.

    Attributes
    ----------
    geometry : Geometry
    by_yaw, by_range : bool
        Whether the dwell of a point depends on its yaw alone, or on its range as well.
    """

    geometry: Lit
    by_yaw: ClassVar[bool] = False
    by_range: ClassVar[bool] = False

    @property
    def collection(self) -> Collection:
        return self.geometry.collection

    @property
    def half(self) -> float:
        """Half the width, rad; infinite where the beam is not steered."""
        width = self.collection.beam_width
        return np.inf if width is None else width / 2

    @abstractmethod
    def is_lit(self, x: FloatArray, y: FloatArray, pulses: slice = slice(None), z: Height | None = None) -> BoolArray:
        """Find which pulses light points x, y (...), m: (..., n_pulse)."""

    @abstractmethod
    def passes(self, x: FloatArray, y: FloatArray, z: Height | None = None) -> tuple[IntArray, IntArray]:
        """The pulses first <= p < last that light each point: exactly those of `is_lit`.

        A point's lit pulses are an interval, but for a beam about its axis that turns back, leaves the point and comes
        to it again: it passes such a point several times.

        Parameters
        ----------
        x, y : (...) float
            m, scene frame; of one shape.
        z : (...) float, optional
            m; by default that of the ground.

        Returns
        -------
        first, last : (n_pass, ...) int
            In the order of time. Passes that a point lacks are empty, at the end of the one before; both are 0 where a
            point is never lit.

        Raises
        ------
        InputError
            If a beam that is described by its yaw scans all round.
        """

    @abstractmethod
    def offset(self, x: FloatArray, y: FloatArray, pulses: Pulses, z: Height | None = None) -> FloatArray:
        """Angle of points x, y (m) off the beam's centre at pulses, rad; points and pulses are broadcast."""

    @abstractmethod
    def dwell(
        self, x: FloatArray, y: FloatArray, *, z: Height | None = None, uncut: bool = False
    ) -> tuple[FloatArray, FloatArray]:
        """First and last lit slow time of ground points x, y (...), m: see `dwell_at`."""

    @abstractmethod
    def dwell_at(
        self, yaw: FloatArray, epoch_range: FloatArray, *, uncut: bool = False
    ) -> tuple[FloatArray, FloatArray]:
        """First and last lit slow time of points at yaws (rad) and epoch ranges (m): s; start > end if never.

        Where dwells depend on range, yaws and ranges are broadcast. Otherwise the arrays have the shape of `yaw`.

        With `uncut`, as if a scanning beam went on beyond the ends of the collection: as it did on average, or about
        its axis as it did there.

        These are the times at which the edges of the beam, taken as a continuous function of time, pass the point. A
        pulse stands for the half interval on either side of it, so N lit pulses dwell for N intervals, or one
        more or less.
        """

    @abstractmethod
    def passing_at(self, yaw: FloatArray, epoch_range: FloatArray, place: float) -> FloatArray:
        """Slow time at which points are at a place in a steered beam, s: -1 where they enter, 1 where they leave it.

        Yaws (rad) and epoch ranges (m) are broadcast; as if the collection did not cut dwells.
        """

    @abstractmethod
    def centre_yaw(self, time: FloatArray, epoch_range: FloatArray | float, low: float, high: float) -> FloatArray:
        """Yaw of the beam's centre at slow times (n,), where points are in mid-dwell; the mean limit if unsteered.

        Under a beam about its axis (..., n), at epoch ranges (...), m, from `low` to `high`; also there the middle,
        where all points are lit at the same time.
        """

    @abstractmethod
    def has_full_dwell(self, x: FloatArray | float, y: FloatArray | float, z: Height | None = None) -> BoolArray:
        """Whether the whole beam sweeps over targets at x, y (...), m, to within one pulse; true if it is not steered.

        Where the beam stands still: whether it lights them. About its axis: also where it lights them all the time.
        Targets that it leaves and comes to again have none.
        """

    @abstractmethod
    def most_lit_pulses(self, x: FloatArray, y: FloatArray) -> int:
        """The largest number of pulses that light any one point; where dwells depend on range, any of x, y, m."""

    def longest_pass(self, x: FloatArray, y: FloatArray) -> tuple[IntArray, IntArray]:
        """The longest of the `passes` of each point: first, last (...); both 0 where it is never lit."""
        passes = np.stack(self.passes(x, y))
        longest = (passes[1] - passes[0]).argmax(axis=0)
        first, last = np.take_along_axis(passes, longest[None, None], axis=1)[:, 0]
        return first, last

    def weights(
        self, x: FloatArray, y: FloatArray, pulses: Pulses, taper: Taper, z: Height | None = None
    ) -> FloatArray:
        """Weights w of pulses at points x, y (m); points and pulses are broadcast.

        A taper of v = 2 offset / beam_width, or of the pulse's place in the collection where the beam is not steered.
        """
        return np.ones(()) if taper.uniform else self._tapered(x, y, pulses, taper, z)

    def _tapered(self, x: FloatArray, y: FloatArray, pulses: Pulses, taper: Taper, z: Height | None) -> FloatArray:
        return taper(self.offset(x, y, pulses, z) / self.half)

    def gain(self, x: FloatArray, y: FloatArray, pulses: Pulses, z: Height | None = None) -> FloatArray:
        """Two-way amplitude g that the antenna gives points x, y (m) at pulses; points and pulses are broadcast.

        The product of both patterns, linear between their samples; 1 where there is none.
        """
        collection = self.collection
        px, py, pz = np.moveaxis(collection.antenna_position[pulses], -1, 0)
        gain = np.ones(np.broadcast_shapes(np.shape(x), np.shape(px)))
        if collection.beam_offset is not None and collection.beam_pattern is not None:
            gain = np.interp(self.offset(x, y, pulses, z), collection.beam_offset, collection.beam_pattern)
        if collection.elevation is not None and collection.elevation_pattern is not None:
            down = np.arctan2(pz - self.height(x, y, z), np.sqrt((x - px) ** 2 + (y - py) ** 2))
            gain = gain * np.interp(down, collection.elevation, collection.elevation_pattern)
        return np.asarray(gain)

    def dwell_weight(self, x: FloatArray, y: FloatArray, time: FloatArray, taper: Taper) -> FloatArray:
        """Weight w g of ground points x, y (m) at slow times (s) in the sum to an image; broadcast."""
        return self.at_times(time, lambda pulses: self.weights(x, y, pulses, taper) * self.gain(x, y, pulses))

    def at_times(self, time: FloatArray, value: Callable[[IntArray], FloatArray]) -> FloatArray:
        """Interpolate a value of pulses, such as the `offset` of points, linearly to slow times (s); broadcast."""
        collection = self.collection
        position = collection.pulse_place(time)
        before = np.clip(np.floor(position), 0, collection.n_pulse - 2).astype(np.int64)
        part = np.clip(position - before, 0.0, 1.0)
        return np.asarray(value(before) * (1 - part) + value(before + 1) * part)

    def height(self, x: FloatArray, y: FloatArray, z: Height | None) -> Height:
        """Heights z, by default those of the ground at points x, y, broadcast; one number on the plane."""
        return self.geometry.height(x, y) if z is None else z

    def lit_total(self, epoch_range: FloatArray, yaw: FloatArray, valid: FloatArray, taper: Taper = FLAT) -> FloatArray:
        """Sum of `valid` (n_pulse,) times taper and pattern over lit pulses: (n_range, n_yaw), at (n,) m and rad.

        Dwells begin and end between pulses here, so that the sum is continuous.
        """
        collection, geometry = self.collection, self.geometry
        shape = epoch_range.size, yaw.size
        first, last = self.dwell_at(yaw, epoch_range[:, None])
        begin, stop = (np.broadcast_to(np.clip(pulses_before(collection, t), 0, None), shape) for t in (first, last))
        before, pulse = np.concatenate([[0.0], np.cumsum(valid)]), np.arange(valid.size + 1.0)
        x, y = geometry.ground_axes(epoch_range[:, None], yaw)
        z = geometry.level(epoch_range[:, None], yaw)
        weighed = collection.has_pattern or not taper.uniform
        parts, total = GAIN_PARTS if weighed else 1, np.zeros(shape)
        for part in range(parts):
            low, high = (begin + (stop - begin) * (part + k) / parts for k in (0, 1))
            count = np.interp(high, pulse, before) - np.interp(low, pulse, before)
            if weighed:
                middle = np.clip((low + high) / 2, 0, valid.size - 1).astype(np.int64)
                count = count * self.weights(x, y, middle, taper, z) * self.gain(x, y, middle, z)
            total += count
        return np.asarray(np.where((last > first) & np.isfinite(x), np.maximum(total, 0.0), 0.0))

    def margin(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Margin by which the dwell of points x, y (...), m, lies inside the collection, relative to the dwell.

        0 where the beam is not steered, or lights a point all the time; -inf where it never does.
        """
        start, end = aperture(self.collection)
        first, last = self.dwell(x, y, uncut=True)
        with np.errstate(invalid="ignore", divide="ignore"):
            margin = np.minimum(first - start, end - last) / (last - first)
        margin = np.where((first <= start) & (last >= end), 0.0, margin)
        return np.where(last > first, margin, -np.inf)


class _OfYaws(Beam):
    """A beam whose dwells do not depend on range."""

    def passes(self, x: FloatArray, y: FloatArray, z: Height | None = None) -> tuple[IntArray, IntArray]:
        yaw = np.asarray(self.geometry.yaw(np.asarray(x, np.float64), np.asarray(y, np.float64)))
        first, last = yaw_interval(self.collection, yaw.ravel(), tolerance=0.0)
        never = first == last
        first[never], last[never] = 0, 0
        return first.reshape(1, *yaw.shape), last.reshape(1, *yaw.shape)

    def is_lit(self, x: FloatArray, y: FloatArray, pulses: slice = slice(None), z: Height | None = None) -> BoolArray:
        azimuth, half = beam_at(self.collection, pulses)
        return in_beam(self.geometry.yaw(x, y)[..., None], azimuth, half)

    def dwell(
        self, x: FloatArray, y: FloatArray, *, z: Height | None = None, uncut: bool = False
    ) -> tuple[FloatArray, FloatArray]:
        return self.dwell_at(self.geometry.yaw(x, y), np.zeros(1), uncut=uncut)

    def most_lit_pulses(self, x: FloatArray, y: FloatArray) -> int:
        collection = self.collection
        return int(lit_pulses(collection, collection.beam_azimuth, np.ones(collection.n_pulse)).max())


class Unsteered(_OfYaws):
    """A beam that lights everything all the time."""

    def offset(self, x: FloatArray, y: FloatArray, pulses: Pulses, z: Height | None = None) -> FloatArray:
        raise AssertionError("a beam that is not steered has no centre")

    def _tapered(self, x: FloatArray, y: FloatArray, pulses: Pulses, taper: Taper, z: Height | None) -> FloatArray:
        return taper.on(self.collection.time, self.collection.pulses)[pulses]

    def dwell_at(
        self, yaw: FloatArray, epoch_range: FloatArray, *, uncut: bool = False
    ) -> tuple[FloatArray, FloatArray]:
        start, end = aperture(self.collection)
        return np.full(np.shape(yaw), start), np.full(np.shape(yaw), end)

    def passing_at(self, yaw: FloatArray, epoch_range: FloatArray, place: float) -> FloatArray:
        raise AssertionError("a beam that is not steered passes over nothing")

    def centre_yaw(self, time: FloatArray, epoch_range: FloatArray | float, low: float, high: float) -> FloatArray:
        return np.full(time.size, (low + high) / 2)

    def has_full_dwell(self, x: FloatArray | float, y: FloatArray | float, z: Height | None = None) -> BoolArray:
        return np.ones(np.broadcast_shapes(np.shape(x), np.shape(y)), bool)


class YawScan(_OfYaws):
    """A beam that is described by the yaw of its centre at each pulse."""

    by_yaw = True

    def passes(self, x: FloatArray, y: FloatArray, z: Height | None = None) -> tuple[IntArray, IntArray]:
        beam, width = self.collection.beam_azimuth, 2 * self.half
        scan = abs(beam[-1] - beam[0])
        if scan + width >= TURN:
            raise InputError(
                f"beam_azimuth scans {scan:.4g} rad with a beam_width of {width:.4g} rad, all round: a target would "
                "be lit twice; cut the collection"
            )
        return super().passes(x, y, z)

    def offset(self, x: FloatArray, y: FloatArray, pulses: Pulses, z: Height | None = None) -> FloatArray:
        return wrapped(self.geometry.yaw(x, y) - self.collection.beam_azimuth[pulses])

    def dwell_at(
        self, yaw: FloatArray, epoch_range: FloatArray, *, uncut: bool = False
    ) -> tuple[FloatArray, FloatArray]:
        beam, (start, end) = self.collection.beam_azimuth, aperture(self.collection)
        yaw = np.asarray(yaw, dtype=np.float64)
        if abs(beam[-1] - beam[0]) < STILL:
            lit = in_beam(yaw, beam[0], self.half + EDGE)
            return np.where(lit, start, np.inf), np.where(lit, end, -np.inf)
        yaw = turned_near(yaw, (beam[0] + beam[-1]) / 2)
        sign = 1.0 if beam[-1] > beam[0] else -1.0
        first, last = self._times_at(np.stack([yaw - sign * self.half, yaw + sign * self.half]))
        return (first, last) if uncut else (np.maximum(first, start), np.minimum(last, end))

    def passing_at(self, yaw: FloatArray, epoch_range: FloatArray, place: float) -> FloatArray:
        beam = self.collection.beam_azimuth
        turned, sign = turned_near(np.asarray(yaw, np.float64), (beam[0] + beam[-1]) / 2), np.sign(beam[-1] - beam[0])
        times = self._times_at(turned + place * sign * self.half)
        return np.broadcast_to(times, np.broadcast_shapes(np.shape(yaw), np.shape(epoch_range)))

    def _times_at(self, level: FloatArray) -> FloatArray:
        """Times (...) at which the beam has azimuths, rad; extrapolated at the mean rate beyond the collection."""
        beam, time = self.collection.beam_azimuth, self.collection.time
        sign = 1.0 if beam[-1] > beam[0] else -1.0
        inside = np.interp(sign * level, beam if sign > 0 else -beam, time)
        slope = (time[-1] - time[0]) / (beam[-1] - beam[0])
        return np.asarray(inside + slope * (level - np.clip(level, min(beam[0], beam[-1]), max(beam[0], beam[-1]))))

    def centre_yaw(self, time: FloatArray, epoch_range: FloatArray | float, low: float, high: float) -> FloatArray:
        return np.interp(time, self.collection.time, self.collection.beam_azimuth)

    def has_full_dwell(self, x: FloatArray | float, y: FloatArray | float, z: Height | None = None) -> BoolArray:
        yaw, beam = self.geometry.yaw(np.asarray(x), np.asarray(y)), self.collection.beam_azimuth
        low, high = float(beam.min()), float(beam.max())
        if low == high:
            return in_beam(yaw, beam[0], self.half + EDGE)
        yaw = turned_near(yaw, (low + high) / 2)
        lowest, highest = full_dwell_yaw(self.collection)
        pulse = (high - low) / (self.collection.n_pulse - 1)
        return np.asarray((lowest - pulse <= yaw) & (yaw <= highest + pulse))


class AxisScan(Beam):
    """A beam about the antenna's own axis."""

    by_range = True

    def is_lit(self, x: FloatArray, y: FloatArray, pulses: slice = slice(None), z: Height | None = None) -> BoolArray:
        px, py, pz = (np.asarray(axis)[..., None] for axis in (x, y, self.height(x, y, z)))
        within = np.abs(self.offset(px, py, pulses, pz)) <= self.half
        return np.asarray(within & on_lit_side(self.collection, px, py, pulses))

    def passes(self, x: FloatArray, y: FloatArray, z: Height | None = None) -> tuple[IntArray, IntArray]:
        passes = axis_passes(self.collection, _raveled(x, y, self.height(x, y, z)))
        first, last = (ends.reshape(len(ends), *np.shape(x)) for ends in passes)
        return first, last

    def offset(self, x: FloatArray, y: FloatArray, pulses: Pulses, z: Height | None = None) -> FloatArray:
        return axis_offset(self.collection, x, y, self.height(x, y, z), pulses)

    def dwell(
        self, x: FloatArray, y: FloatArray, *, z: Height | None = None, uncut: bool = False
    ) -> tuple[FloatArray, FloatArray]:
        x, y = np.broadcast_arrays(x, y)
        z = self.height(x, y, z)
        z = np.broadcast_to(z, x.shape) if isinstance(z, np.ndarray) else z
        first, last = axis_dwell(self.collection, _raveled(x, y, z), uncut=uncut)
        return first.reshape(x.shape), last.reshape(x.shape)

    def dwell_at(
        self, yaw: FloatArray, epoch_range: FloatArray, *, uncut: bool = False
    ) -> tuple[FloatArray, FloatArray]:
        x, y = self.geometry.ground_axes(epoch_range, yaw)
        return self.dwell(x, y, z=self.geometry.level(epoch_range, yaw), uncut=uncut)

    def passing_at(self, yaw: FloatArray, epoch_range: FloatArray, place: float) -> FloatArray:
        geometry = self.geometry
        x, y, z = np.broadcast_arrays(*geometry.ground_axes(epoch_range, yaw), geometry.level(epoch_range, yaw))
        return axis_passing(self.collection, _raveled(x, y, z), place).reshape(x.shape)

    def centre_yaw(self, time: FloatArray, epoch_range: FloatArray | float, low: float, high: float) -> FloatArray:
        yaw = np.linspace(low, high, CENTRE_NODES)
        first, last = self.dwell_at(yaw, np.ravel(epoch_range)[:, None], uncut=True)
        rows = []
        for middle in (first + last) / 2:
            steps = np.diff(middle)
            if np.isfinite(middle).all() and ((steps > 0).all() or (steps < 0).all()):
                order = slice(None) if steps[0] > 0 else slice(None, None, -1)
                rows.append(np.interp(time, middle[order], yaw[order]))
            else:
                rows.append(np.full(time.size, (low + high) / 2))
        return np.array(rows).reshape(*np.shape(epoch_range), time.size)

    def has_full_dwell(self, x: FloatArray | float, y: FloatArray | float, z: Height | None = None) -> BoolArray:
        collection, (start, end) = self.collection, aperture(self.collection)
        x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
        z = self.height(x, y, z)
        first, last = self.dwell(x, y, z=z, uncut=True)
        whole = (first >= start - collection.pulse_interval) & (last <= end + collection.pulse_interval)
        full = np.asarray((whole & (last > first)) | ((first <= start) & (last >= end)))
        if full.any():
            some = (axis[full] for axis in np.broadcast_arrays(x, y, z))
            passes = self.geometry.lit_by(collection.steady).beam.passes(*some)
            full[full] = np.count_nonzero(passes[1] > passes[0], axis=0) < 2
        return full

    def most_lit_pulses(self, x: FloatArray, y: FloatArray) -> int:
        first, last = self.dwell(x, y)
        lasts = (last - first)[np.isfinite(last - first)]  # elsewhere the terrain has no height
        return math.ceil(float(lasts.max(initial=0.0)) * self.collection.prf)


def _raveled(x: FloatArray, y: FloatArray, z: Height) -> GroundPoints:
    """Broadcast points to (n,); their height may be one number."""
    along_x, along_y = (np.ravel(np.asarray(axis, np.float64)) for axis in (x, y))
    return GroundPoints(along_x, along_y, np.ravel(z) if isinstance(z, np.ndarray) else z)


# ---------------------------------------------------------------- pulses and yaws


def beam_at(collection: Collection, pulses: slice) -> tuple[FloatArray, float]:
    """Azimuth of the beam's centre at some pulses (n,), and half its width, rad, as `in_beam` takes them.

    Zeros and infinity where the beam is not steered.
    """
    azimuth = collection.beam_azimuth[pulses]
    if collection.beam_width is None:
        return np.zeros(azimuth.shape), np.inf
    return azimuth, collection.beam_width / 2


def aperture(collection: Collection) -> tuple[float, float]:
    """Start and end of the collection, s: a pulse stands for the half interval on either side of it."""
    half_pulse = collection.pulse_interval / 2
    return collection.time[0] - half_pulse, collection.time[-1] + half_pulse


def pulses_before(collection: Collection, time: FloatArray) -> FloatArray:
    """Number of pulses before slow times (...), s, each of which stands for half the way to either neighbour."""
    if collection.pulses.even:
        return np.asarray((time - aperture(collection)[0]) * collection.prf)
    return collection.pulse_place(time) + 0.5


def yaw_interval(collection: Collection, yaw: FloatArray, *, tolerance: float) -> tuple[IntArray, IntArray]:
    """first <= p < last of yaws (n,), found by bisection with the very inequality of `in_beam`; equal if never lit.

    `in_beam` wraps each difference; here the turns of all pulses are those of the sweep's middle, so that the
    differences fall (or rise) with the pulse throughout. Both give the same bits where the beam is near the point.
    """
    n = collection.n_pulse
    if collection.beam_width is None:
        return np.zeros(yaw.shape, np.int64), np.full(yaw.shape, n, np.int64)
    beam, half = collection.beam_azimuth, collection.beam_width / 2 + tolerance
    sign = 1.0 if beam[-1] >= beam[0] else -1.0
    turns = TURN * np.rint((yaw - (beam[0] + beam[-1]) / 2) / TURN)

    def ahead(points: IntArray, pulses: IntArray) -> FloatArray:
        return sign * ((yaw[points] - beam[pulses]) - turns[points])

    level = sign * (yaw - turns)
    reached = np.searchsorted(sign * beam, level - half, side="left")
    passed = np.searchsorted(sign * beam, level + half, side="right")
    first = _first_pulse(lambda points, pulses: ahead(points, pulses) <= half, reached, n)
    last = _first_pulse(lambda points, pulses: ahead(points, pulses) < -half, passed, n)
    return first, last


def _first_pulse(holds: Callable[[IntArray, IntArray], BoolArray], guess: IntArray, n: int) -> IntArray:
    """The first of n pulses from which on `holds(points, pulses)` is true, for every point; n if for none.

    `guess` (n_point,) is right but for rounding; only points for which it is wrong are bisected.
    """
    points = np.arange(guess.size)
    early = (guess > 0) & holds(points, np.maximum(guess - 1, 0))
    late = (guess < n) & ~holds(points, np.minimum(guess, n - 1))
    wrong = np.flatnonzero(early | late)
    low, high = np.zeros(wrong.size, np.int64), np.full(wrong.size, n, np.int64)
    while (low < high).any():
        middle = np.minimum((low + high) // 2, n - 1)
        true = holds(wrong, middle)
        low, high = np.where((low < high) & ~true, middle + 1, low), np.where((low < high) & true, middle, high)
    first = guess.astype(np.int64)
    first[wrong] = low
    return first


def lit_yaw(collection: Collection) -> tuple[float, float]:
    """First and last yaw that a steered beam ever lights, rad."""
    half = (collection.beam_width or 0.0) / 2
    return float(collection.beam_azimuth.min() - half), float(collection.beam_azimuth.max() + half)


def full_dwell_yaw(collection: Collection) -> tuple[float, float]:
    """First and last yaw that the whole of a steered beam sweeps over, rad.

    First > last where the beam turns by less than its width: targets between are then lit all the time.
    """
    half = (collection.beam_width or 0.0) / 2
    return float(collection.beam_azimuth.min() + half), float(collection.beam_azimuth.max() - half)


def lit_pulses(collection: Collection, yaw: FloatArray, valid: FloatArray) -> FloatArray:
    """Number of valid pulses that light points at yaws (n,): sum of `valid` (n_pulse,) over the lit ones.

    `valid` is the fraction of each pulse's samples that is there; 0 for a missing pulse. Yaws on the edge of the beam
    but for rounding (`EDGE`) are lit.
    """
    total = np.concatenate([[0.0], np.cumsum(valid)])
    first, last = yaw_interval(collection, yaw, tolerance=EDGE)
    return np.asarray(total[last] - total[first])


def weighted_pulses(collection: Collection, yaw: FloatArray, valid: FloatArray, taper: Taper) -> FloatArray:
    """Sum of `valid` (n_pulse,) times the taper over the pulses that light points at yaws (n,); see `lit_pulses`."""
    if taper.uniform:
        return lit_pulses(collection, yaw, valid)
    if collection.beam_width is None:
        return np.full(yaw.shape, float((valid * taper.samples(collection.n_pulse)).sum()))
    first, last = yaw_interval(collection, yaw, tolerance=EDGE)
    beam, half = collection.beam_azimuth, collection.beam_width / 2
    middle = float(beam[0] + beam[-1]) / 2
    point, along = wrapped(yaw - middle) / half, (beam - middle) / half
    # Each cosine of the difference is a product of two phasors, so that one running sum serves all points.
    total, (terms, frequency) = np.zeros(yaw.shape), taper.series
    for k, term in enumerate(terms):
        running = np.concatenate([[0.0], np.cumsum(valid * np.exp(-1j * np.pi * frequency * k * along))])
        total += term * (np.exp(1j * np.pi * frequency * k * point) * (running[last] - running[first])).real
    return total


# ---------------------------------------------------------------- margins


NODES = 33  # places along each side of a part of an image at which margins are computed; linear in between


def margins_over(geometry: Lit, x: FloatArray, y: FloatArray) -> FloatArray:
    """Margins at NODES x NODES places of an image part with axes x and y, m: (NODES, NODES), rows along y."""
    places = np.linspace(x[0], x[-1], NODES), np.linspace(y[0], y[-1], NODES)
    return geometry.beam.margin(*np.meshgrid(*places))


def expand(margins: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Interpolate margins linearly to all pixels of the part, (n_y, n_x); -inf around places that are never lit."""
    with np.errstate(invalid="ignore"):
        for axis, n in enumerate(shape):
            place = np.linspace(0, NODES - 1, n) if n > 1 else np.zeros(1)
            below = np.minimum(place.astype(np.int64), NODES - 2)
            part = (place - below)[:, None] if axis == 0 else place - below
            low, high = np.take(margins, below, axis), np.take(margins, below + 1, axis)
            margins = np.asarray(low * (1 - part) + high * part)
    return np.nan_to_num(margins, nan=-np.inf, posinf=np.inf, neginf=-np.inf)
