"""The point of the Earth at a range to one side of a track: where a scene lies, from what an orbit and a radar tell."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.collection.georeference import Georeference, geodetic_of
from blocksar.errors import InputError

ROUNDED = 1e-12  # rad, to which the angle about the track is bisected: 1 micrometre at 1000 km


def find_scene_centre(
    position: FloatArray, velocity: FloatArray, *, slant_range: float, side: str, height: float, squint: float
) -> Georeference:
    """The frame about the point at a range from an antenna, at a height above WGS 84.

    The point p + R (sin(squint) t + cos(squint) (cos(a) d + sin(a) s)), with t along the velocity, d as close to the
    downward direction as a normal of t can be, and s to the side, rises with the angle a; a is bisected until the point
    has the height that is asked for.

    Parameters
    ----------
    position, velocity : (3,) float
        Of the antenna, Earth-centred, Earth-fixed, m and m/s; of the velocity only the direction counts.
    slant_range : float
        R, m.
    side : {"left", "right"}
        Of the track, seen along the flight.
    height : float
        m above WGS 84.
    squint : float
        Angle of the line of sight ahead of the plane normal to the velocity, rad; 0: where Doppler is zero.

    Raises
    ------
    InputError
        If no ground lies there: the range is shorter than the antenna's height, or reaches beyond the horizon.
    """
    along = velocity / np.linalg.norm(velocity)
    up, own = _up(position), geodetic_of(position)[2] - height
    down = -(up - float((up * along).sum()) * along)
    down /= np.linalg.norm(down)
    beside = np.cross(along, down) if side == "left" else np.cross(down, along)
    centre, radius = position + slant_range * np.sin(squint) * along, slant_range * np.cos(squint)

    def point(angle: float) -> FloatArray:
        return np.asarray(centre + radius * (np.cos(angle) * down + np.sin(angle) * beside))

    if geodetic_of(point(0.0))[2] >= height:
        raise InputError(
            f"slant_range is {slant_range:.6g} m, but the antenna is {own:.6g} m above the height of {height:g} m; "
            "correct one of them"
        )
    ground = point(_bisect(lambda angle: geodetic_of(point(angle))[2] - height))
    if float(((position - ground) * _up(ground)).sum()) <= 0:
        raise InputError(
            f"slant_range is {slant_range:.6g} m, beyond the horizon of an antenna {own:.6g} m high; correct it"
        )
    latitude, longitude, _ = geodetic_of(ground).tolist()
    return Georeference(latitude=latitude, longitude=longitude, height=height)


def _up(point: FloatArray) -> FloatArray:
    """The normal of the ellipsoid (3,) at a point, ECEF."""
    latitude, longitude, _ = geodetic_of(point).tolist()
    return np.asarray(Georeference(latitude=latitude, longitude=longitude, height=0.0).east_north_up[2])


def _bisect(value: Callable[[float], float]) -> float:
    """Where a function that rises from below zero at 0 passes zero, up to half a turn."""
    low, high = 0.0, np.pi
    while high - low > ROUNDED:
        middle = (low + high) / 2
        low, high = (middle, high) if value(middle) < 0 else (low, middle)
    return (low + high) / 2
