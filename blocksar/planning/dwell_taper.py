"""Planning of the weighting over dwells: both halves of them, and the windows that each half needs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from blocksar.arrays import BoolArray, FloatArray
from blocksar.collection.weighting import Taper
from blocksar.focusing.dwell_taper import DwellTaper, HalfDwell
from blocksar.focusing.lines import RowPolynomial
from blocksar.planning.dwell_ends import LitTimes, Moments

LENGTHS, MOST_LENGTHS = {1e-3: 1, 0.04: 2, 0.15: 3}, 4  # windows by the relative spread of the halves' lengths
MOST_SPREAD = 1.6  # the longest half over the shortest, between which so many windows are blended


def divide_dwells(times: LitTimes, ends: Moments, middle: FloatArray) -> Moments:
    """Lengths of both halves of the dwells that begin and end at `ends` after all steps, (n_range, n_yaw), s.

    The beam's centre passes targets at the moment `middle`, s from the epoch.
    """
    divide = times.after(middle)
    return divide - ends[0], ends[1] - divide


def plan_taper(
    taper: Taper, halves: Sequence[FloatArray], lengths: Sequence[RowPolynomial], *, full: BoolArray
) -> DwellTaper:
    """The taper over dwells with halves of these lengths (n_range, n_yaw), s, which polynomials fit."""
    begin, end = (
        HalfDwell(length=length, lengths=_window_lengths(*_blended(half, full)))
        for half, length in zip(halves, lengths, strict=True)
    )
    return DwellTaper(taper=taper, begin=begin, end=end)


def _blended(lengths: FloatArray, full: BoolArray) -> tuple[float, float]:
    """Shortest and longest half for which windows are made, s.

    Where a beam turns slowly near the collection's ends, dwells that these cut may be several times as long as those
    with `full` dwell; windows for both would lie too far apart to be blended. Then they are made for full dwells, and
    for others as far as `MOST_SPREAD` reaches.
    """
    shortest, longest = float(lengths.min()), float(lengths.max())
    if longest > MOST_SPREAD * shortest and full.any():
        least, most = float(lengths[full].min()), float(lengths[full].max())
        room = max(MOST_SPREAD * least / most, 1.0) ** 0.5
        shortest = max(shortest, least / room)
        longest = min(longest, max(most, MOST_SPREAD * shortest))
    return shortest, longest


def _window_lengths(shortest: float, longest: float) -> tuple[float, ...]:
    """So many lengths between two, s, that blending windows of them errs by less than a thousandth."""
    count = next((n for spread, n in LENGTHS.items() if longest <= (1 + spread) * shortest), MOST_LENGTHS)
    if count == 1:
        return ((shortest + longest) / 2,)
    return tuple(np.linspace(shortest, longest, count).tolist())
