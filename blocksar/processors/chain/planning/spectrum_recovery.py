"""Plan of the spectrum's recovery: unified walk, derotation and padding, and whether the PRF suffices."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.polynomial import chebyshev

from blocksar import solvers
from blocksar.arrays import FloatArray
from blocksar.collection.geometry import Geometry
from blocksar.collection.meant import doubt_width
from blocksar.collection.region import Region
from blocksar.collection.track_shape import find_flaw
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import InputError, PrfTooLow, Unfocusable
from blocksar.imaging.method import DEFAULT, Method
from blocksar.kernels import fourier
from blocksar.kernels.fourier import Axis
from blocksar.processors.chain.dwells.target_lines import Dwells, middle_line, tail_margin
from blocksar.processors.chain.planning.fitting import ORDERS
from blocksar.processors.chain.steps.lines import Line
from blocksar.processors.chain.steps.recovery import NO_COMMON_RANGE, CommonRange, Recovery

COMMON_ORDER = ORDERS[-1] + 1  # range history from this order on, where azimuth steps end, is removed from all alike
COMMON_LEAST = 1e-3  # wavelengths, a phase of 0.013 rad: a smaller common range is not removed
AXIS_NODES = 128  # of lines under a beam about its axis, whose dwells differ: all that is lit has to be seen
WINDOW_EDGE = 0.05  # of the range window at either end, for which the PRF need not suffice: echoes only pass through


def plan_recovery(
    geometry: Geometry,
    region: Region,
    method: Method = DEFAULT,
) -> Recovery:
    """Plan unified walk, derotation and padding, and check the PRF.

    A method with linear derotation removes one Doppler rate only (paper A, Figure 6 b), and needs a higher PRF.

    Raises
    ------
    PrfTooLow, Unfocusable, InputError
        If the derotated band exceeds the PRF: for that reason, because of the track, or of the beam's unit.
    """
    collection = geometry.collection
    middle_yaw = (region.yaw[0] + region.yaw[-1]) / 2
    near, far = region.at(np.array([middle_yaw]))
    origin = float((near[0] + far[0]) / 2)
    centre = geometry.ground_point(np.array(origin), np.array(middle_yaw))
    _, rate = geometry.range_history(centre, np.array(geometry.epoch))
    walk = float(rate)
    pulses = Axis(-collection.pulse_interval * (collection.n_pulse // 2), collection.pulse_interval, collection.n_pulse)
    band_edge = max(abs(collection.range_frequency[0]), abs(collection.range_frequency[-1])) / collection.carrier
    common = _common_range(geometry, centre)
    line = _lit_lines(geometry, region, origin, walk, common, margin=0.0)
    inner = _lit_lines(geometry, region, origin, walk, common, margin=WINDOW_EDGE)
    derotation, band = _plan_derotation(pulses, inner, linear=method.derotation == "linear")
    _check_prf(geometry, method, (band[1] - band[0]) * (1 + band_edge))
    padded = fourier.fast_length((1.02 + band_edge) * pulses.size + 16)  # the keystone scales time by the band
    doppler = _plan_spectrum(geometry, region, line, padded=padded, band_edge=band_edge)
    recovery = Recovery(
        carrier=collection.carrier,
        pulses=pulses,
        padded=padded,
        origin=origin,
        walk=walk,
        bulk=_bulk_cycles(geometry, common, origin=origin, walk=walk, region=region),
        derotation=derotation,
        doppler=doppler,
        n_time=doppler.size,
        band=band,
        common=common,
    )
    return recovery if collection.steered else replace(recovery, n_time=_unfolded(recovery, band_edge))


def _unfolded(recovery: Recovery, band_edge: float) -> int:
    """Length `Recovery.n_time` without aliasing of the lit ground beyond the grid.

    The derotated signal fills the PRF, and the derotation moves that up and down. A part that folded into the spectrum
    would lie at a time where nothing of its Doppler is lit, which a dwell gate takes out. Without one, steps in Doppler
    delay some of it round the end of the aperture, and there it has the Doppler of the grid.
    """
    pulses, doppler = recovery.pulses, recovery.doppler
    rate = recovery.derotation_rate(pulses.values)
    reach = 0.5 / pulses.step + band_edge * float(np.abs(rate).max())
    low, high = float(rate.min()) - reach, float(rate.max()) + reach
    width = max(high - doppler.start, doppler.start + doppler.extent - low)
    return max(fourier.fast_length(recovery.padded * pulses.step * width), doppler.size)


def _plan_derotation(pulses: Axis, line: Line, *, linear: bool) -> tuple[FloatArray, tuple[float, float]]:
    """Plan the derotation: a Chebyshev series of phase (cycles), and the Doppler band of derotated lines (Hz)."""
    half = pulses.extent / 2
    middle = pulses.start + pulses.step * (pulses.size - 1) / 2
    u = (line.time - middle) / half
    series = middle_line(u.ravel(), line.doppler.ravel(), order=1 if linear else min(9, pulses.size // 8))
    remaining = line.doppler - chebyshev.chebval(u, series)
    low, high = float(remaining.min()), float(remaining.max())
    series[0] += (low + high) / 2
    return np.asarray(chebyshev.chebint(series) * half), (low, high)


def _check_prf(geometry: Geometry, method: Method, spread: float) -> None:
    """Raise PrfTooLow, or an error about track or beam, if the derotated band, `spread` Hz, exceeds the PRF."""
    collection = geometry.collection
    if collection.prf < spread:
        if (flaw := find_flaw(collection)) is not None:
            raise Unfocusable(str(flaw))
        if (doubt := doubt_width(collection.beam_width, collection.prf, spread)) is not None:
            raise InputError(doubt)
        needed = float(10 * np.ceil(1.002 * spread / 10))  # another PRF cuts the dwells a little differently
        remedy = (
            f"collect with a higher PRF or {'a narrower beam' if collection.steered else 'image a smaller grid'}"
            f"{_of_terrain(geometry)}; `blocksar check` tells whether the track fits the samples"
        )
        raise PrfTooLow(
            f"PRF {collection.prf:.6g} Hz is too low: after {method.derotation} derotation the lit scene still spans "
            f"{spread:.6g} Hz of Doppler, so a PRF of at least {needed:.6g} Hz is needed; {remedy}",
            needed,
        )


def _of_terrain(geometry: Geometry) -> str:
    """Mention the terrain as a possible cause, if there is one: wrong heights change all Dopplers."""
    if geometry.terrain is None:
        return ""
    low, high = geometry.terrain.limits
    return f", or correct the terrain's heights (unit, datum) if they are not z = {low:.6g} .. {high:.6g} m"


def _plan_spectrum(geometry: Geometry, region: Region, line: Line, *, padded: int, band_edge: float) -> Axis:
    """Doppler axis of the recovered spectrum: everything lit, at all range frequencies, with a margin for tails."""
    low, high = float(line.doppler.min()), float(line.doppler.max())
    dwell = float(np.max(np.subtract(*geometry.beam.dwell_at(region.yaw, (region.near + region.far) / 2)[::-1])))
    margin = tail_margin(dwell)
    duration = padded * geometry.collection.pulse_interval
    edge = band_edge * max(abs(low), abs(high))
    size = fourier.fast_length(duration * (high - low + 2 * edge + 2 * margin))
    size = max(size, fourier.fast_length(padded))
    return fourier.centred(np.round((low + high) / 2 * duration) / duration, 1 / duration, size)


def _bulk_cycles(geometry: Geometry, common: CommonRange, *, origin: float, walk: float, region: Region) -> FloatArray:
    """Phase, cycles on the carrier, per pulse, from the stored reference range to the chain's range origin."""
    collection = geometry.collection
    time = collection.time
    slow = time - geometry.epoch
    misfit = geometry.track.misfit
    beam = geometry.beam.centre_yaw(time, origin, float(region.yaw[0]), float(region.yaw[-1]))
    sight = geometry.ground_point(np.full(time.size, origin), beam) - geometry.track.position(time)
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    unmodelled = -np.einsum("ij,ij->i", sight, misfit)  # range that the polynomial track lacks
    to_cycles = -2 * collection.carrier / SPEED_OF_LIGHT
    return np.asarray(to_cycles * (origin + walk * slow + common.at(slow) - collection.reference_range + unmodelled))


def _common_range(geometry: Geometry, centre: FloatArray) -> CommonRange:
    """Range history of the region's centre (3,), m, from COMMON_ORDER on; zero if below COMMON_LEAST."""
    track = geometry.track
    # Range is as smooth as the track: somewhat more than twice its order suffices.
    nodes = chebyshev.chebpts1(2 * track.order + 16)
    sight = centre - track.base.position(track.centre + track.half * nodes)
    rng = np.sqrt((sight * sight).sum(axis=-1))
    series = solvers.chebyshev_series(nodes, rng, nodes.size - 1)
    series[:COMMON_ORDER] = 0
    if np.abs(series).sum() < COMMON_LEAST * geometry.collection.wavelength:
        return NO_COMMON_RANGE
    return CommonRange(series=np.asarray(series), centre=track.centre - geometry.epoch, half=track.half)


def _lit_lines(
    geometry: Geometry, region: Region, origin: float, walk: float, common: CommonRange, *, margin: float
) -> Line:
    """Lines of targets over the region, except for `margin` at either end of the range window.

    Under a beam about its axis (n_target, n), of the lit targets only.
    """
    near, far = region.at(region.yaw)
    width = far - near
    ranges = np.linspace(near + margin * width, far - margin * width, 5)
    if not geometry.beam.by_range:
        return Dwells(geometry=geometry, yaw=region.yaw, origin=origin, walk=walk, common=common).lines(ranges)
    lines = Dwells(
        geometry=geometry, yaw=region.yaw, origin=origin, walk=walk, common=common, least_nodes=AXIS_NODES
    ).lines(ranges)  # fmt: skip
    first, last = geometry.beam.dwell_at(region.yaw, ranges)
    return Line(**{name: getattr(lines, name)[last > first] for name in Line.__dataclass_fields__})
