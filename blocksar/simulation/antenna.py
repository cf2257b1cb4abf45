"""The antenna of a scene: its axis, the steering of its beam, and its patterns by name.

Named patterns are two-way amplitudes, the squares of one-way amplitudes of 1 / sqrt(2) at the edges of the beam: half
of the power is lost there on either way.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.collection.axis_beam import side_of
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import taylor_coefficients
from blocksar.errors import InputError
from blocksar.simulation.scene_fields import BeamTable

SIDE, YAWS = 80, 641  # degrees of yaw on either side of the centre that a beam may light, and yaws examined
PATTERN_SAMPLES = 257  # of a named pattern over its width
NBAR, SIDE_LOBES = 4, -35.0  # of the Taylor illumination: its nearly constant side lobes, and their level, dB


def axis_beam(
    beam: BeamTable, time: FloatArray, positions: FloatArray, centre: FloatArray
) -> dict[str, FloatArray | str]:
    """beam_axis (n, 3) and beam_steering (n,), rad, at slow times (n,), s, and positions (n, 3), m; side_of_track.

    `centre` is the scene centre (3,), m, at which a spotlight looks; no side_of_track if it is right below the track.
    """
    middle = time.size // 2
    side = side_of(np.gradient(positions, time, axis=0)[middle], centre - positions[middle])
    if beam.axis_yaw_deg is None:
        axis = _along(np.gradient(positions, time, axis=0))
    else:
        yaw, pitch = np.deg2rad([beam.axis_yaw_deg, beam.axis_pitch_deg])
        fixed = [np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)]
        axis = np.tile(np.array(fixed), (time.size, 1))
    if beam.mode == "spotlight" or beam.point is not None:
        point = centre if beam.point is None else np.array(beam.point)
        steering = np.arcsin((_along(point - positions) * axis).sum(axis=1))
    else:
        steering = np.deg2rad(beam.squint_deg + (beam.rate_deg or 0.0) * time)
    found: dict[str, FloatArray | str] = {"beam_axis": axis, "beam_steering": steering}
    return found if side is None else found | {"side_of_track": side}


def _along(directions: FloatArray) -> FloatArray:
    """Normalise directions (n, 3)."""
    return np.asarray(directions / np.sqrt((directions * directions).sum(axis=1, keepdims=True)))


def patterns(beam: BeamTable, width_deg: float, sight: Callable[[], FloatArray]) -> dict[str, FloatArray]:
    """Patterns by the names of `Collection`; `sight` returns the vector (3,) from the antenna to the scene centre.

    A named elevation pattern lies about the elevation of the scene centre.
    """
    found = {}
    if beam.pattern is not None:
        found["beam_offset"], found["beam_pattern"] = _pattern(beam.pattern, width_deg)
    if beam.elevation_pattern is not None:
        down, amplitude = _pattern(beam.elevation_pattern, beam.elevation_width_deg or 0.0)
        if isinstance(beam.elevation_pattern, str):
            to_centre = sight()
            down = down + float(np.arctan2(-to_centre[2], np.hypot(to_centre[0], to_centre[1])))
        found["elevation"], found["elevation_pattern"] = down, amplitude
    return found


def _pattern(pattern: str | tuple[tuple[float, float], ...], width_deg: float) -> tuple[FloatArray, FloatArray]:
    """Angles, rad, and two-way amplitudes of a pattern given by name or samples."""
    if isinstance(pattern, str):
        return named_pattern(pattern, float(np.deg2rad(width_deg)))
    angle, amplitude = np.array(pattern).T
    return np.deg2rad(angle), amplitude


def lit_yaws(
    geometry: Geometry, centre: float, swath: Callable[[FloatArray], tuple[FloatArray, FloatArray]]
) -> tuple[float, float]:
    """First and last yaw, rad, that a beam about its axis lights within SIDE degrees of the centre.

    `swath` returns x, y (m) of points all over the swath at yaws (n,).

    Raises
    ------
    InputError
        If it lights none.
    """
    yaw = centre + np.deg2rad(np.linspace(-SIDE, SIDE, YAWS))
    first, last = geometry.beam.dwell(*swath(yaw))
    lit = np.flatnonzero((last > first).any(axis=0))
    if lit.size == 0:
        raise InputError(
            f"beam.mode: the beam lights none of the swath within {SIDE} degrees of scene.centre_yaw_deg = "
            f"{np.degrees(centre):g}; turn the axis, or steer it there"
        )
    return float(yaw[max(lit[0] - 1, 0)]), float(yaw[min(lit[-1] + 1, YAWS - 1)])


def named_pattern(name: str, width: float) -> tuple[FloatArray, FloatArray]:
    """Angles over a beam of `width`, rad, and two-way amplitudes of a pattern: `sinc2`, `gaussian` or `taylor`."""
    place = np.linspace(-1.0, 1.0, PATTERN_SAMPLES)  # 1 at the edge
    if name == "gaussian":
        one_way = np.exp(-np.log(2) / 2 * place**2)
    else:
        factors = taylor_coefficients(NBAR, SIDE_LOBES) if name == "taylor" else np.zeros(0)
        one_way = _aperture(place * _half_power(name), factors)
    return place * width / 2, one_way**2


@lru_cache
def _half_power(name: str) -> float:
    """Angle at which the one-way amplitude of an aperture is 1 / sqrt(2), in wavelengths over the aperture."""
    factors = taylor_coefficients(NBAR, SIDE_LOBES) if name == "taylor" else np.zeros(0)
    low, high = 0.0, 1.0
    for _ in range(60):
        middle = (low + high) / 2
        above = float(_aperture(np.array([middle]), factors)[0]) > np.sqrt(0.5)
        low, high = (middle, high) if above else (low, middle)
    return low


def _aperture(place: FloatArray, factors: FloatArray) -> FloatArray:
    """Far field of an aperture with the illumination 1 + 2 sum F_m cos(2 pi m v), v in [-1/2, 1/2]; 1 at the centre."""
    field = np.sinc(place)
    for m, factor in enumerate(factors, 1):
        field = field + factor * (np.sinc(place - m) + np.sinc(place + m))
    return np.asarray(field)
