"""Picture of the spectra of sub-aperture looks.

Import this module only where a picture is drawn: matplotlib is slow to load.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib import colormaps

from blocksar.products.look_spectra import LookSpectra
from blocksar.products.pictures.figures import CURVE_COLOURS, new_panels, save

DEEPEST = -50.0  # dB
MOST_NAMED = 8


def plot_looks(spectra: LookSpectra, path: str | Path) -> None:
    """Write a PNG of the power of each look over the share of the dwell, dB, with the borders of their own parts."""
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
