"""Beams that dwell gates can follow, smoothed where their pointing jitters.

Measured attitude and steering have waves and noise. The ends of dwells are then no smooth functions of range and
Doppler, which a gate could follow. Chains gate the dwells of a smoothed beam instead, a spline of one
interval a dwell. One that is off by a share e of
its width changes 2 e pulses of a dwell, and loses LOSS e of coherence; under a taper besides, with the error dv of the
place v = 2 offset / beam_width,

    1 - coherence = mean of (w'(v) dv)^2 / (2 mean of w^2).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from blocksar import solvers
from blocksar.arrays import FloatArray
from blocksar.collection.beam import aperture
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.region import Region
from blocksar.collection.weighting import NODES, Taper

SHARE = 0.2  # of what the fidelity allows to be lost, that a minor cause may take: a beam that gates do not follow
LOSS = 0.3  # of coherence, over the share of its width by which a beam is off: measured
LEAST = 2e-5  # of its width: a pulse in 25 000 at either end of a dwell
PLACES = 33  # along either side of ground, at which dwells are looked at


class Smoothed(NamedTuple):
    """The beam that dwell gates follow.

    Attributes
    ----------
    geometry : Geometry
        Under it.
    away : float
        Angle between it and the beam as it is, rad, on average over a dwell; 0: it is that.
    loss : float
        Of coherence.
    """

    geometry: Geometry
    away: float = 0.0
    loss: float = 0.0


def smoothed_beam(geometry: Geometry, region: Region, fidelity: float, taper: Taper) -> Smoothed:
    """Return the beam for gates: the given one, or a smoothed one if it jitters by more than a fidelity allows."""
    collection = geometry.collection
    if collection.beam_width is None or scans_evenly(collection):
        return Smoothed(geometry)
    yaw = np.linspace(region.yaw[0], region.yaw[-1], PLACES)
    near, far = region.at(yaw)
    first, last = geometry.beam.dwell_at(yaw, (near + far) / 2, uncut=True)
    lit = np.flatnonzero(last > first)
    if not lit.size:
        return Smoothed(geometry)
    start, end = aperture(collection)
    dwell = min(float(np.median((last - first)[lit])), end - start)
    middle, n, width = lit[lit.size // 2], max(round(dwell * collection.prf), 1), collection.beam_width
    at = (near + far)[middle] / 2, yaw[middle]
    place = *geometry.ground_axes(*at), slice(None), geometry.level(*at)  # a terrain may not reach as far
    smooth = geometry.lit_by(collection.steadied(math.ceil((end - start) / dwell)))
    off = geometry.beam.offset(*place) - smooth.beam.offset(*place)
    away, squared = (_most_over_dwells(each, n) for each in (np.abs(off), off**2))
    if away <= width * max(SHARE * (1 - fidelity) / LOSS, LEAST):
        return Smoothed(geometry)
    slopes = 0.0 if taper.uniform else _taper_loss(taper, squared * (2 / width) ** 2)
    return Smoothed(smooth, away, LOSS * away / width + slopes)


def scans_evenly(collection: Collection) -> bool:
    """Tell whether the yaw of a beam grows evenly with time; False for a beam about its axis."""
    return collection.unevenness <= LEAST * (collection.beam_width or 0.0)


def _most_over_dwells(values: FloatArray, n: int) -> float:
    """Largest mean of n consecutive values."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    return float((total[n:] - total[:-n]).max() / n) if n < values.size else float(values.mean())


def _taper_loss(taper: Taper, squared: float) -> float:
    """Loss of coherence by errors of the place v in the beam with mean square `squared`, under a taper."""
    nodes, shares = solvers.gauss_legendre(NODES)
    return float(squared * (shares * taper.slope(nodes) ** 2).sum() / (shares * taper(nodes) ** 2).sum() / 2)
