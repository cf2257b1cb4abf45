"""Drawings for the report page, as data URIs: point responses, the track's correction, the terrain."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from blocksar.errors import InputError
from blocksar.measurement.figures import PointResponse
from blocksar.measurement.response import Response, read_response
from blocksar.measurement.targets import Target
from blocksar.products.look_spectra import LookSpectra
from blocksar.products.page.picture import Picture, data_uri
from blocksar.products.page.words import describe, number
from blocksar.products.pictures.looks import plot_looks
from blocksar.products.pictures.relief import plot_relief, read_relief
from blocksar.products.pictures.responses import plot_contours, plot_cuts
from blocksar.products.pictures.track import has_chips, plot_chips, plot_track
from blocksar.progress.listening import Callback
from blocksar.runs.finished import FinishedRun
from blocksar.runs.track import TrackCorrection


class Drawing(NamedTuple):
    """Contours and cuts of one target as data URIs, with alternative text; `at` is its place in the picture."""

    name: str
    at: tuple[str, str] | None
    contours: str
    cuts: str
    description: str


def draw_responses(
    source: FinishedRun, responses: Sequence[PointResponse], image: Picture, progress: Callback | None
) -> list[Drawing]:
    """Draw the responses that can be read from the image; `progress` gets the number done, and of all."""
    drawings = []
    with tempfile.TemporaryDirectory() as folder:
        for i, r in enumerate(responses):
            if progress is not None:
                progress(i, len(responses))
            target = Target(r.name, r.x, r.y)  # drawings are relative to the peak, so its reflectivity does not matter
            try:
                x, y, geometry = source.x, source.y, source.geometry_at(r.x, r.y)
                read = source.reader_at(r.x, r.y)
                response = read_response(read, x, y, geometry, target, source.weighting)
            except InputError:  # the image is too coarse; then nothing was measured either
                continue
            if response is not None:
                drawings.append(Drawing(r.name, image.find(r.x, r.y), *_draw(response, Path(folder)), describe(r)))
    if responses and progress is not None:
        progress(len(responses), len(responses))
    return drawings


def _draw(response: Response, folder: Path) -> tuple[str, str]:
    """Data URIs of contours and cuts."""
    contours, cuts = folder / "contours.png", folder / "cuts.png"
    plot_contours([response], contours)
    plot_cuts([response], cuts)
    return data_uri("png", contours.read_bytes()), data_uri("png", cuts.read_bytes())


class TrackDrawing(NamedTuple):
    """The error of a track, and chips before and after its correction, as data URIs; no chips: an empty one."""

    sentences: list[str]
    error: str
    chips: str


def draw_track(correction: TrackCorrection | None) -> TrackDrawing | None:
    """Draw the correction of a run's track, if there was one."""
    if correction is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        error, chips = Path(folder) / "error.png", Path(folder) / "chips.png"
        plot_track(correction, error)
        drawn = data_uri("png", error.read_bytes())
        if not has_chips(correction):
            return TrackDrawing(correction.sentences(), drawn, "")
        plot_chips(correction, chips)
        return TrackDrawing(correction.sentences(), drawn, data_uri("png", chips.read_bytes()))


class LooksDrawing(NamedTuple):
    """The spectra of looks as a data URI, with a sentence about them."""

    data: str
    sentence: str


def draw_looks(spectra: LookSpectra | None) -> LooksDrawing | None:
    """Draw the spectra of a run's looks, if it has looks."""
    if spectra is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "looks.png"
        plot_looks(spectra, path)
        drawn = data_uri("png", path.read_bytes())
    least, most = (100 * float(end(spectra.within)) for end in (min, max))
    return LooksDrawing(drawn, f"{number(least, 1)} to {number(most, 1)} % of the power of a look lie in its own part.")


class ReliefDrawing(NamedTuple):
    """The terrain under an image: what is said of it, and a picture as a data URI."""

    sentences: list[str]
    picture: str


def draw_relief(source: FinishedRun, marked: Sequence[PointResponse | Target], image: Picture) -> ReliefDrawing | None:
    """Draw the terrain of a run, if it has one, with the targets."""
    terrain = source.geometry.terrain
    if terrain is None:
        return None
    relief = read_relief(source, terrain)
    marks = [(target.name, target.x, target.y) for target in marked if image.holds(target.x, target.y)]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "relief.png"
        plot_relief(relief, terrain, marks, path)
        return ReliefDrawing(relief.sentences(), data_uri("png", path.read_bytes()))
