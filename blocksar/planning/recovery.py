"""What recovery needs, from metadata alone: unified walk, derotation, padding; and whether the PRF suffices."""

from __future__ import annotations

import numpy as np
from numpy.polynomial import chebyshev

from blocksar.arrays import FloatArray
from blocksar.collection.beam import dwell_at
from blocksar.collection.geometry import Geometry
from blocksar.collection.region import Region
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import PrfTooLow
from blocksar.focusing.lines import Line
from blocksar.focusing.method import DEFAULT, Method
from blocksar.focusing.recovery import NOTHING_IN_COMMON, CommonRange, Recovery
from blocksar.kernels import fourier
from blocksar.kernels.fourier import Axis
from blocksar.planning.target_lines import middle_line, recovered_line, tail_margin

COMMON_ORDER = 5  # of the range history: from here on it is taken out of all targets alike, azimuth steps end at 4
COMMON_LEAST = 1e-3  # wavelengths of it, a phase of 0.013 rad: less is left where it is
WINDOW_EDGE = 0.05  # of the range window, at either end, that the PRF need not hold: echoes only pass through


def plan_recovery(geometry: Geometry, region: Region, method: Method = DEFAULT) -> Recovery:
    """Unified walk, derotation, padding, and whether the PRF suffices.

    A method with linear derotation takes out one Doppler rate and no more (paper A, Figure 6 b), and needs more PRF.

    Raises
    ------
    PrfTooLow
        If the derotated band exceeds the PRF.
    """
    collection, linear = geometry.collection, method.derotation == "linear"
    centre_yaw = (region.yaw[0] + region.yaw[-1]) / 2
    near, far = region.at(np.array([centre_yaw]))
    origin = float((near[0] + far[0]) / 2)
    centre = geometry.ground_point(np.array(origin), np.array(centre_yaw))
    _, rate = geometry.range_history(centre, np.array(geometry.epoch))
    walk = float(rate)
    time = collection.time
    slow = time - geometry.epoch
    pulses = Axis(-collection.pulse_interval * (collection.n_pulse // 2), collection.pulse_interval, collection.n_pulse)
    to_cycles = -2 * collection.carrier / SPEED_OF_LIGHT

    band_edge = max(abs(collection.range_frequency[0]), abs(collection.range_frequency[-1])) / collection.carrier
    common = _common_range(geometry, centre)
    line = _lit_lines(geometry, region, origin, walk, common, margin=0.0)
    inner = _lit_lines(geometry, region, origin, walk, common, margin=WINDOW_EDGE)
    half = pulses.extent / 2
    middle = pulses.start + pulses.step * (pulses.size - 1) / 2
    u = (inner.time - middle) / half
    series = middle_line(u.ravel(), inner.doppler.ravel(), order=1 if linear else min(9, time.size // 8))
    bent = inner.doppler - chebyshev.chebval(u, series)
    low, high = float(line.doppler.min()), float(line.doppler.max())
    derotated_low, derotated_high = float(bent.min()), float(bent.max())
    centre_band = (derotated_low + derotated_high) / 2
    spread = (derotated_high - derotated_low) * (1 + band_edge)
    if collection.prf < spread:
        needed = float(10 * np.ceil(1.002 * spread / 10))  # another PRF cuts the dwells a little differently
        raise PrfTooLow(
            f"PRF {collection.prf:.6g} Hz is too low: after {method.derotation} derotation the lit scene still spans "
            f"{spread:.6g} Hz of Doppler, so a PRF of at least {needed:.6g} Hz is needed; collect with a higher PRF or "
            + ("a narrower beam" if collection.steered else "image a smaller grid"),
            needed,
        )
    series[0] += centre_band
    derotation = chebyshev.chebint(series) * half

    dwell = float(np.max(np.subtract(*dwell_at(geometry, region.yaw)[::-1])))
    margin = tail_margin(dwell)
    padded = fourier.fast_length((1.02 + band_edge) * pulses.size + 16)  # the keystone scales time by the band
    duration = padded * pulses.step
    edge = band_edge * max(abs(low), abs(high))
    size = fourier.fast_length(duration * (high - low + 2 * edge + 2 * margin))
    size = max(size, fourier.fast_length(padded))
    doppler = fourier.centred(np.round((low + high) / 2 * duration) / duration, 1 / duration, size)

    misfit = geometry.track.misfit
    beam = collection.beam_azimuth if collection.steered else np.full(time.size, centre_yaw)
    sight = geometry.ground_point(np.full(time.size, origin), beam) - geometry.track.position(time)
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    unmodelled = -np.einsum("ij,ij->i", sight, misfit)  # range that the polynomial track lacks
    bulk = to_cycles * (origin + walk * slow + common.at(slow) - collection.reference_range + unmodelled)
    return Recovery(
        carrier=collection.carrier,
        pulses=pulses,
        padded=padded,
        origin=origin,
        walk=walk,
        bulk=bulk,
        derotation=np.asarray(derotation),
        doppler=doppler,
        band=(derotated_low, derotated_high),
        common=common,
    )


def _common_range(geometry: Geometry, centre: FloatArray) -> CommonRange:
    """The range history of the region's centre (3,), m, from COMMON_ORDER on; nothing where that is little."""
    track = geometry.track
    # Range is smooth where the track is: twice its order, and some, hold it.
    nodes = chebyshev.chebpts1(2 * track.order + 16)
    rng, _ = geometry.range_history(centre, track.centre + track.half * nodes)
    series = chebyshev.chebfit(nodes, rng, nodes.size - 1)
    series[:COMMON_ORDER] = 0
    if np.abs(series).sum() < COMMON_LEAST * geometry.collection.wavelength:
        return NOTHING_IN_COMMON
    return CommonRange(series=np.asarray(series), centre=track.centre - geometry.epoch, half=track.half)


def _lit_lines(
    geometry: Geometry, region: Region, origin: float, walk: float, common: CommonRange, *, margin: float
) -> Line:
    near, far = region.at(region.yaw)
    width = far - near
    ranges = np.linspace(near + margin * width, far - margin * width, 5)
    return recovered_line(geometry, epoch_range=ranges, yaw=region.yaw, origin=origin, walk=walk, common=common)
