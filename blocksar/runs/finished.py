"""Opening a finished run: its image read by windows or strips, its collection, and its record."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from blocksar import stores
from blocksar.arrays import ComplexArray, FloatArray, IntArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.georeference import Georeference
from blocksar.errors import InputError
from blocksar.places.place import Place
from blocksar.runs import folder


@dataclass(frozen=True, eq=False)
class Image:
    """A finished run's image, read by window."""

    path: Place
    x: FloatArray
    y: FloatArray

    def read(self, rows: slice, columns: slice) -> ComplexArray:
        return stores.read_region(self.path, "image", (rows, columns))

    def block(self, rows: slice, columns: slice) -> Any:
        return stores.read_region(self.path, "block", (rows, columns))


def finished_record(run: Place) -> dict[str, Any]:
    """What run.json says of a finished run.

    Raises
    ------
    InputError
        If the run is not finished.
    """
    record = stores.read_json(run / "run.json")
    if not isinstance(record, dict) or record.get("status") != folder.FINISHED:
        raise InputError(f"{run} is not finished; run `blocksar focus` again with the same settings")
    return record


def open_run(run: Place) -> tuple[Image, Collection, dict[str, Any], dict[str, Any]]:
    if not (run / "run.json").exists():
        raise InputError(f"{run} holds no run.json; give the folder that `blocksar focus --out` left")
    record = finished_record(run)
    collection, attrs = stores.read_collection(run / "collection.zarr")
    x, y = (stores.read_region(run / "image.zarr", name, (slice(None),)) for name in ("x", "y"))
    if x.size and y.size and min(x.size, y.size) < 2:
        raise InputError(
            f"the image of {run} has {y.size} x {x.size} pixels (y, x), and products and measurements take 2 at least "
            "in each direction; focus on a larger --grid"
        )
    if any(axis.size < 2 or not (np.diff(axis) > 0).all() for axis in (x, y)):
        raise InputError(f"x or y in {run / 'image.zarr'} is damaged; focus again with --overwrite")
    return Image(run / "image.zarr", x, y), collection.centred(), attrs, record


STRIP = 1 << 23  # pixels that are read at once, at most, if a strip can be as narrow: 64 MiB


class Coverage(NamedTuple):
    """First and last covered pixel of every row and of every column; first > last where none is."""

    row_first: IntArray
    row_last: IntArray
    column_first: IntArray
    column_last: IntArray


@dataclass(frozen=True, eq=False)
class Source:
    """A finished run, as a product needs it.

    Attributes
    ----------
    path : Place
        Of image.zarr.
    x, y : (n_x,), (n_y,) float
        Pixel positions, m, uniform and ascending.
    geometry : Geometry
        Of the run's collection.
    attrs : dict
        Of the collection: title, georeference, targets and whatever else came with the phase history.
    record : dict
        run.json.
    """

    path: Place
    x: FloatArray
    y: FloatArray
    geometry: Geometry
    attrs: dict[str, Any]
    record: dict[str, Any]

    @property
    def title(self) -> str:
        return str(self.attrs.get("title") or self.geometry.collection.title or "blocksar image")

    @property
    def ground_height(self) -> float:
        return self.geometry.collection.ground_height

    @cached_property
    def spacing(self) -> tuple[float, float]:
        """Of the pixels in x and y, m."""
        return tuple(float(axis[-1] - axis[0]) / (axis.size - 1) for axis in (self.x, self.y))  # type: ignore[return-value]

    @cached_property
    def georeference(self) -> Georeference | None:
        """None where nobody said where the scene lies.

        Raises
        ------
        InputError
            If what was said is wrong.
        """
        found = self.attrs.get("georeference")
        return None if found is None else Georeference.from_attribute(found)

    def placed(self, product: str) -> Georeference:
        """The georeference, which this product cannot do without.

        Raises
        ------
        InputError
            If there is none.
        """
        if self.georeference is None:
            raise InputError(
                f"{self.path} has no georeference, and {product} says where on the Earth its pixels lie; put the "
                "attribute georeference into the phase history and focus it again, or export png"
            )
        return self.georeference

    def read(self, rows: slice, columns: slice) -> ComplexArray:
        """Pixels, NaN where not covered."""
        return stores.read_region(self.path, "image", (rows, columns))

    def strips(self, axis: int) -> Iterator[slice]:
        """Whole chunks along rows (axis 0) or columns (1), or parts of them where those have above STRIP pixels."""
        along, across = (self.y.size, self.x.size) if axis == 0 else (self.x.size, self.y.size)
        chunk = stores.chunk_shape(self.path, "image")[axis]
        step = max(chunk // -(-chunk * across // STRIP), 1)
        for first in range(0, along, step):
            yield slice(first, min(first + step, along))

    def coverage(self) -> Coverage:
        """Where pixels are, read from `block`.

        Raises
        ------
        InputError
            If there are none.
        """
        n_y, n_x = self.y.size, self.x.size
        row_first, row_last = np.full(n_y, n_x), np.full(n_y, -1)
        column_first, column_last = np.full(n_x, n_y), np.full(n_x, -1)
        for rows in self.strips(0):
            covered = stores.read_region(self.path, "block", (rows, slice(None))) >= 0
            some, at = covered.any(axis=1), np.arange(rows.start, rows.stop)
            row_first[at[some]] = covered[some].argmax(axis=1)
            row_last[at[some]] = n_x - 1 - covered[some, ::-1].argmax(axis=1)
            some = covered.any(axis=0)
            column_first[some] = np.minimum(column_first[some], rows.start + covered[:, some].argmax(axis=0))
            column_last[some] = rows.stop - 1 - covered[::-1, some].argmax(axis=0)
        if (row_last < 0).all():
            raise InputError(f"{self.path} has no covered pixel, and so nothing to export; focus on another --grid")
        return Coverage(row_first, row_last, column_first, column_last)
