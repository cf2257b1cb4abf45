"""Pictures of point responses: contours and cuts; and of tracks and looks.

Import this module only where a picture is drawn: matplotlib is slow to load.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator
from scipy.ndimage import zoom

from blocksar.arrays import Complex128Array, FloatArray
from blocksar.collection.weighting import CUT_WIDTHS
from blocksar.measurement.figures import BEYOND, ResponseGrid, cuts, ideal_cuts, measure_cuts, response_grid
from blocksar.measurement.response import Response
from blocksar.products.look_spectra import LookSpectra
from blocksar.products.pictures.panels import (
    CURVE_COLOURS,
    LEVEL_COLOURS,
    Curve,
    draw_legend,
    label_outer_axes,
    minus,
    new_figure,
    new_panels,
    save,
)
from blocksar.runs.track import DEPTH, TrackCorrection

DEVIATIONS = 2.0  # standard deviations on either side of the error that are shaded
MOST_CHIPS = 6
COLOUR = CURVE_COLOURS[2]


def plot_track(correction: TrackCorrection, path: str | Path) -> None:
    """Write a PNG of the correction of the track in x, y and z, mm, over slow time, with its predicted uncertainty."""
    figure, panels = new_panels(3, columns=3, size=(3.2, 2.5), title="")
    for axis, axes in enumerate(panels):
        error, spread = 1e3 * correction.error[:, axis], 1e3 * DEVIATIONS * correction.uncertainty[:, axis]
        axes.fill_between(correction.time, error - spread, error + spread, color=COLOUR, alpha=0.25, linewidth=0)
        axes.plot(correction.time, error, color=COLOUR, linewidth=1.2)
        axes.axhline(0, color="#8c9bb0", linewidth=0.6)
        axes.set_title("xyz"[axis], fontsize=10)
        axes.set_xlabel("slow time (s)", fontsize=9)
        axes.grid(color="#e4e7ec", linewidth=0.5)
        axes.set_axisbelow(True)
        axes.margins(x=0)
    limits = [axes.get_ylim() for axes in panels]
    for axes in panels:  # one scale: the eye compares the axes
        axes.set_ylim(min(low for low, _ in limits), max(high for _, high in limits))
        axes.tick_params(labelleft=axes is panels[0])
    panels[0].set_ylabel("error of the track (mm)", fontsize=9)
    save(figure, path)


def plot_chips(correction: TrackCorrection, path: str | Path) -> None:
    """Write a PNG of chips about some points, before correction above and after it below, in dB from the brightest."""
    count = min(len(correction.before), MOST_CHIPS)
    figure = new_figure(1.55 * count + 0.9, 3.5)
    rows = (("before", correction.before), ("after", correction.after))
    for row, (name, chips) in enumerate(rows):
        for column in range(count):
            axes = figure.add_subplot(2, count, row * count + column + 1)
            decibels = DEPTH * (chips[column] / 255.0 - 1)
            shown = axes.imshow(decibels, cmap="gray", vmin=-DEPTH, vmax=0, origin="lower", aspect="auto")
            axes.set_xticks([])
            axes.set_yticks([])
            if row == 0:
                x, y = correction.places[column]
                axes.set_title(f"x {x:.0f} m\ny {y:.0f} m".replace("-", "\N{MINUS SIGN}"), fontsize=7)
            if column == 0:
                axes.set_ylabel(name, fontsize=9)
    bar = figure.colorbar(shown, ax=figure.axes, shrink=0.8, pad=0.01)
    bar.set_label("power (dB)", fontsize=8)
    bar.ax.tick_params(labelsize=7)
    save(figure, path)


def has_chips(correction: TrackCorrection) -> bool:
    """Tell whether there are chips to draw."""
    return bool(correction.before.size) and bool(np.any(correction.before))


DEEPEST = -50.0  # dB
MOST_NAMED = 8


def plot_looks(spectra: LookSpectra, path: str | Path) -> None:
    """Write a PNG of the power of each look over the share of the dwell, dB, with the borders of the looks' parts."""
    figure, (axes,) = new_panels(1, columns=1, size=(8.5, 2.7), title="")
    n = len(spectra.names)
    colours = CURVE_COLOURS if n <= len(CURVE_COLOURS) else colormaps["turbo"](np.linspace(0.05, 0.95, n))
    for border in np.unique(spectra.parts.round(6)):
        axes.axvline(border, color="#8c9bb0", linewidth=0.8)
    for name, power, colour in zip(spectra.names, spectra.power, colours, strict=False):
        with np.errstate(divide="ignore"):
            axes.plot(spectra.share, 10 * np.log10(power), color=colour, linewidth=1.3, label=name)
    axes.set_xlim(spectra.share[0], spectra.share[-1])
    axes.set_ylim(DEEPEST, 3)
    axes.set_xlabel("share of the dwell", fontsize=9)
    axes.set_ylabel("power (dB)", fontsize=9)
    axes.grid(color="#e4e7ec", linewidth=0.5)
    axes.set_axisbelow(True)
    if n <= MOST_NAMED:
        axes.legend(fontsize=8, ncols=n, loc="lower center", frameon=True)
    save(figure, path)


SINGLE = 2.5  # inches, width of a panel of a lone target: its texts are read at the width of a phone
PANEL_WIDTHS = 4.5  # half the side of a contour panel, in median nominal widths
CONTOUR_ZOOM = 4  # contours are drawn through this many times as many points
CONTOUR_LEVELS = (-30.0, -15.0, -3.0)  # dB, as in the paper's Figure 15


def plot_contours(responses: Sequence[Response], path: str | Path, *, title: str = "") -> None:
    """Write a PNG of contours at -3, -15 and -30 dB, one panel per target, on the response's axes in m.

    Three panels in a row, like the paper's Figure 15; nine targets give its 3 x 3. All panels have the same scale along
    both axes, so that widths can be compared by eye. One target is drawn smaller, so that its texts are large.
    """
    side = 3.1 if len(responses) > 1 else SINGLE
    figure, panels = new_panels(len(responses), columns=3, size=(side, side), title=title)
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
        # A response is read only to CUT_WIDTHS; a wider panel stays empty beyond.
        _draw_contours(axes, response_grid(response, widths=min(widths, CUT_WIDTHS)))
    label_outer_axes(panels, 3, "slant range (m)", "azimuth (m)")
    levels = zip(CONTOUR_LEVELS, LEVEL_COLOURS, strict=True)
    draw_legend(figure, [Curve(minus(f"{level:g} dB"), colour, "-") for level, colour in levels])
    save(figure, path)


def _draw_contours(axes: Axes, grid: ResponseGrid) -> None:
    """Draw the contours of a response relative to its largest sample."""
    if not np.isfinite(grid.values).any():
        axes.text(0.5, 0.5, "not covered", ha="center", va="center", transform=axes.transAxes, color="#5a6676")
        return
    values = grid.values
    if np.isfinite(values).all():
        # The nulls below -30 dB are a twentieth of a width across; a spline through complex values resolves them.
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
    """Write a PNG of range and azimuth cuts in dB with the ideal response, two panels per target.

    Three targets in a row; the panels of a lone target are above each other. Offsets are in m from the peak. Each
    panel's title gives PSLR and width.
    """
    columns, size, text = (6, (2.35, 2.5), 8) if len(responses) > 1 else (1, (SINGLE, 1.45), 9)
    figure, panels = new_panels(2 * len(responses), columns=columns, size=size, title=title)
    for (left, right), response in zip(zip(panels[::2], panels[1::2], strict=True), responses, strict=True):
        sampled, name = cuts(response), response.target.name
        ideal = ideal_cuts(response.geometry, response.target, response.axes)
        figures = measure_cuts(response, sampled, ideal)
        left.set_title(_caption(f"{name} range", figures.range_pslr, figures.range_irw), fontsize=text)
        offset, profile = sampled.range_offset, sampled.range_profile
        _draw_cut(left, offset, profile, ideal.range_profile, figures.range_pslr_theory, "#2f6db3")
        right.set_title(_caption(f"{name} azimuth", figures.azimuth_pslr, figures.azimuth_irw), fontsize=text)
        offset, profile = sampled.azimuth_offset, sampled.azimuth_profile
        _draw_cut(right, offset, profile, ideal.azimuth_profile, figures.azimuth_pslr_theory, "#b3202c")
    label_outer_axes(panels, columns, "offset (m)", "power (dB)")
    draw_legend(
        figure,
        [
            Curve("range", "#2f6db3", "-"),
            Curve("azimuth", "#b3202c", "-"),
            Curve("ideal", "#1d242d", ":"),
        ],
    )
    save(figure, path)


def _draw_cut(
    axes: Axes, offset: FloatArray, profile: Complex128Array, ideal: Complex128Array, lobes: float, colour: str
) -> None:
    """Draw a cut in dB over offsets, m, with the ideal response, whose side lobes lie at `lobes`, dB."""
    with np.errstate(divide="ignore", invalid="ignore"):
        measured = 20 * np.log10(np.abs(profile / profile[profile.size // 2]))
        expected = 20 * np.log10(np.abs(ideal))
    axes.plot(offset, measured, color=colour, linewidth=1.1)
    # Drawn last: a dotted line over the measured curve leaves both visible where they agree.
    axes.plot(offset, expected, color="#1d242d", linestyle=":", linewidth=0.8)
    end = CUT_WIDTHS / (CUT_WIDTHS + BEYOND) * offset[-1]
    axes.set_xlim(-end, end)
    axes.set_ylim(min(-45, lobes - 20), 2)
    axes.grid(color="#e4e7ec", linewidth=0.5)


def _caption(name: str, pslr: float, irw: float) -> str:
    """Compose a panel's title: name, PSLR and width."""
    return minus(f"{name}: {pslr:.2f} dB, {irw:.2f} m") if np.isfinite([pslr, irw]).all() else f"{name}: not covered"
