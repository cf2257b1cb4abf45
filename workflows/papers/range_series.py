"""Paper A's Figures 2 to 4: phase errors of the range series (2), order by order."""

from __future__ import annotations

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.collection import range_series
from blocksar.products.pictures.panels import CURVE_COLOURS, LimitLine, Panel, Trace, plot_panels
from papers.bench import SWATH, Bench, geometry
from papers.comparison import ABOVE_QUARTER, BELOW_QUARTER, QUARTER, Exhibit, Row, below
from papers.sectors import YAWS, Sector, sectors

ORDERS = ("first", "second", "third", "fourth")


def series_phase(sector: Sector, order: int, *, kept: int) -> tuple[FloatArray, FloatArray]:
    """Phase error of one order of the series: yaws (n,) in rad, phases (range, n) in units of pi.

    The phase at half the aperture of k_n less the first `kept` terms of its expansion in yaw, (3) of paper A.
    """
    geo, ranges = geometry("table1"), np.array(list(SWATH.values()))
    yaw = np.linspace(sector.low, sector.high, YAWS)
    exact = range_series.range_series(geo, ranges[:, None], yaw, order=4)[..., order]
    half_width = (sector.high - sector.low) / 2
    series = range_series.yaw_series(geo, ranges, sector.centre, order=4, half_width=half_width)[:, order, :kept]
    error = exact - series @ (yaw - sector.centre) ** np.arange(kept)[:, None]
    half_aperture = geo.collection.pulse_interval * geo.collection.n_pulse / 2
    return yaw, 4 / geo.collection.wavelength * error * half_aperture**order


def phase_panel(title: str, order: int, *, blocks: int, kept: int) -> tuple[Panel, float]:
    """Curves of `series_phase` over yaw, one per range; and the largest value, in units of pi."""
    parts = [series_phase(sector, order, kept=kept) for sector in sectors(blocks)]
    yaw = np.concatenate([np.append(yaw, np.nan) for yaw, _ in parts])
    phase = np.concatenate([np.pad(values, ((0, 0), (0, 1)), constant_values=np.nan) for _, values in parts], axis=1)
    curves = [
        Trace(f"{name} range, {rng / 1e3:.1f} km", np.degrees(yaw), values, colour)
        for (name, rng), values, colour in zip(SWATH.items(), phase, CURVE_COLOURS, strict=False)
    ]
    levels = (LimitLine("±π/4", QUARTER), LimitLine("", -QUARTER))
    return Panel(title, "yaw (°)", "phase (π rad)", curves, levels), float(np.nanmax(np.abs(phase)))


def figure2(bench: Bench) -> Exhibit:
    """Before division: errors of k_1 to k_4 in (2)."""
    panels = [phase_panel(f"({'abcd'[n]}) {ORDERS[n]} order", n + 1, blocks=1, kept=4 - n) for n in range(4)]
    path = bench.picture("fig2")
    plot_panels([panel for panel, _ in panels], path, title="Errors of the range series, whole sector")
    claims = (ABOVE_QUARTER, ABOVE_QUARTER, BELOW_QUARTER, BELOW_QUARTER)
    return Exhibit(
        title="Figure 2: phase errors of the range series before angular division",
        text="Phase error of each order of the series (2) at half the aperture, over the whole steering interval "
        "about its centre. The paper prints curves and states which of them exceed π/4.",
        pictures=[path],
        rows=[
            Row(f"{name} order, largest error", worst, "π rad", claim, digits=4)
            for name, (_, worst), claim in zip(ORDERS, panels, claims, strict=True)
        ],
    )


def figure3(bench: Bench) -> Exhibit:
    """After division in three: errors of k_1 and k_2 in (2)."""
    panels = [phase_panel(f"({'ab'[n]}) {ORDERS[n]} order", n + 1, blocks=3, kept=4 - n) for n in range(2)]
    path = bench.picture("fig3")
    plot_panels([panel for panel, _ in panels], path, title="Errors of the range series, three blocks")
    return Exhibit(
        title="Figure 3: phase errors of the range series after angular division",
        text="As Figure 2, with the steering interval divided in three, each block about its own centre. “Much less "
        "than π/4” is taken as less than a fifth of it.",
        pictures=[path],
        rows=[
            Row(f"{name} order, largest error", worst, "π rad", below(QUARTER / 5, "much less than π/4"), digits=4)
            for name, (_, worst) in zip(ORDERS, panels, strict=False)
        ],
    )


def figure4(bench: Bench) -> Exhibit:
    """The space-variant part of the third order, before and after division."""
    titles = {1: "(a) whole sector", 3: "(b) three blocks"}
    panels = {count: phase_panel(title, 3, blocks=count, kept=1) for count, title in titles.items()}
    path = bench.picture("fig4")
    plot_panels([panel for panel, _ in panels.values()], path, title="The space-variant third order")
    return Exhibit(
        title="Figure 4: phase of the space-variant third order",
        text="Phase at half the aperture of k₃ less its value at the centre: of the sector in (a), of each block in "
        "(b).",
        pictures=[path],
        rows=[
            Row("whole sector, largest phase", panels[1][1], "π rad", ABOVE_QUARTER, digits=3),
            Row("three blocks, largest phase", panels[3][1], "π rad", BELOW_QUARTER, digits=3),
        ],
    )
