"""The Doppler centroid of the samples against that of the beam."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from blocksar.arrays import FloatArray
from blocksar.collection.beam import aperture, dwell_at
from blocksar.collection.geometry import Geometry
from blocksar.constants import TURN
from blocksar.focusing.recovery import Recovery
from blocksar.inspection.samples import SEGMENTS, Inspection

MAX_OFFSET = 0.08  # of the PRF, and a quarter of a target's sweep: beyond the figures expected
TURNING = 0.9  # of the least real part: segments that add up to less of what they hold do not belong together
EVEN = 0.8  # of its share that the rest must hold, whichever dwell is left out, for a scene to be lit evenly
SIGNIFICANT = 5  # deviations of noise
DWELL_NODES = 16  # of a target's dwell at which its Doppler is taken


# ---------------------------------------------------------------- the Doppler centroid


@dataclass(frozen=True, kw_only=True, eq=False)
class Centroid:
    """Measured less expected Doppler centroid.

    Attributes
    ----------
    offset : (SEGMENTS,) float
        Of each segment of slow time, Hz; known modulo the PRF only. Anywhere in the lit band for a single target.
    coherence : (SEGMENTS,) float
        Modulus of the segment's sum over its energy; 0 where there is none.
    mean_offset, mean_coherence : float
        Of all of them together.
    """

    offset: FloatArray
    coherence: FloatArray
    mean_offset: float
    mean_coherence: float


def centroid(found: Inspection, *, prf: float) -> Centroid:
    """The Doppler centroid of a merged inspection, PRF in Hz.

    Raises
    ------
    ValueError
        If it has no pairs.
    """
    sums, energy = _sums(found)
    total = sums.sum()
    return Centroid(
        offset=np.angle(sums) / TURN * prf,
        coherence=np.abs(sums) / np.where(energy > 0, energy, 1),
        mean_offset=float(np.angle(total) / TURN * prf),
        mean_coherence=float(np.abs(total) / (energy.sum() or 1)),
    )


def _sums(found: Inspection) -> tuple[NDArray[np.complex128], FloatArray]:
    if not found.pairs:
        raise ValueError("no pulse pairs were summed")
    pairs = np.array(found.pairs)
    return pairs[:, 0] + 1j * pairs[:, 1], pairs[:, 2]


@dataclass(frozen=True, kw_only=True)
class Expectation:
    """What the pulse pairs of a target add up to over a whole dwell, over its energy: a vector in the complex plane.

    Attributes
    ----------
    prf : float
        Hz.
    angle : tuple of float
        Between which its angle lies for all targets, Hz.
    sweep : float
        The least Doppler that any of them runs through, Hz.
    real : float
        Its least real part.
    whole : tuple of int
        The segments first .. last - 1 in which no target is lit that the ends of the collection cut.
    dwell : int
        Segments that one dwell may touch.
    """

    prf: float
    angle: tuple[float, float]
    sweep: float
    real: float
    whole: tuple[int, int]
    dwell: int


def expect(
    geometry: Geometry, recovery: Recovery, *, yaw: FloatArray, near: FloatArray, far: FloatArray
) -> Expectation | None:
    """What is expected of a steered collection from its metadata alone.

    Parameters
    ----------
    geometry : Geometry
    recovery : Recovery
    yaw : (n,) float
        Of what is lit, rad.
    near, far : (n,) float
        Epoch ranges there, m.

    Returns
    -------
    Expectation or None
        None if no target is lit for a whole dwell, or if the beam is not steered: then all that is in sight is lit
        all the time, and the centroid is wherever the scene is bright.
    """
    collection = geometry.collection
    first, last = dwell_at(geometry, yaw)
    start, end = aperture(collection)
    late, early = first <= start, last >= end  # begun too late, or ended too early, to see all of them
    uncut = ~(late | early)
    if not uncut.any():  # as it is where the beam is not steered: lit from start to end
        return None
    cuts = np.array([last[late].max(initial=start), first[early].min(initial=end)])
    nodes, weights = np.polynomial.legendre.leggauss(DWELL_NODES)
    first, last = first[uncut, None], last[uncut, None]
    time = (first + last) / 2 + (last - first) / 2 * nodes
    offsets = []
    for epoch_range in (near, (near + far) / 2, far):
        point = geometry.ground_point(epoch_range[uncut], yaw[uncut])[:, None, :]
        _, rate = geometry.range_history(point, time)
        slow, half = time - geometry.epoch, collection.pulse_interval / 2
        turned = recovery.derotation_cycles(slow + half) - recovery.derotation_cycles(slow - half)
        left = rate - recovery.walk - recovery.common.at(slow, 1)
        offsets.append(-2 / collection.wavelength * left - turned * collection.prf)
    offset = np.concatenate(offsets)
    vector = np.exp(1j * TURN / collection.prf * offset) @ weights / 2
    segments = (cuts - start) / (end - start) * SEGMENTS
    return Expectation(
        prf=collection.prf,
        angle=(
            float(np.angle(vector).min() / TURN * collection.prf),
            float(np.angle(vector).max() / TURN * collection.prf),
        ),
        sweep=float(np.ptp(offset, axis=1).min()),
        real=float(vector.real.min()),
        whole=(int(np.ceil(segments[0])), int(np.floor(segments[1]))),
        dwell=int(np.ceil((last - first).max() / (end - start) * SEGMENTS)) + 1,
    )


def disagreement(found: Inspection, expected: Expectation) -> str | None:
    """One sentence with figures if track, beam and samples do not belong together, else None.

    Two things are looked at. The sum over all segments must lie between the vectors that targets add up to, but for
    what targets may contribute that the ends of the collection cut: no more than the moduli of the segments they can
    be lit in. That holds for any scene. And the segments of a scene that is lit about evenly must add up, with one
    dwell or another left out if need be, and not turn from one to the next as when the phase has the wrong sign.

    Not seen are errors that move Doppler by less than MAX_OFFSET or by whole PRFs; that turn or shift track and beam
    together, or move both along the line of sight by a constant; in scenes of one or a few targets, a part of all
    errors, and those of phase most; where the dwell is longer than half the collection, nothing; nor where noise is
    stronger than the echoes by about the root of the number of samples in it.
    """
    sums, energy = _sums(found)
    pulses = np.diff(np.arange(SEGMENTS + 1) * found.n_pulse // SEGMENTS)
    noise = energy / np.sqrt(np.maximum(pulses * found.n_column, 1))  # deviation of a sum of nothing but noise
    first, last = expected.whole
    cut = np.abs(sums).sum() - np.abs(sums[first:last]).sum() if last > first else np.inf
    total = sums.sum()
    doubt = cut + SIGNIFICANT * float(np.hypot.reduce(noise))
    tolerance = min(MAX_OFFSET * expected.prf, expected.sweep / 4)
    check = "check antenna_position, beam_azimuth and the sign of the phase"
    angle = float(np.angle(total))
    low, high = ((expected.angle[k] + sign * tolerance) / expected.prf * TURN for k, sign in enumerate((-1, 1)))
    beyond = max(angle - high, low - angle)
    if beyond > 0 and abs(total) * np.sin(min(beyond, np.pi / 2)) > doubt:
        offset = angle / TURN * expected.prf
        return (
            f"the measured Doppler centroid lies {abs(offset):.0f} Hz ({abs(offset) / expected.prf:.2f} PRF) "
            f"{'above' if offset > 0 else 'below'} what the track and the beam say, "
            f"mean of {SEGMENTS} segments; {check}"
        )
    if _turning(sums, noise, expected):
        share = max(total.real, 0) / np.abs(sums).sum()
        return (
            f"the measured Doppler centroid wanders through the PRF of {expected.prf:.6g} Hz where the track and the "
            f"beam have it stand: {SEGMENTS} segments add up to {share:.0%} of what they hold; {check}"
        )
    return None


def _turning(sums: NDArray[np.complex128], noise: FloatArray, expected: Expectation) -> bool:
    """Whether segments that each have a centroid do not add up, whichever dwell is left out."""
    if expected.whole[0] >= expected.whole[1]:
        return False
    held = np.maximum(np.abs(sums) - 2 * noise, 0)
    for first in range(-expected.dwell, SEGMENTS - expected.dwell + 1):  # at first, none is
        kept = np.ones(SEGMENTS, np.bool_)
        kept[max(first, 0) : max(first + expected.dwell, 0)] = False
        least = TURNING * expected.real * held[kept].sum() - SIGNIFICANT * np.hypot.reduce(noise[kept])
        if held[kept].sum() < EVEN * kept.mean() * held.sum() or sums[kept].sum().real >= least:
            return False
    return True
