"""The terrain of an image as a picture: hill shade, contours, and where shadow and layover lie.

Import this module only where a picture is drawn: matplotlib is slow to load.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from blocksar.arrays import FloatArray
from blocksar.collection.terrain import Terrain
from blocksar.kernels.occlusion import LAYOVER, SHADOW, UNKNOWN
from blocksar.products.pictures.figures import minus, new_figure, save
from blocksar.products.pictures.overview import NOT_COVERED
from blocksar.runs.finished import FinishedRun

CELLS = 700  # along the longer side of the picture, at most
SUN = np.array([-0.5, 0.5, 0.7])  # from the upper left, as on maps
CONTOURS = 8  # levels, about
SHADES = {LAYOVER: "#c77800", SHADOW: "#2f5fd0"}
WIDTH, TALLEST = 7.6, 9.0  # of the figure, inches
HALO = withStroke(linewidth=2, foreground="#ffffffc0")  # around text, which is dark, on dark slopes
MOST_NAMED = 40  # targets whose names are written


class Relief(NamedTuple):
    """The terrain of an image at the cells of a picture.

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
        """Say what a page says of it."""
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


def read_relief(source: FinishedRun, terrain: Terrain) -> Relief:
    """The terrain of an image, and what it does to the image."""
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
    return Relief(x, y, height, float(np.arctan(np.nanmax(slope))), seen if layered else None, share)


def plot_relief(relief: Relief, terrain: Terrain, marks: Sequence[tuple[str, float, float]], path: str | Path) -> None:
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
