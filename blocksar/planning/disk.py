"""Predicted disk space of a run."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from blocksar.arrays import BoolArray, IntArray
from blocksar.chunks import IMAGE_CHUNK, PYRAMID_FROM, SAMPLE, stored_bytes
from blocksar.collection.grid import Grid
from blocksar.collection.terrain import Terrain
from blocksar.planning.tiling import image_chunk, touched_chunks
from blocksar.processors.chain.ground.ground_map import GroundMap
from blocksar.processors.chain.planning.plan import Plan

CELL = 4  # bytes of a cell of a pyramid, a height or an angle: float32, which hardly compress; visibility does
POINTS = 40_000  # number of grid points at which ownership is evaluated, about
SPECTRA = ("spectrum", "gated")  # stores removed before the mosaic by a run that discards intermediate results


class Room(NamedTuple):
    """Disk space of a run, bytes: at most until its input is read, and once it is finished."""

    reading: int
    most: int
    left: int


def room_of_run(stores: Mapping[str, int], *, beside: int, temporary: int, discard: bool) -> Room:
    """Disk space of a run that writes `stores`, bytes by name, as `run_bytes` or `exact_bytes` return them.

    Parameters
    ----------
    beside, temporary : int
        Bytes of what a run writes before these, and keeps or removes at its end.
    discard : bool
        Whether it removes spectra and patches once it does not need them.
    """
    spectra = sum(stores.get(name, 0) for name in SPECTRA)
    pixels = sum(stores.values()) - spectra - (stores["image"] if "patches" in stores else 0)
    merged = sum(stores.values()) - spectra - pixels
    before = beside + temporary
    focused = before + spectra + pixels
    end = before + pixels + merged + (0 if discard else spectra)
    left = end - temporary - (0 if discard else stores.get("gated", 0)) - (merged if discard else 0)
    return Room(before + spectra, max(focused, end), left)


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
        **_beside(
            plans[0].geometry.terrain,
            heights=min(len(touching) * math.prod(image_chunk(grid)), math.prod(grid.shape)),
            covered=sampled.pixels(covered),
            noise=bool(collection.noise_power),
        ),
    }
    return written | (_pyramid(sampled.pixels(covered)) if has_pyramid(grid) else {})


def exact_bytes(grid: Grid, terrain: Terrain | None, *, noise: bool) -> dict[str, int]:
    """Bytes that exact back-projection writes at most, by store, for a fully covered grid."""
    pixels = math.prod(grid.shape)
    written = {"image": SAMPLE * pixels, **_beside(terrain, heights=pixels, covered=pixels, noise=noise)}
    return written | (_pyramid(pixels) if has_pyramid(grid) else {})


def _beside(terrain: Terrain | None, *, heights: int, covered: int, noise: bool) -> dict[str, int]:
    """Bytes of the terrain's samples, its layers and the noise of an image."""
    layers = {} if terrain is None else {"terrain": terrain.heights.nbytes, "layers": CELL * (heights + covered)}
    # The noise is smooth, float32 of few bits: a byte a pixel at most, compressed.
    return {**layers, **({"noise": covered} if noise else {})}


def has_pyramid(grid: Grid, asked: bool | None = None) -> bool:
    """Tell whether an image has a pyramid: as requested, or by default for large ones."""
    longest = max(grid.shape)
    return longest > IMAGE_CHUNK and (longest > PYRAMID_FROM if asked is None else asked)


def with_pyramid(stores: Mapping[str, int], grid: Grid, asked: bool | None) -> dict[str, int]:
    """Bytes that a run writes, by store, including those of a pyramid if it has one.

    Where it is not predicted, as that of a small image, all pixels may be covered.
    """
    if has_pyramid(grid, asked):
        return {**_pyramid(math.prod(grid.shape)), **stores}
    return {name: size for name, size in stores.items() if name != "pyramid"}


def _pyramid(covered: int) -> dict[str, int]:
    """Bytes of the pyramid of `covered` pixels: 1 / 4 + 1 / 16 + ... of their number in cells."""
    return {"pyramid": round(CELL * covered / 3)}


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
