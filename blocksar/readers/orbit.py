"""Orbits and antenna axes from states, Earth-centred and Earth-fixed; states propagated by gravity."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import NamedTuple

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.errors import InputError, quoted
from blocksar.texts import count

NEIGHBOURS = 4  # states, of which one polynomial has places and velocities
SPIN = 7.292115e-5  # rad/s, of the Earth
BEYOND = 0.02  # s outside of the states, which an echo's way takes; their polynomial holds there
RADII = 6.4e6, 5e7  # m from the Earth's centre, between which satellites fly


@dataclass(frozen=True, kw_only=True, eq=False)
class Orbit:
    """Orbit of a satellite as states with interpolation.

    Between two of them the track is the polynomial of degree 7 that has the positions and velocities of the NEIGHBOURS
    next to it (Hermite): off a circular orbit by 1 micrometre with states 10 s apart, and 0.1 mm with 60 s, where the
    cubic through two states would be off by 0.3 m.

    Attributes
    ----------
    time : (n,) float
        s after an epoch, ascending.
    position, velocity : (n, 3) float
        m and m/s.
    carried : (int, int)
        How many of the first and last are carried on by gravity: between others the track is that of others alone, so
        that what gravity's model leaves out does not reach it.

    Raises
    ------
    InputError
        If these are fewer than two states, not ascending, or no satellite's.
    """

    time: FloatArray
    position: FloatArray
    velocity: FloatArray
    carried: tuple[int, int] = (0, 0)

    def __post_init__(self) -> None:
        n = self.time.size
        if n < 2 or self.position.shape != (n, 3) or self.velocity.shape != (n, 3):
            raise InputError(f"the orbit has {count(n, 'state')}; at least two with position and velocity are needed")
        finite = all(np.isfinite(each).all() for each in (self.time, self.position, self.velocity))
        if not finite or not (np.diff(self.time) > 0).all():
            raise InputError("the orbit's states are not finite, or their times do not ascend; give the file anew")
        radius = np.linalg.norm(self.position, axis=1)
        if not (radius.min() > RADII[0] and radius.max() < RADII[1]):
            raise InputError(
                f"the orbit's states lie {radius.min():.6g} .. {radius.max():.6g} m from the Earth's centre, where no "
                "satellite flies: they must be Earth-centred, in m"
            )
        # Steps between positions and mean velocities disagree in axes that do not rotate with the Earth, or other
        # units.
        moved, mean = np.diff(self.position, axis=0), (self.velocity[1:] + self.velocity[:-1]) / 2
        way = mean * np.diff(self.time)[:, None]
        apart = np.linalg.norm(moved - way, axis=1) / np.linalg.norm(way, axis=1)
        if apart.max() > 0.05:
            raise InputError(
                f"the orbit's velocities differ from its positions' by {100 * apart.max():.3g} %; correct its times or "
                "units"
            )

    def at(self, time: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Positions and velocities (m, 3) at times (m,), s.

        Raises
        ------
        InputError
            If they are more than BEYOND outside of the states.
        """
        from scipy.interpolate import KroghInterpolator  # slow to load

        first, last = self.time[[0, -1]]
        if time.min() < first - BEYOND or time.max() > last + BEYOND:
            raise InputError(
                f"the orbit's states cover {first:.6f} .. {last:.6f} s, but pulses {time.min():.6f} .. "
                f"{time.max():.6f} s; give the file with all states"
            )
        n, position, velocity = self.time.size, np.empty((time.size, 3)), np.empty((time.size, 3))
        given = self.carried[0], n - self.carried[1]
        interval = np.clip(np.searchsorted(self.time, time, side="right") - 1, 0, n - 2)
        for i in np.unique(interval):
            low, high = given if given[0] <= i < given[1] - 1 else (0, n)
            start = int(np.clip(i - (NEIGHBOURS // 2 - 1), low, max(high - NEIGHBOURS, low)))
            near, at = slice(start, min(start + NEIGHBOURS, high)), interval == i
            scale, origin = float(self.time[i + 1] - self.time[i]), float(self.time[i])
            nodes = np.repeat((self.time[near] - origin) / scale, 2)
            values = np.stack([self.position[near], scale * self.velocity[near]], axis=1).reshape(-1, 3)
            place, slope = KroghInterpolator(nodes, values).derivatives((time[at] - origin) / scale, 2)
            position[at], velocity[at] = place, slope / scale
        return position, velocity


@dataclass(frozen=True, kw_only=True, eq=False)
class OrbitTrack:
    """Track from positions and velocities (n, 3), m and m/s, given at pulses at times (n,), s."""

    time: FloatArray
    position: FloatArray
    velocity: FloatArray

    def at(self, time: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Positions and velocities at times (m,), s, linearly interpolated."""
        both = np.hstack([self.position, self.velocity])
        found = np.stack([np.interp(time, self.time, column) for column in both.T], axis=1)
        return found[:, :3], found[:, 3:]


def inertial(position: FloatArray, velocity: FloatArray) -> FloatArray:
    """Convert velocities (n, 3), m/s, from axes that rotate with the Earth to axes that do not."""
    turn = np.stack([-position[:, 1], position[:, 0], 0 * position[:, 2]], axis=1)
    return velocity + SPIN * turn


@dataclass(frozen=True, kw_only=True, eq=False)
class Antenna:
    """Azimuth axis of an antenna: unit vectors (n, 3) at times (n,), s after the orbit's epoch."""

    time: FloatArray
    axis: FloatArray

    def at(self, time: FloatArray) -> FloatArray | None:
        """Interpolate the axis (m, 3) to times (m,); None unless it is known at all of them."""
        if self.time.size < 2 or time.min() < self.time[0] - BEYOND or time.max() > self.time[-1] + BEYOND:
            return None
        axis = np.stack([np.interp(time, self.time, column) for column in self.axis.T], axis=1)
        return np.asarray(axis / np.linalg.norm(axis, axis=1, keepdims=True))


def epoch_of(text: str, name: str) -> datetime:
    """Parse a time in ISO 8601, also after "seconds since"; UTC.

    Examples
    --------
    >>> epoch_of("seconds since 2011-01-13T00:00:00.000000000", "units")
    datetime.datetime(2011, 1, 13, 0, 0, tzinfo=datetime.timezone.utc)
    """
    moment = text.strip().removeprefix("seconds since").strip().removesuffix("Z")
    whole, _, fraction = moment.partition(".")
    try:
        found = datetime.fromisoformat(f"{whole}.{fraction[:6]:0<6}" if fraction else whole)
    except ValueError:
        raise InputError(f"{name} is {quoted(text)}, which tells no time; give `seconds since` a UTC date") from None
    return found.replace(tzinfo=UTC) if found.tzinfo is None else found.astimezone(UTC)


# ---------------------------------------------------------------- states carried on

GRAVITY = 3.986004418e14  # m^3/s^2
OBLATENESS = 1.08262668e-3  # J2
RADIUS = 6378137.0  # m
STEP = 1.0  # s
CLOSEST = 0.1  # s, of states that are carried on
LONGEST = 15.0  # s: what J2 leaves out, 3e-5 m/s^2, moves a satellite by 3 mm


def acceleration(position: FloatArray, velocity: FloatArray) -> FloatArray:
    """Acceleration (3,) of a satellite in axes that turn with the Earth, m/s^2, with its flattening."""
    distance = float(np.linalg.norm(position))
    lift = 5 * position[2] ** 2 / distance**2
    flattened = 1.5 * OBLATENESS * (RADIUS / distance) ** 2 * (np.array([1.0, 1.0, 3.0]) - lift)
    fall = -GRAVITY / distance**3 * position * (1 + flattened)
    turn = np.array([2 * velocity[1], -2 * velocity[0], 0.0]) + SPIN * np.array([position[0], position[1], 0.0])
    return np.asarray(fall + SPIN * turn)


def propagated(position: FloatArray, velocity: FloatArray, seconds: float) -> tuple[FloatArray, FloatArray]:
    """Propagate position, m, and velocity, m/s, (3,) by some seconds, by a Runge-Kutta method of order 4."""
    steps = max(int(np.ceil(abs(seconds) / STEP)), 1)
    h = seconds / steps
    r, v = np.array(position, float), np.array(velocity, float)
    for _ in range(steps):
        rates = [(v, acceleration(r, v))]
        for part in (h / 2, h / 2, h):
            dr, dv = rates[-1]
            rates.append((v + part * dv, acceleration(r + part * dr, v + part * dv)))
        r = r + h / 6 * sum(w * dr for w, (dr, _) in zip((1, 2, 2, 1), rates, strict=True))
        v = v + h / 6 * sum(w * dv for w, (_, dv) in zip((1, 2, 2, 1), rates, strict=True))
    return r, v


class States(NamedTuple):
    """Positions and velocities (n, 3), Earth-centred, Earth-fixed, m and m/s, at ascending times (n,), s."""

    time: FloatArray
    position: FloatArray
    velocity: FloatArray

    def reaching(self, first: float, last: float) -> Orbit:
        """Make an orbit that covers two times, s, propagating states before or after the given ones if necessary.

        States are carried by whole spacings, those of most of the given ones. A state next to a given one would have
        its polynomial divide the rounding of both by the time between them: 21 m from 100 us, thousands of km from 1
        us.

        Raises
        ------
        InputError
            If one lies more than LONGEST before or after, or the states are no satellite's.
        """
        early, late = float(self.time[0]) - first, last - float(self.time[-1])
        if max(early, late) > LONGEST:
            raise InputError(
                f"states of the orbit in packets begin {early:.3g} s after the bursts do and end {late:.3g} s before "
                "their end; give the orbit's file with --orbit"
            )
        alone = self.time.size == 1  # of which no track is known without another
        spacing = STEP if alone else max(float(np.median(np.diff(self.time))), CLOSEST)
        before, after = (max(int(np.ceil(each / spacing)), int(alone)) for each in (early, late))
        states = [
            *(self._carried(0, -spacing * step) for step in range(before, 0, -1)),
            self,
            *(self._carried(-1, spacing * step) for step in range(1, after + 1)),
        ]
        time, position, velocity = (np.concatenate(each) for each in zip(*states, strict=True))
        return Orbit(time=time, position=position, velocity=velocity, carried=(before, after))

    def _carried(self, end: int, seconds: float) -> States:
        """Propagate the first or last state by some seconds."""
        place, velocity = propagated(self.position[end], self.velocity[end], seconds)
        return States(self.time[[end]] + seconds, place[None], velocity[None])
