"""Predicted effort of a chain: seconds for every unit of its stages, see `planning.effort`.

The constants are from the receipts of `table1`, also over hills, on the machine of those there.
"""

from __future__ import annotations

from collections import Counter

import numpy as np

from blocksar.chunks import MOSAIC_CHUNKS
from blocksar.planning.effort import FINISH, of_layers
from blocksar.planning.tiling import image_chunk
from blocksar.processors.chain.ground.patches import touched_chunks
from blocksar.processors.chain.planning.plan import Plan, block_work
from blocksar.progress import Work

RECOVER = 3.2e-8  # per written sample of the spectrum
GATE = 2.6e-8  # per written sample of a range sub-block
STEPS = 8.5e-11  # per operation of the blocks' transforms and resamplings, as Plan.work counts them
CORRECT = 2.7e-8  # per written pixel of a patch's chunks
ON_TERRAIN = 1.3e-8  # more on a terrain: heights, and their part of the correction
ELEVATION = 5e-7  # more with a pattern in elevation, whose means it divides by
MERGE = 1.3e-8  # per merged pixel of a patch's chunk


def of_plan(plan: Plan) -> Work:
    """Work of focusing by a plan, without that of a raw echo."""
    collection, side = plan.geometry.collection, image_chunk(plan.grid)
    written = CORRECT
    written += 0.0 if plan.geometry.terrain is None else ON_TERRAIN
    written += 0.0 if collection.elevation_pattern is None else ELEVATION
    columns = np.diff([*range(0, collection.n_range_frequency, plan.column_group), collection.n_range_frequency])
    chunks = [touched_chunks(block.ground, plan.grid) for block in plan.blocks]
    patches = Counter(chunk for touched in chunks for chunk in touched)  # by chunk of the mosaic
    merged = [patches[chunk] for chunk in sorted(patches) if patches[chunk] > 1]
    layered = 0 if plan.geometry.terrain is None else len(patches)
    stages = {
        "recover": (RECOVER * plan.recovery.doppler.size * columns).tolist(),
        **_gating(plan),
        "focus": [
            STEPS * block_work(block) + written * len(touched) * side[0] * side[1]
            for block, touched in zip(plan.blocks, chunks, strict=True)
        ],
        "mosaic": [
            MERGE * sum(merged[first : first + MOSAIC_CHUNKS]) * side[0] * side[1]
            for first in range(0, len(merged), MOSAIC_CHUNKS)
        ],
        **of_layers(layered, side),
    }
    return stages | {"finish": [FINISH]}


def _gating(plan: Plan) -> dict[str, list[float]]:
    """Work of the range gates; empty without sub-blocks."""
    groups = plan.gate_spans()
    seconds = STEPS * plan.gate_work() + GATE * plan.gated_samples()
    return {"gate": [seconds / len(groups)] * len(groups)} if groups else {}
