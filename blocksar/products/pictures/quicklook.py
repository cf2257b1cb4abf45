"""Quick looks of an image: dB on a grey scale, axes in metres, a scale bar, north and the look direction.

The grey scale is that of `overview.stretch`: percentiles of the dB, so that clutter is mid-grey and single strong
targets neither darken the rest nor vanish. Pixels are averaged in power over the cells of the picture, strip by strip.
Import this module only where a picture is drawn: matplotlib is slow to load.
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from numbers import Integral
from typing import Literal, NamedTuple

import numpy as np
from matplotlib import colormaps, patheffects
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from matplotlib.text import OffsetFrom
from matplotlib.ticker import FuncFormatter

from blocksar.arrays import FloatArray
from blocksar.collection.geometry import Geometry
from blocksar.collection.georeference import Georeference
from blocksar.errors import InputError
from blocksar.places import Location
from blocksar.products.backscatter import BackscatterRun
from blocksar.products.pictures.overview import (
    NOT_COVERED,
    Overview,
    ReadImage,
    mean_of,
    overview,
    range_notes,
    reader_of,
    stretch,
)
from blocksar.products.pictures.panels import DPI, MARK
from blocksar.products.writing import replacing
from blocksar.progress.listening import Callback
from blocksar.runs.finished import FinishedRun
from blocksar.texts import frequency_text

GREY = "gray"
POWER = "power (dB, unit reflectivity = 0)"
PIXELS = 1600  # along the longer side, at most
SMALLEST, LARGEST = 200, 20_000  # pixels of a picture along its longer side
STRIP = 1 << 20  # pixels of the image read at once
INCHES = 9.0  # along the longer side
BAR = 0.25  # share of the picture's width that the scale bar may take
HALO: list[patheffects.AbstractPathEffect] = [patheffects.withStroke(linewidth=2.5, foreground="black")]


class Arrow(NamedTuple):
    """A direction in the scene frame, (2,) in x and y, with a label at its tip."""

    label: str
    direction: FloatArray
    colour: str


def write(
    source: FinishedRun,
    out: Location,
    *,
    others: Sequence[FinishedRun] = (),
    cell: tuple[int, int] = (1, 1),
    limits: tuple[float, float] | None = None,
    colour_map: str | None = None,
    size: int | None = None,
    overwrite: bool = False,
    progress: Callback | None = None,
) -> list[str]:
    """Write a PNG of an image.

    Parameters
    ----------
    others : sequence of FinishedRun
        Looks or channels whose mean power with that of `source` is drawn.
    cell : (int, int)
        As for `overview`.
    limits : (float, float), optional
        dB drawn in the first and the last colour. Default: by the image.
    colour_map : str, optional
        A name that matplotlib knows. Default: "gray".
    size : int, optional
        Pixels of the picture along its longer side. Default: 1600 pixels for the image's cells, and room for axes.

    Returns
    -------
    list of str
        Notes for the user: size of the cells, and the scale in dB.

    Raises
    ------
    InputError
        If there is no covered pixel, an option is wrong, or `out` cannot be written.
    ProcessingError
        If writing fails.
    """
    colour_map = checked_colour_map(colour_map)
    size = checked_size(size)
    caption = caption_of(source)
    source.coverage()  # raises if no pixel is covered
    with replacing(out, overwrite=overwrite) as part:
        read, title = reader_of(source, progress), source.title
        if others:
            read = mean_of([read, *(other.read for other in others)])
            kind = "looks" if "look" in source.attrs else "channels"
            title = f"{source.scene_title}, mean power of {len(others) + 1} {kind}"
        reduced = overview(
            read, source.x, source.y, max_pixels=max(PIXELS, size or 0), looks="mean", cell=cell, strip=STRIP
        )
        arrows = scene_arrows(reduced, source.geometry, source.georeference)
        low, high = save(
            part, reduced, title=title, caption=caption, arrows=arrows, limits=limits, colour_map=colour_map,
            size=size, label=source.label if isinstance(source, BackscatterRun) else POWER,
        )  # fmt: skip
    side = float(reduced.x_edges[1] - reduced.x_edges[0]), float(reduced.y_edges[1] - reduced.y_edges[0])
    scale = "grey" if colour_map == GREY else colour_map
    with np.errstate(divide="ignore"):
        notes = range_notes(10 * np.log10(reduced.power), (low, high))
    return [f"cells of {side[0]:.4g} m x {side[1]:.4g} m, {scale} from {low:.1f} to {high:.1f} dB", *notes]


def save(
    path: str,
    reduced: Overview,
    *,
    title: str,
    caption: str,
    arrows: list[Arrow],
    limits: tuple[float, float] | None = None,
    colour_map: str = GREY,
    size: int | None = None,
    label: str = POWER,
) -> tuple[float, float]:
    """Write a decimated image as a PNG file; return the dB of the first and the last colour."""
    figure, axes = new_figure(reduced, size)
    limits = draw(axes, reduced, arrows=arrows, limits=limits, colour_map=colour_map, label=label)
    axes.set_title(title, fontsize=11)
    figure.supxlabel(caption, fontsize=8, color="#5a6676")
    figure.savefig(path, format="png")
    return limits


def checked_size(size: int | None) -> int | None:
    """Check the number of pixels along a picture's longer side.

    Raises
    ------
    InputError
        If they are too few or too many.
    """
    if size is not None and not (isinstance(size, Integral) and SMALLEST <= size <= LARGEST):
        raise InputError(f"size = {size!r}: give {SMALLEST} to {LARGEST} pixels along the longer side of the picture")
    return size


def checked_colour_map(name: str | None) -> str:
    """Check the name of a colour map, grey by default.

    Raises
    ------
    InputError
        If matplotlib has none of this name.
    """
    if name is None:
        return GREY
    if name in list(colormaps):
        return name
    near = difflib.get_close_matches(str(name), colormaps, n=1)
    raise InputError(
        f"colour map {name!r} is none that matplotlib knows; did you mean {near[0] if near else 'viridis'!r}?"
    )


def draw(
    axes: Axes,
    reduced: Overview,
    *,
    arrows: list[Arrow] | None = None,
    limits: tuple[float, float] | None = None,
    colour_map: str = GREY,
    label: str = POWER,
) -> tuple[float, float]:
    """Draw a decimated image into a pair of axes, with a scale bar and a colour bar.

    Returns
    -------
    (float, float)
        dB drawn in the first and in the last colour.
    """
    with np.errstate(divide="ignore"):
        decibel = 10 * np.log10(reduced.power)
    low, high = limits or stretch(decibel)
    axes.set_facecolor(NOT_COVERED)
    picture = axes.imshow(
        np.ma.masked_invalid(np.where(np.isneginf(decibel), low, decibel)),
        extent=(reduced.x_edges[0], reduced.x_edges[-1], reduced.y_edges[0], reduced.y_edges[-1]),
        origin="lower",
        cmap=colour_map,
        vmin=low,
        vmax=high,
        interpolation="nearest",
    )
    draw_colour_bar(axes, picture, label)
    furnish(axes, reduced, arrows=arrows or [])
    return low, high


def furnish(axes: Axes, reduced: Overview, *, arrows: list[Arrow], handles: Sequence[Patch] = ()) -> None:
    """Label the axes of a picture, draw scale bar and arrows, and explain the colours.

    `handles` make a legend above the picture; without them there is one in its corner if cells are not covered.
    """
    axes.set(xlabel="x (m)", ylabel="y (m)")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(FuncFormatter(_grouped))
    _draw_scale_bar(axes, reduced)
    for place, arrow in enumerate(arrows):
        draw_arrow(axes, arrow, place)
    blank = [Patch(facecolor=NOT_COVERED, label="not covered")] if np.isnan(reduced.power).any() else []
    if handles:
        figure = axes.get_figure()
        assert figure is not None
        legend = [*handles, *blank]
        figure.legend(handles=legend, loc="outside upper center", ncols=len(legend), fontsize=8, frameon=False)
    elif blank:
        axes.legend(handles=blank, loc="upper left", fontsize=8, framealpha=0.85)


def _grouped(value: float, _: object) -> str:
    """Format m for the ticks of an axis, digits in groups of three."""
    return f"{value:,.10g}".replace("-", "\N{MINUS SIGN}").replace(",", "\N{NARROW NO-BREAK SPACE}")


def show(read: ReadImage, x: FloatArray, y: FloatArray, *, axes: Axes | None, arrows: list[Arrow]) -> Axes:
    """Draw an image, read strip by strip, into `axes`, or into a new pyplot figure if None."""
    reduced = overview(read, x, y, max_pixels=PIXELS, looks="mean", strip=STRIP)
    if axes is None:
        from matplotlib import pyplot

        axes = pyplot.figure(figsize=_size(reduced), layout="constrained").add_subplot()
    draw(axes, reduced, arrows=arrows)
    return axes


def north_arrow(rotation: float) -> Arrow:
    """North in a frame whose x axis is rotated from east by `rotation` degrees counter-clockwise."""
    angle = np.radians(rotation)
    return Arrow("N", np.array([np.sin(angle), np.cos(angle)]), "white")


def _size(reduced: Overview) -> tuple[float, float]:
    """Width and height of the figure, inches."""
    width, height = float(np.ptp(reduced.x_edges)), float(np.ptp(reduced.y_edges))
    scale = INCHES / max(width, height)
    return max(4.0, width * scale) + 1.8, max(3.0, height * scale) + 1.0


def new_figure(reduced: Overview, size: int | None = None) -> tuple[Figure, Axes]:
    inches = _size(reduced)
    dots = DPI if size is None else size / max(inches)
    figure = Figure(figsize=inches, dpi=dots, layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.add_subplot()


def scene_arrows(reduced: Overview, geometry: Geometry, frame: Georeference | None) -> list[Arrow]:
    """The look direction at the middle of the covered area, and north if it is known."""
    rows, columns = np.nonzero(np.isfinite(reduced.power))
    arrows = []
    if rows.size:
        x = (reduced.x_edges[:-1] + reduced.x_edges[1:])[columns].mean() / 2
        y = (reduced.y_edges[:-1] + reduced.y_edges[1:])[rows].mean() / 2
        first, last = (float(t) for t in geometry.beam.dwell(x, y))
        time = (first + last) / 2 if first < last else geometry.epoch
        arrows.append(Arrow("look", np.array([x, y]) - geometry.track.position(np.array(time))[:2], MARK))
    if frame is not None:
        arrows.append(north_arrow(frame.rotation))
    return arrows


def caption_of(source: FinishedRun) -> str:
    """Carrier, pixel spacing and, if georeferenced, the centre of the image."""
    dx, dy = source.spacing
    parts = [frequency_text(source.collection.carrier), f"pixels {dx:.4g} m x {dy:.4g} m"]
    if source.georeference is not None:
        centre = np.array([source.x.mean(), source.y.mean(), source.ground_height])
        try:
            latitude, longitude, _ = source.georeference.to_geodetic(centre)
        except InputError:  # pyproj is not installed, and a picture does not need it
            return "   ".join(parts)
        south, west = "NS"[int(latitude < 0)], "EW"[int(longitude < 0)]
        parts.append(f"centre {abs(latitude):.6f}\N{DEGREE SIGN} {south}, {abs(longitude):.6f}\N{DEGREE SIGN} {west}")
    return "   ".join(parts)


def draw_colour_bar(
    axes: Axes, picture: ScalarMappable, label: str, *, extend: Literal["both", "neither"] = "both"
) -> None:
    """Draw the colour bar of a picture; `extend` marks ends beyond which values may lie."""
    figure = axes.get_figure()
    assert figure is not None
    bar = figure.colorbar(picture, ax=axes, extend=extend, shrink=0.85, pad=0.02)
    bar.set_label(label)


def round_length(longest: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that does not exceed `longest`.

    Examples
    --------
    >>> round_length(37.0), round_length(0.5), round_length(1999.0)
    (20.0, 0.5, 1000.0)
    """
    decade = 10.0 ** np.floor(np.log10(longest))
    return float(max(step * decade for step in (1, 2, 5) if step * decade <= longest * (1 + 1e-9)))


def _draw_scale_bar(axes: Axes, reduced: Overview) -> None:
    """Draw the scale bar at the lower left, on a dark background."""
    width, height = float(np.ptp(reduced.x_edges)), float(np.ptp(reduced.y_edges))
    length, side = round_length(BAR * width), max(width, height)
    x, y = reduced.x_edges[0] + 0.03 * width, reduced.y_edges[0] + 0.03 * height
    pad, thick = 0.012 * side, 0.008 * side
    background = Rectangle(
        (x - pad, y - pad), length + 2 * pad, thick + 0.03 * side + 2 * pad, color="black", alpha=0.55, lw=0
    )
    axes.add_patch(background)
    axes.add_patch(Rectangle((x, y), length, thick, color="white", lw=0))
    text = f"{length / 1e3:g} km" if length >= 1e3 else f"{length:g} m"
    axes.text(x + length / 2, y + 1.5 * thick, text, color="white", ha="center", va="bottom", fontsize=9)


def draw_arrow(axes: Axes, arrow: Arrow, place: int) -> None:
    """Draw an arrow at the upper right, to the left of the `place` arrows drawn before it.

    Its length is fixed in points, its direction that of the scene. The spacing keeps all labels within the picture and
    apart, whatever the directions.
    """
    direction = arrow.direction / np.linalg.norm(arrow.direction)
    centre = np.array([-44.0 - 78.0 * place, -40.0])  # points from the corner
    corner = OffsetFrom(axes.patch, (1.0, 1.0))
    line = axes.annotate(
        "",
        tuple(centre + 14 * direction),
        xycoords=corner,
        xytext=tuple(centre - 14 * direction),
        textcoords=corner,
        arrowprops={"arrowstyle": "->,head_width=0.3,head_length=0.45", "color": arrow.colour, "linewidth": 1.8},
    )
    assert line.arrow_patch is not None
    line.arrow_patch.set_path_effects([patheffects.withStroke(linewidth=4.5, foreground="black")])
    text = axes.annotate(
        arrow.label,
        tuple(centre + 26 * direction),
        xycoords=corner,
        color=arrow.colour,
        ha="center",
        va="center",
        fontsize=9,
    )
    text.set_path_effects(HALO)
