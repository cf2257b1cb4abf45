"""Power of side lobes that bright places lay over an image; coherence there does not describe the ground."""

from __future__ import annotations

import numpy as np
from scipy.signal import oaconvolve

from blocksar.arrays import FloatArray
from blocksar.collection.weighting import DwellShape, Taper
from blocksar.measurement.axes import ResponseAxes

REACH = 400  # pixels over which side lobes are followed: at 300 cells those of equal weights lie 60 dB below the peak
STEPS = 32  # of the table of the envelope, per cycle over the band
FALLING = 2.0  # cycles: beyond those of the table the envelope falls as those of equal weights, 1 / u^2


def side_lobe_power(
    power: FloatArray, axes: ResponseAxes, spacing: tuple[float, float], reach: int = REACH
) -> FloatArray:
    """Upper bound of the power (n_y, n_x) that the side lobes of other places make at each pixel, beyond the usual.

    A place of power p has side lobes of at most p e(u) e(v) at u and v cycles over band and dwell along its axes, with
    the envelope e(u) = max over w >= u of |W(w)|^2 of the response W. A pixel stands for the share dx dy / A of a place
    (A: `ResponseAxes.area`), since the squared response of one integrates to A. So

        sum over pixels of p dx dy / A e(u) e(v), without those within the main lobe,  less  k p

    bounds what side lobes add; k p, with the same sum k over p = 1, is what they add to ground of even brightness,
    which decorrelates no more than that ground. Not negative only after a mean over a window, which is for the caller.

    Parameters
    ----------
    power : (n_y, n_x) float
        |image|^2, NaN where not covered.
    axes : ResponseAxes
        Of a target in the middle.
    spacing : (float, float)
        Distance of pixels in x and y, m.
    reach : int
        Pixels over which side lobes are followed.

    References
    ----------
    Sum of the power of independent places, as in the definition of the integrated side lobe ratio.
    """
    known = np.nan_to_num(power, nan=0.0)
    rows, columns = (min(reach, n - 1) for n in known.shape)
    dx, dy = np.arange(-columns, columns + 1) * spacing[0], np.arange(-rows, rows + 1) * spacing[1]
    along_range, along_azimuth = axes.own_offset(dx[None, :], dy[:, None])
    kernel, main = np.ones(along_range.shape), np.ones(along_range.shape, bool)
    for offset, width, taper in (
        (along_range, axes.range_width, axes.weighting.range),
        (along_azimuth, axes.azimuth_width, axes.azimuth_shape),
    ):
        cycles = np.abs(offset) * (taper.ideal.width / width)
        envelope, null = _envelope(taper, cycles)
        kernel *= envelope
        main &= cycles < null
    kernel[main] = 0.0
    kernel *= abs(spacing[0] * spacing[1]) / axes.area
    return np.asarray(oaconvolve(known, kernel, mode="same")) - kernel.sum() * known


def _envelope(taper: Taper | DwellShape, cycles: FloatArray) -> tuple[FloatArray, float]:
    """e at cycles over the band (...), and the cycles of the first minimum of the response."""
    most = float(np.ceil(max(taper.ideal.width * 2, FALLING))) + 14.0
    u = np.arange(int(most * STEPS) + 1) / STEPS
    squared = np.asarray(taper.response(u)) ** 2
    null = float(u[np.flatnonzero(np.diff(squared) > 0)[0]]) if (np.diff(squared) > 0).any() else float(u[-1])
    running = np.maximum.accumulate(squared[::-1])[::-1]
    end = most - FALLING  # the running maximum lacks side lobes beyond the table
    last = float(np.interp(end, u, running))
    inside = np.interp(cycles, u, running)
    return np.where(cycles > end, last * (end / np.maximum(cycles, end)) ** 2, inside), null
