"""Directions and nominal widths of a point target's response: of a rectangle of wavenumbers (`figures.DEFINITIONS`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from blocksar import solvers
from blocksar.arrays import FloatArray
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import NODES, UNIFORM, DwellShape, Taper, Weighting
from blocksar.constants import SPEED_OF_LIGHT

MIN_OVERSAMPLING = 1.2  # of a response's band by pixels: the taps to interpolate it grow without bound towards 1


@dataclass(frozen=True, kw_only=True)
class ResponseAxes:
    """Directions and nominal widths of one target's response.

    Attributes
    ----------
    time : float
        t_m, the middle of the dwell, s.
    range_direction, azimuth_direction : (2,) float
        Ground step (dx, dy) in m for 1 m of slant range along constant Doppler, and for 1 m along constant
        range. The second is a unit vector; the first is longer than one.
    range_width, azimuth_width : float
        Nominal widths, m of slant range and m along the cut.
    band : (2,) float
        Largest |wavenumber| in x and y, cycles/m, of the response once its carrier is removed.
    azimuth_shape : Taper or DwellShape
        Weights in azimuth: the taper, with the antenna's pattern over the dwell if there is one.
    weighting : Weighting
        Tapers over band and dwell.
    """

    time: float
    range_direction: FloatArray
    azimuth_direction: FloatArray
    range_width: float
    azimuth_width: float
    band: FloatArray
    azimuth_shape: Taper | DwellShape
    weighting: Weighting = UNIFORM

    @property
    def area(self) -> float:
        """The ground area A, m^2, over which |response|^2 integrates to that of a peak of 1.

        Clutter of reflectivity s a square metre (mean squared magnitude) has the mean squared magnitude s A in the
        image. A is that of a resolution cell, 1 / band in range by 1 / extent in azimuth, times what the weights add.
        """
        (rx, ry), (ax, ay) = self.range_direction, self.azimuth_direction
        in_range, in_azimuth = self.weighting.range, self.azimuth_shape
        along_range = self.range_width / in_range.ideal.width * in_range.spread
        return abs(rx * ay - ry * ax) * along_range * self.azimuth_width / in_azimuth.ideal.width * in_azimuth.spread

    def ground_offset(self, range_offset: FloatArray, azimuth_offset: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(dx, dy) in m on the ground, at offsets in m along the two axes (broadcast)."""
        (rx, ry), (ax, ay) = self.range_direction, self.azimuth_direction
        return range_offset * rx + azimuth_offset * ax, range_offset * ry + azimuth_offset * ay

    def own_offset(self, dx: FloatArray, dy: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Inverse of `ground_offset`."""
        (rx, ry), (ax, ay) = self.range_direction, self.azimuth_direction
        area = rx * ay - ry * ax
        return (dx * ay - dy * ax) / area, (rx * dy - ry * dx) / area


def _range_gradient(geometry: Geometry, point: FloatArray, time: FloatArray) -> FloatArray:
    """grad_xy R of a ground point (3,) along the ground, at slow times (n,): (n, 2)."""
    sight = geometry.gradient(point, time)
    if geometry.terrain is None:
        return np.asarray(sight[:, :2])
    return np.asarray(sight[:, :2] + sight[:, 2:] * geometry.terrain.slope(point[0], point[1]))


def response_axes(geometry: Geometry, x: float, y: float, weighting: Weighting = UNIFORM) -> ResponseAxes | None:
    """Axes of the response of a target at x, y (m); None if never lit, if its pattern is zero, or if the axes coincide.

    The azimuth band is exact for a ground gradient that turns uniformly over the dwell: it is taken between
    the first and the last edge of the lit pulses (`Beam.dwell`), at the carrier.
    """
    collection = geometry.collection
    start, end = (float(edge) for edge in geometry.beam.dwell(np.array(x), np.array(y)))
    if not start < end:
        return None
    point = geometry.on_ground(np.array(x), np.array(y))
    first, middle, last = _range_gradient(geometry, point, np.array([start, (start + end) / 2, end]))
    turn = last - first
    length, turned = float(np.hypot(*middle)), float(np.hypot(*turn))
    if not (length > 0 and turned > 0):  # nor where the terrain has no height
        return None
    azimuth = np.array([-middle[1], middle[0]]) / length
    along_doppler = np.array([-turn[1], turn[0]]) / turned
    slope = float(along_doppler @ middle)  # dR/ds; dividing by it makes the cut point away from the radar
    extent = 2 * collection.carrier / SPEED_OF_LIGHT * abs(float(turn @ azimuth))
    # Both vanish where the ground gradient changes along itself only: the image is not two-dimensional there.
    if abs(slope) < 1e-6 * length or extent == 0:
        return None
    shape: Taper | DwellShape = weighting.azimuth
    if collection.has_pattern:
        shape = _patterned(geometry, point, start, end, azimuth, weighting.azimuth)
        if not shape.weight.any():
            return None
    carrier, half_band = collection.carrier, collection.bandwidth / 2
    corners = [2 * (carrier + f) / SPEED_OF_LIGHT * k for f in (-half_band, half_band) for k in (first, middle, last)]
    band = np.abs(np.array(corners) - 2 * carrier / SPEED_OF_LIGHT * middle).max(axis=0)
    return ResponseAxes(
        time=(start + end) / 2,
        range_direction=along_doppler / slope,
        azimuth_direction=azimuth,
        range_width=weighting.range.ideal.width * SPEED_OF_LIGHT / (2 * collection.bandwidth),
        azimuth_width=shape.ideal.width / extent,
        band=band,
        azimuth_shape=shape,
        weighting=weighting,
    )


def _patterned(
    geometry: Geometry, point: FloatArray, start: float, end: float, azimuth: FloatArray, taper: Taper
) -> DwellShape:
    """Weights of a point (3,) that is lit from start to end, s, under an antenna's pattern."""
    nodes, weights = solvers.gauss_legendre(NODES)
    time = (start + end) / 2 + (end - start) / 2 * nodes
    counted = geometry.beam.dwell_weight(point[0], point[1], time, taper)
    along = _range_gradient(geometry, point, np.array([start, end, *time])) @ azimuth
    v = (2 * along[2:] - along[0] - along[1]) / (along[1] - along[0])
    return DwellShape(v=v, weight=weights * counted, square=weights * counted**2)
