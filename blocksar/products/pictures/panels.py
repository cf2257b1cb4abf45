"""Rows of panels with curves, maps and marks on common scales."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from blocksar.arrays import FloatArray
from blocksar.products.pictures.figures import LIMIT, new_panels, save
from blocksar.products.pictures.overview import NOT_COVERED, Overview, stretch

Style = Literal["-", "--", ":", "."]


class Trace(NamedTuple):
    """A curve of a panel: x, y (n,) in the units of its axes, NaN = gap; style "." draws points."""

    label: str
    x: FloatArray
    y: FloatArray
    colour: str
    style: Style = "-"


class Level(NamedTuple):
    """A limit that a panel shows as a line across it, at y."""

    label: str
    y: float


class Map(NamedTuple):
    """A picture below the curves: decibel (n_y, n_x), NaN = nothing there; cell edges in the units of the axes."""

    decibel: FloatArray
    x_edges: FloatArray
    y_edges: FloatArray
    low: float
    high: float


class Mark(NamedTuple):
    """A word at a place of a panel."""

    text: str
    x: float
    y: float


class Panel(NamedTuple):
    """One pair of axes of `plot_panels`; limits are those of what is shown where they are None.

    `equal`: a unit is as long along y as along x; `log`: y is logarithmic.
    """

    title: str
    x_label: str
    y_label: str
    traces: Sequence[Trace] = ()
    levels: Sequence[Level] = ()
    map: Map | None = None
    marks: Sequence[Mark] = ()
    x_limits: tuple[float, float] | None = None
    y_limits: tuple[float, float] | None = None
    equal: bool = False
    log: bool = False


def plot_panels(
    panels: Sequence[Panel],
    path: str | Path,
    *,
    columns: int = 2,
    size: tuple[float, float] = (4.4, 3.1),
    title: str = "",
    bar: str = "",
) -> None:
    """Write a PNG of panels of curves, limits, words and maps, with one legend, grey scale and colour bar for all.

    Parameters
    ----------
    panels : sequence of Panel
    path : path
        PNG to write.
    columns : int
        Panels a row.
    size : tuple of float
        Of a panel, inches.
    title : str
    bar : str
        What the maps' colours mean, with the unit; no bar if it is empty.
    """
    figure, drawn = new_panels(len(panels), columns=columns, size=size, title=title)
    maps = [panel.map for panel in panels if panel.map is not None]
    scale = (min((m.low for m in maps), default=0.0), max((m.high for m in maps), default=1.0))
    pictures = []
    for axes, panel in zip(drawn, panels, strict=True):
        if panel.map is not None:
            pictures.append(_draw_map(axes, panel.map, scale))
        _draw_panel(axes, panel)
    if pictures and bar:
        figure.colorbar(pictures[0], ax=drawn, extend="both", shrink=0.7, pad=0.02).set_label(bar, fontsize=9)
    _common_legend(figure, panels)
    save(figure, path)


def _draw_map(axes: Axes, shown: Map, scale: tuple[float, float]) -> QuadMesh:
    axes.set_facecolor(NOT_COVERED)
    return axes.pcolormesh(
        shown.x_edges,
        shown.y_edges,
        np.ma.masked_invalid(np.where(np.isneginf(shown.decibel), scale[0], shown.decibel)),
        cmap="gray",
        vmin=scale[0],
        vmax=scale[1],
        rasterized=True,
    )


def _draw_panel(axes: Axes, panel: Panel) -> None:
    axes.set_title(panel.title, fontsize=10)
    axes.xaxis.set_major_locator(MaxNLocator(6))
    axes.set_xlabel(panel.x_label, fontsize=9)
    axes.set_ylabel(panel.y_label, fontsize=9)
    for trace in panel.traces:
        axes.plot(trace.x, trace.y, **_pen(trace.colour, trace.style, over_map=panel.map is not None))
    for level in panel.levels:
        axes.axhline(level.y, color=LIMIT, linestyle="--", linewidth=0.9)
    for mark in panel.marks:
        text = axes.annotate(mark.text, (mark.x, mark.y), ha="center", va="center", fontsize=9, color="#1d242d")
        text.set_path_effects([patheffects.withStroke(linewidth=2.5, foreground="white")])
    if panel.map is None:
        axes.grid(color="#e4e7ec", linewidth=0.5)
        axes.set_axisbelow(True)
    if panel.equal:
        axes.set_aspect("equal")
    if panel.log:
        axes.set_yscale("log")
    if panel.x_limits is not None:
        axes.set_xlim(*panel.x_limits)
    if panel.y_limits is not None:
        axes.set_ylim(*panel.y_limits)


def _pen(colour: str, style: Style, *, over_map: bool = False) -> dict[str, Any]:
    """Keywords of a line. Long gaps over a map, which lines would hide otherwise."""
    if style == ".":
        return {"color": colour, "linestyle": "none", "marker": "o", "markersize": 3.2, "markerfacecolor": "white"}
    dashes = (0, (4, 7)) if over_map and style == "--" else style
    return {"color": colour, "linestyle": dashes, "linewidth": 1.2}


def _common_legend(figure: Figure, panels: Sequence[Panel]) -> None:
    """Below all panels, every label once; traces without one are not named."""
    handles: dict[str, Line2D] = {}
    for panel in panels:
        for label, _, _, colour, style in panel.traces:
            handles.setdefault(label, Line2D([], [], label=label, **_pen(colour, style)))
        for level in panel.levels:
            handles.setdefault(level.label, Line2D([], [], color=LIMIT, linestyle="--", label=level.label))
    named = [handle for label, handle in handles.items() if label]
    if named:
        figure.legend(handles=named, loc="outside lower center", ncols=min(len(named), 4), fontsize=9, frameon=False)


def as_map(seen: Overview, *, scale: tuple[float, float] = (1.0, 1.0)) -> Map:
    """An overview as a panel's map: its grey scale by `stretch`, its edges times `scale` (x, y)."""
    with np.errstate(divide="ignore"):
        decibel = 10 * np.log10(seen.power)
    return Map(decibel, seen.x_edges * scale[0], seen.y_edges * scale[1], *stretch(decibel))
