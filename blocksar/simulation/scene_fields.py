"""The tables of a scene file: their fields, units, limits and checks.

Errors of the track describe how the antenna really moved relative to the track that the phase history states.

The scene's track is what the navigation says. Samples are simulated from the track plus its error; the store has the
track, and a reference range that follows the track. The track as flown is kept beside the store, see `phase_history`.
"""

from __future__ import annotations

import os
import warnings
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, model_validator

from blocksar.arrays import FloatArray
from blocksar.collection.collection import NOISE_POWERS
from blocksar.collection.georeference import Georeference
from blocksar.errors import InputError

LARGEST, SMALLEST = 1e19, 1e-19  # in any unit: numbers beyond are mistakes, and would overflow

Positive = Annotated[float, Field(gt=0)]
Seed = Annotated[int, Field(ge=0, lt=2**63)]
# TOML has lists only: tuples are read from lists, while their elements stay strict.
Pair = Annotated[tuple[float, float], Field(strict=False)]
Vector = Annotated[tuple[float, float, float], Field(strict=False)]


class Table(BaseModel):
    """A table of a scene file: frozen, without unknown keys, without conversion of types, finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


LINES = 64  # sine waves that a vibration is the sum of
NOTHING = (0.0, 0.0, 0.0)


class WobbleTable(Table):
    amplitude: Vector = Field(description="[x, y, z], m")
    frequency: Positive = Field(description="Hz")
    phase_deg: Vector = Field(NOTHING, description="[x, y, z] at t = 0, of a sine")

    def positions(self, time: FloatArray) -> FloatArray:
        """Return the displacement (n, 3), m, at slow times (n,), s."""
        angle = 2 * np.pi * self.frequency * time[:, None] + np.radians(self.phase_deg)
        return np.asarray(np.array(self.amplitude) * np.sin(angle))


class VibrationTable(Table):
    rms: Vector = Field(description="[x, y, z], m")
    band: Pair = Field(description="[low, high] Hz, in which it is noise")

    @model_validator(mode="after")
    def _check(self) -> Self:
        low, high = self.band
        if not 0 < low < high:
            raise ValueError(f"band = [{low:g}, {high:g}]: must be [low, high] with 0 < low < high, Hz")
        return self

    def positions(self, time: FloatArray, random: np.random.Generator) -> FloatArray:
        """Return the displacement (n, 3), m: sine waves of random frequency and phase, one axis by itself."""
        frequency = random.uniform(*self.band, (LINES, 3))
        phase = random.uniform(0, 2 * np.pi, (LINES, 3))
        waves = sum(np.sin(2 * np.pi * f * time[:, None] + p) for f, p in zip(frequency, phase, strict=True))
        return np.asarray(np.array(self.rms) * np.sqrt(2 / LINES) * waves)


class ErrorTable(Table):
    """Error of the stated track: true minus stated positions, the sum of all given terms."""

    offset: Vector = Field(NOTHING, description="[x, y, z], m, constant")
    velocity: Vector = Field(NOTHING, description="[x, y, z], m/s, about the middle of the collection")
    drift: Vector = Field(
        NOTHING, description="[x, y, z], m: reached at both ends of the collection, with the square of time"
    )
    oscillation: Annotated[tuple[WobbleTable, ...], Field(strict=False)] = Field((), description="sine waves")
    vibration: Annotated[tuple[VibrationTable, ...], Field(strict=False)] = Field(
        (), description="noise within a band of frequencies"
    )
    velocity_random_walk: Vector = Field(
        NOTHING, description="[x, y, z], m rms over the collection: of a velocity that walks from pulse to pulse"
    )
    position_random_walk: Vector = Field(
        NOTHING, description="[x, y, z], m rms over the collection: of a position that walks from pulse to pulse"
    )
    seed: Seed | None = Field(None, description="seed of random walks and vibrations; needed with them")

    @model_validator(mode="after")
    def _check(self) -> Self:
        random = [name for name in ("velocity_random_walk", "position_random_walk") if any(getattr(self, name))]
        random += ["vibration"] if self.vibration else []
        if random and self.seed is None:
            raise ValueError(f"seed missing: {' and '.join(random)} need{'s' if len(random) == 1 else ''} one")
        return self

    def positions(self, time: FloatArray) -> FloatArray:
        """Return the error (n, 3), m, at the pulses' slow times (n,), s.

        Mean and line of a random walk are taken out: they are `offset` and `velocity`. Each part has random numbers of
        its own, so that none changes with another.
        """
        middle, half = (time[0] + time[-1]) / 2, (time[-1] - time[0]) / 2
        since = (time - middle)[:, None]
        total = np.array(self.offset) + np.array(self.velocity) * since + np.array(self.drift) * (since / half) ** 2
        for wave in self.oscillation:
            total += wave.positions(time)
        for index, noise in enumerate(self.vibration):
            total += noise.positions(time, self._random(2 + index))
        for index, rms in enumerate((self.position_random_walk, self.velocity_random_walk)):
            if any(rms):
                steps = self._random(index).standard_normal((time.size, 3))
                total += np.array(rms) * _walk(steps, since[:, 0], sums=1 + index)
        return total

    def _random(self, part: int) -> np.random.Generator:
        assert self.seed is not None  # checked when read
        return np.random.Generator(np.random.Philox(key=np.array([self.seed, part], dtype=np.uint64)))


def _walk(steps: FloatArray, since: FloatArray, *, sums: int) -> FloatArray:
    """Integrate steps (n, 3) once or twice, remove mean and trend over `since` (n,), and scale to rms 1."""
    for _ in range(sums):
        steps = np.cumsum(steps, axis=0)
    steps = steps - steps.mean(axis=0)
    steps = steps - since[:, None] * ((since[:, None] * steps).sum(axis=0) / (since * since).sum())
    return np.asarray(steps / np.sqrt((steps * steps).mean(axis=0)))


MAX_PULSES = 1 << 22

# TOML has lists only: tuples are read from lists, while their elements stay strict.
IndexPair = Annotated[tuple[int, int], Field(strict=False)]
Sample = Annotated[tuple[float, float, float, float], Field(strict=False)]
State = Annotated[tuple[float, float, float, float, float, float, float], Field(strict=False)]
STATE_ERROR = 0.02  # of the speed: allowed difference between velocities and the positions' changes

Rows = Annotated[tuple[Pair, ...], Field(strict=False, min_length=2)]
Pattern = Literal["sinc2", "gaussian", "taylor"] | Rows


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise ValueError(message)


def _either(present: list[str], one: str, other: str) -> str:
    return f"{'both' if present else 'neither'} given: give either {one} or {other}"


def _present(table: BaseModel, *names: str) -> list[str]:
    """Return the names among `names` that the file states."""
    return [name for name in names if getattr(table, name) is not None]


def _stated(table: BaseModel, *names: str) -> list[str]:
    """Return the names among `names` with other values than their defaults."""
    fields = type(table).model_fields
    return [name for name in names if getattr(table, name) != fields[name].default]


class RadarTable(Table):
    carrier: Positive = Field(description="carrier frequency, Hz")
    bandwidth: Positive = Field(description="transmitted bandwidth, Hz")
    range_sampling: Positive = Field(description="complex fast-time sampling rate, Hz, at least the bandwidth")
    prf: Positive = Field(description="pulse repetition frequency, Hz")
    pulse_width: Positive | None = Field(None, description="length of the chirp, s; needed for a raw echo")

    @model_validator(mode="after")
    def _check(self) -> Self:
        _require(
            self.bandwidth < 2 * self.carrier,
            f"bandwidth = {self.bandwidth:g}: must be below twice the carrier, {2 * self.carrier:g} Hz",
        )
        _require(
            self.range_sampling >= self.bandwidth,
            f"range_sampling = {self.range_sampling:g}: must be at least the bandwidth, {self.bandwidth:g} Hz",
        )
        return self


class TrackTable(Table):
    position: Vector | None = Field(None, description="[x, y, z] at t = 0, m")
    velocity: Vector | None = Field(None, description="[x, y, z] at t = 0, m/s")
    acceleration: Vector | None = Field(None, description="[x, y, z] at t = 0, m/s^2")
    jerk: Vector | None = Field(None, description="[x, y, z], m/s^3")
    coefficients: Annotated[tuple[Vector, ...], Field(strict=False, min_length=2)] | None = Field(
        None, description="[x, y, z] that multiply t^0, t^1, t^2, ...: an acceleration enters as a / 2"
    )
    samples: Annotated[tuple[Sample, ...], Field(strict=False, min_length=4)] | None = Field(
        None, description="rows [t, x, y, z] in s and m, at least 4, t ascending"
    )
    states: Annotated[tuple[State, ...], Field(strict=False, min_length=2)] | None = Field(
        None, description="rows [t, x, y, z, vx, vy, vz] in s, m and m/s, at least 2, t ascending"
    )
    file: str | None = Field(
        None, description="CSV file of rows t, x, y, z (, vx, vy, vz) in s, m and m/s; relative to the scene file"
    )
    earth_centred: bool = Field(
        False, description="whether the track is Earth-centred, Earth-fixed (WGS 84); needs [georeference]"
    )
    wobble: Annotated[tuple[WobbleTable, ...], Field(strict=False)] = Field(
        (), description="oscillations that are added to the track, and known: the phase history has the sum"
    )
    error: ErrorTable | None = Field(
        None, description="how the antenna really moved off this track: in the samples, and unknown to the store"
    )

    @model_validator(mode="before")
    @classmethod
    def _read_file(cls, data: Any, info: ValidationInfo) -> Any:
        if not isinstance(data, dict) or not isinstance(data.get("file"), str) or data.keys() & {"samples", "states"}:
            return data
        path = _beside(data["file"], info)
        try:
            with warnings.catch_warnings(action="ignore", category=UserWarning):  # an empty file, reported below
                table = np.loadtxt(path, delimiter=",", ndmin=2, comments="#", skiprows=_header_lines(path))
        except (OSError, ValueError) as error:
            raise ValueError(f"file = {data['file']!r}: must be a readable CSV of t, x, y, z ({error})") from None
        return {**data, "states" if table.shape[1] == 7 else "samples": table.tolist()}

    @model_validator(mode="after")
    def _check(self) -> Self:
        taylor = _present(self, "position", "velocity", "acceleration", "jerk")
        ways = [*(["position, velocity"] if taylor else []), *_present(self, "coefficients", "samples", "states")]
        _require(
            len(ways) == 1,
            f"{' and '.join(ways) or 'nothing'} given: give one of position + velocity (+ acceleration, jerk), "
            "coefficients, samples, states or file",
        )
        if taylor:
            missing = [name for name in ("position", "velocity") if name not in taylor]
            _require(not missing, f"{', '.join(missing)} missing: a track needs position and velocity")
        for name in ("samples", "states"):
            rows = getattr(self, name) or ()
            _require(
                all(later[0] > earlier[0] for earlier, later in pairwise(rows)),
                f"{name}: t must ascend from row to row",
            )
        if self.states is not None:
            _check_states(np.array(self.states))
        return self

    def positions(self, time: FloatArray, georeference: Georeference | None = None) -> FloatArray:
        """Return the antenna phase centre (n, 3) in the scene frame, m, at slow times (n,), s.

        It is a polynomial, or a cubic spline of samples or (Hermite's) of states, carried into the frame of the
        georeference if it is Earth-centred, and the oscillations.

        Raises
        ------
        InputError
            If the samples do not cover `time`.
        """
        smooth = self._smooth(time)
        if self.earth_centred:
            assert georeference is not None  # checked when read
            smooth = georeference.from_ecef(smooth)
        return sum((wobble.positions(time) for wobble in self.wobble), smooth)

    def _smooth(self, time: FloatArray) -> FloatArray:
        if (given := self.samples or self.states) is not None:
            from scipy.interpolate import CubicHermiteSpline, CubicSpline  # slow to import, and only these need it

            rows, name = np.array(given), "samples" if self.samples else "states"
            tolerance = 1e-9 * (rows[-1, 0] - rows[0, 0])
            if time[0] < rows[0, 0] - tolerance or time[-1] > rows[-1, 0] + tolerance:
                raise InputError(
                    f"track.{name} run from t = {rows[0, 0]:g} to {rows[-1, 0]:g} s, but the pulses from "
                    f"{time[0]:g} to {time[-1]:g} s: give {name} for all of that time"
                )
            if self.samples:
                return np.asarray(CubicSpline(rows[:, 0], rows[:, 1:])(time), dtype=np.float64)
            return np.asarray(CubicHermiteSpline(rows[:, 0], rows[:, 1:4], rows[:, 4:])(time), dtype=np.float64)
        if self.coefficients is not None:
            coefficients = np.array(self.coefficients)
        else:
            terms = (self.position, self.velocity, self.acceleration, self.jerk)
            factorial = np.array([1.0, 1.0, 2.0, 6.0])
            coefficients = np.array([term or (0.0, 0.0, 0.0) for term in terms]) / factorial[:, None]
        return np.asarray(np.polynomial.polynomial.polyval(time, coefficients).T, dtype=np.float64)


class TimeTable(Table):
    duration: Positive | None = Field(None, description="length of the collection, s")
    pulses: int | None = Field(None, ge=8, le=MAX_PULSES, description="number of pulses, odd or even")
    start: float | None = Field(None, description="slow time of the first pulse, s; default: t = 0 is the middle pulse")

    @model_validator(mode="after")
    def _check(self) -> Self:
        present = _present(self, "duration", "pulses")
        _require(len(present) == 1, _either(present, "duration (s)", "pulses"))
        return self


class BeamTable(Table):
    """A beam described by its yaw (start_deg, stop_deg), or about the antenna's own axis (mode)."""

    start_deg: float | None = Field(None, ge=-720, le=720, description="beam-centre yaw at the first pulse, degrees")
    stop_deg: float | None = Field(
        None, ge=-720, le=720, description="beam-centre yaw one interval after the last pulse, degrees"
    )
    dwell: Positive | None = Field(None, description="time for which a target is lit, s")
    width_deg: float | None = Field(None, gt=0, lt=180, description="full beam width, degrees")
    mode: Literal["stripmap", "sliding-spotlight", "tops", "spotlight"] | None = Field(
        None, description="how the beam turns about the antenna's axis"
    )
    axis_yaw_deg: float | None = Field(
        None, ge=-720, le=720, description="yaw of the antenna's axis, degrees; default: along the velocity"
    )
    axis_pitch_deg: float = Field(0.0, gt=-90, lt=90, description="pitch of that axis above the horizontal, degrees")
    squint_deg: float = Field(
        0.0, gt=-90, lt=90, description="steering at t = 0 off the plane normal to the axis, towards it, degrees"
    )
    rate_deg: float | None = Field(None, description="rate of the steering, degrees/s")
    point: Vector | None = Field(
        None, description="[x, y, z] of the point at which the beam looks, m; spotlight: default the scene centre"
    )
    pattern: Pattern | None = Field(
        None, description="two-way amplitude: sinc2, gaussian, taylor, or rows [offset_deg, amplitude]"
    )
    elevation_pattern: Pattern | None = Field(
        None, description="the same over elevation, about the scene centre's, or rows [elevation_deg, amplitude]"
    )
    elevation_width_deg: float | None = Field(
        None, gt=0, lt=180, description="full width of a named elevation pattern, degrees"
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        present = _present(self, "dwell", "width_deg")
        if self.mode is None:
            missing = [name for name in ("start_deg", "stop_deg") if getattr(self, name) is None]
            _require(not missing, f"{', '.join(missing)} missing: give start_deg and stop_deg, or mode")
            others = _stated(self, "axis_yaw_deg", "axis_pitch_deg", "squint_deg", "rate_deg", "point")
            _require(not others, f"{', '.join(others)} given without mode: only a beam about its axis has them")
            _require(len(present) == 1, _either(present, "dwell (s)", "width_deg"))
            _require(
                self.start_deg != self.stop_deg or self.dwell is None,
                f"dwell = {self.dwell}: a beam that stands still has no dwell, give width_deg",
            )
        else:
            self._check_mode(self.mode)
        named = isinstance(self.elevation_pattern, str)
        _require(
            named == (self.elevation_width_deg is not None),
            f"elevation_width_deg = {self.elevation_width_deg}: goes with an elevation_pattern given by name",
        )
        return self

    def _check_mode(self, mode: str) -> None:
        others = _present(self, "start_deg", "stop_deg", "dwell")
        _require(not others, f"{', '.join(others)} given with mode = {mode!r}: give width_deg, and how it turns")
        _require(self.width_deg is not None, f"width_deg missing: mode = {mode!r} needs it")
        _require(
            self.axis_yaw_deg is not None or not _stated(self, "axis_pitch_deg"),
            "axis_yaw_deg missing: axis_pitch_deg needs it",
        )
        steering = _stated(self, "squint_deg", "rate_deg", "point")
        allowed: dict[str, tuple[list[str], ...]] = {
            "stripmap": ([], ["squint_deg"]),
            "spotlight": ([], ["point"]),
            "tops": (["rate_deg"], ["squint_deg", "rate_deg"]),
            "sliding-spotlight": (["rate_deg"], ["squint_deg", "rate_deg"], ["point"]),
        }
        ways = allowed[mode]
        _require(
            steering in ways,
            f"{', '.join(steering) or 'nothing'} given with mode = {mode!r}: give "
            + " or ".join(" + ".join(way) or "none of squint_deg, rate_deg, point" for way in ways),
        )


class AreaTable(Table):
    swath: Pair = Field(description="[near, far] slant range at t = 0, m")
    centre_yaw_deg: float | None = Field(
        None, ge=-720, le=720, description="yaw of the scene centre, degrees; default: the middle of the steering"
    )
    centre_range: Positive | None = Field(
        None, description="slant range of the scene centre at t = 0, m; default: the middle of the swath"
    )
    ground_height: float = Field(0.0, description="height of the ground plane, m")
    reference_range: Literal["constant", "scene_centre"] | Positive = Field(
        "constant",
        description="the range whose phase is removed: 'constant' (the scene centre's at t = 0), "
        "'scene_centre' (followed from pulse to pulse), or a number of m",
    )
    frame: str = Field("", description="name of the scene frame: collections of equal text are focused into one image")

    @model_validator(mode="after")
    def _check(self) -> Self:
        near, far = self.swath
        _require(0 < near < far, f"swath = [{near:g}, {far:g}]: must be [near, far] with 0 < near < far, m")
        return self


class TargetTable(Table):
    name: str = Field(min_length=1, description="name of the target")
    x: float | None = Field(None, description="scene-frame x, m")
    y: float | None = Field(None, description="scene-frame y, m")
    z: float | None = Field(None, description="scene-frame z, m; default: on the ground")
    range: Positive | None = Field(None, description="slant range at t = 0, m")
    yaw_deg: float | None = Field(None, description="yaw about the nadir at t = 0, degrees")
    ground_range_offset: float | None = Field(None, description="from the scene centre, away from the platform, m")
    cross_range_offset: float | None = Field(None, description="from the scene centre, towards larger yaw, m")
    amplitude: float = Field(1.0, ge=0, description="modulus of the reflectivity")
    phase_deg: float = Field(0.0, description="phase of the reflectivity, degrees")
    scattering: dict[str, Pair] = Field(
        {}, description="channel = [amplitude, phase_deg] that multiply the reflectivity; not into other channels"
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        ways = {("x", "y"), ("range", "yaw_deg"), ("ground_range_offset", "cross_range_offset")}
        present = tuple(_present(self, "x", "y", "range", "yaw_deg", "ground_range_offset", "cross_range_offset"))
        _require(
            present in ways,
            f"place of {self.name!r} = {', '.join(present) or 'nothing'}: give x + y, range + yaw_deg, or "
            "ground_range_offset + cross_range_offset",
        )
        return self

    @property
    def reflectivity(self) -> complex:
        return complex(self.amplitude * np.exp(1j * np.deg2rad(self.phase_deg)))


class MatrixTable(Table):
    """Unit targets about the scene centre: rows along ground range, columns across it, towards larger yaw."""

    rows: int = Field(ge=1, le=10_000, description="targets along ground range")
    columns: int = Field(ge=1, le=10_000, description="targets across it")
    spacing: Pair | None = Field(None, description="[along ground range, across it] from target to target, m")
    extent: Pair | None = Field(None, description="[along ground range, across it] from first to last target, m")
    amplitude: float = Field(1.0, ge=0, description="modulus of the reflectivity")
    names: dict[str, IndexPair] = Field({}, description="name = [row, column] counted from 0; others are Trc")

    @model_validator(mode="after")
    def _check(self) -> Self:
        present = _present(self, "spacing", "extent")
        _require(len(present) == 1, _either(present, "spacing (m)", "extent (m)"))
        size = self.spacing or self.extent or (0.0, 0.0)
        _require(min(size) > 0, f"{present[0]} = {list(size)}: both must be greater than 0 m")
        _require(
            self.rows * self.columns <= 10_000,
            f"rows x columns = {self.rows * self.columns}: at most 10000 targets; use clutter for more",
        )
        wrong = [
            f"names.{name} = [{row}, {column}]"
            for name, (row, column) in self.names.items()
            if not (0 <= row < self.rows and 0 <= column < self.columns)
        ]
        _require(not wrong, f"{', '.join(wrong)}: must lie in the {self.rows} x {self.columns} matrix, from [0, 0]")
        _require(len(set(self.names.values())) == len(self.names), f"names = {self.names}: two names for one target")
        return self

    def offsets(self) -> tuple[FloatArray, FloatArray]:
        """Return offsets (along ground range, across it) from the scene centre, m, row by row."""
        counts = (self.rows, self.columns)
        if self.spacing is not None:
            extents = [step * (count - 1) for step, count in zip(self.spacing, counts, strict=True)]
        else:
            extents = list(self.extent or ())
        axes = [
            np.linspace(-extent / 2, extent / 2, count) if count > 1 else np.zeros(1)
            for extent, count in zip(extents, counts, strict=True)
        ]
        along, across = np.meshgrid(*axes, indexing="ij")
        return along.ravel(), across.ravel()

    def labels(self) -> list[str]:
        """Return the targets' names, row by row."""
        named = {index: name for name, index in self.names.items()}
        digits = len(str(max(self.rows, self.columns) - 1))
        return [
            named.get((row, column), f"T{row:0{digits}}{column:0{digits}}")
            for row in range(self.rows)
            for column in range(self.columns)
        ]


class ClutterTable(Table):
    """A random field: scatterers uniform over the region's ground area, circular Gaussian reflectivity."""

    scatterers: int = Field(ge=1, le=20_000_000, description="number of scatterers, usually 1e5 to 1e6")
    seed: Seed = Field(description="seed of the random numbers")
    power: Positive = Field(1.0, description="mean of |reflectivity|^2 of one scatterer")
    range: Pair | None = Field(None, description="[near, far] slant range at t = 0, m; default: the swath")
    yaw_deg: Pair | None = Field(None, description="[first, last] yaw, degrees; default: all yaws that the beam lights")
    x: Pair | None = Field(None, description="[first, last] scene-frame x, m")
    y: Pair | None = Field(None, description="[first, last] scene-frame y, m")

    @model_validator(mode="after")
    def _check(self) -> Self:
        box, polar = _present(self, "x", "y"), _present(self, "range", "yaw_deg")
        _require(not (box and polar), f"{', '.join(box + polar)} given: give a box x + y, or range + yaw_deg")
        _require(len(box) != 1, f"{''.join(box)} given alone: a box needs x and y")
        for name in box + polar:
            first, last = getattr(self, name)
            _require(first < last, f"{name} = [{first:g}, {last:g}]: must ascend")
        return self


class ReflectivityTable(Table):
    """A reflectivity map: pixel [row, column] is a scatterer at x = x0 + dx column, y = y0 + dy row."""

    file: str = Field(description=".npy file of a 2-D real or complex array; relative to the scene file")
    x0: float = Field(description="x of the first column, m")
    dx: float = Field(description="step from column to column, m")
    y0: float = Field(description="y of the first row, m")
    dy: float = Field(description="step from row to row, m")
    seed: Seed | None = Field(None, description="seed of a random phase per pixel; left out: phases as in the file")

    @model_validator(mode="after")
    def _check(self, info: ValidationInfo) -> Self:
        for name in ("dx", "dy"):
            _require(getattr(self, name) != 0, f"{name} = 0: must be a step other than 0 m")
        path = _beside(self.file, info)
        try:
            pixels = np.lib.format.open_memmap(path, mode="r")
        except (OSError, ValueError, OverflowError) as error:
            raise ValueError(f"file = {self.file!r}: must be a readable .npy file ({error})") from None
        _require(
            pixels.ndim == 2 and pixels.dtype.kind in "uifc" and pixels.size > 0,
            f"file = {self.file!r}: must hold a 2-D real or complex array",
        )
        _require(bool(np.isfinite(pixels).all()), f"file = {self.file!r}: must hold finite numbers only")
        object.__setattr__(self, "file", str(path))
        return self


class NoiseTable(Table):
    """Circular Gaussian noise: E|n|^2 = power in each sample.

    A target of unit amplitude has modulus 1 in each sample, so its signal-to-noise ratio is 1 / power in one sample,
    and (lit pulses x range frequencies) / power in the image.
    """

    power: float = Field(
        ge=0, le=NOISE_POWERS[1], description="mean |noise|^2 per sample, relative to a target of unit amplitude"
    )
    seed: Seed = Field(description="seed of the random numbers")


class DroppedTable(Table):
    """Lost pulses: rows of NaN."""

    pulses: Annotated[tuple[int, ...], Field(strict=False)] = Field((), description="indices of pulses, from 0")
    ranges: Annotated[tuple[IndexPair, ...], Field(strict=False)] = Field(
        (), description="[first, last] indices, both inclusive"
    )
    fraction: float = Field(0.0, ge=0, lt=1, description="fraction of all pulses, chosen at random")
    seed: Seed | None = Field(None, description="seed of the random choice; needed with fraction")

    @model_validator(mode="after")
    def _check(self) -> Self:
        _require(self.fraction == 0 or self.seed is not None, "seed missing: fraction needs one")
        for first, last in self.ranges:
            _require(first <= last, f"ranges = [{first}, {last}]: must be [first, last] with first <= last")
        return self


def _check_states(rows: FloatArray) -> None:
    """Raise a ValueError if velocities do not match positions: other units, or axes that rotate."""
    mean = np.diff(rows[:, 1:4], axis=0) / np.diff(rows[:, 0])[:, None]
    apart = np.sqrt((((rows[1:, 4:] + rows[:-1, 4:]) / 2 - mean) ** 2).sum(axis=1))
    speed = np.sqrt((mean**2).sum(axis=1))
    worst = int((apart / np.maximum(speed, 1e-9)).argmax())
    _require(
        bool(apart[worst] <= STATE_ERROR * speed[worst]),
        f"states[{worst}]: the velocity differs by {apart[worst]:.4g} m/s from that of the positions, "
        f"{speed[worst]:.6g} m/s: must be in m/s, and in the axes of the positions (Earth-fixed, if earth_centred)",
    )


def _beside(file: str, info: ValidationInfo) -> Path:
    """Resolve the path of a file relative to the scene file that names it."""
    folder = (info.context or {}).get("folder")
    path = Path(file) if folder is None else Path(folder) / file
    _require(not os.path.lexists(path) or os.path.isfile(path), f"file = {file!r}: must be a regular file")
    return path


def _header_lines(path: Path) -> int:
    """Return 1 if the first line of a CSV holds names instead of numbers, else 0."""
    with path.open(encoding="utf-8") as lines:
        first = lines.readline().split(",")[0].strip()
    try:
        float(first)
    except ValueError:
        return 0 if first.startswith("#") else 1
    return 0
