"""Targets of a run that lie in the shadow of its terrain."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from blocksar.kernels.occlusion import SHADOW
from blocksar.measurement.targets import Target
from blocksar.runs.finished import FinishedRun

RAISED = 1.0  # m over the ground, from which on the ground's shadow is not the target's


def in_shadow(run: FinishedRun, targets: Sequence[Target]) -> list[bool]:
    """Whether the image has shadow at the targets, at the middle of the dwell."""
    terrain = run.geometry.terrain
    if terrain is None or not (run.image / "visibility" / "zarr.json").exists():
        return [False] * len(targets)
    hidden = []
    for target in targets:
        row, column = run.pixel_at(target.x, target.y)
        ground = float(terrain(np.array(target.x), np.array(target.y)))
        if run.inside(row, column) and (target.z is None or target.z < ground + RAISED):
            seen = run.read_layer("visibility", slice(row, row + 1), slice(column, column + 1))
            hidden.append(int(seen[0, 0]) == SHADOW)
        else:
            hidden.append(False)
    return hidden
