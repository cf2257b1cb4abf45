"""Whether the edges of dwells are summed pulse by pulse, and how many pulses of them (`focusing.dwell_edges`).

A chain ends a dwell at any time, back-projection at a whole pulse; and where a keystone scales time, the ends move over
the band. What that costs does not depend on the division, so no number of blocks helps: with the weight w g at the
ends, and the energy E by which the chain's end differs from back-projection's (`fidelity.blurred_energy`),

    1 - coherence = E (w g)^2 at the ends / (dwell * mean of (w g)^2).

Where this exceeds what the fidelity allows, or what windows change in the side lobes does (`end_windows`), edges are
faded in the chain and back-projected. What the keystone then costs, by the ends that fade out and by the slopes of a
taper, shrinks with the parts of the gate over the band (`focusing.dwell_gate`): the fewest are taken that leave half of
the allowed loss to other causes.
"""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import numpy as np

from blocksar import solvers
from blocksar.arrays import FloatArray
from blocksar.budget import side_lobe_budget
from blocksar.collection.beam import aperture, dwell_at
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.region import Region
from blocksar.collection.weighting import Weighting
from blocksar.focusing.dwell_taper import faded_taper
from blocksar.planning.dwell_weights import beam_moves, taper_over_dwells
from blocksar.planning.end_windows import at_ends, end_lift, gate_blur
from blocksar.planning.fidelity import blurred_energy, faded_energy, slope_loss, whole_pulse_energy
from blocksar.planning.lobes import responses, side_lobe

LEAST_PULSES = 8  # over which an end fades: with fewer its spectrum reaches the Doppler of other targets
PER_MOVE = 6.0  # the time in which an end fades, at least: over that by which it moves at the edge of the band
PER_SMEAR = 0.25  # and over sqrt(e)
LEAST_FADE = 2  # an edge is at most a quarter of a dwell
PLACES = 33  # yaws at which dwells are looked at
BEAM_NODES = 64  # of the mean over the beam
MOST_PARTS = 3  # of a gate over the band
PARTS_SHARE = 0.5  # of the allowed loss that the keystone may take before the gate is divided


class Edges(NamedTuple):
    """How dwells are gated.

    Attributes
    ----------
    fade : int
        n of `focusing.dwell_edges`: half a dwell over one of its edges; 0 where whole dwells keep the fidelity.
    parts : int
        Of the gate over the band.
    """

    fade: int = 0
    parts: int = 1


def plan_edges(
    geometry: Geometry,
    region: Region,
    *,
    fidelity: float,
    weighting: Weighting,
    band: float,
    keystone: bool,
    times: float = 0.0,
) -> Edges:
    """Whether edges of dwells are back-projected, and of how many parts the gate is.

    They are where the best gate does not keep the fidelity, or where a plan has shown that they are needed: `times` as
    long as they are at least (`planning.edge_search`). Under a beam about its axis on a terrain the plan alone tells:
    what the best gate loses is mostly that back-projection ends dwells at whole pulses, which in a satellite's burst
    moves the peaks of back-projection itself by 0.06 m rms, three times as far as whole dwells of a chain do.

    `band` is the Doppler band that is lit at a time, Hz. In the time of a dwell the beam passes over all of it: ends of
    dwells move along Doppler by e = dwell / band, and the steps of a chain smear them over a share of sqrt(e).
    """
    collection = geometry.collection
    if not beam_moves(collection):
        return Edges()
    yaw = np.linspace(region.yaw[0], region.yaw[-1], PLACES)
    near, far = region.at(yaw)
    first, last = dwell_at(geometry, yaw, (near + far) / 2, uncut=True)
    start, end = aperture(collection)
    ended = (last > first) & ((first > start) | (last < end))
    if not ended.any():
        return Edges()
    dwell = float(np.median((last - first)[ended]))
    moved = dwell / 2 * collection.bandwidth / (2 * collection.carrier) if keystone else 0.0
    fade, planned_first = 0, collection.has_axis and geometry.terrain is not None
    needed = edge_loss(collection, weighting, dwell, moved, band * collection.lit_widths) > 1 - fidelity
    needed = needed or _move_side_lobes(collection, weighting, dwell, moved, fidelity=fidelity, slopes=False)
    if times or (not planned_first and needed):
        smeared = math.sqrt(dwell / max(band, 1 / dwell))
        pulses = max(LEAST_PULSES, math.ceil(max(PER_MOVE * moved, PER_SMEAR * smeared) * collection.prf))
        fade = max(int(dwell * collection.prf / 2 / (max(times, 1.0) * pulses)), LEAST_FADE)
    most = PARTS_SHARE * (1 - fidelity)
    least = 2 if _move_side_lobes(collection, weighting, dwell, moved, fidelity=fidelity, fade=fade) else 1
    return Edges(fade, _plan_parts(collection, weighting, dwell, moved, fade=fade, most=most, least=least))


def _plan_parts(
    collection: Collection, weighting: Weighting, dwell: float, moved: float, *, fade: int, most: float, least: int
) -> int:
    """The fewest parts over the band, from `least` on, with which the keystone costs at most `most`."""
    if not moved:
        return 1
    none, weights = np.zeros(1), _beam_weights(collection, weighting)
    for parts in range(least, MOST_PARTS):
        lost = slope_loss(collection, weighting.range) * weights.change if parts == 1 else 0.0
        if fade:
            energy = faded_energy(none, none, np.array([moved]), dwell / (2 * fade), weighting.range, parts=parts)
            lost += float(energy[0]) * weights.ends / dwell
        if lost <= most:
            return parts
    return MOST_PARTS


def edge_loss(collection: Collection, weighting: Weighting, dwell: float, moved: float, band: float) -> float:
    """Loss of coherence at the ends of a dwell (s) that move over the band by +-`moved`, s, under the best gate.

    `band` is that of `plan_edges`.
    """
    interval, none = collection.pulse_interval, np.zeros(1)
    blur = gate_blur(collection, moved)
    energy = float(blurred_energy(none, none, np.array([moved]), blur, interval, weighting.range)[0])
    weights = _beam_weights(collection, weighting)
    beyond = max(weights.pulse * min(band * interval, 1.0) - weights.ends, 0.0)
    return (energy * weights.ends + whole_pulse_energy(interval) * beyond) / dwell


def _move_side_lobes(
    collection: Collection, weighting: Weighting, dwell: float, moved: float, *, fidelity: float, fade: int = 0,
    slopes: bool = True,
) -> bool:  # fmt: skip
    """Whether a keystone changes the highest side lobe by more than the fidelity allows, with one gate over the band.

    It does so by windows at the ends of whole dwells (`end_windows`) and by slopes. In the time that it has scaled by
    a = 1 + f / fc back-projection weighs echoes by w(v / a) / a, a chain by w(v): this lacks the mean of that over the
    band, as at a = 1 +- B / (2 sqrt(3) fc), less w(v). Of ends that fade out, w is the faded weighting.
    """
    if not moved:
        return False
    v, gain = _over_beam(collection)
    taper = taper_over_dwells(collection, weighting)
    time, shares = dwell / 2 * v, np.append(solvers.gauss_legendre(BEAM_NODES)[1], [0.0, 0.0]) * gain * dwell / 2
    found = [(time, shares * taper(v))]
    if slopes:
        a = 1 + np.array([[-1.0], [1.0]]) * collection.bandwidth / (2 * math.sqrt(3) * collection.carrier)
        weight = partial(faded_taper, taper, fade=fade) if fade else taper
        found.append((time, shares * (weight(v) - (weight(v / a) / a).mean(axis=0))))
    if not fade:
        blur = gate_blur(collection, moved)
        ends = taper(v[-2:]) * gain[-2:]
        found.append(at_ends(blur, end_lift(blur, moved, weighting.range), time[-2:], ends))
    time, made = (np.concatenate(each) for each in zip(*found, strict=True))
    ideal = np.append(found[0][1], np.zeros(made.size - v.size))
    changed, unchanged = map(side_lobe, responses(time, made, ideal))
    return abs(changed - unchanged) > side_lobe_budget(fidelity, unchanged)


class _BeamWeights(NamedTuple):
    """Squares over the beam, divided by the mean of (w g)^2."""

    ends: float  # (w g)^2 at the ends
    change: float  # mean of (v dw/dv g)^2
    pulse: float  # w^2 at the ends times the mean of g^2, if a pulse's echoes filled the PRF


def _beam_weights(collection: Collection, weighting: Weighting) -> _BeamWeights:
    _, shares = solvers.gauss_legendre(BEAM_NODES)
    taper = taper_over_dwells(collection, weighting)
    v, gain = _over_beam(collection)
    squared, changed = (taper(v) * gain) ** 2, (taper.slope(v) * v * gain) ** 2
    mean, lit = (shares * squared[:-2]).sum(), (shares * gain[:-2] ** 2).sum()
    return _BeamWeights(
        ends=float(squared[-2:].mean() * 2 / mean), change=float((shares * changed[:-2]).sum() / mean),
        pulse=float(taper(np.array(1.0))) ** 2 * float(lit / mean),
    )  # fmt: skip


def _over_beam(collection: Collection) -> tuple[FloatArray, FloatArray]:
    """Places in the beam (n,), the nodes of a quadrature and then both ends, and the antenna's pattern there."""
    v = np.concatenate([solvers.gauss_legendre(BEAM_NODES)[0], [-1.0, 1.0]])
    if collection.beam_offset is None or collection.beam_pattern is None:
        return v, np.ones(v.size)
    return v, np.interp(v * (collection.beam_width or 0.0) / 2, collection.beam_offset, collection.beam_pattern)
