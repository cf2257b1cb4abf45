"""What the stages of a command cost: predicted seconds of every unit of work, for `progress.Estimate`.

Only ratios between stages matter, the pace is measured while a command runs. The constants below are CPU seconds of
one thread on one core of a virtual machine (Xeon with AVX-512). Those of recovery, steps, correction and mosaic were
measured task by task with time.process_time on `table1`, in three and in eight blocks; those of compressing, inspecting
and back-projecting are estimates, each of which matters only beside the others of its own command.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace

import numpy as np

from blocksar.chunks import MOSAIC_CHUNKS, TILE
from blocksar.collection.beam import dwell
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.focusing.correction import covers
from blocksar.planning.block import BlockPlan
from blocksar.planning.plan import Plan
from blocksar.planning.tiling import image_chunk, inspection_width, patch_window
from blocksar.progress import Work

COMPRESS = 6e-8  # a sample of the echo
RECOVER = 4.8e-8  # a sample of the spectrum, written
STEPS = 1.3e-10  # an operation of the blocks' transforms and resamplings, as Plan.work counts them
CORRECT = 3.6e-8  # a pixel of a patch's chunks, written
MERGE = 1.13e-8  # a pixel of a patch's chunk, merged
INSPECT = 2e-8  # a sample
BACK_PROJECT = 8e-9  # a lit pulse of a pixel
FINISH = 1.4  # the cluster ends, and what was written is on the disk

# `blocksar demo` has to know what is to come before there is a plan: seconds of its stages on two cores there.
DEMO = {
    "simulate": 0.6,
    "plan": 1.0,
    "compile": 0.1,
    "start-workers": 2.5,
    "recover": 1.4,
    "focus": 4.4,
    "mosaic": 0.8,
    "finish": 1.4,
    "measure": 2.4,
    "draw": 8.0,
    "report": 2.7,
    "responses": 6.0,
}
MOST_CHUNKS = 2000  # of a patch, that are looked at one by one
COMPILE = 13.0  # where no kernel is in numba's cache yet
FOCUS: Work = dict.fromkeys(("plan", "compile", "start-workers", "recover", "focus", "mosaic", "finish"), ())


def of_plan(plan: Plan, *, echo_samples: int = 0) -> Work:
    """Of focusing by a plan; `echo_samples` (in all) where the phase history is a raw echo."""
    collection, side = plan.geometry.collection, image_chunk(plan.grid)
    columns = np.diff([*range(0, collection.n_range_frequency, plan.column_group), collection.n_range_frequency])
    chunks = [touched_chunks(block, plan.grid) for block in plan.blocks]
    patches = Counter(chunk for touched in chunks for chunk in touched)  # by chunk of the mosaic
    merged = [patches[chunk] for chunk in sorted(patches)]
    stages = {
        "recover": (RECOVER * plan.recovery.doppler.size * columns).tolist(),
        "focus": [
            STEPS * replace(plan, blocks=(block,)).work() + CORRECT * len(touched) * side[0] * side[1]
            for block, touched in zip(plan.blocks, chunks, strict=True)
        ],
        "mosaic": [
            MERGE * sum(merged[first : first + MOSAIC_CHUNKS]) * side[0] * side[1]
            for first in range(0, len(merged), MOSAIC_CHUNKS)
        ],
    }
    return _compressed(collection.n_pulse, echo_samples) | stages | {"finish": [FINISH]}


def of_backprojection(geometry: Geometry, grid: Grid, *, echo_samples: int = 0) -> Work:
    """Of exact back-projection."""
    collection = geometry.collection
    looks = math.ceil(collection.n_range_frequency / inspection_width(collection))
    inspect = INSPECT * collection.n_pulse * collection.n_range_frequency
    stages = {"inspect": [inspect / looks] * looks, "backprojection": _by_chunk(geometry, grid)}
    return _compressed(collection.n_pulse, echo_samples) | stages | {"finish": [FINISH]}


def of_demo(*, simulated: bool, compiled: bool) -> Work:
    """Of `blocksar demo`, where the phase history and the compiled kernels may be there already."""
    seconds = DEMO if compiled else DEMO | {"compile": COMPILE}
    return {stage: [cost] for stage, cost in seconds.items() if not (simulated and stage == "simulate")}


def touched_chunks(block: BlockPlan, grid: Grid) -> list[tuple[int, int]]:
    """The chunks of the image, by row and column of chunks, that a block writes; of very many, all of its patch."""
    first_y, first_x, n_y, n_x = patch_window(block.ground, grid)
    side = image_chunk(grid)
    rows, columns = (
        range(first, first + n, s) for first, n, s in zip((first_y, first_x), (n_y, n_x), side, strict=True)
    )
    many = len(rows) * len(columns) > MOST_CHUNKS
    return [
        (y // side[0], x // side[1])
        for y in rows
        for x in columns
        if many or covers(block.ground, x=grid.x[x : x + side[1]], y=grid.y[y : y + side[0]])
    ]


def _compressed(n_pulse: int, echo_samples: int) -> dict[str, list[float]]:
    if not echo_samples:
        return {}
    groups = math.ceil(n_pulse / TILE[0])
    return {"range-compress": [COMPRESS * echo_samples / groups] * groups}


def _by_chunk(geometry: Geometry, grid: Grid) -> list[float]:
    """Lit pulses of all pixels, chunk by chunk, from a few points of each."""
    side, interval = image_chunk(grid), geometry.collection.pulse_interval
    costs = []
    for row in range(0, grid.shape[0], side[0]):
        for column in range(0, grid.shape[1], side[1]):
            y, x = grid.y[row : row + side[0]], grid.x[column : column + side[1]]
            mesh = np.meshgrid(x[:: max(x.size // 8, 1)], y[:: max(y.size // 8, 1)])
            start, end = dwell(geometry, *mesh)
            lit = np.maximum(end - start, 0.0).mean() / interval
            costs.append(BACK_PROJECT * x.size * y.size * max(float(lit), 1.0))
    return costs
