"""The point responses printed in Table 3 of paper A (angular division)."""

from __future__ import annotations

from typing import NamedTuple


class PaperResponse(NamedTuple):
    """One row of the paper's Table 3: PSLR and ISLR in dB, IRW in m (of slant range in range)."""

    range_pslr: float
    range_islr: float
    range_irw: float
    azimuth_pslr: float
    azimuth_islr: float
    azimuth_irw: float


# The rows of the paper's proposed method. The paper does not state its definition of the ISLR.
TABLE3: dict[str, PaperResponse] = {
    "A1": PaperResponse(-13.26, -10.97, 2.68, -12.81, -10.30, 1.85),
    "A2": PaperResponse(-13.23, -10.98, 2.68, -13.10, -10.52, 1.85),
    "A3": PaperResponse(-13.21, -10.92, 2.68, -13.30, -10.79, 1.89),
    "B1": PaperResponse(-13.23, -10.98, 2.68, -13.25, -10.77, 1.89),
    "B2": PaperResponse(-13.14, -10.89, 2.67, -13.24, -10.70, 1.89),
    "B3": PaperResponse(-13.24, -10.97, 2.68, -13.14, -10.59, 1.89),
    "C1": PaperResponse(-13.19, -10.95, 2.68, -13.14, -10.64, 1.85),
    "C2": PaperResponse(-13.18, -10.97, 2.68, -13.21, -10.65, 1.85),
    "C3": PaperResponse(-13.25, -10.96, 2.68, -12.92, -10.41, 1.85),
}
