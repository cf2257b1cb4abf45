"""Paper B's Table 2: azimuth figures of three points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from blocksar.collection.grid import Grid
from blocksar.measurement.figures import PointResponse
from papers.bench import Bench
from papers.comparison import Exhibit, Row, crossed
from papers.printed import PAPER_B
from papers.responses import why_islr

POINTS = ("M1", "M3", "M5")  # the paper's points 1 to 3, in our scene
GRID = Grid(10_960.0, 11_670.0, 0.25, -1050.0, 1050.0, 0.25)
METHODS: dict[str, dict[str, Any]] = {
    "keystone-resampling": {"perturbation": "all"},
    "frequency perturbation, closed-form": {"perturbation": "frequency", "coefficients": "closed-form"},
    "frequency perturbation, fitted": {"perturbation": "frequency"},
}
WHY = (
    "The frequency perturbation is not FDPF, which the paper only names: it blurs points by other amounts. The tables "
    "show that it blurs points at the edges, and that resampling hardly does."
)


def paper_b_table(bench: Bench) -> Exhibit:
    """Three points of paper B's scene: resampled, and with a frequency perturbation only."""
    parts = {}
    for title, options in METHODS.items():
        run = bench.run("paper_b", blocks=1, grid=GRID, processor="keystone-resampling", **options)
        measured = list(run.measured("paper_b", POINTS).values())
        parts[title] = _rows(measured, PAPER_B[options["perturbation"]])
    rows = [row for part in parts.values() for row in part]
    # The peak is searched around the known position.
    above_peak = any(row.ours > 0 for row in rows if row.what.endswith("PSLR"))
    smeared = ["PSLR above 0 dB: the point is smeared, and a lobe beside its position is the strongest."] * above_peak
    return Exhibit(
        title="Table 2 of paper B: azimuth figures of three points",
        text="Points 1 to 3 stand at −1000, 0 and +1000 m of azimuth at middle range. This is the size of the paper's "
        "scene; its figure with the positions was not available. The first table is the paper's method with fitted "
        "coefficients. The other two take the place of its FDPF column, a method that it only names: a frequency "
        "perturbation instead of perturbation in time and resampling, with coefficients expanded about the centre of "
        "the scene, and with coefficients fitted to the whole scene.",
        rows=rows,
        tables=[crossed(part, title) for title, part in parts.items()],
        notes=[
            *smeared,
            "MW: the unit of the printed widths is not stated, so they cannot be compared with metres. For the paper's "
            "method they are almost equal, like widths in Doppler of points that are lit for the same time. We compare "
            "the width over the limit of each point's own dwell, relative to point 2.",
        ],
    )


def _rows(measured: Sequence[PointResponse], printed: Mapping[str, Sequence[float]]) -> list[Row]:
    islr = why_islr(PAPER_B["all"]["ISLR"][1], "the paper prints for point 2")
    rows, over_limit = [], [response.azimuth_irw / response.azimuth_irw_theory for response in measured]
    papers_method = printed is PAPER_B["all"]
    for i, (response, width) in enumerate(zip(measured, printed["MW"], strict=True)):
        name, ratio, theirs = f"point {i + 1}", over_limit[i] / over_limit[1], width / printed["MW"][1]
        rows += [
            Row(f"{name}: PSLR", response.azimuth_pslr, "dB", printed["PSLR"][i], 0.5, WHY),
            Row(f"{name}: ISLR", response.azimuth_islr, "dB", printed["ISLR"][i], 0.5, islr if papers_method else WHY),
            Row(f"{name}: IRW", response.azimuth_irw, "m", f"MW {width:.2f}", digits=3),
            Row(f"{name}: IRW over limit, point 2 = 1", ratio, "", theirs, 0.02, WHY, digits=3),
        ]
    return rows
