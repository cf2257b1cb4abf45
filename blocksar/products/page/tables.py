"""Tables of the report page: plan, targets, comparison with back-projection, stages, units, blocks and steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from blocksar.budget import FIDELITY, side_lobe_budget
from blocksar.constants import MIB, unit_of_lengths
from blocksar.measurement.figures import PointResponse, excess, worst_excess
from blocksar.products.page.facts import MOST_ROWS, TIMES, Facts, number
from blocksar.products.page.picture import Picture
from blocksar.runs.record import PredictedBlock

UNITS = {
    "range-compress": "range compression",
    "interference": "search for interference",
    "inspect": "inspection, by columns",
    "recover": "recovery, by columns",
    "gate": "range gates, by Doppler bins",
    "focus": "blocks",
    "mosaic": "image, by chunks",
    "layers": "layers of the terrain, by chunks",
    "pyramid": "pyramid, by parts",
    "pyramid-top": "top of the pyramid",
    "backprojection": "image, by chunks",
}  # of a stage
STAGES = {
    "inspect": "inspection of samples",
    "recover": "recovery",
    "check": "check of samples",
    "gate": "range gates",
    "focus": "focusing of blocks",
    "mosaic": "mosaic",
    "layers": "layers of the terrain",
    "pyramid": "pyramid",
    "backprojection": "back-projection",
    "rest": "start, checks and end",
}


@dataclass(frozen=True)
class Cell:
    """A cell of a table.

    Attributes
    ----------
    text : str
    sort : float or str
        Key for sorting by the column; empty for an unknown value.
    off : bool
        Whether the figure is outside its limit.
    bar, tick : float, optional
        Length of a bar drawn below the text, and place of a mark on it, % of the longest bar of the column.
    """

    text: str
    sort: float | str = ""
    off: bool = False
    bar: float | None = None
    tick: float | None = None


class Column(NamedTuple):
    """The head of a column: `title`, and `unit` below it."""

    title: str
    unit: str = ""


class Row(NamedTuple):
    """A row, whose first cell is its head; `at` is the place (x, y) in the picture that it links to, if any."""

    cells: list[Cell]
    at: tuple[str, str] | None = None


class PageTable(NamedTuple):
    """A table; `caption` is its title, `note` states what has been left out."""

    key: str
    caption: str
    columns: Sequence[Column]
    rows: Sequence[Row]
    sortable: bool = False
    note: str = ""


def _cell(value: float | None, digits: int, *, off: bool = False, scale: float = 1.0) -> Cell:
    """Format a number times `scale` as a cell, sortable by value; a dash if it is None or not finite."""
    if value is None or not np.isfinite(value):
        return Cell(number(None), "", off)
    return Cell(number(scale * value, digits), value, off)


def plan_table(run: Facts) -> PageTable | None:
    """Compare predictions for each block with the worst figures measured in it; None without a plan."""
    if not run.predicted:
        return None
    unit, metres = unit_of_lengths(max(block.range[1] for block in run.predicted))
    columns = [
        Column("block"),
        Column("coherence planned", f"\N{GREATER-THAN OR EQUAL TO} {_fidelity(run):g}"),
        Column("residual phase planned", "rad"),
        Column("azimuth PSLR planned", "dB"),
        Column("azimuth PSLR measured", "dB, worst"),
        Column("width planned", "relative to its limit"),
        Column("width measured", "relative to theory"),
        Column("targets measured"),
        Column("memory planned", "MiB"),
        Column("memory measured", "MiB, peak of its worker so far"),
        Column("migration planned", "cells"),
        Column("yaw", "degrees"),
        Column("range", unit),
    ]
    rows = [_plan_row(run, block, metres) for block in run.predicted[:MOST_ROWS]]
    if run.record.segments:
        columns.insert(1, Column("segment"))
        for row, block in zip(rows, run.predicted, strict=False):
            row.cells.insert(1, Cell(str(run.source.segment_of(block.block))))
    return PageTable(
        "plan", "Planned and measured figures of every block", columns, rows, note=_left_out(run.predicted)
    )


def _plan_row(run: Facts, block: PredictedBlock, metres: float) -> Row:
    """Predicted and measured figures of one block, with ranges in units of so many metres."""
    responses = [r for r in run.judged if run.places[id(r)] == block.name]
    pslr, width = _worst_of(responses, "azimuth_pslr"), _worst_of(responses, "azimuth_irw")
    fidelity, predicted = _fidelity(run), block.pslr
    receipt = run.receipt(block)
    peak = None if receipt is None else receipt.peak_memory
    low, high = np.degrees(block.yaw)
    near, far = (distance / metres for distance in block.range)
    return Row([
        Cell(block.name),
        _cell(block.coherence, 4, off=block.coherence < fidelity),
        _cell(block.residual_phase, 4),
        _cell(predicted, 2, off=abs(predicted - block.ideal_pslr) > side_lobe_budget(fidelity, block.ideal_pslr)),
        _cell(pslr and pslr.azimuth_pslr, 2, off=pslr is not None and excess(pslr, "azimuth_pslr") > 1),
        _cell(block.width, 4),
        _cell(
            width and width.azimuth_irw / width.azimuth_irw_theory, 4,
            off=width is not None and excess(width, "azimuth_irw") > 1,
        ),
        Cell(str(len(responses))),
        _cell(block.memory / MIB, 0),
        _cell(peak and peak / MIB, 0, off=peak is not None and peak > (run.planned_memory or np.inf)),
        _cell(block.migration, 3),
        Cell(f"{number(low)} .. {number(high)}"),
        Cell(f"{number(near, 3)} .. {number(far, 3)}"),
    ])  # fmt: skip


def _fidelity(run: Facts) -> float:
    """Return the fidelity that was requested, which records of earlier versions lack."""
    return float(run.settings.get("fidelity", FIDELITY))


def _worst_of(responses: Sequence[PointResponse], figure: str) -> PointResponse | None:
    """Find the response that deviates most in a figure."""
    return max(responses, key=lambda r: excess(r, figure), default=None)


def _left_out(rows: Sequence[Any]) -> str:
    """Note on rows beyond MOST_ROWS."""
    return f"The first {MOST_ROWS} of {number(len(rows), 0)}." if len(rows) > MOST_ROWS else ""


def quality_table(run: Facts, image: Picture) -> PageTable:
    """Figures of the point targets, linked to their places in the picture."""
    columns = [
        Column("target"),
        Column("worst figure", "% of its limit"),
        Column("range PSLR", "dB"),
        Column("range ISLR", "dB"),
        Column("range width", "m"),
        Column("range width", "relative to theory"),
        Column("azimuth PSLR", "dB"),
        Column("azimuth ISLR", "dB"),
        Column("azimuth width", "m"),
        Column("azimuth width", "relative to theory"),
        Column("x error", "mm"),
        Column("y error", "mm"),
        Column("amplitude"),
        Column("phase", "rad"),
        Column("judged"),
        Column("block"),
        Column("x", "m"),
        Column("y", "m"),
    ]
    if run.source.geometry.terrain is not None:
        columns.append(Column("ground", "z, m"))
    rows = [_quality_row(run, r, image) for r in run.listed]
    rest = len(run.responses) - len(run.listed)
    note = f"The {len(run.listed)} worst; {number(rest, 0)} more in quality.json." if rest else ""
    return PageTable("targets", "Point targets measured in the image", columns, rows, sortable=True, note=note)


def _quality_row(run: Facts, r: PointResponse, image: Picture) -> Row:
    """Figures of one target."""
    counts = r.full_dwell and r.covered and not r.crowded

    def off(figure: str) -> bool:
        return counts and excess(r, figure) > 1

    share = 100 * worst_excess(r) if counts else None
    status = (
        "yes" if counts else "not covered" if not r.covered else "another peak is near" if r.crowded else "partly lit"
    )
    cells = [
        Cell(r.name, r.name),
        _cell(share, 0, off=share is not None and share > 100),
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
        Cell(status, status),
        Cell(run.places[id(r)], run.places[id(r)]),
        _cell(r.x, 1),
        _cell(r.y, 1),
    ]
    if (terrain := run.source.geometry.terrain) is not None:
        cells.append(_cell(float(terrain(np.array(r.x), np.array(r.y))), 1))
    return Row(cells, image.find(r.x, r.y))


def reference_table(run: Facts) -> PageTable | None:
    """Tabulate the comparison of image chips with exact back-projection; None without one."""
    chips = run.chips
    if not chips:
        return None
    columns = [
        Column("chip"),
        Column("x", "m"),
        Column("y", "m"),
        Column("coherence"),
        Column("judged", "by the power within reach"),
        Column("gain"),
        Column("phase", "rad"),
    ]
    rows = [
        Row([
            Cell(c["place"], c["place"]), _cell(c["x"], 0), _cell(c["y"], 0), _cell(c["coherence"], 5),
            _cell(c["judged"], 5), _cell(c["gain"], 4), _cell(c["phase"], 4),
        ])
        for c in chips[:MOST_ROWS]
    ]  # fmt: skip
    caption = f"Chips of 64 {TIMES} 64 pixels compared with exact back-projection of the same samples"
    return PageTable("reference", caption, columns, rows, sortable=True, note=_left_out(chips))


def _bars(values: Sequence[float], ticks: Sequence[float | None], text: Callable[[float], str]) -> list[Cell]:
    """Make cells with bars on a common scale."""
    longest = max([*values, *(t for t in ticks if t is not None), 1e-12])
    return [
        Cell(text(value), value, bar=100 * value / longest, tick=None if tick is None else 100 * tick / longest)
        for value, tick in zip(values, ticks, strict=True)
    ]


def seconds_text(value: float) -> str:
    """Format s, with decimals below 100 s."""
    return number(value, 2 if value < 100 else 0)


def stage_table(run: Facts) -> PageTable | None:
    """Duration of the stages; None without timings."""
    if not run.timings:
        return None
    stages = {name: seconds for name, seconds in run.timings.items() if name != "total"}
    total = run.timings.get("total", sum(stages.values()))
    stages["rest"] = max(total - sum(stages.values()), 0.0)
    bars = _bars(list(stages.values()), [None] * len(stages), seconds_text)
    rows = [Row([Cell(STAGES.get(name, name)), bar]) for name, bar in zip(stages, bars, strict=True)]
    rows.append(Row([Cell("total"), Cell(seconds_text(total), total)]))
    return PageTable("stages", "Stages", [Column("stage"), Column("time", "s")], rows)


def unit_table(run: Facts) -> PageTable | None:
    """Time and memory by kind of unit; None without receipts."""
    kinds = [(name, [r for r in run.receipts if r.stage == stage]) for stage, name in UNITS.items()]
    rows = [
        Row([
            Cell(name),
            Cell(str(len(units))),
            Cell(str(sum(r.reused for r in units))),
            Cell(seconds_text(sum(r.seconds for r in units))),
            Cell(seconds_text(max(r.seconds for r in units))),
            _cell(max(r.peak_memory or 0 for r in units) / MIB, 0),
        ])
        for name, units in kinds
        if units
    ]  # fmt: skip
    columns = [
        Column("work"), Column("units"), Column("reused", "from an earlier process"), Column("total time", "s"),
        Column("longest", "s"), Column("peak memory", "MiB"),
    ]  # fmt: skip
    return PageTable("units", "Units of work", columns, rows) if rows else None


def block_table(run: Facts) -> PageTable | None:
    """Time and memory of each block; None without receipts of blocks."""
    blocks = [(b, r) for b in run.predicted[:MOST_ROWS] if (r := run.receipt(b))]
    if not blocks:
        return None
    times = _bars([r.seconds for _, r in blocks], [None] * len(blocks), seconds_text)
    peaks = [(r.peak_memory or 0) / MIB for _, r in blocks]
    memories = _bars(peaks, [b.memory / MIB for b, _ in blocks], lambda v: number(v, 0))
    rows = [Row([Cell(b.name), t, m]) for (b, _), t, m in zip(blocks, times, memories, strict=True)]
    columns = [
        Column("block"),
        Column("time", "s"),
        Column("peak memory of its worker so far", "MiB; mark: planned"),
    ]
    return PageTable("blocks", "Blocks", columns, rows, note=_left_out(run.predicted))


def step_table(run: Facts) -> PageTable | None:
    """Time of the steps of each block; None without receipts that hold steps."""
    blocks = [(b, r) for b in run.predicted[:MOST_ROWS] if (r := run.receipt(b)) and r.steps]
    if not blocks:
        return None
    names = list(dict.fromkeys(name for _, receipt in blocks for name in receipt.steps))
    columns = [Column("block"), *(Column(name.replace("+", " + "), "s") for name in names)]
    rows = [Row([Cell(b.name), *(_cell(r.steps.get(name), 2) for name in names)]) for b, r in blocks]
    return PageTable("steps", "Steps of every block", columns, rows)
