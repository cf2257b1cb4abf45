"""Opening a finished run: its record, its collection, and its image, read by windows or strips."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from blocksar import stores, texts
from blocksar.arrays import ComplexArray, FloatArray, IntArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry, over_terrain
from blocksar.collection.georeference import Georeference
from blocksar.collection.weighting import Weighting
from blocksar.errors import InputError, MissingInput
from blocksar.measurement.noise_figures import NoiseFigures
from blocksar.measurement.response import ReadChip
from blocksar.places.local import LocalPlace
from blocksar.places.place import Place
from blocksar.runs.folder import check_finished, member
from blocksar.runs.record import RECORD, RunRecord
from blocksar.runs.track import ATTRIBUTE, TrackCorrection
from blocksar.stores.records import unreachable

Int16Array = np.ndarray[tuple[int, ...], np.dtype[np.int16]]
NOISE_POINTS = 64  # a side, at which the noise of an image is read for its figures
Span = tuple[float, float]  # lower and upper end, m
STRIP = 1 << 23  # largest number of pixels in a strip, 64 MiB, unless a single row or column has more


def finished_record(folder: Place) -> RunRecord:
    """Read the record of a finished run.

    Raises
    ------
    InputError
        If there is no run, or it is not finished, or its record is damaged.
    """
    try:
        wrong = None if (folder / RECORD).exists() else "holds no run.json" if folder.exists() else "does not exist"
    except OSError as error:
        raise unreachable(folder, error) from error
    if wrong is not None:
        _refuse_store(folder)
        kind = InputError if folder.exists() else MissingInput
        raise kind(f"{folder} {wrong}; give the folder that `blocksar focus --out` left")
    record = RunRecord.read(folder)
    if not record.finished:
        raise InputError(f"{folder} is not finished; run `blocksar focus` again with the same settings")
    return record


def _refuse_store(folder: Place) -> None:
    """Refuse a store given instead of a run, and name the folder to give."""
    if (folder / "zarr.json").exists():
        if folder.name == "image.zarr":
            around = str(folder).removesuffix("image.zarr").rstrip("/") or "."
            raise InputError(f"{folder} is the image alone; give the folder of its run, such as {around}")
        raise InputError(f"{folder} is a store, not a run; give the folder that `blocksar focus {folder} --out` leaves")


def folder_of(folder: Place, channel: str | None) -> Place:
    """Return the folder of the run that made a channel's image; the folder itself if the run has no channels.

    Parameters
    ----------
    channel : str, optional
        Default: the first.

    Raises
    ------
    InputError
        If the run is not finished, or has no such channel.
    """
    record = finished_record(folder)
    number = stores.number_of(record.channels, channel, str(folder))
    return member(folder, record.channels[number], record.dimension) if record.channels else folder


def member_line(folder: Place, channel: str | None) -> list[str]:
    """Return a sentence that names the channel or look in use; none if the run has neither.

    Raises
    ------
    InputError
        As `folder_of`.
    """
    record = finished_record(folder)
    if not record.channels:
        return []
    name = record.channels[stores.number_of(record.channels, channel, str(folder))]
    choice = "" if channel else "; --channel chooses another"
    kind = "channel " if record.dimension == "channel" else ""
    return [f"{kind}{name} of {', '.join(record.channels)}{choice}"]


class Coverage(NamedTuple):
    """First and last covered pixel of every row and of every column; first > last where none is."""

    row_first: IntArray
    row_last: IntArray
    column_first: IntArray
    column_last: IntArray


def _described(folder: Place, record: RunRecord) -> tuple[tuple[Geometry, ...], dict[str, Any], list[Any]]:
    """Read the geometries of a run's segments, the attributes with the targets of all collections, and `source`.

    That attribute, of each segment, says when its slow time is 0.
    """
    n = len(record.segments)
    places = [folder / "segments" / str(i) / "collection.zarr" for i in range(n)] or [folder / "collection.zarr"]
    read = [stores.read_collection(place) for place in places]
    attrs = stores.without_unseen(read[0][1])
    if len({segment.collection for segment in record.segments}) > 1:
        listed = [target for _, each in read for target in each.get("targets") or []]
        attrs["targets"] = [target for i, target in enumerate(listed) if target not in listed[:i]]
        attrs.pop("scene", None)
    geometries = tuple(Geometry(collection=collection.centred()) for collection, _ in read)
    return geometries, attrs, [each.get("source") for _, each in read]


@dataclass(frozen=True, eq=False)
class FinishedRun:
    """A finished run, opened for measurements and products.

    Attributes
    ----------
    folder : Place
        Run folder.
    x, y : (n_x,), (n_y,) float
        Pixel positions, m, uniform and ascending.
    geometry : Geometry
        Geometry of the run's collection.
    attrs : dict
        Attributes of the phase history: title, georeference, targets and others; `source` of the one in the middle.
    record : RunRecord
    first : (int, int)
        Row and column of the run's image where this part of it begins.
    segments : tuple of Geometry
        Geometries of the run's segments, if it has several; `geometry` is that of the one in the image's middle.
    """

    folder: Place
    x: FloatArray
    y: FloatArray
    geometry: Geometry
    attrs: dict[str, Any]
    record: RunRecord
    first: tuple[int, int] = (0, 0)
    segments: tuple[Geometry, ...] = ()

    @classmethod
    def open(cls, folder: Place) -> Self:
        """Open a run.

        Raises
        ------
        InputError
            If it is not finished or damaged, or its image has a single row or column.
        """
        record = finished_record(folder)
        if record.receipts and isinstance(folder, LocalPlace):  # a bucket would be listed
            check_finished(folder, record)
        described, attrs, sources = _described(folder, record)
        x, y = (stores.read_region(folder / "image.zarr", name, (slice(None),)) for name in ("x", "y"))
        if x.size and y.size and min(x.size, y.size) < 2:
            raise InputError(
                f"the image of {folder} has {y.size} x {x.size} pixels (y, x), and products and measurements take 2 at "
                "least in each direction; focus on a larger --grid"
            )
        if any(axis.size < 2 or not (np.diff(axis) > 0).all() for axis in (x, y)):
            raise InputError(f"x or y in {folder / 'image.zarr'} is damaged; focus again with --overwrite")
        if record.settings.get("heights") is not None:
            terrain = stores.read_terrain(folder / "terrain.zarr")
            described = tuple(over_terrain(geometry.collection, terrain) for geometry in described)
        if not record.segments:
            return cls(folder, x, y, described[0], attrs, record)
        run = cls(folder, x, y, described[0], attrs, record, segments=described)
        middle = run.segment_at(float(x[x.size // 2]), float(y[y.size // 2]))
        return replace(run, geometry=described[middle], attrs={**attrs, "source": sources[middle]})

    def segment_at(self, x: float, y: float) -> int:
        """Number of the segment that the pixel nearest to a ground point, m, comes from.

        Where it is not covered: of that which saw the most of its dwell.
        """
        if not self.segments:
            return 0
        row, column = self._nearest_pixel(x, y)
        block = int(self.read_block(slice(row, row + 1), slice(column, column + 1))[0, 0])
        if block >= 0:
            return self.segment_of(block)
        margins = [float(geometry.beam.margin(np.array(x), np.array(y))) for geometry in self.segments]
        return margins.index(max(margins))

    def segment_of(self, block: int) -> int:
        """Number of the segment that a block is of."""
        firsts = [segment.first_block for segment in self.record.segments]
        return max(bisect_right(firsts, block) - 1, 0)

    def geometry_at(self, x: float, y: float) -> Geometry:
        """Geometry of the segment that the pixel nearest to a ground point, m, comes from."""
        return self.segments[self.segment_at(x, y)] if self.segments else self.geometry

    def geometry_of(self, block: int) -> Geometry:
        """Geometry of the segment that a block is of."""
        return self.segments[self.segment_of(block)] if self.segments else self.geometry

    @property
    def image(self) -> Place:
        """Path of the image store."""
        return self.folder / "image.zarr"

    @property
    def collection(self) -> Collection:
        return self.geometry.collection

    @property
    def scene_title(self) -> str:
        """Title of the collection; of several, that of the first with their number."""
        name = str(self.attrs.get("title") or self.collection.title or "blocksar image")
        others = len(self.record.inputs) - 1
        return f"{name} and {others} more" if others > 0 else name

    @property
    def title(self) -> str:
        """Title of the collection, and of several channels or looks the name of this one."""
        member = self.attrs.get("channel") or self.attrs.get("look")
        return f"{self.scene_title}, {member}" if member else self.scene_title

    @property
    def ground_height(self) -> float:
        return self.collection.ground_height

    @cached_property
    def weighting(self) -> Weighting:
        """The tapers over band and dwell; none in runs of earlier versions."""
        chosen = [str(self.record.settings.get(f"weighting_{axis}", "uniform")) for axis in ("range", "azimuth")]
        return Weighting.parse(range=chosen[0], azimuth=chosen[1])

    @cached_property
    def track(self) -> TrackCorrection | None:
        """Correction of the track from the samples; None if it was not corrected.

        Raises
        ------
        InputError
            If the attribute is damaged.
        """
        attribute = self.attrs.get(ATTRIBUTE)
        return None if attribute is None else TrackCorrection.of(attribute, str(self.folder / "collection.zarr"))

    @cached_property
    def spacing(self) -> tuple[float, float]:
        """Distance between pixels in x and in y, m."""
        return tuple(float(axis[-1] - axis[0]) / (axis.size - 1) for axis in (self.x, self.y))  # type: ignore[return-value]

    def pixel_at(self, x: float, y: float) -> tuple[int, int]:
        """Row and column of a ground point, m, rounded; not `inside` where the point lies beyond the image."""
        return round((y - self.y[0]) / self.spacing[1]), round((x - self.x[0]) / self.spacing[0])

    def inside(self, row: int, column: int) -> bool:
        """Whether the image has a pixel at this row and column."""
        return 0 <= row < self.y.size and 0 <= column < self.x.size

    def _nearest_pixel(self, x: float, y: float) -> tuple[int, int]:
        """Row and column of the image's pixel that is nearest to a ground point, m."""
        row, column = self.pixel_at(x, y)
        return min(max(row, 0), self.y.size - 1), min(max(column, 0), self.x.size - 1)

    @cached_property
    def georeference(self) -> Georeference | None:
        """Position of the scene on the Earth; None if unknown.

        Raises
        ------
        InputError
            If the attribute is wrong.
        """
        return Georeference.among(self.attrs)

    def placed(self, product: str) -> Georeference:
        """Return the georeference for a product that needs one.

        Raises
        ------
        InputError
            If there is none.
        """
        if self.georeference is None:
            raise InputError(
                f"{self.image} has no georeference, and {product} says where on the Earth its pixels lie; put the "
                "attribute georeference into the phase history and focus it again, or export png"
            )
        return self.georeference

    def cropped(self, x: Span, y: Span, name: str = "crop") -> Self:
        """Return the part of the image between ground coordinates, m, ends included; reads no pixel.

        `name` is that of the option.

        Raises
        ------
        InputError
            If it has no two rows and columns.
        """
        parts = []
        for along, axis, (low, high) in (("y", self.y, y), ("x", self.x, x)):
            inside = np.flatnonzero((axis >= low) & (axis <= high))
            if inside.size < 2:
                raise InputError(
                    f"{name}: {along} from {low:g} to {high:g} m has {texts.count(inside.size, 'pixel')} of the "
                    f"image, which runs from {axis[0]:g} to {axis[-1]:g} m every {axis[1] - axis[0]:g} m; give a "
                    "part with two at least"
                )
            parts.append(slice(int(inside[0]), int(inside[-1]) + 1))
        first = self.first[0] + parts[0].start, self.first[1] + parts[1].start
        return replace(self, x=self.x[parts[1]], y=self.y[parts[0]], first=first)

    def read(self, rows: slice, columns: slice) -> ComplexArray:
        """Read pixels, (rows, columns); NaN where not covered."""
        return stores.read_region(self.image, "image", self._in_image(rows, columns))

    def read_block(self, rows: slice, columns: slice) -> Int16Array:
        """Read the index of the block that each pixel comes from, (rows, columns); -1 where not covered."""
        return stores.read_region(self.image, "block", self._in_image(rows, columns))

    def check_layer(self, name: str) -> None:
        """Check that the image has a layer that only images on a terrain have.

        Raises
        ------
        InputError
            If it has not.
        """
        if not (self.image / name / "zarr.json").exists():
            why = "lies on the plane" if self.geometry.terrain is None else "is of an earlier version"
            raise InputError(f"{self.image} {why} and has no {name}; focus again with --terrain and --overwrite")

    def read_layer(self, name: str, rows: slice, columns: slice) -> NDArray[Any]:
        """Read a layer beside the image, such as `height`, (rows, columns)."""
        return stores.read_region(self.image, name, self._in_image(rows, columns))

    def _in_image(self, rows: slice, columns: slice) -> tuple[slice, slice]:
        """Convert rows and columns of a crop to those of the run's image."""
        spans = (part.indices(n) for part, n in ((rows, self.y.size), (columns, self.x.size)))
        y, x = (
            slice(first + start, first + max(start, stop), step)
            for first, (start, stop, step) in zip(self.first, spans, strict=True)
        )
        return y, x

    def noise_levels(self, count: int) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """x, y (m) and noise-equivalent reflectivity of covered pixels (n,), of about `count` rows and columns.

        None if the noise of the samples is not known.
        """
        if not (self.image / "noise_equivalent" / "zarr.json").exists():
            return None
        rows, columns = (
            np.unique(np.linspace(0, axis.size - 1, count).round().astype(int)) for axis in (self.y, self.x)
        )
        values = np.full((rows.size, columns.size), np.nan)
        for strip in self.strips(0):
            some = (rows >= strip.start) & (rows < strip.stop)
            if some.any():
                read = stores.read_region(self.image, "noise_equivalent", self._in_image(strip, slice(None)))
                values[some] = read[rows[some] - strip.start][:, columns]
        row, column = np.nonzero(values > 0)
        return (self.x[columns[column]], self.y[rows[row]], values[row, column]) if row.size else None

    @cached_property
    def noise(self) -> NoiseFigures | None:
        """The figures of the image's noise; None if the noise of the samples is not known."""
        levels = self.noise_levels(NOISE_POINTS)
        return None if levels is None else NoiseFigures.of(self.geometry_at, *levels, self.weighting)

    def read_input(self, rows: slice, columns: slice) -> Int16Array:
        """Read which of the record's inputs each pixel comes from, (rows, columns); -1 where not covered."""
        blocks = self.read_block(rows, columns)
        inputs = self.record.inputs
        numbers = {int(b): inputs.index(self.record.segments[self.segment_of(int(b))].path) for b in np.unique(blocks)
                   if b >= 0}  # fmt: skip
        found = np.full(blocks.shape, -1, np.int16)
        for block, number in numbers.items():
            found[blocks == block] = number
        return found

    def reader_at(self, x: float, y: float) -> ReadChip:
        """Return a function that reads pixels for measurements about a ground point, m.

        In a mosaic of several collections, pixels that come from another one than the point's are NaN: that saw the
        point from another side, so that the two make no single response.
        """
        if len(self.record.inputs) < 2:
            return self.read
        row, column = self._nearest_pixel(x, y)
        own = self.read_input(slice(row, row + 1), slice(column, column + 1))[0, 0]

        def read(rows: slice, columns: slice) -> ComplexArray:
            return np.where(self.read_input(rows, columns) == own, self.read(rows, columns), np.complex64(np.nan))

        return read

    def strips(self, axis: int) -> Iterator[slice]:
        """Divide the image along rows (axis 0) or columns (1) into strips of whole chunks, or less if above STRIP."""
        along, across = (self.y.size, self.x.size) if axis == 0 else (self.x.size, self.y.size)
        chunk = stores.chunk_shape(self.image, "image")[axis]
        step = max(chunk // -(-chunk * across // STRIP), 1)
        for first in range(-(self.first[axis] % chunk) // step * step, along, step):
            if first + step > 0:
                yield slice(max(first, 0), min(first + step, along))

    def coverage(self) -> Coverage:
        """Find the covered pixels; reads `block`.

        Raises
        ------
        InputError
            If there are none.
        """
        n_y, n_x = self.y.size, self.x.size
        row_first, row_last = np.full(n_y, n_x), np.full(n_y, -1)
        column_first, column_last = np.full(n_x, n_y), np.full(n_x, -1)
        for rows in self.strips(0):
            covered = self.read_block(rows, slice(None)) >= 0
            some, at = covered.any(axis=1), np.arange(rows.start, rows.stop)
            row_first[at[some]] = covered[some].argmax(axis=1)
            row_last[at[some]] = n_x - 1 - covered[some, ::-1].argmax(axis=1)
            some = covered.any(axis=0)
            column_first[some] = np.minimum(column_first[some], rows.start + covered[:, some].argmax(axis=0))
            column_last[some] = rows.stop - 1 - covered[::-1, some].argmax(axis=0)
        if (row_last < 0).all():
            raise InputError(f"{self.image} has no covered pixel, and so nothing to export; focus on another --grid")
        return Coverage(row_first, row_last, column_first, column_last)
