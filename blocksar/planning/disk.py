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
    chunk = math.prod(image_chunk(plan.grid))
    merged = sum(count > 1 for count in touching.values()) * chunk
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
        **_beside(
            plan.geometry.terrain,
            heights=min(len(touching) * chunk, math.prod(plan.grid.shape)),
            covered=covered,
            noise=bool(plan.geometry.collection.noise_power),
        ),
    }


def exact_bytes(grid: Grid, terrain: Terrain | None, *, noise: bool) -> dict[str, int]:
    """Bytes that exact back-projection writes at most, by store: what lies in a grid, all of it covered."""
    pixels = math.prod(grid.shape)
    return {"image": SAMPLE * pixels, **_beside(terrain, heights=pixels, covered=pixels, noise=noise)}


def _beside(terrain: Terrain | None, *, heights: int, covered: int, noise: bool) -> dict[str, int]:
    """Bytes of what lies beside an image: the terrain's samples and the layers of pixels on it, and the noise."""
    layers = (
        {} if terrain is None else {"terrain": terrain.heights.nbytes, "layers": LAYER_SAMPLE * (heights + covered)}
    )
    return {**layers, **({"noise": NOISE_SAMPLE * covered} if noise else {})}


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
