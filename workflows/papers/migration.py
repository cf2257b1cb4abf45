"""Paper A's Figures 8 and 11: range migration before and after correction."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from blocksar.products.pictures.panels import CURVE_COLOURS, Panel, Trace, plot_panels
from papers.bench import SWATH, Bench, plan_scene
from papers.comparison import Exhibit, Row, above, below
from papers.sectors import same_range
from papers.single_targets import Migration, cells, migrations


def migration_panel(title: str, migrations: Mapping[str, Migration], *, origin: float) -> Panel:
    """Traced lines and measured peaks; ranges from `origin`, m."""
    traces = []
    for (name, migration), colour in zip(migrations.items(), CURVE_COLOURS, strict=False):
        traces.append(Trace(f"{name}traced", migration.line.time, migration.line.range - origin, colour))
        traces.append(Trace(f"{name}measured", migration.time, migration.peak - origin, colour, "."))
    return Panel(title, "slow time (s)", "range (m)", traces)


def figure8(bench: Bench) -> Exhibit:
    """Range migration of three targets of one range, through the range steps of the first block."""
    plan = plan_scene("table1", 3)
    block = plan.blocks[0]
    targets = {name: migrations("table1", plan, block, place) for name, place in same_range(block).items()}
    stages = ("unified range-walk correction", "residual range-walk correction", "keystone", "RCMC")
    origin = SWATH["middle"] - plan.recovery.origin
    panels = [
        migration_panel(
            f"({letter}) after {stage}", {f"${name}$, ": steps[i] for name, steps in targets.items()}, origin=origin
        )
        for i, (letter, stage) in enumerate(zip("abcd", stages, strict=True))
    ]
    path = bench.picture("fig8")
    plot_panels(panels, path, title="Range migration of targets of one range")
    worst = [cells(max(steps[i].extent for steps in targets.values())) for i in range(4)]
    apart = cells(float(np.ptp([steps[3].line.range.mean() for steps in targets.values()])))
    claims = (above(1, "walk remains"), above(0.5, "differs between targets"), None, below(0.5, "corrected"))
    off = max(steps[i].disagreement for steps in targets.values() for i in range(4))
    return Exhibit(
        title="Figure 8: range migration of targets that share a reference range",
        text=f"T_A, T_B and T_C lie at {SWATH['middle'] / 1e3:.0f} km in the first block, at the first and the last of "
        "its yaws that are lit for a full dwell, and halfway; ranges are relative to that range. Lines are traced; "
        "dots are peaks of range-compressed samples, of each target simulated alone and passed through the steps. A "
        "range cell is "
        f"{1 / cells(1):.2f} m.",
        pictures=[path],
        rows=[
            *(Row(f"after {stage}, largest migration", extent, "cells", claim, digits=3)
              for stage, extent, claim in zip(stages, worst, claims, strict=True)),
            Row("after RCMC, largest difference between targets", apart, "cells", below(1, "one range cell"), digits=3),
            Row("peaks and traced lines, largest difference", cells(off), "cells", digits=3),
        ],
    )  # fmt: skip


def figure11(bench: Bench) -> Exhibit:
    """Residual migration of a near, a middle and a far target, without and with keystone."""
    path, panels, residuals = bench.picture("fig11"), [], []
    letters = iter("abcdef")
    for keystone in (False, True):
        plan = plan_scene("table1", 3, keystone=keystone)
        block = plan.blocks[1]
        for (name, rng), target in zip(SWATH.items(), "ABC", strict=True):
            after = migrations("table1", plan, block, (rng, block.low))[-1]
            title = f"({next(letters)}) {target}, {name} range, {'with' if keystone else 'without'} keystone"
            panels.append(migration_panel(title, {"": after}, origin=float(after.line.range.mean())))
            residuals.append((f"{target}, {'with' if keystone else 'without'} keystone", after))
    reach = 1.1 * max(float(np.abs(trace.y).max()) for panel in panels for trace in panel.traces)
    plot_panels([panel._replace(y_limits=(-reach, reach)) for panel in panels], path, columns=3, size=(3.6, 2.7),
                title="Residual range migration")  # fmt: skip
    off = cells(max(after.disagreement for _, after in residuals))
    larger, corrected = above(1, "much larger than a cell"), below(0.5, "accurately compensated")
    claims = (larger, None, larger, corrected, corrected, corrected)
    return Exhibit(
        title="Figure 11: residual range migration without and with keystone",
        text="Targets A, B and C stand at near, middle and far range (27.6, 30.0, 32.4 km), all at the first yaw of "
        "the middle block, where keystone corrects most; the paper does not print their yaws. Ranges are relative to "
        "the mean over the dwell, all in one scale. Without keystone, migration is corrected in the time domain by the "
        "reference of the block.",
        pictures=[path],
        rows=[
            Row(name, cells(after.extent), "cells", claim, digits=3)
            for (name, after), claim in zip(residuals, claims, strict=True)
        ],
        notes=[f"Peaks of samples and traced lines differ by {off:.3f} cells at most."],
    )
