"""Whether the samples follow the declared sign SGN, from where their energy lies.

With the wrong sign an echo of the delay dTOA appears at -dTOA. Echoes lie in TOA1 .. TOA2; where that interval is not
centred at the SRP, a part of it is outside of its mirror image, and only one sign puts energy there. A scene about the
SRP is mirrored through its centre and says nothing, nor does the domain TOA, whose delays do not depend on the sign.
"""

from __future__ import annotations

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.kernels.fourier import fft_rows

MOST_ROWS = 64  # pulses that are looked at
LEAST_CELLS = 0.02  # of the delays, that only one sign has
LEAST_ENERGY = 0.05  # of all, that lies there or in its mirror image
RATIO = 4.0  # of the energies of both signs there: 6 dB
# Makers whose files were reported to declare +1 with samples that follow -1.
DOUBTED = ("capella",)


class SignTest:
    """Sums of the energy that one sign only puts inside of TOA1 .. TOA2, of that sign and of the other."""

    def __init__(self) -> None:
        self.inside = self.mirrored = self.total = 0.0

    def add(self, rows: ComplexArray, *, step: float, middle: FloatArray, early: FloatArray, late: FloatArray) -> None:
        """Add pulses.

        Parameters
        ----------
        rows : (n, n_frequency) complex64
            Signal of a phase history, exp(-2j pi f (dTOA - middle)).
        step : float
            Of its frequencies, Hz.
        middle, early, late : (n,) float
            s: the delay of the reference range, TOA1 and TOA2.
        """
        n = rows.shape[1]
        spectra = np.where(np.isfinite(rows), rows, 0).astype(np.complex128) * np.hanning(n + 2)[1:-1]
        power = np.abs(fft_rows(spectra, inverse=True)) ** 2
        delay = np.arange(n) / (n * step) + middle[:, None]
        here, there = (np.mod(delay - first[:, None], 1 / step) <= (late - early)[:, None] for first in (early, -late))
        only = (here & ~there).mean(axis=1) >= LEAST_CELLS
        self.inside += float(power[here & ~there & only[:, None]].sum())
        self.mirrored += float(power[there & ~here & only[:, None]].sum())
        self.total += float(power.sum())

    def describe(self, sign: int, collector: str, *, given: bool) -> str | None:
        """A sentence if the samples contradict `sign`, or it is declared by a maker who was wrong; else None.

        Parameters
        ----------
        sign : int
            As taken: `given` by the user, or declared by the file.
        """
        both = self.inside + self.mirrored
        if both > LEAST_ENERGY * self.total:
            if self.mirrored > RATIO * self.inside:
                return (
                    f"SGN {sign:+d} contradicts the samples: of the energy that only one sign puts inside of TOA1 .. "
                    f"TOA2, {self.mirrored / both:.0%} is where SGN {-sign:+d} has it; ingest again with --sgn "
                    f"{-sign:+d}"
                )
            if self.inside > RATIO * self.mirrored:
                return None
        if not given and sign > 0 and any(maker in collector.lower() for maker in DOUBTED):
            return (
                f"SGN +1 is doubtful: files of {collector} were seen to declare it with samples that follow -1, which "
                "mirrors the scene through its centre; compare places, and ingest again with --sgn -1 if so"
            )
        return None
