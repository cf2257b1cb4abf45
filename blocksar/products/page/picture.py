"""The picture of a report page: the image decimated to grey levels, and what is drawn over it, as SVG has it.

Its frame is in metres from the image's centre, with y growing downwards.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from matplotlib.image import imsave
from numpy.typing import NDArray

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.collection.beam import dwell
from blocksar.measurement.figures import PointResponse
from blocksar.measurement.targets import Target
from blocksar.products.page.facts import MOST_ROWS
from blocksar.products.pictures.overview import overview, stretch
from blocksar.progress.listening import Callback
from blocksar.runs.finished import FinishedRun
from blocksar.runs.record import PredictedBlock

PIXELS = 1600  # of the longer side, at most: a page of clutter is then some 3 MB
DEEPEST = 100.0  # dB under the strongest cell that the picture still tells apart
CHIP = 64  # pixels a side of what is shown about a target at full resolution, once one is near enough
MOST_CHIPS = 100
ARC = np.radians(1.0)  # between the points of a block's outline


@dataclass(frozen=True)
class Picture:
    """The image, decimated, in a frame of its own: m from the image's centre, y growing downwards as in SVG.

    Attributes
    ----------
    data : str
        Data URI: grey levels over `bottom` .. `top` dB; transparent where not covered.
    centre : tuple of float
        x, y of the scene frame at the picture's origin, m.
    width, height, cell : float
        Of the whole and of a cell (its longer side), m.
    black, white : float
        dB between which grey is first spread.
    looks : "max" or "mean"
        What of its pixels a cell shows.
    """

    data: str
    centre: tuple[float, float]
    width: float
    height: float
    cell: float
    bottom: float
    top: float
    black: float
    white: float
    looks: Literal["max", "mean"]

    def place(self, x: float, y: float) -> tuple[str, str]:
        """Of a point of the scene frame, as SVG has it."""
        return f"{x - self.centre[0]:.3f}", f"{self.centre[1] - y:.3f}"

    def find(self, x: float, y: float) -> tuple[str, str] | None:
        """Likewise; None outside."""
        return self.place(x, y) if self.holds(x, y) else None

    def holds(self, x: float, y: float, room: float = 0.0) -> bool:
        """Whether a point of the scene frame lies in it, `room` from its edges."""
        dx, dy = abs(x - self.centre[0]) + room, abs(y - self.centre[1]) + room
        return bool(dx <= self.width / 2 and dy <= self.height / 2)


class Outline(NamedTuple):
    """A block's border as an SVG path, and where its name stands; None where none of it is in the image."""

    name: str
    path: str
    label: tuple[str, str] | None


class Mark(NamedTuple):
    """A target in the picture."""

    name: str
    x: str
    y: str
    first: bool  # its name is written out before others


class Chip(NamedTuple):
    """Pixels about a target at full resolution: data URI, upper left corner and size in the picture."""

    data: str
    x: str
    y: str
    width: str
    height: str


class Arrow(NamedTuple):
    """A direction, degrees clockwise from the right as SVG turns."""

    name: str
    angle: str


def draw(source: FinishedRun, *, looks: Literal["max", "mean"], progress: Callback | None = None) -> Picture:
    """Read the image by strips, and decimate it to grey levels."""

    def read(rows: slice, columns: slice) -> ComplexArray:
        if progress is not None:
            progress(min(rows.stop, source.y.size), source.y.size)
        return source.read(rows, columns)

    seen = overview(read, source.x, source.y, max_pixels=PIXELS, looks=looks)
    with np.errstate(divide="ignore"):
        decibel = 10 * np.log10(seen.power)
    finite = decibel[np.isfinite(decibel)]
    top = float(finite.max()) if finite.size else 0.0
    bottom = max(float(finite.min()), top - DEEPEST) if finite.size else -DEEPEST
    bottom = min(bottom, top - 1)
    black, white = stretch(decibel)
    x, y = seen.x_edges, seen.y_edges
    # Cells at the right and upper ends may reach beyond the image: the picture's frame is that of the cells.
    return Picture(
        data=data_uri("webp", _grey(decibel, bottom, top)),
        centre=(float(x[0] + x[-1]) / 2, float(y[0] + y[-1]) / 2),
        width=float(x[-1] - x[0]),
        height=float(y[-1] - y[0]),
        cell=float(max(x[1] - x[0], y[1] - y[0])),
        bottom=bottom,
        top=top,
        black=float(np.floor(black)),
        white=float(np.ceil(white)),
        looks=looks,
    )


def _grey(decibel: FloatArray, bottom: float, top: float) -> bytes:
    """A lossless WebP: level 0 is `bottom` or less, 255 is `top`; rows from the upper end."""
    level = np.nan_to_num((decibel - bottom) / (top - bottom), nan=0.0, neginf=0.0).clip(0, 1)
    grey: NDArray[np.uint8] = np.round(255 * level).astype(np.uint8)
    there = np.where(np.isnan(decibel), 0, 255).astype(np.uint8)
    pixels = np.dstack([grey, grey, grey, there])[::-1]
    written = io.BytesIO()
    imsave(written, pixels, format="webp", pil_kwargs={"lossless": True, "quality": 0, "method": 0})
    return written.getvalue()


def data_uri(kind: str, content: bytes) -> str:
    """A picture, as a page carries it."""
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def marks(targets: Sequence[PointResponse | Target], first: Collection[str], picture: Picture) -> Iterator[Mark]:
    """Of the targets that the picture holds; those named in `first` have their names written out before others."""
    for target in targets:
        if (at := picture.find(target.x, target.y)) is not None:
            yield Mark(target.name, *at, target.name in first)


def chips(source: FinishedRun, targets: Sequence[PointResponse | Target], picture: Picture) -> Iterator[Chip]:
    """Where the picture's cells are larger than pixels."""
    (dx, dy), axes = source.spacing, (source.x, source.y)
    if picture.cell < 1.5 * max(dx, dy):
        return
    for target in targets:
        if not picture.holds(target.x, target.y):
            continue
        columns, rows = (_about(v, axis, d) for v, axis, d in zip(target[1:3], axes, (dx, dy), strict=True))
        x, y = source.x[columns], source.y[rows]
        with np.errstate(divide="ignore"):
            decibel = 20 * np.log10(np.abs(source.read(rows, columns)))
        corner = picture.place(float(x[0]) - dx / 2, float(y[-1]) + dy / 2)
        data = data_uri("webp", _grey(decibel, picture.bottom, picture.top))
        yield Chip(data, *corner, f"{x.size * dx:.3f}", f"{y.size * dy:.3f}")


def _about(value: float, axis: FloatArray, step: float) -> slice:
    """CHIP pixels about a coordinate, fewer at the image's edge."""
    at = min(max(round((value - axis[0]) / step), 0), axis.size - 1)
    return slice(max(at - CHIP // 2, 0), min(at + CHIP // 2, axis.size))


def outlines(source: FinishedRun, predicted: Sequence[PredictedBlock], picture: Picture) -> Iterator[Outline]:
    """Borders of the blocks: rays of equal yaw and arcs of equal range about the nadir."""
    geometry = source.geometry
    for block in predicted[:MOST_ROWS]:
        (low, high), (near, far) = block.yaw, block.range
        yaws = np.linspace(low, high, 2 + int((high - low) / ARC))
        inner = geometry.ground_point(np.array(near), yaws)
        outer = geometry.ground_point(np.array(far), yaws[::-1])
        corners = [picture.place(x, y) for x, y, _ in np.concatenate([inner, outer]) if np.isfinite(x)]
        path = " ".join(f"{'L' if i else 'M'}{x} {y}" for i, (x, y) in enumerate(corners))
        yield Outline(block.name, f"{path}Z", _label_place(source, block, picture))


def _label_place(source: FinishedRun, block: PredictedBlock, picture: Picture) -> tuple[str, str] | None:
    """The farthest place along a yaw, the block's middle one if it can be, with some room around in the picture."""
    (near, far), (low, high) = block.range, block.yaw
    ranges, room = np.linspace(far, near, 41)[2:-2], 0.03 * max(picture.width, picture.height)
    for share in sorted(np.linspace(0.1, 0.9, 17), key=lambda share: abs(share - 0.5)):
        points = source.geometry.ground_point(ranges, np.array(low + share * (high - low)))
        for x, y, _ in points:
            if np.isfinite(x) and picture.holds(x, y, room):
                return picture.place(x, y)
    return None


def arrows(source: FinishedRun, picture: Picture, north: float | None) -> list[Arrow]:
    """The look direction at the image's centre, and north, if it is known how far x is turned from east (degrees)."""
    centre = np.array(picture.centre)
    first, last = (float(t) for t in dwell(source.geometry, *centre))
    time = (first + last) / 2 if first < last else source.geometry.epoch
    look = centre - source.geometry.track.position(np.array(time))[:2]
    found = [Arrow("look", _turn(look))]
    if north is not None:
        turn = np.radians(north)
        found.append(Arrow("N", _turn(np.array([np.sin(turn), np.cos(turn)]))))
    return found


def _turn(direction: FloatArray) -> str:
    return f"{np.degrees(np.arctan2(-direction[1], direction[0])):.1f}"
