"""Pictures: the mosaic in decibels, contours of point responses and their cuts, and panels of curves and maps.

Drawn with matplotlib's object interface on the Agg canvas, so no display and no global state is needed.
Import this module where a picture is wanted, not before: matplotlib is slow to load.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, QuadMesh
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from scipy.ndimage import zoom

from blocksar.measurement import (
    CUT_WIDTHS,
    Complex128Array,
    Response,
    ResponseGrid,
    Target,
    cuts,
    measure,
    response_grid,
)
from blocksar.parameters import SINC_WIDTH, ComplexArray, FloatArray

ReadImage = Callable[[slice, slice], ComplexArray]
ReadBlock = Callable[[slice, slice], NDArray[np.int16]]

PANEL_WIDTHS = 4.5  # median theoretical widths that a contour panel shows on either side
CONTOUR_ZOOM = 4
CONTOUR_LEVELS = (-30.0, -15.0, -3.0)  # dB, as in the paper's Figure 15
NOT_COVERED = "#39506b"  # slate blue: cannot be read as dark ground
BORDER = "#ffb000"
MARK = "#35c9ff"
LEVEL_COLOURS = ("#8c9bb0", "#2f6db3", "#b3202c")
CURVE_COLOURS = ("#b3202c", "#1d242d", "#2f6db3", "#2c8a4b", "#8a4fae")  # of panels: near, middle, far; and more
LIMIT = "#c77800"
DPI = 150


class Curve(NamedTuple):
    """One entry of a legend."""

    label: str
    colour: str
    style: Literal["-", ":"]


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


class Overview(NamedTuple):
    """A decimated image. power (n_y, n_x), NaN = not covered; block likewise or None; cell edges in m."""

    power: FloatArray
    block: NDArray[np.int16] | None
    x_edges: FloatArray
    y_edges: FloatArray


def overview(
    read_image: ReadImage,
    image_x: FloatArray,
    image_y: FloatArray,
    *,
    read_block: ReadBlock | None = None,
    max_pixels: int = 1400,
    looks: Literal["max", "mean"] = "max",
    strip: int = 2**22,
) -> Overview:
    """Decimate |image|^2 to at most `max_pixels` a side, reading a bounded strip of samples at a time.

    Parameters
    ----------
    read_image : callable
        (slice of y, slice of x) -> complex pixels, NaN where not covered.
    image_x, image_y : (n_x,), (n_y,) float
        Pixel positions, m; uniform.
    read_block : callable, optional
        Likewise -> block index, -1 where not covered.
    max_pixels : int
        Of the longer side of the result.
    looks : "max" or "mean"
        Strongest pixel of each cell, which never loses a point target, or mean power, which has least speckle.
    strip : int
        Pixels read at once, at most (one row of cells at least).
    """
    factor = max(1, -(-max(image_x.size, image_y.size) // max_pixels))
    n_y, n_x = -(-image_y.size // factor), -(-image_x.size // factor)
    power = np.full((n_y, n_x), np.nan)
    block = np.full((n_y, n_x), -1, dtype=np.int16) if read_block is not None else None
    rows_at_once = max(1, strip // (factor * image_x.size))
    for first in range(0, n_y, rows_at_once):
        cells = slice(first, min(first + rows_at_once, n_y))
        rows = slice(cells.start * factor, min(cells.stop * factor, image_y.size))
        pixels = read_image(rows, slice(0, image_x.size))
        power[cells] = _reduce(pixels.real**2 + pixels.imag**2, factor, looks)
        if block is not None and read_block is not None:
            block[cells] = _reduce(read_block(rows, slice(0, image_x.size)), factor, "max")
    return Overview(power, block, _edges(image_x, n_x, factor), _edges(image_y, n_y, factor))


def _reduce(values: NDArray[np.float32] | NDArray[np.int16], factor: int, looks: Literal["max", "mean"]) -> FloatArray:
    """Cells of factor x factor pixels, the last ones maybe smaller; NaN only where a whole cell is."""
    padded = np.pad(
        values.astype(np.float32), [(0, -n % factor) for n in values.shape], constant_values=np.float32(np.nan)
    )
    cells = padded.reshape(padded.shape[0] // factor, factor, padded.shape[1] // factor, factor)
    present = np.isfinite(cells)
    count = present.sum(axis=(1, 3))
    if looks == "max":
        found = np.where(present, cells, -np.inf).max(axis=(1, 3))
    else:
        found = np.where(present, cells, 0).sum(axis=(1, 3), dtype=np.float64) / np.maximum(count, 1)
    return np.where(count > 0, found, np.nan)


def _edges(axis: FloatArray, cells: int, factor: int) -> FloatArray:
    step = float(axis[-1] - axis[0]) / max(axis.size - 1, 1)
    return np.asarray(axis[0] - step / 2 + step * factor * np.arange(cells + 1))


def stretch(power_db: FloatArray) -> tuple[float, float]:
    """Darkest and brightest dB of a grey scale, for clutter and for isolated targets alike.

    The top is the 99.9th percentile, but at least 12 dB over the median, so that even clutter is mid-grey, and
    at most 20 dB under the strongest cell; the bottom is the 2nd percentile, but at least 25 and at most 60 dB
    under the top.
    """
    finite = power_db[np.isfinite(power_db)]
    if finite.size == 0:
        return -60.0, 0.0
    low, median, high = (float(v) for v in np.percentile(finite, [2, 50, 99.9]))
    high = max(high, median + 12, float(finite.max()) - 20)
    return float(np.clip(low, high - 60, high - 25)), high


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
    """Write a PNG of the mosaic: dB against km, block borders, target marks, colour bar.

    Parameters
    ----------
    read_image, image_x, image_y, read_block, looks, max_pixels
        See `overview`; the image is read in strips and never held whole.
    path : path
        PNG to write.
    targets : sequence of Target
        All are marked if there are no more than 200.
    labels : sequence of str, optional
        Names of the targets to write out; by default all of them, if there are no more than 12.
    title : str
    """
    seen = overview(read_image, image_x, image_y, read_block=read_block, max_pixels=max_pixels, looks=looks)
    with np.errstate(divide="ignore"):
        decibel = 10 * np.log10(seen.power)
    low, high = stretch(decibel)
    x_km, y_km = seen.x_edges / 1e3, seen.y_edges / 1e3
    width, height = float(np.ptp(x_km)), float(np.ptp(y_km))
    scale = 8.5 / max(width, height)
    figure = _figure(max(4.0, width * scale) + 2.0, max(3.0, height * scale) + 1.0)
    axes = figure.add_subplot()
    axes.set_facecolor(NOT_COVERED)
    shown = np.ma.masked_invalid(np.where(np.isneginf(decibel), low, decibel))
    picture = axes.imshow(
        shown,
        extent=(x_km[0], x_km[-1], y_km[0], y_km[-1]),
        origin="lower",
        cmap="gray",
        vmin=low,
        vmax=high,
        interpolation="nearest",
    )
    if seen.block is not None:
        borders = _borders(seen.block, x_km, y_km)
        axes.add_collection(LineCollection(borders, colors=BORDER, linewidths=0.8, label="block border"))
    if 0 < len(targets) <= 200:
        axes.scatter(
            [t.x / 1e3 for t in targets],
            [t.y / 1e3 for t in targets],
            s=70,
            facecolors="none",
            edgecolors=MARK,
            linewidths=0.6,
            label="target",
        )
    if labels is None:
        labels = [t.name for t in targets] if len(targets) <= 12 else []
    for target in targets:
        if target.name in labels:
            _name(axes, target)
    axes.set(xlabel="x (km)", ylabel="y (km)", title=title or "Mosaic")
    axes.set_xlim(x_km[0], x_km[-1])
    axes.set_ylim(y_km[0], y_km[-1])
    bar = figure.colorbar(picture, ax=axes, extend="both", shrink=0.85, pad=0.02)
    bar.set_label("power (dB, unit reflectivity = 0)" + (", strongest pixel of a cell" if looks == "max" else ""))
    handles, labels = axes.get_legend_handles_labels()
    if np.isnan(seen.power).any():
        handles.append(Patch(facecolor=NOT_COVERED))
        labels.append("not covered")
    if handles:
        axes.legend(handles, labels, loc="upper left", fontsize=8, framealpha=0.85)
    _save(figure, path)


def _name(axes: Axes, target: Target) -> None:
    text = axes.annotate(
        target.name,
        (target.x / 1e3, target.y / 1e3),
        xytext=(6, 5),
        textcoords="offset points",
        color=MARK,
        fontsize=10,
    )
    text.set_path_effects([patheffects.withStroke(linewidth=2.5, foreground="black")])


def _borders(block: NDArray[np.int16], x_edges: FloatArray, y_edges: FloatArray) -> list[FloatArray]:
    """Line pieces (2, 2) along the cell edges where two different blocks meet; the coverage's rim is no border."""

    def runs(change: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
        steps = np.flatnonzero(np.diff(np.concatenate([[False], change, [False]]).astype(np.int8)))
        yield from zip(steps[::2].tolist(), steps[1::2].tolist(), strict=True)

    pieces = []
    across = (block[:, 1:] != block[:, :-1]) & (block[:, 1:] >= 0) & (block[:, :-1] >= 0)
    for column in np.flatnonzero(across.any(axis=0)):
        for first, last in runs(across[:, column]):
            x = x_edges[column + 1]
            pieces.append(np.array([[x, y_edges[first]], [x, y_edges[last]]]))
    along = (block[1:] != block[:-1]) & (block[1:] >= 0) & (block[:-1] >= 0)
    for row in np.flatnonzero(along.any(axis=1)):
        for first, last in runs(along[row]):
            y = y_edges[row + 1]
            pieces.append(np.array([[x_edges[first], y], [x_edges[last], y]]))
    return pieces


def plot_contours(responses: Sequence[Response], path: str | Path, *, title: str = "") -> None:
    """Write a PNG of contours at -3, -15 and -30 dB, one panel a target, on the response's own axes in metres.

    Three panels a row, like the paper's Figure 15; nine targets give its 3 x 3. All panels have one scale, along
    both axes, so that widths can be compared by eye.
    """
    figure, panels = _panels(len(responses), columns=3, size=(3.1, 3.1), title=title)
    reach = PANEL_WIDTHS * max(
        float(np.median([getattr(r.axes, f"{axis}_width") for r in responses])) for axis in ("range", "azimuth")
    )
    for axes, response in zip(panels, responses, strict=True):
        axes.set_title(response.target.name, fontsize=11)
        axes.set_xlim(-reach, reach)
        axes.set_ylim(-reach, reach)
        axes.set_aspect("equal")
        axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
        axes.yaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
        axes.grid(color="#e4e7ec", linewidth=0.5)
        axes.set_axisbelow(True)
        widths = 1.05 * reach / min(response.axes.range_width, response.axes.azimuth_width)
        # Beyond what was read of a response there is nothing to fill a panel with.
        _draw_contours(axes, response_grid(response, widths=min(widths, CUT_WIDTHS)))
    _outer_labels(panels, 3, "slant range (m)", "azimuth (m)")
    levels = zip(CONTOUR_LEVELS, LEVEL_COLOURS, strict=True)
    _legend(figure, [Curve(_minus(f"{level:g} dB"), colour, "-") for level, colour in levels])
    _save(figure, path)


def _draw_contours(axes: Axes, grid: ResponseGrid) -> None:
    if not np.isfinite(grid.values).any():
        axes.text(0.5, 0.5, "not covered", ha="center", va="center", transform=axes.transAxes, color="#5a6676")
        return
    values = grid.values
    if np.isfinite(values).all():
        # The nulls below -30 dB are a twentieth of a width across; a spline through complex values finds them.
        values = zoom(values.real, CONTOUR_ZOOM) + 1j * zoom(values.imag, CONTOUR_ZOOM)
    with np.errstate(divide="ignore"):
        decibel = 20 * np.log10(np.abs(values) / np.nanmax(np.abs(values)))
    axes.contour(
        np.linspace(grid.range_offset[0], grid.range_offset[-1], values.shape[1]),
        np.linspace(grid.azimuth_offset[0], grid.azimuth_offset[-1], values.shape[0]),
        np.ma.masked_invalid(np.maximum(decibel, -100)),
        levels=CONTOUR_LEVELS,
        colors=LEVEL_COLOURS,
        linewidths=1.0,
        linestyles="solid",
    )


def plot_cuts(responses: Sequence[Response], path: str | Path, *, title: str = "") -> None:
    """Write a PNG of the range and azimuth cuts in dB over the ideal sinc, two panels a target, three targets a row.

    Offsets are in m from the peak; each panel tells its PSLR and width.
    """
    figure, panels = _panels(2 * len(responses), columns=6, size=(2.35, 2.5), title=title)
    for (left, right), response in zip(zip(panels[::2], panels[1::2], strict=True), responses, strict=True):
        sampled, found, name = cuts(response), measure(response), response.target.name
        left.set_title(_caption(f"{name} range", found.range_pslr, found.range_irw), fontsize=8)
        _draw_cut(left, sampled.range_offset, sampled.range_profile, found.range_irw_theory, "#2f6db3")
        right.set_title(_caption(f"{name} azimuth", found.azimuth_pslr, found.azimuth_irw), fontsize=8)
        _draw_cut(right, sampled.azimuth_offset, sampled.azimuth_profile, found.azimuth_irw_theory, "#b3202c")
    _outer_labels(panels, 6, "offset (m)", "power (dB)")
    _legend(
        figure,
        [
            Curve("range cut", "#2f6db3", "-"),
            Curve("azimuth cut", "#b3202c", "-"),
            Curve("ideal sinc", "#1d242d", ":"),
        ],
    )
    _save(figure, path)


def _draw_cut(axes: Axes, offset: FloatArray, profile: Complex128Array, width: float, colour: str) -> None:
    with np.errstate(divide="ignore", invalid="ignore"):
        ideal = 20 * np.log10(np.abs(np.sinc(offset / width * SINC_WIDTH)))
        measured = 20 * np.log10(np.abs(profile / profile[profile.size // 2]))
    axes.plot(offset, measured, color=colour, linewidth=1.1)
    # Over the measured curve, so that neither hides the other where they agree.
    axes.plot(offset, ideal, color="#1d242d", linestyle=":", linewidth=0.8)
    axes.set_xlim(-CUT_WIDTHS * width, CUT_WIDTHS * width)
    axes.set_ylim(-45, 2)
    axes.grid(color="#e4e7ec", linewidth=0.5)


def _caption(name: str, pslr: float, irw: float) -> str:
    return _minus(f"{name}: {pslr:.2f} dB, {irw:.2f} m") if np.isfinite([pslr, irw]).all() else f"{name}: not covered"


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
    figure, drawn = _panels(len(panels), columns=columns, size=size, title=title)
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
    _save(figure, path)


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


def _minus(text: str) -> str:
    """With typographic minus signs, as on the axes."""
    return text.replace("-", "\N{MINUS SIGN}")


def _figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _panels(count: int, *, columns: int, size: tuple[float, float], title: str) -> tuple[Figure, list[Axes]]:
    if count == 0:
        raise ValueError("no responses to draw")
    columns = min(count, columns)
    rows = -(-count // columns)
    figure = _figure(size[0] * columns + 0.4, size[1] * rows + 0.8)
    if title:
        figure.suptitle(title, fontsize=12)
    panels = [figure.add_subplot(rows, columns, i + 1) for i in range(count)]
    for axes in panels:
        axes.tick_params(labelsize=8)
    return figure, panels


def _outer_labels(panels: Sequence[Axes], columns: int, x_label: str, y_label: str) -> None:
    columns = min(len(panels), columns)
    for i, axes in enumerate(panels):
        if i + columns >= len(panels):
            axes.set_xlabel(x_label, fontsize=9)
        if i % columns == 0:
            axes.set_ylabel(y_label, fontsize=9)


def _legend(figure: Figure, entries: Sequence[Curve]) -> None:
    handles = [Line2D([], [], color=colour, linestyle=style, label=label) for label, colour, style in entries]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(entries), fontsize=9, frameon=False)


def _save(figure: Figure, path: str | Path) -> None:
    figure.savefig(path, format="png")
