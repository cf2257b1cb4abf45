"""The picture of the report page: the image decimated to grey levels, and its overlays in SVG coordinates.

SVG coordinates are m from the image's centre, with y growing downwards.
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

from blocksar.arrays import FloatArray
from blocksar.measurement.figures import PointResponse
from blocksar.measurement.targets import Target
from blocksar.products.page.facts import MOST_ROWS
from blocksar.products.pictures.overview import level_for, level_of, overview, reader_of, stretch
from blocksar.progress.listening import Callback
from blocksar.runs.finished import FinishedRun
from blocksar.runs.record import PredictedBlock

PIXELS = 1600  # along the longer side, at most: a page of clutter is then some 3 MB
DEEPEST = 100.0  # dB, range of the grey levels below the strongest cell, at most
CHIP = 64  # pixels along a side of the full-resolution chip around a target, shown when zoomed in
MOST_CHIPS = 100
ARC = np.radians(1.0)  # between neighbouring points of a block's outline, at most


@dataclass(frozen=True)
class Picture:
    """The decimated image in SVG coordinates: m from its centre, y growing downwards.

    Attributes
    ----------
    data : str
        Data URI: grey levels; transparent where not covered.
    centre : tuple of float
        x, y of the scene frame at the origin of the SVG coordinates, m.
    width, height, cell : float
        Sides of the picture, and the longer side of a cell, m.
    bottom, top : float
        dB of grey levels 0 and 255.
    black, white : float
        dB first shown as black and as white.
    looks : "max" or "mean"
        Power of a cell: that of its strongest pixel, or the mean.
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
        """SVG coordinates of a point of the scene frame, m."""
        return f"{x - self.centre[0]:.3f}", f"{self.centre[1] - y:.3f}"

    def find(self, x: float, y: float) -> tuple[str, str] | None:
        """SVG coordinates of a point of the scene frame, m; None outside the picture."""
        return self.place(x, y) if self.holds(x, y) else None

    def holds(self, x: float, y: float, margin: float = 0.0) -> bool:
        """Whether a point of the scene frame lies in the picture, at least `margin` m from its edges."""
        dx, dy = abs(x - self.centre[0]) + margin, abs(y - self.centre[1]) + margin
        return bool(dx <= self.width / 2 and dy <= self.height / 2)


class Outline(NamedTuple):
    """A block's border as an SVG path, and the place of its name; None if the block lies outside the image."""

    name: str
    path: str
    label: tuple[str, str] | None


class Mark(NamedTuple):
    """A target in SVG coordinates; `first` names are labelled before others."""

    name: str
    x: str
    y: str
    first: bool


class Chip(NamedTuple):
    """Pixels around a target at full resolution: data URI, upper left corner and size in SVG coordinates."""

    data: str
    x: str
    y: str
    width: str
    height: str


class Arrow(NamedTuple):
    """A direction, degrees clockwise from the right."""

    name: str
    angle: str


def draw(source: FinishedRun, *, looks: Literal["max", "mean"], progress: Callback | None = None) -> Picture:
    """Decimate the image to grey levels: a level of the run's pyramid, which has means, or the image, strip by strip.

    Grey levels then reach up to what a single pixel can have in a cell of that mean, for the chips around targets.
    """
    level = level_for(source, PIXELS)
    if level:
        reduced, looks = overview(*level_of(source, level), max_pixels=PIXELS, looks="mean"), "mean"
    else:
        reduced = overview(reader_of(source, progress), source.x, source.y, max_pixels=PIXELS, looks=looks)
    with np.errstate(divide="ignore"):
        decibel = 10 * np.log10(reduced.power)
    finite = decibel[np.isfinite(decibel)]
    top = float(finite.max()) if finite.size else 0.0
    if level:
        (dx, dy), x, y = source.spacing, reduced.x_edges, reduced.y_edges
        top += 10 * float(np.log10((x[1] - x[0]) * (y[1] - y[0]) / (dx * dy)))
    bottom = max(float(finite.min()), top - DEEPEST) if finite.size else -DEEPEST
    bottom = min(bottom, top - 1)
    black, white = stretch(decibel)
    x, y = reduced.x_edges, reduced.y_edges
    # Cells at the right and upper ends may reach beyond the image, so the picture takes its sides from the cells.
    return Picture(
        data=data_uri("webp", lossless(decibel, bottom, top)),
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


def lossless(decibel: FloatArray, bottom: float, top: float) -> bytes:
    """Encode dB, grey (n_y, n_x) or in red, green and blue (n_y, n_x, 3), as lossless WebP, upper row first.

    Level 0 is `bottom` or less, 255 is `top`; transparent where not covered, in all colours alike.
    """
    colours = decibel[..., None] if decibel.ndim == 2 else decibel
    level = np.nan_to_num((colours - bottom) / (top - bottom), nan=0.0, neginf=0.0).clip(0, 1)
    shades: NDArray[np.uint8] = np.broadcast_to(np.round(255 * level), (*colours.shape[:2], 3)).astype(np.uint8)
    alpha = np.where(np.isnan(colours[..., :1]), 0, 255).astype(np.uint8)
    pixels = np.concatenate([shades, alpha], axis=-1)[::-1]
    buffer = io.BytesIO()
    imsave(buffer, pixels, format="webp", pil_kwargs={"lossless": True, "quality": 0, "method": 0})
    return buffer.getvalue()


def data_uri(kind: str, content: bytes) -> str:
    """A picture as a data URI."""
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def marks(targets: Sequence[PointResponse | Target], first: Collection[str], picture: Picture) -> Iterator[Mark]:
    """Marks of the targets within the picture; names in `first` are labelled before others."""
    for target in targets:
        if (at := picture.find(target.x, target.y)) is not None:
            yield Mark(target.name, *at, target.name in first)


def chips(source: FinishedRun, targets: Sequence[PointResponse | Target], picture: Picture) -> Iterator[Chip]:
    """Chips around the targets within the picture; none if its cells are about as small as pixels."""
    (dx, dy), axes = source.spacing, (source.x, source.y)
    if picture.cell < 1.5 * max(dx, dy):
        return
    for target in targets:
        if not picture.holds(target.x, target.y):
            continue
        columns, rows = (_slice_around(v, axis, d) for v, axis, d in zip(target[1:3], axes, (dx, dy), strict=True))
        x, y = source.x[columns], source.y[rows]
        with np.errstate(divide="ignore"):
            decibel = 20 * np.log10(np.abs(source.read(rows, columns)))
        corner = picture.place(float(x[0]) - dx / 2, float(y[-1]) + dy / 2)
        data = data_uri("webp", lossless(decibel, picture.bottom, picture.top))
        yield Chip(data, *corner, f"{x.size * dx:.3f}", f"{y.size * dy:.3f}")


def _slice_around(value: float, axis: FloatArray, step: float) -> slice:
    """Slice of CHIP pixels around a coordinate, fewer at the image's edge."""
    at = min(max(round((value - axis[0]) / step), 0), axis.size - 1)
    return slice(max(at - CHIP // 2, 0), min(at + CHIP // 2, axis.size))


def outlines(source: FinishedRun, predicted: Sequence[PredictedBlock], picture: Picture) -> Iterator[Outline]:
    """Borders of the blocks: rays of equal yaw and arcs of equal range around the nadir."""
    for block in predicted[:MOST_ROWS]:
        geometry = source.geometry_of(block.block)
        (low, high), (near, far) = block.yaw, block.range
        yaws = np.linspace(low, high, 2 + int((high - low) / ARC))
        inner = geometry.ground_point(np.array(near), yaws)
        outer = geometry.ground_point(np.array(far), yaws[::-1])
        corners = [picture.place(x, y) for x, y, _ in np.concatenate([inner, outer]) if np.isfinite(x)]
        path = " ".join(f"{'L' if i else 'M'}{x} {y}" for i, (x, y) in enumerate(corners))
        yield Outline(block.name, f"{path}Z", _label_place(source, block, picture))


def _label_place(source: FinishedRun, block: PredictedBlock, picture: Picture) -> tuple[str, str] | None:
    """Place of a block's name: the farthest point with a margin inside the picture, on the most central yaw."""
    (near, far), (low, high) = block.range, block.yaw
    ranges, margin = np.linspace(far, near, 41)[2:-2], 0.03 * max(picture.width, picture.height)
    for share in sorted(np.linspace(0.1, 0.9, 17), key=lambda share: abs(share - 0.5)):
        points = source.geometry_of(block.block).ground_point(ranges, np.array(low + share * (high - low)))
        for x, y, _ in points:
            if np.isfinite(x) and picture.holds(x, y, margin):
                return picture.place(x, y)
    return None


def arrows(source: FinishedRun, picture: Picture, north: float | None) -> list[Arrow]:
    """The look direction at the image's centre, and north if the rotation `north` of x from east, degrees, is known."""
    centre = np.array(picture.centre)
    first, last = (float(t) for t in source.geometry.beam.dwell(*centre))
    time = (first + last) / 2 if first < last else source.geometry.epoch
    look = centre - source.geometry.track.position(np.array(time))[:2]
    directions = [Arrow("look", _svg_angle(look))]
    if north is not None:
        rotation = np.radians(north)
        directions.append(Arrow("N", _svg_angle(np.array([np.sin(rotation), np.cos(rotation)]))))
    return directions


def _svg_angle(direction: FloatArray) -> str:
    """Degrees clockwise from the right of a direction (2,) in x and y."""
    return f"{np.degrees(np.arctan2(-direction[1], direction[0])):.1f}"
