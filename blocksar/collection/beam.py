"""Which pulses light a ground point: the one rule, and what follows from it.

A pulse lights a point while |wrapped(yaw - beam_azimuth)| <= beam_width / 2, where yaw is the point's angle about the
platform's nadir at t = 0. Points on the very edge are lit. A collection whose beam is not steered lights every point
with every pulse.

`in_beam` is that rule for plain angles; compiled loops wrap it by `numba.njit(inline="always")`. Callers that have
positions ask `is_lit`, `lit_interval` and `dwell`; `is_lit` and `lit_interval` compare without tolerance. Callers that
work in the polar frame ask `lit_pulses` and `dwell_at`, which allow for the rounding of computed yaws (`EDGE`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from blocksar.arrays import BoolArray, FloatArray, IntArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import Taper
from blocksar.constants import TURN
from blocksar.errors import InputError

Angle = TypeVar("Angle", float, FloatArray)

# rad; 3 micrometres at 30 km. The only tolerance, for yaws that were themselves computed from the beam's edge: they
# carry rounding errors (4e-16 at pi, 1e-14 at 100 rad, 1e-11 where coordinates are large) and still count as on it.
STILL = 1e-9  # rad: a beam that turns by less stands still
EDGE = 1e-10


# ---------------------------------------------------------------- angles


def wrapped(angle: Angle) -> Angle:
    """The same angle in [-pi, pi], rad; exactly the input where it lies there already."""
    return angle - TURN * np.rint(angle / TURN)


def turned_near(angle: Angle, centre: float) -> Angle:
    """The same angle within pi of `centre`, rad."""
    # Not centre + wrapped(angle - centre): plans depend on this rounding, and must repeat to the bit.
    return centre + np.mod(angle - centre + np.pi, TURN) - np.pi


def in_beam(yaw: FloatArray | float, azimuth: FloatArray | float, half_width: float) -> BoolArray:
    """Whether |wrapped(yaw - azimuth)| <= half_width, for numbers or arrays (broadcast), rad.

    `wrapped` is written out, so that numba compiles this function as it is.
    """
    away = yaw - azimuth
    return np.abs(away - TURN * np.rint(away / TURN)) <= half_width


def beam_at(collection: Collection, pulses: slice) -> tuple[FloatArray, float]:
    """Azimuth of the beam's centre at some pulses (n,), and half its width, rad, as `in_beam` takes them.

    Zeros and infinity where the beam is not steered.
    """
    azimuth = collection.beam_azimuth[pulses]
    if collection.beam_width is None:
        return np.zeros(azimuth.shape), np.inf
    return azimuth, collection.beam_width / 2


# ---------------------------------------------------------------- pulses that light a point


def is_lit(geometry: Geometry, x: FloatArray, y: FloatArray, pulses: slice = slice(None)) -> BoolArray:
    """Which pulses light ground points x, y (...), m: (..., n_pulse)."""
    return in_beam(geometry.yaw(x, y)[..., None], *beam_at(geometry.collection, pulses))


def lit_interval(geometry: Geometry, x: FloatArray, y: FloatArray) -> tuple[IntArray, IntArray]:
    """The pulses first <= p < last that light each ground point: exactly those of `is_lit`.

    The beam scans one way, so that a point's lit pulses are an interval.

    Parameters
    ----------
    geometry : Geometry
    x, y : (...) float
        m, scene frame; of one shape.

    Returns
    -------
    first, last : (...) int
        Both 0 where a point is never lit.

    Raises
    ------
    InputError
        If the beam scans so far round that a point could be lit twice.
    """
    collection = geometry.collection
    yaw = np.asarray(geometry.yaw(np.asarray(x, np.float64), np.asarray(y, np.float64)))
    if collection.beam_width is not None:
        beam, width = collection.beam_azimuth, collection.beam_width
        scan = abs(beam[-1] - beam[0])
        if scan + width >= TURN:
            raise InputError(
                f"beam_azimuth scans {scan:.4g} rad with a beam_width of {width:.4g} rad, all round: a target would "
                "be lit twice; cut the collection"
            )
    first, last = _lit_interval(collection, yaw.ravel(), tolerance=0.0)
    never = first == last
    first[never], last[never] = 0, 0
    return first.reshape(yaw.shape), last.reshape(yaw.shape)


def lit_pulses(collection: Collection, yaw: FloatArray, valid: FloatArray) -> FloatArray:
    """Number of valid pulses that light points at yaws (n,): sum of `valid` (n_pulse,) over the lit ones.

    `valid` is the fraction of each pulse's samples that is there; 0 for a missing pulse. Yaws on the edge of the beam
    but for rounding (`EDGE`) are lit.
    """
    total = np.concatenate([[0.0], np.cumsum(valid)])
    first, last = _lit_interval(collection, yaw, tolerance=EDGE)
    return np.asarray(total[last] - total[first])


def weighted_pulses(collection: Collection, yaw: FloatArray, valid: FloatArray, taper: Taper) -> FloatArray:
    """Sum of `valid` (n_pulse,) times the taper over the pulses that light points at yaws (n,); see `lit_pulses`."""
    if taper.uniform:
        return lit_pulses(collection, yaw, valid)
    if collection.beam_width is None:
        return np.full(yaw.shape, float((valid * taper.samples(collection.n_pulse)).sum()))
    first, last = _lit_interval(collection, yaw, tolerance=EDGE)
    beam, half = collection.beam_azimuth, collection.beam_width / 2
    centre = float(beam[0] + beam[-1]) / 2
    point, along = wrapped(yaw - centre) / half, (beam - centre) / half
    # Each cosine of the difference is a product of two phasors, so that one running sum serves all points.
    total, (terms, frequency) = np.zeros(yaw.shape), taper.series
    for k, term in enumerate(terms):
        running = np.concatenate([[0.0], np.cumsum(valid * np.exp(-1j * np.pi * frequency * k * along))])
        total += term * (np.exp(1j * np.pi * frequency * k * point) * (running[last] - running[first])).real
    return total


def beam_offset(geometry: Geometry, x: FloatArray, y: FloatArray, pulses: slice = slice(None)) -> FloatArray:
    """How far ground points x, y (...), m, lie from the centre of a steered beam, rad: (..., n_pulse)."""
    return wrapped(geometry.yaw(x, y)[..., None] - geometry.collection.beam_azimuth[pulses])


def most_lit_pulses(collection: Collection) -> int:
    """The largest number of pulses that light any one point."""
    return int(lit_pulses(collection, collection.beam_azimuth, np.ones(collection.n_pulse)).max())


def _lit_interval(collection: Collection, yaw: FloatArray, *, tolerance: float) -> tuple[IntArray, IntArray]:
    """first <= p < last of yaws (n,), found by bisection with the very inequality of `in_beam`; equal if never lit.

    `in_beam` wraps each difference; here the turns of all pulses are those of the sweep's middle, so that the
    differences fall (or rise) with the pulse throughout. Both give the same bits where the beam is near the point.
    """
    n = collection.n_pulse
    if collection.beam_width is None:
        return np.zeros(yaw.shape, np.int64), np.full(yaw.shape, n, np.int64)
    beam, half = collection.beam_azimuth, collection.beam_width / 2 + tolerance
    sign = 1.0 if beam[-1] >= beam[0] else -1.0
    turns = TURN * np.rint((yaw - (beam[0] + beam[-1]) / 2) / TURN)

    def ahead(points: IntArray, pulses: IntArray) -> FloatArray:
        return sign * ((yaw[points] - beam[pulses]) - turns[points])

    level = sign * (yaw - turns)
    reached = np.searchsorted(sign * beam, level - half, side="left")
    passed = np.searchsorted(sign * beam, level + half, side="right")
    first = _first_pulse(lambda points, pulses: ahead(points, pulses) <= half, reached, n)
    last = _first_pulse(lambda points, pulses: ahead(points, pulses) < -half, passed, n)
    return first, last


def _first_pulse(holds: Callable[[IntArray, IntArray], BoolArray], guess: IntArray, n: int) -> IntArray:
    """The first of n pulses from which on `holds(points, pulses)` is true, for every point; n if for none.

    `guess` (n_point,) is right but for rounding; only points for which it is wrong are bisected.
    """
    points = np.arange(guess.size)
    early = (guess > 0) & holds(points, np.maximum(guess - 1, 0))
    late = (guess < n) & ~holds(points, np.minimum(guess, n - 1))
    wrong = np.flatnonzero(early | late)
    low, high = np.zeros(wrong.size, np.int64), np.full(wrong.size, n, np.int64)
    while (low < high).any():
        middle = np.minimum((low + high) // 2, n - 1)
        true = holds(wrong, middle)
        low, high = np.where((low < high) & ~true, middle + 1, low), np.where((low < high) & true, middle, high)
    first = guess.astype(np.int64)
    first[wrong] = low
    return first


# ---------------------------------------------------------------- dwells


def aperture(collection: Collection) -> tuple[float, float]:
    """Start and end of the collection, s: a pulse stands for the half interval on either side of it."""
    half_pulse = collection.pulse_interval / 2
    return collection.time[0] - half_pulse, collection.time[-1] + half_pulse


def dwell(geometry: Geometry, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """First and last lit slow time of ground points x, y (...), m: see `dwell_at`."""
    return dwell_at(geometry, geometry.yaw(x, y))


def dwell_at(geometry: Geometry, yaw: FloatArray, *, uncut: bool = False) -> tuple[FloatArray, FloatArray]:
    """First and last lit slow time of points at yaws (...), rad: two arrays (...), s; start > end where never lit.

    With `uncut`, as if a scanning beam went on beyond the ends of the collection as it did on average.

    These are the times at which the edges of the beam, taken as a continuous function of time, pass the point. A pulse
    stands for the half interval on either side of it, so N lit pulses dwell for N intervals, give or take one.
    """
    collection = geometry.collection
    start, end = aperture(collection)
    yaw = np.asarray(yaw, dtype=np.float64)
    if collection.beam_width is None:
        return np.full(yaw.shape, start), np.full(yaw.shape, end)
    beam, time, half = collection.beam_azimuth, collection.time, collection.beam_width / 2
    if abs(beam[-1] - beam[0]) < STILL:
        lit = in_beam(yaw, beam[0], half + EDGE)
        return np.where(lit, start, np.inf), np.where(lit, end, -np.inf)
    yaw = turned_near(yaw, (beam[0] + beam[-1]) / 2)
    sign = 1.0 if beam[-1] > beam[0] else -1.0

    level = np.stack([yaw - sign * half, yaw + sign * half])
    inside = np.interp(sign * level, beam if sign > 0 else -beam, time)
    slope = (time[-1] - time[0]) / (beam[-1] - beam[0])
    first, last = inside + slope * (level - np.clip(level, min(beam[0], beam[-1]), max(beam[0], beam[-1])))
    return (first, last) if uncut else (np.maximum(first, start), np.minimum(last, end))


def has_full_dwell(geometry: Geometry, x: FloatArray | float, y: FloatArray | float) -> BoolArray:
    """Whether the whole beam sweeps over targets at x, y (...), m, to within one pulse; true if it is not steered.

    Where the beam stands still: whether it lights them.
    """
    collection = geometry.collection
    yaw = geometry.yaw(np.asarray(x), np.asarray(y))
    if collection.beam_width is None:
        return np.ones(yaw.shape, bool)
    beam = collection.beam_azimuth
    low, high = float(beam.min()), float(beam.max())
    if low == high:
        return in_beam(yaw, beam[0], collection.beam_width / 2 + EDGE)
    yaw = turned_near(yaw, (low + high) / 2)
    first, last = full_dwell_yaw(collection)
    pulse = (high - low) / (collection.n_pulse - 1)
    return np.asarray((first - pulse <= yaw) & (yaw <= last + pulse))


# ---------------------------------------------------------------- yaws


def lit_yaw(collection: Collection) -> tuple[float, float]:
    """First and last yaw that a steered beam ever lights, rad."""
    half = (collection.beam_width or 0.0) / 2
    return float(collection.beam_azimuth.min() - half), float(collection.beam_azimuth.max() + half)


def full_dwell_yaw(collection: Collection) -> tuple[float, float]:
    """First and last yaw that the whole of a steered beam sweeps over, rad.

    First > last where the beam turns by less than its width: targets between are then lit all the time.
    """
    half = (collection.beam_width or 0.0) / 2
    return float(collection.beam_azimuth.min() + half), float(collection.beam_azimuth.max() - half)
