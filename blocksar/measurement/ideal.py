"""The ideal response of a point target: the exact back-projection of its echo alone.

With dR(t) the range of a point p less that of the target q, over the times at which both are lit,

    h(p) = integral of w_p g_q W^(2 B dR / c) exp(4j pi fc dR / c) dt / integral over p's own dwell of w_p g_p dt

W^(u) is the ideal response of the weighting over the band B (`Taper.response`), w that over the dwell, and g the
antenna's gain. On a small band and over a small turn of the line of sight h is the product of two such responses: the
wavenumbers fill a rectangle. Else they fill part of a ring, whose side lobes and widths differ: over a band of 40 % the
azimuth side lobes are -14.4 dB, and a flight through an arc of 25 degrees about a spot has side lobes of -25 dB in
range. Where the dwell is little longer than the response, the beam moves on between p and q, which widens h.

Pulses are taken as dense: the mean over them is an integral, from half an interval before the first one on.
"""

from __future__ import annotations

import numpy as np

from blocksar import solvers
from blocksar.arrays import Complex128Array, FloatArray, IntArray
from blocksar.collection.axis_beam import Height
from blocksar.collection.beam import at_times, dwell, dwell_weight, pattern_gain, pulse_weights
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import NODES, UNIFORM, Taper, Weighting
from blocksar.constants import SPEED_OF_LIGHT

LEAST_NODES = 48  # over a dwell; two more for each turn of phase by which a point's range changes in it
STEPS = 128  # of the table of W^, per unit of u: linear between them to 1e-5


def ideal_response(
    geometry: Geometry, origin: tuple[float, float], x: FloatArray, y: FloatArray, weighting: Weighting = UNIFORM
) -> Complex128Array:
    """The response h (n,) of a target of reflectivity 1 on the ground at `origin`, at ground points x, y (n,), m.

    0 where target and point are never lit together, NaN where the terrain has no height, and all NaN where it has none
    at the target, or the target is never lit.
    """
    collection, taper = geometry.collection, weighting.azimuth
    of_x, of_y = np.array([origin[0]]), np.array([origin[1]])
    begin, end = (float(edge[0]) for edge in dwell(geometry, of_x, of_y))
    if not (begin < end and np.isfinite(geometry.on_ground(of_x, of_y)).all()):
        return np.full(x.shape, np.nan + 0j)
    own_begin, own_end = dwell(geometry, x, y)
    known = np.isfinite(geometry.on_ground(x, y)).all(axis=-1)
    both = known & (np.minimum(own_end, end) > np.maximum(own_begin, begin))
    x, y, own_begin, own_end = x[both], y[both], own_begin[both], own_end[both]
    first, last = np.maximum(own_begin, begin), np.minimum(own_end, end)

    plain = taper.uniform and not collection.has_pattern
    swing = _swing(geometry, origin, x, y, np.linspace(begin, end, 17))
    nodes, weights = solvers.gauss_legendre(max(LEAST_NODES + 2 * int(np.ceil(swing)), 0 if plain else NODES))

    def over(first: FloatArray, last: FloatArray) -> FloatArray:
        """Times (n, nodes) between those (n,)."""
        return np.asarray((last + first)[:, None] / 2 + (last - first)[:, None] / 2 * nodes)

    def tapered(geometry: Geometry, x: FloatArray, y: FloatArray, pulses: IntArray, z: Height | None) -> FloatArray:
        return pulse_weights(geometry, x, y, pulses, taper, z)

    time = over(first, last)
    offset = _offset(geometry, origin, x, y, time)
    made = _over_band(weighting.range, collection.bandwidth, offset)
    whole = own_end - own_begin
    if not plain:
        made *= at_times(geometry, x[:, None], y[:, None], time, tapered)
        made *= at_times(geometry, of_x, of_y, time, pattern_gain)
        counted = dwell_weight(geometry, x[:, None], y[:, None], over(own_begin, own_end), taper)
        whole = whole * (counted @ weights) / 2
    turned = (made * np.exp(4j * np.pi * collection.carrier / SPEED_OF_LIGHT * offset)) @ weights / 2
    response = np.where(known, 0j, np.nan + 0j)
    response[both] = turned * (last - first) / np.where(whole > 0, whole, np.inf)
    return response


def _offset(
    geometry: Geometry, origin: tuple[float, float], x: FloatArray, y: FloatArray, time: FloatArray
) -> FloatArray:
    """dR of points (n,) at times (n, m), or (m,), m."""
    point, target = geometry.on_ground(x, y)[:, None, :], geometry.on_ground(*(np.array(at) for at in origin))
    antenna = geometry.track.position(time)
    return np.asarray(np.linalg.norm(point - antenna, axis=-1) - np.linalg.norm(target - antenna, axis=-1))


def _swing(geometry: Geometry, origin: tuple[float, float], x: FloatArray, y: FloatArray, time: FloatArray) -> float:
    """Largest turn of phase (cycles, at the top of the band) by which dR of points (n,) changes over times (m,)."""
    collection = geometry.collection
    top = collection.carrier + collection.bandwidth / 2
    return float(2 * top / SPEED_OF_LIGHT * np.ptp(_offset(geometry, origin, x, y, time), axis=1).max(initial=0.0))


def _over_band(taper: Taper, bandwidth: float, offset: FloatArray) -> FloatArray:
    """W^(2 B dR / c)."""
    u = 2 * bandwidth / SPEED_OF_LIGHT * offset
    if taper.uniform:
        return np.asarray(np.sinc(u))
    known = np.arange(int(np.abs(u).max(initial=0.0) * STEPS) + 2) / STEPS
    return np.interp(np.abs(u), known, taper.response(known))
