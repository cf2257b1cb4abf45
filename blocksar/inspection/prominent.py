"""Prominent places of a scene, found from a few pulses, and their deramped lines over the whole dwell.

A short aperture has so coarse a resolution that it hardly depends on what is wrong with a collection: bright points
are found, perhaps at a wrong place. Their lines - the samples at the point's range, with the point's phase removed,
pulse by pulse - are constant if the long aperture is right too.

What was found is an echo: a pulse, and at it a range and a Doppler. Those are in the samples, and whatever is said of
them places the same echo somewhere on its own ground.

The contrast of an echo's surroundings is compared, with the probability of a gain by chance.

Contrast is m = N sum(I^2) / (sum I)^2 over the N cells of a small image about an echo, formed over its whole dwell. It
needs no targets: of speckle m is 2 wherever it is smeared to, of points in focus N over a few, and what blurs an image,
in range or along the track, takes contrast from points, edges and texture alike. Gains are of the same echoes, as given
and under an alternative, in dB.

Chance
------
What is not in focus is speckle, I_k = s_k E_k with exponential E_k of unit mean. As E(I^n) = n! s^n, the variances of
the sums are known from the intensities themselves: of T = sum I^2 it is 5/6 sum I^4, of S = sum I it is T / 2, and
their covariance 2/3 sum I^3. So

    var(m) / m^2 = 5/6 sum(I^4) / T^2 + 2 T / S^2 - 8/3 sum(I^3) / (T S),

which is 1 / N for homogeneous speckle, and grows as fewer cells dominate. A lone target has none of that; but the side
lobes of others, of the amplitude a = 0.217 (-13.3 dB) for the first of a neighbour as strong, change its power by the
factor 1 + 2 a cos(phase), of the variance 2 a^2. That adds 2 a^2 sum(I^4) / T^2: 1.4 dB and more to a lone target.
If an alternative is no better than what is given, the gains of n echoes have a mean of zero at most, and

    z = sum(gain) / sqrt(sum(var given + var alternative))

exceeds SIGNIFICANT = 5 by chance once in 3.5 million. Images of exact data change less than that: a mirrored image has
the same speckle and the same side lobes, but is counted as if both were drawn anew.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from blocksar import solvers
from blocksar.arrays import Complex128Array, ComplexArray, FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.region import Region
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.imaging.backprojection import accumulate
from blocksar.imaging.profiles import Profiles, profile_frequency, range_profiles
from blocksar.kernels.fourier import fft_rows
from blocksar.kernels.projection import LitPixels

SIGNIFICANT = 5.0  # standard deviations
SIDE_LOBE = 2 * 0.217**2  # relative variance of a target's power under the first side lobe of one as strong
SPECKLE = 10 * np.log10(2.0)  # dB
DECIBEL = 10 / np.log(10)


class Contrast(NamedTuple):
    """Contrast of a small image, dB, and the variance that speckle gives it, dB^2."""

    decibels: float
    variance: float


UNLIT = Contrast(float(SPECKLE), 0.0)  # of an echo that a hypothesis does not light: no contrast


def contrast(power: FloatArray, *, oversampling: float) -> Contrast:
    """Contrast of an image.

    Parameters
    ----------
    power : (...) float
        |image|^2.
    oversampling : float
        Samples to an independent cell.
    """
    scaled = power / max(float(power.max()), 1e-300)
    first, second, third, fourth = (float((scaled**n).sum()) for n in (1, 2, 3, 4))
    if first == 0.0:
        return UNLIT
    relative = (
        SIDE_LOBE * fourth / second**2
        + 5 / 6 * fourth / second**2
        + 2 * second / first**2
        - 8 / 3 * third / (second * first)
    )
    variance = DECIBEL**2 * oversampling * max(relative, 1 / power.size)
    return Contrast(float(10 * np.log10(power.size * second / first**2)), variance)


def deviations(given: Sequence[Contrast], other: Sequence[Contrast]) -> float:
    """Significance z of the contrast gained by the same echoes under an alternative, in standard deviations."""
    gain = sum(b.decibels - a.decibels for a, b in zip(given, other, strict=True))
    variance = sum(a.variance + b.variance for a, b in zip(given, other, strict=True))
    return gain / max(variance, 1e-12) ** 0.5


APERTURES = 6  # short ones, spread over the collection
SHORT = 64  # pulses of a short aperture
LONGER = 6  # times: growth of the aperture from one refinement of a place to the next
MOST_UPDATES = 1.5e6  # points times pulses of a short aperture's map
EDGE = 0.42  # of the beam's width: angles to either side of its middle that are searched
STANDS_OUT = 50.0  # times the median power: in clutter alone one cell of 1e15 does
# Of the power of the strongest range bin: less may be side lobes, which a sinc has at -28 dB APART cells away.
SIDE_LOBES = 10**-2.5
APART = 12  # cells between prominent places of one map
SAME = 4.0  # range cells between places: nearer ones are the same, seen in two apertures
EACH = 4  # places taken from one map
ROW = 0.7  # range cells between rows
ROWS: FloatArray = np.arange(-8.0, 9.0) * ROW  # range cells about a place at which lines are taken
FEW_ROWS = ROWS[5:12]  # about one that a shorter aperture has been moved to
BINS = 16  # of Doppler to either side of a place, that belong to its small image
WIDE_ROWS: FloatArray = np.arange(-32.0, 32.0)  # range cells about a place amid clutter, and its bins of Doppler
WIDE_BINS = 64
DARK = 10**-2.5  # of the mean power over all ranges: with less, a place shows side lobes of others
MOST_PULSES = 4096  # of its dwell, that are taken then
FINE = 129  # ranges at which the steepness of a terrain is looked at
MOST_PHASE = 0.5  # rad
BASE = 8  # pulses to either side, between which Doppler is taken
PULSES = 256  # whose range profiles are formed at a time
NEWTON, CONVERGED = 10, 1e-2  # steps to a place of another range and Doppler, and the cells left then
SEEDS = 33, 65  # ranges and yaws of the ground, from the best of which they start


class ProminentPoint(NamedTuple):
    """A point on the ground, m, its power over the median of its surroundings, and a pulse that saw it."""

    x: float
    y: float
    prominence: float
    pulse: int = 0


class Echo(NamedTuple):
    """Offset R - reference_range, m, and Doppler, Hz, of a place in a pulse; Doppler is ambiguous by the PRF."""

    pulse: int
    offset: float
    doppler: float


class Seeds(NamedTuple):
    """Points of the ground, x, y and z (n,), m, and the depth of their region in range, m."""

    x: FloatArray
    y: FloatArray
    z: FloatArray
    depth: float


@dataclass(frozen=True, eq=False)
class PointLine:
    """The deramped line of a place over its lit pulses.

    Attributes
    ----------
    place : Place
    pulses : slice
    values : (n,) complex
        At the range and Doppler where the place is brightest.
    contrast : Contrast
        Of its small image over these pulses.
    focus : float
        Share of the energy near the peak, along the track or in range, that the peak holds: 1 for a lone point.
    """

    place: ProminentPoint
    pulses: slice
    values: Complex128Array
    contrast: Contrast = UNLIT
    focus: float = 0.0


class ProfiledSamples:
    """Samples of a phase history, with a cache of their range profiles.

    They do not depend on track and beam, so that alternatives of these share them.
    """

    def __init__(self, signal: ComplexArray, collection: Collection, *, threads: int) -> None:
        self.signal, self.collection, self.threads = signal, collection, threads
        self._profiles: dict[tuple[int, int], Profiles] = {}
        self._levels: dict[int, float] = {}

    def profiles(self, first: int, last: int) -> Profiles:
        """Range profiles of the pulses first .. last - 1."""
        if (first, last) not in self._profiles:
            pulses = slice(first, last)
            self._profiles[first, last] = range_profiles(
                self.signal[pulses], collection=self.collection, pulses=pulses, threads=self.threads
            )
        return self._profiles[first, last]

    def level(self, pulse: int) -> float:
        """Mean power over all ranges of the group of pulses around one."""
        start = pulse // PULSES * PULSES
        if start not in self._levels:
            values = self.profiles(start, min(start + PULSES, self.collection.n_pulse)).values
            self._levels[start] = float((np.abs(values).astype(np.float64) ** 2).mean())
        return self._levels[start]

    def overview(self) -> list[Contrast]:
        """Contrast over range and Doppler of each short aperture."""
        seen = []
        for pulses in short_apertures(self.collection.n_pulse):
            profiles = self.profiles(pulses.start, pulses.stop)
            bins = max(int(self.cell / profiles.spacing / 2), 1)  # two to a range cell
            image = np.zeros((2 * (pulses.stop - pulses.start), -(-profiles.values.shape[1] // bins)), np.complex64)
            image[: len(profiles.values)] = profiles.values[:, ::bins]
            power = np.abs(fft_rows(np.ascontiguousarray(image.T), inverse=False)).astype(np.float64) ** 2
            seen.append(contrast(power, oversampling=2 * self.cell / (bins * profiles.spacing)))
        return seen

    @property
    def cell(self) -> float:
        """A range cell, m."""
        return SPEED_OF_LIGHT / (2 * self.collection.bandwidth)


def short_apertures(n_pulse: int) -> list[slice]:
    """Short apertures spread over the collection, as slices of pulses."""
    size = min(SHORT, n_pulse)
    starts = [round((k + 0.5) / APERTURES * (n_pulse - size)) for k in range(APERTURES)]
    return [slice(start, start + size) for start in starts]


class Lines:
    """Prominent places of a phase history, and their lines.

    Parameters
    ----------
    samples : Samples
    geometry : Geometry
        Of these samples.
    """

    def __init__(self, samples: ProfiledSamples, geometry: Geometry) -> None:
        self.samples, self.geometry = samples, geometry
        collection = geometry.collection
        self.cell = samples.cell
        self.turns = 2 * (collection.carrier + profile_frequency(collection)) / SPEED_OF_LIGHT

    def places(self, region: Region, count: int) -> list[ProminentPoint]:
        """The most prominent places, at most `count`, from all short apertures."""
        found: list[ProminentPoint] = []
        for pulses in short_apertures(self.geometry.collection.n_pulse):
            found += self._bright(region, pulses)
        return sorted(found, key=lambda place: -place.prominence)[:count]

    def known(self, line: PointLine, others: Sequence[PointLine]) -> bool:
        """Tell whether a line belongs to the place of one of the others."""
        return any(self._near(line.place, other.place) for other in others)

    def _near(self, place: ProminentPoint, other: ProminentPoint) -> bool:
        return bool(np.hypot(place.x - other.x, place.y - other.y) < SAME * self.cell)

    def _bright(self, region: Region, pulses: slice) -> list[ProminentPoint]:
        """Find prominent places in the range-Doppler map of a short aperture."""
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
        ranges = np.arange(near, far, ROW * self.cell / self._steepness(near, far, (low + high) / 2))
        yaws = np.linspace(low, high, max(int((high - low) * way / (0.35 * collection.wavelength)), 3))
        every = math.ceil(np.sqrt(max(ranges.size * yaws.size * position.shape[0] / MOST_UPDATES, 1.0)))
        ranges, yaws = ranges[::every], yaws[::every]  # of a large scene some places are missed
        point = geometry.ground_point(ranges[None, :], yaws[:, None])
        x, y = (np.ascontiguousarray(point[..., axis]) for axis in (0, 1))
        image, outside = np.zeros(x.shape, np.complex64), np.zeros(x.shape, np.bool_)
        first, last = np.full(x.shape, pulses.start, np.int64), np.full(x.shape, pulses.stop, np.int64)
        profiles = self.samples.profiles(pulses.start, pulses.stop)
        pixels = LitPixels(x, y, geometry.known_height(x, y)[0], first, last)
        accumulate(image, outside, profiles, geometry=geometry, pixels=pixels, threads=self.samples.threads)
        if collection.has_axis:  # its edges are no yaws: beyond them lie only ambiguities of what it lights
            away = geometry.beam.offset(x, y, (pulses.start + pulses.stop) // 2)
            outside |= ~(np.abs(away) <= EDGE * (collection.beam_width or 0.0))  # NaN where no height is known
        power = np.where(outside, 0.0, np.nan_to_num(np.abs(image).astype(np.float64) ** 2))
        typical = float(np.median(power[power > 0])) if (power > 0).any() else 0.0
        strongest = float((np.abs(profiles.values).astype(np.float64) ** 2).sum(axis=0).max()) * len(position)
        least = max(STANDS_OUT * typical, SIDE_LOBES * strongest)
        places: list[ProminentPoint] = []
        while typical > 0 and len(places) < EACH:
            row, column = np.unravel_index(int(np.argmax(power)), power.shape)
            if power[row, column] < least:
                break
            prominence = float(power[row, column] / typical)
            middle = (pulses.start + pulses.stop) // 2
            places.append(ProminentPoint(float(x[row, column]), float(y[row, column]), prominence, middle))
            power[max(row - APART, 0) : row + APART + 1, max(column - APART, 0) : column + APART + 1] = 0.0
        return places

    def _steepness(self, near: float, far: float, yaw: float) -> float:
        """Largest factor, 1 .. 3, by which range changes faster over a terrain than over its smooth part, at a yaw."""
        if self.geometry.terrain is None:
            return 1.0
        ranges = np.linspace(near, far, FINE)
        x, y = self.geometry.ground_axes(ranges, np.full(FINE, yaw))
        change = np.diff(self._distance(x, y, self.geometry.collection.n_pulse // 2)) / np.diff(ranges)
        return float(np.clip(np.nanmax(np.abs(change), initial=1.0), 1.0, 3.0))

    def line(self, place: ProminentPoint, *, phase: FloatArray | None = None) -> PointLine | None:
        """The line of a place, moved to where it is brightest as the aperture grows about the pulse that saw it.

        None if it is not lit then. A phase error (n_pulse,), rad, is removed from its rows at last.
        """
        interval = self.lit(place)
        if interval is None:
            return None
        place, pulses, rows, row, shift = self._grown(place, *interval, place.pulse, ROWS)
        if phase is not None:
            rows = rows * np.exp(-1j * phase[pulses])[:, None]
        image = _small_image(rows, shift, min(BINS, rows.shape[0] // 4))
        line = PointLine(place, pulses, _demodulated(rows[:, row], shift))
        return replace(line, contrast=contrast(image, oversampling=2 / ROW), focus=_focus(image))

    def line_about(
        self, place: ProminentPoint, first: int, last: int, middle: int, *, later: FloatArray = ROWS
    ) -> PointLine:
        """The line of a place over the pulses first .. last - 1, found by apertures that grow about `middle`.

        The first of them looks at all ROWS, and those after it at `later`.
        """
        place, pulses, rows, row, shift = self._grown(place, first, last, middle, later)
        return PointLine(place, pulses, _demodulated(rows[:, row], shift))

    def surroundings(self, place: ProminentPoint) -> Contrast | None:
        """Contrast of a wide image of clutter about a place, over its dwell; None if it is not lit, or dark."""
        interval = self.lit(place)
        if interval is None:
            return None
        size = min(interval[1] - interval[0], MOST_PULSES)
        first = min(max(place.pulse - size // 2, interval[0]), interval[1] - size)
        rows = self._rows(place, slice(first, first + size), WIDE_ROWS)
        if (np.abs(rows) ** 2).mean() < DARK * self.samples.level(first):
            return None
        bins = min(WIDE_BINS, rows.shape[0] // 4)
        spectrum = fft_rows(np.ascontiguousarray(rows.T), inverse=False)
        return contrast(np.abs(np.r_["1", spectrum[:, -bins:], spectrum[:, :bins]]) ** 2, oversampling=1.0)

    def lit(self, place: ProminentPoint) -> tuple[int, int] | None:
        """First and last (exclusive) of the pulses that light a place, around the pulse that saw it; None if none."""
        first, last = (int(v) for v in self.geometry.beam.longest_pass(np.array(place.x), np.array(place.y)))
        return (first, last) if last - first >= SHORT and first - SHORT <= place.pulse <= last + SHORT else None

    def _grown(
        self, place: ProminentPoint, first: int, last: int, middle: int, later: FloatArray
    ) -> tuple[ProminentPoint, slice, Complex128Array, int, int]:
        """Refine a place by growing apertures; also return the last pulses, rows, and the brightest row and bin.

        Where the sight turns so far that a place half a cell away is out of focus, the last aperture is taken twice.
        """
        size, offsets, settled = SHORT, ROWS, not self._turns(place, first, last)
        while True:
            settled |= size == last - first
            size = min(LONGER * size, last - first)
            begin = min(max(middle - size // 2, first), last - size)
            pulses = slice(begin, begin + size)
            rows = self._rows(place, pulses, offsets)
            power = np.abs(fft_rows(np.ascontiguousarray(rows.T), inverse=False).T) ** 2
            reach = min(3 * LONGER, size // 2 - 1)
            near = np.r_[size - reach : size, 0 : reach + 1]
            bin_, row = (int(i) for i in np.unravel_index(int(np.argmax(power[near])), (near.size, offsets.size)))
            if size == last - first and settled:
                return place, pulses, rows, row, bin_ - reach
            shift = bin_ - reach + _beside(power[near, row], bin_)
            away = offsets[row] + ROW * _beside(power[near[bin_]], row)
            middle_pulse = (pulses.start + pulses.stop) // 2
            place = self._moved(place, middle_pulse, np.array([away * self.cell, shift / (size * self._interval)]))
            offsets = later

    def _turns(self, place: ProminentPoint, first: int, last: int) -> bool:
        """Tell whether the sight turns so much that an error of a range cell exceeds MOST_PHASE over the dwell."""
        position = self.geometry.collection.antenna_position[[first, (first + last) // 2, last - 1]]
        sight = np.array([place.x, place.y, self.geometry.collection.ground_height]) - position
        sight /= np.linalg.norm(sight, axis=1)[:, None]
        turn = np.linalg.norm(sight[2] - sight[0])
        return bool(2 * np.pi * self.turns * self.cell * turn**2 / 8 > MOST_PHASE)

    def echo(self, place: ProminentPoint) -> Echo:
        """Echo of the place in the pulse that saw it."""
        offset, doppler = self._seen(np.array(place.x), np.array(place.y), place.pulse)
        return Echo(place.pulse, float(offset), float(doppler))

    def seeds(self, region: Region) -> Seeds:
        """Points that cover a region, from which places are searched."""
        yaw = np.linspace(region.yaw[0], region.yaw[-1], SEEDS[1])
        near, far = region.at(yaw)
        point = self.geometry.ground_point(near + (far - near) * np.linspace(0, 1, SEEDS[0])[:, None], yaw)
        x, y = (point[..., axis][np.isfinite(point).all(axis=-1)] for axis in (0, 1))
        return Seeds(x, y, self.geometry.known_height(x, y)[0], float((far - near).max()))

    def place(self, echo: Echo, seeds: Seeds) -> ProminentPoint | None:
        """Find the lit ground with the range and Doppler of an echo, near a seed; None if there is none."""
        geometry, prf = self.geometry, self.geometry.collection.prf
        x, y, z, depth = seeds
        if (width := geometry.collection.beam_width) is not None:
            lit = np.abs(geometry.beam.offset(x, y, echo.pulse)) <= width / 2
            x, y, z = x[lit], y[lit], z[lit]
        if not x.size:
            return None
        offset, doppler = self._seen(x, y, echo.pulse, z)
        further = echo.doppler - doppler
        further -= prf * np.rint(further / prf)
        best = int(np.argmin(((echo.offset - offset) / depth) ** 2 + (further / prf) ** 2))
        wanted = np.array([echo.offset, doppler[best] + further[best]])
        return self._solved(ProminentPoint(float(x[best]), float(y[best]), 0.0, echo.pulse), wanted)

    def ambiguous(self, place: ProminentPoint, turns: int) -> ProminentPoint:
        """The place at the same range whose Doppler is `turns` times the PRF higher, seen from the place's pulse."""
        echo = self.echo(place)
        wanted = np.array([echo.offset, echo.doppler + turns * self.geometry.collection.prf])
        return self._solved(place, wanted) or place

    def _solved(self, place: ProminentPoint, wanted: FloatArray) -> ProminentPoint | None:
        """Solve for the place with an offset (m) and a Doppler (Hz) at its pulse, by Newton's method from another."""
        tolerance = np.array([self.cell, self.geometry.collection.prf / SHORT])  # resolution of a short aperture
        for _ in range(NEWTON):
            left = wanted - self._seen(np.array(place.x), np.array(place.y), place.pulse)
            if (np.abs(left) < CONVERGED * tolerance).all():
                return place
            place = self._moved(place, place.pulse, left)
        return None

    @property
    def _interval(self) -> float:
        return self.geometry.collection.pulse_interval

    def _distance(self, x: FloatArray, y: FloatArray, pulses: slice | int, z: FloatArray | None = None) -> FloatArray:
        z = self.geometry.known_height(x, y)[0] if z is None else z
        px, py, pz = np.moveaxis(self.geometry.collection.antenna_position[pulses], -1, 0)
        return np.sqrt((px - x) ** 2 + (py - y) ** 2 + (pz - z) ** 2)

    def _rows(self, place: ProminentPoint, pulses: slice, offsets: FloatArray) -> Complex128Array:
        """Samples (n, n_row) at offsets (n_row,) in range cells from a place, with its phase removed."""
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

    def _moved(self, place: ProminentPoint, pulse: int, change: FloatArray) -> ProminentPoint:
        """Move a place so that its offset (m) and Doppler (Hz) at a pulse change by `change`."""
        at = np.array([place.x, place.y])
        wanted = self._seen(at[0], at[1], pulse) + change
        x, y = solvers.newton(lambda moved: self._seen(moved[0], moved[1], pulse), wanted, at, steps=1)
        return place._replace(x=float(x), y=float(y)) if np.isfinite([x, y]).all() else place

    def _seen(self, x: FloatArray, y: FloatArray, pulse: int, z: FloatArray | None = None) -> FloatArray:
        """R - reference_range (m) and Doppler (Hz) of points, m, about a pulse: (2, ...)."""
        collection = self.geometry.collection
        first, last = max(pulse - BASE, 0), min(pulse + BASE, collection.n_pulse - 1)
        z = self.geometry.known_height(x, y)[0] if z is None else z
        before, after = (self._distance(x, y, p, z) - collection.reference_range[p] for p in (first, last))
        return np.stack([(before + after) / 2, -self.turns * (after - before) / ((last - first) * self._interval)])


def _beside(power: FloatArray, peak: int) -> float:
    """Position of a maximum relative to sample `peak`, by a parabola; 0 at the ends."""
    return solvers.vertex(power[max(peak - 1, 0) : peak + 2])


def _demodulated(values: Complex128Array, shift: int) -> Complex128Array:
    """Shift the peak of a line to zero Doppler."""
    return np.asarray(values * np.exp(-2j * np.pi * shift / values.size * np.arange(values.size)))


def _small_image(rows: Complex128Array, shift: int, reach: int) -> FloatArray:
    """Power (n_bin, n_row) about a Doppler bin, at every half bin."""
    size = rows.shape[0]
    near = (shift + np.arange(-reach, reach)) % size
    between = rows * np.exp(-1j * np.pi / size * np.arange(size))[:, None]
    whole, half = (fft_rows(np.ascontiguousarray(part.T), inverse=False).T[near] for part in (rows, between))
    return np.asarray(np.abs(np.stack([whole, half], axis=1).reshape(-1, rows.shape[1])) ** 2)


def _focus(image: FloatArray) -> float:
    """Lesser share of a small image's energy that its peak holds, along the track or in range."""
    bin_, row = np.unravel_index(int(np.argmax(image)), image.shape)
    peak = float(image[bin_, row])
    return min(1.0, peak / max(float(image[:, row].sum()) / 2, float(image[bin_].sum()) * ROW, 1e-300))
