"""The beam that dwell gates follow: that of a collection, or a steadier one where it wobbles.

Measured attitude and steering have waves and noise. The ends of dwells are then no smooth functions of range and
Doppler, which a gate could follow. Chains gate the dwells of a steadier beam instead, and what the true dwells have
besides, or lack, is back-projected (`focusing.dwell_edges`): exactly, but for the slopes of a taper, which lie where
the steadier beam has them. With dv by which v = 2 offset / beam_width then errs, this loses

    1 - coherence = mean of (w'(v) dv)^2 / (2 mean of w^2).

The steadier the beam, the fewer blocks are needed, and the more pulses are back-projected. The first of several is
taken of which a probe keeps the fidelity.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from blocksar import solvers
from blocksar.arrays import FloatArray
from blocksar.collection.beam import aperture, beam_offset, dwell_at
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.region import Region
from blocksar.collection.weighting import Taper

PER_DWELL = 1.0, 0.5, 0.25, 0.0  # intervals of splines that a beam may follow in a dwell; 0: a straight line
SHARE = 0.2  # of what the fidelity allows to be lost that a beam may take which gates do not follow
LOSS = 0.3  # of coherence, over the share of its width by which a beam is off: measured
LEAST = 2e-5  # of its width: a pulse in 25 000 at either end of a dwell
UNEVEN = 0.05  # of its width, by which a beam that does not wobble is off another that gates may follow
PROBED = 8  # blocks with which it is seen whether gates follow a beam
ALIKE = 1.1  # over the least excess: no difference
PLACES = 33  # yaws at which dwells are looked at
TAPER_NODES = 64


class Gated(NamedTuple):
    """The beam that dwell gates follow.

    Attributes
    ----------
    collection : Collection or None
        With this beam; None: the beam that there is.
    wobbles : bool
        Whether it is another one than there is.
    pulses : float
        That a dwell of either beam has and the other has not, on average.
    away : float
        Angle between the two beams, rad, on average over a dwell.
    taper_loss : float
        Of coherence, by a taper whose slopes follow the wrong beam.
    """

    collection: Collection | None = None
    wobbles: bool = False
    pulses: float = 0.0
    away: float = 0.0
    taper_loss: float = 0.0

    def over(self, geometry: Geometry) -> Geometry:
        """A geometry under this beam."""
        return geometry if self.collection is None else geometry.lit_by(self.collection)


def gated_beams(geometry: Geometry, region: Region, fidelity: float, taper: Taper) -> list[Gated]:
    """The beams that gates may follow, the true one first, then the steadier the later.

    A share e of its width by which a beam is off on average changes 2 e pulses of every one of a dwell. The true beam
    is left out where this is too much against the most pliant of the others; otherwise these are there only where it
    turns unevenly.
    """
    collection = geometry.collection
    if collection.beam_width is None or scans_evenly(collection):
        return [Gated()]
    yaw = np.linspace(region.yaw[0], region.yaw[-1], PLACES)
    near, far = region.at(yaw)
    first, last = dwell_at(geometry, yaw, (near + far) / 2, uncut=True)
    lit = np.flatnonzero(last > first)
    if not lit.size:
        return [Gated()]
    start, end = aperture(collection)
    dwell = min(float(np.median((last - first)[lit])), end - start)
    middle, n, width = lit[lit.size // 2], max(round(dwell * collection.prf), 1), collection.beam_width
    at = (near + far)[middle] / 2, yaw[middle]
    place = *geometry.ground_axes(*at), slice(None), geometry.level(*at)  # a terrain may not reach as far
    offset = beam_offset(geometry, *place)

    def follow(n_interval: int) -> Gated:
        steady = collection.steadied(n_interval)
        off = offset - beam_offset(geometry.lit_by(steady), *place)
        away, squared = (_most_over_dwells(each, n) for each in (np.abs(off), off**2))
        loss = 0.0 if taper.uniform else _taper_loss(taper, squared * (2 / width) ** 2)
        return Gated(steady, True, 2 * n * away / width, away, loss)

    intervals = sorted({math.ceil(each * (end - start) / dwell) for each in PER_DWELL})
    pliant, straight = follow(intervals[-1]), follow(intervals[0])
    least = width * max(SHARE * (1 - fidelity) / LOSS, LEAST)
    wobbles = pliant.away > least
    if not wobbles and straight.away <= UNEVEN * width:
        return [Gated()]
    others = [pliant, *(follow(n_interval) for n_interval in intervals[-2:0:-1]), straight]
    return [Gated()] * (not wobbles) + [each for each in others if each.away > least]


def scans_evenly(collection: Collection) -> bool:
    """Whether the yaw of a beam, and so a target's place in it, grows evenly with time; not about an axis."""
    return collection.unevenness <= LEAST * (collection.beam_width or 0.0)


def first_that(gates: Sequence[Gated], excess: Callable[[Gated], float]) -> Gated:
    """The first that keeps the fidelity, or else the steadiest of those that exceed it least."""
    if len(gates) == 1:
        return gates[0]
    found: list[float] = []
    for gated in gates:
        found.append(excess(gated))
        if found[-1] <= 1.0:
            return gated
    return next(gated for gated, each in zip(gates[::-1], found[::-1], strict=True) if each <= ALIKE * min(found))


def _most_over_dwells(values: FloatArray, n: int) -> float:
    """The largest mean of n values that follow each other."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    return float((total[n:] - total[:-n]).max() / n) if n < values.size else float(values.mean())


def _taper_loss(taper: Taper, squared: float) -> float:
    """Loss of coherence by a place v in the beam whose error has the mean square `squared`."""
    nodes, shares = solvers.gauss_legendre(TAPER_NODES)
    return float(squared * (shares * taper.slope(nodes) ** 2).sum() / (shares * taper(nodes) ** 2).sum() / 2)
