"""Predicted coherence of a block's image with exact back-projection, from traced lines.

On clutter every pulse holds the echoes of all that is lit, so a pixel of back-projection and of a processor's image are
two weighted sums over the same uncorrelated samples: their coherence is the normalised inner product of the weights.
Back-projection's weights are those of the pixel's echo over its lit pulses. A processor's differ in four ways, each of
which takes its loss, 1 - coherence (what the map from the ground misses is `block_ground.map_loss`):

    phase        the residual phase of the line over the dwell
    range        its range migration, as a phase across the band: sinc(2 B dr / c)
    dispersion   ends of the dwell that are smeared or displaced
    track        what the noise of the track leaves

The ends: steps in Doppler that delay by D(f) smear a sharp end of the dwell gate into a Fresnel integral of area D'
(less the mean of the block, with which the gate is made), and displace it where the gate's fit does not meet it. The
keystone scales time by 1 + f / fc, which displaces the ends at the band's edges. With F the smeared end and H the sharp
one displaced by d, the weights differ by the energy

    integral of |F(t) - H(t - d)|^2 dt = sqrt(a) h(d / sqrt(a)),    z = sqrt(2) d / sqrt(a),
    h = (z (C(z) + S(z)) + (cos(pi z^2 / 2) - sin(pi z^2 / 2)) / pi) / sqrt(2),

from |F - H|^2 integrated at d = 0 in frequency, sqrt(a / 2) / pi, and d/dd = 2 Re F(d) - 1. Half of it, over the dwell,
would be lost at each end if every pulse held all Dopplers. A plan predicts what is lost in the echoes that are there
(`dwell_ends`), times CHIPS, by which single chips lose more than their mean.

A keystone also moves the slopes of a taper, by (t - m) f / fc about its time m, and a chain without one by fd f / (fc
rate) (`band_moves`). The weights of a range frequency differ by dw/dt times that, and half the mean of its square is
lost, over the mean of w^2.

On a terrain heights displace both ends of a dwell to the same side. What the gate lets in beyond the one is no echo, as
what has the pixel's Doppler there has left the beam. Only what it cuts off at the other is lost: half of the sum. Both
count where echoes lie on either side of an end: of sub-apertures, which the whole beam lights beyond their dwells.

Under a weighting w both sums have the weights w besides, and under an antenna's pattern g the echo has g: the inner
product along the dwell has (w g)^2; at an end the pattern counts for each echo where this is in the beam. Means over
the band have the square of its weighting.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np

from blocksar import solvers
from blocksar.arrays import BoolArray, FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import FLAT, Taper
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.focusing.dwell_gate import DwellGate
from blocksar.focusing.lines import LEAST_STRETCH, Focus, Line
from blocksar.kernels.fresnel import FAR, far_fresnel_integral
from blocksar.planning.dwell_ends import ImageEdges, dwell_ends, end_smear, lift_energy, lit_energy
from blocksar.planning.dwell_weights import DwellWeights
from blocksar.planning.steadiness import scans_evenly
from blocksar.planning.target_lines import TracedTargets

ONE_SIDE = 0.5  # of the energy of both ends of a dwell that are displaced to the same side
BAND_NODES = 4  # of the means over range frequency
MIGRATION_NODES = 12  # of that over the phase by range migration, under a weighting
CHIPS = 1.6  # what the worst chips of an image lose at whole ends, over the mean: 1.1 to 1.6 measured
KNOTS = 128  # of the table of the energy of an end, per unit of z
KNOT_NODES = 6  # of the integrals from one of them to the next


class Losses(NamedTuple):
    """Losses of coherence of a target, by cause."""

    phase: float
    range: float
    dispersion: float
    track: float


def worst_losses(
    targets: TracedTargets,
    gate: DwellGate | None,
    *,
    track_phase: float,
    full: BoolArray,
    reached: BoolArray | None = None,
    band: Taper = FLAT,
    edges: Sequence[ImageEdges] = (),
) -> Losses:
    """Losses of the target with full dwell that loses most; on a terrain, of those that are there, if any of them is.

    Parameters
    ----------
    targets : TracedTargets
    gate : DwellGate or None
        None where the sum over time is that over the pulses.
    track_phase : float
        Root mean square phase that the noise of the track leaves, rad.
    full : (n_range, n_yaw) bool
        From `full_dwells`.
    reached : (n_range, n_yaw) bool, optional
        On a terrain, which of the targets there are; default: all.
    band : Taper
        Weighting along range frequency.
    edges : sequence of ImageEdges
    """
    phase, migration = _along_dwell(targets, band)
    ends = np.zeros_like(phase) if gate is None else _gated(targets, gate, reached=reached, band=band)
    for edge in edges:
        phase, migration, ends = (edge.at(each) for each in (phase, migration, ends))
        full = full | edge.before | edge.behind
    lost = phase + migration + ends
    total = np.where(full if reached is None or not (full & reached).any() else full & reached, lost, -1.0)
    worst = np.unravel_index(int(np.argmax(total)), total.shape)
    return Losses(
        float(phase[worst]), float(migration[worst]), float(ends[worst]), 1 - float(np.exp(-(track_phase**2) / 2))
    )


def _along_dwell(targets: TracedTargets, band: Taper) -> tuple[FloatArray, FloatArray]:
    """Loss by residual phase, and what range migration takes besides."""
    spots, weights = targets.spots, targets.weights
    line = targets.line.weighed(weights.nodes**2)
    stretch = np.maximum(line.stretch, LEAST_STRETCH)
    level = line.phase - spots.doppler[..., None] * line.time - spots.phase[..., None]
    offset = line.range - spots.range[..., None]
    turns = 2 * targets.geometry.collection.bandwidth / SPEED_OF_LIGHT * offset
    if band.uniform:
        response = np.sinc(turns)
    else:
        nodes, shares = band_nodes(band, MIGRATION_NODES)
        response = sum(share * np.cos(np.pi * node * turns) for node, share in zip(nodes, shares, strict=True))
    turned = np.sqrt(stretch) * np.exp(2j * np.pi * level)
    whole = line.weight.sum(axis=-1)
    norm = np.sqrt(whole * (line.weight * np.abs(turned) ** 2).sum(axis=-1))
    phase = 1 - np.abs((line.weight * turned).sum(axis=-1)) / norm
    both = 1 - np.abs((line.weight * turned * response).sum(axis=-1)) / norm
    return phase, np.maximum(both - phase, 0.0)


def _gated(targets: TracedTargets, gate: DwellGate, *, reached: BoolArray | None, band: Taper) -> FloatArray:
    """Loss by the gate: ends of dwells, and slopes of weights that it does not follow."""
    line, weights, collection = targets.line, targets.weights, targets.geometry.collection
    whole = collection.lit_widths == 1  # echoes lie to one side of the ends: no dwell is a part of the beam's own
    by_lit = whole and (reached is None or weights.pattern is not None)
    lost = _at_ends(targets, gate, by_lit=by_lit, band=band)
    lost *= line.weight.sum(axis=-1)
    if whole and not by_lit:
        lost *= ONE_SIDE
    lost += slope_loss(collection, band) * (line.weight * np.square(weights.change)).sum(axis=-1)
    lost /= line.weighed(weights.nodes**2).weight.sum(axis=-1)
    fitting = scans_evenly(collection) and reached is None
    if gate.taper is not None and not gate.taper.taper.uniform and not fitting:
        lost += _by_place(line, targets.spots, gate, weights)
    return lost


def _by_place(line: Line, spots: Focus, gate: DwellGate, weights: DwellWeights) -> FloatArray:
    """Loss by windows that take a target's place in the beam as a function of time that does not fit the target.

    Under a beam about its axis a simple one, made for a few lengths of each half of the dwells and blended; on a
    terrain that of the smooth ground, from which heights move dwells.
    """
    assert gate.taper is not None
    made = np.ones(line.time.shape)
    for half, share, length in gate.halves(spots.range, spots.doppler, line.time):
        made *= half.blended(gate.taper.taper, share * length, length)
    wanted, found = weights.nodes, made * weights.nodes / weights.alone
    power = (line.weight * wanted**2).sum(axis=-1) * (line.weight * found**2).sum(axis=-1)
    # Under a taper to zero targets that are hardly lit weigh nothing at all.
    return 1 - np.abs((line.weight * wanted * found).sum(axis=-1)) / np.sqrt(np.where(power > 0, power, np.inf))


def _at_ends(targets: TracedTargets, gate: DwellGate, *, by_lit: bool, band: Taper) -> FloatArray:
    """Loss by ends of the dwell that are smeared or displaced; none at an end that the collection's end cuts."""
    line, spots, weights, collection = targets.line, targets.spots, targets.weights, targets.geometry.collection
    lit = line.weight.sum(axis=-1)
    lost = np.zeros(lit.shape)
    edge_of_band = collection.bandwidth / 2 / collection.carrier
    smear = end_smear(line, targets.rate)
    for end, phase, slope in ((0, gate.begin, gate.begin_slope), (-1, gate.end, gate.end_slope)):
        side = -1 if end == 0 else 1
        _, at, pace = (v[..., 0] for v in phase.evaluate(spots.range, spots.doppler[..., None]))
        left = smear[..., end] - (slope.coefficients(spots.range)[..., 0] - pace)
        displaced = (at + side * gate.length / 2 - targets.ends[end]) / line.stretch[..., end]
        spread = targets.moved(end) * edge_of_band
        if by_lit:
            total = lit_energy(
                left, displaced, spread, blur=gate.blur, pulse_interval=collection.pulse_interval,
                lit_band=weights.lit_band, band=band_nodes(band, BAND_NODES), gain=weights.gains(side),
            )  # fmt: skip
            total = (total + lift_energy(gate.blur, gate.lift)) * CHIPS * weights.end**2 * weights.level(side)
        else:
            total = blurred_energy(left, displaced, spread, gate.blur, collection.pulse_interval, band)
            total = (total + lift_energy(gate.blur, gate.lift)) * np.square(weights.edge)
        lost += np.where(targets.cut[..., end], 0.0, total)
    return lost / (2 * lit)


def slope_loss(collection: Collection, band: Taper) -> float:
    """Loss by a change of weights whose square is that of the weights, per relative range frequency."""
    nodes, shares = band_nodes(band, BAND_NODES)
    return float((shares * nodes**2).sum() * (collection.bandwidth / 2 / collection.carrier) ** 2 / 2)


def smear_loss(line: Line, spots: Focus, rate: FloatArray, geometry: Geometry, full: BoolArray) -> float:
    """The most that any of these lines loses at its ends, under the gate that suits them best.

    An estimate from few lines (n_range, n_yaw, n), without a gate: the slopes of the ends along Doppler are differences
    between neighbouring yaws, and only the keystone displaces them. `full` (n_range, n_yaw) is from `full_dwells`.
    """
    collection = geometry.collection
    lit = np.broadcast_to(line.weight, line.time.shape).sum(axis=-1)
    inner = full.copy()
    inner[:, 1:-1] &= full[:, :-2] & full[:, 2:]  # both neighbours, for the differences
    full = inner if inner.any() else full if full.any() else np.ones_like(full)  # of a few of the ranges none may be
    spread = lit / 2 * collection.bandwidth / 2 / collection.carrier  # by the keystone, at the band's edges
    lost = np.zeros(lit.shape)
    *moves, apart = np.gradient(np.stack([*dwell_ends(line), spots.doppler]), axis=2)
    for smear, move in zip(np.moveaxis(end_smear(line, rate), -1, 0), moves, strict=True):
        slope = smear + move / apart
        low = np.min(slope, axis=1, where=full, initial=np.inf)
        high = np.max(slope, axis=1, where=full, initial=-np.inf)
        none = ~full.any(axis=1)
        low[none], high[none] = 0.0, 0.0
        middle = (low + high)[:, None] / 2
        lost += blurred_energy(slope - middle, np.zeros(1), spread, spread, collection.pulse_interval) / (2 * lit)
    return float(lost[full].max())


def blurred_energy(
    area: FloatArray,
    displaced: FloatArray,
    spread: FloatArray,
    blur: FloatArray | float,
    pulse_interval: float,
    taper: Taper = FLAT,
) -> FloatArray:
    """Mean energy by which smeared ends, spread by +-`spread` over the band, differ from their gate, s.

    The gate is the mean of sharp ends spread by +-`blur`; the energy by which it differs from an end is the mean of the
    energies by which those do, less their own variance, blur / 3.
    """
    nodes, weights = solvers.gauss_legendre(BAND_NODES)
    _, shares = band_nodes(taper, BAND_NODES)
    shape = np.broadcast_shapes(area.shape, displaced.shape, spread.shape)
    band = nodes.reshape(-1, 1, *(1,) * len(shape))
    gate = band.swapaxes(0, 1)
    apart = np.hypot(displaced - band * spread - gate * blur, pulse_interval / np.sqrt(12))
    total = np.einsum("i,j,ij...->...", 2 * shares, weights, end_energy(area, apart)) / 4
    return np.maximum(total - blur / 3, 0.0)


def band_nodes(taper: Taper, n: int) -> tuple[FloatArray, FloatArray]:
    """Nodes over the band, -1 .. 1, and their shares in a mean under the square of the weighting."""
    nodes, weights = solvers.gauss_legendre(n)
    if taper.uniform:
        return nodes, weights / 2
    shares = weights * taper(nodes) ** 2
    return nodes, shares / shares.sum()


def end_energy(area: FloatArray, displaced: FloatArray) -> FloatArray:
    """Energy by which a smeared and displaced end differs from a sharp one, s; area, s^2; displacement, s."""
    size = np.sqrt(np.maximum(np.abs(area), 1e-18))
    z = np.sqrt(2) * np.abs(displaced) / size
    far = ~(z <= FAR)  # and where it is not a number
    energy = _near_energy(np.where(far, 0.0, z))
    beyond = far_fresnel_integral(z[far])
    energy[far] = beyond.real + beyond.imag
    return np.asarray(size * energy / np.sqrt(2))


def _near_energy(z: FloatArray) -> FloatArray:
    """E = z (C(z) + S(z)) + (cos(pi z^2 / 2) - sin(pi z^2 / 2)) / pi for z in 0 .. FAR, to 1e-11.

    Between the knots of a table the quintic with the values, slopes and curvatures of both. This avoids
    `scipy.special`, which takes longer to import than a plan to make.
    """
    table = _energy_table()
    low = np.minimum((z * KNOTS).astype(np.intp), table.shape[1] - 2)
    value, slope, bend, other_value, other_slope, other_bend = *table[:, low], *table[:, low + 1]
    u, step = z * KNOTS - low, other_value - value
    a = 10 * step - 6 * slope - 4 * other_slope - 1.5 * bend + 0.5 * other_bend
    b = -15 * step + 8 * slope + 7 * other_slope + 1.5 * bend - other_bend
    c = 6 * step - 3 * (slope + other_slope) - 0.5 * (bend - other_bend)
    return np.asarray(value + u * (slope + u * (bend / 2 + u * (a + u * (b + u * c)))))


@cache
def _energy_table() -> FloatArray:
    """E, E' / KNOTS and E'' / KNOTS^2 at 0, 1 / KNOTS .. FAR, (3, n) float: E'' = cos + sin of pi z^2 / 2, integrated.

    E(0) = 1 / pi and E'(0) = 0.
    """
    nodes, weights = solvers.gauss_legendre(KNOT_NODES)
    knots = np.arange(int(FAR * KNOTS) + 1) / KNOTS
    at = (1 + nodes) / 2  # of the way from a knot to the next
    bends = _bend(knots[:-1, None] + at / KNOTS) * weights / 2 / KNOTS**2
    slope = np.concatenate([[0.0], np.cumsum(bends.sum(axis=1))])
    value = 1 / np.pi + np.concatenate([[0.0], np.cumsum(slope[:-1] + (bends * (1 - at)).sum(axis=1))])
    return np.stack([value, slope, _bend(knots) / KNOTS**2])


def _bend(z: FloatArray) -> FloatArray:
    quarter = np.pi / 2 * z**2
    return np.cos(quarter) + np.sin(quarter)
