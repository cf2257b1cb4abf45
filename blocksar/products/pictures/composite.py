"""Pauli composites: three polarisations of one run as the red, green and blue of a picture.

The colours are the powers of the Pauli vector, which sum to the span |HH|^2 + |HV|^2 + |VH|^2 + |VV|^2 where HV = VH:

    red |HH - VV| / sqrt(2): two bounces; green |HV + VH| / sqrt(2): volume; blue |HH + VV| / sqrt(2): one bounce

(Cloude, Pottier, IEEE Trans. GRS 34(2), 1996). One of HV and VH alone stands for both. Powers are averaged over the
cells of the picture and drawn in dB, all three over the same range. Import this module only where a picture is drawn.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, to_rgb
from matplotlib.patches import Patch

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.errors import InputError
from blocksar.places import Location
from blocksar.products.pictures.overview import NOT_COVERED, Overview, overview, range_notes, stretch
from blocksar.products.pictures.quicklook import (
    GREY,
    PIXELS,
    STRIP,
    Arrow,
    caption_of,
    checked_size,
    draw_colour_bar,
    furnish,
    new_figure,
    scene_arrows,
)
from blocksar.products.writing import replacing
from blocksar.progress.listening import Callback
from blocksar.runs.finished import FinishedRun

# Sum of channels that gives each colour, by the channels that a run has.
SQRT = float(np.sqrt(0.5))
RED, BLUE = {"HH": SQRT, "VV": -SQRT}, {"HH": SQRT, "VV": SQRT}
GREENS: dict[frozenset[str], Mapping[str, float]] = {
    frozenset({"HV", "VH"}): {"HV": SQRT, "VH": SQRT},
    frozenset({"HV"}): {"HV": 2 * SQRT},
    frozenset({"VH"}): {"VH": 2 * SQRT},
}
MINUS, ROOT = "\N{MINUS SIGN}", "\N{SQUARE ROOT}2"


def find_pauli(channels: Sequence[str]) -> dict[str, str]:
    """Choose the channels of a Pauli composite, by polarisation; none if HH, VV, or both of HV and VH are missing."""
    known = {name.upper(): name for name in channels}
    if not {"HH", "VV"} <= set(known) or not {"HV", "VH"} & set(known):
        return {}
    return {name: known[name] for name in ("HH", "HV", "VH", "VV") if name in known}


def pauli_channels(channels: tuple[str, ...], label: str) -> dict[str, str]:
    """Choose the channels of a run for a Pauli composite, by polarisation.

    Raises
    ------
    InputError
        If HH, VV, or both of HV and VH are not among them.
    """
    if found := find_pauli(channels):
        return found
    have = f"has {', '.join(channels)}" if channels else "has none"
    raise InputError(f"composite pauli takes the channels HH, VV and HV or VH, and {label} {have}; leave it out")


def write(
    sources: Mapping[str, FinishedRun],
    out: Location,
    *,
    limits: tuple[float, float] | None = None,
    size: int | None = None,
    cell: tuple[int, int] = (1, 1),
    overwrite: bool = False,
    progress: Callback | None = None,
) -> list[str]:
    """Write a PNG of a Pauli composite.

    Parameters
    ----------
    sources : mapping of polarisation to FinishedRun
        HH, VV, and HV or VH or both, on one grid.
    limits, size, cell, progress
        As for the picture of one channel (`quicklook.write`).

    Returns
    -------
    list of str
        Notes for the user: size of the cells, and the scale in dB.

    Raises
    ------
    InputError, ProcessingError
        As for the picture of one channel.
    """
    size = checked_size(size)
    source = sources["HH"]
    source.coverage()  # raises if no pixel is covered
    with replacing(out, overwrite=overwrite) as part:
        reduced, power = pauli_powers(sources, max_pixels=max(PIXELS, size or 0), cell=cell, progress=progress)
        figure, axes = new_figure(reduced, size)
        arrows, labels = scene_arrows(reduced, source.geometry, source.georeference), labels_of(sources)
        low, high = draw(axes, reduced, power, arrows=arrows, labels=labels, limits=limits)
        axes.set_title(f"{source.scene_title}, Pauli composite", fontsize=11)
        figure.supxlabel(caption_of(source), fontsize=8, color="#5a6676")
        figure.savefig(part, format="png")
    side = float(reduced.x_edges[1] - reduced.x_edges[0]), float(reduced.y_edges[1] - reduced.y_edges[0])
    listed = ", ".join(f"{name} {label}" for name, label in zip(("red", "green", "blue"), labels, strict=True))
    with np.errstate(divide="ignore"):
        notes = range_notes(10 * np.log10(power), (low, high))
    return [f"cells of {side[0]:.4g} m x {side[1]:.4g} m; {listed}, each from {low:.1f} to {high:.1f} dB", *notes]


def pauli_powers(
    sources: Mapping[str, FinishedRun],
    *,
    max_pixels: int,
    cell: tuple[int, int] = (1, 1),
    progress: Callback | None = None,
) -> tuple[Overview, FloatArray]:
    """Mean powers of the colours over a picture's cells, (n_y, n_x, 3), and the cells, with the power of red.

    NaN in all three where one is not covered.
    """
    colours, rows = [], sources["HH"].y.size
    for number, weights in enumerate((RED, _green(sources), BLUE)):
        report = None if progress is None else _of_three(progress, number, rows)
        colours.append(_reduced(sources, weights, max_pixels, cell, report))
    power = np.stack([colour.power for colour in colours], axis=-1)
    power[~np.isfinite(power).all(axis=-1)] = np.nan
    return colours[0]._replace(power=power[..., 0]), power


def _green(sources: Mapping[str, FinishedRun]) -> Mapping[str, float]:
    return GREENS[frozenset(sources) & {"HV", "VH"}]


def draw(
    axes: Axes,
    reduced: Overview,
    power: FloatArray,
    *,
    arrows: list[Arrow],
    labels: list[str],
    limits: tuple[float, float] | None = None,
) -> tuple[float, float]:
    """Draw powers (n_y, n_x, 3) as red, green and blue; return the dB of black and of full colour."""
    with np.errstate(divide="ignore"):
        decibel = 10 * np.log10(power)
    low, high = limits or stretch(decibel)
    colours = np.clip((decibel - low) / (high - low), 0, 1)
    colours = np.where(np.isnan(power), np.array(to_rgb(NOT_COVERED)), colours)
    axes.imshow(
        colours,
        extent=(reduced.x_edges[0], reduced.x_edges[-1], reduced.y_edges[0], reduced.y_edges[-1]),
        origin="lower",
        interpolation="nearest",
    )
    draw_colour_bar(axes, ScalarMappable(Normalize(low, high), GREY), "power in each colour (dB)")
    pure = ("red", "lime", "blue")
    furnish(
        axes, reduced, arrows=arrows,
        handles=[Patch(facecolor=colour, label=label) for colour, label in zip(pure, labels, strict=True)],
    )  # fmt: skip
    return low, high


def labels_of(sources: Mapping[str, FinishedRun]) -> list[str]:
    """Describe the meanings of red, green and blue."""
    green = _green(sources)
    middle = f"|HV + VH|/{ROOT}" if len(green) == 2 else f"{ROOT}|{next(iter(green))}|"
    return [f"|HH {MINUS} VV|/{ROOT}", middle, f"|HH + VV|/{ROOT}"]


def _reduced(
    sources: Mapping[str, FinishedRun],
    weights: Mapping[str, float],
    pixels: int,
    cell: tuple[int, int],
    progress: Callback | None,
) -> Overview:
    """Reduce a weighted sum of channels to the cells of a picture."""
    first = sources["HH"]

    def read(rows: slice, columns: slice) -> ComplexArray:
        if progress is not None:
            progress(min(rows.stop, first.y.size), first.y.size)
        total, *others = (np.float32(w) * sources[name].read(rows, columns) for name, w in weights.items())
        for other in others:
            total = total + other
        return total

    return overview(read, first.x, first.y, max_pixels=pixels, looks="mean", cell=cell, strip=STRIP)


def _of_three(progress: Callback, number: int, rows: int) -> Callback:
    """Report the progress of one of three passes over the image's rows."""
    return lambda done, total: progress(number * rows + done, 3 * rows)
