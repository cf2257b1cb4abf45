"""The map from the ground to a focused block, by where the lines of targets focus; on a terrain also by height."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from blocksar import solvers
from blocksar.arrays import BoolArray, FloatArray
from blocksar.collection.geometry import Geometry
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.focusing.ground_map import YAW_STEPS, GroundMap, by_range, surfaces
from blocksar.focusing.lines import LEAST_STRETCH, Focus
from blocksar.focusing.relief_map import NodeHeights, straighten
from blocksar.focusing.sampling import Sampling
from blocksar.focusing.surfaces import Surface, fit_surface
from blocksar.kernels.interpolation import taps_needed
from blocksar.planning.aperture_waves import plan_waves
from blocksar.planning.binding import AzimuthPart
from blocksar.planning.block_lines import FineLines, retrace
from blocksar.planning.relief import Layer, map_relief, turns_of
from blocksar.planning.row_sampling import range_scale
from blocksar.planning.sector import Sector

SURFACE_DEGREE = 9, 16  # of what the map knows, along range and yaw
SWING = 2e-3  # cycles by which a series of that degree along yaw may miss the phase on a track that wobbles
REGION_STEPS, LEAST_STEPS = 64 * YAW_STEPS, 128  # of yaw over the region, in which a block has its share; at least
STEPS_BY_RANGE = 512  # of yaw, where the sum over lit pulses is a table over range and yaw


def plan_ground(sector: Sector, azimuth: AzimuthPart, sampling: Sampling, lines: FineLines) -> GroundMap:
    """The map of a block with its sampling; lines (n_range, n_yaw) are through the whole chain."""
    ground = _on_smooth_ground(sector, sampling, lines)
    if sector.staying is not None and not sector.taper.uniform:
        waves = plan_waves(
            sector.staying, sector.taper, lines.lit, lines.line, epoch_range=lines.epoch_range, yaw=lines.yaw
        )
        ground = replace(ground, waves=waves)
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
        geometry=sector.lit,
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
        stays=sector.staying is not None,
        scale=range_scale(collection, sampling.range_frequency, sampling.range_period, sector.weighting.range),
        range_taps=(taps_needed(sampling.range_occupancy, error=sector.tap_error), sampling.range_occupancy),
        doppler_taps=(taps_needed(filled, error=sector.tap_error), filled),
        tap_error=sector.tap_error,
        tapered=None if sector.wobbling is None else sector.geometry,
        tilt=None if lines.weights.elevation is None else _tilt(sector, lines),
    )


def _tilt(sector: Sector, lines: FineLines) -> Surface:
    """How fast what the chain makes of echoes grows over the dwell, from -1 to 1, over its mean: see `GroundMap`."""
    time, weight = lines.lit.time, lines.weights.weigh_chain(lines.line).weight
    place = 2 * (time - time[..., :1]) / (time[..., -1:] - time[..., :1]) - 1
    made = np.sqrt(np.maximum(lines.line.stretch, LEAST_STRETCH)) * lines.spots.levels
    total = weight.sum(axis=-1)
    middle = ((weight * place).sum(axis=-1) / total)[..., None]
    slope = (weight * (place - middle) * made).sum(axis=-1) / (weight * (place - middle) ** 2).sum(axis=-1)
    tilt = slope * total / (weight * made).sum(axis=-1)
    return fit_surface(tilt, epoch_range=lines.epoch_range, yaw=lines.yaw, degree=_degree(sector, lines))


def _surfaces(sector: Sector, lines: FineLines, spots: Focus) -> tuple[Surface, ...]:
    """What the map knows of a focus, over range and yaw."""
    return surfaces(
        spots, time=_carrier_time(sector, lines, spots), epoch_range=lines.epoch_range, yaw=lines.yaw,
        origin=sector.recovery.origin, carrier=sector.geometry.collection.carrier, degree=_degree(sector, lines),
    )  # fmt: skip


def map_loss(ground: GroundMap, lines: FineLines, seen: BoolArray) -> float:
    """Loss of coherence where the map's series miss where lines focus, at the worst of the targets `seen`.

    Close to the nadir the ground under a range R is sqrt(R^2 - h^2) away, and no polynomial of R follows that. A pixel
    that is displaced by f in Doppler and r in range, in an image with the phase p too much, has the coherence
    sinc(f T) sinc(2 B r / c) cos(p) over a dwell T with the one meant.
    """
    spots, at = lines.spots, (lines.epoch_range[:, None], lines.yaw)
    offset = at[0] - ground.origin
    doppler = spots.doppler - ground.doppler_focus(*at)
    displaced = spots.range - offset - ground.range_offset(*at)
    collection = ground.geometry.collection
    phase = spots.phase + 2 * collection.carrier / SPEED_OF_LIGHT * offset - ground.phase(*at)
    dwell = (lines.line.weight * lines.line.stretch).sum(axis=-1)
    turns = (np.pi * doppler * dwell) ** 2 + (2 * np.pi * collection.bandwidth / SPEED_OF_LIGHT * displaced) ** 2
    return float(np.where(seen, turns / 6 + (2 * np.pi * phase) ** 2 / 2, 0.0).max())


def _degree(sector: Sector, lines: FineLines) -> tuple[int, int]:
    """Degrees of the surfaces along range and yaw: as many terms as yaws where a wobble swings the phase over these.

    A turning beam lights one yaw after the other. What is left of the waves of the track then runs along yaw.
    """
    if sector.geometry.track.wobble is None:
        return SURFACE_DEGREE
    phase = lines.spots.phase.T
    series = solvers.node_series(phase, SURFACE_DEGREE[1])
    missed = np.polynomial.chebyshev.chebval(solvers.end_nodes(lines.yaw.size), series).T - phase
    return SURFACE_DEGREE if np.abs(missed).max() <= SWING else (SURFACE_DEGREE[0], lines.yaw.size - 1)


def _carrier_time(sector: Sector, lines: FineLines, spots: Focus) -> FloatArray:
    """Time (n_range, n_yaw), s, about which a target's response is interpolated along Doppler: the middle of its dwell.

    Where all pulses are summed their weights can tilt, up to ten to one at the rim of a beam. Their mean would leave
    the first or the last of them beyond what the taps pass. Nor does a series follow it where a pattern in elevation
    has zeros.
    """
    tilted = sector.staying is not None or sector.geometry.collection.elevation_pattern is not None
    if not tilted or lines.weights.uniform:
        return spots.time
    return np.asarray((spots.line.time[..., 0] + spots.line.time[..., -1]) / 2)


def _yaw_steps(sector: Sector) -> int:
    """Yaws at which a block knows its limits: its share of the region's, so that many narrow blocks are small."""
    step = float(np.ptp(sector.region.yaw)) / REGION_STEPS
    share = (sector.high - sector.low) / step if step > 0 else math.inf
    return math.ceil(min(max(share, LEAST_STEPS), STEPS_BY_RANGE if by_range(sector.lighting) else YAW_STEPS))


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
        relief, layers, lambda spots: _surfaces(sector, lines, spots), epoch_range=rng, yaw=yaw,
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
