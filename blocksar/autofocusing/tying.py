"""Ties between the tracks of collections that overlap, such as bursts.

The samples of a collection do not determine a constant and a linear error of its track along the line of sight, which
shift and rotate its image. Those of two collections differ, and their images do not fit where they meet: by metres,
where errors of centimetres change within a second. Points that both see show the difference: the places where one sees
them are control points of the other, without phases. A place is known to some hundredths of a resolution cell, which is
many turns of the phase over the time between both dwells.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from blocksar.arrays import BoolArray, FloatArray, IntArray
from blocksar.autofocusing.anchoring import Control, Seen, anchored, responses_of
from blocksar.autofocusing.chips import ChipPart, Chips, join_chips
from blocksar.autofocusing.finishing import Result
from blocksar.autofocusing.selection import Points
from blocksar.autofocusing.track_correction import Correction
from blocksar.autofocusing.work import Work
from blocksar.errors import InputError
from blocksar.solvers import newton

SHARED = 0.75  # of a dwell that each collection must see of a shared point
LEAST = 4  # points that tie two collections
STEPS = 6  # of Newton's method, from a point to a place in its chip


@dataclass(frozen=True, kw_only=True, eq=False)
class Places:
    """Ground places where a collection sees responses: x, y, z (n,) float, m, scene frame."""

    x: FloatArray
    y: FloatArray
    z: FloatArray


def shared_points(one: Work, other: Work, points: Sequence[Points]) -> Points:
    """Select points of either collection that both see for most of a dwell, with the pulses of `one`.

    Both have them in their range windows, where a chip would hold other ranges otherwise. No more than an estimate has.
    """
    x, y, z = (np.concatenate([getattr(some, name) for some in points]) for name in ("x", "y", "z"))
    seen = np.ones(x.size, bool)
    for work in (one, other):
        first, last = work.geometry.beam.longest_pass(x, y)
        seen &= (last - first >= SHARED * work.dwell) & _in_window(work, x, y, z, first, last)
    index = np.flatnonzero(seen)[: one.settings.points]
    x, y, z = x[index], y[index], z[index]
    first, last = one.geometry.beam.longest_pass(x, y)
    return Points(x=x, y=y, z=z, first=first, last=last)


def _in_window(work: Work, x: FloatArray, y: FloatArray, z: FloatArray, first: IntArray, last: IntArray) -> BoolArray:
    """Mask of points (n,), m, that stay in the range window from pulse `first` to before `last`."""
    collection, inside = work.geometry.collection, np.ones(x.shape, bool)
    for pulse in (first, (first + last) // 2, np.maximum(last - 1, 0)):
        distance = np.linalg.norm(np.stack([x, y, z], axis=1) - collection.antenna_position[pulse], axis=1)
        inside &= np.abs(distance - collection.reference_range[pulse]) <= collection.range_window / 2
    return inside


def find_places(work: Work, points: Points, parts: Sequence[ChipPart], correction: Correction) -> Places:
    """Locate the brightest response in each point's chip along the corrected track; equal places only once.

    Parameters
    ----------
    parts : sequence of ChipPart
        Chips of `points`, taken with `correction`, by block of pulses.
    """
    chips = join_chips(work, points, parts, correction.displacement)
    found: list[tuple[float, float]] = []
    for i in range(points.x.size):
        with suppress(InputError):  # nothing stands out in this chip
            x, y = _place(work, points, chips, i, responses_of(chips, i, f"{i}")[0])
            known = np.isfinite(work.geometry.height(np.array([x]), np.array([y]))).all() and np.isfinite([x, y]).all()
            if known and all(np.hypot(x - a, y - b) > work.cell for a, b in found):
                found.append((x, y))
    at = np.array(found, np.float64).reshape(-1, 2)
    height = work.geometry.height(at[:, 0], at[:, 1])
    return Places(x=at[:, 0].copy(), y=at[:, 1].copy(), z=np.broadcast_to(height, at.shape[:1]).copy())


def _place(work: Work, points: Points, chips: Chips, i: int, one: Seen) -> tuple[float, float]:
    """x and y of a response, m, from its range at mid-dwell and the change of range over the dwell.

    NaN where the terrain has no such place.
    """
    n = int(chips.count[i])
    at = [0, n // 2, n - 1]
    distance = chips.distance[i, at]
    point = np.array([points.x[i], points.y[i], points.z[i]])
    antenna = point - chips.sight[i, at] * distance[:, None]

    def seen(place: FloatArray) -> FloatArray:
        height = float(np.asarray(work.geometry.height(place[:1], place[1:])).ravel()[0])
        ranges = np.sqrt(((antenna - [*place, height]) ** 2).sum(axis=1))
        return np.array([ranges[1], ranges[2] - ranges[0]])

    turned = one.rate * float(one.at[2] - one.at[0]) / work.wavenumber  # m, towards the antenna
    wanted = np.array([distance[1] + one.range, distance[2] - distance[0] - turned])
    x, y = newton(seen, wanted, point[:2], steps=STEPS)
    return float(x), float(y)


def places_seen(work: Work, places: Places) -> Places:
    """Select the places that this collection sees."""
    first, last = work.geometry.beam.longest_pass(places.x, places.y)
    inside = _in_window(work, places.x, places.y, places.z, first, last)
    seen = np.flatnonzero((last - first >= 2 * work.decimation) & inside)
    return Places(x=places.x[seen], y=places.y[seen], z=places.z[seen])


def control_of(places: Places) -> Control:
    """Turn places where another collection sees responses into control points, of unknown phase."""
    names = tuple(f"{i}" for i in range(places.x.size))
    return Control(names=names, x=places.x, y=places.y, z=places.z, phase=np.zeros(places.x.size))


def tie(work: Work, result: Result, places: Places, parts: Sequence[ChipPart], correction: Correction) -> Result:
    """Correct a track by a constant and a line so that it sees responses where another collection does.

    The result's figures have `tied`: the number of points, 0 where they do not agree and the track stays as it is; by
    how much it was `moved`, m; and what is left of their ranges, `range_left`, m.

    Parameters
    ----------
    parts : sequence of ChipPart
        Chips of `control_of(places)`, taken with `correction`, by block of pulses.
    """
    control = control_of(places)
    chips = join_chips(work, control.points(work), parts, correction.displacement)
    names, found = [], []
    for i, name in enumerate(control.names):
        with suppress(InputError):  # it is not seen here
            found.append([replace(one, doubt=np.inf) for one in responses_of(chips, i, name)])
            names.append(name)
    with suppress(InputError):  # they do not agree
        if len(names) >= LEAST:
            tied = anchored(work, result, names, found)
            fit = tied.figures["control"]
            figures = {name: tied.figures[name] for name in tied.figures if name != "control"}
            summary = {"points": fit["points"], "moved": fit["moved"], "range_left": fit["range_left"]}
            return replace(tied, figures={**figures, "tied": summary})
    return replace(result, figures={**result.figures, "tied": {"points": 0}})


def tie_in_turn(n: int, shared: Mapping[tuple[int, int], int], attempt: Callable[[int, int], bool]) -> list[int]:
    """Tie n collections to each other, one by one; return those besides the first that stay untied.

    The one that shares most points with those before is tied to the one that it shares them with; if these points do
    not agree, the next such pair is tried. Where no pair shares `LEAST` points, one stays as it is, and others may be
    tied to it.

    Parameters
    ----------
    shared : mapping
        Number of points that the collections (i, j) share, i < j.
    attempt : callable
        attempt(one, other) ties the other to the one, and returns whether their points agree.
    """
    left, before, rest, apart = dict(shared), [0], list(range(1, n)), []
    while rest:
        pairs = [(min(one, other), max(one, other)) for one in before for other in rest]
        pair = max(pairs, key=left.__getitem__)
        if left[pair] < LEAST:
            apart.append(other := rest[0])
        else:
            one, other = pair if pair[1] in rest else pair[::-1]
            left[pair] = 0
            if not attempt(one, other):
                continue
        before.append(other)
        rest.remove(other)
    return apart
