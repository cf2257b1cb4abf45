"""The ranges of a block's rows: dense enough for the band, and for what the steps in azimuth turn from row to row.

A phase of azimuth that changes with range, psi(r, t) in cycles, multiplies a target's response along range by
exp(2j pi (r - r0) d psi / dr): its range frequencies move by c / 2 d psi / dr. The Doppler rate that the deramp removes
is proportional to 1 / R: where the line of sight has turned by theta from the middle of the dwell, that is
|d psi / dr| = (1 - cos theta) 2 / lambda. At 9.6 GHz and 4 degrees they move by half of a band of 50 MHz.
"""

from __future__ import annotations

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.weighting import Taper
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.focusing.lines import Focus
from blocksar.kernels import fourier
from blocksar.kernels.fourier import Axis, centred
from blocksar.kernels.interpolation import taps_needed

# Oversampling of a focused block: twelve taps in range and eight in Doppler then err by less than IMAGE_TAP_ERROR.
RANGE_ROOM = 1.42
MOST_PERIODS = 3  # rows: a narrow range window, and as much on either side, into which the interpolation reaches
LEAST_SPREAD = 0.08  # of the band: turns that move range frequencies by less need no room of their own


def plan_rows(spots: Focus, range_frequency: Axis, turns: FloatArray, tap_error: float) -> tuple[Axis, float]:
    """Ranges, less the origin, at which targets focus, with room for interpolation; and how much of them is filled.

    Parameters
    ----------
    spots : Focus
    range_frequency : Axis
    turns : (n_range, n_yaw, n) float
        From `AzimuthPart.turns`, cycles/m.
    tap_error : float
        Of the interpolation along range.

    Returns
    -------
    tuple of (Axis, float)
        The second is the fraction of the sampling rate that responses fill.
    """
    band = range_frequency.step * range_frequency.size
    moved = SPEED_OF_LIGHT * float(np.abs(turns).max()) / band
    filled = range_frequency.size * (1 + moved if moved > LEAST_SPREAD else 1)
    period = fourier.fast_length(RANGE_ROOM * filled)
    occupancy, step = filled / period, SPEED_OF_LIGHT / (2 * range_frequency.step * period)
    reach = (taps_needed(occupancy, error=tap_error) / 2 + 2) * step
    nearest, farthest = float(spots.range.min()) - reach, float(spots.range.max()) + reach
    size = int(np.ceil((farthest - nearest) / step)) + 1
    if size <= MOST_PERIODS * period:
        return Axis(nearest, step, size), occupancy
    return centred((nearest + farthest) / 2, step, MOST_PERIODS * period), occupancy


def range_scale(collection: Collection, range_frequency: Axis, period: int, taper: Taper) -> float:
    """Sum of the weights over the band, in steps of `range_frequency`, over the length of the range transform."""
    weights = taper.samples(collection.n_range_frequency)
    # Those of a sub-block reach beyond the band; those of a whole block are the band's, without a rounding error.
    n_band = round(collection.range_frequency_step * collection.n_range_frequency / range_frequency.step, 9)
    return float(n_band / period * weights.mean())
