"""Prominent places of a scene, found from a few pulses, and their deramped lines over the whole dwell.

A short aperture has so coarse a resolution that it hardly depends on what is wrong with a collection: bright points
are found, perhaps at a wrong place. Their lines - the samples at the point's range, with the point's phase removed,
pulse by pulse - are constant if the long aperture is right too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from blocksar.arrays import Complex128Array, ComplexArray, FloatArray
from blocksar.collection.beam import beam_offset, lit_interval
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.region import Region
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.focusing.backprojection import accumulate
from blocksar.focusing.profiles import Profiles, range_profiles
from blocksar.kernels.fourier import fft_rows

APERTURES = 6  # short ones, spread over the collection
SHORT = 64  # pulses of a short aperture
LONGER = 6  # times: growth of the aperture from one refinement of a place to the next
MOST_UPDATES = 1.5e6  # points times pulses of a short aperture's map
EDGE = 0.42  # of the beam's width: angles to either side of its middle that are searched
STANDS_OUT = 50.0  # times the median power: in clutter alone one cell of 1e15 does
APART = 12  # cells between prominent places of one map
EACH = 4  # places taken from one map
ROWS: FloatArray = np.arange(-8.0, 9.0) * 0.7  # range cells about a place at which lines are taken
FEW_ROWS = ROWS[5:12]  # about one that a shorter aperture has been moved to
PULSES = 256  # whose range profiles are formed at a time
NEWTON = 6  # steps to a place of another Doppler


class Place(NamedTuple):
    """A point on the ground, m, its power over the median of its surroundings, and a pulse that saw it."""

    x: float
    y: float
    prominence: float
    pulse: int = 0


@dataclass(frozen=True, eq=False)
class Line:
    """The deramped line of a place over its lit pulses.

    Attributes
    ----------
    place : Place
    pulses : slice
    values : (n,) complex
        At the range and Doppler where the place is brightest.
    """

    place: Place
    pulses: slice
    values: Complex128Array


class Samples:
    """Samples of a phase history, and their range profiles, which are kept.

    They do not depend on track and beam, so that alternatives of these share them.
    """

    def __init__(self, signal: ComplexArray, collection: Collection, *, threads: int) -> None:
        self.signal, self.collection, self.threads = signal, collection, threads
        self._profiles: dict[tuple[int, int], Profiles] = {}

    def profiles(self, first: int, last: int) -> Profiles:
        """Range profiles of the pulses first .. last - 1."""
        if (first, last) not in self._profiles:
            pulses = slice(first, last)
            self._profiles[first, last] = range_profiles(
                self.signal[pulses], collection=self.collection, pulses=pulses, threads=self.threads
            )
        return self._profiles[first, last]


class Lines:
    """Prominent places of a phase history, and their lines.

    Parameters
    ----------
    samples : Samples
    geometry : Geometry
        Of these samples.
    """

    def __init__(self, samples: Samples, geometry: Geometry) -> None:
        self.samples, self.geometry = samples, geometry
        collection = geometry.collection
        self.cell = SPEED_OF_LIGHT / (2 * collection.bandwidth)
        middle = collection.range_frequency[collection.n_range_frequency // 2]
        self.turns = 2 * (collection.carrier + middle) / SPEED_OF_LIGHT

    def places(self, region: Region, count: int) -> list[Place]:
        """The most prominent places, at most `count`, from all short apertures."""
        found: list[Place] = []
        n = self.geometry.collection.n_pulse
        size = min(SHORT, n)
        for k in range(APERTURES):
            first = round((k + 0.5) / APERTURES * (n - size))
            found += self._bright(region, slice(first, first + size))
        return sorted(found, key=lambda place: -place.prominence)[:count]

    def _bright(self, region: Region, pulses: slice) -> list[Place]:
        """Prominent places in the map of a short aperture."""
        geometry, collection = self.geometry, self.geometry.collection
        low, high = float(region.yaw[0]), float(region.yaw[-1])
        if collection.beam_width is not None and not collection.has_axis:
            beam = float(collection.beam_azimuth[pulses].mean())
            low, high = max(low, beam - EDGE * collection.beam_width), min(high, beam + EDGE * collection.beam_width)
        if high <= low:
            return []
        position = collection.antenna_position[pulses]
        near, far = region.limits(low, high)
        way = float(np.linalg.norm(position[-1] - position[0]))
        ranges = np.arange(near, far, 0.7 * self.cell)
        yaws = np.linspace(low, high, max(int((high - low) * way / (0.35 * collection.wavelength)), 3))
        every = math.ceil(np.sqrt(max(ranges.size * yaws.size * position.shape[0] / MOST_UPDATES, 1.0)))
        ranges, yaws = ranges[::every], yaws[::every]  # of a large scene some places are missed
        point = geometry.ground_point(ranges[None, :], yaws[:, None])
        x, y = (np.ascontiguousarray(point[..., axis]) for axis in (0, 1))
        image, outside = np.zeros(x.shape, np.complex64), np.zeros(x.shape, np.bool_)
        first, last = np.full(x.shape, pulses.start, np.int64), np.full(x.shape, pulses.stop, np.int64)
        profiles = self.samples.profiles(pulses.start, pulses.stop)
        accumulate(
            image, outside, profiles, geometry=geometry, x=x, y=y, first=first, last=last, threads=self.samples.threads
        )
        if collection.has_axis:  # its edges are no yaws: beyond them lie only ambiguities of what it lights
            away = beam_offset(geometry, x, y, (pulses.start + pulses.stop) // 2)
            outside |= ~(np.abs(away) <= EDGE * (collection.beam_width or 0.0))  # NaN where no height is known
        power = np.where(outside, 0.0, np.nan_to_num(np.abs(image).astype(np.float64) ** 2))
        typical = float(np.median(power[power > 0])) if (power > 0).any() else 0.0
        places: list[Place] = []
        while typical > 0 and len(places) < EACH:
            row, column = np.unravel_index(int(np.argmax(power)), power.shape)
            if power[row, column] < STANDS_OUT * typical:
                break
            prominence = float(power[row, column] / typical)
            middle = (pulses.start + pulses.stop) // 2
            places.append(Place(float(x[row, column]), float(y[row, column]), prominence, middle))
            power[max(row - APART, 0) : row + APART + 1, max(column - APART, 0) : column + APART + 1] = 0.0
        return places

    def line(self, place: Place) -> Line | None:
        """The line of a place, which is moved to where it is brightest as the aperture grows; None if it is not lit."""
        first, last = (int(v) for v in lit_interval(self.geometry, np.array(place.x), np.array(place.y)))
        if last - first < SHORT:
            return None
        return self.line_about(place, first, last, (first + last) // 2)

    def line_about(self, place: Place, first: int, last: int, middle: int, *, later: FloatArray = ROWS) -> Line:
        """The line of a place over the pulses first .. last - 1, found by apertures that grow about `middle`.

        The first of them looks at all ROWS, and those after it at `later`.
        """
        size, offsets = SHORT, ROWS
        while True:
            size = min(LONGER * size, last - first)
            begin = min(max(middle - size // 2, first), last - size)
            pulses = slice(begin, begin + size)
            rows = self._rows(place, pulses, offsets)
            spectrum = fft_rows(np.ascontiguousarray(rows.T), inverse=False).T
            reach = min(3 * LONGER, size // 2 - 1)
            near = np.r_[0 : reach + 1, size - reach : size]
            bin_, row = np.unravel_index(int(np.argmax(np.abs(spectrum[near]))), (near.size, offsets.size))
            shift = near[bin_] if near[bin_] <= reach else near[bin_] - size
            if size == last - first:
                turn = np.exp(-2j * np.pi * shift / size * np.arange(size))
                return Line(place, pulses, rows[:, row] * turn)
            place = self._moved(place, pulses, offsets[row] * self.cell, shift / (size * self._interval))
            offsets = later

    def ambiguous(self, place: Place, turns: int) -> Place:
        """The place at the same range whose Doppler is `turns` times the PRF higher, seen from the place's pulse."""
        n = self.geometry.collection.n_pulse
        pulses = slice(max(place.pulse - 1, 0), min(place.pulse + 1, n))
        wanted = self._seen(place.x, place.y, pulses) + np.array([0.0, turns * self.geometry.collection.prf])
        for _ in range(NEWTON):
            further, doppler = wanted - self._seen(place.x, place.y, pulses)
            place = self._moved(place, pulses, float(further), float(doppler))
        return place

    @property
    def _interval(self) -> float:
        return self.geometry.collection.pulse_interval

    def _distance(self, x: FloatArray, y: FloatArray, pulses: slice) -> FloatArray:
        position = self.geometry.collection.antenna_position[pulses]
        height = np.nan_to_num(self.geometry.height(x, y), nan=self.geometry.collection.ground_height)
        return np.sqrt((position[:, 0] - x) ** 2 + (position[:, 1] - y) ** 2 + (position[:, 2] - height) ** 2)

    def _rows(self, place: Place, pulses: slice, offsets: FloatArray) -> Complex128Array:
        """(n, n_row): the samples at offsets (n_row,) in range cells from a place, with its phase removed."""
        collection = self.geometry.collection
        offset = self._distance(np.array(place.x), np.array(place.y), pulses) - collection.reference_range[pulses]
        rows = np.empty((offset.size, offsets.size), np.complex128)
        for start in range(pulses.start // PULSES * PULSES, pulses.stop, PULSES):
            profiles = self.samples.profiles(start, min(start + PULSES, self.geometry.collection.n_pulse))
            part = slice(max(start, pulses.start), min(start + PULSES, pulses.stop))
            into = slice(part.start - pulses.start, part.stop - pulses.start)
            rows[into] = profiles.at(
                np.arange(part.start - start, part.stop - start), offset[into, None] + offsets * self.cell
            )
        cycles = self.turns * offset
        return np.asarray(rows * np.exp(2j * np.pi * (cycles - np.rint(cycles)))[:, None])

    def _moved(self, place: Place, pulses: slice, further: float, doppler: float) -> Place:
        """The place that lies `further` m in range and has `doppler` Hz more, at the middle of some pulses."""
        step = 1.0  # m
        middle = slice((pulses.start + pulses.stop) // 2 - 1, (pulses.start + pulses.stop) // 2 + 1)

        here = self._seen(place.x, place.y, middle)
        by_x = self._seen(place.x + step, place.y, middle) - here
        by_y = self._seen(place.x, place.y + step, middle) - here
        determinant = by_x[0] * by_y[1] - by_x[1] * by_y[0]
        if abs(determinant) < 1e-12:
            return place
        x = (further * by_y[1] - doppler * by_y[0]) / determinant
        y = (doppler * by_x[0] - further * by_x[1]) / determinant
        return place._replace(x=place.x + step * x, y=place.y + step * y)

    def _seen(self, x: float, y: float, pulses: slice) -> FloatArray:
        """Range (m) and Doppler (Hz) of a point, m, between two pulses."""
        distance = self._distance(np.array(x), np.array(y), pulses)
        rate = (distance[1] - distance[0]) / self._interval
        return np.array([distance.mean(), -2 / self.geometry.collection.wavelength * rate])
