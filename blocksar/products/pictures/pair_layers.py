"""Pictures of a pair: phase, coherence, amplitude ratio and change, reduced strip by strip."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from numpy.typing import NDArray

from blocksar import stores
from blocksar.arrays import FloatArray
from blocksar.places.place import Place
from blocksar.products.pair import Pair
from blocksar.products.pictures import quicklook
from blocksar.products.pictures.overview import NOT_COVERED, Overview, cell_edges, reduce_cells
from blocksar.products.writing import replacing
from blocksar.progress.listening import Callback

PIXELS = 1400  # cells along the longer side, at most
STRIP = 1 << 21  # pixels read at once, but whole rows of cells
RATIO = 10.0  # dB at the ends of the colours of the amplitude ratio
CHANGED, UNJUDGED = "#d81e2c", "#2f6db3"


class PairLayer(NamedTuple):
    """Style in which a picture shows a layer of a pair."""

    title: str
    variable: str
    shown: Callable[[NDArray[Any]], FloatArray]  # cells of the picture from means over cells of the variable
    colours: Any
    limits: tuple[float, float]
    label: str


def _decibels(ratio: NDArray[Any]) -> FloatArray:
    with np.errstate(divide="ignore"):
        return np.asarray(20 * np.log10(ratio))


LAYERS = {
    "phase": PairLayer(
        "interferometric phase", "interferogram", np.angle, "hsv", (-np.pi, np.pi), "phase of a conj(b) (rad)"
    ),
    "coherence": PairLayer("coherence", "coherence", np.real, "gray", (0.0, 1.0), "coherence"),
    "ratio": PairLayer("amplitude ratio", "amplitude_ratio", _decibels, "RdBu_r", (-RATIO, RATIO), "b over a (dB)"),
}


def draw_pair(pair: Pair, store: Place, folder: Place, *, overwrite: bool, progress: Callback) -> list[Place]:
    """Write phase.png, coherence.png, ratio.png and change.png of a pair's store into a folder; return their places."""
    drawn = []
    for number, name in enumerate((*LAYERS, "change"), 1):
        target = folder / f"{name}.png"
        with replacing(target, overwrite=overwrite) as part:
            _draw(part, pair, store, name)
        drawn.append(target)
        progress(number, len(LAYERS) + 1)
    return drawn


def _draw(path: str, pair: Pair, store: Place, name: str) -> None:
    cell = max(1, -(-max(pair.a.x.size, pair.a.y.size) // PIXELS))
    edges = cell_edges(pair.a.x, -(-pair.a.x.size // cell), cell), cell_edges(pair.a.y, -(-pair.a.y.size // cell), cell)

    def reduced(variable: str, take: Callable[[NDArray[Any]], FloatArray]) -> FloatArray:
        return reduce_rows(store, variable, (pair.a.y.size, pair.a.x.size), cell, take)

    if name == "change":
        coherence = reduced("coherence", np.real)
        values = reduced("change", lambda flags: np.where(flags == 255, np.nan, flags == 1))
    else:
        layer = LAYERS[name]
        if layer.variable == "interferogram":
            values = layer.shown(reduced(layer.variable, np.real) + 1j * reduced(layer.variable, np.imag))
        else:
            values = layer.shown(reduced(layer.variable, np.real))
    figure, axes = quicklook.new_figure(Overview(values, None, *edges))
    extent = edges[0][0], edges[0][-1], edges[1][0], edges[1][-1]
    shared: dict[str, Any] = {"extent": extent, "origin": "lower", "interpolation": "nearest"}
    axes.set_facecolor(NOT_COVERED)
    if name == "change":
        picture = axes.imshow(np.ma.masked_invalid(coherence), cmap="gray", vmin=0, vmax=1, **shared)
        quicklook.draw_colour_bar(axes, picture, "coherence", extend="neither")
        red = np.ma.masked_where(~(values > 0), np.ones(values.shape))
        axes.imshow(red, cmap=ListedColormap([CHANGED]), alpha=np.clip(np.nan_to_num(values), 0.35, 1.0), **shared)
        dark = reduced("change", lambda flags: np.where(flags == 255, np.nan, flags == 2))
        blue = np.ma.masked_where(~(dark > 0.5), np.ones(dark.shape))
        axes.imshow(blue, cmap=ListedColormap([UNJUDGED]), alpha=0.45, **shared)
        title = "coherent change red, not judged blue"
    else:
        low, high = layer.limits
        picture = axes.imshow(np.ma.masked_invalid(values), cmap=layer.colours, vmin=low, vmax=high, **shared)
        extend: Literal["both", "neither"] = "both" if name == "ratio" else "neither"
        quicklook.draw_colour_bar(axes, picture, layer.label, extend=extend)
        title = layer.title
    _furnish(axes, Overview(values, None, *edges), pair, title)
    figure.supxlabel(quicklook.caption_of(pair.a), fontsize=8, color="#5a6676")
    figure.savefig(path, format="png")


def _furnish(axes: Axes, reduced: Overview, pair: Pair, title: str) -> None:
    arrows = quicklook.scene_arrows(reduced, pair.a.geometry, pair.a.georeference)
    quicklook.furnish(axes, reduced, arrows=arrows)
    axes.set_title(f"{title}: {pair.a.folder.name} and {pair.b.folder.name}", fontsize=11)


def reduce_rows(
    store: Place, variable: str, shape: tuple[int, int], cell: int, take: Callable[[NDArray[Any]], FloatArray]
) -> FloatArray:
    """Average part of a variable over cells of pixels, (n_y, n_x); NaN for empty cells. Reads strips of rows."""
    rows = max(STRIP // (shape[1] * cell), 1) * cell
    parts = [slice(first, min(first + rows, shape[0])) for first in range(0, shape[0], rows)]
    whole = slice(0, shape[1])
    return np.concatenate([
        reduce_cells(
            take(stores.read_region(store, variable, (part, whole))).astype(np.float32), (cell, cell), "mean"
        )
        for part in parts
    ])  # fmt: skip
