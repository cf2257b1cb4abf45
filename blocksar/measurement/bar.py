"""The quality limits of a point response: how far each figure may deviate from the ideal one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from blocksar.budget import SIDE_LOBE_BUDGET, WEIGHTED_SIDE_LOBE_BUDGET
from blocksar.constants import SINC_PSLR
from blocksar.measurement.figures import PointResponse


class Bar(NamedTuple):
    """How far a figure may deviate from the ideal one."""

    name: str
    limit: float  # of |deviation|
    text: str  # the limit with its unit, for people
    deviation: Callable[[PointResponse], float]


LOW = SINC_PSLR - 1.0  # dB: below lie those of all weights, and of a band of a third or more
LOBES = f"{SIDE_LOBE_BUDGET:g} dB"
BARS = {
    "range_pslr": Bar("range PSLR", SIDE_LOBE_BUDGET, LOBES, lambda r: r.range_pslr - r.range_pslr_theory),
    "range_irw": Bar("range width", 0.01, "1 %", lambda r: r.range_irw / r.range_irw_theory - 1),
    "azimuth_pslr": Bar("azimuth PSLR", SIDE_LOBE_BUDGET, LOBES, lambda r: r.azimuth_pslr - r.azimuth_pslr_theory),
    "azimuth_irw": Bar("azimuth width", 0.01, "1 %", lambda r: r.azimuth_irw / r.azimuth_irw_theory - 1),
    "error_x": Bar("position in x", 0.05, "50 mm", lambda r: r.error_x),
    "error_y": Bar("position in y", 0.05, "50 mm", lambda r: r.error_y),
    "amplitude": Bar("amplitude", 0.02, "2 %", lambda r: abs(r.value) - 1),
    "phase": Bar("phase", 0.05, "0.05 rad", lambda r: float(np.angle(r.value))),
}


def limit(response: PointResponse, figure: str) -> tuple[float, str]:
    """How far a figure may deviate, and in words; further for the lower side lobes that weights make."""
    bar = BARS[figure]
    if figure.endswith("pslr") and getattr(response, f"{figure}_theory") < LOW:
        return WEIGHTED_SIDE_LOBE_BUDGET, f"{WEIGHTED_SIDE_LOBE_BUDGET:g} dB"
    return bar.limit, bar.text


def excess(response: PointResponse, figure: str) -> float:
    """A figure's deviation divided by its limit; infinite where it could not be measured."""
    deviation = BARS[figure].deviation(response)
    return float(np.nan_to_num(abs(deviation) / limit(response, figure)[0], nan=np.inf))


def worst_excess(response: PointResponse) -> float:
    """The largest excess of all figures; a response within the limits has at most 1."""
    return max(excess(response, figure) for figure in BARS)


def is_judged(response: PointResponse) -> bool:
    """Whether the limits apply to a target: it is lit over its full dwell, and covered."""
    return response.full_dwell and response.covered


def select_judged(responses: Sequence[PointResponse]) -> list[PointResponse]:
    """The responses to which the limits apply."""
    return [r for r in responses if is_judged(r)]


def rank(response: PointResponse) -> tuple[bool, float]:
    """Sort key: judged targets first, and the worst of them before the others."""
    return not is_judged(response), -worst_excess(response)
