"""Scene files in TOML: radar, track, beam, targets and disturbances, checked as a whole before anything runs.

People write scene files, so angles are in degrees (in keys that end in `_deg`); all other units are SI. The message
about a wrong file lists every wrong field with its value and the remedy.

    title = "..."
    [radar]         carrier, bandwidth, range_sampling, prf, pulse_width (raw echo only)
    [georeference]  latitude, longitude, height, rotation_deg
    [track]         position, velocity, acceleration, jerk | coefficients | samples | states | file; earth_centred
    [[track.wobble]]  amplitude, frequency, phase_deg; [track.error] offset, velocity, drift, oscillation, ...
    [time]          duration | pulses; start
    [beam]          start_deg, stop_deg, dwell | width_deg          (omit if not steered)
                    | mode, width_deg, axis_yaw_deg, axis_pitch_deg, squint_deg, rate_deg, point
                    pattern, elevation_pattern, elevation_width_deg
    [scene]         swath, centre_yaw_deg, centre_range, ground_height, reference_range
    [terrain]       file, vertical | hills = [{x, y, height, width}, ..]; spacing, surface
    [[targets]]     name, x + y | range + yaw_deg | ground_range_offset + cross_range_offset; z; amplitude, phase_deg
    [matrix]        rows, columns, spacing | extent, names
    [clutter]       scatterers, seed, range + yaw_deg | x + y, power
    [reflectivity]  file, x0, dx, y0, dy, seed
    [noise]         power, seed
    [dropped]       pulses, ranges, fraction, seed

Messages about errors name the field, the value, the remedy, and the nearest known key.
"""

from __future__ import annotations

import difflib
import math
import os
import re
import tomllib
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, PrivateAttr, ValidationError

from blocksar.arrays import FloatArray, IntArray
from blocksar.collection.beam import in_beam, lit_yaw
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.terrain import Terrain
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError, MissingInput
from blocksar.simulation import shipped_scenes, shipped_text
from blocksar.simulation.antenna import axis_beam, lit_yaws, patterns
from blocksar.simulation.scene_fields import LARGEST, SMALLEST, ClutterTable, ReflectivityTable
from blocksar.simulation.scene_ground import hiding_terrain, terrain_of
from blocksar.simulation.scene_tables import SceneTables
from blocksar.texts import count


def message_of(label: str, problems: list[str]) -> str:
    """Join problems into one message; `label` names the scene file."""
    return f"{label} has {count(len(problems), 'wrong field')}:" + "".join(f"\n  {problem}" for problem in problems)


def describe_error(error: ValidationError, data: dict[str, Any], label: str, root: type[BaseModel]) -> str:
    """List every wrong field as `field = value: remedy`; alternative remedies are joined by 'or'."""
    remedies: dict[str, list[str]] = {}  # by wrong field
    hints: dict[str, str] = {}
    for item in error.errors(include_url=False):
        place, model = _locate(item["loc"], data, root)
        field, value = _dotted(place), _short(item["input"])
        text = item["msg"].replace("Input should be", "must be").removeprefix("Value error, ")
        match item["type"]:
            case "missing" if isinstance(item["loc"][-1], str):
                remedies[f"{field} is missing"] = [f"add {_hint(model, place)}"]
            case "extra_forbidden":
                remedies[f"{field} = {value}"] = [f"unknown key; {_nearest(model, place)}"]
            case "value_error":
                # Messages about a whole table begin with the wrong field, if there is one.
                known = _fields(_table_at(place, root))
                first_word = re.split(r"[^a-z_0-9]", text)[0]
                remedies[f"{field}.{text}" if first_word in known else f"{field}: {text}"] = []
            case kind:
                text = "has too few elements" if kind == "missing" else text.replace("valid tuple", "list")
                remedies.setdefault(f"{field} = {value}", []).append(text[0].lower() + text[1:])
                hints[f"{field} = {value}"] = _hint(model, place)
    problems = []
    for head, alternatives in remedies.items():
        remedy = " or ".join(dict.fromkeys(alternatives))
        problems.append(": ".join(filter(None, (head, remedy))) + (f" ({hints[head]})" if head in hints else ""))
    return message_of(label, problems)


def _locate(
    loc: tuple[int | str, ...], data: Any, root: type[BaseModel]
) -> tuple[list[int | str], type[BaseModel] | None]:
    """Return the part of pydantic's location that exists in the file, and the table that contains it."""
    place: list[int | str] = []
    model: type[BaseModel] | None = root
    here: Any = data
    for i, part in enumerate(loc):
        last = i == len(loc) - 1
        inside = part in here if isinstance(here, dict) else isinstance(here, list) and part in range(len(here))
        if inside:
            here = here[part]
        elif not (last and isinstance(here, dict)) or "[" in str(part):
            continue  # the name of an alternative in a union
        place.append(part)
        if not last and isinstance(part, str) and model is not None:
            # In a table inside a table, its own keys; a table of any keys (names of targets) stays its parent's.
            inner = _tables(model).get(part)
            model = inner if model is root or inner is not None else model
    return place, model


def _table_at(place: list[int | str], root: type[BaseModel]) -> type[BaseModel] | None:
    """Return the table that a place names."""
    model: type[BaseModel] | None = root
    for part in place:
        if isinstance(part, str) and model is not None:
            model = _tables(model).get(part)
    return model


def _tables(root: type[BaseModel]) -> dict[str, type[BaseModel]]:
    """Return the tables of a scene file by key."""
    tables = {(field.alias or name): _models_in(field.annotation) for name, field in root.model_fields.items()}
    return {key: models[0] for key, models in tables.items() if models}


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    """List the tables in an annotation, which may be optional or a list of tables."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in get_args(annotation) for model in _models_in(part)]


def _fields(model: type[BaseModel] | None) -> dict[str, str]:
    """Return the keys of a table and their descriptions."""
    if model is None:
        return {}
    return {field.alias or name: field.description or "" for name, field in model.model_fields.items()}


def _hint(model: type[BaseModel] | None, place: list[int | str]) -> str:
    fields = _fields(model)
    return next((fields[part] for part in reversed(place) if isinstance(part, str) and part in fields), "it")


def _nearest(model: type[BaseModel] | None, place: list[int | str]) -> str:
    known = list(_fields(model))
    close = difflib.get_close_matches(str(place[-1]), known, n=1)
    return f"did you mean {close[0]}?" if close else f"known here are {', '.join(known)}"


def impossible_values(value: Any, place: tuple[int | str, ...] = ()) -> Iterator[str]:
    """Report numbers that are too large or too small for any unit."""
    match value:
        case dict():
            for key, item in value.items():
                yield from impossible_values(item, (*place, key))
        case list():
            for index, item in enumerate(value):
                yield from impossible_values(item, (*place, index))
        case int() | float() if value and not SMALLEST <= abs(value) <= LARGEST and math.isfinite(value):
            yield f"{_dotted([*place])} = {_short(value)}: must lie between {SMALLEST:g} and {LARGEST:g} in size"


def _dotted(place: list[int | str]) -> str:
    text = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in place)
    return text.removeprefix(".")


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def next_smooth_even(least: int) -> int:
    """Return the least even number >= max(least, 16) whose prime factors are 2, 3 and 5.

    >>> next_smooth_even(2342)
    2400
    """
    n = max(least + least % 2, 16)
    while True:
        rest = n
        for factor in (2, 3, 5):
            while rest % factor == 0:
                rest //= factor
        if rest == 1:
            return n
        n += 2


class PointTarget(NamedTuple):
    """A named point target: x, y in m in the scene frame, and z; None on the ground plane."""

    name: str
    x: float
    y: float
    reflectivity: complex
    z: float | None = None


class PlacedScatterers(NamedTuple):
    """Many nameless scatterers: x, y (n,) m in the scene frame, reflectivity (n,) complex64."""

    x: FloatArray
    y: FloatArray
    reflectivity: NDArray[np.complex64]


def draw_field(
    table: ClutterTable,
    ranges: tuple[float, float],
    yaws: tuple[float, float],
    ground_point: Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]],
) -> PlacedScatterers:
    """Draw a random field: uniform over the table's box, or over the ground between slant ranges (m) and yaws (rad).

    `ground_point` returns x, y (m) at slant ranges (m) and yaws (rad).
    """
    random = np.random.default_rng(table.seed)
    u, v = random.random((2, table.scatterers))
    if table.x is not None and table.y is not None:
        x = table.x[0] + u * (table.x[1] - table.x[0])
        y = table.y[0] + v * (table.y[1] - table.y[0])
    else:
        # Ground area grows with the square of the distance, and that with the square of the slant range.
        squared = ranges[0] ** 2 + u * (ranges[1] ** 2 - ranges[0] ** 2)
        x, y = ground_point(np.sqrt(squared), yaws[0] + v * (yaws[1] - yaws[0]))
    parts = random.standard_normal((2, table.scatterers)) * np.sqrt(table.power / 2)
    return PlacedScatterers(x, y, (parts[0] + 1j * parts[1]).astype(np.complex64))


def read_map(table: ReflectivityTable) -> PlacedScatterers:
    """Read a reflectivity map: a scatterer for each pixel that is not zero."""
    pixels = np.load(table.file, allow_pickle=False)
    row, column = np.nonzero(pixels)
    values = pixels[row, column].astype(np.complex64)
    if table.seed is not None:
        # One phase for each pixel of the map, empty ones included: editing a pixel leaves the others unchanged.
        phase = np.random.default_rng(table.seed).random(pixels.shape)[row, column]
        values = values * np.exp(2j * np.pi * phase).astype(np.complex64)
    x, y = table.x0 + table.dx * column.astype(np.float64), table.y0 + table.dy * row.astype(np.float64)
    return PlacedScatterers(x, y, values)


RANGE_GUARD = 1.05  # ratio of the range window to the extent of lit targets
MAX_FAST_TIME_SAMPLES = 1 << 20
CHECKED_PULSES = 257  # number of pulses at which ranges of lit targets are evaluated


def scene_text(source: str | Path) -> str:
    """Return the text of a scene file; a name that is not a file means a shipped scene (e.g. "table1").

    Raises
    ------
    MissingInput
        If there is no such scene.
    InputError
        If the file cannot be read.
    """
    path = Path(source)
    if os.path.isfile(path):
        try:
            return path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"{path} cannot be read ({error}); give a scene file in UTF-8") from None
    if str(source) not in shipped_scenes():
        raise MissingInput(
            f"scene {str(source)!r} is neither a file nor one of the shipped scenes: {', '.join(shipped_scenes())}"
        )
    return shipped_text(str(source))


class Scene(SceneTables):
    """A checked scene file; `Scene.read` reads one, and `Scene.parse` its text."""

    _name: str = PrivateAttr("")

    @classmethod
    def read(cls, source: str | Path) -> Scene:
        """Read a scene file; a name that is not a file means a shipped scene (e.g. "table1").

        Raises
        ------
        InputError
            If there is no such scene, it is not TOML, or fields are wrong; the message lists all of them.
        """
        path = Path(source)
        text = scene_text(source)
        if os.path.isfile(path):
            return cls.parse(text, name=path.stem, label=str(path), folder=path.parent)
        return cls.parse(text, name=str(source), label=f"{source}.toml")

    @classmethod
    def parse(cls, text: str, *, name: str = "", label: str = "scene", folder: Path | None = None) -> Scene:
        """Read and check the text of a scene file.

        Parameters
        ----------
        text : str
            TOML.
        name : str
            Name of the scene.
        label : str
            Name of the file in messages.
        folder : path, optional
            Folder of the files that the scene names.

        Raises
        ------
        InputError
            If it is not TOML, or fields are wrong; the message lists all of them.
        """
        try:
            data = tomllib.loads(text)
            impossible = list(impossible_values(data))
        except (ValueError, RecursionError) as error:
            raise InputError(f"{label} is not TOML: {error}; correct that line") from None
        if impossible:
            raise InputError(message_of(label, impossible))
        try:
            scene = cls.model_validate(data, context={"folder": folder})
        except ValidationError as error:
            raise InputError(describe_error(error, data, label, cls)) from None
        scene._name = name
        if problems := list(scene.problems()) or list(scene._range_problems()):
            raise InputError(message_of(label, problems))
        return scene

    @property
    def name(self) -> str:
        """The name of the scene file without its suffix, or of the shipped scene."""
        return self._name

    def _range_problems(self) -> Iterator[str]:
        """List slant ranges that do not reach the ground, and a swath that an Earth-centred track does not see."""
        try:
            origin = self.origin
        except InputError as error:
            why = "; track.earth_centred = true, so that states are in m, above the place that [georeference] names"
            yield f"{error}{why if self.track.earth_centred else ''}"
            return
        height, swath = origin[2] - self.area.ground_height, self.area.swath
        if self.track.earth_centred:
            away = float(np.sqrt(origin[0] ** 2 + origin[1] ** 2 + height**2))
            if self.about_origin and not swath[0] <= away <= swath[1]:
                yield (
                    f"scene.swath = [{swath[0]:g}, {swath[1]:g}]: must contain the slant range of the scene centre at "
                    f"t = 0, the frame's origin, {away:.8g} m"
                )
        fields = {"scene.swath": swath[0], "scene.centre_range": self.area.centre_range}
        fields |= {f"targets[{i}].range": target.range for i, target in enumerate(self.targets)}
        if self.clutter is not None and self.clutter.range is not None:
            fields["clutter.range"] = self.clutter.range[0]
        for field, value in fields.items():
            if value is not None and value <= height:
                yield f"{field} = {value:g}: must exceed the height above ground at t = 0, {height:.6g} m"

    @cached_property
    def pulse_times(self) -> FloatArray:
        """Slow time (n_pulse,), s; by default 0 at the middle pulse, n_pulse // 2."""
        index = np.arange(self.n_pulse)
        if self.time.start is None:
            return np.asarray((index - self.n_pulse // 2) / self.radar.prf)
        return np.asarray(self.time.start + index / self.radar.prf)

    @cached_property
    def beam_azimuth(self) -> FloatArray:
        """Beam-centre yaw (n_pulse,), rad; NaN if the beam is not steered, or has an axis."""
        if self.beam is None or self.beam.start_deg is None or self.beam.stop_deg is None:
            return np.full(self.n_pulse, np.nan)
        start, stop = self.beam.start_deg, self.beam.stop_deg
        return np.asarray(np.deg2rad(start + (stop - start) * np.arange(self.n_pulse) / self.n_pulse))

    @cached_property
    def _antenna(self) -> dict[str, Any]:
        """The beam about the antenna's axis and its patterns, by field names of `Collection`."""
        if self.beam is None:
            return {}
        antenna: dict[str, Any] = patterns(self.beam, self.beam_width_deg, lambda: self.centre - self.origin)
        if self.beam.mode is not None:
            antenna |= axis_beam(self.beam, self.pulse_times, self._positions, self.centre)
        return antenna

    @cached_property
    def _positions(self) -> FloatArray:
        return self.track.positions(self.pulse_times, self.georeference)

    def _collection(
        self, range_frequency: FloatArray, reference_range: FloatArray, noise_power: float | None = None
    ) -> Collection:
        return Collection(
            carrier=self.radar.carrier,
            time=self.pulse_times,
            range_frequency=range_frequency,
            reference_range=reference_range,
            antenna_position=self._positions,
            beam_azimuth=self.beam_azimuth,
            beam_width=None if self.beam is None else float(np.deg2rad(self.beam_width_deg)),
            ground_height=self.area.ground_height,
            title=self.title,
            noise_power=noise_power,
            **self._antenna,
        )

    @cached_property
    def geometry(self) -> Geometry:
        """Track and polar frame, as derived from the store later; its range axis is a placeholder."""
        axis = np.linspace(-0.5, 0.5, 8) * self.radar.bandwidth
        return Geometry(collection=self._collection(axis, np.zeros(self.n_pulse)))

    @cached_property
    def origin(self) -> FloatArray:
        """Antenna position at t = 0, (3,) m."""
        geometry = self._bare_geometry
        geometry.nadir  # noqa: B018 - raises an InputError if t = 0 lies too far from the pulses
        return geometry.track.position(np.array(0.0))

    @cached_property
    def _bare_geometry(self) -> Geometry:
        """Geometry of the scene without the antenna, whose pointing may depend on that geometry."""
        if self.beam is None or (self.beam.mode is None and self.beam.elevation_pattern is None):
            return self.geometry
        return self.model_copy(update={"beam": None}).geometry

    @property
    def centre_yaw(self) -> float:
        """Yaw of the scene centre, rad."""
        if self.area.centre_yaw_deg is not None:
            return float(np.deg2rad(self.area.centre_yaw_deg))
        if self.about_origin:
            return float(np.arctan2(-self.origin[1], -self.origin[0]))
        assert self.beam is not None and self.beam.start_deg is not None  # checked when read
        assert self.beam.stop_deg is not None
        return float(np.deg2rad((self.beam.start_deg + self.beam.stop_deg) / 2))

    def ground_point(self, slant_range: FloatArray | float, yaw: FloatArray | float) -> tuple[FloatArray, FloatArray]:
        """Return x, y (m) on the ground at slant ranges (m) and yaws (rad) at t = 0; both broadcast."""
        height = self.origin[2] - self.area.ground_height
        distance = np.sqrt(np.asarray(slant_range) ** 2 - height**2)
        return self.origin[0] + distance * np.cos(yaw), self.origin[1] + distance * np.sin(yaw)

    @cached_property
    def centre(self) -> FloatArray:
        """The scene centre, (3,) m."""
        if self.about_origin:
            return np.array([0.0, 0.0, self.area.ground_height])
        near, far = self.area.swath
        x, y = self.ground_point(self.area.centre_range or (near + far) / 2, self.centre_yaw)
        return np.array([float(x), float(y), self.area.ground_height])

    def offset_point(self, along: FloatArray | float, across: FloatArray | float) -> tuple[FloatArray, FloatArray]:
        """Return x, y (m) at offsets (m) from the scene centre: along ground range, and across it to larger yaw."""
        cos, sin = np.cos(self.centre_yaw), np.sin(self.centre_yaw)
        along, across = np.asarray(along), np.asarray(across)
        return self.centre[0] + along * cos - across * sin, self.centre[1] + along * sin + across * cos

    @cached_property
    def lit_yaw(self) -> tuple[float, float]:
        """First and last yaw (rad) that the beam lights; those of the scene centre if the beam is not steered."""
        if self.beam is None:
            return self.centre_yaw, self.centre_yaw
        if self.beam.mode is None:
            return lit_yaw(self.geometry.collection)
        return lit_yaws(
            self.geometry,
            self.centre_yaw,
            lambda yaw: self.ground_point(np.linspace(*self.area.swath, 9)[:, None], yaw),
        )

    def point_targets(self) -> list[PointTarget]:
        """Return all point targets, the listed ones, then the matrix row by row; with z on a terrain."""
        points = self._placed()
        if self.terrain is None:
            return points
        z = self.terrain(np.array([p.x for p in points]), np.array([p.y for p in points])).tolist()
        return [p if p.z is not None else p._replace(z=height) for p, height in zip(points, z, strict=True)]

    def unlit_targets(self) -> list[str]:
        """Names of the point targets that no pulse lights."""
        points = self.point_targets()
        if self.beam is None or not points:
            return []
        x, y = (np.array([getattr(point, axis) for point in points]) for axis in "xy")
        z = np.array([self.area.ground_height if point.z is None else point.z for point in points])
        with suppress(InputError):  # a beam that turns all round lights all
            first, last = self.geometry.beam.passes(x, y, z)
            return [point.name for point, pulses in zip(points, (last - first).max(axis=0), strict=True) if not pulses]
        return []

    def _placed(self) -> list[PointTarget]:
        """Point targets with z as given in the file."""
        points: list[PointTarget] = []
        for target in self.targets:
            if target.x is not None and target.y is not None:
                position = np.asarray(target.x), np.asarray(target.y)
            elif target.range is not None and target.yaw_deg is not None:
                position = self.ground_point(target.range, float(np.deg2rad(target.yaw_deg)))
            else:
                position = self.offset_point(target.ground_range_offset or 0.0, target.cross_range_offset or 0.0)
            x0, y0 = map(float, position)
            points.append(PointTarget(target.name, x0, y0, target.reflectivity, target.z))
        if self.matrix is not None:
            x, y = self.offset_point(*self.matrix.offsets())
            amplitude = complex(self.matrix.amplitude)
            points.extend(map(PointTarget, self.matrix.labels(), x.tolist(), y.tolist(), [amplitude] * x.size))
        return points

    @cached_property
    def terrain(self) -> Terrain | None:
        """Heights of the ground over everything that may be lit; None for the plane."""
        if self.ground is None:
            return None
        return terrain_of(self.ground, self.area.ground_height, *self._outline(), self.georeference)

    @cached_property
    def hiding_terrain(self) -> Terrain | None:
        """Heights of the ground that may shadow what is lit, as far as the file covers it; None for the plane."""
        if self.ground is None or self.terrain is None:
            return None
        x, y = ((float(axis.min()), float(axis.max())) for axis in self._outline())
        return hiding_terrain(
            self.ground, self.area.ground_height, self.terrain, (x, y), self._positions, self.georeference
        )

    def scatterers(self) -> PlacedScatterers:
        """Return the scatterers of the random field and of the reflectivity map together (possibly none)."""
        parts = []
        if self.clutter is not None:
            parts.append(draw_field(self.clutter, *self._clutter_region(), self.ground_point))
        if self.reflectivity is not None:
            parts.append(read_map(self.reflectivity))
        if not parts:
            return PlacedScatterers(np.empty(0), np.empty(0), np.empty(0, np.complex64))
        return PlacedScatterers(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))

    def _clutter_region(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return the polar region of the random field: slant ranges (m) and yaws (rad)."""
        assert self.clutter is not None
        ranges = self.clutter.range or self.area.swath
        yaws = self.clutter.yaw_deg
        if yaws is not None:
            return ranges, (float(np.deg2rad(yaws[0])), float(np.deg2rad(yaws[1])))
        return ranges, self.lit_yaw

    def dropped_pulses(self) -> IntArray:
        """Return the indices of lost pulses, ascending."""
        if self.dropped is None:
            return np.empty(0, dtype=np.int64)
        lost = np.zeros(self.n_pulse, dtype=bool)
        lost[list(self.dropped.pulses)] = True
        for first, last in self.dropped.ranges:
            lost[first : last + 1] = True
        count = round(self.dropped.fraction * self.n_pulse)
        if count:
            lost[np.random.default_rng(self.dropped.seed).permutation(self.n_pulse)[:count]] = True
        return np.flatnonzero(lost)

    @cached_property
    def reference_range(self) -> FloatArray:
        """Range whose phase is removed, (n_pulse,) m."""
        choice = self.area.reference_range
        if choice == "scene_centre":
            return np.asarray(np.linalg.norm(self.centre - self.geometry.collection.antenna_position, axis=1))
        constant = float(np.linalg.norm(self.centre - self.origin)) if choice == "constant" else float(choice)
        return np.full(self.n_pulse, constant)

    def _outline(self) -> tuple[FloatArray, FloatArray]:
        """Return x, y (m) of points that enclose everything that may be lit: swath, targets, field, map."""
        yaw = np.linspace(*self.lit_yaw, 65)
        near, far = self.area.swath
        parts = [self.ground_point(np.linspace(near, far, 5)[:, None], yaw)]
        targets = self._placed()
        parts.append((np.array([t.x for t in targets]), np.array([t.y for t in targets])))
        if self.reflectivity is not None:
            table, shape = self.reflectivity, np.load(self.reflectivity.file, mmap_mode="r").shape
            x_edge = np.linspace(table.x0, table.x0 + table.dx * (shape[1] - 1), 33)
            y_edge = np.linspace(table.y0, table.y0 + table.dy * (shape[0] - 1), 33)
            parts.append((np.tile(x_edge, y_edge.size), np.repeat(y_edge, x_edge.size)))
        if self.clutter is not None and self.clutter.x is not None and self.clutter.y is not None:
            x_edge, y_edge = np.linspace(*self.clutter.x, 33), np.linspace(*self.clutter.y, 33)
            parts.append((np.tile(x_edge, y_edge.size), np.repeat(y_edge, x_edge.size)))
        elif self.clutter is not None:
            ranges, yaws = self._clutter_region()
            parts.append(self.ground_point(np.linspace(*ranges, 5)[:, None], np.linspace(*yaws, 65)))
        return (
            np.concatenate([np.ravel(x) for x, _ in parts]),
            np.concatenate([np.ravel(y) for _, y in parts]),
        )

    @cached_property
    def _lit_ranges(self) -> tuple[float, float, float]:
        """Largest |R - reference_range|, smallest R and largest R, m, over lit targets and pulses."""
        x, y = self._outline()
        known = [self.area.ground_height] if self.terrain is None else self.terrain.limits
        levels = np.array([*known, *(t.z for t in self._placed() if t.z is not None)])
        yaw = self.geometry.yaw(x, y)
        pulses = np.unique(np.linspace(0, self.n_pulse - 1, CHECKED_PULSES).astype(int))
        # The beam is widened by half a step of the checked pulses (about its axis: a whole one), to miss no target.
        slack = np.ptp(self.beam_azimuth) / (pulses.size - 1) if self.beam else 0.0
        if has_axis := self.geometry.collection.has_axis:
            offset = self.geometry.beam.offset(x[:, None], y[:, None], pulses)
            slack = float(np.abs(np.diff(offset, axis=1)).max())
        half = np.deg2rad(self.beam_width_deg) / 2 + slack
        largest, nearest, farthest = 0.0, np.inf, 0.0
        for i, pulse in enumerate(pulses):
            lit = np.abs(offset[:, i]) <= half if has_axis else np.ones(x.shape, bool)
            if self.beam is not None and not has_axis:
                lit = in_beam(yaw, self.beam_azimuth[pulse], half)
            px, py, pz = self.geometry.collection.antenna_position[pulse]
            distance = np.sqrt((x[lit] - px) ** 2 + (y[lit] - py) ** 2 + (levels[:, None] - pz) ** 2)
            if distance.size:
                largest = max(largest, float(np.abs(distance - self.reference_range[pulse]).max()))
                nearest, farthest = min(nearest, float(distance.min())), max(farthest, float(distance.max()))
        return largest, nearest, farthest

    def _fast_time_samples(self, window: float) -> int:
        """Return the even, 5-smooth number of fast-time samples that span `window` metres of range."""
        least = max(window, 0.0) * 2 * self.radar.range_sampling / SPEED_OF_LIGHT
        if not least <= MAX_FAST_TIME_SAMPLES:
            raise InputError(
                f"scene.swath with scene.reference_range needs {least:.7g} fast-time samples for a window of "
                f"{window:.6g} m; the limit is {MAX_FAST_TIME_SAMPLES}: use a smaller swath or a reference range "
                "inside it"
            )
        return next_smooth_even(int(np.ceil(least)))

    @cached_property
    def fast_time(self) -> FloatArray:
        """Two-way delays of the raw echo's samples, (n,) s, which contain all lit echoes completely.

        Raises
        ------
        InputError
            If radar.pulse_width is missing.
        """
        if self.radar.pulse_width is None:
            raise InputError("radar.pulse_width is missing: a raw echo needs the length of its chirp, s")
        largest, nearest, farthest = self._lit_ranges
        pulse = self.radar.pulse_width * SPEED_OF_LIGHT / 2
        # Range compression wraps ranges into the window about the reference, so it must contain these as well.
        window = RANGE_GUARD * max(farthest - nearest + pulse, 2 * largest)
        n = self._fast_time_samples(window)
        middle = (nearest + farthest) / SPEED_OF_LIGHT
        return np.asarray(middle + (np.arange(n) - n // 2) / self.radar.range_sampling)

    def range_frequency(self, *, raw: bool = False) -> FloatArray:
        """Return the baseband range frequencies, Hz: the Fourier grid of the fast-time samples within the bandwidth.

        The window c / (2 step) contains all lit ranges about the reference range, including range migration and a
        guard of 5 %, so that no echo wraps.
        """
        n = self.fast_time.size if raw else self._fast_time_samples(2 * RANGE_GUARD * self._lit_ranges[0])
        grid = np.arange(-(n // 2), n // 2) * (self.radar.range_sampling / n)
        return np.asarray(grid[np.abs(grid) <= self.radar.bandwidth / 2])

    def collection(self, *, raw: bool = False) -> Collection:
        """Return the collection's metadata, as the simulated store will hold it.

        Parameters
        ----------
        raw : bool
            For a raw echo, whose range frequencies belong to `fast_time`.

        Raises
        ------
        InputError
            If track samples do not cover the pulses, the range window is too large, or a raw echo has no pulse width.
        """
        noise_power = None if self.noise is None else self.noise.power
        return self._collection(self.range_frequency(raw=raw), self.reference_range, noise_power)
