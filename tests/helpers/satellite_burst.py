"""A satellite's burst over hills on the Earth: an orbit of Earth-centred states, steered from aft to fore."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blocksar import stores
from blocksar.arrays import FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.georeference import Georeference
from blocksar.collection.grid import Grid
from blocksar.collection.terrain import Terrain
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.places import place
from blocksar.readers.terrain_earth import ellipsoid
from blocksar.simulation.scatterers import field, phase_history

RADIUS, INCLINATION = 7_071_000.0, np.radians(98.2)  # m, of an orbit about 700 km high
AXES = np.array([6378137.0, 6378137.0, 6356752.314245])  # m, of WGS 84
GRAVITY, SPIN = 3.986004418e14, 7.292115e-5  # m^3/s^2, rad/s
LATITUDE = np.radians(47.0)  # argument of latitude at t = 0
LOOK = np.radians(31.0)  # off nadir, at the middle of the swath
CARRIER, BANDWIDTH, PRF = 5.405e9, 56e6, 1750.0  # Hz
BEAM, STEERING_RATE = np.radians(0.28), np.radians(1.6)  # rad, rad/s


def earth_centred(time: FloatArray) -> FloatArray:
    """Positions (n, 3) on a circular orbit, in axes that turn with the Earth, m."""
    along = LATITUDE + np.sqrt(GRAVITY / RADIUS**3) * time
    x, y = RADIUS * np.cos(along), RADIUS * np.sin(along)
    inertial = np.stack([x, y * np.cos(INCLINATION), y * np.sin(INCLINATION)], axis=1)
    cos, sin = np.cos(SPIN * time), np.sin(SPIN * time)
    px, py = inertial[:, 0], inertial[:, 1]
    return np.stack([cos * px + sin * py, cos * py - sin * px, inertial[:, 2]], axis=1)


def orbit(time: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Positions (n, 3), m, and velocities, m/s: a polynomial through states every 10 s, as orbits are delivered."""
    states = 10.0 * np.arange(-4, 5)
    series = np.polynomial.Polynomial.fit
    fits = [series(states, column, 8) for column in earth_centred(states).T]
    return np.stack([fit(time) for fit in fits], axis=1), np.stack([fit.deriv()(time) for fit in fits], axis=1)


def scene_frame() -> Georeference:
    """The frame about the swath's middle, x away from the track; y is then about along it."""
    position, velocity = (values[0] for values in orbit(np.zeros(1)))
    down = -position / np.linalg.norm(position)
    right = np.cross(velocity, down)
    right /= np.linalg.norm(right)
    sight = np.cos(LOOK) * down + np.sin(LOOK) * right
    # Where the line of sight meets the ellipsoid, which scaled along its axes is a sphere.
    p, s = position / AXES, sight / AXES
    distance = (-p @ s - np.sqrt((p @ s) ** 2 - (s @ s) * (p @ p - 1))) / (s @ s)
    frame = Georeference.at(position + distance * sight)
    east, north, _ = frame.east_north_up @ right
    rotation = float(np.degrees(np.arctan2(north, east)))
    return Georeference(latitude=frame.latitude, longitude=frame.longitude, height=0.0, rotation=rotation)


def hills(frame: Georeference, width: float, length: float) -> Terrain:
    """Hills and hollows up to 300 m, with slopes to 20 degrees, on the ellipsoid, every 60 m."""
    box = (-width / 2 - 2000, width / 2 + 2000), (-length / 2 - 2000, length / 2 + 2000)
    x, y = (np.arange(low, high, 60.0) for low, high in box)
    z = ellipsoid(frame, 0.0, (x[0] - 60, x[-1] + 60), (y[0] - 60, y[-1] + 60)).on_grid(x, y)
    random = np.random.default_rng(8)
    for _ in range(int(width * length / 4e6) + 12):
        place_x, place_y = random.uniform(x[0], x[-1]), random.uniform(y[0], y[-1])
        height = random.uniform(-150, 300)
        size = max(abs(height) * random.uniform(2.4, 5), 250.0)
        near_x, near_y = np.exp(-(((x - place_x) / size) ** 2)), np.exp(-(((y - place_y) / size) ** 2))
        z += height * near_y[:, None] * near_x
    return Terrain(x0=float(x[0]), dx=60.0, y0=float(y[0]), dy=60.0, heights=z)


class Burst(NamedTuple):
    """A burst over a box, width (across the track) by length, m, about the frame's origin."""

    frame: Georeference
    terrain: Terrain
    collection: Collection
    width: float
    length: float

    @classmethod
    def over(cls, width: float, length: float) -> Burst:
        """The burst that lights all of a box over a full dwell."""
        frame = scene_frame()
        terrain = hills(frame, width, length)
        speed = SPEED / (RADIUS / 6_371_000.0) + STEERING_RATE * 810e3  # of the beam over the ground
        duration = (1.06 * length + 0.9 * BEAM * 810e3 + 0.02 * width) / speed * 1.1
        n = round(duration * PRF)
        time = (np.arange(n) - n // 2) / PRF
        position, velocity = orbit(time)
        track, axis = frame.from_ecef(position), velocity @ frame.axes.T
        corners = np.array([[x, y] for x in (-width / 2, width / 2) for y in (-length / 2, length / 2)])
        ranges = [np.linalg.norm(track - [x, y, float(terrain(x, y))], axis=1) for x, y in corners]
        reach = 1.06 * (np.max(ranges) - np.min(ranges)) + 2500.0
        step = SPEED_OF_LIGHT / (2 * reach)
        n_frequency = int(np.ceil(BANDWIDTH / step))
        collection = Collection(
            carrier=CARRIER,
            time=time,
            range_frequency=(np.arange(n_frequency) - n_frequency // 2) * step,
            reference_range=np.full(n, (np.max(ranges) + np.min(ranges)) / 2),
            antenna_position=track,
            beam_azimuth=np.full(n, np.nan),
            beam_width=float(BEAM),
            beam_axis=axis / np.linalg.norm(axis, axis=1, keepdims=True),
            beam_steering=STEERING_RATE * time,
            title="burst",
        )
        return cls(frame, terrain, collection, width, length)

    @property
    def geometry(self) -> Geometry:
        return Geometry(collection=self.collection).over(self.terrain)

    def full(self, x: FloatArray, y: FloatArray) -> NDArray[np.bool_]:
        """Whether points are lit over a full dwell."""
        first, last = self.geometry.beam.dwell(x, y, uncut=True)
        time = self.collection.time
        return np.asarray((first > time[0]) & (last < time[-1]))

    def grid(self, dx: float, dy: float) -> Grid:
        return Grid(-self.width / 2, self.width / 2, dx, -self.length / 2, self.length / 2, dy)

    def targets(self, across: int, along: int) -> list[tuple[float, float]]:
        """Places spread over the box."""
        random = np.random.default_rng(2)
        x, y = np.meshgrid(np.linspace(-0.45, 0.45, across), np.linspace(-0.35, 0.35, along))
        x = x * self.width + random.uniform(-40, 40, x.shape)
        y = y * self.length + random.uniform(-40, 40, y.shape)
        return [(float(a), float(b)) for a, b in zip(x.ravel(), y.ravel(), strict=True)]

    def write(self, folder: Path, targets: list[tuple[float, float]], chips: list[tuple[float, float]]) -> Path:
        """Store the phase history of targets, and of clutter about the middles of chips, and the terrain.

        Clutter is of other amplitude: it is where targets are not.
        """
        stores.write_terrain(place(folder / "terrain.zarr"), self.terrain)
        path = folder / "phase_history.zarr"
        told = [{"name": f"P{i}", "x": x, "y": y, "reflectivity": [1.0, 0.0]} for i, (x, y) in enumerate(targets)]
        attrs = {"title": "burst", "georeference": self.frame.as_attribute(), "targets": told}
        x, y, sigma = (np.concatenate(parts) for parts in zip(*self._scatterers(targets, chips), strict=True))
        of = field(self.collection, x, y, sigma, self.terrain(x, y))
        stores.create_phase_history(path, self.collection, attrs=attrs)
        for first in range(0, self.collection.n_pulse, 1024):
            pulses = slice(first, min(first + 1024, self.collection.n_pulse))
            signal = phase_history(of, pulses=pulses)
            stores.write_region(path, "signal", (pulses, slice(0, signal.shape[1])), signal)
        return path

    def _scatterers(
        self, targets: list[tuple[float, float]], chips: list[tuple[float, float]]
    ) -> Iterator[tuple[FloatArray, FloatArray, NDArray[np.complex128]]]:
        yield np.array([x for x, _ in targets]), np.array([y for _, y in targets]), np.ones(len(targets), complex)
        random = np.random.default_rng(6)
        for x, y in chips:
            n = CHIP_SCATTERERS
            sigma = random.standard_normal(n) + 1j * random.standard_normal(n)
            yield (
                x + random.uniform(-CHIP, CHIP, n), y + random.uniform(-CHIP, CHIP, n), 0.3 * sigma
            )  # fmt: skip


SPEED = float(np.linalg.norm(orbit(np.zeros(1))[1]))  # m/s
CHIP, CHIP_SCATTERERS = 250.0, 3000  # m, half the side
