"""The sign of the phase from where the energy lies.

A source states the window of delays that its samples hold, or the grid has the ground that they show. The conjugate of
a signal lies in the mirror image of that window about the reference range. A spotlight about a fixed point may be as
sharp there, so that its energy tells what its sharpness does not.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blocksar.arrays import ComplexArray, FloatArray
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.kernels.fourier import fft_rows

GROUP = 256  # pulses that are transformed at a time
GUARD = 8  # bins about the ends of the window that are left out: a Hann weighting leaks 1e-6 of a target beyond
LEAK = 1e-4  # of all energy: with less in either part, they hold what leaks from between them
CLEAR = 3.0  # dB
SIGNIFICANT = 5.0  # standard deviations; by chance once in 3 million


class WindowEnergy(NamedTuple):
    """Where the energy of a signal lies, against the window that is stated for it.

    Attributes
    ----------
    inside, mirrored : float
        Share of the energy inside the window as given, and with the signal conjugated.
    gain : float
        Power per bin where only the window is, over that where only its mirror image is, dB; 0 where nothing lies in
        either, as with a window that is its own mirror image.
    deviation : float
        Standard deviation of `gain` if both hold speckle of the same power, dB.
    """

    inside: float
    mirrored: float
    gain: float
    deviation: float

    @property
    def conjugated(self) -> bool | None:
        """Whether the signal is conjugated; None if its energy does not tell."""
        if abs(self.gain) < max(CLEAR, SIGNIFICANT * self.deviation):
            return None
        return self.gain < 0


def energy_in_window(
    signal: ComplexArray, *, frequency_step: float, near: FloatArray | float, far: FloatArray | float
) -> WindowEnergy:
    """Compare the energy inside a window of range with that inside its mirror image about the reference range.

    Under either sign the part of the range axis that only the true window covers holds echoes and noise, and the part
    that only the mirror image covers holds noise. Speckle whose power is averaged over m independent bins deviates by
    10 / ln 10 / sqrt(m) dB; range profiles of a spotlight hardly change from pulse to pulse, so only the bins of one
    pulse count as independent.

    Parameters
    ----------
    signal : (n_pulse, n_frequency) complex64
        With the phase -4 pi (fc + f) / c (R - reference_range); NaN where missing. Not changed.
    frequency_step : float
        Hz. Ranges are told apart up to c / (4 frequency_step) on either side of the reference; those beyond fold back.
    near, far : float or (n_pulse,) float
        Ends of the window, R - reference_range, m: c / 2 times TOA1 and TOA2 of a CPHD file.

    Returns
    -------
    WindowEnergy

    Raises
    ------
    ValueError
        If the window is empty.
    """
    n_pulse, n = signal.shape
    ends = [np.broadcast_to(np.asarray(end, np.float64), (n_pulse,))[:, None] for end in (near, far)]
    if not (ends[0] < ends[1]).all():
        raise ValueError(f"need near < far, got {near=} {far=}")
    spacing = SPEED_OF_LIGHT / (2 * n * frequency_step)
    offset = spacing * ((np.arange(n) + n // 2) % n - n // 2)  # of the bins, as the transform has them
    span, guard = n * spacing, GUARD * spacing
    hann = (1 + np.cos(2 * np.pi * (np.arange(n) - (n - 1) / 2) / n)).astype(np.float32)
    energy, bins = np.zeros(5), np.zeros(5)  # all, inside, mirrored, only inside, only mirrored
    for first in range(0, n_pulse, GROUP):
        rows = slice(first, first + GROUP)
        low, high = ends[0][rows], ends[1][rows]
        profile = fft_rows(np.nan_to_num(signal[rows]) * hann, inverse=True)
        power = np.abs(profile).astype(np.float64) ** 2
        inside, mirrored = (np.mod(each - low, span) <= high - low for each in (offset, -offset))
        around, around_mirrored = (
            np.mod(each - low + guard, span) <= high - low + 2 * guard for each in (offset, -offset)
        )
        for k, part in enumerate((None, inside, mirrored, inside & ~around_mirrored, mirrored & ~around)):
            energy[k] += power.sum() if part is None else power[part].sum()
            bins[k] += power.size if part is None else part.sum()
    shares = energy / max(energy[0], 1e-300)
    gain, independent = 0.0, bins[3:].min() / n_pulse
    if independent >= 1 and shares[3:].max() > LEAK:
        gain = float(10 * np.log10(max(energy[3] / bins[3], 1e-300) / max(energy[4] / bins[4], 1e-300)))
    # Neighbouring bins of a Hann-weighted profile are not independent: two in three are.
    deviation = 10 / np.log(10) * np.sqrt(2 * 1.5 / max(independent, 1.0))
    return WindowEnergy(float(shares[1]), float(shares[2]), gain, float(deviation))
