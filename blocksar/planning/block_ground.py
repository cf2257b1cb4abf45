"""The map from the ground to a focused block, by where the lines of targets focus; on a terrain also by height."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from blocksar import solvers
from blocksar.arrays import BoolArray, FloatArray
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.focusing.ground_map import YAW_STEPS, GroundMap, NodeHeights, by_range, straighten, surfaces
from blocksar.focusing.lines import LEAST_STRETCH, Focus
from blocksar.focusing.step import Sampling
from blocksar.focusing.surfaces import Surface, fit_surface
from blocksar.kernels.interpolation import taps_needed
from blocksar.planning.binding import AzimuthPart
from blocksar.planning.block_lines import MORE_RANGES, FineLines, retrace, trace_finely
from blocksar.planning.block_sampling import range_scale
from blocksar.planning.relief import Layer, map_relief, turns_of
from blocksar.planning.sector import Sector

RANGE_DEGREE, YAW_DEGREE = 0.75, 16  # of what the map knows, along range for each node, and along yaw
MISS_SHARE = 0.1  # of the coherence that may be lost, which the map may miss before lines at more ranges are traced
SWING = 2e-3  # cycles by which a series of that degree along yaw may miss the phase on a track that wobbles
REGION_STEPS, LEAST_STEPS = 64 * YAW_STEPS, 128  # of yaw over the region, in which a block has its share; at least
STEPS_BY_RANGE = 512  # of yaw, where the sum over lit pulses is a table over range and yaw


def plan_ground(sector: Sector, azimuth: AzimuthPart, sampling: Sampling, lines: FineLines) -> GroundMap:
    """The map of a block with its sampling; lines (n_range, n_yaw) are through the whole chain."""
    ground = _on_smooth_ground(sector, sampling, lines)
    return ground if sector.relief is None else _raise(sector, azimuth, ground, lines)


def _on_smooth_ground(sector: Sector, sampling: Sampling, lines: FineLines) -> GroundMap:
    collection = sector.geometry.collection
    offset, doppler_focus, phase, gain, dwell_time = _surfaces(sector, lines, lines.spots)
    yaw_axis = np.linspace(sector.low, sector.high, _yaw_steps(sector))
    near_limit, far_limit = sector.region.at(yaw_axis)
    # Of the sampling rate, what a target's response fills along Doppler without its own carrier.
    reach = np.abs(lines.line.time - _carrier_time(sector, lines, lines.spots)[..., None]).max()
    filled = float(min(2.2 * reach * sampling.image_doppler.step, 0.9))
    return GroundMap(
        geometry=sector.geometry,
        low=sector.low,
        high=sector.high,
        near=sector.near,
        far=sector.far,
        origin=sector.recovery.origin,
        rows=sampling.rows,
        doppler=sampling.image_doppler,
        range_offset=offset,
        doppler_focus=doppler_focus,
        phase=phase,
        gain=gain,
        time=dwell_time,
        common=None if sampling.gate is None else sampling.gate.common,
        yaw_axis=yaw_axis,
        near_limit=near_limit,
        far_limit=far_limit,
        taper=sector.taper,
        range_taper=sector.weighting.range,
        scale=range_scale(collection, sampling.range_frequency, sampling.range_period, sector.weighting.range),
        range_taps=(taps_needed(sampling.range_occupancy, error=sector.tap_error), sampling.range_occupancy),
        doppler_taps=(taps_needed(filled, error=sector.tap_error), filled),
        tap_error=sector.tap_error,
        tilt=None if lines.weights.elevation is None else _tilt(sector, lines),
    )


def _tilt(sector: Sector, lines: FineLines) -> Surface:
    """How fast what the chain makes of echoes grows over the dwell, from -1 to 1, over its mean: see `GroundMap`."""
    time, weight = lines.lit.time, lines.weights.weigh_chain(lines.line).weight
    place = 2 * (time - time[..., :1]) / (time[..., -1:] - time[..., :1]) - 1
    made = np.sqrt(np.maximum(lines.line.stretch, LEAST_STRETCH))
    total = weight.sum(axis=-1)
    middle = ((weight * place).sum(axis=-1) / total)[..., None]
    slope = (weight * (place - middle) * made).sum(axis=-1) / (weight * (place - middle) ** 2).sum(axis=-1)
    tilt = slope * total / (weight * made).sum(axis=-1)
    return fit_surface(tilt, along=sector.ground_range, yaw=lines.yaw, degree=_degree(sector, lines))


def _surfaces(sector: Sector, lines: FineLines, spots: Focus) -> tuple[Surface, ...]:
    """Find what the map knows of a focus, over range and yaw."""
    return surfaces(
        spots, time=_carrier_time(sector, lines, spots), along=sector.ground_range, epoch_range=lines.epoch_range,
        yaw=lines.yaw, origin=sector.recovery.origin, carrier=sector.geometry.collection.carrier,
        degree=_degree(sector, lines),
    )  # fmt: skip


def trace_for_map(sector: Sector, azimuth: AzimuthPart) -> tuple[AzimuthPart, FineLines]:
    """`trace_finely`, at more ranges where the map's series would miss too much of where the lines focus."""
    traced = trace_finely(sector, azimuth)
    lines = traced[1]
    at, fitted = (lines.epoch_range[:, None], lines.yaw), _surfaces(sector, lines, lines.spots)
    offset, doppler, phase = (known(*at) for known in fitted[:3])
    missed = _missed(sector.geometry.collection, sector.recovery.origin, lines, lines.spots, (offset, doppler, phase))
    if np.where(lines.ends.full, missed, 0.0).max() <= MISS_SHARE * (1 - sector.fidelity):
        return traced
    return trace_finely(sector, azimuth, n_range=MORE_RANGES)


def map_loss(ground: GroundMap, lines: FineLines, seen: BoolArray, layers: Sequence[Layer]) -> float:
    """Loss of coherence where the map's series miss where lines focus, at the worst of the targets `seen`.

    On a terrain those of some layers of targets over it.
    """
    at, of = (lines.epoch_range[:, None], lines.yaw), (ground.geometry.collection, ground.origin, lines)
    if ground.relief is None:
        known = ground.range_offset(*at), ground.doppler_focus(*at), ground.phase(*at)
        missed = [_missed(*of, lines.spots, known)]
    else:
        missed = []
        epoch_range, yaw = np.broadcast_arrays(*at)
        for layer in layers:
            z = np.broadcast_to(layer.geometry.level(*at), yaw.shape)
            offset, doppler, phase, _, _, bend, _ = ground.relief(epoch_range, yaw, z)
            missed.append(_missed(*of, layer.spots, (offset, doppler, phase), bend - layer.bend))
    return float(np.where(seen, missed, 0.0).max())


def _missed(
    collection: Collection, origin: float, lines: FineLines, spots: Focus,
    known: tuple[FloatArray, FloatArray, FloatArray], bend: FloatArray | float = 0.0,
) -> FloatArray:  # fmt: skip
    """Loss of coherence (n_range, n_yaw) where range offset, Doppler and phase that are known miss the focus of lines.

    A pixel that is displaced by f in Doppler and r in range, in an image with the phase p too much, has the coherence
    sinc(f T) sinc(2 B r / c) cos(p) over a dwell T with the one meant; a bend b too much, a phase 2 pi b t^2 whose
    variance is (2 pi b)^2 T^4 / 180, takes half of that.
    """
    offset = (lines.epoch_range - origin)[:, None]
    displaced, doppler = spots.range - offset - known[0], spots.doppler - known[1]
    phase = spots.phase + 2 * collection.carrier / SPEED_OF_LIGHT * offset - known[2]
    dwell = (lines.line.weight * lines.line.stretch).sum(axis=-1)
    turns = (np.pi * doppler * dwell) ** 2 + (2 * np.pi * collection.bandwidth / SPEED_OF_LIGHT * displaced) ** 2
    return np.asarray(turns / 6 + (2 * np.pi * phase) ** 2 / 2 + (2 * np.pi * bend * dwell**2) ** 2 / 360)


def _degree(sector: Sector, lines: FineLines) -> tuple[int, int]:
    """Degrees of the surfaces along range and yaw: as many terms as yaws where a wobble swings the phase over these.

    A turning beam lights one yaw after the other. What is left of the waves of the track then runs along yaw.
    """
    in_range = int(RANGE_DEGREE * lines.epoch_range.size)
    if sector.geometry.track.wobble is None:
        return in_range, YAW_DEGREE
    phase = lines.spots.phase.T
    series = solvers.node_series(phase, YAW_DEGREE)
    missed = np.polynomial.chebyshev.chebval(solvers.end_nodes(lines.yaw.size), series).T - phase
    return in_range, YAW_DEGREE if np.abs(missed).max() <= SWING else lines.yaw.size - 1


def _carrier_time(sector: Sector, lines: FineLines, spots: Focus) -> FloatArray:
    """Time (n_range, n_yaw), s, about which a target's response is interpolated along Doppler: the middle of its dwell.

    No series follows the mean of the weights where a pattern in elevation has zeros.
    """
    if sector.geometry.collection.elevation_pattern is None or lines.weights.uniform:
        return spots.time
    return np.asarray((spots.line.time[..., 0] + spots.line.time[..., -1]) / 2)


def _yaw_steps(sector: Sector) -> int:
    """Yaws at which a block knows its limits: its share of the region's, so that many narrow blocks are small."""
    step = float(np.ptp(sector.region.yaw)) / REGION_STEPS
    share = (sector.high - sector.low) / step if step > 0 else math.inf
    return math.ceil(min(max(share, LEAST_STEPS), STEPS_BY_RANGE if by_range(sector.geometry) else YAW_STEPS))


def _raise(sector: Sector, azimuth: AzimuthPart, ground: GroundMap, lines: FineLines) -> GroundMap:
    """The map with the terrain's heights, from lines over the smooth ground at several heights."""
    relief, rng, yaw = sector.relief, lines.epoch_range, lines.yaw
    assert relief is not None
    layers = [_layer(sector, azimuth, lines, sector.over(offset).geometry) for offset in relief.offsets.tolist()]
    turns = []
    if sector.geometry.collection.has_axis:
        turns = [turns_of(layer.geometry, sector.geometry, rng, yaw) for layer in layers]
        ground = ground.widened(sector.region, float(np.abs(turns).max()))
    by_height = map_relief(
        relief, layers, lambda spots: _surfaces(sector, lines, spots), along=sector.ground_range, yaw=yaw,
        degree=_degree(sector, lines), turns=turns,
    )  # fmt: skip
    return replace(ground, relief=by_height)


def usual_layer(sector: Sector, azimuth: AzimuthPart, lines: FineLines) -> tuple[Layer, BoolArray]:
    """Lines of targets at usual heights of a terrain, and which (n_range, n_yaw) of them there are."""
    assert sector.relief is not None
    usual, known = sector.relief.usual(lines.epoch_range.size, lines.yaw.size)
    return _at_heights(sector, azimuth, lines, usual), known if known.any() else np.ones_like(known)


def end_layers(sector: Sector, azimuth: AzimuthPart, lines: FineLines) -> list[Layer]:
    """Lines of targets that lie low and of such that lie high on a terrain."""
    assert sector.relief is not None
    ends = sector.relief.usual_ends(lines.epoch_range.size, lines.yaw.size)
    return [_at_heights(sector, azimuth, lines, heights) for heights in ends]


def _at_heights(sector: Sector, azimuth: AzimuthPart, lines: FineLines, over: FloatArray) -> Layer:
    """Lines of targets at heights (n_range, n_yaw), m, over the finer smooth ground."""
    assert sector.relief is not None
    return _layer(sector, azimuth, lines, sector.geometry.over(None, NodeHeights(smooth=sector.relief.fine, over=over)))


def _layer(sector: Sector, azimuth: AzimuthPart, lines: FineLines, geometry: Geometry) -> Layer:
    """The lines of targets on another ground, straightened, with the weights of their dwells."""
    line, rate = retrace(replace(sector, geometry=geometry), azimuth, lines)
    summed = lines.weights.weigh_chain(line)
    straight, bend, spots = straighten(summed, lambda spots: _carrier_time(sector, lines, spots))
    return Layer(geometry, replace(straight, weight=line.weight), bend, spots, rate)
