"""The report page of a run: one HTML file with its image, what was planned, what was measured, and how it was made.

The page needs nothing but itself: pictures are data, style and script are in it, and its content security policy lets
nothing else in, not even a script or a style that stood in a title. It says nothing of the moment at which it was made,
so that a page made twice is the same to the last byte.

Import this module where a page is wanted, not before: matplotlib is slow to load.
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

from blocksar.errors import InputError, printable
from blocksar.focusing.method import Method
from blocksar.measurement.bar import BARS, excess, rank
from blocksar.measurement.figures import DEFINITIONS, PointResponse
from blocksar.measurement.response import Response, read_response
from blocksar.measurement.targets import Target
from blocksar.products.page import picture
from blocksar.products.page.facts import BAR, Facts
from blocksar.products.page.picture import Picture, data_uri
from blocksar.products.page.tables import (
    block_table,
    plan_table,
    quality_table,
    reference_table,
    stage_table,
    step_table,
    unit_table,
)
from blocksar.products.page.words import SPACE, count, number, spoken, together
from blocksar.products.pictures.responses import plot_contours, plot_cuts
from blocksar.progress.listening import Callback
from blocksar.runs.finished import FinishedRun
from blocksar.version import __version__


class Drawing(NamedTuple):
    """Contours and cuts of one target: data URIs, with what they show in words."""

    name: str
    at: tuple[str, str] | None
    contours: str
    cuts: str
    said: str


# ---------------------------------------------------------------- the page


def make(
    source: FinishedRun,
    found: Mapping[str, Any] | None,
    *,
    folder: str,
    history: str = "",
    why: str = "",
    progress: Callback | None = None,
    drawn: Callback | None = None,
) -> tuple[bytes, list[str]]:
    """Make the page of a finished run.

    Parameters
    ----------
    source : FinishedRun
    found : mapping, optional
        What quality.json holds, or would hold; None if nothing could be measured.
    folder : str
        Of the run, for the command that repeats it.
    history : str
        Of the image, a line for every step, the last one first.
    why : str
        Why nothing could be measured.
    progress : callable, optional
        Told how much of the image has been read.
    drawn : callable, optional
        Told how many of the responses have been drawn, if there are any.

    Returns
    -------
    (bytes, list of str)
        The page, in UTF-8, and its verdict, for a terminal.

    Raises
    ------
    InputError
        If what the run or its quality.json says cannot be read.
    """
    try:
        run = Facts(source, found, why)
        repeated = command(run.settings, run.record.input.path, folder)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise InputError(
            f"the settings in run.json, quality.json or the attributes of {folder} are damaged ({error}); "
            "measure or focus anew"
        ) from None
    wanted, verdicts = run.drawn(), run.verdicts()
    drawing = picture.draw(source, looks="max" if run.responses else "mean", progress=progress)
    shown = {
        "title": source.title,
        "subtitle": run.subtitle(),
        "verdicts": verdicts,
        "warnings": run.warnings,
        "picture": drawing,
        "outlines": list(picture.outlines(source, run.predicted, drawing)),
        "marks": list(picture.marks(run.marked, wanted, drawing)),
        "chips": list(picture.chips(source, run.marked[: picture.MOST_CHIPS], drawing)),
        "pixel": max(source.spacing),
        "arrows": picture.arrows(source, drawing, run.north),
        "plan": plan_table(run),
        "plan_words": run.plan_words(),
        "quality": quality_table(run, drawing) if run.responses else None,
        "quality_words": [together(line) for line in _quality_words(run)],
        "definitions": DEFINITIONS.replace("\n", " ").split(". "),
        "reference": reference_table(run),
        "drawings": _drawings(source, [r for r in run.responses if r.name in wanted], drawing, drawn),
        "stages": stage_table(run),
        "units": unit_table(run),
        "blocks": block_table(run),
        "steps": step_table(run),
        "memory_words": run.memory_words(),
        "provenance": _provenance(run),
        "settings": [(name.replace("_", " "), _plain(value)) for name, value in run.settings.items()],
        "history": history.splitlines(),
        "command": repeated,
        "version": __version__,
    }
    return _render(shown).encode("utf-8", "backslashreplace"), [v.said.replace(SPACE, " ") for v in verdicts]


def _render(shown: Mapping[str, Any]) -> str:
    """Fill the template; what comes from files is escaped, and nothing in it can run."""
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(_template),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        finalize=_finalized,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    parts = {"style": _template("report.css"), "script": _template("report.js")}
    hashes = {f"{name}_hash": _hash(text) for name, text in parts.items()}
    return environment.get_template("report.html").render(**shown, **parts, **hashes)


def _finalized(value: Any) -> Any:
    """Text from files without control characters; markup of our own, which has `__html__`, as it is."""
    if not isinstance(value, str) or hasattr(value, "__html__") or value.isprintable():
        return value
    return SPACE.join(map(printable, value.split(SPACE)))  # which no terminal is given, and so is not printable


def _template(name: str) -> str:
    return (resources.files("blocksar.products.page") / "templates" / name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    """As a content security policy names what it lets in."""
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"


def _quality_words(run: Facts) -> list[str]:
    if not run.responses:
        return [run.why or "The collection names no targets, so there was nothing to measure."]
    full = sum(r.full_dwell for r in run.responses)
    said = [
        f"{count(len(run.responses), 'target')}, {full} of them lit over their full dwell, {len(run.judged)} of those "
        "covered by the image: these are judged.",
        f"The bar: {BAR}. Figures outside it are marked with an exclamation mark.",
    ]
    if run.judged:
        worst = min(run.judged, key=rank)
        figure = max(BARS, key=lambda name: excess(worst, name))
        said.append(
            f"The worst figure is the {BARS[figure].name} of {worst.name}: "
            f"{number(100 * excess(worst, figure), 0)} % of the {BARS[figure].text} that it may be off."
        )
    return said


# ---------------------------------------------------------------- responses


def _drawings(
    source: FinishedRun, wanted: Sequence[PointResponse], drawing: Picture, progress: Callback | None
) -> list[Drawing]:
    made = []
    with tempfile.TemporaryDirectory() as folder:
        for i, r in enumerate(wanted):
            if progress is not None:
                progress(i, len(wanted))
            target = Target(r.name, r.x, r.y)  # its reflectivity is no matter here: all is relative to the peak
            try:
                response = read_response(source.read, source.x, source.y, source.geometry, target)
            except InputError:  # too coarse an image; then nothing was measured either
                continue
            if response is not None:
                made.append(Drawing(r.name, drawing.find(r.x, r.y), *_draw(response, Path(folder)), spoken(r)))
    if wanted and progress is not None:
        progress(len(wanted), len(wanted))
    return made


def _draw(response: Response, folder: Path) -> tuple[str, str]:
    contours, cuts = folder / "contours.png", folder / "cuts.png"
    plot_contours([response], contours)
    plot_cuts([response], cuts)
    return data_uri("png", contours.read_bytes()), data_uri("png", cuts.read_bytes())


# ---------------------------------------------------------------- where it comes from


def command(settings: Mapping[str, Any], path: str, folder: str) -> str:
    """What to type to focus the input at `path` in the same way again; empty if the run does not say."""
    if not settings or not path:
        return ""
    words = ["blocksar", "focus", path, "--out", folder]
    usual = Method().as_settings() | {"processor": "angular-division", "blocks": "auto", "grid": None}
    for name, value in settings.items():
        if value == usual.get(name, value):
            continue
        if name == "grid":
            x0, x1, dx, y0, y1, dy = value
            words.append(f"--grid={x0!r}:{x1!r}:{dx!r},{y0!r}:{y1!r}:{dy!r}")
        elif isinstance(value, bool):
            words.append(f"--{'' if value else 'no-'}{name}")
        else:
            words += [f"--{name.replace('_', '-')}", str(value)]
    return shlex.join(words)


def _provenance(run: Facts) -> list[tuple[str, str]]:
    collection = run.source.collection
    known = [
        ("input", run.record.input.path),
        ("fingerprint of the input", run.record.input.fingerprint),
        ("identity of the run", run.record.identity),
        ("image", _extent(run.source)),
        ("collection", f"{collection.n_pulse} pulses of {collection.n_range_frequency} range frequencies, "
         f"{collection.prf:.6g} Hz, {collection.carrier / 1e9:.6g} GHz, {collection.bandwidth / 1e6:.4g} MHz wide"),
        ("samples", run.samples),
        ("Doppler centroid", run.centroid),
        ("georeference", _georeference(run.source)),
        ("versions", ", ".join(f"{name} {version}" for name, version in run.versions.items())),
    ]  # fmt: skip
    return [(name, str(value)) for name, value in known if value]


def _extent(source: FinishedRun) -> str:
    ends = [
        f"{name} {number(axis[0], 1)} .. {number(axis[-1], 1)} m" for name, axis in (("x", source.x), ("y", source.y))
    ]
    return f"{', '.join(ends)}, ground at {number(source.ground_height, 1)} m"


def _georeference(source: FinishedRun) -> str:
    found = source.attrs.get("georeference")
    if not isinstance(found, Mapping):
        return ""
    where = [f"{name} {found[name]}\N{DEGREE SIGN}" for name in ("latitude", "longitude") if name in found]
    where += [f"height {found['height']} m"] if "height" in found else []
    turn = found.get("rotation_deg")
    return ", ".join([*where, *([f"x turned {turn}\N{DEGREE SIGN} from east"] if turn else [])])


def _plain(value: Any) -> str:
    match value:
        case None:
            return "default"
        case bool():
            return "yes" if value else "no"
        case list():
            return ", ".join(f"{v:g}" if isinstance(v, float) else str(v) for v in value)
    return str(value)
