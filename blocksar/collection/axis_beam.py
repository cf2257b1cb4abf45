"""Beams about the antenna's own axis: angles off the beam's centre, and the pulses that light a point.

With u the unit vector from the antenna to a point, the point lies by

    offset = asin(u . beam_axis) - beam_steering

off the beam's centre, and is lit while |offset| <= beam_width / 2. A fixed beam is stripmap, a slow turn sliding
spotlight, a fast one TOPS. When a point is lit depends on its range as well as on its yaw.

That is a sheet all round the axis, of which an antenna lights one side. Where `side_of_track` is given, a point is lit
only at pulses at which it lies on that side of the vertical plane through the antenna that holds the axis, or in the
plane: `lit_side`. On a straight track that is one half of the ground. On an arc or a circle the plane sweeps over the
ground, so that it begins and ends dwells as the edges of the beam do.

Which pulses light a point is found exactly, however the beam turns and wobbles (`kernels.beam_passes`). Times of dwells
are those of a beam that is smooth over a fraction 1 / NODES of the collection: an offset mostly rises or falls
throughout, or turns back once.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from blocksar.arrays import BoolArray, FloatArray, IntArray
from blocksar.collection.collection import Collection

if TYPE_CHECKING:
    from blocksar.kernels.beam_passes import FoundPasses, LitSide, MovingBeam

NODES = 32  # parts of the collection at whose ends offsets are compared, to see whether they turn back
FEW_PASSES = 2  # for which there is room where every pulse is looked at; more if there are more
REACH = 64  # the part of the collection, 1 / REACH, whose slope continues an offset beyond the collection's ends
LEAST_SLOPE = 1e-12  # rad/s
DOWN = 1e-3  # rad off the nadir, within which a line of sight looks to no side
ALONG = 0.25  # of its way that an antenna moves along its axis, at least, for a side of the track to be one of the axis
Height = FloatArray | float


class GroundPoints(NamedTuple):
    """Places x, y (n,) and z (n,) or one for all, m."""

    x: FloatArray
    y: FloatArray
    z: Height

    def some(self, which: IntArray | BoolArray) -> GroundPoints:
        """The points at some indices."""
        return GroundPoints(self.x[which], self.y[which], self.z[which] if isinstance(self.z, np.ndarray) else self.z)

    def each(self) -> GroundPoints:
        """Broadcast to contiguous arrays, with a height for each point."""
        z = np.broadcast_to(np.asarray(self.z, np.float64), self.x.shape)
        return GroundPoints(*(np.ascontiguousarray(part, np.float64) for part in (self.x, self.y, z)))


def axis_offset(
    collection: Collection, x: FloatArray, y: FloatArray, z: Height, pulses: slice | IntArray | int
) -> FloatArray:
    """Angle of points x, y, z (m) off the beam's centre at pulses, rad; points and pulses are broadcast."""
    assert collection.beam_axis is not None and collection.beam_steering is not None
    px, py, pz = np.moveaxis(collection.antenna_position[pulses], -1, 0)
    ax, ay, az = np.moveaxis(collection.beam_axis[pulses], -1, 0)
    dx, dy, dz = x - px, y - py, z - pz
    sine = (dx * ax + dy * ay + dz * az) / np.sqrt(dx * dx + dy * dy + dz * dz)
    return np.asarray(np.arcsin(np.clip(sine, -1.0, 1.0)) - collection.beam_steering[pulses])


def side_of(ahead: FloatArray, sight: FloatArray) -> str | None:
    """Side of the track, "left" or "right", to which a line of sight (3,) looks; None if straight down."""
    across = float(ahead[0] * sight[1] - ahead[1] * sight[0])
    if abs(across) < DOWN * float(np.hypot(*ahead[:2])) * abs(float(sight[2])):
        return None
    return "left" if across > 0 else "right"


@lru_cache(maxsize=4)
def lit_side(collection: Collection) -> FloatArray | None:
    """Level unit vectors (n_pulse, 2) across the axis, towards the side of the track that the antenna lights.

    None where either side counts as lit: without `side_of_track`, or where the antenna does not move along its axis, so
    that a side of the track is none of the axis. The axis may point backwards, which the way of the whole collection
    tells: an antenna does not change the side of its axis. 0 at pulses where the axis is vertical. Read-only.
    """
    if collection.side_of_track is None or collection.beam_axis is None:
        return None
    axis, steps = collection.beam_axis[:, :2], np.diff(collection.antenna_position[:, :2], axis=0)
    along = float((axis[:-1] * steps).sum())
    if abs(along) <= ALONG * float(np.hypot(*steps.T).sum()):
        return None
    ahead = axis * np.sign(along) / np.maximum(np.hypot(*axis.T), np.finfo(float).tiny)[:, None]
    right = np.stack([ahead[:, 1], -ahead[:, 0]], axis=1)
    towards = right if collection.side_of_track == "right" else -right
    towards.flags.writeable = False
    return towards


def on_lit_side(collection: Collection, x: FloatArray, y: FloatArray, pulses: slice) -> BoolArray:
    """Whether points x, y (m) lie on the side that the antenna lights at pulses; points and pulses are broadcast."""
    if (towards := lit_side(collection)) is None:
        return np.ones((), np.bool_)
    (px, py), (ax, ay) = collection.antenna_position[pulses, :2].T, towards[pulses].T
    return np.asarray((x - px) * ax + (y - py) * ay >= 0)


def axis_passes(collection: Collection, points: GroundPoints) -> tuple[IntArray, IntArray]:
    """Pulses first <= p < last that light points (n,): exactly those of |offset| <= beam_width / 2, on the lit side.

    Several passes where the beam turns back or wobbles, or the antenna its side, leaves a point and comes to it again:
    (n_pass, n), in the order of time. Those that a point lacks are empty, at the end of the one before; so a point that
    is never lit has 0 and 0.
    """
    points = points.each()
    found = _in_sheet(collection, points)
    if (side := _side(collection)) is not None:
        found = _of_side(side, points, found)
    return _in_order(*found)


def _in_sheet(collection: Collection, points: GroundPoints) -> FoundPasses:
    """Passes of points (n,), each with a height, within the beam's width of the axis, on both sides of the track."""
    # Numba is loaded here, which other beams do without.
    from blocksar.kernels.beam_passes import find_passes

    beam = _moving(collection)
    return _all_found(points.x.size, lambda found: find_passes(beam, *points, found))


def _all_found(n: int, find: Callable[[FoundPasses], int]) -> FoundPasses:
    """Passes of n points as `find` writes them, repeated with more room until all of them fit."""
    from blocksar.kernels.beam_passes import FoundPasses

    most, m = FEW_PASSES, 0
    while most > m:
        m = most
        found = FoundPasses(*np.empty((2, m, n), np.int64))
        most = find(found)
    return found


@lru_cache(maxsize=4)
def _side(collection: Collection) -> LitSide | None:
    """`lit_side` for compiled loops."""
    from blocksar.kernels.beam_passes import LitSide

    towards = lit_side(collection)
    return None if towards is None else LitSide.of(collection.antenna_position, towards)


def _loses(collection: Collection, side: LitSide, points: GroundPoints) -> BoolArray:
    """Tell which points (n,) lose pulses when passes are limited to the lit side."""
    found = _in_sheet(collection, points)
    on_side = _of_side(side, points, found)
    sheet, lit = ((passes.lasts - passes.firsts).sum(axis=0) for passes in (found, on_side))
    return np.asarray(sheet != lit)


def _of_side(side: LitSide, points: GroundPoints, passes: FoundPasses) -> FoundPasses:
    """Limit passes to the pulses at which points are on the lit side."""
    from blocksar.kernels.beam_passes import keep_side

    return _all_found(points.x.size, lambda found: keep_side(side, points.x, points.y, passes, found))


def _in_order(firsts: IntArray, lasts: IntArray) -> tuple[IntArray, IntArray]:
    """First and last pulses (n_pass, n) in ascending order; empty passes start and end where the previous one ends."""
    empty = firsts >= lasts
    count = int(np.flatnonzero(~empty.all(axis=1)).max(initial=0)) + 1
    firsts, lasts, empty = firsts[:count], lasts[:count], empty[:count]
    lasts = np.maximum.accumulate(np.where(empty, 0, lasts))
    return np.where(empty, lasts, firsts), lasts


@lru_cache(maxsize=4)
def _table(collection: Collection, half: float) -> FloatArray:
    """The beam's table for compiled loops, with limits `half` rad about its centre; read-only."""
    from blocksar.kernels.beam_passes import beam_table

    assert collection.beam_axis is not None and collection.beam_steering is not None
    table = beam_table(collection.antenna_position, collection.beam_axis, collection.beam_steering, half)
    table.flags.writeable = False
    return table


@lru_cache(maxsize=4)
def _moving(collection: Collection) -> MovingBeam:
    """The beam for compiled loops, with how fast it changes."""
    from blocksar.kernels.beam_passes import MovingBeam

    return MovingBeam.of(_table(collection, _half(collection)))


def axis_dwell(collection: Collection, points: GroundPoints, *, uncut: bool) -> tuple[FloatArray, FloatArray]:
    """Times at which points (n,) enter and leave the beam, s, as a continuous function of time.

    Of the steady beam where it wobbles. Between pulses, offsets are interpolated linearly; beyond the ends of the
    collection they go on with their slope there. Without `uncut`, times are limited to the collection; the first is not
    before the last where a point is never lit. Where offsets turn back, or the lit side leaves a point in the
    sheet, times are those of pulses. NaN where x, y or z is.
    """
    collection = collection.steady
    known = np.isfinite(points.x) & np.isfinite(points.y) & np.isfinite(points.z)
    if not known.all():
        first, last = np.full((2, points.x.size), np.nan)
        first[known], last[known] = axis_dwell(collection, points.some(known), uncut=uncut)
        return first, last
    time, half_pulse = collection.time, collection.pulse_interval / 2
    turning, rising = _turning(collection, points)
    sign = np.where(rising, 1.0, -1.0)
    first, last = (_edge_times(collection, points, sign, level) for level in (-_half(collection), _half(collection)))
    bent = np.flatnonzero(turning != 0)
    if bent.size:
        passes = axis_passes(collection, points.some(bent))
        begin, end = passes[0][0], passes[1][-1]
        lit, at_turn = end > begin, time[np.maximum(turning[bent], 0)]
        first[bent] = np.where(lit, time[np.minimum(begin, collection.n_pulse - 1)] - half_pulse, at_turn)
        last[bent] = np.where(lit, time[end - 1] + half_pulse, at_turn)
    if uncut:
        return first, last
    return np.maximum(first, time[0] - half_pulse), np.minimum(last, time[-1] + half_pulse)


def axis_passing(collection: Collection, points: GroundPoints, place: float) -> FloatArray:
    """Times at which points (n,) are at a place in the beam, s: -1 where they enter, 1 where they leave it.

    As `axis_dwell`, as if the collection did not cut dwells; in proportion where offsets turn back. From the nearer end
    of the dwell, a place is half as far as in proportion to half as far again; near the ends a third to three times.
    """
    collection = collection.steady
    first, last = axis_dwell(collection, points, uncut=True)
    middle, half = (first + last) / 2, (last - first) / 2
    known = np.flatnonzero(np.isfinite(middle))
    turning, rising = _turning(collection, points.some(known))
    some = known[turning == 0]
    sign = np.where(rising[turning == 0], 1.0, -1.0)
    found = _edge_times(collection, points.some(some), sign, place * _half(collection))
    away = np.full(points.x.shape, place)
    toward, apart = (1.0 if place >= 0 else -1.0), 1 - abs(place)
    limits = toward * (1 - apart * 1.5 * (1 + place**2)), toward * (1 - apart / (2 + place**2))
    away[some] = np.clip((found - middle[some]) / half[some], min(limits), max(limits))
    return np.asarray(middle + away * half)


def _half(collection: Collection) -> float:
    return (collection.beam_width or 0.0) / 2


def _turning(collection: Collection, points: GroundPoints) -> tuple[IntArray, BoolArray]:
    """The pulse at which the offset of each point (n,) turns back, and whether it rises before that.

    The pulse is 0 where it never turns, -1 where it does so more than once, or the lit side leaves it in the sheet.
    """
    from blocksar.kernels.beam_passes import FoundPasses, find_turning

    assert collection.beam_steering is not None
    nodes = np.unique(np.linspace(0, collection.n_pulse - 1, NODES + 1).round().astype(np.int64))
    turning, rises = np.empty(points.x.size, np.int64), np.empty(points.x.size, np.bool_)
    table, steering = _table(collection, 0.0), np.array(collection.beam_steering)
    find_turning(table, steering, nodes, *points.each(), turning, rises)
    if (side := _side(collection)) is not None:
        whole = FoundPasses(np.zeros((1, turning.size), np.int64), np.full((1, turning.size), collection.n_pulse))
        on_side = _of_side(side, points.each(), whole)
        doubtful = np.flatnonzero((on_side.firsts[0] > 0) | (on_side.lasts[0] < collection.n_pulse))
        turning[doubtful[_loses(collection, side, points.some(doubtful).each())]] = -1
    return turning, rises


def _at(collection: Collection, points: GroundPoints, pulses: IntArray) -> FloatArray:
    """Offsets of points (n,) from the beam's centre at one pulse each (n,), rad."""
    return axis_offset(collection, *points, pulses)


def _edge_times(collection: Collection, points: GroundPoints, sign: FloatArray, level: float) -> FloatArray:
    """Times, s, at which the offset times `sign`, which rises, passes a level."""
    from blocksar.kernels.beam_passes import find_first

    n, time = collection.n_pulse, collection.time
    after = np.empty(sign.size, np.int64)
    find_first(_table(collection, level), *points.each(), sign > 0, after)
    reach = max(n // REACH, 1)
    # Two pulses whose chord is followed: neighbours inside the collection, further apart beyond its ends.
    left = np.where(after == 0, 0, np.where(after == n, n - 1 - reach, after - 1))
    right = np.where(after == 0, reach, np.where(after == n, n - 1, np.minimum(after, n - 1)))
    begin, end = sign * _at(collection, points, left), sign * _at(collection, points, right)
    slope = np.maximum((end - begin) / (time[right] - time[left]), LEAST_SLOPE)
    late = after == n
    return np.where(late, time[right] + (level - end) / slope, time[left] + (level - begin) / slope)
