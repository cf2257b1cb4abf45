"""The report page of a run: one HTML file with the image, the plan, the measured figures and the provenance.

The page is self-contained: pictures are data URIs, style and script are inline, and its content security policy admits
nothing else, not even a script or a style inside a title. It holds no time of writing, so making the page twice gives
identical bytes.

Import this module only where a page is made: matplotlib is slow to load.

The Pauli composite of a page is an overlay of colours that can be switched on over the grey levels of a channel.
"""

from __future__ import annotations

import base64
import hashlib
import shlex
import tempfile
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
import numpy as np

from blocksar.arrays import FloatArray
from blocksar.budget import FIDELITY
from blocksar.errors import InputError, printable
from blocksar.imaging.method import Method
from blocksar.measurement.figures import BARS, DEFINITIONS, PointResponse, excess, limit, rank, worst_excess
from blocksar.measurement.response import Response, read_response
from blocksar.measurement.targets import Target
from blocksar.products.look_spectra import LookSpectra
from blocksar.products.page import picture
from blocksar.products.page.facts import SPACE, TIMES, Facts, describe, keep_units, memory, number
from blocksar.products.page.picture import Picture, data_uri, lossless, plot_relief, read_relief
from blocksar.products.page.tables import (
    block_table,
    plan_table,
    quality_table,
    reference_table,
    stage_table,
    step_table,
    unit_table,
)
from blocksar.products.pictures.composite import labels_of, pauli_powers
from blocksar.products.pictures.overview import stretch
from blocksar.products.pictures.responses import has_chips, plot_chips, plot_contours, plot_cuts, plot_looks, plot_track
from blocksar.progress.listening import Callback
from blocksar.runs import demonstration
from blocksar.runs.finished import FinishedRun
from blocksar.runs.folder import INPUT, find_input
from blocksar.runs.track import TrackCorrection
from blocksar.texts import count, frequency_text
from blocksar.version import __version__

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


class PlacedComposite(NamedTuple):
    """A composite in the SVG coordinates of a page's picture: upper left corner and sides, m."""

    composite: Composite
    x: str
    y: str
    width: str
    height: str


def draw_composite(sources: Mapping[str, FinishedRun], *, progress: Callback | None = None) -> Composite:
    """Reduce the Pauli composite of channels, by polarisation, to colour levels; reads strip by strip."""
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


def put(composite: Composite | None, image: Picture) -> PlacedComposite | None:
    """Place a composite in a page's picture, if there is one."""
    if composite is None:
        return None
    x0, x1, y0, y1 = composite.edges
    return PlacedComposite(composite, *image.place(x0, y1), f"{x1 - x0:.3f}", f"{y1 - y0:.3f}")


EDGE = 16  # pixels at the edge of an image in which a response may not be measurable


def bar_text(response: PointResponse) -> str:
    """Describe the limits of a response's figures."""
    lobes = [
        f"{axis} side lobes within {limit(response, f'{axis}_pslr')[1]} of theory, "
        f"{number(getattr(response, f'{axis}_pslr_theory'))} dB at {response.name}"
        for axis in ("range", "azimuth")
    ]
    return (
        f"{' and '.join(lobes)}; widths within {BARS['range_irw'].text} of theory, in range and in azimuth; position "
        f"within {BARS['error_x'].text} in x and in y; amplitude within {BARS['amplitude'].text}, phase within "
        f"{BARS['phase'].text}"
    )


class Verdict(NamedTuple):
    """One part of the page's first line, and whether it is good news."""

    good: bool
    text: str


def subtitle(run: Facts) -> str:
    """Processor, number of blocks, size of the image and carrier."""
    blocks = len({b.block for b in run.predicted})
    dx, dy = run.source.spacing
    spacing = f"{dx:.4g} m" if abs(dx - dy) < 1e-9 * dx else f"{dx:.4g} m {TIMES} {dy:.4g} m"
    size = f"{number(run.source.x.size, 0)} {TIMES} {number(run.source.y.size, 0)} pixels of {spacing}"
    carrier = frequency_text(run.source.collection.carrier)
    processor = run.record.processor or "blocksar"
    return ", ".join([processor, *([count(blocks, "block")] if blocks else []), size, carrier])


def verdicts(run: Facts) -> list[Verdict]:
    """Verdicts on targets, warnings and memory."""
    warnings = Verdict(not run.warnings, count(len(run.warnings), "warning"))
    return [_verdict_on_targets(run), warnings, _verdict_on_memory(run)]


def _verdict_on_targets(run: Facts) -> Verdict:
    """Fully lit targets within the limits of quality; a target in a gap of the image counts as outside them."""
    if run.why:
        return Verdict(False, "targets could not be measured")
    if not run.responses:
        return Verdict(True, "no targets to measure")
    full = [r for r in run.responses if r.full_dwell]
    if not full:
        return Verdict(False, "no target is lit over its full dwell")
    within = [r for r in run.judged if worst_excess(r) <= 1]
    n = len(run.judged) + sum(_in_a_gap(run, r) for r in full)
    if not n:
        return Verdict(True, "no fully lit target to judge in this image")
    return Verdict(len(within) == n, f"{len(within)} of {count(n, 'fully lit target')} within the limits")


def _in_a_gap(run: Facts, response: PointResponse) -> bool:
    """Tell whether a target without data lies more than EDGE pixels inside the image's grid."""
    if response.covered or np.isfinite(response.value):
        return False
    if len(run.record.inputs) > 1:  # a seam between collections, which covers the target's own pixel
        read = run.source.read_block(*map(_nearest, (response.y, response.x), (run.source.y, run.source.x)))
        if (read >= 0).all():
            return False
    places = ((response.x, run.source.x), (response.y, run.source.y))
    return all(
        axis[0] + EDGE * step < value < axis[-1] - EDGE * step
        for (value, axis), step in zip(places, run.source.spacing, strict=True)
    )


def _nearest(value: float, axis: FloatArray) -> slice:
    """The pixel nearest to a coordinate, m."""
    at = int(np.abs(axis - value).argmin())
    return slice(at, at + 1)


def _verdict_on_memory(run: Facts) -> Verdict:
    """Judge the peak memory of a worker against the plan."""
    peak, planned = run.peak_memory, run.planned_memory
    if peak is None or planned is None:
        return Verdict(True, f"peak memory of a worker {memory(peak)}")
    return Verdict(
        peak <= planned,
        f"peak memory of a worker {memory(peak)}, {number(100 * peak / planned, 0)}{SPACE}% of the plan",
    )


def plan_sentence(run: Facts) -> str:
    """Introduction to the table of the plan."""
    if run.predicted:
        return (
            "Figures predicted for the worst target of each block by tracing the scene's time-frequency lines, beside "
            "those measured at its fully lit targets. Memory is that of a worker process, interpreter and libraries "
            "included."
        )
    if (coherence := run.record.plan.coherence) is not None:
        return (
            f"Predicted coherence with exact back-projection of the same samples: at least {coherence:.8g}. Parts of "
            "the image have no figures of their own."
        )
    return "Exact back-projection makes no approximation, so the plan predicts no figures."


def quality_sentences(run: Facts) -> list[str]:
    """Paragraphs on targets, limits and worst figure; or the reason why nothing was measured."""
    if not run.responses:
        return [run.why or "The collection names no targets, so there was nothing to measure."]
    full = sum(r.full_dwell for r in run.responses)
    sentences = [
        f"{count(len(run.responses), 'target')}, {full} of them lit over their full dwell. The image covers "
        f"{len(run.judged)} of these; only covered ones are judged.",
        f"The limits: {bar_text([*run.judged, *run.responses][0])}. "
        "Figures outside them are marked with an exclamation mark.",
    ]
    if run.judged:
        worst = min(run.judged, key=rank)
        figure = max(BARS, key=lambda name: excess(worst, name))
        sentences.append(
            f"The worst figure is the {BARS[figure].name} of {worst.name}: "
            f"its deviation is {number(100 * excess(worst, figure), 0)} % of the {limit(worst, figure)[1]} allowed."
        )
    return sentences


def memory_sentence(run: Facts) -> str:
    """Peak, planned and permitted memory of a worker, and the number of workers."""
    planned, limit = run.planned_memory, run.memory_limit
    parts = [f"Peak of a worker: {memory(run.peak_memory)}"]
    parts += [f"planned: {memory(planned)}"] if planned is not None else []
    parts += [f"limit: {memory(limit)}"] if limit is not None else []
    workers, threads = run.record.workers, run.record.threads
    if workers is not None and threads is not None:
        parts.append(f"{count(workers, 'worker')} with {count(threads, 'thread')} each")
    return f"{'; '.join(parts)}."


def repeat_command(settings: Mapping[str, Any], paths: Sequence[str], folder: str) -> str:
    """Compose the command that repeats the focusing of the inputs; empty if settings or paths are unknown.

    An input that lies in the run folder, as samples from memory do, is focused into another one.
    """
    if not settings or not paths:
        return ""
    inside = any(f"{path}/".startswith(f"{folder}/{INPUT}/") for path in paths)
    words = ["blocksar", "focus", *paths, "--out", f"{folder}-again" if inside else folder]
    defaults = Method().as_settings() | {
        "processor": "auto",
        "blocks": "auto",
        "fidelity": FIDELITY,
        "grid": None,
        "autofocus": False,
        "terrain": None,
        "surface": "plane",
        "vertical": None,
        "looks": None,
        "interference": None,
        "weighting_range": "uniform",
        "weighting_azimuth": "uniform",
    }
    names = list(settings)
    own = names[1 : names.index("blocks")] if {"processor", "blocks"} <= {*names} else []  # options of its processor
    for name, value in settings.items():
        if value == defaults.get(name, None if name in own else value):
            continue
        if name == "grid":
            x0, x1, dx, y0, y1, dy = value
            words.append(f"--grid={x0!r}:{x1!r}:{dx!r},{y0!r}:{y1!r}:{dy!r}")
        elif isinstance(value, bool):
            words.append(f"--{'' if value else 'no-'}{name}")
        elif name == "control":
            words += ["--control", "TARGETS.json"]  # the run keeps the points, and no name of a file
        else:
            words += [f"--{name.replace('_', '-')}", str(value)]
    return shlex.join(words)


def repeat_run(run: Facts, folder: str, looks: int | None = None) -> str:
    """Compose the command that repeats a run: `blocksar demo` for a demonstration, `blocksar focus` for others."""
    history = f"{folder}/{demonstration.HISTORY}"
    settings = run.settings if looks is None else {**run.settings, "looks": looks}
    inputs = [str(find_input(run.source.folder, path)) for path in run.record.inputs]
    command = repeat_command(settings, inputs, folder)
    shown = {"blocks": demonstration.BLOCKS, "grid": [*demonstration.GRID[0], *demonstration.GRID[1]]}
    usual = repeat_command(shown, [history], folder)
    if command == usual and run.source.attrs.get("scene") == demonstration.SCENE:
        return shlex.join(["blocksar", "demo", "--out", folder, "--overwrite"])
    return command


def provenance(run: Facts) -> list[tuple[str, str]]:
    """List known facts on the run's input, image and collection as names and values."""
    collection = run.source.collection
    rows = [
        ("input", ", ".join(run.record.inputs)),
        ("fingerprint of the input", run.record.input.fingerprint),
        ("identity of the run", run.record.identity),
        ("weighting", run.source.weighting.text),
        ("image", _extent(run.source)),
        ("segments", _segments(run)),
        ("collection", f"{collection.n_pulse} pulses of {collection.n_range_frequency} range frequencies, "
         f"{collection.rate_text}, {frequency_text(collection.carrier)}, "
         f"{frequency_text(collection.bandwidth)} wide"),
        ("samples", run.samples),
        ("Doppler centroid", run.centroid),
        ("noise", "" if run.source.noise is None else run.source.noise.sentence()),
        ("georeference", _georeference(run.source)),
        ("versions", ", ".join(f"{name} {version}" for name, version in run.versions.items())),
    ]  # fmt: skip
    return [(name, str(value)) for name, value in rows if value]


def _segments(run: Facts) -> str:
    """Collection and blocks of each segment of a run; empty in a run of one."""
    texts = []
    for index, segment in enumerate(run.record.segments):
        last = segment.first_block + (segment.blocks or 1) - 1
        pulses = "" if segment.pulses is None else f", pulses {segment.pulses[0]} .. {segment.pulses[1] - 1}"
        texts.append(f"{index}: {segment.path}{pulses}, blocks {segment.first_block} .. {last}")
    return "; ".join(texts)


def _extent(source: FinishedRun) -> str:
    """Extent of the image and height of its ground."""
    ends = [
        f"{name} {number(axis[0], 1)} .. {number(axis[-1], 1)} m" for name, axis in (("x", source.x), ("y", source.y))
    ]
    return f"{', '.join(ends)}, ground at {number(source.ground_height, 1)} m"


def _georeference(source: FinishedRun) -> str:
    """Place of the scene frame; empty if it is unknown."""
    frame = source.attrs.get("georeference")
    if not isinstance(frame, Mapping):
        return ""
    parts = [f"{name} {frame[name]}\N{DEGREE SIGN}" for name in ("latitude", "longitude") if name in frame]
    parts += [f"height {frame['height']} m"] if "height" in frame else []
    rotation = frame.get("rotation_deg")
    return ", ".join([*parts, *([f"x rotated {rotation}\N{DEGREE SIGN} from east"] if rotation else [])])


def settings_rows(run: Facts) -> list[tuple[str, str]]:
    """Names and values of the settings."""
    return [(name.replace("_", " "), _as_text(value)) for name, value in run.settings.items()]


def _as_text(value: Any) -> str:
    """A setting's value as text."""
    match value:
        case None:
            return "default"
        case bool():
            return "yes" if value else "no"
        case list():
            return ", ".join(f"{v:g}" if isinstance(v, float) else str(v) for v in value)
    return str(value)


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
    """The error of a track, and chips before and after correction, as data URIs; an empty one without chips."""

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
    """The terrain under an image: sentences, and a picture as a data URI."""

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


class Sibling(NamedTuple):
    """The page of a channel or look of the same run: name, relative path, and whether it is this page."""

    name: str
    href: str
    here: bool


def make(
    source: FinishedRun,
    quality: Mapping[str, Any] | None,
    *,
    folder: str,
    siblings: Sequence[Sibling] = (),
    looks: int | None = None,
    spectra: LookSpectra | None = None,
    composite: Composite | None = None,
    history: str = "",
    why: str = "",
    progress: Callback | None = None,
    drawn: Callback | None = None,
) -> tuple[bytes, list[str]]:
    """Make the page of a finished run.

    Parameters
    ----------
    source : FinishedRun
    quality : mapping, optional
        Contents of quality.json, or the same measured now; None if nothing could be measured.
    folder : str
        Folder of the run, for the command that repeats it; of the whole, if this is one of several channels or looks.
    siblings : sequence of Sibling
        Pages of all channels or looks, this one among them.
    looks : int, optional
        Number of looks of the whole.
    spectra : LookSpectra, optional
        Of the looks of the whole.
    composite : Composite, optional
        Of the channels of the whole, to be switched on over the picture.
    history : str
        History of the image, one line per step, the last one first.
    why : str
        Reason why nothing could be measured.
    progress : callable, optional
        Called with the rows of the image read so far, and their number.
    drawn : callable, optional
        Called with the responses drawn so far, and their number, if there are any.

    Returns
    -------
    (bytes, list of str)
        The page in UTF-8, and its verdicts as text for a terminal.

    Raises
    ------
    InputError
        If run.json, quality.json or the attributes of the run are damaged.
    """
    try:
        run = Facts(source, quality, why)
        command = repeat_run(run, folder, looks)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise InputError(
            f"the settings in run.json, quality.json or the attributes of {folder} are damaged ({error}); "
            "measure or focus anew"
        ) from None
    drawn_names, page_verdicts = run.choose_drawn(), verdicts(run)
    image = picture.draw(source, looks="max" if run.responses else "mean", progress=progress)
    contents = {
        "title": source.title,
        "subtitle": subtitle(run),
        "verdicts": page_verdicts,
        "siblings": siblings,
        "warnings": run.warnings,
        "picture": image,
        "outlines": list(picture.outlines(source, run.predicted, image)),
        "composite": put(composite, image),
        "looks": draw_looks(spectra),
        "marks": list(picture.marks(run.marked, drawn_names, image)),
        "chips": list(picture.chips(source, run.marked[: picture.MOST_CHIPS], image)),
        "pixel": max(source.spacing),
        "arrows": picture.arrows(source, image, run.north),
        "plan": plan_table(run),
        "plan_text": plan_sentence(run),
        "quality": quality_table(run, image) if run.responses else None,
        "quality_text": [keep_units(line) for line in quality_sentences(run)],
        "definitions": DEFINITIONS.replace("\n", " ").split(". "),
        "reference": reference_table(run),
        "drawings": draw_responses(source, [r for r in run.responses if r.name in drawn_names], image, drawn),
        "track": draw_track(source.track),
        "relief": draw_relief(source, run.marked, image),
        "stages": stage_table(run),
        "units": unit_table(run),
        "blocks": block_table(run),
        "steps": step_table(run),
        "memory_text": memory_sentence(run),
        "provenance": provenance(run),
        "settings": settings_rows(run),
        "history": history.splitlines(),
        "command": command,
        "version": __version__,
    }
    return _render(contents).encode("utf-8", "backslashreplace"), [v.text.replace(SPACE, " ") for v in page_verdicts]


def _render(contents: Mapping[str, Any]) -> str:
    """Fill the template. Text from files is escaped, so that nothing in it can run."""
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(_template),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        finalize=_finalize,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    parts = {"style": _template("report.css"), "script": _template("report.js")}
    hashes = {f"{name}_hash": _hash(text) for name, text in parts.items()}
    return environment.get_template("report.html").render(**contents, **parts, **hashes)


def _finalize(value: Any) -> Any:
    """Escape text for HTML, control characters included; markup of our own, with `__html__`, stays."""
    if not isinstance(value, str) or hasattr(value, "__html__") or value.isprintable():
        return value
    return SPACE.join(map(printable, value.split(SPACE)))  # SPACE does not count as printable, but the page needs it


def _template(name: str) -> str:
    """Text of a template file."""
    return (resources.files("blocksar.products.page") / "templates" / name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    """Hash a script or style for the content security policy."""
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"
