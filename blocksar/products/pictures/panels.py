"""Parts of all pictures: colours, legends and panels of curves, limits, maps and labels on common scales.

Figures use the Agg canvas directly, so they need no display and no global state of pyplot.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import QuadMesh
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from blocksar.arrays import FloatArray
from blocksar.products.pictures.overview import NOT_COVERED, Overview, stretch

MARK = "#35c9ff"  # marks and names of targets
LEVEL_COLOURS = ("#8c9bb0", "#2f6db3", "#b3202c")  # contours
CURVE_COLOURS = ("#b3202c", "#1d242d", "#2f6db3", "#2c8a4b", "#8a4fae")  # curves of panels: near, middle, far; others
LIMIT = "#c77800"
DPI = 150


class Curve(NamedTuple):
    """A curve's entry in a legend."""

    label: str
    colour: str
    style: Literal["-", ":"]


def minus(text: str) -> str:
    """Replace hyphens by typographic minus signs, as on the axes."""
    return text.replace("-", "\N{MINUS SIGN}")


def new_figure(width: float, height: float) -> Figure:
    """A figure of a size in inches, with constrained layout."""
    figure = Figure(figsize=(width, height), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def new_panels(count: int, *, columns: int, size: tuple[float, float], title: str) -> tuple[Figure, list[Axes]]:
    """A figure of `count` panels, each of a size in inches, at most `columns` in a row."""
    if count == 0:
        raise ValueError("no responses to draw")
    columns = min(count, columns)
    rows = -(-count // columns)
    figure = new_figure(size[0] * columns + 0.4, size[1] * rows + 0.8)
    if title:
        figure.suptitle(title, fontsize=12)
    panels = [figure.add_subplot(rows, columns, i + 1) for i in range(count)]
    for axes in panels:
        axes.tick_params(labelsize=8)
    return figure, panels


def label_outer_axes(panels: Sequence[Axes], columns: int, x_label: str, y_label: str) -> None:
    """Label x below the lowest panel of each column and y left of the first panel of each row."""
    columns = min(len(panels), columns)
    for i, axes in enumerate(panels):
        if i + columns >= len(panels):
            axes.set_xlabel(x_label, fontsize=9)
        if i % columns == 0:
            axes.set_ylabel(y_label, fontsize=9)


def draw_legend(figure: Figure, entries: Sequence[Curve]) -> None:
    """Draw one legend below all panels."""
    handles = [Line2D([], [], color=colour, linestyle=style, label=label) for label, colour, style in entries]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(entries), fontsize=9, frameon=False)


def save(figure: Figure, path: str | Path) -> None:
    """Write a figure as PNG."""
    figure.savefig(path, format="png")


# ---------------------------------------------------------------- panels

Style = Literal["-", "--", ":", "."]


class Trace(NamedTuple):
    """A curve of a panel: x, y (n,) in the units of the axes, NaN for gaps; style "." draws points."""

    label: str
    x: FloatArray
    y: FloatArray
    colour: str
    style: Style = "-"


class LimitLine(NamedTuple):
    """A limit, drawn as a horizontal line at y."""

    label: str
    y: float


class Map(NamedTuple):
    """A grey-scale map below the curves.

    Attributes
    ----------
    decibel : (n_y, n_x) float
        NaN where there is no value.
    x_edges, y_edges : (n_x + 1,), (n_y + 1,) float
        Edges of the cells, in the units of the axes.
    low, high : float
        Darkest and brightest dB.
    """

    decibel: FloatArray
    x_edges: FloatArray
    y_edges: FloatArray
    low: float
    high: float


class Mark(NamedTuple):
    """A word in a panel, centred on x, y."""

    text: str
    x: float
    y: float


class Panel(NamedTuple):
    """One panel of `plot_panels`.

    Limits that are None follow from the contents. `equal` gives x and y the same scale; `log` makes y logarithmic.
    """

    title: str
    x_label: str
    y_label: str
    traces: Sequence[Trace] = ()
    levels: Sequence[LimitLine] = ()
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
    """Write a PNG of panels that share one legend, one grey scale and one colour bar.

    Parameters
    ----------
    panels : sequence of Panel
    path : path
        PNG to write.
    columns : int
        Panels in a row, at most.
    size : tuple of float
        Width and height of a panel, inches.
    title : str
    bar : str
        Label of the colour bar, with the unit; no bar if empty.
    """
    figure, all_axes = new_panels(len(panels), columns=columns, size=size, title=title)
    maps = [panel.map for panel in panels if panel.map is not None]
    scale = (min((m.low for m in maps), default=0.0), max((m.high for m in maps), default=1.0))
    pictures = []
    for axes, panel in zip(all_axes, panels, strict=True):
        if panel.map is not None:
            pictures.append(_draw_map(axes, panel.map, scale))
        _draw_panel(axes, panel)
    if pictures and bar:
        figure.colorbar(pictures[0], ax=all_axes, extend="both", shrink=0.7, pad=0.02).set_label(bar, fontsize=9)
    _common_legend(figure, panels)
    save(figure, path)


def _draw_map(axes: Axes, grid: Map, scale: tuple[float, float]) -> QuadMesh:
    """Draw a map in grey between the dB of `scale`."""
    axes.set_facecolor(NOT_COVERED)
    return axes.pcolormesh(
        grid.x_edges,
        grid.y_edges,
        np.ma.masked_invalid(np.where(np.isneginf(grid.decibel), scale[0], grid.decibel)),
        cmap="gray",
        vmin=scale[0],
        vmax=scale[1],
        rasterized=True,
    )


def _draw_panel(axes: Axes, panel: Panel) -> None:
    """Draw everything of a panel except its map."""
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
    """Keywords of `plot` for a line; dashes have long gaps over a map, so as not to hide it."""
    if style == ".":
        return {"color": colour, "linestyle": "none", "marker": "o", "markersize": 3.2, "markerfacecolor": "white"}
    dashes = (0, (4, 7)) if over_map and style == "--" else style
    return {"color": colour, "linestyle": dashes, "linewidth": 1.2}


def _common_legend(figure: Figure, panels: Sequence[Panel]) -> None:
    """Draw a legend below all panels with every label once; unlabelled traces are left out."""
    handles: dict[str, Line2D] = {}
    for panel in panels:
        for label, _, _, colour, style in panel.traces:
            handles.setdefault(label, Line2D([], [], label=label, **_pen(colour, style)))
        for level in panel.levels:
            handles.setdefault(level.label, Line2D([], [], color=LIMIT, linestyle="--", label=level.label))
    labelled = [handle for label, handle in handles.items() if label]
    if labelled:
        figure.legend(
            handles=labelled, loc="outside lower center", ncols=min(len(labelled), 4), fontsize=9, frameon=False
        )


def as_map(reduced: Overview, *, scale: tuple[float, float] = (1.0, 1.0)) -> Map:
    """Convert an overview to a map, with the grey scale of `stretch` and edges multiplied by `scale` (x, y)."""
    with np.errstate(divide="ignore"):
        decibel = 10 * np.log10(reduced.power)
    return Map(decibel, reduced.x_edges * scale[0], reduced.y_edges * scale[1], *stretch(decibel))
