"""Gaps of the collection: the displacement while pulses are missing, which the samples do not show.

The points determine the phase on either side of a gap. Their power shows how both sides fit, up to whole turns, since
no pulse saw the displacement in between. The turns are those of the smoothest motion, and so is the displacement in the
gap.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blocksar import solvers
from blocksar.arrays import BoolArray, FloatArray
from blocksar.autofocusing.chips import SHORT_GAP, Chips, mean_sight, missing_runs
from blocksar.autofocusing.fine_phase import strongest_rows
from blocksar.autofocusing.selection import Refused
from blocksar.kernels.fourier import fast_length, fft_rows

LONGEST = 0.22  # of the collection: over longer gaps, errors across the line of sight are poorly determined
DEGREE = 3  # of the polynomial through both sides of a gap
LEAST_SIDE = 16  # samples of either side, at least
TRIALS = 8  # phases within half a turn, with which both sides of a gap are put together
STEEPEST = 12  # slopes likewise, in steps of a Doppler cell
PADDING = 4.0  # Doppler cells for each sample, in which points are brightest
NEAR_CELLS = 8  # on either side of the brightest, in whole ones of the dwell
SLOPE = 8  # samples from which the slope at either end of a gap is taken


def long_gaps(chips: Chips) -> list[slice]:
    """Return the runs of missing samples that are too long to be filled and have samples on either side."""
    return [
        gap
        for gap in missing_runs(chips.seen)
        if gap.stop - gap.start > SHORT_GAP and gap.start >= SLOPE and gap.stop <= chips.time.size - SLOPE
    ]


def refuse_gaps(chips: Chips) -> None:
    """Refuse gaps that are too long.

    Raises
    ------
    Refused
        If one has more than LONGEST of the collection.
    """
    for gap in long_gaps(chips):
        if (share := (gap.stop - gap.start) / chips.time.size) > LONGEST:
            raise Refused(
                f"signal is NaN over {share:.0%} of the collection in a row, and the track's error cannot be followed "
                f"over a gap of more than {LONGEST:.0%}; give the part before it, or the part after it"
            )


def stitched(chips: Chips, displacement: FloatArray, weights: FloatArray) -> FloatArray:
    """Shift a displacement (n_sample, 3), m, along the line of sight after each gap so that points are brightest.

    Within half a turn of the phase. Entropy does not tell: a gap gives all points sidelobes, however both sides fit.
    """
    out = displacement
    for gap in long_gaps(chips):
        ahead, since = jump(chips.corrected(out), gap, weights), np.arange(chips.time.size) - gap.stop
        phase = np.where(since < 0, 0.0, ahead.phase + ahead.slope * since)
        out = out + (phase / chips.work.wavenumber)[:, None] * sight_across(chips, gap)
    return out


def straddling(chips: Chips, gap: slice) -> BoolArray:
    """Find which points (n_point,) are seen on either side of a gap."""
    valid, later = chips.told, chips.index >= gap.stop
    return np.asarray(np.minimum((valid & later).sum(axis=1), (valid & ~later).sum(axis=1)) >= SLOPE)


def sight_across(chips: Chips, gap: slice) -> FloatArray:
    """Unit vectors (n_sample, 3) to one place: the mean of the points seen on both sides of a gap, or one near it.

    Displacements of one length along them are a constant and nearly a line to each point. Along the mean line of sight
    of a beam that turns otherwise than the points', they would bend the phases, the more the longer they are.
    """
    collection = chips.work.geometry.collection
    position = np.stack(
        [np.interp(chips.time, collection.time, axis) for axis in collection.antenna_position.T], axis=1
    )
    near = straddling(chips, gap)
    if not near.any():
        near[np.abs(chips.first + chips.count / 2 - (gap.start + gap.stop) / 2).argmin()] = True
    place = chips.sight[near, 0] * chips.distance[near, :1] + position[chips.index[near, 0]]
    vector = place.mean(axis=0) - position
    return np.asarray(vector / np.sqrt((vector * vector).sum(axis=1, keepdims=True)))


class Jump(NamedTuple):
    """Phase by which the samples after a gap are ahead of those before it, common to all points.

    phase : float
        At the first sample after the gap, rad, within half a turn.
    slope : float
        rad per sample.
    """

    phase: float
    slope: float


def jump(chips: Chips, gap: slice, weights: FloatArray) -> Jump:
    """Estimate the jump over a gap: without it, the mean power of the brightest Doppler cells is highest.

    0 where no point is seen on both sides.
    """
    both = straddling(chips, gap)
    if not (weights[both] > 0).any():
        return Jump(0.0, 0.0)
    chips, weights = chips.some(np.flatnonzero(both)), weights[both]
    rows = strongest_rows(chips)
    n, later = rows.shape[1], chips.index >= gap.stop
    length = fast_length(PADDING * n)
    spectra = []
    for part in (np.where(later, 0, rows), np.where(later, rows, 0)):
        padded = np.zeros((rows.shape[0], length), np.complex64)
        padded[:, :n] = part
        spectra.append(fft_rows(padded, inverse=False))
    share = weights / np.maximum((np.abs(rows) ** 2).sum(axis=1, dtype=np.float64), 1e-300)
    near = np.arange(-round(NEAR_CELLS * PADDING), round(NEAR_CELLS * PADDING) + 1)
    steps, turns = np.arange(-STEEPEST, STEEPEST + 1), np.arange(-TRIALS, TRIALS) / (2 * TRIALS)
    origin = (gap.stop - chips.first)[:, None]
    power = np.zeros((steps.size, turns.size))
    for i, step in enumerate(steps):
        moved = spectra[1][:, (near + step) % length] * np.exp(2j * np.pi * (step * origin % length) / length)
        for k, turn in enumerate(turns):
            whole = spectra[0][:, near % length] + moved * np.exp(-2j * np.pi * turn)
            power[i, k] = (share * (whole.real**2 + whole.imag**2).max(axis=1)).sum()
    step, best = np.unravel_index(int(power.argmax()), power.shape)
    offset = solvers.vertex(power[step, [best - 1, best, (best + 1) % turns.size]])
    return Jump(2 * np.pi * (float(turns[best]) + offset / turns.size), 2 * np.pi * float(steps[step]) / length)


def bridged(chips: Chips, displacement: FloatArray, before: FloatArray) -> FloatArray:
    """Shift a displacement (n_sample, 3), m, by whole turns after each gap so that it and `before` together are smooth.

    After each gap it is moved along the line of sight by half wavelengths, which turn phases by whole turns that no
    chip sees: those that make it smooth by itself, so that loops add no turns to what is smooth already.
    """
    lit, out = (mean_sight(chips) != 0).any(axis=1), displacement
    for gap in long_gaps(chips):
        sight = sight_across(chips, gap)
        phase = chips.work.wavenumber * (out * sight).sum(axis=1)
        turns = whole_turns(phase, gap, chips.seen & lit)
        later = sight[gap.stop :] * (2 * np.pi * turns / chips.work.wavenumber)
        out = np.concatenate([out[: gap.stop], out[gap.stop :] - later])
        out[gap] = between(out + before, gap) - before[gap]
    return out


def whole_turns(phase: FloatArray, gap: slice, seen: BoolArray) -> int:
    """Whole turns by which a phase (n,), rad, jumps over a gap, by a polynomial through the samples `seen`."""
    side = max(gap.stop - gap.start, LEAST_SIDE)
    low, high = max(gap.start - side, 0), min(gap.stop + side, phase.size)
    at = low + np.flatnonzero(seen[low:high])
    after = (at >= gap.stop).astype(np.float64)
    if min(after.sum(), at.size - after.sum()) < SLOPE:
        return 0
    u = (2 * at - (low + high)) / (high - low)
    terms = np.concatenate([u[None] ** np.arange(DEGREE + 1)[:, None], after[None]])
    return round(float(solvers.least_squares(terms, phase[at])[-1]) / (2 * np.pi))


def between(displacement: FloatArray, gap: slice) -> FloatArray:
    """Interpolate a displacement (n_sample, 3) over a gap by cubics with value and slope of either side: (n, 3)."""
    n, u = gap.stop - gap.start + 1, np.arange(SLOPE) - (SLOPE - 1) / 2
    sides = (displacement[gap.start - SLOPE : gap.start], displacement[gap.stop : gap.stop + SLOPE])
    slopes = [(u[:, None] * side).sum(axis=0) / (u * u).sum() for side in sides]
    means = [side.mean(axis=0) for side in sides]
    first, last = means[0] + slopes[0] * u[-1], means[1] + slopes[1] * u[0]
    s = (np.arange(1, n) / n)[:, None]
    return np.asarray(
        (1 + 2 * s) * (1 - s) ** 2 * first + s**2 * (3 - 2 * s) * last
        + n * s * (1 - s) * ((1 - s) * slopes[0] - s * slopes[1])
    )  # fmt: skip
