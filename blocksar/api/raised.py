"""Targets off the ground, where an image of the ground shows them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.collection.beam import aperture, dwell
from blocksar.collection.geometry import Geometry
from blocksar.measurement.targets import Target
from blocksar.runs.finished import FinishedRun

RAISED = 0.01  # m over or under the ground
STEPS, STEP = 12, 1.0  # of Newton's method, and m over which it takes slopes


def seen_places(run: FinishedRun, targets: Sequence[Target]) -> list[Target]:
    """The targets, those off the ground moved to the ground with their range and Doppler at the middle of the dwell.

    They stay where they are if there is no such ground, or it has no height.
    """
    return [_seen(run.geometry_at(target.x, target.y), target) for target in targets]


def raised_line(listed: Sequence[Target], seen: Sequence[Target]) -> list[str]:
    """A sentence that names targets that were moved; none if there are none."""
    moved = [(a, float(np.hypot(a.x - b.x, a.y - b.y))) for a, b in zip(listed, seen, strict=True) if a.z != b.z]
    if not moved:
        return []
    named = ", ".join(f"{target.name} {way:.3g} m" for target, way in moved[:5])
    return [
        f"off the ground, and measured where the ground has their range and Doppler: {len(moved)} of {len(listed)} "
        f"targets (away by: {named}{', ...' if len(moved) > 5 else ''})"
    ]


def _seen(geometry: Geometry, target: Target) -> Target:
    at = np.array([target.x, target.y])
    ground = float(geometry.height(*at))
    if target.z is None or not abs(target.z - ground) > RAISED:
        return target
    first, last = dwell(geometry, *at)
    time = np.clip((first + last) / 2 if first < last else np.array(geometry.epoch), *aperture(geometry.collection))

    def look(xy: FloatArray) -> FloatArray:
        return np.array(geometry.range_history(geometry.on_ground(xy[0], xy[1]), time))

    wanted = np.array(geometry.range_history(np.array([*at, target.z]), time))
    for _ in range(STEPS):
        here = look(at)
        along = [(look(at + STEP * unit) - here) / STEP for unit in np.eye(2)]
        a, b, c, d = along[0][0], along[1][0], along[0][1], along[1][1]  # rows: range and its rate
        left, determinant = wanted - here, a * d - b * c
        if not abs(determinant) > 0:
            return target
        move = np.array([d * left[0] - b * left[1], a * left[1] - c * left[0]]) / determinant
        at = at + np.clip(move, -abs(target.z - ground) - STEP, abs(target.z - ground) + STEP)
    found = look(at)
    if not np.abs(found - wanted)[0] < 1e-3:
        return target
    return target._replace(x=float(at[0]), y=float(at[1]), z=None)
