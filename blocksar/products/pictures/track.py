"""Pictures of the correction of a track: its error over time, and chips before and after.

Import this module only where a picture is drawn: matplotlib is slow to load.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from blocksar.products.pictures.figures import CURVE_COLOURS, new_figure, new_panels, save
from blocksar.runs.track import DEPTH, TrackCorrection

DEVIATIONS = 2.0  # standard deviations on either side of the error that are shaded
MOST_CHIPS = 6
COLOUR = CURVE_COLOURS[2]


def plot_track(correction: TrackCorrection, path: str | Path) -> None:
    """Write a PNG of what was taken off the track in x, y and z, mm, over slow time, with its predicted uncertainty."""
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
    """Write a PNG of chips about some points, before above and after below, in dB from the brightest of each pair."""
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
