"""Images that a plan's chains form in one process, without stores and tasks."""

from __future__ import annotations

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.focusing.correction import correct
from blocksar.focusing.dwell_edges import add_edges, edge_profiles, take_unlit
from blocksar.focusing.recovery import recover_columns
from blocksar.planning.plan import Plan


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
        kept = edge_profiles(
            lambda pulses: signal[pulses], plan.geometry.collection, plan.weighting, fade=plan.fade, threads=2
        )
        if plan.stays:
            take_unlit(
                part, kept, block.ground.geometry, x=grid.x, y=grid.y, total=block.ground.lit_at,
                valid=np.ones(signal.shape[0]), weighting=plan.weighting, height=z, threads=2,
            )  # fmt: skip
        if plan.fade:
            lit = block.ground.lit_at(*np.meshgrid(grid.x, grid.y), z)
            add_edges(
                part, kept, plan.gated.over(block.ground.geometry), x=grid.x, y=grid.y, lit=lit,
                valid=np.ones(signal.shape[0]), fade=plan.fade, weighting=plan.weighting, height=z, threads=2,
                wobbling=block.ground.geometry if plan.gated.wobbles else None,
            )  # fmt: skip
        image[~np.isnan(part)] = part[~np.isnan(part)]
    return image
