"""Predicted quality of a block from its traced lines: residual phase, side lobes, width and range migration.

Side lobes and width of a sampled response along azimuth.

The response of a target to a weighting is not quite the spectrum of the weights over its dwell. At a pixel beside the
target, whose Doppler differs by f, back-projection sums otherwise in two ways (`measurement.figures`):

- The beam passes the pixel by s = f dt/df later. Of the pixel's dwell the last s finds no echo of the target, or the
  first -s where s < 0. In the pixel's own time the sum lacks what lies there. If the end of the collection cuts the
  dwells, it cuts both at once: an end then gains by -s what it loses by s.
- At a time t from the middle of the dwell the target's range differs from the pixel's by c f t / (2 fc). So the sum
  over the band counts W^(B / fc f t), with W^ the response of the weighting over the band B.

Side lobes of -35 dB change by the first from -35.2 to -33.4 dB where the beam steps on by 0.8 % of a dwell from one
resolution cell to the next, and by the second by -0.9 dB over a band of 20 %. A chain does both: its windows are those
of the pixel. They rise over the `blur` of the gate, which is not counted: where s is no longer than that, a chain loses
less (-35.0 dB measured under a scan at 15 GHz, where back-projection has -34.8 dB). Without a weighting neither is
counted.

Predicted coherence of a block's image with exact back-projection, from traced lines.

On clutter every pulse holds the echoes of all that is lit, so a pixel of back-projection and of a processor's image are
two weighted sums over the same uncorrelated samples: their coherence is the normalised inner product of the weights.
Back-projection's weights are those of the pixel's echo over its lit pulses. A processor's differ in four ways, each of
which takes its loss, 1 - coherence (what the map from the ground misses is `block.map_loss`):

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

from collections.abc import Callable, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np

from blocksar import solvers
from blocksar.arrays import BoolArray, Complex128Array, ComplexArray, FloatArray
from blocksar.budget import side_lobe_budget
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import TRACK_ACCURACY, Geometry
from blocksar.collection.weighting import FLAT, Taper
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.focusing.dwell_gate import DwellGate
from blocksar.focusing.lines import LEAST_STRETCH, Focus, Line
from blocksar.kernels.fresnel import FAR, far_fresnel_integral
from blocksar.planning.dwell_ends import (
    ImageEdges,
    at_ends,
    dwell_ends,
    end_smear,
    full_dwells,
    lift_energy,
    lit_energy,
)
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
    lost = _between_ends(targets, gate, by_lit=by_lit, band=band)
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


def _between_ends(targets: TracedTargets, gate: DwellGate, *, by_lit: bool, band: Taper) -> FloatArray:
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


LOBES = 5.0  # widths 1 / dwell on either side of the peak: within are the highest side lobes of all weightings
SAMPLES = 501
MOST_LATER = 0.25  # of a dwell, of which as much is taken to have the weight of its end
STEPS = 128  # of the table of W^, per unit: linear between them to 1e-5


class Beside(NamedTuple):
    """How pixels beside a target sum its echo, other than the target's own."""

    band: Taper  # the weighting over the band
    relative: float  # B / fc
    pace: FloatArray  # (2,) dt/df of the begin and the end of dwells, s/Hz
    cut: BoolArray  # (2,) whether the collection cuts them

    def factors(self, offsets: FloatArray, time: FloatArray) -> Complex128Array:
        """Of the weights at times (n,), at frequencies (m,): (m, n).

        Weights of the last two are those at the begin and the end of the dwell, 1 / s of the others.
        """
        f = offsets[:, None]
        most = MOST_LATER * (time[-1] - time[-2])
        later = np.clip(f * self.pace, -most, most)
        lost = np.where(self.cut, later, later.clip([-np.inf, 0.0], [0.0, np.inf]))  # at the begin of the wrong sign
        factors = self._over_band(f * (time - time[-2:].mean())).astype(np.complex128)
        factors[:, -2:] *= lost * [1.0, -1.0] * np.exp(1j * np.pi * f * later)  # from the middle of what is lost
        return factors

    def _over_band(self, turns: FloatArray) -> FloatArray:
        u = np.abs(self.relative * turns)
        known = np.arange(int(u.max() * STEPS) + 2) / STEPS
        return np.interp(u, known, self.band.response(known))


def responses(time: FloatArray, *weights: FloatArray | ComplexArray, beside: Beside | None = None) -> list[FloatArray]:
    """Magnitudes (SAMPLES,) of the sums of `weights` (n,) at times (n,), s, over frequencies about zero.

    With `beside`, the last two of them are those at the ends of a dwell: see `Beside.factors`.
    """
    offsets = np.linspace(-LOBES, LOBES, SAMPLES) / _extent(time)
    waves = np.exp(-2j * np.pi * offsets[:, None] * time)
    if beside is not None:
        waves = waves * beside.factors(offsets, time)
    return [np.abs((waves * weight).sum(axis=1)) for weight in weights]


def side_lobe(response: FloatArray) -> float:
    """Highest side lobe over the peak, dB."""
    return _beyond(response, *_main_lobe(response))


def side_lobe_as_in(ideal: FloatArray, response: FloatArray) -> float:
    """`side_lobe` of a response close to an ideal one, to be compared with that of this.

    Under a part of a weighting, side lobes may be shoulders of the main lobe, which count where the slightest change
    makes a minimum before them. Of the side lobes beyond the response's own main lobe, and beyond that of the ideal
    one, it is those that differ less.
    """
    sides = side_lobe(response), _beyond(response, *_main_lobe(ideal))
    return min(sides, key=lambda side: abs(side - side_lobe(ideal)))


def _main_lobe(response: FloatArray) -> tuple[int, int]:
    """The first minima on either side of the peak."""
    left = right = int(np.argmax(response))
    while left > 0 and response[left - 1] < response[left]:
        left -= 1
    while right < response.size - 1 and response[right + 1] < response[right]:
        right += 1
    return left, right


def _beyond(response: FloatArray, left: int, right: int) -> float:
    side = max(response[:left].max(initial=0.0), response[right + 1 :].max(initial=0.0))
    return float(20 * np.log10(max(side, 1e-12) / response.max()))


def lobe_width(response: FloatArray, time: FloatArray) -> float:
    """Distance between the outermost crossings of 3 dB below the peak, Hz, of a response over those times."""
    above = np.concatenate([[-1.0], response / response.max() - np.sqrt(0.5), [-1.0]])
    first, last = np.flatnonzero(above >= 0)[[0, -1]]
    left, right = above[first] - above[first - 1], above[last] - above[last + 1]
    samples = float(last - first + above[first] / left + above[last] / right)
    return samples * 2 * LOBES / (SAMPLES - 1) / _extent(time)


def _extent(time: FloatArray) -> float:
    return max(float(np.ptp(time)), 1e-9)


class Prediction(NamedTuple):
    """Predicted quality of a block: the worst figures of its targets."""

    residual_phase: float  # rad, largest over the dwell
    quadratic_phase: float  # rad, its quadratic part at the dwell's edge
    pslr: float  # dB, azimuth
    width: float  # azimuth width over the limit that the dwell sets
    migration: float  # range resolution cells over the dwell
    resolution: float  # azimuth, m
    track_phase: float  # rad, root mean square: what the noise of the track leaves
    coherence: float  # with exact back-projection: 1 less the four losses of the target that loses most, or 0
    phase_loss: float
    range_loss: float
    dispersion_loss: float
    track_loss: float
    ideal_pslr: float  # dB, in exact back-projection

    def less(self, of_dwells: float, of_range: float) -> Prediction:
        """Copy where dwells lose some more coherence, and what a division by range mends."""
        if not of_dwells + of_range:
            return self
        return self._replace(
            coherence=max(self.coherence - of_dwells - of_range, 0.0),
            dispersion_loss=self.dispersion_loss + of_dwells,
            range_loss=self.range_loss + of_range,
        )

    def or_lobes(self, lobes: Lobes) -> Prediction:
        """Copy with other side lobes and their width, if these are changed by more."""
        if lobes.change() <= abs(self.pslr - self.ideal_pslr):
            return self
        return self._replace(pslr=lobes.side, width=lobes.widened, ideal_pslr=lobes.ideal_side)

    def excess(self, fidelity: float) -> float:
        """Loss of coherence and change of the side lobes over what `fidelity` allows: the worse of the two."""
        loss = self.phase_loss + self.range_loss + self.dispersion_loss + self.track_loss
        allowed = side_lobe_budget(fidelity, self.ideal_pslr)
        return max(loss / (1 - fidelity), abs(self.pslr - self.ideal_pslr) / allowed)


def predict(
    targets: TracedTargets,
    gate: DwellGate | None,
    *,
    reached: BoolArray | None = None,
    imaged: tuple[ImageEdges, ImageEdges] | None = None,
    band: Taper = FLAT,
) -> Prediction:
    """The worst figures of traced targets under a gate, and a weighting `band` along it.

    The ideal side lobes are those that exact back-projection gives the target with the worst phase. Level lines make
    time after all steps a linear function of the direction in which a target is seen, so that they are those of its
    weights at these times. They differ from the taper's where a beam does not turn evenly, an antenna has a pattern, or
    dwells are cut: on the curved track of `paper_b` by 0.5 dB under a taper. To these comes what `responses` has under
    a weighting. On a terrain `reached` (n_range, n_yaw) tells which of the targets there are, and `imaged` where the
    image begins and ends along yaw and along range: a block may be wider than the grid, and the range window slants
    over a wide one.
    """
    line, spots, weights, geometry = targets.line, targets.spots, targets.weights, targets.geometry
    rng, yaw = targets.epoch_range, targets.yaw
    range_cell = SPEED_OF_LIGHT / (2 * geometry.collection.bandwidth)
    residual = spots.residual
    judged = JudgedTargets.of(targets, reached, imaged or ())
    lobes = worst_lobes(targets, gate, judged, band=band)
    slope = np.gradient(spots.doppler, yaw, axis=1)
    dwell = (line.weight * line.stretch).sum(axis=-1)
    width = weights.taper.ideal.width
    if weights.patterned:
        width = lobes.ideal_width * float(dwell[lobes.target])
    widths = width / np.maximum(np.abs(slope) * dwell, 1e-12)
    ground = np.sqrt(np.maximum(rng**2 - (geometry.epoch_position[2] - geometry.collection.ground_height) ** 2, 0.0))
    middle = yaw.size // 2
    track_phase = _track_phase(geometry, rng, yaw)
    lost = worst_losses(
        targets,
        gate,
        track_phase=track_phase,
        full=judged.full,
        reached=reached,
        band=band,
        edges=judged.edges,
    )
    return Prediction(
        residual_phase=float(residual[judged.there].max()),
        quadratic_phase=float(spots.quadratic[judged.there].max()),
        pslr=lobes.side,
        width=lobes.widened,
        migration=float(spots.migration[judged.there].max() / range_cell),
        resolution=float(widths[rng.size // 2, middle] * ground[rng.size // 2]),
        track_phase=track_phase,
        coherence=max(1 - sum(lost), 0.0),
        phase_loss=lost.phase,
        range_loss=lost.range,
        dispersion_loss=lost.dispersion,
        track_loss=lost.track,
        ideal_pslr=lobes.ideal_side,
    )


class Lobes(NamedTuple):
    """Highest side lobes, dB, and widths, Hz, of a target's response along azimuth, and those in back-projection."""

    target: tuple[int, ...]
    side: float
    width: float
    ideal_side: float
    ideal_width: float

    @property
    def widened(self) -> float:
        """Width over that in back-projection."""
        return self.width / self.ideal_width

    def change(self) -> float:
        """Difference of the side lobes from those in back-projection, dB."""
        return abs(self.side - self.ideal_side)

    def towards(self, other: Lobes, share: float) -> Lobes:
        """Mix with the lobes of another target, by a share."""
        return Lobes(self.target, *(a + share * (b - a) for a, b in zip(self[1:], other[1:], strict=True)))


class JudgedTargets(NamedTuple):
    """Mask of the targets that are judged."""

    there: BoolArray  # (n_range, n_yaw): those that there are
    full: BoolArray  # (n_range, n_yaw): those of them with full dwell; of all, if none of them has
    edges: list[ImageEdges]  # of the image between targets with full dwell

    @classmethod
    def of(cls, targets: TracedTargets, reached: BoolArray | None, imaged: Sequence[ImageEdges]) -> JudgedTargets:
        """Select the targets that an image shows; on a terrain, that are `reached`."""
        # Cut dwells have other side lobes under weights: of those with full dwell, where there are any.
        line = targets.line
        uncut = full_dwells(line, targets.geometry, targets.epoch_range[:, None], targets.yaw)
        there, beyond, edges = np.ones(line.time.shape[:-1], np.bool_), uncut, []
        for known in (*(each.held for each in imaged), reached):
            if known is not None and (there & known).any():
                there &= known
        for each in imaged:
            edges.append(each.of_dwells(beyond))
            beyond = beyond & each.held | edges[-1].before | edges[-1].behind
        full = uncut & there if (uncut & there).any() else uncut
        return cls(there, full, [each for each in edges if each.before.any() or each.behind.any()])


def worst_lobes(targets: TracedTargets, gate: DwellGate | None, judged: JudgedTargets, *, band: Taper = FLAT) -> Lobes:
    """Of the target with the worst phase, and of those at the edges of the image beside it; see `predict`."""
    full, uniform = judged.full, targets.weights.uniform
    residual = np.where(judged.there if uniform else full & judged.there, targets.spots.residual, -1.0)
    worst = tuple(int(i) for i in np.unravel_index(int(np.argmax(residual)), residual.shape))
    some = [worst] if uniform or not full.any() else [worst, *_corners(full)]
    changed = _at_ends(targets, gate) if gate is not None and gate.lift else None
    beside = None if targets.weights.taper.uniform else _beside(targets, band)
    found = [_azimuth_lobes(targets, target, changed if full[target] else None, beside) for target in some]
    for edge in judged.edges:
        for outer, inner in edge.beside(worst):
            beyond = _azimuth_lobes(targets, outer, changed, beside)
            inside = _azimuth_lobes(targets, inner, changed if full[inner] else None, beside)
            found.append(inside.towards(beyond, float(edge.share[outer])))
    return max(found, key=Lobes.change)


def _corners(full: BoolArray) -> list[tuple[int, ...]]:
    """The first and the last of the targets with full dwell, at the first, the middle and the last range with any."""
    rows = np.flatnonzero(full.any(axis=1))
    ends = [(row, np.flatnonzero(full[row])[[0, -1]].tolist()) for row in rows[[0, rows.size // 2, -1]].tolist()]
    return sorted({(row, column) for row, columns in ends for column in columns})


def _beside(targets: TracedTargets, band: Taper) -> Callable[[tuple[int, ...]], Beside]:
    """How pixels beside a target sum its echo: as dwells begin and end from yaw to yaw if nothing cuts them."""
    collection, doppler, yaw = targets.geometry.collection, targets.spots.doppler, targets.yaw
    moments = np.stack([np.broadcast_to(each, doppler.shape) for each in targets.uncut], axis=-1)
    passed = np.gradient(doppler, yaw, axis=1)[..., None]
    pace = np.gradient(moments, yaw, axis=1) / np.where(passed == 0, np.inf, passed)
    cut = np.broadcast_to(targets.cut, pace.shape)
    relative = collection.bandwidth / collection.carrier
    return lambda target: Beside(band, relative, pace[target], cut[target])


def _azimuth_lobes(
    targets: TracedTargets,
    target: tuple[int, ...],
    changed: tuple[FloatArray, FloatArray] | None,
    beside: Callable[[tuple[int, ...]], Beside] | None,
) -> Lobes:
    """Side lobes of one target, with what windows have `changed` (`_at_ends`), and `beside` it."""
    line, spots, weights = targets.line, targets.spots, targets.weights
    weight = weights.weigh(line).weight[target]
    level = line.phase[target] - spots.doppler[target] * line.time[target] - spots.phase[target]
    turned = np.sqrt(np.maximum(line.stretch[target], LEAST_STRETCH)) * np.exp(2j * np.pi * level)
    made = weight * turned
    time = line.time[target] - spots.time[target]
    if changed is not None:
        at, change = (each[target] for each in changed)
        time, weight = np.append(time, at - spots.time[target]), np.append(weight, np.zeros(at.size))
        made = np.append(made, change)
    if beside is not None:
        outer = [0, line.time.shape[-1] - 1]  # whose weights are those at the ends, nearly
        quadrature = line.weight[target][outer]
        ends = np.array([each[target] for each in targets.ends]) - spots.time[target]
        time = np.append(time, ends)
        weight, made = (np.append(each, each[outer] / quadrature) for each in (weight, made))
    # The ends of the dwell lie slightly outside the outermost nodes. The quadrature over the nodes is still exact.
    response, ideal = responses(time, made, weight, beside=None if beside is None else beside(target))
    side = side_lobe(response) if beside is None else side_lobe_as_in(ideal, response)
    return Lobes(target, side, lobe_width(response, time), side_lobe(ideal), lobe_width(ideal, time))


def _at_ends(targets: TracedTargets, gate: DwellGate) -> tuple[FloatArray, FloatArray]:
    """Times and weights (..., 4) by which windows at ends of dwells change sums; none at ends that no window makes."""
    line, edge = targets.line, targets.weights.edge
    stretch = np.sqrt(np.maximum(line.stretch[..., [0, -1]], LEAST_STRETCH))
    weight = np.where(targets.cut, 0.0, np.broadcast_to(edge, line.time.shape[:-1])[..., None] * stretch)
    return at_ends(gate.blur, gate.lift, np.stack(targets.ends, axis=-1), weight)


def _track_phase(geometry: Geometry, rng: FloatArray, yaw: FloatArray) -> float:
    """Largest root mean square phase that the noise of the track leaves over a dwell, rad.

    Recovery removes the noise along the line of sight of the beam's centre at the middle range.
    """
    collection, misfit = geometry.collection, geometry.track.misfit
    if geometry.track.max_misfit <= TRACK_ACCURACY * collection.wavelength:
        return 0.0
    turns, n = 4 * np.pi / collection.wavelength, collection.n_pulse
    centre = float(np.mean(rng))
    beam = np.full(n, float(np.mean(yaw)))
    if collection.steered:
        beam = geometry.beam.centre_yaw(collection.time, centre, float(yaw[0]), float(yaw[-1]))
    removed = _along_sight(geometry, np.full(n, centre), beam, misfit)
    worst = 0.0
    for target_range in (rng[0], centre, rng[-1]):
        for target_yaw in (yaw[0], yaw[yaw.size // 2], yaw[-1]):
            first, last = geometry.beam.dwell_at(np.array(target_yaw), np.array(target_range))
            lit = (collection.time >= first) & (collection.time <= last)
            if lit.any():
                along = _along_sight(geometry, np.full(n, target_range), np.full(n, target_yaw), misfit)
                worst = max(worst, float(np.std(turns * (along - removed)[lit])))
    return worst


def _along_sight(geometry: Geometry, rng: FloatArray, yaw: FloatArray, misfit: FloatArray) -> FloatArray:
    """The misfit along the line of sight of one point at each pulse, (n_pulse,) m."""
    sight = geometry.ground_point(rng, yaw) - geometry.collection.antenna_position
    return np.asarray((sight * misfit).sum(axis=1) / np.sqrt((sight * sight).sum(axis=1)))
