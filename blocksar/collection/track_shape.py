"""Unusual tracks: the antenna stands still, turns back, scans a raster, or repeats positions.

Chains transform slow time to Doppler, which has to change with the yaw of a target, one to one. Where the antenna
stands still it does not change, and on the way back it takes its values again. An image depends on positions only, not
on the times at which the antenna was there, and exact back-projection takes any positions.

Tracks are examined over windows of some pulses, so that noise of the positions does not count; shapes below that noise
are not reported.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from blocksar.arrays import BoolArray, FloatArray, IntArray
from blocksar.collection.collection import Collection
from blocksar.texts import count

WINDOW, LEAST_WINDOW = 1 / 64, 4  # of the pulses, over which ways are judged, and the fewest intervals
STANDS, USUAL = 0.05, 0.75  # of the usual way over a window: it stands still with less. Usual: that quantile
REVERSED = -0.5  # cosine of the angle by which it turns, of 120 degrees
MOVES = 0.2  # of the usual way, on either side of a turn
WITHIN = 0, 1 / 32, 1 / 16  # of the pulses that a turn may take
FLIES_BACK = 5.0  # usual steps from pulse to pulse against the way, as from the end of a row to the next one's start
MOST_PULSES = 4096  # that are looked at, evenly spaced
ROWS = 3  # turns of a raster
REPEATS = 0.5  # of the pulses at the very place of the pulse before, from which on positions are steps


class Flaw(NamedTuple):
    """Unusual shape of a track: a sentence with figures, the remedy for chains, and the number of passes."""

    fact: str
    remedy: str
    ways: int = 1

    def __str__(self) -> str:
        return f"{self.fact}; {self.remedy}"


def find_flaw(collection: Collection) -> Flaw | None:
    """Find the shape of a track that no transform to Doppler can handle; None if there is none."""
    every = math.ceil(collection.n_pulse / MOST_PULSES)
    position, step = (
        collection.antenna_position[::every],
        np.linalg.norm(np.diff(collection.antenna_position, axis=0), axis=1),
    )
    n = len(position)
    width = max(math.ceil(WINDOW * n), LEAST_WINDOW)
    if n < 4 * width:
        return None
    if (step == 0).sum() > REPEATS * step.size and (flaw := _repeats(step)) is not None:
        return flaw
    turns = np.union1d(every * _turns(position, width), _flights_back(collection.antenna_position))
    if len(turns) >= ROWS:
        return _raster(turns)
    if len(turns):
        return _turning_back(collection, turns)
    standing = _standing(position, width).repeat(every)[: collection.n_pulse]
    return _stands_still(collection, standing) if standing.any() else None


def _standing(position: FloatArray, width: int) -> BoolArray:
    """Mask of pulses (n,) inside a window of `width` intervals in which positions (n, 3), m, hardly differ."""
    windows = sliding_window_view(position, width + 1, axis=0)
    extent = np.linalg.norm(windows.max(axis=-1) - windows.min(axis=-1), axis=-1)
    first = np.flatnonzero(extent < STANDS * np.quantile(extent, USUAL))
    change = np.zeros(len(position) + 1, np.int64)
    np.add.at(change, first, 1)
    np.add.at(change, first + width + 1, -1)
    return np.asarray(np.cumsum(change)[:-1] > 0)


def _turns(position: FloatArray, width: int) -> IntArray:
    """Pulses at which positions (n, 3), m, turn back, or jump back to begin another row, ascending."""
    n = len(position)
    way = position[width:] - position[:-width]
    length = np.linalg.norm(way, axis=1)
    usual = float(np.quantile(length, USUAL))
    turning = np.zeros(n, np.bool_)
    for share in WITHIN:
        apart = width + math.ceil(share * n)  # from the start of one way to that of the other
        before, after = way[:-apart], way[apart:]
        least = np.minimum(length[:-apart], length[apart:])
        cosine = (before * after).sum(axis=1) / np.maximum(length[:-apart] * length[apart:], 1e-300)
        middle = (width + apart) // 2 + np.flatnonzero((cosine < REVERSED) & (least > MOVES * usual))
        turning[middle] = True
    pulses = np.flatnonzero(turning)
    groups = np.split(pulses, np.flatnonzero(np.diff(pulses) > width) + 1) if pulses.size else []
    return np.array([int(group.mean()) for group in groups], np.int64)


def _flights_back(position: FloatArray) -> IntArray:
    """Last pulses before steps backwards that are many times the usual length."""
    step = np.diff(position, axis=0)
    length = np.linalg.norm(step, axis=1)
    usual = float(np.median(length))
    ahead = np.median(step[length < FLIES_BACK * usual], axis=0) if usual else np.zeros(3)
    back = (step * ahead).sum(axis=1) < 0
    return np.flatnonzero((length > FLIES_BACK * usual) & back) if usual else np.zeros(0, np.int64)


def _runs(mask: BoolArray) -> list[tuple[int, int]]:
    """First and last index of every run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(first), int(end) - 1) for first, end in zip(edges[::2], edges[1::2], strict=True)]


def _stands_still(collection: Collection, standing: BoolArray) -> Flaw:
    runs, n, time = _runs(standing), collection.n_pulse, collection.time
    places = ", ".join(f"{first} .. {last} (t = {time[first]:.6g} .. {time[last]:.6g} s)" for first, last in runs[:3])
    more = f" and in {count(len(runs) - 3, 'more place')}" if len(runs) > 3 else ""
    inside = [run for run in runs if run[0] > 0 and run[1] < n - 1]
    first = runs[0][1] + 1 if runs[0][0] == 0 else 0
    last = runs[-1][0] if runs[-1][1] == n - 1 else n
    if inside:
        remedy = (
            "leave them out, and give the others even times without the gap, as an image depends on positions and not "
            "on times"
        )
    else:
        remedy = f"leave them out (dataset.isel(pulse=slice({first}, {last})))"
    return Flaw(
        f"the antenna stands still at pulses {places}{more}: they lengthen no aperture, and their Doppler does not "
        "tell yaws apart",
        remedy,
    )


def _turning_back(collection: Collection, turns: IntArray) -> Flaw:
    places = " and ".join(f"at pulse {pulse} (t = {collection.time[pulse]:.6g} s)" for pulse in turns)
    return Flaw(
        f"antenna_position turns back {places}: on the way back Doppler takes its values again",
        "give the pulses of each way as a collection of its own",
        len(turns) + 1,
    )


def _raster(turns: IntArray) -> Flaw:
    rows = float(np.median(np.diff(turns)))
    return Flaw(
        f"antenna_position is a raster of {len(turns) + 1} rows of some {rows:.0f} pulses, not one track: it turns "
        f"back after pulses {', '.join(map(str, turns[:3]))}, ...",
        "give the pulses of one row as a collection of their own",
        len(turns) + 1,
    )


def _repeats(step: FloatArray) -> Flaw | None:
    """Describe positions that stay constant between steps; None if the antenna keeps moving, or stops for good."""
    moves = np.flatnonzero(step)
    if moves.size < ROWS or np.diff(moves).max() > 4 * max(float(np.median(np.diff(moves))), 1.0):
        return None
    return Flaw(
        f"antenna_position moves on at {moves.size} of {step.size + 1} pulses only, by {np.median(step[moves]):.3g} m "
        "each time",
        "interpolate positions that were measured less often than pulses were sent, or average the pulses that were "
        "sent from one place",
    )
