"""Numbers and names that the papers print, each with the place where they print it.

Paper A is the angular-division paper, paper B the keystone-resampling paper. Paper A's Table 3 is in
`blocksar.measurement.figures`, as the package uses it too.
"""

from __future__ import annotations

from blocksar.measurement.figures import TABLE3, PaperResponse

# Paper A, Tables 2 and 3, first column: the targets that are measured.
NAMES = ("A1", "A2", "A3", "B1", "B2", "B3", "C1", "C2", "C3")

# Paper A, Table 2 (reference method): azimuth PSLR (dB), ISLR (dB) and IRW (m). Its range columns are those of Table 3.
TABLE2_AZIMUTH = {
    "A1": (-5.74, -7.02, 2.18), "A2": (-13.10, -10.52, 1.85), "A3": (-8.48, -6.59, 2.01),
    "B1": (-7.65, -5.89, 2.01), "B2": (-13.24, -10.70, 1.89), "B3": (-8.43, -6.34, 1.97),
    "C1": (-7.37, -5.73, 2.06), "C2": (-13.21, -10.65, 1.85), "C3": (-7.04, -5.28, 2.10),
}  # fmt: skip
TABLE2 = {name: PaperResponse(*TABLE3[name][:3], *azimuth) for name, azimuth in TABLE2_AZIMUTH.items()}

# Paper A, Table 1: the steering interval of 42.13 to 57.87 degrees; section 3.1: divided evenly in three.
SEAMS = (42.13 + 15.74 / 3, 42.13 + 15.74 * 2 / 3)

# Paper A, section 4.2: pixel size (m), and positions of targets in Figure 13 (d) in pixels, ground range first. C1 is
# printed twice; the fourth position is that of A3.
PIXEL = 2.0
MIDDLE = 1276  # of both axes: B2, the centre of the scene
MOSAIC_PIXELS = {"A1": (26, 26), "C1": (2526, 26), "B2": (1276, 1276), "A3": (26, 2526), "C3": (2526, 2526)}

# Paper A, section 4.2: positions in Figure 13 (a) to (c), by block, in pixels of the block's picture.
BLOCK_PIXELS = {
    "A1": (26, 26), "C1": (2526, 26), "A2": (26, 426), "C2": (2526, 426), "A3": (26, 826), "C3": (2526, 826),
}  # fmt: skip
# First columns of these pictures in (d), by the digit of their targets. They follow from the printed A2, A3 and B2.
BLOCK_COLUMNS = {"1": 0, "2": 850, "3": 1700}

# Paper B, Table 2: points 1 to 3 by method: its own ("all") and FDPF ("frequency"), by our names of the perturbation.
# PSLR and ISLR in dB; the unit of "MW" is not stated.
PAPER_B = {
    "frequency": {"PSLR": (-3.98, -13.26, -4.78), "ISLR": (-7.11, -9.83, -6.78), "MW": (20.67, 15.60, 28.35)},
    "all": {"PSLR": (-12.68, -13.27, -13.39), "ISLR": (-9.37, -9.81, -10.28), "MW": (15.62, 15.61, 15.62)},
}
