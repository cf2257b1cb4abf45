"""Figures, panels, colours and legends shared by all pictures.

Figures use the Agg canvas directly, so they need no display and no global state of pyplot.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

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
