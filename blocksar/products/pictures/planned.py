"""The picture of a plan: blocks, footprint and grid on the ground, and where the platform flies."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Polygon, Rectangle
from matplotlib.ticker import FuncFormatter

from blocksar.arrays import FloatArray
from blocksar.collection.geometry import Geometry
from blocksar.collection.grid import Grid
from blocksar.collection.region import Region
from blocksar.planning.block import BlockPlan
from blocksar.products.pictures.figures import minus

TONES = ("#2f6db3", "#8fb7e0")  # of neighbouring blocks, in turn
TRACK, FOOTPRINT, GRID = "#b3202c", "#1d242d", "#c77800"
MOST_NAMES = 40  # blocks of more are not named
FLIGHT = 36  # points on the paper, length of the arrow along the flight
BORDER = 33  # points along a side of an outline
SIZE = (11.0, 5.2)  # inches


def draw_plan(
    geometry: Geometry,
    grid: Grid,
    *,
    blocks: Sequence[BlockPlan] = (),
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
    blocks : sequence of BlockPlan
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
        if len(blocks) <= MOST_NAMES:
            _name_block(axes, block, outline, len(blocks))
    if region is not None:
        axes.plot(*_outline(geometry, region).T, color=FOOTPRINT, linewidth=1, linestyle="--", label="footprint")
    axes.add_patch(_box(grid, label=f"image, {grid.shape[1]} x {grid.shape[0]} pixels"))
    axes.autoscale_view()
    axes.margins(0.04)
    told = ", with predicted coherence" if 0 < len(blocks) <= MOST_NAMES // 4 else ""
    _finish(axes, title or ("blocks on the ground" + told if blocks else "image on the ground"))
    return axes


def _block_outline(geometry: Geometry, block: BlockPlan) -> FloatArray:
    """Corners of a block (n, 2), m: its yaws, and of its ranges those inside the range window."""
    ground = block.ground
    yaw = np.linspace(block.low, block.high, BORDER)
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


def _name_block(axes: Axes, block: BlockPlan, outline: FloatArray, count: int) -> None:
    coherence = f"\n{block.prediction.coherence:.4f}" if count <= MOST_NAMES // 4 else ""
    middle = (outline.min(axis=0) + outline.max(axis=0)) / 2
    axes.annotate(
        f"{block.name}{coherence}", middle, ha="center", va="center", fontsize=8, color="white", clip_on=True,
        bbox={"boxstyle": "round,pad=0.2", "facecolor": FOOTPRINT, "edgecolor": "none", "alpha": 0.65},
    )  # fmt: skip


def _draw_above(axes: Axes, geometry: Geometry, grid: Grid, region: Region | None) -> None:
    """Draw the track with its direction, the line of sight at t = 0, and the ground that is imaged, from above."""
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
    """Axes in m or km with equal scales, a legend and a title."""
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
