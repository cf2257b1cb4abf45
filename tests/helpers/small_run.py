"""A small run made by exact back-projection; products must reproduce its known scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import blocksar
from blocksar import stores
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry, over_terrain
from blocksar.collection.georeference import Georeference
from blocksar.collection.grid import Grid
from blocksar.collection.terrain import Terrain
from blocksar.collection.weighting import Weighting
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.imaging.noise import NoiseMap
from blocksar.imaging.terrain_layers import Sight, Strip, box_of, heights_and_angles, visibility
from blocksar.measurement.targets import Target
from blocksar.processors.exact.sums import form_image
from blocksar.runs import finished

DAYTON = Georeference(latitude=39.78, longitude=-84.09, height=250.0)
TARGETS = [Target("A", 0.3, -0.2), Target("B", 20.1, 11.3), Target("C", -17.7, 13.9), Target("D", -12.2, -15.9)]


@dataclass(frozen=True)
class Made:
    """A run and its known scene."""

    folder: Path
    collection: Collection
    image: Any
    x: Any
    y: Any

    @property
    def source(self) -> finished.FinishedRun:
        _, attrs = stores.read_collection(self.folder / "collection.zarr")
        geometry = Geometry(collection=self.collection)
        folder = blocksar.places.place(self.folder)  # type: ignore[attr-defined]
        record = finished.finished_record(folder)
        return finished.FinishedRun(folder, self.x, self.y, geometry, attrs, record)

    def exact_value(self, terrain: Terrain, point: Any, *, centre: tuple[float, float] = (0.0, 0.0)) -> complex:
        """The image of the targets on a terrain at a point (3,) of it, m, by its definition."""
        collection, total = self.collection, 0.0 + 0j
        away = point[:2] - Geometry(collection=collection).nadir
        lit = np.ones(collection.n_pulse, bool)
        if collection.beam_axis is not None and collection.beam_steering is not None:
            sight = point - collection.antenna_position
            sine = (sight * collection.beam_axis).sum(axis=1) / np.linalg.norm(sight, axis=1)
            lit = np.abs(np.arcsin(sine) - collection.beam_steering) <= (collection.beam_width or 0.0) / 2
        elif collection.beam_width is not None:
            off = np.arctan2(away[1], away[0]) - collection.beam_azimuth
            lit = np.abs(np.angle(np.exp(1j * off))) <= collection.beam_width / 2
        track, frequency = collection.antenna_position[lit], collection.carrier + collection.range_frequency
        distance = np.linalg.norm(point - track, axis=1)
        for target in TARGETS:
            x, y = target.x + centre[0], target.y + centre[1]
            own = np.linalg.norm([x, y, float(terrain(np.array(x), np.array(y)))] - track, axis=1)
            total += np.exp(4j * np.pi / SPEED_OF_LIGHT * np.outer(distance - own, frequency)).mean()
        return total

    def peak(self, target: Target) -> Any:
        """Fractional (row of y, column of x) of the target's peak, from a chip upsampled 16 times by zero padding."""
        at = [round((v - axis[0]) / (axis[1] - axis[0])) for v, axis in ((target.y, self.y), (target.x, self.x))]
        chip = self.image[at[0] - 12 : at[0] + 12, at[1] - 12 : at[1] + 12]
        return np.array(at) - 12 + upsampled_peak(chip)


def hilly(centre: tuple[float, float]) -> Terrain:
    """A hill on a slope, with the scene about `centre` on it."""
    x, y = np.meshgrid(np.arange(-60.0, 61.0, 2.0), np.arange(-60.0, 61.0, 2.0))
    heights = 8 + 14 * np.exp(-((x - 5) ** 2 + (y + 4) ** 2) / 22**2) + 0.05 * x
    return Terrain(x0=centre[0] - 60, dx=2.0, y0=centre[1] - 60, dy=2.0, heights=heights)


def ridge(*, base: float = 0.0) -> Terrain:
    """A ridge across range, with layover before it and shadow behind it, on a slope of 1 in 50 about z = base, m."""
    x, y = np.meshgrid(np.arange(-60.0, 61.0, 1.5), np.arange(-60.0, 61.0, 1.5))
    heights = 14 * np.exp(-(((0.6 * x + 0.8 * y + 4) / 6) ** 2)) + 0.02 * x + base
    return Terrain(x0=-60.0, dx=1.5, y0=-60.0, dy=1.5, heights=heights)


def axis_beam(track: Any, centre: Any, time: Any, rate: float) -> dict[str, Any]:
    """A beam about an axis along the velocity, raised by 0.1, that passes the centre at t = 0.5 s."""
    axis = np.gradient(track, time, axis=0)
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    axis += [0.0, 0.0, 0.1]
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    sight = (centre - track) / np.linalg.norm(centre - track, axis=1, keepdims=True)
    return {"beam_axis": axis, "beam_steering": np.arcsin((sight * axis).sum(axis=1)) + rate * (time - 0.5)}


def upsampled_peak(chip: Any, factor: int = 16) -> Any:
    steps = [np.angle((chip[1:] * chip[:-1].conj()).sum()), np.angle((chip[:, 1:] * chip[:, :-1].conj()).sum())]
    for axis, step in enumerate(steps):
        ramp = np.exp(-1j * step * np.arange(chip.shape[axis]))
        chip = chip * (ramp[:, None] if axis == 0 else ramp)
    n = chip.shape[0]
    spectrum = np.zeros((n * factor, n * factor), np.complex128)
    half = n // 2
    spectrum[:n, :n] = np.roll(np.fft.fft2(chip), (half, half), (0, 1))
    fine = np.abs(np.fft.ifft2(spectrum))
    return np.array(np.unravel_index(fine.argmax(), fine.shape)) / factor


def make(
    folder: Path,
    *,
    look: float = 0.9,
    steered: bool = False,
    about_axis: bool = False,
    beam: tuple[float, float] = (0.02, 0.012),
    frame: Georeference | None = DAYTON,
    centre: tuple[float, float] = (0.0, 0.0),
    size: tuple[int, int] = (150, 130),
    step: float = 0.4,
    hole: bool = True,
    more: dict[str, Any] | None = None,
    weighting: str = "uniform",
    noise_power: float | None = None,
    terrain: Terrain | None = None,
    formed_on_it: bool = False,
) -> Made:
    """Make a finished run over targets about `centre`; no coverage in a south-west corner and some northern rows.

    With `noise_power` the run says what noise its image has; there is none in it. With a terrain it has the layers of
    one, but the image is that of the plane, unless it is `formed_on_it`. The beam turns with a yaw where it is
    `steered`, and `about_axis` about an axis that is not level; `beam` has its width, rad, and its rate, rad/s.
    """
    n = 160
    time = (np.arange(n) - n // 2) / 60.0 + 0.5
    cos, sin = np.cos(look), np.sin(look)
    t = time[:, None]
    track = np.array([-6000 * cos, -6000 * sin, 4000.0]) + t * np.array([-sin, cos, 0.0]) * 60 + t * [30 * cos, 9, -4]
    track = track + t**2 * np.array([1.0, 0.5, 0.2]) + np.array([*centre, 0.0])
    frequency = (np.arange(96) - 48) * 1.5e6
    nadir = track[0] + (track[-1] - track[0]) * (0.0 - time[0]) / (time[-1] - time[0])
    middle = np.arctan2(centre[1] - nadir[1], centre[0] - nadir[0])
    collection = Collection(
        carrier=9.6e9,
        time=time,
        range_frequency=frequency,
        reference_range=np.linalg.norm(track - [*centre, 0.0], axis=1),
        antenna_position=track,
        beam_azimuth=middle + beam[1] * (time - 0.5) if steered else np.full(n, np.nan),
        beam_width=beam[0] if steered or about_axis else None,
        noise_power=noise_power,
        **(axis_beam(track, np.array([*centre, 0.0]), time, beam[1]) if about_axis else {}),
        title="small scene, é",
    ).centred()
    geometry = Geometry(collection=collection)
    if terrain is not None and formed_on_it:
        geometry = over_terrain(collection, terrain)
    targets = [Target(t.name, t.x + centre[0], t.y + centre[1]) for t in TARGETS]
    signal = np.zeros((n, frequency.size), np.complex128)
    for target in targets:
        point = geometry.on_ground(np.array(target.x), np.array(target.y))
        distance = np.linalg.norm(point - track, axis=1) - collection.reference_range
        phase = np.outer(distance, collection.carrier + collection.range_frequency) * 4 * np.pi / SPEED_OF_LIGHT
        signal += np.exp(-1j * phase)
    x, y = (c + (np.arange(k) - k // 2) * step for c, k in zip(centre, size, strict=True))
    image = form_image(
        lambda pulses: signal[pulses].astype(np.complex64),
        geometry,
        x,
        y,
        threads=1,
        weighting=Weighting.parse(weighting),
    )
    if hole:
        image[:20, :30] = np.nan
        image[-9:] = np.nan
    attrs: dict[str, Any] = {"targets": [t._asdict() | {"reflectivity": [1.0, 0.0]} for t in targets], **(more or {})}
    if frame is not None:
        attrs["georeference"] = frame.as_attribute()
    stores.write_collection(folder / "collection.zarr", collection, attrs)
    whole = (slice(0, y.size), slice(0, x.size))
    told = {name: attrs[name] for name in ("georeference",) if name in attrs}
    image_attrs = {"title": collection.title, "Conventions": stores.CONVENTIONS, "ground_height": 0.0, **told}

    noise = NoiseMap.of(geometry, Weighting.parse(weighting), np.ones(n))
    variables = {"image": image, "block": np.where(np.isfinite(image), 0, -1).astype(np.int16)}
    if noise is not None:
        variables["noise_equivalent"] = np.where(np.isfinite(image), noise.over(x, y), np.nan).astype(np.float32)

    if terrain is not None:
        stores.write_terrain(blocksar.places.place(folder) / "terrain.zarr", terrain)  # type: ignore[attr-defined]
        grid, sight = (
            Grid(x[0], x[-1] + step / 2, step, y[0], y[-1] + step / 2, step),
            Sight.of(geometry, box_of(x, y), terrain.limits),
        )
        (ground,) = heights_and_angles(terrain, sight, grid, Strip(whole[0], [whole[1]]))
        variables["height"], variables["incidence_angle"] = ground.height, ground.angle
        variables["visibility"] = visibility(terrain, sight, grid, whole)

    def fill(place: Any) -> None:
        for name, values in variables.items():
            for first in range(0, y.size, 64):
                rows = slice(first, min(first + 64, y.size))
                stores.write_region(place, name, (rows, whole[1]), values[rows])

    stores.create(
        folder / "image.zarr",
        {**stores.IMAGE, **(stores.NOISE if noise_power else {}), **(stores.ON_TERRAIN if terrain else {})},
        sizes={},
        coords={"x": x, "y": y},
        attrs=image_attrs,
        chunks={"y": 64, "x": x.size},
        fill=fill,
    )
    stores.write_json(folder / "run.json", {
        "status": "finished", "identity": "0123456789abcdef",
        "settings": {
            **dict.fromkeys(("weighting_range", "weighting_azimuth"), weighting),
            "heights": None if terrain is None else stores.terrain_fingerprint(terrain),
        },
    })  # fmt: skip
    return Made(folder, collection, image, x, y)


def index(axis: Any, value: float) -> float:
    return float((value - axis[0]) / (axis[1] - axis[0]))
