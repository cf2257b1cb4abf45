"""Plan of one angular block: slab, chain of steps, coefficients, sampling, dwell gate and ground map.

The dwell gate follows the lines of targets. The ground map leads from the ground to the focused block, to where those
lines focus; on a terrain also by height.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from blocksar import solvers
from blocksar.arrays import BoolArray, FloatArray
from blocksar.chunks import DOPPLER_GROUP
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import AxisTaper
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import OutsideSwath
from blocksar.imaging.method import Method
from blocksar.kernels.fourier import Axis
from blocksar.kernels.interpolation import taps_needed
from blocksar.processors.chain.dwells.target_lines import Sector, tail_margin
from blocksar.processors.chain.ground.ground_map import (
    QUANTITIES,
    YAW_STEPS,
    GroundMap,
    NodeHeights,
    ReliefMap,
    by_range,
    straighten,
)
from blocksar.processors.chain.ground.relief import Relief, turns_of
from blocksar.processors.chain.ground.surfaces import Surface, fit_surface
from blocksar.processors.chain.planning.binding import AzimuthPart, RangePart, Slab, plan_motion
from blocksar.processors.chain.planning.block_lines import (
    MORE_RANGES,
    CoarseLines,
    TracedTargets,
    common_ranges,
    retrace,
    trace_finely,
    under_tiles,
    with_level_aperture,
)
from blocksar.processors.chain.planning.block_sampling import plan_sampling, plan_slab, range_scale
from blocksar.processors.chain.planning.coefficients import Choice, choose
from blocksar.processors.chain.planning.fitting import ORDERS
from blocksar.processors.chain.planning.gating import plan_dwell_gate, plan_range_gate
from blocksar.processors.chain.planning.prediction import ImageEdges, JudgedTargets, Prediction, predict, worst_lobes
from blocksar.processors.chain.planning.worker_memory import RELIEF_MEMORY, block_memory
from blocksar.processors.chain.steps.chains import steps_of
from blocksar.processors.chain.steps.lines import LEAST_STRETCH, Focus, Line
from blocksar.processors.chain.steps.range_gate import RangeGate
from blocksar.processors.chain.steps.step import Constants, Sampling, Stage, Step, stages


@dataclass(frozen=True, kw_only=True, eq=False)
class BlockPlan:
    """One angular block: its part of the spectrum, its chain, its ground map.

    Attributes
    ----------
    index : int
    part : int or None
        Number of the range sub-block; None for a whole block.
    low, high : float
        Yaw interval, rad.
    first_bin, n_bin : int
        Doppler slab of the recovered spectrum.
    range_gate : RangeGate or None
        Of a sub-block, which one task applies for all sub-blocks; None for a whole block.
    steps : tuple of Step
        Those that the block's own tasks apply.
    sampling : Sampling
        The axes of the block's samples along the chain.
    ground : GroundMap
    prediction : Prediction
    memory : int
        Peak memory of a worker that focuses the block, bytes.
    choice : Choice
        The chosen kind of chain. Its bias is the range acceleration that the time perturbation adds, m/s^2.
    """

    index: int
    part: int | None
    low: float
    high: float
    first_bin: int
    n_bin: int
    range_gate: RangeGate | None
    steps: tuple[Step, ...]
    sampling: Sampling
    ground: GroundMap
    prediction: Prediction
    memory: int
    choice: Choice

    def __repr__(self) -> str:
        return f"<BlockPlan {self.name}: yaw {self.low:.6g} .. {self.high:.6g} rad, {self.n_bin} Doppler bins>"

    @property
    def chain(self) -> tuple[Step, ...]:
        """All steps, the range gate first."""
        return self.steps if self.range_gate is None else (self.range_gate, *self.steps)

    @property
    def stages(self) -> list[Stage]:
        """Stages that are run, in order."""
        return stages(self.steps)

    @property
    def even(self) -> bool:
        """Tell whether a Doppler resampling, if any, can be applied to all of the block's Doppler bins."""
        return all(step.even for step in self.chain)

    @property
    def name(self) -> str:
        return str(self.index) if self.part is None else f"{self.index}.{self.part}"


def plan_block(
    sector: Sector, method: Method, *, index: int, part: int | None = None, neighbour: Choice | None = None
) -> BlockPlan:
    """Plan one block, or a range sub-block of it.

    Parameters
    ----------
    sector : Sector
    method : Method
    index : int
    part : int or None
        Number of the range sub-block; None for a whole block.
    neighbour : Choice or None
        The kind of chain of the sub-block before, taken if it serves here too; None to choose it.

    A Doppler resampling is fitted on the lines of the block, and applied to all Doppler bins: of a narrow block these
    reach many times as far, where its highest orders may fold Doppler. It then has fewer of them.

    Raises
    ------
    OutsideSwath
        If none of its targets are lit; on a terrain, of those on the smooth part.
    """
    for resampling in range(len(ORDERS), -1, -1):
        block = _plan_block(sector, method, index=index, part=part, neighbour=neighbour, resampling=resampling)
        if block.even or method.coefficients == "closed-form":
            break
    return block


def _plan_block(
    sector: Sector, method: Method, *, index: int, part: int | None, neighbour: Choice | None, resampling: int
) -> BlockPlan:
    """Plan a block as `plan_block` does, with a Doppler resampling of at most `resampling` orders."""
    collection = sector.geometry.collection
    band = Axis(float(collection.range_frequency[0]), collection.range_frequency_step, collection.n_range_frequency)

    # Coarse lines, as far as range compression: the slab, and the steps with their coefficients.
    coarse = CoarseLines.of(sector)
    if coarse.duration <= 0:
        raise OutsideSwath(
            f"block {index} lies outside the swath: the beam lights none of its ground, yaw "
            f"{np.degrees(sector.low):.2f} .. {np.degrees(sector.high):.2f} degrees; move the grid"
        )
    margin = tail_margin(coarse.duration)
    slab = plan_slab(collection, sector.recovery.doppler, coarse.everywhere, margin=margin)
    range_gate = None if part is None else plan_range_gate(band, slab.doppler, coarse.everywhere, collection.carrier)
    constants = _constants(sector, slab, band, coarse.line)
    range_part = RangePart.bind(steps_of(method, measured=constants.motion is not None), constants, coarse.line)
    straight = range_part.trace(coarse.line)
    azimuth, choice = _plan_azimuth(
        sector, range_part, method, straight, coarse, neighbour=neighbour, resampling=resampling
    )

    # Fine lines, through the whole chain: the sampling, the gate, the ground map and the prediction.
    azimuth = with_level_aperture(sector, azimuth)
    lines = trace_for_map(sector, azimuth)
    sampling = plan_sampling(
        sector, slab, azimuth, straight if sector.relief is None else range_part.trace(coarse.everywhere), lines,
        range_frequency=band if range_gate is None else range_gate.range_frequency, duration=coarse.duration,
    )  # fmt: skip
    sampling = replace(sampling, gate=plan_dwell_gate(sector, azimuth, sampling, lines))
    ground = plan_ground(sector, azimuth, sampling, under_tiles(sector, azimuth, lines))
    return BlockPlan(
        index=index, part=part, low=sector.low, high=sector.high, first_bin=slab.first_bin, n_bin=slab.doppler.size,
        range_gate=range_gate, steps=azimuth.sampled(sampling), sampling=sampling, ground=ground,
        prediction=_predict(sector, azimuth, sampling, lines, ground),
        memory=_plan_memory(sector, range_gate, range_part, sampling), choice=choice,
    )  # fmt: skip


def _constants(sector: Sector, slab: Slab, band: Axis, line: Line) -> Constants:
    """Constants of the block that its steps bind."""
    recovery, pulses = sector.recovery, sector.recovery.pulses
    return Constants(
        carrier=sector.geometry.collection.carrier,
        walk=slab.walk,
        reference=sector.reference(),
        middle=float((line.time.min() + line.time.max()) / 2),
        motion=plan_motion(
            sector.geometry, near=sector.near, far=sector.far, origin=recovery.origin, low=sector.low, high=sector.high
        ),
        in_range=AxisTaper.over(sector.weighting.range, band.start, band.step, band.size),
        in_time=None
        if sector.geometry.collection.steered
        else AxisTaper.over(sector.weighting.azimuth, pulses.start, pulses.step, pulses.size),
    )


def _plan_azimuth(
    sector: Sector,
    range_part: RangePart,
    method: Method,
    straight: Line,
    coarse: CoarseLines,
    *,
    neighbour: Choice | None,
    resampling: int,
) -> tuple[AzimuthPart, Choice]:
    """Plan the steps after range compression, with coefficients for targets that share an apparent range."""
    recovery, dwells = sector.recovery, coarse.dwells
    ranges, epoch_range = common_ranges(
        lambda at: range_part.trace(dwells.lines(at)),
        straight,
        coarse.nodes,
        origin=recovery.origin,
        least=(coarse.nodes[0] + sector.geometry.epoch_position[2] - sector.geometry.collection.ground_height) / 2,
    )
    shared = range_part.trace(dwells.lines(epoch_range))
    polynomials, choice = choose(
        sector.geometry,
        shared,
        range_part,
        method,
        ranges=ranges,
        epoch_range=epoch_range,
        yaws=dwells.yaw,
        shift=-2 / sector.geometry.collection.wavelength * recovery.walk + range_part.constants.walk,
        fidelity=sector.fidelity,
        neighbour=neighbour,
        resampling=resampling,
    )
    return AzimuthPart.bind(range_part, polynomials, straight), choice


def _predict(
    sector: Sector, azimuth: AzimuthPart, sampling: Sampling, lines: TracedTargets, ground: GroundMap
) -> Prediction:
    """Predict the quality from the block's lines; on a terrain, from targets at its usual heights.

    Side lobes also from those of targets that lie low, and of such that lie high.
    """
    imaged = (
        ImageEdges.between(lines.yaw, *(np.full(lines.epoch_range.size, yaw) for yaw in sector.imaged), axis=1),
        ImageEdges.between(lines.epoch_range, *sector.region.at(lines.yaw), axis=0),
    )
    gate, band = sampling.gate, sector.weighting.range
    seen = np.logical_and.reduce([lines.full, *(each.held for each in imaged)])
    if sector.relief is None:
        predicted, layers = predict(lines, gate, imaged=imaged, band=band), []
    else:
        shape = lines.epoch_range.size, lines.yaw.size
        usual, reached = sector.relief.usual(*shape)
        reached = reached if reached.any() else np.ones_like(reached)
        grounds = (
            sector.geometry.over(None, NodeHeights(smooth=sector.relief.fine, over=heights))
            for heights in (usual, *sector.relief.usual_ends(*shape))
        )
        layers = [_layer(sector, azimuth, lines, ground) for ground in grounds]
        predicted = predict(layers[0].targets, gate, reached=reached, imaged=imaged, band=band)
        for targets, _ in layers[1:]:
            masks = JudgedTargets.of(targets, reached, imaged)
            predicted = predicted.or_lobes(worst_lobes(targets, gate, masks, band=band))
        seen &= reached
    return predicted.less(sector.beam_loss, map_loss(ground, lines, seen, layers))


def _plan_memory(sector: Sector, range_gate: RangeGate | None, range_part: RangePart, sampling: Sampling) -> int:
    """Peak memory of a worker that focuses the block, bytes."""
    margin = 0 if range_gate is None else 2 * DOPPLER_GROUP  # its slab in whole chunks
    lengthened = any(step.lengthens_rows for step in range_part.steps)
    chain_memory = block_memory(
        n_short=sampling.time.size if lengthened else 0,
        frequency=sampling.range_frequency,
        n_bin=sampling.slab.size + margin,
        n_column=(sampling.doppler if range_part.compression.in_doppler else sampling.time).size,
        n_row=sampling.rows.size,
        n_image=sampling.image_doppler.size,
        length=max(sampling.long_time.size, sampling.range_period),
    )
    return chain_memory + (0 if sector.relief is None else RELIEF_MEMORY)


RANGE_DEGREE, YAW_DEGREE = 0.75, 16  # of what the map knows, along range for each node, and along yaw
MISS_SHARE = 0.1  # of the coherence that may be lost, which the map may miss before lines at more ranges are traced
REGION_STEPS = 64 * YAW_STEPS  # of yaw over the region, in which a block has its share
STEPS_BY_RANGE = 512  # of yaw, where the sum over lit pulses is a table over range and yaw


def plan_ground(sector: Sector, azimuth: AzimuthPart, sampling: Sampling, targets: TracedTargets) -> GroundMap:
    """Make the map from the ground to samples of a focused block; on a terrain also over height."""
    collection, z = sector.geometry.collection, sector.geometry.collection.ground_height
    degree = _degree(sector, targets)
    offset, doppler_focus, phase, gain, dwell_time = _surfaces(sector, targets, degree)
    yaw_axis = np.linspace(sector.low, sector.high, _yaw_steps(sector))
    near_limit, far_limit = sector.region.at(yaw_axis)
    # The share of the sampling rate that a target's response occupies along Doppler without its carrier.
    reach = np.abs(targets.line.time - _carrier_time(targets, targets.spots)[..., None]).max()
    filled = float(min(2.2 * reach * sampling.image_doppler.step, 0.9))
    ground = GroundMap(
        geometry=sector.geometry,
        low=sector.low,
        high=sector.high,
        near=sector.near,
        far=sector.far,
        levels=(z, z),
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
        tilt=None if targets.weights.elevation is None else _tilt(sector, targets, degree),
    )
    return ground if sector.relief is None else _raise(sector, sector.relief, azimuth, ground, targets, degree)


def _tilt(sector: Sector, lines: TracedTargets, degree: tuple[int, int]) -> Surface:
    """Relative slope over the dwell, -1 to 1, of the amplitude that the chain gives echoes: see `GroundMap`."""
    time, weight = lines.lit.time, lines.weights.weigh_chain(lines.line).weight
    place = 2 * (time - time[..., :1]) / (time[..., -1:] - time[..., :1]) - 1
    made = np.sqrt(np.maximum(lines.line.stretch, LEAST_STRETCH))
    total = weight.sum(axis=-1)
    middle = ((weight * place).sum(axis=-1) / total)[..., None]
    slope = (weight * (place - middle) * made).sum(axis=-1) / (weight * (place - middle) ** 2).sum(axis=-1)
    tilt = slope * total / (weight * made).sum(axis=-1)
    return fit_surface(tilt, along=sector.ground_range, yaw=lines.yaw, degree=degree)


def _surfaces(sector: Sector, targets: TracedTargets, degree: tuple[int, int]) -> list[Surface]:
    """Range offset, Doppler, phase, gain and carrier time where targets focus, over range and yaw."""
    spots, offset = targets.spots, (targets.epoch_range - sector.recovery.origin)[:, None]
    carrier_cycles = -2 * sector.geometry.collection.carrier / SPEED_OF_LIGHT * offset
    values = (
        spots.range - offset, spots.doppler, spots.phase - carrier_cycles, spots.gain, _carrier_time(targets, spots)
    )  # fmt: skip
    return [fit_surface(each, along=sector.ground_range, yaw=targets.yaw, degree=degree) for each in values]


def trace_for_map(sector: Sector, azimuth: AzimuthPart) -> TracedTargets:
    """Trace as `trace_finely`, at more ranges if the map's series would miss the focus of lines by too much."""
    lines = trace_finely(sector, azimuth)
    at, fitted = (lines.epoch_range[:, None], lines.yaw), _surfaces(sector, lines, _degree(sector, lines))
    offset, doppler, phase = (known(*at) for known in fitted[:3])
    missed = _missed(lines, sector.recovery.origin, (offset, doppler, phase))
    if np.where(lines.full, missed, 0.0).max() <= MISS_SHARE * (1 - sector.fidelity):
        return lines
    return trace_finely(sector, azimuth, n_range=MORE_RANGES)


def map_loss(ground: GroundMap, lines: TracedTargets, seen: BoolArray, layers: Sequence[Layer]) -> float:
    """Loss of coherence from errors of the map's series, at the worst of the targets `seen`.

    On a terrain those of some layers of targets over it.
    """
    at = lines.epoch_range[:, None], lines.yaw
    if ground.relief is None:
        known = ground.range_offset(*at), ground.doppler_focus(*at), ground.phase(*at)
        missed = [_missed(lines, ground.origin, known)]
    else:
        missed = []
        epoch_range, yaw = np.broadcast_arrays(*at)
        for layer, own_bend in layers:
            z = np.broadcast_to(layer.geometry.level(*at), yaw.shape)
            offset, doppler, phase, _, _, bend, _ = ground.relief(epoch_range, yaw, z)
            missed.append(_missed(layer, ground.origin, (offset, doppler, phase), bend - own_bend))
    return float(np.where(seen, missed, 0.0).max())


def _missed(
    targets: TracedTargets, origin: float, known: tuple[FloatArray, FloatArray, FloatArray],
    bend: FloatArray | float = 0.0,
) -> FloatArray:  # fmt: skip
    """Loss of coherence (n_range, n_yaw) from errors of range offset, Doppler and phase relative to the focus.

    A pixel that is displaced by f in Doppler and r in range, in an image with the phase p too much, has the coherence
    sinc(f T) sinc(2 B r / c) cos(p) over a dwell T with the one meant; a bend b too much, a phase 2 pi b t^2 whose
    variance is (2 pi b)^2 T^4 / 180, takes half of that.
    """
    collection, spots, line = targets.geometry.collection, targets.spots, targets.line
    offset = (targets.epoch_range - origin)[:, None]
    displaced, doppler = spots.range - offset - known[0], spots.doppler - known[1]
    phase = spots.phase + 2 * collection.carrier / SPEED_OF_LIGHT * offset - known[2]
    dwell = (line.weight * line.stretch).sum(axis=-1)
    turns = (np.pi * doppler * dwell) ** 2 + (2 * np.pi * collection.bandwidth / SPEED_OF_LIGHT * displaced) ** 2
    return np.asarray(turns / 6 + (2 * np.pi * phase) ** 2 / 2 + (2 * np.pi * bend * dwell**2) ** 2 / 360)


def _degree(sector: Sector, lines: TracedTargets) -> tuple[int, int]:
    """Degrees of the surfaces along range and yaw; on a wobbling track, as many terms as yaws.

    A turning beam lights one yaw after the other. What is left of the waves of the track then runs along yaw.
    """
    in_range = int(RANGE_DEGREE * lines.epoch_range.size)
    return in_range, YAW_DEGREE if sector.geometry.track.wobble is None else lines.yaw.size - 1


def _carrier_time(targets: TracedTargets, spots: Focus) -> FloatArray:
    """Time (n_range, n_yaw), s, about which responses are interpolated along Doppler: the middle of the dwell.

    No series follows the mean of the weights where a pattern in elevation has zeros.
    """
    if targets.geometry.collection.elevation_pattern is None or targets.weights.uniform:
        return spots.time
    return np.asarray((spots.line.time[..., 0] + spots.line.time[..., -1]) / 2)


def _yaw_steps(sector: Sector) -> int:
    """Number of yaws at which a block tabulates its limits: its share of the region's, to keep narrow blocks small."""
    step = float(np.ptp(sector.region.yaw)) / REGION_STEPS
    share = (sector.high - sector.low) / step if step > 0 else math.inf
    return math.ceil(min(max(share, 2), STEPS_BY_RANGE if by_range(sector.geometry) else YAW_STEPS))


class Layer(NamedTuple):
    """Targets on another ground over a block, with their quadratic phase removed, and that phase."""

    targets: TracedTargets
    bend: FloatArray  # cycles/s^2


def _layer(sector: Sector, azimuth: AzimuthPart, lines: TracedTargets, ground: Geometry) -> Layer:
    targets = retrace(sector, azimuth, lines, ground)
    straight, bend, spots = straighten(targets.spots.line, lambda spots: _carrier_time(targets, spots))
    return Layer(replace(targets, line=replace(straight, weight=targets.line.weight), spots=spots), bend)


def _raise(
    sector: Sector, relief: Relief, azimuth: AzimuthPart, ground: GroundMap, lines: TracedTargets,
    degree: tuple[int, int],
) -> GroundMap:  # fmt: skip
    """Add the terrain's heights to the map, from lines over the smooth ground at several heights."""
    geometry, along, yaw = sector.geometry, sector.ground_range, lines.yaw
    layers = [_layer(sector, azimuth, lines, relief.over(geometry, offset)) for offset in relief.offsets.tolist()]
    by_layer = [
        [*_surfaces(sector, layer.targets, degree), fit_surface(layer.bend, along=along, yaw=yaw, degree=degree)]
        for layer in layers
    ]
    if geometry.collection.has_axis:
        turns = [turns_of(layer.targets.geometry, geometry, lines.epoch_range, yaw) for layer in layers]
        ground = ground.widened(sector.region, float(np.abs(turns).max()))
        for fitted, turn in zip(by_layer, turns, strict=True):
            fitted.append(fit_surface(turn, along=along, yaw=yaw, degree=degree))
    terms = []
    for quantity in zip(*by_layer, strict=True):
        values = np.stack([surface.series for surface in quantity])
        series = solvers.node_series(values.reshape(len(layers), -1), len(layers) - 1).reshape(values.shape)
        terms.append(tuple(replace(quantity[0], series=np.ascontiguousarray(part)) for part in series))
    by_height = ReliefMap(
        smooth=relief.smooth, low=relief.low, high=relief.high, layers=tuple(terms[:QUANTITIES]),
        turns=terms[QUANTITIES] if terms[QUANTITIES:] else (),
        most_bend=max(float(np.abs(layer.bend).max()) for layer in layers),
    )  # fmt: skip
    return replace(ground, relief=by_height, levels=(relief.lowest, relief.highest))
