"""What recovery needs, from metadata alone: unified walk, derotation, padding; and whether the PRF suffices."""

from __future__ import annotations

import numpy as np
from numpy.polynomial import chebyshev

from blocksar import fourier
from blocksar.fourier import Axis
from blocksar.geometry import Geometry
from blocksar.lines import Line
from blocksar.parameters import SPEED_OF_LIGHT, FloatArray, InputError
from blocksar.recovery import NOTHING_IN_COMMON, CommonRange, Recovery
from blocksar.region import Region

LINE_NODES = 16
TAIL_ENERGY = 1e-3  # of a target's energy that may lie outside its block's Doppler support
COMMON_ORDER = 5  # of the range history: from here on it is taken out of all targets alike, azimuth steps end at 4
COMMON_LEAST = 1e-3  # wavelengths of it, a phase of 0.013 rad: less is left where it is
WINDOW_EDGE = 0.05  # of the range window, at either end, that the PRF need not hold: echoes only pass through


def recovered_line(
    geometry: Geometry,
    *,
    epoch_range: FloatArray,
    yaw: FloatArray,
    origin: float,
    walk: float,
    common: CommonRange = NOTHING_IN_COMMON,
) -> Line:
    """Lines of targets in the recovered signal, LINE_NODES samples each; the two inputs are broadcast.

    Dwells cut by the ends of the collection are traced as they are; targets lit for less than a
    twentieth of a dwell are traced over that much, inside the collection.
    """
    nodes, weights = np.polynomial.legendre.leggauss(LINE_NODES)
    epoch_range, yaw = np.broadcast_arrays(epoch_range, yaw)
    first, last = geometry.dwell(yaw)
    collection = geometry.collection
    shortest = 0.05 * float(np.max(last - first))
    middle = np.clip((first + last) / 2, collection.time[0] + shortest / 2, collection.time[-1] - shortest / 2)
    length = np.maximum(last - first, shortest)[..., None]
    time = middle[..., None] + length / 2 * nodes
    point = geometry.ground_point(epoch_range, yaw)[..., None, :]
    rng, rate = geometry.range_history(point, time)
    curvature = geometry.range_curvature(point, time)
    slow = time - geometry.epoch
    rho = rng - origin - walk * slow - common.at(slow)
    to_cycles = -2 * collection.carrier / SPEED_OF_LIGHT
    return Line(
        time=slow,
        doppler=to_cycles * (rate - walk - common.at(slow, 1)),
        rate=to_cycles * (curvature - common.at(slow, 2)),
        phase=to_cycles * rho,
        range=rho,
        stretch=np.ones_like(rho),
        weight=length / 2 * weights,
    )


def tail_margin(duration: float) -> float:
    """Doppler beyond a line's ends that holds all but TAIL_ENERGY of a target lit for `duration`, Hz.

    A chirp that starts and stops sharply has spectral tails 1 / (2 pi f) from either end; the energy
    beyond f is 1 / (pi^2 f duration) of the whole.
    """
    return 1.0 / (np.pi**2 * TAIL_ENERGY * duration)


def plan_recovery(geometry: Geometry, region: Region, *, linear: bool = False) -> Recovery:
    """Unified walk, derotation, padding, and whether the PRF suffices.

    `linear` derotation takes out one Doppler rate and no more (paper A, Figure 6 b): a rival that needs more PRF.

    Raises
    ------
    InputError
        If the derotated band exceeds the PRF; the message names the PRF needed.
    """
    collection = geometry.collection
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
        kind = "linear" if linear else "nonlinear"
        needed = 10 * np.ceil(1.002 * spread / 10)  # another PRF cuts the dwells a little differently
        raise InputError(
            f"PRF {collection.prf:.6g} Hz is too low: after {kind} derotation the lit scene still spans "
            f"{spread:.6g} Hz of Doppler, so a PRF of at least {needed:.6g} Hz is needed; collect with a higher PRF or "
            + ("a narrower beam" if collection.steered else "image a smaller grid")
        )
    series[0] += centre_band
    derotation = chebyshev.chebint(series) * half

    dwell = float(np.max(np.subtract(*geometry.dwell(region.yaw)[::-1])))
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


def middle_line(u: FloatArray, doppler: FloatArray, *, order: int) -> FloatArray:
    """Chebyshev series through the middle of the lit band at each time u in [-1, 1]: what derotation follows.

    Paper A (8) follows the beam's centre at the reference range; the middle of all that is lit at a time
    needs a little less PRF, and is the same thing where the swath is narrow.
    """
    bins = np.clip(((u + 1) / 2 * 48).astype(int), 0, 47)
    low, high, count = np.full(48, np.inf), np.full(48, -np.inf), np.zeros(48)
    np.minimum.at(low, bins, doppler)
    np.maximum.at(high, bins, doppler)
    np.add.at(count, bins, 1)
    filled = count > 0
    # The middle of a time bin, not of its samples: a bin cut by the aperture's end would pull the fit.
    place = ((np.arange(48) + 0.5) / 24 - 1)[filled]
    return np.asarray(chebyshev.chebfit(place, (low[filled] + high[filled]) / 2, min(order, int(filled.sum()) - 1)))
