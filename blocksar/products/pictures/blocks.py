"""Pictures of blocks on the ground: of a plan, with footprint, grid and flight; and of a mosaic, with targets."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.patches import Patch, Polygon, Rectangle
from matplotlib.ticker import FuncFormatter
from numpy.typing import NDArray

from blocksar.arrays import FloatArray
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.collection.region import Region
from blocksar.constants import unit_of_lengths
from blocksar.measurement.targets import Target
from blocksar.products.pictures.overview import NOT_COVERED, ReadBlock, ReadImage, overview, stretch
from blocksar.products.pictures.panels import MARK, minus, new_figure, save

# ---------------------------------------------------------------- plan

TONES = ("#2f6db3", "#8fb7e0")  # of neighbouring blocks, in turn
TRACK, FOOTPRINT, GRID = "#b3202c", "#1d242d", "#c77800"
MOST_NAMED_BLOCKS = 40  # blocks of more are not named
FLIGHT = 36  # points on the paper, length of the arrow along the flight
OUTLINE_POINTS = 33  # points along a side of an outline
SIZE = (11.0, 5.2)  # inches


class Block(Protocol):
    """Block of a plan, as it is drawn: its name and number, its yaws, rad, its ground, and its prediction."""

    @property
    def name(self) -> str: ...

    @property
    def index(self) -> int: ...

    @property
    def part(self) -> int | None: ...

    @property
    def low(self) -> float: ...

    @property
    def high(self) -> float: ...

    @property
    def ground(self) -> Any: ...

    @property
    def prediction(self) -> Any: ...


def draw_plan(
    geometry: Geometry,
    grid: Grid,
    *,
    blocks: Sequence[Block] = (),
    region: Region | None = None,
    axes: Axes | None = None,
    title: str = "",
) -> Axes:
    """Draw where a plan puts its blocks, and the geometry of the collection.

    Parameters
    ----------
    geometry : Geometry
    grid : Grid
        The image.
    blocks : sequence of Block
        Empty for back-projection.
    region : Region, optional
        What a steered beam lights.
    axes : Axes, optional
        Where to draw the ground; by default a new pyplot figure, which also shows track and footprint from above.
    title : str

    Returns
    -------
    Axes
        Those of the ground.
    """
    if axes is None:
        from matplotlib import pyplot

        figure = pyplot.figure(figsize=SIZE, layout="constrained")
        above, axes = figure.subplots(1, 2, width_ratios=(1, 1.4))
        _draw_above(above, geometry, grid, region)
    outlines = [_block_outline(geometry, block) for block in blocks]
    for block, outline in zip(blocks, outlines, strict=True):
        colour = TONES[(block.index + (block.part or 0)) % 2]
        axes.add_patch(Polygon(outline, facecolor=colour, edgecolor="white", linewidth=0.8))
        if len(blocks) <= MOST_NAMED_BLOCKS:
            _name_block(axes, block, outline, len(blocks))
    if region is not None:
        axes.plot(*_outline(geometry, region).T, color=FOOTPRINT, linewidth=1, linestyle="--", label="footprint")
    axes.add_patch(_box(grid, label=f"image, {grid.shape[1]} x {grid.shape[0]} pixels"))
    axes.autoscale_view()
    axes.margins(0.04)
    legend_note = ", with predicted coherence" if 0 < len(blocks) <= MOST_NAMED_BLOCKS // 4 else ""
    _finish(axes, title or ("blocks on the ground" + legend_note if blocks else "image on the ground"))
    return axes


def _block_outline(geometry: Geometry, block: Block) -> FloatArray:
    """Outline of a block (n, 2), m: its yaws, and its ranges inside the range window."""
    ground = block.ground
    yaw = np.linspace(block.low, block.high, OUTLINE_POINTS)
    near = np.maximum(ground.near, np.interp(yaw, ground.yaw_axis, ground.near_limit))
    far = np.minimum(ground.far, np.interp(yaw, ground.yaw_axis, ground.far_limit))
    return _ring(geometry, yaw, near, np.maximum(near, far))


def _outline(geometry: Geometry, region: Region) -> FloatArray:
    ring = _ring(geometry, region.yaw, region.near, region.far)
    return np.concatenate([ring, ring[:1]])


def _ring(geometry: Geometry, yaw: FloatArray, near: FloatArray, far: FloatArray) -> FloatArray:
    """Points on the ground (n, 2), m, along the near ranges and back along the far ones."""
    points = geometry.ground_point(np.concatenate([near, far[::-1]]), np.concatenate([yaw, yaw[::-1]]))
    return np.asarray(points[:, :2])


def _box(grid: Grid, label: str = "") -> Rectangle:
    x, y = grid.x, grid.y
    return Rectangle(
        (x[0], y[0]), x[-1] - x[0], y[-1] - y[0], fill=False, edgecolor=GRID, linewidth=1.4, label=label
    )  # fmt: skip


def _name_block(axes: Axes, block: Block, outline: FloatArray, count: int) -> None:
    coherence = f"\n{block.prediction.coherence:.4f}" if count <= MOST_NAMED_BLOCKS // 4 else ""
    middle = (outline.min(axis=0) + outline.max(axis=0)) / 2
    axes.annotate(
        f"{block.name}{coherence}", middle, ha="center", va="center", fontsize=8, color="white", clip_on=True,
        bbox={"boxstyle": "round,pad=0.2", "facecolor": FOOTPRINT, "edgecolor": "none", "alpha": 0.65},
    )  # fmt: skip


def _draw_above(axes: Axes, geometry: Geometry, grid: Grid, region: Region | None) -> None:
    """Draw from above the track with its direction, the line of sight at t = 0, and the imaged ground."""
    track, nadir = geometry.collection.antenna_position[:, :2], geometry.nadir[:2]
    axes.plot(*track.T, color=TRACK, linewidth=2, label="track", solid_capstyle="round")
    ground = np.array([[grid.x[0], grid.y[0]], [grid.x[-1], grid.y[-1]]])
    if region is not None:
        ring = _outline(geometry, region)
        axes.add_patch(Polygon(ring, facecolor=TONES[0], edgecolor=FOOTPRINT, linewidth=0.8, label="footprint"))
    axes.add_patch(_box(grid))
    line = {"arrowstyle": "->", "color": FOOTPRINT, "linewidth": 0.8, "linestyle": ":"}
    axes.annotate("", _pair(ground.mean(axis=0)), xytext=_pair(nadir), arrowprops=line)
    axes.plot(*nadir, color=TRACK, marker="+", markersize=9, linestyle="", label="nadir at t = 0")
    way = track[-1] - track[0]
    way = FLIGHT * way / max(float(np.hypot(*way)), 1e-9)
    arrow = {"arrowstyle": "<-", "color": TRACK, "linewidth": 1.6, "shrinkB": 0}
    axes.annotate(
        "flight", _pair(nadir), xytext=_pair(way), textcoords="offset points", ha="center", va="center", fontsize=8,
        color=TRACK, arrowprops=arrow,
    )  # fmt: skip
    axes.autoscale_view()
    axes.margins(0.12)
    _finish(axes, "from above")


def _pair(values: FloatArray) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def _finish(axes: Axes, title: str) -> None:
    """Finish axes: m or km with equal scales, legend and title."""
    x, y = axes.get_xlim(), axes.get_ylim()
    unit, scale = ("km", 1e3) if max(abs(x[1] - x[0]), abs(y[1] - y[0])) >= 10e3 else ("m", 1.0)

    def place(value: float, _: object) -> str:
        return minus(f"{value / scale:,.10g}").replace(",", "\N{NARROW NO-BREAK SPACE}")

    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(FuncFormatter(place))
    axes.locator_params(nbins=6)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel=f"x ({unit})", ylabel=f"y ({unit})")
    axes.set_title(title, fontsize=10, pad=24)
    axes.tick_params(labelsize=8)
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), borderaxespad=0.2, fontsize=8, frameon=False, ncols=3)


# ---------------------------------------------------------------- mosaic

BORDER_COLOUR = "#ffb000"
MOST_MARKS = 200
MOST_NAMED_TARGETS = 12


def plot_mosaic(
    read_image: ReadImage,
    image_x: FloatArray,
    image_y: FloatArray,
    path: str | Path,
    *,
    read_block: ReadBlock | None = None,
    targets: Sequence[Target] = (),
    labels: Sequence[str] | None = None,
    title: str = "",
) -> None:
    """Write a PNG of the mosaic in dB over the ground, with block borders, targets and colour bar.

    Parameters
    ----------
    read_image, image_x, image_y, read_block
        See `overview`; the image is read in strips and never held whole.
    path : path
        PNG to write.
    targets : sequence of Target
        Marked if there are at most MOST_MARKS.
    labels : sequence of str, optional
        Names of the targets to label; by default all of them if there are at most MOST_NAMES.
    title : str
    """
    reduced = overview(read_image, image_x, image_y, read_block=read_block)
    with np.errstate(divide="ignore"):
        decibel = 10 * np.log10(reduced.power)
    low, high = stretch(decibel)
    unit, metres = unit_of_lengths(float(max(np.abs(reduced.x_edges).max(), np.abs(reduced.y_edges).max())))
    x, y = reduced.x_edges / metres, reduced.y_edges / metres
    width, height = float(np.ptp(x)), float(np.ptp(y))
    scale = 8.5 / max(width, height)
    figure = new_figure(max(4.0, width * scale) + 2.0, max(3.0, height * scale) + 1.0)
    axes = figure.add_subplot()
    axes.set_facecolor(NOT_COVERED)
    picture = axes.imshow(
        np.ma.masked_invalid(np.where(np.isneginf(decibel), low, decibel)),
        extent=(x[0], x[-1], y[0], y[-1]),
        origin="lower",
        cmap="gray",
        vmin=low,
        vmax=high,
        interpolation="nearest",
    )
    if reduced.block is not None:
        borders = _borders(reduced.block, x, y)
        axes.add_collection(LineCollection(borders, colors=BORDER_COLOUR, linewidths=0.8, label="block border"))
    if 0 < len(targets) <= MOST_MARKS:
        axes.scatter(
            [t.x / metres for t in targets],
            [t.y / metres for t in targets],
            s=70,
            facecolors="none",
            edgecolors=MARK,
            linewidths=0.6,
            label="target",
        )
    if labels is None:
        labels = [t.name for t in targets] if len(targets) <= MOST_NAMED_TARGETS else []
    for target in targets:
        if target.name in labels:
            _label_target(axes, target, metres)
    axes.set(xlabel=f"x ({unit})", ylabel=f"y ({unit})", title=title or "Mosaic")
    axes.set_xlim(x[0], x[-1])
    axes.set_ylim(y[0], y[-1])
    bar = figure.colorbar(picture, ax=axes, extend="both", shrink=0.85, pad=0.02)
    bar.set_label("power (dB, unit reflectivity = 0), strongest pixel of a cell")
    handles, labels = axes.get_legend_handles_labels()
    if np.isnan(reduced.power).any():
        handles.append(Patch(facecolor=NOT_COVERED))
        labels.append("not covered")
    if handles:
        axes.legend(handles, labels, loc="upper left", fontsize=8, framealpha=0.85)
    save(figure, path)


def _label_target(axes: Axes, target: Target, metres: float) -> None:
    """Write a target's name beside its place; a unit of the axes is `metres` long."""
    text = axes.annotate(
        target.name,
        (target.x / metres, target.y / metres),
        xytext=(6, 5),
        textcoords="offset points",
        color=MARK,
        fontsize=10,
    )
    text.set_path_effects([patheffects.withStroke(linewidth=2.5, foreground="black")])


def _borders(block: NDArray[np.int16], x_edges: FloatArray, y_edges: FloatArray) -> list[FloatArray]:
    """Ends (2, 2) of the line segments along cell edges between two blocks; edges of uncovered cells are no borders."""

    def runs(change: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
        """Iterate over first index and end of every run of True."""
        steps = np.flatnonzero(np.diff(np.concatenate([[False], change, [False]]).astype(np.int8)))
        yield from zip(steps[::2].tolist(), steps[1::2].tolist(), strict=True)

    segments = []
    across = (block[:, 1:] != block[:, :-1]) & (block[:, 1:] >= 0) & (block[:, :-1] >= 0)
    for column in np.flatnonzero(across.any(axis=0)):
        for first, last in runs(across[:, column]):
            x = x_edges[column + 1]
            segments.append(np.array([[x, y_edges[first]], [x, y_edges[last]]]))
    along = (block[1:] != block[:-1]) & (block[1:] >= 0) & (block[:-1] >= 0)
    for row in np.flatnonzero(along.any(axis=1)):
        for first, last in runs(along[row]):
            y = y_edges[row + 1]
            segments.append(np.array([[x_edges[first], y], [x_edges[last], y]]))
    return segments
