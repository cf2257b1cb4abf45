"""The report page's tables."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from blocksar.budget import MIGRATION_BUDGET, PHASE_BUDGET, SIDE_LOBE_BUDGET
from blocksar.constants import MIB, SINC_PSLR
from blocksar.measurement.bar import excess, worst_excess
from blocksar.measurement.figures import PointResponse
from blocksar.products.page.facts import MOST_ROWS, Facts
from blocksar.products.page.picture import Picture
from blocksar.products.page.words import TIMES, number
from blocksar.runs.record import PredictedBlock

UNITS = {
    "range-compress": "range compression",
    "inspect": "inspection, by columns",
    "recover": "recovery, by columns",
    "focus": "blocks",
    "mosaic": "image, by chunks",
    "backprojection": "image, by chunks",
}  # of a stage
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


# ---------------------------------------------------------------- tables


def _cell(value: float | None, digits: int, *, off: bool = False, scale: float = 1.0) -> Cell:
    if value is None or not np.isfinite(value):
        return Cell(number(None), "", off)
    return Cell(number(scale * value, digits), value, off)


def plan_table(run: Facts) -> Table | None:
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


def _plan_row(run: Facts, block: PredictedBlock) -> Row:
    here = [r for r in run.judged if run.places[id(r)] == block.name]
    pslr, width = _worst_of(here, "azimuth_pslr"), _worst_of(here, "azimuth_irw")
    phase, migration, predicted = block.residual_phase, block.migration, block.pslr
    receipt = run.receipt(block)
    peak = None if receipt is None else receipt.peak_memory
    low, high = np.degrees(block.yaw)
    near, far = (distance / 1e3 for distance in block.range)
    return Row([
        Cell(block.name),
        _cell(phase, 4, off=phase > PHASE_BUDGET),
        _cell(predicted, 2, off=abs(predicted - SINC_PSLR) > SIDE_LOBE_BUDGET),
        _cell(pslr and pslr.azimuth_pslr, 2, off=pslr is not None and excess(pslr, "azimuth_pslr") > 1),
        _cell(block.width, 4),
        _cell(
            width and width.azimuth_irw / width.azimuth_irw_theory, 4,
            off=width is not None and excess(width, "azimuth_irw") > 1,
        ),
        Cell(str(len(here))),
        _cell(block.memory / MIB, 0),
        _cell(peak and peak / MIB, 0, off=peak is not None and peak > (run.planned_memory or np.inf)),
        _cell(migration, 3, off=migration > MIGRATION_BUDGET),
        Cell(f"{number(low)} .. {number(high)}"),
        Cell(f"{number(near, 3)} .. {number(far, 3)}"),
    ])  # fmt: skip


def _worst_of(responses: Sequence[PointResponse], figure: str) -> PointResponse | None:
    return max(responses, key=lambda r: excess(r, figure), default=None)


def _left_out(rows: Sequence[Any]) -> str:
    return f"The first {MOST_ROWS} of {number(len(rows), 0)}." if len(rows) > MOST_ROWS else ""


def quality_table(run: Facts, drawing: Picture) -> Table:
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


def reference_table(run: Facts) -> Table | None:
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


def stage_table(run: Facts) -> Table | None:
    if not run.timings:
        return None
    named = {name: seconds for name, seconds in run.timings.items() if name != "total"}
    total = run.timings.get("total", sum(named.values()))
    named["rest"] = max(total - sum(named.values()), 0.0)
    bars = _bars(list(named.values()), [None] * len(named), _seconds)
    rows = [Row([Cell(STAGES.get(name, name)), bar]) for name, bar in zip(named, bars, strict=True)]
    rows.append(Row([Cell("in all"), Cell(_seconds(total), total)]))
    return Table("stages", "Stages", [Column("stage"), Column("time", "s")], rows)


def unit_table(run: Facts) -> Table | None:
    kinds = [(name, [r for r in run.receipts if r.stage == stage]) for stage, name in UNITS.items()]
    rows = [
        Row([
            Cell(name),
            Cell(str(len(units))),
            Cell(str(sum(r.reused for r in units))),
            Cell(_seconds(sum(r.seconds for r in units))),
            Cell(_seconds(max(r.seconds for r in units))),
            _cell(max(r.peak_memory or 0 for r in units) / MIB, 0),
        ])
        for name, units in kinds
        if units
    ]  # fmt: skip
    columns = [
        Column("work"), Column("units"), Column("used again", "of an earlier process"), Column("time of all", "s"),
        Column("longest", "s"), Column("peak memory", "MiB"),
    ]  # fmt: skip
    return Table("units", "Units of work, by their receipts", columns, rows) if rows else None


def block_table(run: Facts) -> Table | None:
    shown = [(b, r) for b in run.predicted[:MOST_ROWS] if (r := run.receipt(b))]
    if not shown:
        return None
    times = _bars([r.seconds for _, r in shown], [None] * len(shown), _seconds)
    peaks = [(r.peak_memory or 0) / MIB for _, r in shown]
    memories = _bars(peaks, [b.memory / MIB for b, _ in shown], lambda v: number(v, 0))
    rows = [Row([Cell(b.name), t, m]) for (b, _), t, m in zip(shown, times, memories, strict=True)]
    columns = [
        Column("block"),
        Column("time", "s"),
        Column("memory of its worker so far, the plan as a line", "MiB"),
    ]
    return Table("blocks", "Blocks", columns, rows, note=_left_out(run.predicted))


def step_table(run: Facts) -> Table | None:
    shown = [(b, r) for b in run.predicted[:MOST_ROWS] if (r := run.receipt(b)) and r.steps]
    if not shown:
        return None
    names = list(dict.fromkeys(name for _, receipt in shown for name in receipt.steps))
    columns = [Column("block"), *(Column(name.replace("+", " + "), "s") for name in names)]
    rows = [Row([Cell(b.name), *(_cell(r.steps.get(name), 2) for name in names)]) for b, r in shown]
    return Table("steps", "Steps of every block", columns, rows)
