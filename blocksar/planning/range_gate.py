"""Planning of the range gate of a sub-block."""

from __future__ import annotations

import math

import numpy as np
from numpy.polynomial import chebyshev

from blocksar.constants import SPEED_OF_LIGHT
from blocksar.focusing.lines import Line
from blocksar.focusing.range_gate import RangeGate
from blocksar.kernels import fourier
from blocksar.kernels.fourier import Axis
from blocksar.planning.target_lines import middle_line

RANGE_GUARD = 48  # range cells on either side of a sub-block, for side lobes of targets at its ends
BAND_ROOM = 0.08  # of the band, on either side of it, over which a sub-block's range frequencies fall to zero


def plan_range_gate(full: Axis, slab: Axis, line: Line, carrier: float) -> RangeGate:
    """The gate that holds the ranges of lines (n_range, n_yaw) at each Doppler, with room for side lobes."""
    u = (2 * line.doppler - slab.start - (slab.start + slab.extent)) / slab.extent
    centre = middle_line(u.ravel(), line.range.ravel(), order=6)
    spread = line.range - chebyshev.chebval(u, centre)
    # In a Doppler bin the ends of the band belong to other times than the carrier: a smear that SRC removes later.
    edge = max(abs(full.start), abs(full.start + full.extent)) / carrier
    rate = np.maximum(np.abs(line.rate), 1e-3 * np.abs(line.rate).max())
    smear = SPEED_OF_LIGHT / (2 * carrier) * line.doppler**2 / rate * edge
    cell = SPEED_OF_LIGHT / (2 * full.extent)
    low = float((spread - np.abs(smear)).min()) - RANGE_GUARD * cell
    high = float((spread + np.abs(smear)).max()) + RANGE_GUARD * cell
    period = fourier.fast_length((1 + 2 * BAND_ROOM) * full.size)
    step = 1 / (period * full.step)
    size = min(fourier.fast_length((high - low) * 2 / SPEED_OF_LIGHT / step), period)
    middle = round((low + high) / SPEED_OF_LIGHT / step)
    coarse = 1 / (size * step)
    n_frequency = min(math.floor((1 + 2 * BAND_ROOM) * full.extent / coarse), size)
    band_middle = full.start + (full.size - 1) / 2 * full.step
    frequency = Axis(band_middle - (n_frequency - 1) / 2 * coarse, coarse, n_frequency)
    beyond = np.clip(np.abs(frequency.values - band_middle) / full.extent - 0.5, 0, BAND_ROOM) / BAND_ROOM
    ramp = np.clip((np.minimum(np.arange(size), np.arange(size)[::-1]) + 0.5) / (RANGE_GUARD / 2), 0, 1)
    normalised = np.clip((2 * slab.values - 2 * slab.start - slab.extent) / slab.extent, u.min(), u.max())
    return RangeGate(
        slab=slab,
        centre=np.rint(chebyshev.chebval(normalised, centre) * 2 / SPEED_OF_LIGHT / step).astype(np.intp),
        gate=Axis(step * (middle - size // 2), step, size),
        window=np.sin(np.pi / 2 * ramp) ** 2,
        full=full,
        range_frequency=frequency,
        taper=np.cos(np.pi / 2 * beyond) ** 2,
    )
