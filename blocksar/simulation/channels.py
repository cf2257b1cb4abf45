"""Channels of a scene, such as polarisations: one geometry, and what each target scatters into each of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, Protocol, Self, TypeVar

import numpy as np

from blocksar.errors import InputError
from blocksar.stores import check_channels

if TYPE_CHECKING:
    from blocksar.simulation.tables import TargetTable


class Seen(Protocol):
    """Part of a scene that its channels need."""

    @property
    def channels(self) -> tuple[str, ...]: ...

    @property
    def targets(self) -> tuple[TargetTable, ...]: ...

    def model_copy(self, *, update: Mapping[str, Any]) -> Self: ...


S = TypeVar("S", bound=Seen)


def problems(scene: Seen) -> Iterator[str]:
    """List what is wrong with the channels of a scene."""
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
    """Factor of a target's reflectivity in a channel: 1 where none is stated, 0 where only others are."""
    if not target.scattering:
        return 1.0
    amplitude, phase_deg = target.scattering.get(channel, (0.0, 0.0))
    return complex(amplitude * np.exp(1j * np.deg2rad(phase_deg)))


def of_channel(scene: S, number: int) -> S:
    """The scene as one channel sees it; clutter and noise of different channels are independent."""
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
