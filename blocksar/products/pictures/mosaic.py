"""The picture of a mosaic: power in dB, block borders and marked targets."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.patches import Patch
from numpy.typing import NDArray

from blocksar.arrays import FloatArray
from blocksar.constants import unit_of_lengths
from blocksar.measurement.targets import Target
from blocksar.products.pictures.figures import MARK, new_figure, save
from blocksar.products.pictures.overview import NOT_COVERED, ReadBlock, ReadImage, overview, stretch

BORDER = "#ffb000"
MOST_MARKS = 200
MOST_NAMES = 12


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
    looks: Literal["max", "mean"] = "max",
    max_pixels: int = 1400,
) -> None:
    """Write a PNG of the mosaic: dB against places, block borders, target marks, colour bar.

    Parameters
    ----------
    read_image, image_x, image_y, read_block, looks, max_pixels
        See `overview`; the image is read in strips and never held whole.
    path : path
        PNG to write.
    targets : sequence of Target
        Marked if there are at most MOST_MARKS.
    labels : sequence of str, optional
        Names of the targets to label; by default all of them if there are at most MOST_NAMES.
    title : str
    """
    reduced = overview(read_image, image_x, image_y, read_block=read_block, max_pixels=max_pixels, looks=looks)
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
        axes.add_collection(LineCollection(borders, colors=BORDER, linewidths=0.8, label="block border"))
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
        labels = [t.name for t in targets] if len(targets) <= MOST_NAMES else []
    for target in targets:
        if target.name in labels:
            _label_target(axes, target, metres)
    axes.set(xlabel=f"x ({unit})", ylabel=f"y ({unit})", title=title or "Mosaic")
    axes.set_xlim(x[0], x[-1])
    axes.set_ylim(y[0], y[-1])
    bar = figure.colorbar(picture, ax=axes, extend="both", shrink=0.85, pad=0.02)
    bar.set_label("power (dB, unit reflectivity = 0)" + (", strongest pixel of a cell" if looks == "max" else ""))
    handles, labels = axes.get_legend_handles_labels()
    if np.isnan(reduced.power).any():
        handles.append(Patch(facecolor=NOT_COVERED))
        labels.append("not covered")
    if handles:
        axes.legend(handles, labels, loc="upper left", fontsize=8, framealpha=0.85)
    save(figure, path)


def _label_target(axes: Axes, target: Target, metres: float) -> None:
    """Write a target's name beside its place; axes count so many metres."""
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
        """First index and end of every run of True."""
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
