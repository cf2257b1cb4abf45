"""Checks of positions for other frames and units: km, degrees, Earth-centred, inertial, rounded to float32.

Each is recognised by sizes and by the speed over ground, and reported with its remedy. Positions are never changed.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.collection.georeference import Georeference
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError

SMALLEST, LARGEST = 6.33e6, 6.0e7  # m from the Earth's centre: below the deepest ground at a pole, beyond any orbit
EQUATOR = 6378137.0  # m
DEGREE = 111.2e3  # m on the ground
COARSE = 1000.0  # m across the line of sight: no synthetic aperture resolves so little
LOW = 300.0  # m above the ground: below, small horizontal coordinates may be metres, as on a rail
AIRCRAFT, ORBITS = (20.0, 1200.0), (500.0, 9000.0)  # m/s over ground, below and above SPACE
SPACE = 100e3  # m
STEEP = 0.5  # of its speed: no track in a local frame climbs so fast
ROUNDED = 0.3  # rad: rms of the phase by rounding of positions, from which on amplitudes fall by 5 %
NOISY = 0.1  # of a step of float32, rms of third differences: rounding has 1.3, a smooth track next to none
GM, SPIN = 3.986004418e14, 7.2921159e-5  # m^3/s^2, rad/s
FREE_FALL = 0.1  # m/s^2, within which a track falls freely: harmonics of the Earth's field stay below 0.03
TOLD_APART = 0.5  # m/s^2, by which it must not do so in the other frame
FOLLOWS = 0.1  # of the change of range by the Earth's rotation, within which a reference range follows the ground
ECEF_OF = "np.stack(pyproj.Transformer.from_crs(4979, 4978).transform(latitude, longitude, height), axis=-1)"


def check_scene_frame(
    *, carrier: float, time: FloatArray, position: FloatArray, reference: FloatArray, ground_height: float
) -> None:
    """Refuse positions (n, 3) outside a local frame in m, z up, if another frame or unit explains them.

    Arguments that fit no collection pass: what is wrong with them is said elsewhere.

    Raises
    ------
    InputError
        If they look like latitude and longitude, Earth-centred, z down, or are rounded to float32.
    """
    if not _usable(time, position, reference):
        return
    _check_rounding(carrier, position)
    distance = float(np.median(reference))
    _check_degrees(carrier, time, position, distance, ground_height, "earth_centred=True and a georeference")
    for unit, metres in (("m", 1.0), ("km", 1e3)):
        if _is_earth_centred(metres * position, time, distance, ground_height):
            raise InputError(
                f"antenna_position lies {_size(position):.6g} from its origin, at a range of {distance:.6g} m: it "
                f"looks Earth-centred{'' if unit == 'm' else ', in km: multiply it by 1000'}; give earth_centred=True, "
                "and the georeference of a scene frame, such as blocksar.scene_centre returns"
            )
    below = -position[:, 2] - ground_height
    if (
        (position[:, 2] < 0).all()
        and (below <= distance).all()
        and distance > 0
        and float(below.min()) > 0.02 * distance
    ):
        raise InputError(
            f"antenna_position has z = {np.median(position[:, 2]):.6g} m at a range of {distance:.6g} m: z looks like "
            "down, but must point up; of north, east and down give east, north and -down, in this order"
        )


def check_earth_centred(
    *, carrier: float, time: FloatArray, position: FloatArray, reference: FloatArray, frame: Georeference
) -> None:
    """Refuse positions (n, 3) that are not Earth-centred, Earth-fixed, in m, if another frame or unit explains them.

    Raises
    ------
    InputError
        If they look like km, latitude and longitude, a local frame, inertial (ECI), are rounded to float32, or lie
        below the horizon of the georeference.
    """
    if not _usable(time, position, reference):
        return
    _check_degrees(carrier, time, position, float(np.median(reference)), 0.0, "them")
    check_centre(position)
    _check_rounding(carrier, position)
    _check_inertial(time, position, reference, frame)
    local = frame.from_ecef(position)
    if (local[:, 2] < 0).all():
        away = float(np.median(np.sqrt((local**2).sum(axis=1))))
        raise InputError(
            f"antenna_position lies {away:.6g} m from the georeference's origin, below its horizon; correct the "
            "georeference, or turn positions that are inertial (ECI) into Earth-fixed ones (ECEF)"
        )


def check_centre(position: FloatArray) -> None:
    """Refuse positions (n, 3), m, that do not lie about the Earth's centre.

    Raises
    ------
    InputError
        If they do not; it says what they look like.
    """
    size = _size(position)
    if not SMALLEST <= size <= LARGEST:
        if SMALLEST <= 1e3 * size <= LARGEST:
            remedy = "it looks like km: multiply it by 1000"
        elif SMALLEST <= 1e-3 * size <= LARGEST:
            remedy = "it looks like mm: divide it by 1000"
        else:
            remedy = "it looks like a local frame: leave out earth_centred, or give x, y, z of WGS 84"
        raise InputError(
            f"antenna_position lies {size:.6g} m from the Earth's centre, which is {EQUATOR:.7g} m below the ground; "
            f"{remedy}"
        )


def _usable(time: Any, position: Any, reference: Any) -> bool:
    shapes = np.shape(time), np.shape(position), np.shape(reference)
    n = shapes[0][0] if len(shapes[0]) == 1 else 0
    if n < 8 or shapes[1] != (n, 3) or shapes[2] not in ((), (n,)):
        return False
    return bool(
        np.isfinite(time).all() and np.isfinite(position).all() and np.isfinite(reference).all() and time[-1] > time[0]
    )


def _size(position: FloatArray) -> float:
    return float(np.median(np.sqrt((position**2).sum(axis=1))))


def _way(position: FloatArray) -> float:
    return float(np.sqrt((np.diff(position, axis=0) ** 2).sum(axis=1)).sum())


def _is_earth_centred(position: FloatArray, time: FloatArray, distance: float, ground_height: float) -> bool:
    """Tell whether positions, m, are plausible as Earth-centred and implausible in a local frame.

    Seen at a slant range R, an antenna is at most R above the ground. In a local frame that is z, and positions with
    z <= R may be local: those of a map projection reach 10 000 km. A satellite near the equator has z so small too, but
    not for long.
    """
    if not SMALLEST <= _size(position) <= LARGEST:
        return False
    above = _size(position) - EQUATOR
    if not -30e3 <= above <= distance + 30e3:
        return False
    height = float(np.median(position[:, 2])) - ground_height
    climbs = abs(float(position[-1, 2] - position[0, 2])) > STEEP * _way(position) > 0
    return not 0 < height <= distance or climbs


def _check_degrees(
    carrier: float, time: FloatArray, position: FloatArray, distance: float, ground_height: float, remedy: str
) -> None:
    """Refuse latitude, longitude and height given as positions: plausible as a platform in degrees only.

    Satellites turn by 0.06 degrees a second, aircraft by less than 0.01: as metres, next to no motion, whose aperture L
    resolves c R / (2 fc L), COARSE and more.
    """
    aperture = _way(position[:, :2])
    if 2 * carrier * aperture * COARSE > SPEED_OF_LIGHT * distance:
        return
    height = float(np.median(position[:, 2])) - ground_height
    for unit, most, metres in (("degrees", (90.0, 360.0), DEGREE), ("radians", (np.pi / 2, 2 * np.pi), 6.37e6)):
        first, second = np.abs(position[:, :2]).max(axis=0)
        if not (min(first, second) <= most[0] and max(first, second) <= most[1]):
            continue
        for heights, word in ((height, "height"), (1e3 * height, "height in km")):
            if heights < LOW:
                continue
            slowest, fastest = ORBITS if heights > SPACE else AIRCRAFT
            speed = aperture / float(time[-1] - time[0])
            latitude = np.radians(position[0, 0]) if unit == "degrees" and first <= 90 else 0.0
            shrunk = max(float(np.cos(latitude)), 1e-3)
            if slowest <= metres * speed and metres * speed * shrunk <= fastest and speed < 0.05 * heights:
                raise InputError(
                    f"antenna_position is {position[0, 0]:.6g}, {position[0, 1]:.6g}, {position[0, 2]:.6g}, and moves "
                    f"by {speed:.3g} a second: it looks like latitude and longitude in {unit}, and {word}; convert "
                    f"it to Earth-centred x, y, z, {ECEF_OF}, and give it with {remedy}"
                )


def _check_rounding(carrier: float, position: FloatArray) -> None:
    """Refuse positions that were rounded to float32 where this blurs: in steps of 0.5 m at the Earth's radius.

    Rounding is told by values that float32 holds, with third differences of the size of its steps; a track on round
    numbers has none.
    """
    rounded = position.astype(np.float32)
    if not np.array_equal(rounded.astype(np.float64), position) or not np.isfinite(carrier) or carrier <= 0:
        return
    step = np.spacing(np.abs(rounded).max(axis=0)).astype(np.float64)
    third = np.sqrt((np.diff(position, 3, axis=0) ** 2).mean(axis=0))
    noisy = third > NOISY * step
    phase = 4 * np.pi * carrier / SPEED_OF_LIGHT * float(np.max(step, where=noisy, initial=0.0)) / np.sqrt(12)
    if phase > ROUNDED:
        raise InputError(
            f"antenna_position is rounded to float32, to steps of {np.max(step, where=noisy, initial=0.0):.3g} m, or "
            f"{phase:.3g} rad of phase; give it as float64 from where it comes, not converted from float32"
        )


def _check_inertial(time: FloatArray, position: FloatArray, reference: FloatArray, frame: Georeference) -> None:
    """Refuse positions of a satellite in an inertial frame (ECI) that are labelled Earth-fixed.

    A satellite falls freely: its acceleration is g = -GM r / r^3 in an inertial frame, and
    g - 2 w x v - w x (w x r) in one that turns with the Earth at w, 1 m/s^2 apart on low orbits. Where the reference
    range follows the ground of the georeference in the given frame, the Earth stands still by intention, as in
    simulations.
    """
    span = float(time[-1] - time[0])
    if _size(position) < EQUATOR + SPACE or _way(position) / span < 1e3:
        return
    x = 2 * (time - time[0]) / span - 1
    square = x**2 - (x**2).mean()
    basis = square - x * (square * x).sum() / (x**2).sum()
    second = (basis[:, None] * position).sum(axis=0) / (basis * x**2).sum()
    acceleration, middle = 8 * second / span**2, position.mean(axis=0)
    velocity = ((x - x.mean())[:, None] * position).sum(axis=0) / ((x - x.mean()) ** 2).sum() * 2 / span
    gravity = -GM * middle / float((middle**2).sum()) ** 1.5
    spin = np.array([0.0, 0.0, SPIN])
    turning = gravity - 2 * np.cross(spin, velocity) - np.cross(spin, np.cross(spin, middle))
    inertial = float(np.sqrt(((acceleration - gravity) ** 2).sum()))
    fixed = float(np.sqrt(((acceleration - turning) ** 2).sum()))
    if inertial > FREE_FALL or fixed < TOLD_APART:
        return
    if np.ndim(reference) and np.ptp(reference) > 0:
        away = np.sqrt((frame.from_ecef(position) ** 2).sum(axis=1)) - reference
        turned = float(SPIN * np.hypot(*middle[:2]) * span)  # motion of the ground by the Earth's rotation
        if np.ptp(away) < FOLLOWS * turned:
            return
    raise InputError(
        f"antenna_position looks inertial (ECI): it accelerates as in free fall to {inertial:.2g} m/s^2, and by "
        f"{fixed:.2g} m/s^2 otherwise than seen from the turning Earth; turn it into the Earth-fixed frame (ECEF) by "
        "the sidereal time of each pulse, as astropy.coordinates.ITRS does"
    )
