"""Predicted disk space of a run."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

from blocksar.chunks import IMAGE_CHUNK, PYRAMID_FROM, SAMPLE
from blocksar.collection.grid import Grid
from blocksar.collection.terrain import Terrain

CELL = 4  # bytes of a cell of a pyramid, a height or an angle: float32, which hardly compress; visibility does
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


def exact_bytes(grid: Grid, terrain: Terrain | None, *, noise: bool) -> dict[str, int]:
    """Bytes that exact back-projection writes at most, by store, for a fully covered grid."""
    pixels = math.prod(grid.shape)
    written = {"image": SAMPLE * pixels, **beside_image(terrain, heights=pixels, covered=pixels, noise=noise)}
    return written | (pyramid_bytes(pixels) if has_pyramid(grid) else {})


def beside_image(terrain: Terrain | None, *, heights: int, covered: int, noise: bool) -> dict[str, int]:
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
        return {**pyramid_bytes(math.prod(grid.shape)), **stores}
    return {name: size for name, size in stores.items() if name != "pyramid"}


def pyramid_bytes(covered: int) -> dict[str, int]:
    """Bytes of the pyramid of `covered` pixels: 1 / 4 + 1 / 16 + ... of their number in cells."""
    return {"pyramid": round(CELL * covered / 3)}
