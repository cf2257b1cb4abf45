"""Orbit and attitude of Sentinel-1, from packets or files of precise orbits; and the GPS time of packets.

Packets carry one of 64 words each, which follow each other. Words 1 to 22 are position and velocity with their time, 23
to 41 the attitude's quaternion (S1-IF-ASD-PL-0007, tables 3.2-5 and 3.2-6). Times are GPS seconds of 32 bits with a
fraction of 24.

The document does not say between which axes the quaternion turns. The antenna's azimuth axis is x of the satellite's
body, and the satellite is steered so that it lies along the velocity over the turning Earth (zero Doppler): of all
readings of the quaternion that is taken which comes closest, if one does. In a measured packet the one known component
is that of a turn to inertial axes by a body that rolls to its right.
"""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from itertools import product
from typing import NamedTuple

import numpy as np

from blocksar import texts
from blocksar.arrays import FloatArray, IntArray
from blocksar.errors import InputError
from blocksar.places import Location, readable
from blocksar.readers.orbit import Orbit, States
from blocksar.readers.reading import reading
from blocksar.readers.sentinel1.packets import Packets

GPS = datetime(1980, 1, 6, tzinfo=UTC)
# Seconds by which GPS time is ahead of UTC, by the GPS second from which they hold.
LEAPS = ((0, 16), (1119744017, 17), (1167264018, 18))


def utc(zero: int, seconds: float) -> str:
    """Convert GPS seconds, `zero` plus `seconds`, to UTC, ISO 8601."""
    ahead = next(leap for since, leap in reversed(LEAPS) if zero >= since)
    moment: datetime = GPS + timedelta(seconds=zero - ahead) + timedelta(seconds=seconds)
    return f"{moment.replace(tzinfo=None).isoformat(timespec='microseconds')}Z"


ORBIT, ATTITUDE = (1, 22), (23, 41)  # first and last words
TILTED = np.radians(1.0)  # rad, which no attitude of Sentinel-1 departs from zero Doppler by
J2000 = 630763218.0  # s of GPS time at 2000-01-01T12:00 UT, were it 18 s ahead of UT as it is since 2017


class Attitude(NamedTuple):
    """Attitude: tilt of the antenna's axis off the velocity, outwards and across, rad (n, 2), at times (n,), s.

    `reading` says how the quaternions were read, `off` is the largest angle off the velocity, rad.
    """

    time: FloatArray
    lean: FloatArray
    reading: str
    off: float

    def axis(self, time: FloatArray, position: FloatArray, velocity: FloatArray) -> FloatArray:
        """Antenna axis (m, 3) at times (m,), for positions and velocities there; constant beyond the known times."""
        along, outward, across = _axes(position, velocity)
        lean = [np.interp(time, self.time, column)[:, None] for column in self.lean.T]
        axis = along + lean[0] * outward + lean[1] * across
        return np.asarray(axis / np.linalg.norm(axis, axis=1, keepdims=True))


def read_states(packets: Packets, zero: int) -> States:
    """Read the orbit's states in packets, at times after the GPS second `zero`.

    Raises
    ------
    InputError
        If there are none.
    """
    words = _records(packets, *ORBIT)
    place = words[:, :12].reshape(-1).astype(">u2").view(">f8").reshape(-1, 3)
    velocity = words[:, 12:18].reshape(-1).astype(">u2").view(">f4").reshape(-1, 3)
    time = _stamps(words[:, 18:22], zero)
    _, first = np.unique(time, return_index=True)
    if not first.size:
        raise InputError(
            f"no state of the orbit is in its {texts.count(len(packets), 'packet')}, of which 64 hold one: give "
            "the orbit's file with --orbit, or a longer part of the data"
        )
    return States(time[first], place[first].astype(float), velocity[first].astype(float))


def read_attitude(packets: Packets, zero: int, orbit: Orbit) -> Attitude | None:
    """Read the attitude within the orbit's times; None if there is none consistent with zero-Doppler steering."""
    words = _records(packets, *ATTITUDE)
    quaternion = words[:, :8].reshape(-1).astype(">u2").view(">f4").reshape(-1, 4).astype(float)
    time = _stamps(words[:, 14:18], zero)
    known = (time >= orbit.time[0]) & (time <= orbit.time[-1])
    known &= np.isfinite(quaternion).all(axis=1)
    known[known] = np.abs(np.linalg.norm(quaternion[known], axis=1) - 1) < 1e-3
    time, first = np.unique(time[known], return_index=True)
    if not time.size:
        return None
    along, outward, across = _axes(*orbit.at(time))
    found: list[Attitude] = []
    for (axes, turn), inverse in product(_turns(time + zero).items(), (False, True)):
        axis = np.einsum("nij,nj->ni", turn, _forward(quaternion[known][first], inverse=inverse))
        axis *= np.sign((axis * along).sum(axis=1))[:, None]
        lean = np.stack([(axis * outward).sum(axis=1), (axis * across).sum(axis=1)], axis=1)
        off = float(np.arccos(np.clip((axis * along).sum(axis=1), -1, 1)).max())
        ways = ("from {} to the body" if inverse else "from the body to {}").format(axes)
        found.append(Attitude(time, lean, ways, off))
    best = min(found, key=lambda each: each.off)
    return best if best.off < TILTED else None


def _records(packets: Packets, first: int, last: int) -> IntArray:
    """Records of ancillary words: rows (n, last - first + 1) of consecutive words."""
    count = last - first + 1
    begins = np.flatnonzero(packets.word == first)
    rows = begins[begins + count <= len(packets), None] + np.arange(count)
    whole = (packets.word[rows] == np.arange(first, last + 1)).all(axis=1)
    return np.asarray(packets.value[rows[whole]])


def _stamps(words: IntArray, zero: int) -> FloatArray:
    """Times (n,), s, from four words (n, 4), the first byte of which is unused."""
    seconds = ((words[:, 0] & 0xFF) << 24) | (words[:, 1] << 8) | (words[:, 2] >> 8)
    fraction = ((words[:, 2] & 0xFF) << 16) | words[:, 3]
    return np.asarray((seconds - zero) + fraction * 2.0**-24)


def _axes(position: FloatArray, velocity: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Unit vectors (n, 3) along the velocity, outwards perpendicular to it, and across both."""
    along = velocity / np.linalg.norm(velocity, axis=1, keepdims=True)
    outward = position - (position * along).sum(axis=1, keepdims=True) * along
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    return along, outward, np.cross(along, outward)


def _forward(quaternion: FloatArray, *, inverse: bool) -> FloatArray:
    """Body x axis (n, 3) rotated by quaternions, scalar first, or by their inverse."""
    q0, q1, q2, q3 = quaternion.T * np.array([[1.0], [-1.0], [-1.0], [-1.0]]) ** inverse
    return np.stack([1 - 2 * (q2**2 + q3**2), 2 * (q1 * q2 + q0 * q3), 2 * (q1 * q3 - q0 * q2)], axis=1)


def _turns(seconds: FloatArray) -> dict[str, FloatArray]:
    """Rotations (n, 3, 3) from several axes to Earth-fixed ones at GPS times (n,), s; accurate to 1e-4 rad.

    Sidereal time and precession of 1976 (Lieske), to the first order in centuries.
    """
    days = (seconds - J2000) / 86400
    turning = _about(2, np.radians(280.46061837 + 360.98564736629 * days))
    centuries = days / 36525
    zeta, theta = (np.radians(rate * centuries / 3600) for rate in (2306.2181, 2004.3109))
    precession = _about(2, -zeta) @ _about(1, theta) @ _about(2, -zeta)
    return {
        "inertial axes (J2000)": turning @ precession, "inertial axes of date": turning,
        "Earth-fixed axes": np.broadcast_to(np.eye(3), turning.shape),
    }  # fmt: skip


def _about(axis: int, angle: FloatArray) -> FloatArray:
    """Rotation matrices (n, 3, 3) of coordinates for axes rotated by angles (n,) about axis 1 or 2."""
    c, s, one, zero = np.cos(angle), np.sin(angle), np.ones_like(angle), np.zeros_like(angle)
    about_z, about_y = [c, s, zero, -s, c, zero, zero, zero, one], [c, zero, -s, zero, one, zero, s, zero, c]
    rows = about_z if axis == 2 else about_y
    return np.stack(rows, axis=-1).reshape(-1, 3, 3)


# ---------------------------------------------------------------- files of precise orbits (EOF)

TAI_AHEAD = 19.0  # s, of GPS time
MARGIN = 60.0  # s before and after the data, of which states are taken
STATE = ("X", "Y", "Z", "VX", "VY", "VZ")


def read_orbit_file(path: Location, first: float, last: float, zero: int) -> Orbit:
    """Read the states around times first .. last, s after the GPS second `zero`.

    Raises
    ------
    InputError
        If it is no such file, damaged, or of another time.
    """
    from xml.etree import ElementTree  # every reader is loaded where a kind of file is looked for

    where = readable(path)
    with reading(
        where, damaged="no orbit file of Sentinel-1 (EOF)", remedy="give one, such as S1A_OPER_AUX_POEORB_*.EOF"
    ):
        with where.open() as file:
            root = ElementTree.parse(file).getroot()
        times, states = [], []
        for state in root.iter("OSV"):
            text = state.findtext("TAI", "").removeprefix("TAI=")
            moment = datetime.fromisoformat(text).replace(tzinfo=UTC) - GPS
            times.append(moment.days * 86400 - zero + moment.seconds + moment.microseconds * 1e-6 - TAI_AHEAD)
            states.append([float(state.findtext(name, "nan")) for name in STATE])
        if not times:
            raise InputError("it holds no states of an orbit (OSV); give a file of precise or restituted orbits")
        time, values = np.array(times), np.array(states)
        near = (time >= first - MARGIN) & (time <= last + MARGIN)
        if time.min() > first or time.max() < last or near.sum() < 2:
            raise InputError(
                f"its states begin {time.min() - first:.6g} s after the data do and end {time.max() - last:.6g} s "
                "after them; give the file of the day of the data"
            )
        return Orbit(time=time[near], position=values[near, :3], velocity=values[near, 3:])
