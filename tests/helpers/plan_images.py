"""Images that a plan's chains form in one process, without stores and tasks."""

from __future__ import annotations

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.processors.chain.ground.correction import correct
from blocksar.processors.chain.planning.plan import Plan
from blocksar.processors.chain.steps.recovery import recover_columns


def focus(plan: Plan, signal: ComplexArray, z: FloatArray | None = None) -> ComplexArray:
    """All blocks of a plan, on its grid; on a terrain z (n_y, n_x) has the heights of its pixels, m."""
    frequency, grid = plan.geometry.collection.range_frequency, plan.grid
    spectrum = recover_columns(signal, range_frequency=frequency, recovery=plan.recovery, threads=2)
    image = np.full(grid.shape, np.nan, np.complex64)
    for block in plan.blocks:
        slab = np.ascontiguousarray(spectrum[block.first_bin : block.first_bin + block.n_bin].T)
        for step in block.chain:
            slab = step.apply(slab, threads=2)
        part = correct(np.ascontiguousarray(slab), block.ground, x=grid.x, y=grid.y, z=z, threads=2)
        image[~np.isnan(part)] = part[~np.isnan(part)]
    return image
