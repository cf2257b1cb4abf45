"""Numbers that the papers print."""

from __future__ import annotations

from blocksar.collection.grid import Grid
from blocksar.measurement.table3 import TABLE3, PaperResponse

NAMES = ("A1", "A2", "A3", "B1", "B2", "B3", "C1", "C2", "C3")
SWATH = {"near": 27_600.0, "middle": 30_000.0, "far": 32_400.0}  # m: paper A's swath, less the width of a response
QUARTER = 0.25  # of pi: the phase error that is usually allowed

# ---------------------------------------------------------------- what the papers print

# Paper A, Table 2: the reference method. Its range columns are those of Table 3, which `measurement` holds.
TABLE2_AZIMUTH = {
    "A1": (-5.74, -7.02, 2.18), "A2": (-13.10, -10.52, 1.85), "A3": (-8.48, -6.59, 2.01),
    "B1": (-7.65, -5.89, 2.01), "B2": (-13.24, -10.70, 1.89), "B3": (-8.43, -6.34, 1.97),
    "C1": (-7.37, -5.73, 2.06), "C2": (-13.21, -10.65, 1.85), "C3": (-7.04, -5.28, 2.10),
}  # fmt: skip
TABLE2 = {name: PaperResponse(*TABLE3[name][:3], *azimuth) for name, azimuth in TABLE2_AZIMUTH.items()}

# Paper A, Table 1: the steering interval of 42.13 to 57.87 degrees, divided evenly in three (section 3.1).
SEAMS = (42.13 + 15.74 / 3, 42.13 + 15.74 * 2 / 3)

# Paper A, section 4.2: positions in Figure 13 d, ground range first. It prints C1 twice: the fourth position is A3's.
PIXEL = 2.0  # m
MIDDLE = 1276  # the pixel of B2, the scene's centre
MOSAIC_PIXELS = {"A1": (26, 26), "C1": (2526, 26), "B2": (1276, 1276), "A3": (26, 2526), "C3": (2526, 2526)}
# And in Figure 13 a-c, which begin at columns 0, 850 and 1700 of 13 d: so much follows from A2, A3 and B2.
BLOCK_PIXELS = {
    "A1": (26, 26), "C1": (2526, 26), "A2": (26, 426), "C2": (2526, 426), "A3": (26, 826), "C3": (2526, 826),
}  # fmt: skip
BLOCK_COLUMNS = {"1": 0, "2": 850, "3": 1700}  # by the targets' digit

# Paper B, Table 2: points 1 to 3, by our name for the method. The unit of "MW" is not stated.
PAPER_B = {
    "frequency": {"PSLR": (-3.98, -13.26, -4.78), "ISLR": (-7.11, -9.83, -6.78), "MW": (20.67, 15.60, 28.35)},
    "all": {"PSLR": (-12.68, -13.27, -13.39), "ISLR": (-9.37, -9.81, -10.28), "MW": (15.62, 15.61, 15.62)},
}

POINTS_B = ("M1", "M3", "M5")  # paper B's points 1 to 3, in our scene
GRID_B = Grid(10_960.0, 11_670.0, 0.25, -1050.0, 1050.0, 0.25)
