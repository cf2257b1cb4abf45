"""How many blocks? Residual phase, side lobes, width and memory against their number, predicted and measured.

    python workflows/blocks_against_residual_phase.py table1 --out study

Plans SCENE for 1 to 8 blocks with every processor, with fitted and with closed-form coefficients; this needs no
samples. Then simulates the scene, focuses it for some of these numbers, and measures all targets that were lit for a
full dwell. Writes study/blocks.csv and study/blocks.png and prints the table. For table1 this takes one or two minutes
on two cores, and 2 GB of temporary files. A scene whose beam is not steered needs --grid. The picture needs the extra
`plots`.

Results for `table1`, a squint-TOPS scan on a diving, turning platform (residual phase, rad):

    blocks                               1       2       4       8     budget 0.1
    angular-division, fitted         0.0013  0.0009  0.0005  0.0000
    angular-division, closed-form      1.29    1.52    0.70    0.87
    keystone-resampling, closed-form   0.14    0.20    0.07    0.03
    high-order-phase, closed-form      0.24    0.25    0.12    0.07

- Closed-form coefficients need blocks. Expanded about the middle of a block, they suffice for keystone-resampling
  from 4 blocks on, for high-order-phase from 6. Not every division helps: two blocks are worse than one.
- More blocks do not remove every error. The closed form of angular-division decreases to 0.70 rad at 4 blocks and then
  increases: the residual changes with range, and a division in angle does not reduce that. With a swath of 100 m
  instead of 5 km it keeps decreasing, from 0.68 rad at 4 blocks to 0.38 at 8.
- Fitted coefficients need no division: with one block the residual is a hundredth of the budget. More blocks then
  serve to reduce memory (778 MiB for one, 441 for four; below 388 recovery determines it) and to share the work
  between workers.
- Predictions hold. For the closed form the plan predicts side lobes of -7.30 dB (1 block) and -11.03 dB (4); the worst
  of 73 targets have -7.64 and -11.22. Widths over the limit: 1.109 and 1.023 predicted, 1.099 and 1.021 measured.
  Memory: 782 and 439 MiB predicted, 659 and 390 measured. A prediction is for the worst place of a block, where there
  may be no target.

Results for `paper_b`, which is lit all the time, with --grid 10960:11670:0.25,-1050:1050:0.25: high-order-phase is
refused with one block, as targets would migrate over 1.3 range cells, and leaves 0.24 rad even with 8.
Angular-division and keystone-resampling, fitted, leave 0.01 rad with 4. At a residual of some radians side lobes mean
little, as the main lobe has split.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, get_args

import numpy as np
import typer
from rich import box
from rich.console import Console
from rich.table import Table

import blocksar
from blocksar.application.parsing import parse_grid
from blocksar.budget import SIDE_LOBE_BUDGET
from blocksar.imaging.method import Chain, Coefficients

MIB = 2**20
COLUMNS = {  # of the CSV file, with title and format of the table's column
    "processor": ("processor", ""),
    "coefficients": ("coefficients", ""),
    "blocks": ("blocks", ""),
    "residual_phase_rad": ("residual phase (rad)", ".4f"),
    "pslr_db": ("PSLR (dB)", ".2f"),
    "measured_pslr_db": ("measured", ".2f"),
    "width": ("width / limit", ".3f"),
    "measured_width": ("measured", ".3f"),
    "memory_mib": ("memory (MiB)", ".0f"),
    "measured_memory_mib": ("measured", ".0f"),
    "refused": ("refused", ""),
}
COLOURS = dict(zip(get_args(Chain), ("#b3202c", "#2f6db3", "#2c8a4b"), strict=True))

Row = dict[str, Any]
Grid = tuple[tuple[float, float, float], tuple[float, float, float]]


def predict(scene: str, processor: Chain, coefficients: Coefficients, blocks: int, grid: Grid | None) -> Row:
    """Predictions of a plan for the worst place of its worst block. No samples are needed."""
    row: Row = {"processor": processor, "coefficients": coefficients, "blocks": blocks}
    try:
        plan = blocksar.plan(scene, processor=processor, coefficients=coefficients, blocks=blocks, grid=grid).result
    except blocksar.InputError as error:  # this processor cannot focus the scene at all
        return row | {"refused": str(error)}
    predictions = [block.prediction for block in plan.blocks]
    return row | {
        "residual_phase_rad": max(p.residual_phase for p in predictions),
        "pslr_db": max(p.pslr for p in predictions),
        "width": max(p.width for p in predictions),
        "memory_mib": plan.memory / MIB,
        "refused": plan.refusal or "",
    }


def measure(row: Row, history: Path, run: Path, grid: Grid | None) -> Row:
    """Focus with the settings of a row and add the worst figures of the targets that were lit for a full dwell."""
    settings = {name: row[name] for name in ("processor", "coefficients", "blocks")}
    record = blocksar.focus(history, run, grid=grid, overwrite=True, **settings).result
    targets = [
        target for target in blocksar.quality(run).result["targets"] if target["full_dwell"] and target["covered"]
    ]
    lobes, width, theory = (
        np.array([target[name] for target in targets], float)  # None, where nothing could be measured, becomes NaN
        for name in ("azimuth_pslr", "azimuth_irw", "azimuth_irw_theory")
    )
    return row | {
        "measured_pslr_db": lobes.max(),
        "measured_width": (width / theory).max(),
        "measured_memory_mib": record["peak_memory"] / MIB,
    }


def show(rows: list[Row]) -> None:
    table = Table(box=box.SIMPLE_HEAD)
    for title, form in COLUMNS.values():
        table.add_column(title, justify="right" if form else "left")
    for row in rows:
        cells = {name: format(row[name], form) for name, (_, form) in COLUMNS.items() if name in row}
        cells["refused"] = "yes" if row["refused"] else "no"
        table.add_row(*(cells.get(name, "") for name in COLUMNS), end_section=row["blocks"] == rows[-1]["blocks"])
    Console(width=160).print(table)
    for row in rows:
        if row["refused"]:
            print(f"{row['processor']}, {row['coefficients']}, {row['blocks']} blocks is refused: {row['refused']}")


def write(rows: list[Row], path: Path) -> None:
    with path.open("w", newline="") as file:
        table = csv.DictWriter(file, COLUMNS)
        table.writeheader()
        table.writerows(rows)


def draw(rows: list[Row], path: Path, title: str) -> None:
    """Draw predictions as lines (solid: fitted coefficients; dotted: closed-form ones), measurements as circles."""
    import matplotlib.pyplot as plt  # optional, and slow to load

    figure, axes = plt.subplots(2, 2, figsize=(12, 8), layout="constrained", sharex=True)
    panels = dict(zip(("residual_phase_rad", "pslr_db", "width", "memory_mib"), axes.flat, strict=True))
    for processor, colour in COLOURS.items():
        for coefficients, style in (("fitted", "-"), ("closed-form", ":")):
            curve = [r for r in rows if (r["processor"], r["coefficients"]) == (processor, coefficients)]
            for name, ax in panels.items():
                pairs = [(r["blocks"], r[name]) for r in curve if name in r]
                if pairs:
                    ax.plot(*zip(*pairs, strict=True), style, color=colour, label=f"{processor}, {coefficients}")
                measured = [(r["blocks"], r[f"measured_{name}"]) for r in curve if f"measured_{name}" in r]
                if measured:
                    ax.plot(*zip(*measured, strict=True), "o", color=colour, mfc="none" if style == ":" else colour)
    for name, ax in panels.items():
        ax.set(ylabel=COLUMNS[name][0])
        ax.grid(alpha=0.3)
    for ax in axes[1]:
        ax.set(xlabel="blocks")
    panels["residual_phase_rad"].set(yscale="log")
    panels["pslr_db"].axhline(-13.26 + SIDE_LOBE_BUDGET, color="black", linewidth=1)
    figure.suptitle(f"{title}: predicted (lines), measured (circles), budgets (black)")
    figure.legend(*panels["memory_mib"].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    figure.savefig(path, dpi=110)


def parse_numbers(text: str, option: str) -> list[int]:
    """Parse numbers of blocks separated by commas.

    Raises
    ------
    blocksar.InputError
        If one of them is not a positive integer.
    """
    if not all(part.isdecimal() and int(part) > 0 for part in text.split(",")):
        raise blocksar.InputError(f"{option} is {text!r}; give numbers of blocks separated by commas, such as 1,4")
    return sorted({int(part) for part in text.split(",")})


def main(
    scene: Annotated[str, typer.Argument(metavar="SCENE.toml", help="Scene file, or the name of a shipped scene.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for blocks.csv and blocks.png.")] = Path("study"),
    blocks: Annotated[str, typer.Option(metavar="N,...", help="Numbers of blocks to plan for.")] = "1,2,3,4,5,6,7,8",
    measured: Annotated[str, typer.Option(metavar="N,...", help="Those of them to focus with.")] = "1,4",
    processor: Annotated[Chain, typer.Option(metavar="NAME", help="Processor to focus with.")] = "angular-division",
    grid: Annotated[str | None, typer.Option(metavar="x0:x1:dx,y0:y1:dy", help="Image points, m.")] = None,
) -> None:
    """Study blocks against residual phase: plan with all processors, focus and measure some of the plans.

    Example: python workflows/blocks_against_residual_phase.py table1 --out study --measured 1,4
    """
    points = None if grid is None else parse_grid(grid)
    planned, focused = parse_numbers(blocks, "--blocks"), parse_numbers(measured, "--measured")
    rows = [
        predict(scene, chain, coefficients, count, points)
        for chain in get_args(Chain)
        for coefficients in get_args(Coefficients)
        for count in planned
    ]
    if all("residual_phase_rad" not in row for row in rows):  # the scene itself is wrong
        raise blocksar.InputError(rows[0]["refused"])
    out.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(dir=out) as scratch:
        history = Path(scratch, "phase_history.zarr")
        blocksar.simulate(scene, history)
        for row in rows:
            if row["processor"] == processor and row["blocks"] in focused and not row["refused"]:
                row.update(measure(row, history, Path(scratch, "run"), points))
    show(rows)
    write(rows, out / "blocks.csv")
    draw(rows, out / "blocks.png", scene)
    print(f"wrote {out / 'blocks.csv'} and {out / 'blocks.png'}")


if __name__ == "__main__":
    try:
        typer.run(main)
    except ModuleNotFoundError as error:
        print(f"blocks_against_residual_phase: {error.name} is not installed; install blocksar[plots]", file=sys.stderr)
        sys.exit(2)
    except blocksar.InputError as error:
        print(f"blocks_against_residual_phase: {error}", file=sys.stderr)
        sys.exit(2)
