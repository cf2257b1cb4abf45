"""Paper A's Figure 9: azimuth focusing."""

from __future__ import annotations

import numpy as np

from blocksar.measurement.figures import ProfileQuality, profile_quality
from blocksar.processors.chain.steps.azimuth_steps import Deramp, FrequencyPerturbation
from blocksar.processors.chain.steps.lines import focus
from blocksar.processors.chain.steps.range_steps import Compression
from blocksar.products.pictures.panels import CURVE_COLOURS, Panel, Style, Trace, plot_panels
from papers.bench import Bench, plan_scene
from papers.comparison import ABOVE_QUARTER, QUARTER, Exhibit, Row, below
from papers.sectors import same_range
from papers.single_targets import Cut, azimuth_cut, line_panel, rates, recovered_lines, trace


def figure9(bench: Bench) -> Exhibit:
    """Time-frequency lines through the azimuth steps, and focused azimuth responses."""
    plan, path = plan_scene("table1", 3), bench.picture("fig9")
    bare = plan_scene("table1", 3, perturbation="none")
    block = plan.blocks[0]
    places = same_range(block)
    line = recovered_lines(plan, list(places.values()))
    kinds = (Compression, FrequencyPerturbation, Deramp)
    after = [trace(line, block, through=kind) for kind in kinds]
    titles = ("(a) before perturbation", "(b) after frequency perturbation", "(c) after deramp")
    panels = [
        line_panel(title, line, [f"${name}$" for name in places]) for title, line in zip(titles, after, strict=True)
    ]
    cuts = {name: azimuth_cut("table1", plan, block, place) for name, place in places.items()}
    blurred = {name: azimuth_cut("table1", bare, bare.blocks[0], place) for name, place in places.items()}
    panels.append(_cut_panel("(d) focused in Doppler", cuts, blurred))
    plot_panels(panels, path, title="Azimuth focusing of targets of one range")
    dwell = float(line.weight.sum(axis=-1).max())
    deramped = [trace(recovered_lines(p, list(places.values())), p.blocks[0], through=Deramp) for p in (plan, bare)]
    residual = [float(focus(each).quadratic.max()) / np.pi for each in deramped]
    # As phase at the edge of the dwell, in units of pi.
    differing, *apart = (float(np.ptp(rates(each))) * (dwell / 2) ** 2 for each in (after[0], *deramped))
    quality = [_quality(cut) for cut in (*cuts.values(), *blurred.values())]
    return Exhibit(
        title="Figure 9: azimuth focusing of targets that share a reference range",
        text="The targets of Figure 8. (a) to (c) are traced lines. (d) shows cuts of focused samples about the "
        "Doppler at which each target's traced line focuses; dotted: without perturbation, where one deramp serves all "
        "targets. Targets are lit at different times, so equal rates mean that one curve of Doppler over time, shifted "
        "in Doppler, fits all of them: a common deramp removes it. The remaining difference of the rates is given as "
        "phase at the edge of the dwell.",
        pictures=[path],
        rows=[
            *(
                Row(f"(a) Doppler rate of {name}", float(rate) / 1e3, "kHz/s")
                for name, rate in zip(places, rates(after[0]), strict=True)
            ),
            Row("(a) rates differ by", differing, "π rad", ABOVE_QUARTER),
            Row("(a) rates differ, beyond one curve", apart[1], "π rad", digits=4),
            Row("(b) rates differ, beyond one curve", apart[0], "π rad", below(QUARTER / 5, "the same rate"), digits=4),
            Row("(c) residual quadratic phase", residual[0], "π rad", below(QUARTER / 5, "level"), digits=4),
            Row("(c) the same without perturbation", residual[1], "π rad", digits=4),
            *(Row(f"(d) PSLR of {name}", each.pslr, "dB") for name, each in zip(places, quality[:3], strict=True)),
            *(Row(f"(d) PSLR of {name}, no perturbation", each.pslr, "dB")
              for name, each in zip(places, quality[3:], strict=True)),
        ],
    )  # fmt: skip


def _quality(cut: Cut) -> ProfileQuality:
    """Quality of a cut about its peak."""
    top = int(np.abs(cut.values).argmax())
    return profile_quality(cut.offset - cut.offset[top], cut.values, width=cut.width)


def _cut_panel(title: str, cuts: dict[str, Cut], blurred: dict[str, Cut]) -> Panel:
    traces, reach = [], 8 * next(iter(cuts.values())).width
    peak = max(float(np.abs(cut.values).max()) for cut in cuts.values())
    parts: tuple[tuple[dict[str, Cut], Style], ...] = ((blurred, ":"), (cuts, "-"))
    for group, style in parts:
        for cut, colour in zip(group.values(), CURVE_COLOURS, strict=False):
            near = np.abs(cut.offset) < reach
            decibel = 20 * np.log10(np.abs(cut.values[near]) / peak + 1e-6)
            label, shade = ("no perturbation", "#8c9bb0") if style == ":" else ("", colour)
            traces.append(Trace(label, cut.offset[near], decibel, shade, style))
    return Panel(title, "Doppler from the traced focus (Hz)", "power (dB)", traces, y_limits=(-45, 2))
