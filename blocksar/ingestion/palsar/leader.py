"""The leader of a scene: radar, orbit and attitude."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError, quoted
from blocksar.ingestion.kinds import ECHOES
from blocksar.ingestion.palsar.records import (
    ATTITUDE,
    ATTITUDE_LENGTH,
    ATTITUDES,
    BANDWIDTH,
    CALIBRATION,
    PLATFORM,
    PLATFORM_FIELDS,
    STATE,
    STATES,
    SUMMARY,
    SUMMARY_FIELDS,
    Place,
    number_of,
    records_of,
    text_of,
)
from blocksar.ingestion.strips.orbit import Antenna, Orbit, inertial


@dataclass(frozen=True, kw_only=True, eq=False)
class Leader:
    """Leader file: orbit, attitude and radar of a scene.

    Attributes
    ----------
    records : dict
        By two codes.
    """

    records: dict[bytes, bytes]

    @classmethod
    def parse(cls, data: bytes) -> Leader:
        """Raises an InputError if it is cut, or lacks radar or orbit, or is another sensor's."""
        leader = cls(records=records_of(data))
        for code, name in ((SUMMARY, "data set summary"), (PLATFORM, "platform positions")):
            if code not in leader.records:
                raise InputError(f"has no record of {name}; get it again")
        if (mission := leader.text("mission")) != "ALOS":
            raise InputError(f"is of the mission {quoted(mission)}; only level 1.0 of ALOS PALSAR is read; {ECHOES}")
        return leader

    def text(self, name: str) -> str:
        return text_of(self.records[SUMMARY], SUMMARY_FIELDS[name])

    def number(self, name: str) -> float:
        return number_of(self.records[SUMMARY], SUMMARY_FIELDS[name], name)

    def known(self, name: str) -> float:
        """A number that may be missing: 0 then."""
        try:
            return self.number(name)
        except InputError:
            return 0.0

    @property
    def carrier(self) -> float:
        """Hz."""
        if not (wavelength := self.number("wavelength")) > 0:
            raise InputError(f"the leader's wavelength is {wavelength:g} m; get the file again")
        return SPEED_OF_LIGHT / wavelength

    @property
    def side(self) -> str:
        return "left" if self.known("clock angle") < 0 else "right"

    @property
    def bandwidth(self) -> float:
        """Hz; 0 if it is not told."""
        record = self.records.get(CALIBRATION)
        if record is None:
            return 0.0
        try:
            return 1e6 * number_of(record, BANDWIDTH, "bandwidth")
        except InputError:
            return 0.0

    def orbit(self, epoch: datetime) -> Orbit:
        """Its states, by seconds after an epoch.

        Raises
        ------
        InputError
            If they are not Earth-centred, or wrong.
        """
        record = self.records[PLATFORM]

        def number(name: str) -> float:
            return number_of(record, PLATFORM_FIELDS[name], name)

        system = text_of(record, PLATFORM_FIELDS["coordinate system"]).upper()
        if "ECI" in system or "INERTIAL" in system:
            raise InputError(f"the leader's orbit is in {quoted(system)}; it must turn with the Earth (ECR)")
        count = int(number("number of points"))
        if not 2 <= count <= (len(record) - STATES) // (6 * STATE):
            raise InputError(f"the leader's orbit has {count} states, which its record does not hold; get it again")
        try:
            day = datetime(int(number("year")), int(number("month")), int(number("day")), tzinfo=UTC)
        except ValueError:
            raise InputError("the leader's orbit has no date; get the file again") from None
        states = np.array(
            [number_of(record, Place(STATES + STATE * k, STATE), f"state {k // 6 + 1}") for k in range(6 * count)]
        ).reshape(count, 6)
        first = (day - epoch).total_seconds() + number("seconds of the day")
        time = first + number("interval") * np.arange(count)
        return Orbit(time=np.asarray(time, np.float64), position=states[:, :3], velocity=states[:, 3:])

    def antenna(self, epoch: datetime, orbit: Orbit) -> Antenna | None:
        """The body's long axis: yaw, pitch and roll about down, right and forward of the inertial flight."""
        record = self.records.get(ATTITUDE)
        if record is None:
            return None
        try:
            count = int(number_of(record, Place(12, 4), "number of attitudes"))
            rows = np.array([_attitude(record, k) for k in range(count)]).reshape(count, 4)
        except InputError:
            return None
        year = datetime(epoch.year, 1, 1, tzinfo=UTC)
        time = rows[:, 0] - (epoch - year) / timedelta(seconds=1)
        inside = (time >= orbit.time[0]) & (time <= orbit.time[-1]) & (np.diff(time, prepend=-np.inf) > 0)
        time, (pitch, yaw) = time[inside], rows[inside, 1:3].T
        if time.size < 2:
            return None
        position, velocity = orbit.at(time)
        flight = inertial(position, velocity)
        down = -position / np.linalg.norm(position, axis=1, keepdims=True)
        right = np.cross(down, flight)
        right /= np.linalg.norm(right, axis=1, keepdims=True)
        ahead = np.cross(right, down)
        parts: tuple[FloatArray, ...] = (np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), -np.sin(pitch))
        axis = sum(part[:, None] * unit for part, unit in zip(parts, (ahead, right, down), strict=True))
        return Antenna(time=time, axis=np.asarray(axis))


def _attitude(record: bytes, number: int) -> tuple[float, float, float, float]:
    """Seconds of the year, pitch, yaw and roll, rad."""
    at = ATTITUDES + ATTITUDE_LENGTH * number
    day, milliseconds = (number_of(record, Place(at + first, n), "time of attitude") for first, n in ((0, 4), (4, 8)))
    pitch, roll, yaw = (number_of(record, Place(at + 24 + 14 * k, 14), "attitude") for k in range(3))
    return 86400 * (day - 1) + milliseconds / 1000, *np.radians([pitch, yaw, roll]).tolist()
