"""The report page of a run: one HTML file with the image, the plan, the measured figures and the provenance.

The page is self-contained: pictures are data URIs, style and script are inline, and its content security policy admits
nothing else, not even a script or a style inside a title. It holds no time of writing, so making the page twice gives
identical bytes.

Import this module only where a page is made: matplotlib is slow to load.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any, NamedTuple

import jinja2

from blocksar.errors import InputError, printable
from blocksar.measurement.figures import DEFINITIONS
from blocksar.products.look_spectra import LookSpectra
from blocksar.products.page import picture
from blocksar.products.page.composite import Composite, put
from blocksar.products.page.drawings import draw_looks, draw_relief, draw_responses, draw_track
from blocksar.products.page.facts import Facts
from blocksar.products.page.provenance import provenance, repeat_run, settings_rows
from blocksar.products.page.sentences import memory_sentence, plan_sentence, quality_sentences, subtitle, verdicts
from blocksar.products.page.tables import (
    block_table,
    plan_table,
    quality_table,
    reference_table,
    stage_table,
    step_table,
    unit_table,
)
from blocksar.products.page.words import SPACE, keep_units
from blocksar.progress.listening import Callback
from blocksar.runs.finished import FinishedRun
from blocksar.version import __version__


class Sibling(NamedTuple):
    """The page of a channel or look of the same run: name, place relative to this page, and whether it is this one."""

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
    """Fill the template. Text from files is escaped, so nothing in it can run."""
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
    """Escape control characters in text; leave markup of our own, which has `__html__`, as it is."""
    if not isinstance(value, str) or hasattr(value, "__html__") or value.isprintable():
        return value
    return SPACE.join(map(printable, value.split(SPACE)))  # SPACE does not count as printable, but the page needs it


def _template(name: str) -> str:
    """Text of a template file."""
    return (resources.files("blocksar.products.page") / "templates" / name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    """Hash of a script or style as a content security policy states it."""
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"
