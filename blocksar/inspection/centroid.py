"""The Doppler centroid measured from the samples, compared with the one expected from track and beam."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from blocksar.arrays import FloatArray
from blocksar.collection.beam import aperture
from blocksar.collection.geometry import Geometry
from blocksar.constants import TURN
from blocksar.inspection.samples import SEGMENTS, Inspection, Motion

MAX_OFFSET = 0.08  # of the PRF, and at most a quarter of a target's sweep: tolerance about the expected angles
TURNING = 0.9  # of the least real part: below it the sum of the segments is too small for a steady centroid
EVEN = 0.8  # of its share that the rest must hold, whichever dwell is left out, for a scene to be lit evenly
SIGNIFICANT = 5  # standard deviations of noise
DWELL_NODES = 16  # quadrature nodes in a target's dwell at which its Doppler is evaluated


@dataclass(frozen=True, kw_only=True, eq=False)
class Centroid:
    """Measured minus expected Doppler centroid.

    Attributes
    ----------
    offset : (SEGMENTS,) float
        Of each segment of slow time, Hz; known modulo the PRF only. For a single target it may lie anywhere in the
        lit band.
    coherence : (SEGMENTS,) float
        Modulus of the segment's sum divided by its energy; 0 where there is none.
    mean_offset, mean_coherence : float
        Of all segments together.
    """

    offset: FloatArray
    coherence: FloatArray
    mean_offset: float
    mean_coherence: float


def measure_centroid(inspection: Inspection, *, prf: float) -> Centroid:
    """Measure the Doppler centroid from a merged inspection; PRF in Hz.

    Raises
    ------
    ValueError
        If it has no pulse pairs.
    """
    sums, energy = _pair_sums(inspection)
    total = sums.sum()
    return Centroid(
        offset=np.angle(sums) / TURN * prf,
        coherence=np.abs(sums) / np.where(energy > 0, energy, 1),
        mean_offset=float(np.angle(total) / TURN * prf),
        mean_coherence=float(np.abs(total) / (energy.sum() or 1)),
    )


def _pair_sums(inspection: Inspection) -> tuple[NDArray[np.complex128], FloatArray]:
    """Complex sums over pulse pairs and energies, both (SEGMENTS,)."""
    if not inspection.pairs:
        raise ValueError("no pulse pairs were summed")
    pairs = np.array(inspection.pairs)
    return pairs[:, 0] + 1j * pairs[:, 1], pairs[:, 2]


@dataclass(frozen=True, kw_only=True)
class Expectation:
    """The sum over a target's pulse pairs in a whole dwell, divided by its energy: a vector in the complex plane.

    Attributes
    ----------
    prf : float
        Hz.
    angle : tuple of float
        Least and largest angle over all targets, Hz.
    sweep : float
        Least Doppler extent of any target, Hz.
    real : float
        Least real part over all targets.
    whole : tuple of int
        First and last (exclusive) of the segments in which every lit target has its whole dwell inside the collection.
    dwell : int
        Largest number of segments that one dwell may touch.
    beam : str
        The field that says where the beam points.
    """

    prf: float
    angle: tuple[float, float]
    sweep: float
    real: float
    whole: tuple[int, int]
    dwell: int
    beam: str = "beam_azimuth"


def expect(
    geometry: Geometry, recovery: Motion, *, yaw: FloatArray, near: FloatArray, far: FloatArray
) -> Expectation | None:
    """Expected sums over pulse pairs of a steered collection, from its metadata alone.

    Parameters
    ----------
    geometry : Geometry
    recovery : Motion
    yaw : (n,) float
        Yaw of lit points, rad.
    near, far : (n,) float
        Nearest and farthest lit epoch range at each yaw, m.

    Returns
    -------
    Expectation or None
        None if no target is lit for a whole dwell, or if the beam is not steered: everything in sight is then lit all
        the time, and the centroid depends on where the scene is bright.
    """
    collection = geometry.collection
    start, end = aperture(collection)
    nodes, weights = np.polynomial.legendre.leggauss(DWELL_NODES)
    cuts, offsets, longest = np.array([start, end]), [], 0.0
    for epoch_range in (near, (near + far) / 2, far):
        first, last = geometry.beam.dwell_at(yaw, epoch_range)
        late, early = first <= start, last >= end  # begun too late, or ended too early, to see all of them
        uncut = ~(late | early)
        cuts = np.array([last[late].max(initial=cuts[0]), first[early].min(initial=cuts[1])])
        if collection.has_axis:
            uncut &= last > first
        if not uncut.any():
            continue
        first, last = first[uncut, None], last[uncut, None]
        longest = max(longest, float((last - first).max()))
        time = (first + last) / 2 + (last - first) / 2 * nodes
        point = geometry.ground_point(epoch_range[uncut], yaw[uncut])[:, None, :]
        _, rate = geometry.range_history(point, time)
        slow, half = time - geometry.epoch, collection.pulse_interval / 2
        derotation = recovery.derotation_cycles(slow + half) - recovery.derotation_cycles(slow - half)
        remaining_rate = rate - recovery.walk - recovery.common.at(slow, 1)
        offsets.append(-2 / collection.wavelength * remaining_rate - derotation * collection.prf)
    if not offsets:  # as it is where the beam is not steered: lit from start to end
        return None
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
        dwell=int(np.ceil(longest / (end - start) * SEGMENTS)) + 1,
        beam=collection.pointing,
    )


def disagreement(inspection: Inspection, expected: Expectation) -> str | None:
    """One sentence with figures if track, beam and samples contradict each other, else None.

    There are two checks. First, the angle of the sum over all segments must lie between those of the targets' own sums,
    apart from the contribution of targets whose dwell the ends of the collection cut, which is at most the sum of the
    moduli of the segments in which they can be lit. This holds for any scene. Second, in a scene that is lit about
    evenly the segments must add up, possibly with one dwell left out, instead of turning from one to the next as they
    do when the phase has the wrong sign.

    Errors that are not detected: those that move Doppler by less than MAX_OFFSET or by whole PRFs; those that rotate or
    shift track and beam together, or move both along the line of sight by a constant; in scenes of one or a few
    targets, part of all errors, phase errors above all. Nothing is detected where the dwell is longer than half the
    collection, or where noise exceeds the echoes by about the square root of the number of samples in it.
    """
    sums, energy = _pair_sums(inspection)
    pulses = np.diff(np.arange(SEGMENTS + 1) * inspection.n_pulse // SEGMENTS)
    noise = energy / np.sqrt(np.maximum(pulses * inspection.n_column, 1))  # standard deviation of a sum over noise
    first, last = expected.whole
    cut = np.abs(sums).sum() - np.abs(sums[first:last]).sum() if last > first else np.inf
    total = sums.sum()
    doubt = cut + SIGNIFICANT * float(np.hypot.reduce(noise))
    tolerance = min(MAX_OFFSET * expected.prf, expected.sweep / 4)
    check = f"check antenna_position, {expected.beam} and the sign of the phase"
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
    if _is_turning(sums, noise, expected):
        share = max(total.real, 0) / np.abs(sums).sum()
        return (
            f"the measured Doppler centroid wanders through the PRF of {expected.prf:.6g} Hz where track and beam "
            f"predict a steady one: {SEGMENTS} segments add up to {share:.0%} of the sum of their moduli; {check}"
        )
    return None


def _is_turning(sums: NDArray[np.complex128], noise: FloatArray, expected: Expectation) -> bool:
    """Tell whether the segments' sums cancel although each has a centroid, whichever dwell of segments is left out."""
    if expected.whole[0] >= expected.whole[1]:
        return False
    modulus = np.maximum(np.abs(sums) - 2 * noise, 0)
    for first in range(-expected.dwell, SEGMENTS - expected.dwell + 1):  # the first turn leaves no segment out
        rest = np.ones(SEGMENTS, np.bool_)
        rest[max(first, 0) : max(first + expected.dwell, 0)] = False
        least = TURNING * expected.real * modulus[rest].sum() - SIGNIFICANT * np.hypot.reduce(noise[rest])
        if modulus[rest].sum() < EVEN * rest.mean() * modulus.sum() or sums[rest].sum().real >= least:
            return False
    return True
