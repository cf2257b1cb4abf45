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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
import numpy as np

from blocksar import __version__, picture
from blocksar.facts import (
    BAR,
    BARS,
    MOST_ROWS,
    SPACE,
    TIMES,
    Facts,
    block_name,
    count,
    excess,
    number,
    rank,
    spoken,
    together,
    worst_excess,
)
from blocksar.measurement import DEFINITIONS, PointResponse, Response, Target, read_response
from blocksar.method import Method
from blocksar.parameters import SINC_PSLR, InputError, printable
from blocksar.picture import Picture, data_uri
from blocksar.planning import MIB, MIGRATION_BUDGET, PHASE_BUDGET, SIDE_LOBE_BUDGET
from blocksar.plotting import plot_contours, plot_cuts
from blocksar.products import Progress, Source

UNITS = {
    "pulses": "range compression",
    "columns": "recovery, by columns",
    "block": "blocks",
    "chunk": "image, by chunks",
}
STAGES = {
    "inspect": "samples inspected",
    "recover": "recovery",
    "focus": "blocks focused",
    "mosaic": "mosaic",
    "backprojection": "back-projection",
    "rest": "start, checks and end",
}


# ---------------------------------------------------------------- what the template is given


@dataclass(frozen=True)
class Cell:
    """Of a table.

    Attributes
    ----------
    text : str
    sort : float or str
        What a column is sorted by.
    off : bool
        Outside its bar.
    bar, tick : float, optional
        A bar drawn beside the text, and a mark on it: parts of the longest.
    """

    text: str
    sort: float | str = ""
    off: bool = False
    bar: float | None = None
    tick: float | None = None


class Column(NamedTuple):
    """`title` in the head of the column, `unit` below it."""

    title: str
    unit: str = ""


class Row(NamedTuple):
    """The first cell is the row's head; `at` is where it lies in the picture, if it does: (x, y) of it."""

    cells: Sequence[Cell]
    at: tuple[str, str] | None = None


class Table(NamedTuple):
    """`caption` says what it is, `note` what has been left out."""

    key: str
    caption: str
    columns: Sequence[Column]
    rows: Sequence[Row]
    sortable: bool = False
    note: str = ""


class Drawing(NamedTuple):
    """Contours and cuts of one target: data URIs, with what they show in words."""

    name: str
    at: tuple[str, str] | None
    contours: str
    cuts: str
    said: str


# ---------------------------------------------------------------- the page


def make(
    source: Source,
    found: Mapping[str, Any] | None,
    *,
    folder: str,
    history: str = "",
    why: str = "",
    progress: Progress | None = None,
    drawn: Progress | None = None,
) -> tuple[bytes, list[str]]:
    """Make the page of a finished run.

    Parameters
    ----------
    source : Source
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
        repeated = command(run.settings, run.input.get("path"), folder)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise InputError(
            f"run.json, quality.json or the attributes of {folder} are damaged ({error}); measure or focus anew"
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
        "plan": _plan_table(run),
        "plan_words": run.plan_words(),
        "quality": _quality_table(run, drawing) if run.responses else None,
        "quality_words": [together(line) for line in _quality_words(run)],
        "definitions": DEFINITIONS.replace("\n", " ").split(". "),
        "reference": _reference_table(run),
        "drawings": _drawings(source, [r for r in run.responses if r.name in wanted], drawing, drawn),
        "stages": _stage_table(run),
        "units": _unit_table(run),
        "blocks": _block_table(run),
        "steps": _step_table(run),
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
    return (resources.files("blocksar") / "templates" / name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    """As a content security policy names what it lets in."""
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"


# ---------------------------------------------------------------- tables


def _cell(value: float | None, digits: int, *, off: bool = False, scale: float = 1.0) -> Cell:
    if value is None or not np.isfinite(value):
        return Cell(number(None), "", off)
    return Cell(number(scale * value, digits), value, off)


def _plan_table(run: Facts) -> Table | None:
    if not run.predicted:
        return None
    columns = [
        Column("block"),
        Column("residual phase planned", f"rad, \N{LESS-THAN OR EQUAL TO} {PHASE_BUDGET:g}"),
        Column("azimuth PSLR planned", "dB"),
        Column("azimuth PSLR measured", "dB, the worst"),
        Column("width planned", "over its limit"),
        Column("width measured", "over theory"),
        Column("targets measured"),
        Column("memory planned", "MiB"),
        Column("memory measured", "MiB, worker so far"),
        Column("migration planned", f"cells, \N{LESS-THAN OR EQUAL TO} {MIGRATION_BUDGET:g}"),
        Column("yaw", "degrees"),
        Column("range", "km"),
    ]
    rows = [_plan_row(run, block) for block in run.predicted[:MOST_ROWS]]
    return Table(
        "plan", "The plan of every block, and what was measured in it", columns, rows, note=_left_out(run.predicted)
    )


def _plan_row(run: Facts, block: Mapping[str, Any]) -> Row:
    here = [r for r in run.judged if run.places[id(r)] == block_name(block)]
    pslr, width = _worst_of(here, "azimuth_pslr"), _worst_of(here, "azimuth_irw")
    phase, migration, predicted = block["residual_phase"], block["migration"], block["pslr"]
    peak = run.receipt(block).get("peak_memory")
    low, high = np.degrees(block["yaw"])
    near, far = (distance / 1e3 for distance in block["range"])
    return Row([
        Cell(block_name(block)),
        _cell(phase, 4, off=phase > PHASE_BUDGET),
        _cell(predicted, 2, off=abs(predicted - SINC_PSLR) > SIDE_LOBE_BUDGET),
        _cell(pslr and pslr.azimuth_pslr, 2, off=pslr is not None and excess(pslr, "azimuth_pslr") > 1),
        _cell(block["width"], 4),
        _cell(
            width and width.azimuth_irw / width.azimuth_irw_theory, 4,
            off=width is not None and excess(width, "azimuth_irw") > 1,
        ),
        Cell(str(len(here))),
        _cell(block["memory"] / MIB, 0),
        _cell(peak and peak / MIB, 0, off=peak is not None and peak > (run.planned_memory or np.inf)),
        _cell(migration, 3, off=migration > MIGRATION_BUDGET),
        Cell(f"{number(low)} .. {number(high)}"),
        Cell(f"{number(near, 3)} .. {number(far, 3)}"),
    ])  # fmt: skip


def _worst_of(responses: Sequence[PointResponse], figure: str) -> PointResponse | None:
    return max(responses, key=lambda r: excess(r, figure), default=None)


def _left_out(rows: Sequence[Any]) -> str:
    return f"The first {MOST_ROWS} of {number(len(rows), 0)}." if len(rows) > MOST_ROWS else ""


def _quality_table(run: Facts, drawing: Picture) -> Table:
    columns = [
        Column("target"),
        Column("of the bar", "%"),
        Column("range PSLR", "dB"),
        Column("range ISLR", "dB"),
        Column("range width", "m"),
        Column("range width", "over theory"),
        Column("azimuth PSLR", "dB"),
        Column("azimuth ISLR", "dB"),
        Column("azimuth width", "m"),
        Column("azimuth width", "over theory"),
        Column("x error", "mm"),
        Column("y error", "mm"),
        Column("amplitude"),
        Column("phase", "rad"),
        Column("judged"),
        Column("block"),
        Column("x", "m"),
        Column("y", "m"),
    ]
    rows = [_quality_row(run, r, drawing) for r in run.shown]
    rest = len(run.responses) - len(run.shown)
    note = f"The {len(run.shown)} worst; {number(rest, 0)} more are in quality.json." if rest else ""
    return Table("targets", "Point targets, as measured in the image", columns, rows, sortable=True, note=note)


def _quality_row(run: Facts, r: PointResponse, drawing: Picture) -> Row:
    judge = r.full_dwell and r.covered

    def off(figure: str) -> bool:
        return judge and excess(r, figure) > 1

    used = 100 * worst_excess(r) if judge else None
    why = "yes" if judge else "not covered" if not r.covered else "lit in part"
    cells = [
        Cell(r.name, r.name),
        _cell(used, 0, off=used is not None and used > 100),
        _cell(r.range_pslr, 2, off=off("range_pslr")),
        _cell(r.range_islr, 2),
        _cell(r.range_irw, 3),
        _cell(r.range_irw / r.range_irw_theory, 4, off=off("range_irw")),
        _cell(r.azimuth_pslr, 2, off=off("azimuth_pslr")),
        _cell(r.azimuth_islr, 2),
        _cell(r.azimuth_irw, 3),
        _cell(r.azimuth_irw / r.azimuth_irw_theory, 4, off=off("azimuth_irw")),
        _cell(r.error_x, 1, off=off("error_x"), scale=1e3),
        _cell(r.error_y, 1, off=off("error_y"), scale=1e3),
        _cell(abs(r.value), 4, off=off("amplitude")),
        _cell(float(np.angle(r.value)), 4, off=off("phase")),
        Cell(why, why),
        Cell(run.places[id(r)], run.places[id(r)]),
        _cell(r.x, 1),
        _cell(r.y, 1),
    ]
    return Row(cells, drawing.find(r.x, r.y))


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
            f"{number(100 * excess(worst, figure), 0)} % of the {BARS[figure].said} that it may be off."
        )
    return said


def _reference_table(run: Facts) -> Table | None:
    chips = run.chips
    if not chips:
        return None
    columns = [
        Column("chip"),
        Column("x", "m"),
        Column("y", "m"),
        Column("coherence"),
        Column("gain"),
        Column("phase", "rad"),
    ]
    rows = [
        Row([
            Cell(c["place"], c["place"]), _cell(c["x"], 0), _cell(c["y"], 0), _cell(c["coherence"], 5),
            _cell(c["gain"], 4), _cell(c["phase"], 4),
        ])
        for c in chips[:MOST_ROWS]
    ]  # fmt: skip
    caption = f"Chips of 64 {TIMES} 64 pixels against exact back-projection of the same samples"
    return Table("reference", caption, columns, rows, sortable=True, note=_left_out(chips))


def _bars(values: Sequence[float], ticks: Sequence[float | None], text: Callable[[float], str]) -> list[Cell]:
    """Cells with bars of one scale."""
    longest = max([*values, *(t for t in ticks if t is not None), 1e-12])
    return [
        Cell(text(value), value, bar=100 * value / longest, tick=None if tick is None else 100 * tick / longest)
        for value, tick in zip(values, ticks, strict=True)
    ]


def _seconds(value: float) -> str:
    return number(value, 2 if value < 100 else 0)


def _stage_table(run: Facts) -> Table | None:
    if not run.timings:
        return None
    named = {name: seconds for name, seconds in run.timings.items() if name != "total"}
    total = run.timings.get("total", sum(named.values()))
    named["rest"] = max(total - sum(named.values()), 0.0)
    bars = _bars(list(named.values()), [None] * len(named), _seconds)
    rows = [Row([Cell(STAGES.get(name, name)), bar]) for name, bar in zip(named, bars, strict=True)]
    rows.append(Row([Cell("in all"), Cell(_seconds(total), total)]))
    return Table("stages", "Stages", [Column("stage"), Column("time", "s")], rows)


def _unit_table(run: Facts) -> Table | None:
    kinds = [(said, [r for r in run.receipts if r["unit"].startswith(f"{kind}-")]) for kind, said in UNITS.items()]
    rows = [
        Row([
            Cell(said),
            Cell(str(len(units))),
            Cell(str(sum(r["reused"] for r in units))),
            Cell(_seconds(sum(r["seconds"] for r in units))),
            Cell(_seconds(max(r["seconds"] for r in units))),
            _cell(max(r["peak_memory"] for r in units) / MIB, 0),
        ])
        for said, units in kinds
        if units
    ]  # fmt: skip
    columns = [
        Column("work"), Column("units"), Column("used again", "of an earlier process"), Column("time of all", "s"),
        Column("longest", "s"), Column("peak memory", "MiB"),
    ]  # fmt: skip
    return Table("units", "Units of work, by their receipts", columns, rows) if rows else None


def _block_table(run: Facts) -> Table | None:
    shown = [(b, r) for b in run.predicted[:MOST_ROWS] if (r := run.receipt(b))]
    if not shown:
        return None
    times = _bars([r["seconds"] for _, r in shown], [None] * len(shown), _seconds)
    peaks = [r["peak_memory"] / MIB for _, r in shown]
    memories = _bars(peaks, [b["memory"] / MIB for b, _ in shown], lambda v: number(v, 0))
    rows = [Row([Cell(block_name(b)), t, m]) for (b, _), t, m in zip(shown, times, memories, strict=True)]
    columns = [
        Column("block"),
        Column("time", "s"),
        Column("memory of its worker so far, the plan as a line", "MiB"),
    ]
    return Table("blocks", "Blocks", columns, rows, note=_left_out(run.predicted))


def _step_table(run: Facts) -> Table | None:
    shown = [(b, r) for b in run.predicted[:MOST_ROWS] if (r := run.receipt(b)).get("steps")]
    if not shown:
        return None
    names = list(dict.fromkeys(name for _, receipt in shown for name in receipt["steps"]))
    columns = [Column("block"), *(Column(name.replace("+", " + "), "s") for name in names)]
    rows = [Row([Cell(block_name(b)), *(_cell(r["steps"].get(name), 2) for name in names)]) for b, r in shown]
    return Table("steps", "Steps of every block", columns, rows)


# ---------------------------------------------------------------- responses


def _drawings(
    source: Source, wanted: Sequence[PointResponse], drawing: Picture, progress: Progress | None
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


def command(settings: Mapping[str, Any], path: str | None, folder: str) -> str:
    """What to type to focus the input at `path` in the same way again; empty if the run does not say."""
    if not settings or path is None:
        return ""
    words = ["blocksar", "focus", str(path), "--out", folder]
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
    collection = run.source.geometry.collection
    known = [
        ("input", run.input.get("path")),
        ("fingerprint of the input", run.input.get("fingerprint")),
        ("identity of the run", run.record.get("identity")),
        ("image", _extent(run.source)),
        ("collection", f"{collection.n_pulse} pulses of {collection.n_range_frequency} range frequencies, "
         f"{collection.prf:.6g} Hz, {collection.carrier / 1e9:.6g} GHz, {collection.bandwidth / 1e6:.4g} MHz wide"),
        ("samples", run.samples),
        ("Doppler centroid", run.centroid),
        ("georeference", _georeference(run.source)),
        ("versions", ", ".join(f"{name} {version}" for name, version in run.versions.items())),
    ]  # fmt: skip
    return [(name, str(value)) for name, value in known if value]


def _extent(source: Source) -> str:
    ends = [
        f"{name} {number(axis[0], 1)} .. {number(axis[-1], 1)} m" for name, axis in (("x", source.x), ("y", source.y))
    ]
    return f"{', '.join(ends)}, ground at {number(source.ground_height, 1)} m"


def _georeference(source: Source) -> str:
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
