"""The area of the point response, by which the power of an image becomes backscatter of an area of the ground.

The image at q is sum s w W exp(j phase(q)) / sum w W g over the lit valid pulses p and all range frequencies f, so that
a target of reflectivity 1 at x leaves there

    h(q, x) = sum w W g exp(j k . (q - x)) / sum w W g

about it, with k = 4 pi (fc + f) / c times the line of sight along the ground. Samples tile the plane of wavenumbers k,
each an area J = |dk/df x dk/dp| of it for steps of one sample. The sum is therefore the integral of
(w W g / J) exp(j k . (q - x)) over that plane, and by Parseval's theorem

    A(x) = integral of |h|^2 d^2 q = (2 pi)^2 sum (w W g)^2 / J / (sum w W g)^2,

m^2. Clutter is a field of independent scatterers whose mean squared reflectivities add up to s a square metre. Its
image has the mean power s times the integral of |h(q, x)|^2 over x, which is s A: A changes little over a response.

With u the line of sight, R the range, v the antenna's velocity and n the upward normal of the ground,
du/dt = -(v - (v . u) u) / R, so that

    J = (4 pi / c)^2 (fc + f) |(u x v) . n| / R times the steps in frequency and time.

Samples that stand for shares s of a step count s times, and have s of its J: one s is left in the squares. J is a
product, and so is A: c^2 / (4 df dt) times sum W^2 / (fc + f) / (sum W)^2 over range frequencies, times
sum (w g)^2 R / |(u x v) . n| / (sum w g)^2 over pulses. Equal weights of a short dwell T broadside of a straight track
give (c / 2B) / sin(incidence) times (wavelength R / (2 |v| T)): the cell of the textbook.

The area is that of level ground at the point's height; `terrain_layers.slope_factors` has what slopes change. It holds
where dwells see each direction once: passes that repeat one add up coherently, which J does not know. It also holds
only where the ground beside a point that the point's own pulses light is some responses long: 2 responses before the
end of what a beam lights, A is right to 0.1 dB, and half a response before it 1 dB too large. A pattern in
elevation cancels as far as it does not change over a dwell, and is taken as constant. Where a raw echo recorded parts
of pulses, A is times the mean share of W^2 over the square of that of W (`recorded_pulses`).

Sums over pulses are smooth over the ground against the length that the beam lights, apart from bends where dwells begin
to be cut: they are computed at every NODE_PIXELS-th pixel, or closer where that length has few pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from blocksar.arrays import FloatArray, IntArray
from blocksar.collection.axis_beam import Height
from blocksar.collection.beam import GAIN_PARTS
from blocksar.collection.geometry import Geometry
from blocksar.collection.sampling import refuse_departures
from blocksar.collection.weighting import Taper, Weighting
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.imaging.noise import NODE_PIXELS, dwell_parts, nodes_of, over_pixels
from blocksar.imaging.recorded_pulses import recorded_means

NODES_LIT = 64  # on the length that the beam lights, at least


class ResponseSums(NamedTuple):
    """Sums over the lit valid pulses of points (...): of (w g)^2 R / |(u x v)_z|, s, and of w g."""

    squares: FloatArray
    gains: FloatArray


def response_sums(
    geometry: Geometry, x: FloatArray, y: FloatArray, z: Height, valid: FloatArray, taper: Taper
) -> ResponseSums:
    """The sums at points x, y, z (...), m; below 0 beyond the ends of the beam, as those of `noise.pulse_sums`."""
    squares, gains = np.zeros(np.shape(x)), np.zeros(np.shape(x))
    for count, _, middle in dwell_parts(geometry, x, y, valid, z, GAIN_PARTS):
        weight = geometry.beam.weights(x, y, middle, taper, z) * geometry.beam.gain(x, y, middle, z)
        squares += count * weight**2 * _slowness(geometry, x, y, z, middle)
        gains += count * weight
    return ResponseSums(squares, gains)


def _slowness(geometry: Geometry, x: FloatArray, y: FloatArray, z: Height, pulses: IntArray) -> FloatArray:
    """R / |(u x v)_z| of points (...) at a pulse each (...), s."""
    px, py, pz = np.moveaxis(geometry.collection.antenna_position[pulses], -1, 0)
    vx, vy, _ = np.moveaxis(geometry.track.velocity(geometry.collection.time[pulses]), -1, 0)
    dx, dy, dz = x - px, y - py, z - pz
    with np.errstate(divide="ignore"):
        return np.asarray((dx * dx + dy * dy + dz * dz) / np.abs(dx * vy - dy * vx))


@dataclass(frozen=True, kw_only=True, eq=False)
class AreaMap:
    """The areas of the responses of an image's pixels, on level ground.

    Attributes
    ----------
    geometry : Geometry
    weighting : Weighting
    valid : (n_pulse,) float
        Fraction of each pulse's samples that are valid.
    sample : float
        c^2 / (4 df dt) sum W^2 / (fc + f) / (sum W)^2, m^2/s.
    """

    geometry: Geometry
    weighting: Weighting
    valid: FloatArray
    sample: float

    @classmethod
    def of(cls, geometry: Geometry, weighting: Weighting, valid: FloatArray | None = None) -> Self:
        """The areas of a collection's image; by default every sample is valid.

        Raises
        ------
        InputError
            If the collection is bistatic.
        """
        collection = geometry.collection
        refuse_departures("backscatter", collection.two_antennas, "take the power of the image")
        plane = geometry.lit_by(collection.without_elevation).over(None)
        weights = weighting.range.weights(collection.range_frequency, collection.band)
        squares = weights * weighting.range.on(collection.range_frequency, collection.band)
        band = float((squares / (collection.carrier + collection.range_frequency)).sum() / weights.sum() ** 2)
        steps = collection.range_frequency_step * collection.pulse_interval
        valid = np.ones(collection.n_pulse) if valid is None else valid
        return cls(geometry=plane, weighting=weighting, valid=valid, sample=SPEED_OF_LIGHT**2 / (4 * steps) * band)

    def at(self, x: FloatArray, y: FloatArray, z: FloatArray | None = None) -> FloatArray:
        """Areas at points x, y (...), m, of the plane, or at heights z, m: (...), m^2.

        NaN where no pulse lights a point or the image has none; infinite below a straight track, where an image has no
        second dimension.
        """
        x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        return self._areas(self._sums(x, y, z), x, y, z)

    def over(self, x: FloatArray, y: FloatArray, z: FloatArray | None = None) -> FloatArray:
        """Areas at pixels of columns x (n_x,) and rows y (n_y,), m, as `at`: (n_y, n_x), m^2.

        `z` (n_y, n_x) has their heights, m; unknown ones, NaN, are taken for the plane's.
        """
        columns, rows = (_close_nodes(axis, self._lit_length(x, y)) for axis in (x, y))
        some = None if z is None else z[np.ix_(rows, columns)]
        if some is not None:
            some = np.where(np.isfinite(some), some, self.geometry.collection.ground_height)
        sums = self._sums(*np.meshgrid(x[columns], y[rows]), some)
        sums = ResponseSums(*(over_pixels(part, rows, columns, y, x) for part in sums))
        return self._areas(sums, *np.meshgrid(x, y), z)

    def _lit_length(self, x: FloatArray, y: FloatArray) -> float:
        """Length of what the beam lights at a time in the middle of an image, m."""
        collection = self.geometry.collection
        if collection.beam_width is None:
            return np.inf
        middle = [float(axis[axis.size // 2]) for axis in (x, y)]
        away = collection.antenna_position - [*middle, collection.ground_height]
        return float(np.linalg.norm(away, axis=1).min()) * collection.beam_width

    def _sums(self, x: FloatArray, y: FloatArray, z: FloatArray | None) -> ResponseSums:
        return response_sums(self.geometry, x, y, self._height(z), self.valid, self.weighting.azimuth)

    def _height(self, z: FloatArray | None) -> Height:
        return self.geometry.collection.ground_height if z is None else z

    def _areas(self, sums: ResponseSums, x: FloatArray, y: FloatArray, z: FloatArray | None) -> FloatArray:
        lit = (sums.squares > 0) & (sums.gains > 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            area = np.where(lit, self.sample * sums.squares / sums.gains**2, np.nan)
        recorded = self.geometry.collection.recorded
        if recorded is not None and recorded.partial:
            means = recorded_means(self.geometry, x, y, self._height(z), weighting=self.weighting)
            area = area * means.power / means.amplitude**2
        return np.asarray(area)


def _close_nodes(axis: FloatArray, length: float) -> IntArray:
    """Nodes of an axis, NODES_LIT of them or more to a length, m."""
    n = axis.size
    spacing = abs(float(axis[-1] - axis[0])) / max(n - 1, 1)
    return nodes_of(n, NODE_PIXELS if spacing == 0 else int(np.clip(length / NODES_LIT / spacing, 1, NODE_PIXELS)))
