"""Pictures of the report page: the image as grey levels with overlays in SVG coordinates, and its terrain.

SVG coordinates are m from the image's centre, with y growing downwards.

Import this module only where a picture is drawn: matplotlib is slow to load.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.image import imsave
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from blocksar.arrays import FloatArray
from blocksar.collection.terrain import Terrain
from blocksar.kernels.occlusion import LAYOVER, SHADOW, UNKNOWN
from blocksar.measurement.figures import PointResponse
from blocksar.measurement.targets import Target
from blocksar.products.page.facts import MOST_ROWS
from blocksar.products.pictures.overview import NOT_COVERED, level_for, level_of, overview, reader_of, stretch
from blocksar.products.pictures.panels import minus, new_figure, save
from blocksar.progress.listening import Callback
from blocksar.runs.finished import FinishedRun
from blocksar.runs.record import PredictedBlock

# ---------------------------------------------------------------- image

PIXELS = 1600  # along the longer side, at most: a page of clutter is then some 3 MB
DEEPEST = 100.0  # dB, range of the grey levels below the strongest cell, at most
CHIP = 64  # pixels along a side of the full-resolution chip around a target, shown when zoomed in
MOST_CHIPS = 100
ARC = np.radians(1.0)  # between neighbouring points of a block's outline, at most


@dataclass(frozen=True)
class Picture:
    """The decimated image with its placement in SVG coordinates: m from its centre, y growing downwards.

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


class OverlayMark(NamedTuple):
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


class OverlayArrow(NamedTuple):
    """A direction, degrees clockwise from the right."""

    name: str
    angle: str


def draw(source: FinishedRun, *, looks: Literal["max", "mean"], progress: Callback | None = None) -> Picture:
    """Decimate the image to grey levels: from a mean level of the run's pyramid, or strip by strip from the image.

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


def marks(targets: Sequence[PointResponse | Target], first: Collection[str], picture: Picture) -> Iterator[OverlayMark]:
    """Marks of the targets within the picture; names in `first` are labelled before others."""
    for target in targets:
        if (at := picture.find(target.x, target.y)) is not None:
            yield OverlayMark(target.name, *at, target.name in first)


def chips(source: FinishedRun, targets: Sequence[PointResponse | Target], picture: Picture) -> Iterator[Chip]:
    """Cut chips around the targets within the picture; none if its cells are about as small as pixels."""
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
    """Place for a block's name: the farthest point with a margin inside the picture, on the most central yaw."""
    (near, far), (low, high) = block.range, block.yaw
    ranges, margin = np.linspace(far, near, 41)[2:-2], 0.03 * max(picture.width, picture.height)
    for share in sorted(np.linspace(0.1, 0.9, 17), key=lambda share: abs(share - 0.5)):
        points = source.geometry_of(block.block).ground_point(ranges, np.array(low + share * (high - low)))
        for x, y, _ in points:
            if np.isfinite(x) and picture.holds(x, y, margin):
                return picture.place(x, y)
    return None


def arrows(source: FinishedRun, picture: Picture, north: float | None) -> list[OverlayArrow]:
    """The look direction at the image's centre, and north if the rotation `north` of x from east, degrees, is known."""
    centre = np.array(picture.centre)
    first, last = (float(t) for t in source.geometry.beam.dwell(*centre))
    time = (first + last) / 2 if first < last else source.geometry.epoch
    look = centre - source.geometry.track.position(np.array(time))[:2]
    directions = [OverlayArrow("look", _svg_angle(look))]
    if north is not None:
        rotation = np.radians(north)
        directions.append(OverlayArrow("N", _svg_angle(np.array([np.sin(rotation), np.cos(rotation)]))))
    return directions


def _svg_angle(direction: FloatArray) -> str:
    """Degrees clockwise from the right of a direction (2,) in x and y."""
    return f"{np.degrees(np.arctan2(-direction[1], direction[0])):.1f}"


# ---------------------------------------------------------------- terrain

CELLS = 700  # along the longer side of the picture, at most
SUN = np.array([-0.5, 0.5, 0.7])  # from the upper left, as on maps
CONTOURS = 8  # levels, about
SHADES = {LAYOVER: "#c77800", SHADOW: "#2f5fd0"}
WIDTH, TALLEST = 7.6, 9.0  # of the figure, inches
HALO = withStroke(linewidth=2, foreground="#ffffffc0")  # around text, which is dark, on dark slopes
MOST_NAMED = 40  # targets whose names are written


class ReliefPicture(NamedTuple):
    """The terrain of an image, sampled at the cells of a picture.

    Attributes
    ----------
    x, y : (n_x,), (n_y,) float
        m, ascending.
    height : (n_y, n_x) float
        m; NaN where the image is not covered.
    steepest : float
        Slope of the steepest cell, rad.
    visibility : (n_y, n_x) uint8 or None
        None in runs of earlier versions.
    share : dict
        Share of the covered pixels in layover and in shadow.
    """

    x: FloatArray
    y: FloatArray
    height: FloatArray
    steepest: float
    visibility: NDArray[np.uint8] | None
    share: dict[int, float]

    def sentences(self) -> list[str]:
        """Describe the terrain for the page."""
        low, mean, high = (minus(f"{figure(self.height):.1f}") for figure in (np.nanmin, np.nanmean, np.nanmax))
        lines = [
            f"The image lies on a terrain between z = {low} m and {high} m, {mean} m on average, with slopes of up to "
            f"{np.degrees(self.steepest):.0f} degrees"
        ]
        if self.visibility is not None:
            lines.append(
                f"{100 * self.share[LAYOVER]:.2g} % of the covered pixels are in layover, where other ground has the "
                f"same range and Doppler, and {100 * self.share[SHADOW]:.2g} % are in shadow"
            )
        return lines


def read_relief(source: FinishedRun, terrain: Terrain) -> ReliefPicture:
    """Read the terrain of an image, with shadow and layover."""
    step = -(-max(source.x.size, source.y.size) // CELLS)
    x, y = source.x[step // 2 :: step], source.y[step // 2 :: step]
    layered = (source.image / "visibility" / "zarr.json").exists()
    seen, covered = np.full((y.size, x.size), UNKNOWN, np.uint8), np.zeros((y.size, x.size), bool)
    counts, total, row = dict.fromkeys(SHADES, 0), 0, 0
    for rows in source.strips(0):
        inside = source.read_block(rows, slice(None)) >= 0
        total += int(inside.sum())
        own = slice((step // 2 - rows.start) % step, None, step)
        part = slice(row, row + len(inside[own]))
        covered[part], row = inside[own, step // 2 :: step], part.stop
        if layered:
            layer = source.read_layer("visibility", rows, slice(None))
            seen[part] = layer[own, step // 2 :: step]
            for flag in SHADES:
                counts[flag] += int(((layer == flag) & inside).sum())
    along_x, along_y = terrain.slopes_on_grid(x, y)
    height = np.where(covered, terrain.on_grid(x, y), np.nan)
    slope = np.where(np.isfinite(height), np.hypot(along_x, along_y), np.nan)
    share = {flag: count / max(total, 1) for flag, count in counts.items()}
    return ReliefPicture(x, y, height, float(np.arctan(np.nanmax(slope))), seen if layered else None, share)


def plot_relief(
    relief: ReliefPicture, terrain: Terrain, marks: Sequence[tuple[str, float, float]], path: str | Path
) -> None:
    """Write a PNG of hill shade, contours, shadow and layover; `marks` are names and places of targets, m."""
    x, y = relief.x, relief.y
    along_x, along_y = terrain.slopes_on_grid(x, y)
    normal = np.sqrt(1 + along_x**2 + along_y**2)
    light = np.clip((SUN[2] - SUN[0] * along_x - SUN[1] * along_y) / normal / np.linalg.norm(SUN), 0, 1)
    light[~np.isfinite(relief.height)] = np.nan
    dx, dy = (float(axis[-1] - axis[0]) / max(axis.size - 1, 1) for axis in (x, y))
    extent = (x[0] - dx / 2, x[-1] + dx / 2, y[0] - dy / 2, y[-1] + dy / 2)
    tall = (WIDTH - 1.0) * (extent[3] - extent[2]) / (extent[1] - extent[0]) + 0.9
    figure = new_figure(WIDTH * min(1.0, TALLEST / tall), min(tall, TALLEST))
    axes = figure.add_subplot()
    axes.set_facecolor(NOT_COVERED)
    axes.imshow(light, cmap="gray", vmin=0, vmax=1, origin="lower", extent=extent, interpolation="nearest")
    legend = []
    if relief.visibility is not None:
        for flag, name in ((LAYOVER, "layover"), (SHADOW, "shadow")):
            hit = (relief.visibility == flag) & np.isfinite(relief.height)
            if hit.any():
                shown = np.ma.masked_where(~hit, hit)
                axes.imshow(shown, cmap=ListedColormap([SHADES[flag]]), alpha=0.55, origin="lower", extent=extent)
                legend.append(Patch(facecolor=SHADES[flag], alpha=0.55, label=name))
    levels = MaxNLocator(CONTOURS).tick_values(float(np.nanmin(relief.height)), float(np.nanmax(relief.height)))
    if float(np.nanmax(relief.height)) > float(np.nanmin(relief.height)):
        lines = axes.contour(x, y, relief.height, levels=levels, colors="#7a1f1f", linewidths=0.7, linestyles="solid")
        for text in axes.clabel(lines, fontsize=7, fmt=lambda level: minus(f"{level:g}")):
            text.set_path_effects([HALO])
    for name, at_x, at_y in marks:
        axes.plot(at_x, at_y, "o", markersize=5, markerfacecolor="none", markeredgecolor="#006d8f",
                  markeredgewidth=1.2, path_effects=[HALO])  # fmt: skip
        if len(marks) <= MOST_NAMED:
            axes.annotate(name, (at_x, at_y), (4, 4), textcoords="offset points", fontsize=8, color="#00506a",
                          annotation_clip=True, path_effects=[HALO])  # fmt: skip
    axes.set(xlim=extent[:2], ylim=extent[2:], xlabel="x (m)", ylabel="y (m)")
    axes.tick_params(labelsize=8)
    if legend:
        figure.legend(handles=legend, loc="outside lower center", ncols=len(legend), fontsize=9, frameon=False)
    save(figure, path)
