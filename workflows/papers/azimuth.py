"""Paper A's Figure 9 and the closed form: azimuth compression."""

from __future__ import annotations

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.focusing.azimuth_steps import Deramp, FrequencyPerturbation
from blocksar.focusing.lines import focus
from blocksar.focusing.range_steps import Compression
from blocksar.measurement.figures import PointResponse, ProfileQuality, profile_quality
from blocksar.planning.plan import Plan
from blocksar.products.pictures.figures import CURVE_COLOURS
from blocksar.products.pictures.panels import Level, Panel, Style, Trace, plot_panels
from papers.bench import Bench, plan
from papers.comparison import ABOVE_QUARTER, Cell, Exhibit, Row, Table, below, listed, minus
from papers.printed import NAMES, QUARTER, SWATH
from papers.single_targets import Cut, azimuth_cut, full_dwell, line_panel, lines, rates, same_range, traced


def figure9(bench: Bench) -> Exhibit:
    """Time-frequency lines through the azimuth steps, and focused azimuth responses."""
    made, path = plan("table1", 3), bench.picture("fig9")
    bare = plan("table1", 3, perturbation="none")
    block = made.blocks[0]
    places = same_range(block)
    line = lines(made, list(places.values()))
    kinds = (Compression, FrequencyPerturbation, Deramp)
    after = [traced(line, block, through=kind) for kind in kinds]
    titles = ("(a) before perturbation", "(b) after frequency perturbation", "(c) after deramp")
    panels = [
        line_panel(title, line, [f"${name}$" for name in places]) for title, line in zip(titles, after, strict=True)
    ]
    cuts = {name: azimuth_cut("table1", made, block, place) for name, place in places.items()}
    blurred = {name: azimuth_cut("table1", bare, bare.blocks[0], place) for name, place in places.items()}
    panels.append(_cut_panel("(d) focused in Doppler", cuts, blurred))
    plot_panels(panels, path, title="Azimuth focusing of targets of one range")
    dwell = float(line.weight.sum(axis=-1).max())
    lined = [traced(lines(p, list(places.values())), p.blocks[0], through=Deramp) for p in (made, bare)]
    left = [float(focus(found).quadratic.max()) / np.pi for found in lined]
    # As phase at the dwell's edge, of pi.
    differing, *apart = (float(np.ptp(rates(found))) * (dwell / 2) ** 2 for found in (after[0], *lined))
    quality = [_quality(cut) for cut in (*cuts.values(), *blurred.values())]
    return Exhibit(
        title="Figure 9: azimuth focusing of targets that share a reference range",
        text="The targets of Figure 8. (a) to (c) are traced lines; (d) are cuts of focused samples about the Doppler "
        "at which each target's traced line focuses, dotted without any perturbation, where one deramp has to serve "
        "all. Targets are lit at different times, so one rate for all means one curve of Doppler over time, moved up "
        "and down: that is what a common deramp takes out. By how much rates differ beyond it is given as phase at "
        "the dwell's edge.",
        pictures=[path],
        rows=[
            *(
                Row(f"(a) Doppler rate of {name}", float(rate) / 1e3, "kHz/s")
                for name, rate in zip(places, rates(after[0]), strict=True)
            ),
            Row("(a) rates differ by", differing, "π rad", ABOVE_QUARTER),
            Row("(a) rates differ, beyond one curve", apart[1], "π rad", digits=4),
            Row("(b) rates differ, beyond one curve", apart[0], "π rad", below(QUARTER / 5, "the same rate"), digits=4),
            Row("(c) quadratic phase left", left[0], "π rad", below(QUARTER / 5, "level"), digits=4),
            Row("(c) the same without perturbation", left[1], "π rad", digits=4),
            *(Row(f"(d) PSLR of {name}", found.pslr, "dB") for name, found in zip(places, quality[:3], strict=True)),
            *(Row(f"(d) PSLR of {name}, no perturbation", found.pslr, "dB")
              for name, found in zip(places, quality[3:], strict=True)),
        ],
    )  # fmt: skip


def _quality(cut: Cut) -> ProfileQuality:
    """About its peak."""
    top = int(np.abs(cut.values).argmax())
    return profile_quality(cut.offset - cut.offset[top], cut.values, width=cut.width)


def _cut_panel(title: str, cuts: dict[str, Cut], blurred: dict[str, Cut]) -> Panel:
    traces, reach = [], 8 * next(iter(cuts.values())).width
    peak = max(float(np.abs(cut.values).max()) for cut in cuts.values())
    parts: tuple[tuple[dict[str, Cut], Style], ...] = ((blurred, ":"), (cuts, "-"))
    for shown, style in parts:
        for cut, colour in zip(shown.values(), CURVE_COLOURS, strict=False):
            near = np.abs(cut.offset) < reach
            decibel = 20 * np.log10(np.abs(cut.values[near]) / peak + 1e-6)
            named = ("no perturbation", "#8c9bb0") if style == ":" else ("", colour)
            traces.append(Trace(named[0], cut.offset[near], decibel, named[1], style))
    return Panel(title, "Doppler from the traced focus (Hz)", "power (dB)", traces, y_limits=(-45, 2))


# ---------------------------------------------------------------- coefficients


def closed_form(bench: Bench) -> Exhibit:
    """Closed-form against fitted coefficients: residual phase by range, and the nine targets with one block."""
    ranges = np.linspace(SWATH["near"], SWATH["far"], 13)
    path, panels, found = bench.picture("closed-form"), [], []
    for blocks in (1, 2, 3):
        traces, title = [], f"{blocks} block{'s' * (blocks > 1)}"
        for coefficients, colour in zip(("closed-form", "fitted"), CURVE_COLOURS[::2], strict=False):
            left = quadratic_left(plan("table1", blocks, coefficients=coefficients), ranges)
            traces.append(Trace(coefficients, ranges / 1e3, left, colour))
            found.append(Row(f"{title}, {coefficients}, worst range", float(left.max()), "rad", digits=4))
        panels.append(
            Panel(
                title, "range (km)", "phase (rad)", traces, [Level("π/4", np.pi / 4)], y_limits=(1e-4, 10.0), log=True
            )
        )
    plot_panels(panels, path, columns=3, size=(3.5, 2.9), title="Quadratic phase left at the dwell's edge")
    runs = {kind: bench.run("table1", blocks=1, coefficients=kind) for kind in ("closed-form", "fitted")}
    measured = {kind: run.measured("table1", NAMES) for kind, run in runs.items()}
    return Exhibit(
        title="Closed-form and fitted coefficients",
        text="Not a figure of the papers. What is left of the quadratic phase at the dwell's edge on traced lines, the "
        "worst of all yaws that are lit for a full dwell, by (30) and (31) of paper A as corrected, and by "
        "coefficients fitted on the lines; and the nine targets of Table 3 with the whole sector as one block.",
        pictures=[path],
        rows=found,
        tables=[listed(found), _pslr_table(measured)],
    )


def quadratic_left(made: Plan, ranges: FloatArray) -> FloatArray:
    """The worst of all blocks and yaws of full dwell at each range, rad."""
    worst, full = np.zeros(ranges.size), full_dwell()
    for block in made.blocks:
        yaws = np.linspace(max(block.low, full.low), min(block.high, full.high), 21)
        line = lines(made, [(rng, yaw) for rng in ranges.tolist() for yaw in yaws.tolist()])
        left = focus(traced(line, block)).quadratic.reshape(ranges.size, yaws.size)
        worst = np.maximum(worst, left.max(axis=1))
    return worst


def _pslr_table(measured: dict[str, dict[str, PointResponse]]) -> Table:
    lines_ = [[Cell(name)] + [Cell(minus(f"{m[name].azimuth_pslr:.2f}")) for m in measured.values()] for name in NAMES]
    return Table(["target, one block", *(f"azimuth PSLR, {kind} (dB)" for kind in measured)], lines_)
