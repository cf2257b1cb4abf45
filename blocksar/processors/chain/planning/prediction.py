"""Predicted quality of a block from its traced targets: coherence, side lobes and width, residual phase, migration.

COHERENCE of a block's image with exact back-projection. On clutter every pulse holds the echoes of all that is lit, so
a pixel of back-projection and of a processor's image are two weighted sums over the same uncorrelated samples: their
coherence is the normalised inner product of the weights. Back-projection's weights are those of the pixel's echo over
its lit pulses. A processor's differ in four ways, each of which takes its loss, 1 - coherence (what the map from the
ground misses is `block.map_loss`):

    phase        the residual phase of the line over the dwell
    range        its range migration, as a phase across the band: sinc(2 B dr / c)
    dispersion   ends of the dwell that are smeared or displaced
    track        what the noise of the track leaves

The ends: `dwell_ends` has the energy by which they differ, of which half is lost. The keystone scales time by 1 + f /
fc, which displaces the ends at the band's edges. A plan predicts what is lost in the echoes that are there, times
CHIPS, by which single chips lose more than their mean.

A keystone also moves the slopes of a taper, by (t - m) f / fc about its time m, and a chain without one by fd f / (fc
rate) (`band_moves`). The weights of a range frequency differ by dw/dt times that, and half the mean of its square is
lost, over the mean of w^2.

On a terrain heights displace both ends of a dwell to the same side. What the gate lets in beyond the one is no echo, as
what has the pixel's Doppler there has left the beam. Only what it cuts off at the other is lost: half of the sum. Both
count where echoes lie on either side of an end: of sub-apertures, which the whole beam lights beyond their dwells.

Under a weighting w both sums have the weights w besides, and under an antenna's pattern g the echo has g: the inner
product along the dwell has (w g)^2; at an end the pattern counts for each echo where this is in the beam. Means over
the band have the square of its weighting.

SIDE LOBES and width along azimuth. The response of a target to a weighting is not quite the spectrum of the weights
over its dwell. At a pixel beside the target, whose Doppler differs by f, back-projection sums otherwise in two ways
(`measurement.figures`):

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
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from blocksar.arrays import BoolArray, Complex128Array, ComplexArray, FloatArray
from blocksar.budget import side_lobe_budget
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import TRACK_ACCURACY, Geometry
from blocksar.collection.weighting import FLAT, Taper
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.processors.chain.dwells.dwell_ends import band_nodes, blurred_energy, end_smear, lift_energy, lit_energy
from blocksar.processors.chain.dwells.dwell_weights import DwellWeights
from blocksar.processors.chain.dwells.steadiness import scans_evenly
from blocksar.processors.chain.planning.block_lines import TracedTargets
from blocksar.processors.chain.steps.dwell_gate import DwellGate
from blocksar.processors.chain.steps.lines import LEAST_STRETCH, Focus, Line


class Prediction(NamedTuple):
    """Predicted quality of a block: the figures of its worst target."""

    residual_phase: float  # rad, largest over the dwell
    quadratic_phase: float  # rad, its quadratic part at the dwell's edge
    pslr: float  # dB, azimuth
    width: float  # azimuth width over the limit that the dwell sets
    migration: float  # range resolution cells over the dwell
    resolution: float  # azimuth, m
    track_phase: float  # rad, root mean square, due to the noise of the track
    coherence: float  # with exact back-projection: 1 less the four losses of the target that loses most, or 0
    phase_loss: float
    range_loss: float
    dispersion_loss: float
    track_loss: float
    ideal_pslr: float  # dB, in exact back-projection

    def less(self, of_dwells: float, of_range: float) -> Prediction:
        """Copy with additional losses of coherence, by dwells and by range, the latter reducible by division."""
        if not of_dwells + of_range:
            return self
        return self._replace(
            coherence=max(self.coherence - of_dwells - of_range, 0.0),
            dispersion_loss=self.dispersion_loss + of_dwells,
            range_loss=self.range_loss + of_range,
        )

    def or_lobes(self, lobes: Lobes) -> Prediction:
        """Copy with other side lobes and width, if these deviate more."""
        if lobes.change() <= abs(self.pslr - self.ideal_pslr):
            return self
        return self._replace(pslr=lobes.side, width=lobes.widened, ideal_pslr=lobes.ideal_side)

    def excess(self, fidelity: float) -> float:
        """Larger of loss of coherence and change of side lobes, relative to what `fidelity` allows."""
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
    """Predict the worst figures of traced targets under a gate, and a weighting `band` along the band.

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
    masks = JudgedTargets.of(targets, reached, imaged or ())
    lobes = worst_lobes(targets, gate, masks, band=band)
    slope = np.gradient(spots.doppler, yaw, axis=1)
    dwell = (line.weight * line.stretch).sum(axis=-1)
    width = weights.taper.ideal.width
    if weights.patterned:
        width = lobes.ideal_width * float(dwell[lobes.target])
    widths = width / np.maximum(np.abs(slope) * dwell, 1e-12)
    ground = np.sqrt(np.maximum(rng**2 - (geometry.epoch_position[2] - geometry.collection.ground_height) ** 2, 0.0))
    middle = yaw.size // 2
    track_phase = _track_phase(geometry, rng, yaw)
    track_loss = 1 - float(np.exp(-(track_phase**2) / 2))
    phase_loss, range_loss, dispersion_loss = worst_losses(targets, gate, masks, reached=reached, band=band)
    return Prediction(
        residual_phase=float(residual[masks.there].max()),
        quadratic_phase=float(spots.quadratic[masks.there].max()),
        pslr=lobes.side,
        width=lobes.widened,
        migration=float(spots.migration[masks.there].max() / range_cell),
        resolution=float(widths[rng.size // 2, middle] * ground[rng.size // 2]),
        track_phase=track_phase,
        coherence=max(1 - (phase_loss + range_loss + dispersion_loss + track_loss), 0.0),
        phase_loss=phase_loss,
        range_loss=range_loss,
        dispersion_loss=dispersion_loss,
        track_loss=track_loss,
        ideal_pslr=lobes.ideal_side,
    )


class JudgedTargets(NamedTuple):
    """Masks of the targets that enter the prediction."""

    there: BoolArray  # (n_range, n_yaw): those that there are
    full: BoolArray  # (n_range, n_yaw): those of them with full dwell; of all, if none of them has
    edges: list[ImageEdges]  # of the image between targets with full dwell

    @classmethod
    def of(cls, targets: TracedTargets, reached: BoolArray | None, imaged: Sequence[ImageEdges]) -> JudgedTargets:
        """Select the targets that the image shows; on a terrain, those `reached`."""
        # Under weights, cut dwells have other side lobes: use targets with full dwell, if there are any.
        uncut = beyond = targets.full
        there, edges = np.ones(uncut.shape, np.bool_), []
        for known in (*(each.held for each in imaged), reached):
            if known is not None and (there & known).any():
                there &= known
        for each in imaged:
            edges.append(each.of_dwells(beyond))
            beyond = beyond & each.held | edges[-1].before | edges[-1].behind
        full = uncut & there if (uncut & there).any() else uncut
        return cls(there, full, [each for each in edges if each.before.any() or each.behind.any()])


class ImageEdges(NamedTuple):
    """Edges of the imaged ground between the places of traced targets: (n_range, n_yaw) each.

    Targets next beyond stand for targets at the edge: what those lose is interpolated between them and the next ones.
    """

    held: BoolArray  # the targets inside; where none lies inside, those on either side of it
    before: BoolArray  # those next beyond the beginning
    behind: BoolArray  # those next beyond the end
    share: FloatArray  # of the way to them at which the edge lies, from the ones next to them
    axis: int

    @classmethod
    def between(cls, places: FloatArray, first: FloatArray, last: FloatArray, *, axis: int) -> ImageEdges:
        """Edges of the imaged interval [first, last] (m,) among places (n,) along one axis, at m along the other."""
        at, step = places[:, None], np.diff(places)[:, None]
        held = (at >= first) & (at <= last)
        before, behind, share = np.zeros_like(held), np.zeros_like(held), np.zeros(held.shape)
        before[:-1], behind[1:] = (at[:-1] < first) & (at[1:] >= first), (at[1:] > last) & (at[:-1] <= last)
        share[:-1] = np.where(before[:-1], (at[1:] - first) / step, 0.0)
        share[1:] += np.where(behind[1:], (last - at[:-1]) / step, 0.0)
        held = held if held.any() else before | behind
        return cls(held.T, before.T, behind.T, share.T, axis) if axis else cls(held, before, behind, share, axis)

    def of_dwells(self, full: BoolArray) -> ImageEdges:
        """Limit edges to those with full dwell on either side."""
        before, behind = self.before & full, self.behind & full
        along = (before.T, behind.T, full.T) if self.axis else (before, behind, full)
        along[0][:-1] &= along[2][1:]
        along[1][1:] &= along[2][:-1]
        return self._replace(before=before, behind=behind)

    def beside(self, target: tuple[int, ...]) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
        """Pairs of targets next to an edge, outside and inside, on the same line along the other axis."""
        row, column = target
        pairs: list[tuple[tuple[int, ...], tuple[int, ...]]] = []
        for beyond, step in ((self.before, 1), (self.behind, -1)):
            if self.axis:
                pairs += [((row, at), (row, at + step)) for at in np.flatnonzero(beyond[row]).tolist()]
            else:
                pairs += [((at, column), (at + step, column)) for at in np.flatnonzero(beyond[:, column]).tolist()]
        return pairs

    def at(self, lost: FloatArray) -> FloatArray:
        """Interpolate losses (n_range, n_yaw) to the edges, in place of the targets beyond."""
        inner = lost.copy()
        into, own, behind = (inner.T, lost.T, self.behind.T) if self.axis else (inner, lost, self.behind)
        into[:-1] = own[1:]
        into[1:] = np.where(behind[1:], own[:-1], into[1:])
        return np.where(self.before | self.behind, inner + self.share * (lost - inner), lost)


MIGRATION_NODES = 12  # of the mean over the phase by range migration, under a weighting
CHIPS = 1.6  # loss of an image's worst chips at whole ends over the mean: 1.1 to 1.6 measured


def worst_losses(
    targets: TracedTargets, gate: DwellGate | None, judged: JudgedTargets, *, reached: BoolArray | None, band: Taper
) -> tuple[float, float, float]:
    """Losses of the worst target, by residual phase, range migration and dwell ends; see `predict`.

    Of those with full dwell; on a terrain, of those of them that are there, if any is.
    """
    phase, migration = _along_dwell(targets, band)
    ends = np.zeros_like(phase) if gate is None else _gated(targets, gate, reached=reached, band=band)
    full = judged.full
    for edge in judged.edges:
        phase, migration, ends = (edge.at(each) for each in (phase, migration, ends))
        full = full | edge.before | edge.behind
    lost = phase + migration + ends
    total = np.where(full if reached is None or not (full & reached).any() else full & reached, lost, -1.0)
    worst = np.unravel_index(int(np.argmax(total)), total.shape)
    return float(phase[worst]), float(migration[worst]), float(ends[worst])


def _along_dwell(targets: TracedTargets, band: Taper) -> tuple[FloatArray, FloatArray]:
    """Loss by residual phase, and additional loss by range migration."""
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
    """Loss by the gate: at ends of dwells, and where it does not follow slopes of weights."""
    line, weights, collection = targets.line, targets.weights, targets.geometry.collection
    whole = collection.lit_widths == 1  # echoes lie to one side of the ends: no dwell is a part of the beam's own
    by_lit = whole and (reached is None or weights.pattern is not None)
    lost = _between_ends(targets, gate, by_lit=by_lit, band=band)
    lost *= line.weight.sum(axis=-1)
    if whole and not by_lit:
        lost /= 2  # of two ends that are displaced to the same side, one
    lost += slope_loss(collection, band) * (line.weight * np.square(weights.change)).sum(axis=-1)
    lost /= line.weighed(weights.nodes**2).weight.sum(axis=-1)
    fitting = scans_evenly(collection) and reached is None
    if gate.taper is not None and not gate.taper.taper.uniform and not fitting:
        lost += _by_place(line, targets.spots, gate, weights)
    return lost


def _by_place(line: Line, spots: Focus, gate: DwellGate, weights: DwellWeights) -> FloatArray:
    """Loss by windows that assume another time course of a target's place in the beam than its own.

    Under a beam about its axis a simple one, made for a few lengths of each half of the dwells and blended; on a
    terrain that of the smooth ground, from which heights move dwells.
    """
    assert gate.taper is not None
    made = np.ones(line.time.shape)
    for half, share, length in gate.halves(spots.range, spots.doppler, line.time):
        made *= half.blended(gate.taper.taper, share * length, length)
    wanted, found = weights.nodes, made * weights.nodes / weights.alone
    power = (line.weight * wanted**2).sum(axis=-1) * (line.weight * found**2).sum(axis=-1)
    # Under a taper to zero, targets that are hardly lit have no weight at all.
    return 1 - np.abs((line.weight * wanted * found).sum(axis=-1)) / np.sqrt(np.where(power > 0, power, np.inf))


def _between_ends(targets: TracedTargets, gate: DwellGate, *, by_lit: bool, band: Taper) -> FloatArray:
    """Loss by smeared or displaced ends of the dwell; 0 at ends cut by the collection."""
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
                lit_band=weights.lit_band, band=band_nodes(band), gain=weights.gains(side),
            )  # fmt: skip
            total = (total + lift_energy(gate.blur, gate.lift)) * CHIPS * weights.end**2 * weights.level(side)
        else:
            total = blurred_energy(left, displaced, spread, gate.blur, collection.pulse_interval, band)
            total = (total + lift_energy(gate.blur, gate.lift)) * np.square(weights.edge)
        lost += np.where(targets.cut[..., end], 0.0, total)
    return lost / (2 * lit)


def slope_loss(collection: Collection, band: Taper) -> float:
    """Loss by weights that change linearly over the band, for a unit relative slope."""
    nodes, shares = band_nodes(band)
    return float((shares * nodes**2).sum() * (collection.bandwidth / 2 / collection.carrier) ** 2 / 2)


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
    """Misfit along the line of sight of one point at each pulse, (n_pulse,) m."""
    sight = geometry.ground_point(rng, yaw) - geometry.collection.antenna_position
    return np.asarray((sight * misfit).sum(axis=1) / np.sqrt((sight * sight).sum(axis=1)))


LOBES = 5.0  # widths 1 / dwell on either side of the peak: within are the highest side lobes of all weightings
SAMPLES = 501
MOST_LATER = 0.25  # of a dwell, of which as much is taken to have the weight of its end
STEPS = 128  # of the table of W^, per unit: linear between them to 1e-5


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
        """Mix with the lobes of another target by a share."""
        return Lobes(self.target, *(a + share * (b - a) for a, b in zip(self[1:], other[1:], strict=True)))


def worst_lobes(targets: TracedTargets, gate: DwellGate | None, judged: JudgedTargets, *, band: Taper = FLAT) -> Lobes:
    """Side lobes of the target with the worst phase and of those at the image's edges next to it; see `predict`."""
    full, uniform = judged.full, targets.weights.uniform
    residual = np.where(judged.there if uniform else full & judged.there, targets.spots.residual, -1.0)
    worst = tuple(int(i) for i in np.unravel_index(int(np.argmax(residual)), residual.shape))
    some = [worst] if uniform or not full.any() else [worst, *_corners(full)]
    changed = _at_ends(targets, gate) if gate is not None and gate.lift else None
    neighbours = None if targets.weights.taper.uniform else _beside(targets, band)
    found = [_azimuth_lobes(targets, target, changed if full[target] else None, neighbours) for target in some]
    for edge in judged.edges:
        for outer, inner in edge.beside(worst):
            beyond = _azimuth_lobes(targets, outer, changed, neighbours)
            inside = _azimuth_lobes(targets, inner, changed if full[inner] else None, neighbours)
            found.append(inside.towards(beyond, float(edge.share[outer])))
    return max(found, key=Lobes.change)


def _corners(full: BoolArray) -> list[tuple[int, ...]]:
    """First and last target with full dwell, at the first, middle and last range that has any."""
    rows = np.flatnonzero(full.any(axis=1))
    ends = [(row, np.flatnonzero(full[row])[[0, -1]].tolist()) for row in rows[[0, rows.size // 2, -1]].tolist()]
    return sorted({(row, column) for row, columns in ends for column in columns})


def _beside(targets: TracedTargets, band: Taper) -> Callable[[tuple[int, ...]], Beside]:
    """Make the sums of a target's echo at neighbouring pixels, whose dwells are shifted unless cut."""
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
    """Side lobes of one target, with changes by windows (`_at_ends`) and dwells of pixels `beside` it."""
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
    """Times and weights (..., 4) of the changes by windows at ends of dwells; 0 at ends without a window."""
    line, edge = targets.line, targets.weights.edge
    stretch = np.sqrt(np.maximum(line.stretch[..., [0, -1]], LEAST_STRETCH))
    weight = np.where(targets.cut, 0.0, np.broadcast_to(edge, line.time.shape[:-1])[..., None] * stretch)
    time, area = np.stack(targets.ends, axis=-1), 2 * gate.blur * gate.lift
    inside = time + 2 * gate.blur * np.array([1.0, -1.0])
    return np.concatenate([time, inside], axis=-1), area * np.concatenate([-weight, weight], axis=-1)


class Beside(NamedTuple):
    """Sum of a target's echo at neighbouring pixels, over their dwells rather than the target's."""

    band: Taper  # the weighting over the band
    relative: float  # B / fc
    pace: FloatArray  # (2,) dt/df of the begin and the end of dwells, s/Hz
    cut: BoolArray  # (2,) whether the collection cuts them

    def factors(self, offsets: FloatArray, time: FloatArray) -> Complex128Array:
        """Factors (m, n) of the weights at times (n,), at frequencies (m,).

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
    """Magnitudes (SAMPLES,) of sums of `weights` (n,) at times (n,), s, over frequencies about zero.

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
    """Side lobe of a response, dB, read where an ideal response close to it has its highest.

    Under a part of a weighting, side lobes may be shoulders of the main lobe, which count where the slightest change
    makes a minimum before them. Of the side lobes beyond the response's own main lobe, and beyond that of the ideal
    one, it is those that differ less.
    """
    sides = side_lobe(response), _beyond(response, *_main_lobe(ideal))
    return min(sides, key=lambda side: abs(side - side_lobe(ideal)))


def _main_lobe(response: FloatArray) -> tuple[int, int]:
    """Indices of the first minima on either side of the peak."""
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
    """Distance, Hz, between the outermost -3 dB crossings of a response over these times."""
    above = np.concatenate([[-1.0], response / response.max() - np.sqrt(0.5), [-1.0]])
    first, last = np.flatnonzero(above >= 0)[[0, -1]]
    left, right = above[first] - above[first - 1], above[last] - above[last + 1]
    samples = float(last - first + above[first] / left + above[last] / right)
    return samples * 2 * LOBES / (SAMPLES - 1) / _extent(time)


def _extent(time: FloatArray) -> float:
    return max(float(np.ptp(time)), 1e-9)
