"""Planning of the weighting over dwells: both halves of them, and the windows that each half needs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from blocksar.arrays import BoolArray, FloatArray
from blocksar.collection.weighting import Taper
from blocksar.focusing.dwell_taper import DwellTaper, HalfDwell
from blocksar.focusing.lines import LEAST_STRETCH, RowPolynomial
from blocksar.planning.dwell_ends import LitTimes, Moments, Passing

LEAST_SPREAD = 1e-3  # of halves' lengths, over which the place in the beam halfway is fitted
EDGES = 1e-4, 0.28  # shares of a half where an edge that fades out may be over
HALFWAY = 0.3, 0.7  # shares of a half where the place in the beam may be half of that at its edge
LENGTHS, MOST_LENGTHS = {1e-3: 1, 0.04: 2, 0.15: 3}, 4  # windows by the relative spread of the halves' lengths
MOST_SPREAD = 1.6  # the longest half over the shortest, between which so many windows are blended


class Half(NamedTuple):
    """One half of the dwells of targets, (n_range, n_yaw) each; None where of no use."""

    length: FloatArray  # s, after all steps
    edge: FloatArray | None  # share of the half at which its edge that fades out is over
    halfway: FloatArray | None  # share at which the place in the beam is half of that at its edge


def divide_dwells(times: LitTimes, ends: Moments, passing: Passing, middle: FloatArray) -> tuple[Half, Half]:
    """Both halves of the dwells that begin and end at `ends` after all steps, (n_range, n_yaw), s.

    The beam passes targets at `passing`, and its centre at the moment `middle`, s from the epoch.
    """
    (begins, stops), divide = ends, times.after(middle)
    lengths = divide - begins, stops - divide

    def shares(moments: Moments | None) -> tuple[FloatArray, FloatArray] | tuple[None, None]:
        if moments is None:
            return None, None
        after, before = (times.after(moment) for moment in moments)
        return (after - begins) / lengths[0], (stops - before) / lengths[1]

    edges, halfways = shares(passing.edges), shares(passing.halfways)
    return Half(lengths[0], edges[0], halfways[0]), Half(lengths[1], edges[1], halfways[1])


def plan_taper(
    taper: Taper,
    fade: int,
    halves: Sequence[Half],
    lengths: Sequence[RowPolynomial],
    *,
    full: BoolArray,
    levels: tuple[float, float],
) -> DwellTaper:
    """The taper over dwells with these halves, whose lengths are fitted by polynomials, and whose ends have levels."""
    begin, end = (
        _plan_half(half, length, full, level) for half, length, level in zip(halves, lengths, levels, strict=True)
    )
    return DwellTaper(taper=taper, begin=begin, end=end, fade=fade)


def _plan_half(half: Half, length: RowPolynomial, full: BoolArray, level: float) -> HalfDwell:
    windows = _window_lengths(*_blended(half.length, full))
    edge = 0.0 if half.edge is None else float(np.median(half.edge[full]))
    knots: tuple[tuple[float, float], ...] = ()
    if half.edge is not None and half.halfway is not None:
        edges, halfways = (_by_length(shares[full], half.length[full], windows) for shares in (half.edge, half.halfway))
        knots = tuple(zip(np.clip(edges, *EDGES).tolist(), np.clip(halfways, *HALFWAY).tolist(), strict=True))
    return HalfDwell(length=length, lengths=windows, edge=edge, knots=knots, level=level)


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


def _by_length(shares: FloatArray, lengths: FloatArray, windows: tuple[float, ...]) -> FloatArray:
    """Shares (n,) of halves of some lengths (n,), s, fitted linearly over the length, at those of windows."""
    middle, spread = float(np.median(lengths)), float(np.ptp(lengths))
    slope, level = 0.0, float(np.median(shares))
    if spread > LEAST_SPREAD * middle:
        away = lengths - lengths.mean()
        slope, level = float((away * shares).sum() / (away * away).sum()), float(shares.mean())
        middle = float(lengths.mean())
    return level + slope * (np.array(windows) - middle)


def _window_lengths(shortest: float, longest: float) -> tuple[float, ...]:
    """So many lengths between two, s, that blending windows of them errs by less than a thousandth."""
    count = next((n for spread, n in LENGTHS.items() if longest <= (1 + spread) * shortest), MOST_LENGTHS)
    if count == 1:
        return ((shortest + longest) / 2,)
    return tuple(np.linspace(shortest, longest, count).tolist())


def stretch_levels(times: LitTimes, middle: FloatArray, full: BoolArray, *, uneven: float) -> tuple[float, float]:
    """Levels of both halves of dwells that make up for the stretch of lines; 0 where it costs less than `uneven`.

    The sum over a dwell weighs its lines by sqrt(stretch). `middle` is the moment when the beam's centre passes.
    """
    line = times.line
    full = full if full.any() else np.ones_like(full)
    stretch = np.maximum(line.stretch, LEAST_STRETCH)
    even = line.weight.sum(axis=-1) * (line.weight * stretch).sum(axis=-1)
    if np.median((1 - (line.weight * np.sqrt(stretch)).sum(axis=-1) / np.sqrt(even))[full]) < uneven:
        return 0.0, 0.0
    amid = times.at(stretch, middle)
    begin, end = (float(np.median(np.sqrt(amid / stretch[..., i])[full])) - 1 for i in (0, -1))
    return begin, end
