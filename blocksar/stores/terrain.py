"""The terrain of a run: written once, read by windows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from blocksar.chunks import IMAGE_CHUNK
from blocksar.collection.terrain import Terrain
from blocksar.errors import InputError
from blocksar.places.place import Place
from blocksar.stores.creation import create
from blocksar.stores.records import checksum, checksum_bytes, read_json
from blocksar.stores.regions import read_region, write_region
from blocksar.stores.schema import CONVENTIONS, TERRAIN

LIMITS = "limits"  # attribute: lowest and highest height, m
NUMBERS = ("x0", "dx", "y0", "dy", "row", "column")  # attributes that make a window's arithmetic that of the whole


def terrain_fingerprint(terrain: Terrain) -> str:
    """A checksum of the heights and of where they lie."""
    numbers = repr([getattr(terrain, name) for name in NUMBERS])
    return checksum_bytes(f"{numbers} {checksum(np.ascontiguousarray(terrain.heights))}".encode())


def write_terrain(place: Place, terrain: Terrain) -> None:
    """Create a store with a terrain's heights."""
    whole = tuple(slice(0, n) for n in terrain.heights.shape)
    create(
        place, TERRAIN, sizes={}, coords={"x": terrain.x, "y": terrain.y}, overwrite=True,
        attrs={"title": "height of the ground", "Conventions": CONVENTIONS}
        | {name: getattr(terrain, name) for name in NUMBERS} | {LIMITS: list(terrain.limits)},
        chunks={"y": IMAGE_CHUNK, "x": IMAGE_CHUNK},
        fill=lambda store: write_region(store, "height", whole, terrain.heights),
    )  # fmt: skip


def read_terrain(place: Place, x: tuple[float, float] | None = None, y: tuple[float, float] | None = None) -> Terrain:
    """The part of a stored terrain that a box needs, x and y from .. to, m; all of it without a box.

    Raises
    ------
    InputError
        If the store is damaged.
    """
    try:
        attributes = read_json(place / "zarr.json")["attributes"]
        shape = tuple(read_json(place / "height" / "zarr.json")["shape"])
        empty = np.broadcast_to(np.float64(np.nan), shape)
        known = Terrain(**{name: attributes[name] for name in NUMBERS}, heights=empty)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{place} is damaged ({error}); focus again with --overwrite") from error
    columns, rows = (slice(0, shape[1]), slice(0, shape[0])) if x is None or y is None else known.span(x, y)
    heights = read_region(place, "height", (rows, columns))
    return replace(known, heights=heights, row=known.row + rows.start, column=known.column + columns.start)


def terrain_limits(place: Place) -> tuple[float, float]:
    """Lowest and highest height of a stored terrain, m.

    Raises
    ------
    InputError
        If the store is damaged.
    """
    try:
        low, high = (float(limit) for limit in read_json(place / "zarr.json")["attributes"][LIMITS])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{place} is damaged ({error}); focus again with --overwrite") from error
    return low, high
