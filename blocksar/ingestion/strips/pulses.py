"""Times of a raw echo's pulses: which follow each other evenly, and which are lost between them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blocksar.arrays import FloatArray, IntArray
from blocksar.errors import InputError

UNEVEN = 0.02  # of the interval, by which one may differ from a whole number of it
LONGEST_GAP = 4096  # pulses
LEAST = 16  # pulses of a constant PRF that are worth an image
WANDER = 0.1  # of the interval, by which a pulse may lie off an even axis; positions are taken where it is


class Even(NamedTuple):
    """Pulses at one PRF.

    Attributes
    ----------
    pulses : (n,) int
        Their numbers in the file.
    slots : (n,) int
        Their places on an even axis, from 0; what lies between is lost.
    time : (n_slot,) float
        Of all slots, s: that of the pulse, or in between.
    interval : float
        s.
    """

    pulses: IntArray
    slots: IntArray
    time: FloatArray
    interval: float

    def part(self, first: int, stop: int) -> tuple[IntArray, IntArray]:
        """The slots from one to before another that have a pulse, from the first on, and the pulses in the file."""
        low, high = np.searchsorted(self.slots, [first, stop])
        return self.slots[low:high] - first, self.pulses[low:high]

    def without(self, some: IntArray) -> Even:
        """Copy in which some pulses, by their place here, are lost; the axis stays."""
        return self._replace(pulses=np.delete(self.pulses, some), slots=np.delete(self.slots, some))


def even_pulses(time: FloatArray, interval: float | None = None) -> tuple[Even, list[str]]:
    """The longest part of pulses at times (n,), s, that has one PRF, and notes on what was left out or lost.

    Raises
    ------
    InputError
        If there is none, as where the PRF is dithered.
    """
    if time.size < LEAST or not np.isfinite(time).all():
        raise InputError(f"{time.size} pulses with finite times are left; at least {LEAST} are needed")
    steps = np.diff(time)
    usual = float(np.median(steps)) if interval is None else interval
    if not usual > 0 or (steps <= 0).any():
        raise InputError(f"times of pulses do not ascend at pulse {int(np.argmax(steps <= 0)) + 1}; give the file anew")
    whole = np.rint(steps / usual)
    fits = (whole >= 1) & (whole <= LONGEST_GAP) & (np.abs(steps - whole * usual) <= UNEVEN * usual)
    ends = np.flatnonzero(np.diff(np.concatenate([[0], fits, [0]])))
    first, last = ends.reshape(-1, 2)[np.argmax(np.diff(ends.reshape(-1, 2), axis=1))] if ends.size else (0, 0)
    if last - first + 1 < LEAST:
        raise InputError(
            f"intervals between pulses are {1e6 * steps.min():.6g} .. {1e6 * steps.max():.6g} us and change all the "
            "time (a dithered PRF), which no phase history holds; resample the echoes to even times first"
        )
    slots = np.concatenate([[0], np.cumsum(whole[first:last])]).astype(np.int64)
    kept = time[first : last + 1]
    step, start = np.polyfit(slots - slots[-1] / 2, kept - kept[0], 1) if slots[-1] else (usual, 0.0)
    even = kept[0] + start + step * (np.arange(slots[-1] + 1) - slots[-1] / 2)
    if np.abs(even[slots] - kept).max() > WANDER * step:
        raise InputError(
            f"times of pulses wander by {np.abs(even[slots] - kept).max() / step:.3g} intervals off an even axis; "
            "resample the echoes to even times first"
        )
    at = np.interp(np.arange(even.size), slots, kept - even[slots]) + even
    notes = []
    if kept.size < time.size:
        notes.append(
            f"the PRF changes: pulses {first} .. {last} of {time.size} have one of {1 / step:.6g} Hz and are taken; "
            "others with --pulses"
        )
    if lost := int(slots[-1] + 1 - slots.size):
        notes.append(f"{lost} pulses between these are lost, and missing in the store")
    return Even(np.arange(first, last + 1), slots, at, float(step)), notes
