"""The bar: how far a point response may be from the ideal one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from blocksar.budget import SIDE_LOBE_BUDGET
from blocksar.constants import SINC_PSLR
from blocksar.measurement.figures import PointResponse

# ---------------------------------------------------------------- what a target has to meet


class Bar(NamedTuple):
    """How far a figure may be from the ideal one: by `limit`, as a person reads it `said`."""

    name: str
    limit: float
    said: str
    deviation: Callable[[PointResponse], float]


BARS = {
    "range_pslr": Bar("range PSLR", SIDE_LOBE_BUDGET, f"{SIDE_LOBE_BUDGET:g} dB", lambda r: r.range_pslr - SINC_PSLR),
    "range_irw": Bar("range width", 0.01, "1 %", lambda r: r.range_irw / r.range_irw_theory - 1),
    "azimuth_pslr": Bar(
        "azimuth PSLR", SIDE_LOBE_BUDGET, f"{SIDE_LOBE_BUDGET:g} dB", lambda r: r.azimuth_pslr - SINC_PSLR
    ),
    "azimuth_irw": Bar("azimuth width", 0.01, "1 %", lambda r: r.azimuth_irw / r.azimuth_irw_theory - 1),
    "error_x": Bar("position in x", 0.05, "50 mm", lambda r: r.error_x),
    "error_y": Bar("position in y", 0.05, "50 mm", lambda r: r.error_y),
    "amplitude": Bar("amplitude", 0.02, "2 %", lambda r: abs(r.value) - 1),
    "phase": Bar("phase", 0.05, "0.05 rad", lambda r: float(np.angle(r.value))),
}


def excess(response: PointResponse, figure: str) -> float:
    """A figure's deviation over what it may be; infinite where it could not be measured."""
    bar = BARS[figure]
    return float(np.nan_to_num(abs(bar.deviation(response)) / bar.limit, nan=np.inf))


def worst_excess(response: PointResponse) -> float:
    """Of all figures: at most 1 is within the bar."""
    return max(excess(response, figure) for figure in BARS)


def judged(responses: Sequence[PointResponse]) -> list[PointResponse]:
    """Those that the bar is for: lit over their full dwell, and covered."""
    return [r for r in responses if r.full_dwell and r.covered]


def rank(response: PointResponse) -> tuple[bool, float]:
    """The judged targets first, the worst of them before others."""
    return not (response.full_dwell and response.covered), -worst_excess(response)
