"""Small collections and scenes whose beam turns about the antenna's own axis."""

from __future__ import annotations

from typing import Any

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.collection.collection import Collection

# Steering at t = 0 (rad) and its rate (rad/s). The line of sight to (9 km, 0) turns by 0.02 rad/s against the track.
MODES = {
    "stripmap": (0.0, 0.0),
    "squinted": (0.25, 0.0),
    "sliding spotlight": (0.0, -0.003),
    "tops": (0.0, 0.02),
    "scanned backwards": (0.0, -0.055),
}


def axis_collection(mode: str = "stripmap", *, n_pulse: int = 400, **changes: Any) -> Collection:
    """A pass of 250 m along y, 4 km high; targets near (9 km, 0), or ahead of it where the beam is squinted."""
    n_frequency, prf = 96, n_pulse / 1.25
    time = (np.arange(n_pulse) - n_pulse // 2) / prf
    track = np.stack([0.4 * time**2, 200 * time + 0.5 * time**2, 4000 - time**2], axis=1)
    velocity = np.gradient(track, time, axis=0)
    steering, rate = MODES[mode]
    return Collection(**{
        "carrier": 9.6e9,
        "time": time,
        "range_frequency": (np.arange(n_frequency) - n_frequency // 2) * 400e3,
        "reference_range": np.full(n_pulse, float(np.hypot(9000, 4000) / np.cos(steering))),
        "antenna_position": track,
        "beam_azimuth": np.full(n_pulse, np.nan),
        "beam_width": 0.01,
        "beam_axis": velocity / np.linalg.norm(velocity, axis=1, keepdims=True),
        "beam_steering": steering + rate * time,
        **changes,
    })  # fmt: skip


def spotlight(**changes: Any) -> Collection:
    """A beam that stays on (9 km, 0): offsets of points about it turn back."""
    n_pulse = changes.pop("n_pulse", 400)
    c = axis_collection(n_pulse=n_pulse)
    sight = np.array([9000.0, 0.0, 0.0]) - c.antenna_position
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    assert c.beam_axis is not None
    return axis_collection(n_pulse=n_pulse, beam_steering=np.arcsin((sight * c.beam_axis).sum(axis=1)), **changes)


AXIS_SCENE: dict[str, Any] = {
    "bandwidth": 40e6,
    "range_sampling": 50e6,
    "prf": 320,
    "pulse_width": 2e-6,
    "height": 4000.0,
    "velocity": [0.0, 200.0, -2.0],
    "acceleration": [0.2, 0.5, 0.0],
    "time": "pulses = 601",
    "yaw": 0.0,
    "swath": [9700.0, 10000.0],
    "more": "",
}


def axis_scene(beam: str, **changes: Any) -> str:
    """The text of a scene file with the lines `beam` of its table [beam]."""
    s = {**AXIS_SCENE, **changes}
    lines = ['title = "test"', "[radar]", "carrier = 9.6e9"]
    lines += [f"{name} = {s[name]}" for name in ("bandwidth", "range_sampling", "prf", "pulse_width")]
    lines += ["[track]", f"position = [0.0, 0.0, {s['height']}]"]
    lines += [f"{name} = {s[name]}" for name in ("velocity", "acceleration")]
    lines += ["[time]", s["time"], "[beam]", beam, "[scene]", f"swath = {s['swath']}", f"centre_yaw_deg = {s['yaw']}"]
    return "\n".join([*lines, s["more"], ""])


BOOM = {"circle": 2 * np.pi, "arc": 2.4}  # rad, by which it turns


def boom(kind: str, side: str, *, backwards: bool = False) -> tuple[Collection, FloatArray]:
    """An antenna that turns counter-clockwise on a boom of 1.5 m about the origin, 3 m above the ground at z = 0.

    It looks outwards (right of its way) or inwards; the axis lies along its way, or `backwards`. Also returns where it
    looks, level unit vectors (n_pulse, 2).
    """
    turn = BOOM[kind]
    n = round(360 * turn / (2 * np.pi))
    angle = turn * (np.arange(n) / n - 0.5)
    outward = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    along = np.stack([-np.sin(angle), np.cos(angle), np.zeros(n)], axis=1)
    collection = Collection(
        carrier=5e9, time=(np.arange(n) - n // 2) / 10.0, range_frequency=(np.arange(128) - 64) * 1.5e6,
        reference_range=np.full(n, 30.0), antenna_position=np.column_stack([1.5 * outward, np.full(n, 3.0)]),
        beam_azimuth=np.full(n, np.nan), beam_axis=-along if backwards else along, beam_steering=np.zeros(n),
        beam_width=np.pi / 3, side_of_track=side,
    )  # fmt: skip
    return collection, outward if side == "right" else -outward


def with_patterns(collection: Collection) -> Collection:
    """The same with a pattern over the beam and one over elevation."""
    half = (collection.beam_width or 0.0) / 2
    offset, elevation = np.linspace(-1.1 * half, 1.1 * half, 65), np.linspace(0.3, 0.6, 17)
    patterns = {
        "beam_offset": offset,
        "beam_pattern": np.exp(-0.6 * (offset / half) ** 2),
        "elevation": elevation,
        "elevation_pattern": 0.5 + elevation,
    }
    return Collection(**{**collection.as_dict(), **patterns})
