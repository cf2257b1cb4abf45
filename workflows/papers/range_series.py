"""Paper A's Figures 2 to 4: the orders of the range history by sectors."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.collection import range_series
from blocksar.products.pictures.figures import CURVE_COLOURS
from blocksar.products.pictures.panels import Level, Panel, Trace, plot_panels
from papers.bench import Bench, geometry, scene
from papers.comparison import ABOVE_QUARTER, BELOW_QUARTER, Exhibit, Row, below
from papers.printed import QUARTER, SWATH
from papers.single_targets import YAWS, Sector

# ---------------------------------------------------------------- paper A: the range series (2)

ORDERS = ("first", "second", "third", "fourth")


def sectors(count: int) -> list[Sector]:
    """The steering interval of paper A's Table 1, divided evenly."""
    beam = scene("table1").beam
    assert beam is not None
    edges = np.radians(np.linspace(beam.start_deg, beam.stop_deg, count + 1)).tolist()
    return [Sector(*edge) for edge in pairwise(edges)]


def series_phase(sector: Sector, order: int, *, kept: int) -> tuple[FloatArray, FloatArray]:
    """Yaws (n,) in rad, and the phase (range, n) of k_n less its first terms in yaw, (3) of paper A, in pi.

    All at half the aperture; `kept` terms are taken off.
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
    """Curves of `series_phase` over yaw, one a range; and the largest of them, in pi."""
    found = [series_phase(sector, order, kept=kept) for sector in sectors(blocks)]
    yaw = np.concatenate([np.append(yaw, np.nan) for yaw, _ in found])
    phase = np.concatenate([np.pad(values, ((0, 0), (0, 1)), constant_values=np.nan) for _, values in found], axis=1)
    curves = [
        Trace(f"{name} range, {rng / 1e3:.1f} km", np.degrees(yaw), values, colour)
        for (name, rng), values, colour in zip(SWATH.items(), phase, CURVE_COLOURS, strict=False)
    ]
    levels = (Level("±π/4", QUARTER), Level("", -QUARTER))
    return Panel(title, "yaw (°)", "phase (π rad)", curves, levels), float(np.nanmax(np.abs(phase)))


def figure2(bench: Bench) -> Exhibit:
    """Before division: what (2) leaves of k_1 .. k_4."""
    made = [phase_panel(f"({'abcd'[n]}) {ORDERS[n]} order", n + 1, blocks=1, kept=4 - n) for n in range(4)]
    path = bench.picture("fig2")
    plot_panels([panel for panel, _ in made], path, title="What the range series leaves, whole sector")
    claims = (ABOVE_QUARTER, ABOVE_QUARTER, BELOW_QUARTER, BELOW_QUARTER)
    return Exhibit(
        title="Figure 2: phase errors of the range series before angular division",
        text="Phase at half the aperture that the series (2) leaves of each order of the range, over the whole "
        "steering interval about its centre. The paper prints curves, and says which of them exceed π/4.",
        pictures=[path],
        rows=[
            Row(f"{name} order, largest error", worst, "π rad", claim, digits=4)
            for name, (_, worst), claim in zip(ORDERS, made, claims, strict=True)
        ],
    )


def figure3(bench: Bench) -> Exhibit:
    """After division in three: what (2) leaves of k_1 and k_2."""
    made = [phase_panel(f"({'ab'[n]}) {ORDERS[n]} order", n + 1, blocks=3, kept=4 - n) for n in range(2)]
    path = bench.picture("fig3")
    plot_panels([panel for panel, _ in made], path, title="What the range series leaves, three blocks")
    return Exhibit(
        title="Figure 3: phase errors of the range series after angular division",
        text="The same with the steering interval divided in three, each block about its own centre. “Much less than "
        "π/4” is taken as less than a fifth of it.",
        pictures=[path],
        rows=[
            Row(f"{name} order, largest error", worst, "π rad", below(QUARTER / 5, "much less than π/4"), digits=4)
            for name, (_, worst) in zip(ORDERS, made, strict=False)
        ],
    )


def figure4(bench: Bench) -> Exhibit:
    """The space-variant part of the third order, before and after division."""
    titles = {1: "(a) whole sector", 3: "(b) three blocks"}
    made = {count: phase_panel(title, 3, blocks=count, kept=1) for count, title in titles.items()}
    path = bench.picture("fig4")
    plot_panels([panel for panel, _ in made.values()], path, title="The space-variant third order")
    return Exhibit(
        title="Figure 4: phase of the space-variant third order",
        text="Phase at half the aperture of k₃ less its value at the centre: of the sector in (a), of each block in "
        "(b).",
        pictures=[path],
        rows=[
            Row("whole sector, largest phase", made[1][1], "π rad", ABOVE_QUARTER, digits=3),
            Row("three blocks, largest phase", made[3][1], "π rad", BELOW_QUARTER, digits=3),
        ],
    )
