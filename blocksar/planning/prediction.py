"""Predicted quality of a block from its traced lines: residual phase, side lobes, width and range migration."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blocksar.arrays import BoolArray, FloatArray
from blocksar.budget import side_lobe_budget
from blocksar.collection.beam import centre_yaw, dwell_at
from blocksar.collection.geometry import TRACK_ACCURACY, Geometry
from blocksar.collection.weighting import FLAT, Taper
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.focusing.dwell_gate import DwellGate
from blocksar.focusing.lines import LEAST_STRETCH, Focus, Line
from blocksar.planning.dwell_ends import full_dwells
from blocksar.planning.dwell_weights import DwellWeights
from blocksar.planning.fidelity import worst_losses


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

    def less(self, loss: float) -> Prediction:
        """The same where dwells lose some more coherence."""
        if not loss:
            return self
        return self._replace(coherence=max(self.coherence - loss, 0.0), dispersion_loss=self.dispersion_loss + loss)

    def excess(self, fidelity: float, *, migration: bool = True) -> float:
        """Loss of coherence and change of the side lobes over what `fidelity` allows: the worse of the two.

        Without `migration`, the loss by range migration is left out.
        """
        loss = self.phase_loss + self.dispersion_loss + self.track_loss + (self.range_loss if migration else 0.0)
        allowed = side_lobe_budget(fidelity, self.ideal_pslr)
        return max(loss / (1 - fidelity), abs(self.pslr - self.ideal_pslr) / allowed)


def predict(
    line: Line,
    spots: Focus,
    rng: FloatArray,
    yaw: FloatArray,
    geometry: Geometry,
    *,
    rate: FloatArray,
    gate: DwellGate | None,
    parts: int = 1,
    scaled_about: float | None,
    moves: FloatArray | None = None,
    weights: DwellWeights,
    reached: BoolArray | None = None,
    band: Taper = FLAT,
) -> Prediction:
    """The worst figures of traced lines (n_range, n_yaw) under a weighting `band` along range frequency.

    `rate` is the lines' Doppler rate before the steps in Doppler.

    The ideal side lobes are those that exact back-projection gives the target with the worst phase. Level lines make
    time after all steps a linear function of the direction in which a target is seen, so that they are those of its
    weights at these times. They differ from the taper's where a beam does not turn evenly, an antenna has a pattern, or
    dwells are cut: on the curved track of `paper_b` by 0.5 dB under a taper. On a terrain `reached` (n_range, n_yaw)
    tells which of the targets there are.
    """
    range_cell = SPEED_OF_LIGHT / (2 * geometry.collection.bandwidth)
    residual = spots.residual
    # Cut dwells have other side lobes under weights: of those with full dwell, where there are any.
    full = full_dwells(line, geometry, rng[:, None], yaw)
    judged = residual if weights.uniform else np.where(full, residual, -1.0)
    if reached is not None:
        judged = np.where(reached, judged, -1.0)
    worst = np.unravel_index(int(np.argmax(judged)), residual.shape)
    weight = weights.weigh(line).weight[worst]
    made = weight * (np.sqrt(np.maximum(line.stretch, LEAST_STRETCH)) * spots.levels)[worst]
    time = line.time[worst] - spots.time[worst]
    level = line.phase[worst] - spots.doppler[worst] * line.time[worst]
    spread = float(np.ptp(time))
    offsets = np.linspace(-4, 4, 401) / max(spread, 1e-9)
    # The ends of the dwell lie slightly outside the outermost nodes. The quadrature over the nodes is still exact.
    waves = np.exp(-2j * np.pi * offsets[:, None] * time)
    response = np.abs((made * np.exp(2j * np.pi * level) * waves).sum(axis=1))
    ideal = np.abs((weight * waves).sum(axis=1))
    slope = np.gradient(spots.doppler, yaw, axis=1)
    dwell = (line.weight * line.stretch).sum(axis=-1)
    width = weights.taper.ideal.width
    if weights.patterned:
        width = _width(ideal) * float(offsets[1] - offsets[0]) * float(dwell[worst])
    widths = width / np.maximum(np.abs(slope) * dwell, 1e-12)
    ground = np.sqrt(np.maximum(rng**2 - (geometry.epoch_position[2] - geometry.collection.ground_height) ** 2, 0.0))
    middle = yaw.size // 2
    track_phase = _track_phase(geometry, rng, yaw)
    lost = worst_losses(
        line, spots, rng, yaw, geometry, rate=rate, gate=gate, parts=parts, scaled_about=scaled_about,
        moves=moves, track_phase=track_phase, weights=weights, full=full, reached=reached, band=band,
    )  # fmt: skip
    return Prediction(
        residual_phase=float((residual if reached is None else residual[reached]).max()),
        quadratic_phase=float((spots.quadratic if reached is None else spots.quadratic[reached]).max()),
        pslr=_pslr(response),
        width=_width(response) / _width(ideal),
        migration=float(spots.migration.max() / range_cell),
        resolution=float(widths[rng.size // 2, middle] * ground[rng.size // 2]),
        track_phase=track_phase,
        coherence=max(1 - sum(lost), 0.0),
        phase_loss=lost.phase,
        range_loss=lost.range,
        dispersion_loss=lost.dispersion,
        track_loss=lost.track,
        ideal_pslr=_pslr(ideal),
    )


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
        beam = centre_yaw(geometry, collection.time, centre, float(yaw[0]), float(yaw[-1]))
    removed = _along_sight(geometry, np.full(n, centre), beam, misfit)
    worst = 0.0
    for target_range in (rng[0], centre, rng[-1]):
        for target_yaw in (yaw[0], yaw[yaw.size // 2], yaw[-1]):
            first, last = dwell_at(geometry, np.array(target_yaw), np.array(target_range))
            lit = (collection.time >= first) & (collection.time <= last)
            if lit.any():
                along = _along_sight(geometry, np.full(n, target_range), np.full(n, target_yaw), misfit)
                worst = max(worst, float(np.std(turns * (along - removed)[lit])))
    return worst


def _along_sight(geometry: Geometry, rng: FloatArray, yaw: FloatArray, misfit: FloatArray) -> FloatArray:
    """The misfit along the line of sight of one point at each pulse, (n_pulse,) m."""
    sight = geometry.ground_point(rng, yaw) - geometry.collection.antenna_position
    return np.asarray((sight * misfit).sum(axis=1) / np.sqrt((sight * sight).sum(axis=1)))


def _pslr(response: FloatArray) -> float:
    """Highest side lobe over the peak, dB."""
    peak = int(np.argmax(response))
    left, right = peak, peak
    while left > 0 and response[left - 1] < response[left]:
        left -= 1
    while right < response.size - 1 and response[right + 1] < response[right]:
        right += 1
    side = max(response[:left].max(initial=0.0), response[right + 1 :].max(initial=0.0))
    return float(20 * np.log10(max(side, 1e-12) / response[peak]))


def _width(response: FloatArray) -> float:
    """Distance between the outermost crossings of 3 dB below the peak, samples."""
    above = np.concatenate([[-1.0], response / response.max() - np.sqrt(0.5), [-1.0]])
    first, last = np.flatnonzero(above >= 0)[[0, -1]]
    left, right = above[first] - above[first - 1], above[last] - above[last + 1]
    return float(last - first + above[first] / left + above[last] / right)
