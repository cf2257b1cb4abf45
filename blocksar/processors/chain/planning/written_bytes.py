"""Predicted size on the disk of what chains write: spectra, patches, and the image that is merged from these."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from blocksar.arrays import BoolArray, IntArray
from blocksar.chunks import SAMPLE, stored_bytes
from blocksar.collection.grid import Grid
from blocksar.planning.disk import beside_image, has_pyramid, pyramid_bytes
from blocksar.planning.tiling import image_chunk
from blocksar.processors.chain.ground.ground_map import GroundMap
from blocksar.processors.chain.ground.patches import touched_chunks
from blocksar.processors.chain.planning.plan import Plan

POINTS = 40_000  # number of grid points at which ownership is evaluated, about


def run_bytes(*plans: Plan) -> dict[str, int]:
    """Bytes that a run by plans writes, by store: spectra, patches of blocks, and what is merged from these.

    Pixels that are not covered take no room. An image's chunk that only one block touches is that of its patch: the two
    share their storage, on file systems with hard links. The noise of the image is there where that of the samples is
    known.
    """
    grid, collection = plans[0].grid, plans[0].geometry.collection
    touching = Counter(cell for plan in plans for block in plan.blocks for cell in touched_chunks(block.ground, grid))
    sampled = _Sampled.of(grid)
    owned = [sampled.owned([block.ground for block in plan.blocks]) for plan in plans]
    covered = np.logical_or.reduce(owned)
    merged = covered & sampled.within({cell for cell, count in touching.items() if count > 1})
    gated = 0
    for plan in plans:
        for block in plan.blocks:
            if block.range_gate is not None:
                first, last = plan.gated_bins(block)
                gated += stored_bytes((last - first, block.sampling.range_frequency.size), plan.gated_chunk(block))
    written = {
        "spectrum": sum(
            stored_bytes((plan.recovery.doppler.size, plan.geometry.collection.n_range_frequency), plan.spectrum_chunk)
            for plan in plans
        ),
        **({"gated": gated} if gated else {}),
        "patches": SAMPLE * sum(map(sampled.pixels, owned)),
        "image": SAMPLE * sampled.pixels(merged),
        **beside_image(
            plans[0].geometry.terrain,
            heights=min(len(touching) * math.prod(image_chunk(grid)), math.prod(grid.shape)),
            covered=sampled.pixels(covered),
            noise=bool(collection.noise_power),
        ),
    }
    return written | (pyramid_bytes(sampled.pixels(covered)) if has_pyramid(grid) else {})


class _Sampled(NamedTuple):
    """Every n-th row and column of a grid: their indices (n_row, 1) and (1, n_column)."""

    grid: Grid
    row: IntArray
    column: IntArray

    @classmethod
    def of(cls, grid: Grid) -> _Sampled:
        step = max(math.isqrt(math.prod(grid.shape) // POINTS), 1)
        n_row, n_column = grid.shape
        return cls(grid, np.arange(step // 2, n_row, step)[:, None], np.arange(step // 2, n_column, step)[None])

    def pixels(self, some: BoolArray) -> int:
        """Number of pixels of the grid that samples (n_row, n_column) stand for."""
        return round(float(some.mean()) * math.prod(self.grid.shape)) if some.size else 0

    def within(self, cells: set[tuple[int, int]]) -> BoolArray:
        """Mask of samples in chunks of the image, each given by its number along y and along x."""
        side = image_chunk(self.grid)
        chosen = np.zeros([-(-n // length) for n, length in zip(self.grid.shape, side, strict=True)], np.bool_)
        for cell in cells:
            chosen[cell] = True
        return chosen[self.row // side[0], self.column // side[1]]

    def owned(self, grounds: Sequence[GroundMap]) -> BoolArray:
        """Mask of samples that blocks own."""
        x, y = np.broadcast_arrays(self.grid.x[self.column], self.grid.y[self.row])
        geometry = grounds[0].geometry
        yaw, rng = geometry.yaw(x, y), geometry.epoch_range(x, y)
        owned = np.zeros(x.shape, np.bool_)
        for ground in grounds:
            turn = np.remainder(yaw - ground.middle_yaw + np.pi, 2 * np.pi) - np.pi
            inside = (abs(turn) <= (ground.high - ground.low) / 2) & (rng >= ground.near) & (rng < ground.far)
            at = ground.middle_yaw + turn[inside]
            limits = (np.interp(at, ground.yaw_axis, limit) for limit in (ground.near_limit, ground.far_limit))
            near, far = limits
            owned[inside] |= (rng[inside] >= near) & (rng[inside] <= far)
        return owned
