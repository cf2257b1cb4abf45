"""Predicted size of a run on the disk."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

import numpy as np

from blocksar.collection.grid import Grid
from blocksar.collection.terrain import Terrain
from blocksar.focusing.ground_map import GroundMap
from blocksar.planning.plan import Plan
from blocksar.planning.tiling import image_chunk, touched_chunks

SAMPLE = 8  # bytes of a sample or pixel, complex64
LAYER_SAMPLE = 4  # bytes of a height or an angle, float32, which hardly compress; visibility does
NOISE_SAMPLE = 1  # bytes at most of the noise of a pixel, which is smooth: float32 of few bits, compressed
POINTS = 40_000  # at about so many points of the grid, ownership is asked


def run_bytes(plan: Plan) -> dict[str, int]:
    """Bytes that a run by a plan writes, by store: the spectrum, the blocks' patches, and what is merged from these.

    Pixels that are not covered take no room. An image's chunk that only one block touches is that of its patch: the two
    share their storage, on file systems with hard links. The noise of the image is there where that of the samples is
    known.
    """
    grounds = [block.ground for block in plan.blocks]
    touching = Counter(cell for ground in grounds for cell in touched_chunks(ground, plan.grid))
    covered = covered_pixels(grounds, plan.grid)
    merged = sum(count > 1 for count in touching.values()) * math.prod(image_chunk(plan.grid))
    gated = 0
    for block in plan.blocks:
        if block.range_gate is not None:
            first, last = plan.gated_bins(block)
            gated += SAMPLE * (last - first) * block.sampling.range_frequency.size
    return {
        "spectrum": SAMPLE * plan.recovery.doppler.size * plan.geometry.collection.n_range_frequency,
        **({"gated": gated} if gated else {}),
        "patches": SAMPLE * covered,
        "image": SAMPLE * min(merged, covered),
        **_on_terrain(plan, touched=len(touching), covered=covered),
        **({"noise": NOISE_SAMPLE * covered} if plan.geometry.collection.noise_power else {}),
    }


def exact_bytes(grid: Grid, terrain: Terrain | None, *, noise: bool) -> dict[str, int]:
    """Bytes that exact back-projection writes at most, by store: what lies in a grid, all of it covered."""
    pixels = math.prod(grid.shape)
    layers = {} if terrain is None else {"terrain": terrain.heights.nbytes, "layers": 2 * LAYER_SAMPLE * pixels}
    return {"image": SAMPLE * pixels, **layers, **({"noise": NOISE_SAMPLE * pixels} if noise else {})}


def _on_terrain(plan: Plan, *, touched: int, covered: int) -> dict[str, int]:
    """Bytes of the terrain's samples and of the layers of an image on it; nothing on the plane."""
    terrain = plan.geometry.terrain
    if terrain is None:
        return {}
    heights = min(touched * math.prod(image_chunk(plan.grid)), math.prod(plan.grid.shape))
    return {"terrain": terrain.heights.nbytes, "layers": LAYER_SAMPLE * (heights + covered)}


def covered_pixels(grounds: Sequence[GroundMap], grid: Grid) -> int:
    """Number of pixels that the blocks own, from every n-th row and column."""
    step = max(math.isqrt(math.prod(grid.shape) // POINTS), 1)
    x, y = np.meshgrid(grid.x[step // 2 :: step], grid.y[step // 2 :: step])
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
    return round(float(owned.mean()) * math.prod(grid.shape)) if owned.size else 0
