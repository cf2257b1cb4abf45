"""Sampling of a block along its chain: axes dense and long enough for its targets' lines.

The rows of a block are dense enough for the band, and for the change of azimuth phases from row to row.

A phase of azimuth that changes with range, psi(r, t) in cycles, multiplies a target's response along range by
exp(2j pi (r - r0) d psi / dr): its range frequencies move by c / 2 d psi / dr. The Doppler rate that the deramp removes
is proportional to 1 / R: where the line of sight has turned by theta from the middle of the dwell, that is
|d psi / dr| = (1 - cos theta) 2 / lambda. At 9.6 GHz and 4 degrees they move by half of a band of 50 MHz.
"""

from __future__ import annotations

import math

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.budget import IMAGE_TAP_ERROR
from blocksar.collection.beam import aperture
from blocksar.collection.collection import Collection
from blocksar.collection.weighting import Taper
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.kernels import fourier
from blocksar.kernels.fourier import Axis
from blocksar.kernels.interpolation import taps_needed
from blocksar.processors.chain.dwells.dwell_ends import GUARD, smear_room
from blocksar.processors.chain.dwells.dwell_weights import beam_moves
from blocksar.processors.chain.dwells.target_lines import Sector
from blocksar.processors.chain.planning.binding import AzimuthPart, Slab
from blocksar.processors.chain.planning.block_lines import TracedTargets
from blocksar.processors.chain.steps.lines import Focus, Line, focus
from blocksar.processors.chain.steps.recovery import Recovery
from blocksar.processors.chain.steps.step import Sampling

# Oversampling of a focused block: twelve taps in range and eight in Doppler then err by less than IMAGE_TAP_ERROR.
RANGE_ROOM = 1.42
LEAST_SPREAD = 0.08  # of the band: turns that move range frequencies by less need no room of their own


def plan_rows(spots: Focus, range_frequency: Axis, turns: FloatArray, tap_error: float) -> tuple[Axis, float]:
    """Ranges of output rows, relative to the origin, with room for interpolation; and the filled share of the band.

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
    return Axis(nearest, step, int(np.ceil((farthest - nearest) / step)) + 1), occupancy


def range_scale(collection: Collection, range_frequency: Axis, period: int, taper: Taper) -> float:
    """Sum of the weights over the band, in steps of `range_frequency`, divided by the length of the range transform."""
    weights = taper.samples(collection.n_range_frequency)
    # The frequencies of a sub-block reach beyond the band; those of a whole block are the band's, up to rounding.
    n_band = round(collection.range_frequency_step * collection.n_range_frequency / range_frequency.step, 9)
    return float(n_band / period * weights.mean())


TIME_GUARD = 0.1  # dwells kept on either side of the time in which a block's targets are lit
LEAST_ROOM = 1.4  # dwells that slow time has room for, so that the windows of the gate can fade out
SLOW_ROOM = 1.25  # oversampling of slow time
IMAGE_ROOM = 1.05  # of the image along Doppler, for the taps of the targets at its ends
ROOM = 1.35  # oversampling of Doppler by padding in time: dense enough to interpolate, for delayed echoes long enough


def plan_slab(collection: Collection, spectrum: Axis, line: Line, *, margin: float) -> Slab:
    """Doppler bins that hold lines at all range frequencies, with a margin (Hz) on either side."""
    band_edge = float(np.abs(collection.range_frequency).max() / collection.carrier)
    band = np.outer([1 - band_edge, 1 + band_edge], [line.doppler.min(), line.doppler.max()])
    first_bin = max(int(np.floor(spectrum.position(np.array(band.min() - margin)))), 0)
    last_bin = min(int(np.ceil(spectrum.position(np.array(band.max() + margin)))) + 1, spectrum.size)
    walk = float((line.doppler.min() + line.doppler.max()) / 2)
    return Slab(first_bin, spectrum.part(first_bin, last_bin - first_bin), walk, margin, band_edge)


def plan_sampling(
    sector: Sector,
    slab: Slab,
    azimuth: AzimuthPart,
    straight: Line,
    lines: TracedTargets,
    *,
    range_frequency: Axis,
    duration: float,
) -> Sampling:
    """Plan the axes that hold a block's lines, before any gate.

    Parameters
    ----------
    straight : Line
        Coarse lines after range compression.
    lines : TracedTargets
        What is asked of the time after the gate, and of the rows.
    range_frequency : Axis
        Of the block's samples.
    duration : float
        The longest dwell, s.
    """
    biased, before_deramp, focused = azimuth.trace(straight)
    spots = focus(focused)
    bands = _doppler_bands(slab, before_deramp)
    bandwidth = max(max(bands) - min(bands), IMAGE_ROOM * float(np.ptp(spots.doppler)) / SLOW_ROOM)
    time = _plan_time(sector.recovery, slab, straight, bandwidth=bandwidth, duration=duration)

    # Slow time before the final transform: the lines and their smear, with room for resampling and windows. Without a
    # gate, half of the room beyond is not summed: steps in Doppler delay echoes from beside a block into it, or around
    # the end of the axis, and the deramp would shift those to the block's Doppler.
    guard, gated = GUARD * duration, beam_moves(sector.geometry.collection)
    if not gated:  # all is summed, to the end of the smear
        guard += smear_room(focused, biased.rate) * (IMAGE_TAP_ERROR / sector.tap_error) ** (2 / 3)
    begin = min(float(focused.time.min()) - guard, time.start)
    end = max(float(focused.time.max()) + guard, time.start + time.extent)
    roomy = azimuth.range_part.freedom.resampling or not gated
    held = _held_time(lines, time)
    padded = (ROOM if roomy else 1.0) * time.size
    n_padded = fourier.fast_length(max((end - begin) / time.step, padded, held / time.step))
    beyond = 0.0 if gated else n_padded * time.step - (end - begin)
    long_time = Axis(begin - beyond / 2, time.step, n_padded)

    middle = azimuth.polynomials.middle
    reach = 2 * max(time.start + time.extent - middle, middle - time.start)
    rows, range_occupancy = plan_rows(spots, range_frequency, azimuth.turns(lines.compressed), sector.tap_error)
    return Sampling(
        slab=slab.doppler,
        range_frequency=range_frequency,
        time=time,
        time_occupancy=min(time.step * slab.doppler.extent, 0.95),
        doppler=fourier.dual(time, size=n_padded, centre=(min(bands) + max(bands)) / 2),
        long_time=long_time,
        doppler_occupancy=min(reach / (time.step * n_padded), 0.95),
        rows=rows,
        range_occupancy=range_occupancy,
        focused_doppler=fourier.dual(
            long_time, size=n_padded, centre=float((spots.doppler.min() + spots.doppler.max()) / 2)
        ),
        gate=None,
        summed=None if gated else (begin - beyond / 4, end + beyond / 4),
    )


def _doppler_bands(slab: Slab, before_deramp: list[Line]) -> list[float]:
    """Ends of the Doppler bands, Hz, that a block occupies before its deramp, from its lines after each step."""
    start = slab.doppler.start - slab.walk
    bands = [start, slab.doppler.start + slab.doppler.extent - slab.walk]
    for line in before_deramp:
        bands += [float(line.doppler.min()) - slab.margin, float(line.doppler.max()) + slab.margin]
    return bands


def _plan_time(recovery: Recovery, slab: Slab, straight: Line, *, bandwidth: float, duration: float) -> Axis:
    """Slow time over which a block's targets are lit, sampled for a band of `bandwidth` Hz."""
    span = recovery.time.extent
    full = fourier.fast_length(SLOW_ROOM * span * max(bandwidth, slab.doppler.extent))
    step = span / full
    # Ends of dwells ring beyond. The keystone moves them by up to band_edge times their time from the epoch.
    latest = float(np.abs(straight.time).max())
    room = TIME_GUARD * duration + latest * slab.band_edge
    first = max(math.floor((float(straight.time.min()) - room - recovery.time.start) / step), 0)
    last = min(math.ceil((float(straight.time.max()) + room - recovery.time.start) / step), full)
    # An odd number of cache lines per row, so that the columns of a block do not share cache sets.
    n_time = min(math.ceil((last - first - 8) / 16) * 16 + 8, full - first)
    return Axis(recovery.time.start + first * step, step, n_time)


def _held_time(lines: TracedTargets, time: Axis) -> float:
    """Time span that the dwell gate must hold, s.

    Under a beam about its axis cut dwells are a large part of an image. Gates stay open beyond the collection then:
    steps in Doppler wrap no noise from its other end to there.
    """
    (first, last), geometry = lines.uncut, lines.geometry
    held = LEAST_ROOM * float((last - first).max()) if geometry.collection.steered else 0.0
    if not geometry.beam.by_range:
        return held
    start, end = (moment - geometry.epoch for moment in aperture(geometry.collection))
    overhang = min(max(float((start - first).max()), float((last - end).max())), float((last - first).max()))
    return max(held, time.extent + overhang) if overhang > 0 else held
