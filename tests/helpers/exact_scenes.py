"""Random collections with exact samples: what is said of them is true, so that nothing may be called wrong.

Samples are sums over point targets of the signal that `Collection` states, written out, so that neither the simulator
nor anything else of the package has made them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.grid import Grid
from blocksar.collection.terrain import Terrain
from blocksar.constants import SPEED_OF_LIGHT

KINDS = ("spotlight", "curved", "strip", "squinted", "tops", "yaw")
CONTENTS = ("points", "many points", "points on clutter", "clutter", "terrain")
SLOWEST = 1.3  # PRF over what the beam or the scene spans in Doppler


@dataclass(frozen=True, kw_only=True)
class ExactScene:
    """Samples, and all that is said of them."""

    name: str
    signal: ComplexArray
    collection: Collection
    grid: Grid | None
    terrain: Terrain | None
    targets: FloatArray  # (n, 3) m


def exact_scene(seed: int) -> ExactScene:
    """The scene of a seed: every kind of collection with every kind of content in turn, its figures drawn."""
    rng = np.random.default_rng([20, seed])
    kind, content = KINDS[seed % len(KINDS)], CONTENTS[seed // len(KINDS) % len(CONTENTS)]
    wide = kind in ("spotlight", "curved")
    relief = float(rng.uniform(20, 120)) if content == "terrain" else 0.0
    collection, centre, size = (_unsteered if wide else _steered)(rng, kind, relief)
    count = {"points": rng.integers(1, 13), "many points": rng.integers(30, 501), "points on clutter": 300,
             "clutter": 800, "terrain": rng.integers(4, 40)}[content]  # fmt: skip
    place = np.zeros((count, 3))
    place[:, :2] = centre + rng.uniform(-1, 1, (count, 2)) * size
    speckle = rng.standard_normal(count) + 1j * rng.standard_normal(count)
    amplitude = np.exp(2j * np.pi * rng.uniform(size=count)) * rng.uniform(0.5, 1.0, count)
    if "clutter" in content:
        amplitude = 0.05 * speckle if content.startswith("points") else speckle
        if content == "clutter" and rng.integers(2):  # fields and woods
            amplitude *= np.where(np.sin(place[:, 0] * 6 / size[0]) * np.sin(place[:, 1] * 6 / size[1]) > 0, 1, 0.2)
        if content.startswith("points"):
            amplitude[: rng.integers(3, 13)] = 2.0
    terrain = None
    if content == "terrain":
        terrain = _hill(centre, size, relief)
        place[:, 2] = [terrain_height(terrain, x, y) for x, y in place[:, :2]]
    noise = rng.choice([0.0, 0.3, 1.0])
    signal = samples(collection, place, amplitude)
    signal += (noise * np.sqrt(np.mean(np.abs(amplitude) ** 2))) * _gaussian(rng, signal.shape)
    grid = Grid(
        centre[0] - size[0], centre[0] + size[0], 0.5, centre[1] - size[1], centre[1] + size[1], 0.5
    )  # fmt: skip
    needs_grid = wide or rng.integers(2)
    return ExactScene(
        name=f"{seed}: {kind}, {count} {content}, noise {noise:g}", signal=signal.astype(np.complex64),
        collection=collection, grid=grid if needs_grid else None, terrain=terrain, targets=place,
    )  # fmt: skip


def _gaussian(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    return rng.standard_normal(shape) + 1j * rng.standard_normal(shape)


def samples(collection: Collection, place: FloatArray, amplitude: np.ndarray) -> np.ndarray:
    """(n_pulse, n_frequency) complex128: the sum over targets at place (n, 3), m, while the beam lights them."""
    f = collection.range_frequency
    fine, coarse = np.arange(8) * collection.range_frequency_step, f[::8]
    signal = np.zeros((collection.n_pulse, coarse.size * 8), np.complex128)
    for target, a in zip(place, amplitude, strict=True):
        sight = target - collection.antenna_position
        distance = np.sqrt((sight**2).sum(axis=1))
        seen = lit(collection, target)
        cycles = -2 / SPEED_OF_LIGHT * (distance - collection.reference_range)[seen, None]
        fast = np.exp(2j * np.pi * cycles * fine)
        slow = a * np.exp(2j * np.pi * cycles * (collection.carrier + coarse))
        signal[seen] += (slow[:, :, None] * fast[:, None, :]).reshape(fast.shape[0], 8 * coarse.size)
    return signal[:, : f.size]


def lit(collection: Collection, target: FloatArray) -> np.ndarray:
    """Whether the beam lights a target (3,), m, at each pulse."""
    sight = target - collection.antenna_position
    sight /= np.linalg.norm(sight, axis=1)[:, None]
    if collection.beam_width is None:
        return np.ones(len(sight), np.bool_)
    if collection.beam_axis is not None and collection.beam_steering is not None:
        away = np.arcsin((sight * collection.beam_axis).sum(axis=1)) - collection.beam_steering
        ahead = np.gradient(collection.antenna_position, axis=0)  # which the axis follows in these scenes
        left = np.cross(ahead, sight)[:, 2] * {"left": 1, "right": -1, None: 0}[collection.side_of_track]
        away[left < 0] = np.inf
    else:
        middle = int(np.argmin(np.abs(collection.time)))
        nadir = collection.antenna_position[middle]
        away = np.arctan2(target[1] - nadir[1], target[0] - nadir[0]) - collection.beam_azimuth
        away = (away + np.pi) % (2 * np.pi) - np.pi
    return np.asarray(np.abs(away) <= collection.beam_width / 2)


def _unsteered(rng: np.random.Generator, kind: str, relief: float) -> tuple[Collection, FloatArray, FloatArray]:
    """A spotlight about the origin of 1 to 50 degrees, on a straight or a curved track."""
    angle = np.radians(np.exp(rng.uniform(0, np.log(50))))
    wavelength = 0.031 if angle < np.radians(8) else 0.06 if angle < np.radians(25) else 0.23
    height, ground = rng.uniform(3000, 9000), rng.uniform(6000, 12000)
    distance, size = float(np.hypot(height, ground)), float(rng.uniform(25, 60))
    n = int(np.clip(SLOWEST * angle * 4 * size * np.sqrt(2) / wavelength, 300, 4000))
    half, time = distance * np.tan(angle / 2), (np.arange(n) - n // 2) / 400.0
    along = np.linspace(-half, half, n) + (0.0 if kind == "curved" else rng.choice([0.0, 0.2]) * distance)
    track = np.stack([np.full(n, -ground), along, np.full(n, height)], axis=1)
    if kind == "curved":  # about the scene's centre
        turn = np.linspace(-angle / 2, angle / 2, n)
        track = np.stack([-ground * np.cos(turn), ground * np.sin(turn), np.full(n, height)], axis=1)
    turn = rng.uniform(0, 2 * np.pi)
    track[:, :2] = track[:, :2] @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    collection = _collection(
        rng, wavelength, 3.2 * size + 2 * relief, time=time, antenna_position=track,
        reference_range=np.linalg.norm(track, axis=1),
        beam_azimuth=np.full(n, np.nan),
    )  # fmt: skip
    return collection, np.zeros(2), np.full(2, size)


def _steered(rng: np.random.Generator, kind: str, relief: float) -> tuple[Collection, FloatArray, FloatArray]:
    """A beam about its axis along the track, or by its yaw, with two dwells or more."""
    wavelength = float(rng.choice([0.031, 0.056]))
    height, ground, speed = rng.uniform(3000, 6000), rng.uniform(6000, 9000), rng.uniform(100, 220)
    squint = float(rng.uniform(0.1, 0.25) * rng.choice([-1, 1])) if kind == "squinted" else 0.0
    broadside = float(np.hypot(height, ground))
    distance = broadside / np.cos(squint)
    width = float(rng.uniform(0.012, 0.04))
    dwell = distance * width / speed / np.cos(squint)
    turned = {"tops": rng.choice([rng.uniform(0.5, 2.0), rng.uniform(-0.6, -0.3)]), "yaw": rng.uniform(1.5, 3.0)}
    rate = turned.get(kind, 0.0) * speed / distance * (np.hypot(height, ground) / ground if kind == "yaw" else 1.0)
    dwell /= 1 + turned["tops"] if kind == "tops" else turned["yaw"] if kind == "yaw" else 1.0
    duration = dwell * rng.uniform(2.0, 3.5)
    prf = rng.uniform(SLOWEST, 1.7) * 2 * speed / wavelength * width
    n = int(np.clip(duration * prf, 300, 3000))
    time = (np.arange(n) - n // 2) / prf
    track = np.stack([0.3 * time**2, speed * time, np.full(n, height)], axis=1)
    velocity = np.gradient(track, time, axis=0)
    beam: dict[str, object] = {
        "beam_axis": velocity / np.linalg.norm(velocity, axis=1, keepdims=True),
        "beam_steering": squint + rate * time, "beam_azimuth": np.full(n, np.nan), "side_of_track": "right",
    }  # fmt: skip
    if kind == "yaw":
        beam = {"beam_azimuth": rate * time}
    reach = abs(time[-1]) * (rate * ground if kind == "yaw" else speed + rate * distance)
    size = np.array([float(rng.uniform(40, 90)), float(np.clip(0.6 * reach, 30, 400))])
    curved = 0.5 * distance * (width / 2 + abs(rate * time[-1])) ** 2
    swath = 2 * relief + 2.2 * size[0] + 2 * curved + 2 * abs(np.sin(squint)) * (size[1] + distance * width)
    collection = _collection(
        rng, wavelength, swath,
        time=time, antenna_position=track, reference_range=np.full(n, distance), beam_width=width, **beam,
    )  # fmt: skip
    return collection, np.array([ground, broadside * np.tan(squint)]), size


def _collection(rng: np.random.Generator, wavelength: float, swath: float, **fields: object) -> Collection:
    bandwidth = float(rng.uniform(60e6, 200e6))
    step = SPEED_OF_LIGHT / (2 * swath + 40 * SPEED_OF_LIGHT / (2 * bandwidth))  # and the ends, which are not imaged
    n = int(np.clip(bandwidth / step, 48, 200))
    return Collection(carrier=SPEED_OF_LIGHT / wavelength, range_frequency=(np.arange(n) - n // 2) * step, **fields)  # type: ignore[arg-type]


def _hill(centre: FloatArray, size: FloatArray, height: float) -> Terrain:
    reach = 1.5 * size + 200
    x, y = (np.linspace(c - r, c + r, 81) for c, r in zip(centre, reach, strict=True))
    away = ((x - centre[0] - 30) / 150) ** 2 + (((y - centre[1] + 20) / 200) ** 2)[:, None]
    return Terrain(
        x0=float(x[0]), dx=float(x[1] - x[0]), y0=float(y[0]), dy=float(y[1] - y[0]), heights=height * np.exp(-away)
    )


def terrain_height(terrain: Terrain, x: float, y: float) -> float:
    """Height of the terrain at a point, as the package interpolates it."""
    return float(terrain(np.array([x]), np.array([y]))[0])
