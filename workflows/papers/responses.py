"""Paper A's Figures 14 and 15 and Tables 2 and 3, and paper B's table: point responses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from blocksar.constants import SINC_WIDTH
from blocksar.measurement.figures import PointResponse
from blocksar.measurement.response import CUT_WIDTHS
from blocksar.measurement.table3 import TABLE3, PaperResponse
from blocksar.products.pictures import responses
from papers.bench import Bench, Run, targets
from papers.comparison import Cell, Exhibit, Row, Table, crossed, minus
from papers.printed import GRID_B, NAMES, PAPER_B, POINTS_B, TABLE2

# ---------------------------------------------------------------- point responses

TOLERANCES = {"PSLR": 0.5, "ISLR": 0.5, "IRW": 0.05}
WHY_ISLR = (
    "ISLR: the paper does not define its ISLR. Ours counts side lobes within {ours:g} widths of the peak, for which an "
    "ideal response has {ideal:.2f} dB; it would have the {printed:.2f} dB that {whose} where they are counted within "
    "about {widths:.1f} widths."
)
WHY_WIDTH = (
    "Azimuth IRW: the printed widths are all but constant over the scene, as if one factor had turned the width in "
    "Doppler, which is the same for every full dwell, into metres. Ours are metres on the ground along constant range: "
    "Doppler changes less with yaw towards the velocity, so they grow with yaw and follow the limit of each target's "
    "own dwell (last column). A1 and A3 are lit for part of a dwell only."
)
WHY_B = (
    "The frequency perturbation is not FDPF, of which the paper gives no more than the name: it blurs points by other "
    "amounts. That points at the edges blur by it, and hardly by resampling, is what the tables show."
)
WHY_PSLR = "PSLR: the printed response of this target is not ours."


def why_islr(printed: float, whose: str) -> str:
    """With the definition that would give an ideal response the printed ISLR, dB."""
    u = np.arange(0, 60, 1e-3)
    energy = np.cumsum(np.sinc(u) ** 2)
    main, side = energy[u <= 1][-1], u > 1
    widths, islr = u[side] / SINC_WIDTH, 10 * np.log10((energy[side] - main) / main)
    within = float(widths[np.abs(islr - printed).argmin()])
    ideal = float(np.interp(CUT_WIDTHS, widths, islr))
    return minus(WHY_ISLR.format(ours=CUT_WIDTHS, ideal=ideal, printed=printed, whose=whose, widths=within))


def response_tables(
    found: dict[str, PointResponse], printed: dict[str, PaperResponse], why: str
) -> tuple[list[Row], list[Table]]:
    """Range and azimuth of the nine targets, beside the paper's."""
    rows_, tables = [], []
    islr = why_islr(float(np.mean([row.range_islr for row in printed.values()])), "the table prints for range (mean)")
    for axis in ("range", "azimuth"):
        part = []
        for name in NAMES:
            for quantity, unit in (("PSLR", "dB"), ("ISLR", "dB"), ("IRW", "m")):
                key = f"{axis}_{quantity.lower()}"
                ours, theirs = getattr(found[name], key), getattr(printed[name], key)
                reason = {"ISLR": islr, "IRW": WHY_WIDTH, "PSLR": why}[quantity]
                part.append(Row(f"{name}: {axis} {quantity}", ours, unit, theirs, TOLERANCES[quantity], reason))
        table = crossed(part)
        table.header.append("IRW, limit (m)")
        for name, line in zip(NAMES, table.lines, strict=True):
            line.append(Cell(f"{getattr(found[name], f'{axis}_irw_theory'):.2f}"))
        tables.append(table)
        rows_ += part
    return rows_, tables


def contours(bench: Bench, key: str, run: Run, title: str) -> Path:
    path = bench.picture(key)
    responses.plot_contours(run.responses(targets("table1", NAMES)), path, title=title)
    return path


def reference_run(bench: Bench) -> Run:
    """The reference method of paper A: see `Method`."""
    return bench.run("table1", blocks=1, coefficients="closed-form", range_model="conventional")


REFERENCE = (
    "The paper's reference method is its [10], of which it says only that the range model is less accurate after "
    "variable substitution and that the space-variant third order remains, all other steps being its own. Built in its "
    "place: a range model whose substitution is right to first order in azimuth. With it only the first condition of "
    "(29) can be met, so there is the α of (30) and no β, and third and fourth order count as constant; the sector is "
    "one block."
)


def figure14(bench: Bench) -> Exhibit:
    """Contours of the nine targets by the reference method."""
    path = contours(bench, "fig14", reference_run(bench), "Reference method")
    return Exhibit(
        title="Figure 14: contours by the reference method",
        text=f"Contours at −3, −15 and −30 dB on each response's own axes, all panels in one scale. {REFERENCE}",
        pictures=[path],
    )


def table2(bench: Bench) -> Exhibit:
    """The nine targets by the reference method."""
    measured = reference_run(bench).measured("table1", NAMES)
    why = (
        "PSLR: what was built in place of the reference method is not it, so edge targets blur by another amount; that "
        "they blur while A2, B2 and C2 do not is what the table shows."
    )
    found, tables = response_tables(measured, TABLE2, why)
    bad = [name for name in NAMES if measured[name].azimuth_pslr > -9]
    return Exhibit(
        title="Table 2: nine targets by the reference method",
        text=REFERENCE,
        rows=found,
        tables=tables,
        notes=[
            f"Azimuth PSLR is worse than −9 dB at {', '.join(bad) or 'none of the nine'}; in the paper at all of A1, "
            "A3, B1, B3, C1 and C3."
        ],
    )  # fmt: skip


def figure15(bench: Bench) -> Exhibit:
    """Contours of the nine targets, three blocks."""
    path = contours(bench, "fig15", bench.run("table1", blocks=3), "Angular division, three blocks")
    return Exhibit(
        title="Figure 15: contours by the proposed method",
        text="Contours at −3, −15 and −30 dB on each response's own axes, all panels in one scale: three blocks, "
        "fitted coefficients.",
        pictures=[path],
    )


def table3(bench: Bench) -> Exhibit:
    """The nine targets, three blocks."""
    measured = bench.run("table1", blocks=3).measured("table1", NAMES)
    found, tables = response_tables(measured, TABLE3, WHY_PSLR)
    excess = max(abs(r.azimuth_irw / r.azimuth_irw_theory - 1) for r in measured.values())
    return Exhibit(
        title="Table 3: nine targets by the proposed method",
        text="Three blocks, fitted coefficients. PSLR, ISLR and IRW are measured in the calibrated ground image, along "
        "constant Doppler (range) and along constant range (azimuth).",
        rows=found,
        tables=tables,
        notes=[f"Every azimuth width is within {100 * excess:.2g} % of what the target's own dwell allows."],
    )


# ---------------------------------------------------------------- paper B


def paper_b_table(bench: Bench) -> Exhibit:
    """Three points of paper B's scene: resampled, and by a frequency perturbation only."""
    methods: dict[str, dict[str, Any]] = {
        "keystone-resampling": {"perturbation": "all"},
        "frequency perturbation, closed-form": {"perturbation": "frequency", "coefficients": "closed-form"},
        "frequency perturbation, fitted": {"perturbation": "frequency"},
    }
    parts = {}
    for title, options in methods.items():
        run = bench.run("paper_b", blocks=1, grid=GRID_B, processor="keystone-resampling", **options)
        measured = list(run.measured("paper_b", POINTS_B).values())
        parts[title] = _paper_b_rows(measured, PAPER_B[options["perturbation"]])
    found = [row for part in parts.values() for row in part]
    # The peak is looked for where the point is.
    above_peak = any(row.ours > 0 for row in found if row.what.endswith("PSLR"))
    smeared = ["PSLR above 0 dB: the point is smeared, and a lobe beside its place is the strongest."] * above_peak
    return Exhibit(
        title="Table 2 of paper B: azimuth figures of three points",
        text="Points 1 to 3 stand at −1000, 0 and +1000 m of azimuth, at middle range: the paper's figure of them is "
        "not at hand, and that is its scene's size. The first table is the paper's method, with fitted coefficients. "
        "The others stand in for its FDPF column, a method which it only names: a frequency perturbation in place of "
        "perturbation in time and resampling, with coefficients expanded about the scene's centre, and fitted to the "
        "whole scene.",
        rows=found,
        tables=[crossed(part, title) for title, part in parts.items()],
        notes=[
            *smeared,
            "MW: the unit of the printed widths is not stated, so they cannot be compared with metres. For the paper's "
            "method they are all but equal, as widths in Doppler are of points that are lit for one time; so what is "
            "compared is the width over the limit of each point's own dwell, with point 2 as the unit.",
        ],
    )


def _paper_b_rows(found: Sequence[PointResponse], printed: Mapping[str, Sequence[float]]) -> list[Row]:
    islr = why_islr(PAPER_B["all"]["ISLR"][1], "the paper prints for point 2")
    rows_, over_limit = [], [response.azimuth_irw / response.azimuth_irw_theory for response in found]
    well = printed is PAPER_B["all"]
    for i, (response, width) in enumerate(zip(found, printed["MW"], strict=True)):
        name, ratio, theirs = f"point {i + 1}", over_limit[i] / over_limit[1], width / printed["MW"][1]
        rows_ += [
            Row(f"{name}: PSLR", response.azimuth_pslr, "dB", printed["PSLR"][i], 0.5, WHY_B),
            Row(f"{name}: ISLR", response.azimuth_islr, "dB", printed["ISLR"][i], 0.5, islr if well else WHY_B),
            Row(f"{name}: IRW", response.azimuth_irw, "m", f"MW {width:.2f}", digits=3),
            Row(f"{name}: IRW over limit, point 2 = 1", ratio, "", theirs, 0.02, WHY_B, digits=3),
        ]
    return rows_
