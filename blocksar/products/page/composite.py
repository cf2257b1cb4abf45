"""The Pauli composite of the report page: colours that are switched on over the grey levels of a channel."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from blocksar.products.page.picture import Picture, data_uri, lossless
from blocksar.products.pictures.composite import find_pauli, labels_of, pauli_powers
from blocksar.products.pictures.overview import stretch
from blocksar.progress.listening import Callback
from blocksar.runs.finished import FinishedRun

__all__ = ["Composite", "Placed", "draw", "find_pauli", "put"]

PIXELS = 800  # along the longer side, at most: the colours of clutter are then some 2.5 MB
MARGIN = 15.0  # dB of levels beyond those that are first shown, at most


class Composite(NamedTuple):
    """Levels of three colours.

    Attributes
    ----------
    data : str
        Data URI: levels of red, green and blue; transparent where not covered.
    edges : tuple of float
        x from and to, y from and to, m.
    bottom, top : float
        dB of levels 0 and 255.
    black, white : float
        dB first shown as no and as full colour.
    labels : list of str
        What red, green and blue stand for.
    """

    data: str
    edges: tuple[float, float, float, float]
    bottom: float
    top: float
    black: float
    white: float
    labels: list[str]


class Placed(NamedTuple):
    """A composite in the SVG coordinates of a page's picture: upper left corner and sides, m."""

    composite: Composite
    x: str
    y: str
    width: str
    height: str


def draw(sources: Mapping[str, FinishedRun], *, progress: Callback | None = None) -> Composite:
    """Reduce the Pauli composite of channels, by polarisation, to levels; reads them strip by strip."""
    reduced, power = pauli_powers(sources, max_pixels=PIXELS, progress=progress)
    with np.errstate(divide="ignore"):
        decibel = 10 * np.log10(power)
    black, white = (float(end) for end in stretch(decibel))
    finite = decibel[np.isfinite(decibel)]
    bottom, top = (float(finite.min()), float(finite.max())) if finite.size else (black, white)
    bottom, top = max(bottom, black - MARGIN), max(min(top, white + MARGIN), bottom + 1)
    x, y = reduced.x_edges, reduced.y_edges
    return Composite(
        data=data_uri("webp", lossless(decibel, bottom, top)),
        edges=(float(x[0]), float(x[-1]), float(y[0]), float(y[-1])),
        bottom=bottom, top=top, black=float(np.floor(black)), white=float(np.ceil(white)), labels=labels_of(sources),
    )  # fmt: skip


def put(composite: Composite | None, image: Picture) -> Placed | None:
    """Place a composite in a page's picture, if there is one."""
    if composite is None:
        return None
    x0, x1, y0, y1 = composite.edges
    return Placed(composite, *image.place(x0, y1), f"{x1 - x0:.3f}", f"{y1 - y0:.3f}")
