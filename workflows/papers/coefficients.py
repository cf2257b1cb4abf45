"""Closed-form and fitted coefficients: an exhibit that the papers do not have."""

from __future__ import annotations

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.measurement.figures import PointResponse
from blocksar.processors.chain.planning.plan import Plan
from blocksar.processors.chain.steps.lines import focus
from blocksar.products.pictures.panels import CURVE_COLOURS, LimitLine, Panel, Trace, plot_panels
from papers.bench import SWATH, Bench, plan_scene
from papers.comparison import Cell, Exhibit, Row, Table, listed, minus
from papers.printed import NAMES
from papers.sectors import full_dwell
from papers.single_targets import recovered_lines, trace


def closed_form(bench: Bench) -> Exhibit:
    """Closed-form against fitted coefficients: residual phase by range, and the nine targets with one block."""
    ranges = np.linspace(SWATH["near"], SWATH["far"], 13)
    path, panels, rows = bench.picture("closed-form"), [], []
    for blocks in (1, 2, 3):
        traces, title = [], f"{blocks} block{'s' * (blocks > 1)}"
        for coefficients, colour in zip(("closed-form", "fitted"), CURVE_COLOURS[::2], strict=False):
            residual = residual_phase(plan_scene("table1", blocks, coefficients=coefficients), ranges)
            traces.append(Trace(coefficients, ranges / 1e3, residual, colour))
            rows.append(Row(f"{title}, {coefficients}, worst range", float(residual.max()), "rad", digits=4))
        limits = [LimitLine("π/4", np.pi / 4)]
        panels.append(Panel(title, "range (km)", "phase (rad)", traces, limits, y_limits=(1e-4, 10.0), log=True))
    plot_panels(panels, path, columns=3, size=(3.5, 2.9), title="Residual quadratic phase at the edge of the dwell")
    runs = {kind: bench.run("table1", blocks=1, coefficients=kind) for kind in ("closed-form", "fitted")}
    measured = {kind: run.measured("table1", NAMES) for kind, run in runs.items()}
    return Exhibit(
        title="Closed-form and fitted coefficients",
        text="Not a figure of the papers. The residual quadratic phase at the edge of the dwell on traced lines, the "
        "worst of all yaws that are lit for a full dwell: with the corrected (30) and (31) of paper A, and with "
        "coefficients fitted on the lines. Also the nine targets of Table 3 with the whole sector as one block.",
        pictures=[path],
        rows=rows,
        tables=[listed(rows), _pslr_table(measured)],
    )


def residual_phase(plan: Plan, ranges: FloatArray) -> FloatArray:
    """The worst residual quadratic phase of all blocks and yaws of full dwell at each range, rad."""
    worst, full = np.zeros(ranges.size), full_dwell()
    for block in plan.blocks:
        yaws = np.linspace(max(block.low, full.low), min(block.high, full.high), 21)
        line = recovered_lines(plan, [(rng, yaw) for rng in ranges.tolist() for yaw in yaws.tolist()])
        residual = focus(trace(line, block)).quadratic.reshape(ranges.size, yaws.size)
        worst = np.maximum(worst, residual.max(axis=1))
    return worst


def _pslr_table(measured: dict[str, dict[str, PointResponse]]) -> Table:
    header = ["target, one block", *(f"azimuth PSLR, {kind} (dB)" for kind in measured)]
    cells = [[Cell(name)] + [Cell(minus(f"{m[name].azimuth_pslr:.2f}")) for m in measured.values()] for name in NAMES]
    return Table(header, cells)
