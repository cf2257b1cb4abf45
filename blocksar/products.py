"""What every product starts from: the image of a finished run read by strips, what of it is covered, where it lies.

A product is one file. It is written under a temporary name, in strips of whole chunks, and takes its place when it is
complete: there is no half of one, and no process holds the image.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from blocksar import stores
from blocksar.geometry import Geometry
from blocksar.georeference import Georeference
from blocksar.parameters import ComplexArray, FloatArray, InputError, IntArray, ProcessingError
from blocksar.places import LocalPlace, Location, Place, place, replacing_file

STRIP = 1 << 23  # pixels that are read at once, at most, if a strip can be as narrow: 64 MiB

Progress = Callable[[int, int], None]


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


@contextmanager
def replacing(out: Location, *, overwrite: bool) -> Iterator[str]:
    """A temporary name for a product, which takes its place, on the disk, when the block ends well.

    Raises
    ------
    InputError
        If something stands at `out` that is not to be replaced, or no file can.
    ProcessingError
        If there is no room, or another fault of the file system.
    """
    target = place(out)
    if not isinstance(target, LocalPlace):
        raise InputError(f"{target} is no local path, and products are written to those only; copy it there afterwards")
    if target.path.is_dir():
        raise InputError(f"{target} is a folder; give --out the name of a file")
    if target.exists() and not target.path.is_file():
        raise InputError(f"{target} is no regular file, and is not replaced; choose another name")
    if target.exists() and not overwrite:
        raise InputError(f"{target} exists; choose another name, or have it overwritten (--overwrite)")
    try:
        os.makedirs(target.path.parent, exist_ok=True)
        with replacing_file(target.path) as part:
            with open(part, "xb"):
                pass  # what cannot be written is said now, and alike whatever library writes
            yield part
            descriptor = os.open(part, os.O_RDONLY)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
    except (PermissionError, NotADirectoryError, FileExistsError) as error:
        raise InputError(f"{target} cannot be written ({error.strerror}); choose another name") from error
    except OSError as error:
        raise ProcessingError(f"{target} cannot be written ({error.strerror or error})") from error
