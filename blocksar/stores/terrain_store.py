"""Storage of a run's terrain: written once, read by windows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.chunks import IMAGE_CHUNK
from blocksar.collection.terrain import Terrain
from blocksar.constants import MIB
from blocksar.errors import InputError
from blocksar.places.place import Place
from blocksar.stores.contract import CONVENTIONS, TERRAIN
from blocksar.stores.creation import create
from blocksar.stores.records import checksum, checksum_bytes, read_json
from blocksar.stores.regions import read_region, write_region

KEPT_BYTES = 16 * MIB  # of heights that are kept between windows, at most
LIMITS = "limits"  # attribute: lowest and highest height, m
NUMBERS = ("x0", "dx", "y0", "dy", "row", "column")  # attributes that make a window's arithmetic that of the whole

REFINED = "refined"  # attribute; left out by earlier versions


def terrain_fingerprint(terrain: Terrain) -> str:
    """Checksum of a terrain's heights and position."""
    numbers = repr([getattr(terrain, name) for name in NUMBERS])
    return checksum_bytes(f"{numbers} {checksum(np.ascontiguousarray(terrain.heights))}".encode())


def write_terrain(place: Place, terrain: Terrain) -> None:
    """Create a store with a terrain's heights."""
    whole = tuple(slice(0, n) for n in terrain.heights.shape)
    create(
        place, TERRAIN, sizes={}, coords={"x": terrain.x, "y": terrain.y}, overwrite=True,
        attrs={"title": "height of the ground", "Conventions": CONVENTIONS}
        | {name: getattr(terrain, name) for name in (*NUMBERS, REFINED)} | {LIMITS: list(terrain.limits)},
        chunks={"y": IMAGE_CHUNK, "x": IMAGE_CHUNK},
        fill=lambda store: write_region(store, "height", whole, terrain.heights),
    )  # fmt: skip


class StoredTerrain:
    """A stored terrain read by windows; chunks of the last window are cached for its neighbours.

    Parameters
    ----------
    place : Place

    Attributes
    ----------
    limits : (float, float)
        Lowest and highest height, m.

    Raises
    ------
    InputError
        If the store is damaged.
    """

    def __init__(self, place: Place) -> None:
        self._place = place
        try:
            attributes = read_json(place / "zarr.json")["attributes"]
            shape = tuple(read_json(place / "height" / "zarr.json")["shape"])
            empty = np.broadcast_to(np.float64(np.nan), shape)
            numbers = {name: attributes[name] for name in NUMBERS} | {REFINED: attributes.get(REFINED, 1)}
            self._known = Terrain(**numbers, heights=empty)
            low, high = (float(limit) for limit in attributes[LIMITS])
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{place} is damaged ({error}); focus again with --overwrite") from error
        self.limits = low, high
        self._kept: tuple[slice, slice, FloatArray] | None = None

    def read(self, x: tuple[float, float] | None = None, y: tuple[float, float] | None = None) -> Terrain:
        """Read the part for heights in a box, x and y from .. to, m; all of it without a box."""
        shape = self._known.heights.shape
        columns, rows = (slice(0, shape[1]), slice(0, shape[0])) if x is None or y is None else self._known.span(x, y)
        return replace(self._known, heights=self._heights(rows, columns), row=self._known.row + rows.start,
                       column=self._known.column + columns.start)  # fmt: skip

    def _heights(self, rows: slice, columns: slice) -> FloatArray:
        if self._kept is not None:
            of_rows, of_columns, heights = self._kept
            if _within(rows, of_rows) and _within(columns, of_columns):
                first, left = rows.start - of_rows.start, columns.start - of_columns.start
                return heights[first : first + rows.stop - rows.start, left : left + columns.stop - columns.start]
        whole = tuple(
            slice(part.start - part.start % IMAGE_CHUNK, min(-(-part.stop // IMAGE_CHUNK) * IMAGE_CHUNK, n))
            for part, n in zip((rows, columns), self._known.heights.shape, strict=True)
        )
        if 8 * np.prod([part.stop - part.start for part in whole]) > KEPT_BYTES:
            return read_region(self._place, "height", (rows, columns))
        self._kept = whole[0], whole[1], read_region(self._place, "height", whole)
        return self._heights(rows, columns)


def _within(part: slice, whole: slice) -> bool:
    return bool(whole.start <= part.start and part.stop <= whole.stop)


def read_terrain(place: Place, x: tuple[float, float] | None = None, y: tuple[float, float] | None = None) -> Terrain:
    """Read the part of a stored terrain for heights in a box, x and y from .. to, m; all of it without a box.

    Raises
    ------
    InputError
        If the store is damaged.
    """
    return StoredTerrain(place).read(x, y)
