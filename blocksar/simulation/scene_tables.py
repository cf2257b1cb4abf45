"""All tables of a scene file, checks of one against another, and channels such as polarisations."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import Annotated, Any, Protocol, Self, TypeVar

import numpy as np
from pydantic import Field, model_validator

from blocksar.collection.georeference import Georeference
from blocksar.errors import InputError
from blocksar.simulation.scene_fields import (
    MAX_PULSES,
    AreaTable,
    BeamTable,
    ClutterTable,
    DroppedTable,
    MatrixTable,
    NoiseTable,
    RadarTable,
    ReflectivityTable,
    Table,
    TargetTable,
    TimeTable,
    TrackTable,
)
from blocksar.simulation.scene_ground import TerrainTable
from blocksar.stores import check_channels

# ---------------------------------------------------------------- channels


class WithChannels(Protocol):
    """Interface of a scene for its channels."""

    @property
    def channels(self) -> tuple[str, ...]: ...

    @property
    def targets(self) -> tuple[TargetTable, ...]: ...

    def model_copy(self, *, update: Mapping[str, Any]) -> Self: ...


S = TypeVar("S", bound=WithChannels)


def channel_problems(scene: WithChannels) -> Iterator[str]:
    """List errors in the channels of a scene."""
    try:
        known = check_channels(scene.channels) if scene.channels else ()
    except InputError as error:
        yield str(error).replace("channel ", "channels: ", 1)
        return
    for i, target in enumerate(scene.targets):
        for name in target.scattering:
            if name not in known:
                yield f"targets[{i}].scattering.{name}: must be one of channels ({', '.join(known) or 'none given'})"


def factor(target: TargetTable, channel: str) -> complex:
    """Factor of a target's reflectivity in a channel: 1 if none is stated, 0 if only other channels are stated."""
    if not target.scattering:
        return 1.0
    amplitude, phase_deg = target.scattering.get(channel, (0.0, 0.0))
    return complex(amplitude * np.exp(1j * np.deg2rad(phase_deg)))


def of_channel(scene: S, number: int) -> S:
    """The scene as seen by one channel; clutter and noise of different channels are independent."""
    if not scene.channels:
        return scene
    changes: dict[str, Any] = {
        "channels": (),
        "targets": tuple(_seen(t, scene.channels[number]) for t in scene.targets),
    }
    for name in ("clutter", "noise"):
        table = getattr(scene, name)
        if table is not None:
            changes[name] = table.model_copy(update={"seed": (table.seed or 0) + number})
    return scene.model_copy(update=changes)


def _seen(target: TargetTable, channel: str) -> TargetTable:
    sigma = target.reflectivity * factor(target, channel)
    polar = {"amplitude": float(abs(sigma)), "phase_deg": float(np.degrees(np.angle(sigma)))}
    return target if not target.scattering else target.model_copy(update=polar)


# ---------------------------------------------------------------- tables


class GeoreferenceTable(Table):
    """Position of the frame's origin x = y = z = 0 on the Earth, and rotation of its axes."""

    latitude: float = Field(description="of the frame's origin, geodetic, WGS 84, degrees")
    longitude: float = Field(description="of the frame's origin, degrees")
    height: float = Field(0.0, description="of the frame's origin above the WGS 84 ellipsoid, m")
    rotation_deg: float = Field(0.0, description="x axis from east, counter-clockwise seen from above, degrees")

    @model_validator(mode="after")
    def _check(self) -> Self:
        try:
            self.frame  # noqa: B018 - checks its numbers
        except InputError as error:
            raise ValueError(str(error).removeprefix("georeference: ").partition(";")[0]) from None
        return self

    @cached_property
    def frame(self) -> Georeference:
        return Georeference(
            latitude=self.latitude, longitude=self.longitude, height=self.height, rotation=self.rotation_deg
        )


class SceneTables(Table):
    """Tables of a scene file."""

    title: str = Field("", description="one line about the scene")
    radar: RadarTable = Field(description="the table of the radar")
    track: TrackTable = Field(description="the table of the platform's track")
    place: GeoreferenceTable | None = Field(None, alias="georeference", description="where the frame lies on the Earth")
    time: TimeTable = Field(description="the table of the pulses' time")
    beam: BeamTable | None = Field(None, description="the table of the steered beam")
    area: AreaTable = Field(alias="scene", description="the table of swath and centre")
    channels: Annotated[tuple[str, ...], Field(strict=False)] = Field((), description="names, such as HH and HV")
    targets: Annotated[tuple[TargetTable, ...], Field(strict=False)] = Field((), description="point targets")
    ground: TerrainTable | None = Field(None, alias="terrain", description="the table of the ground's height")
    matrix: MatrixTable | None = Field(None, description="a matrix of point targets")
    clutter: ClutterTable | None = Field(None, description="a random field")
    reflectivity: ReflectivityTable | None = Field(None, description="a reflectivity map")
    noise: NoiseTable | None = Field(None, description="receiver noise")
    dropped: DroppedTable | None = Field(None, description="lost pulses")

    @property
    def n_pulse(self) -> int:
        if self.time.pulses is not None:
            return self.time.pulses
        return round((self.time.duration or 0.0) * self.radar.prf)

    @property
    def beam_width_deg(self) -> float:
        beam = self.beam
        if beam is None:
            return 360.0
        if beam.width_deg is not None:
            return beam.width_deg
        rate = abs((beam.stop_deg or 0.0) - (beam.start_deg or 0.0)) * self.radar.prf / self.n_pulse
        return rate * (beam.dwell or 0.0)

    @property
    def georeference(self) -> Georeference | None:
        """Position of the frame on the Earth, if stated."""
        return None if self.place is None else self.place.frame

    @property
    def about_origin(self) -> bool:
        """Tell whether the scene centre is the frame's origin on the ground, by default with an Earth-centred track."""
        by_yaw = self.beam is not None and self.beam.mode is None
        stated = self.area.centre_yaw_deg is not None or self.area.centre_range is not None
        return self.track.earth_centred and not by_yaw and not stated

    def problems(self) -> Iterator[str]:
        """List keys that contradict each other, as `field = value: remedy`."""
        yield from channel_problems(self)
        if self.track.earth_centred and self.place is None:
            yield "georeference is missing: track.earth_centred = true needs it; add latitude, longitude and height"
        if (self.beam is None or self.beam.mode is not None) and self.area.centre_yaw_deg is None:
            kind = "without [beam]" if self.beam is None else "with beam.mode"
            if self.area.centre_range is not None or not self.track.earth_centred:
                yield f"scene.centre_yaw_deg is missing: a scene {kind} needs it"
        if self.ground is not None and self.place is None and (why := self.ground.needs_earth):
            yield f"georeference is missing: {why} needs it; add latitude, longitude and height"
        clutter = self.clutter
        if self.beam is None and clutter is not None and clutter.x is None and clutter.yaw_deg is None:
            yield "clutter.yaw_deg is missing: without [beam], give range + yaw_deg, or a box x + y"
        if not 8 <= (n := self.n_pulse) <= MAX_PULSES:
            yield f"time.duration = {self.time.duration:g}: gives {n} pulses; must give 8 to {MAX_PULSES}"
        if self.beam is not None and not 0 < self.beam_width_deg < 180:
            yield (
                f"beam.dwell = {self.beam.dwell}: gives a beam {self.beam_width_deg:.4g} degrees wide; "
                "must give less than 180"
            )
        if self.dropped is not None:
            lost = [*self.dropped.pulses, *(i for pair in self.dropped.ranges for i in pair)]
            wrong = sorted({i for i in lost if not 0 <= i < n})
            if wrong:
                yield f"dropped = {wrong[:5]}: must be indices of the {n} pulses, 0 to {n - 1}"
        names = Counter([target.name for target in self.targets] + (self.matrix.labels() if self.matrix else []))
        repeated = sorted(name for name, count in names.items() if count > 1)
        if repeated:
            yield f"targets = {repeated[:5]}: names must differ from target to target"
