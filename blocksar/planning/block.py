"""Planning of one angular block: slab, chain of steps, coefficients, sampling and ground map."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.budget import IMAGE_TAP_ERROR
from blocksar.chunks import DOPPLER_GROUP
from blocksar.collection.beam import aperture, dwell_at
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import FLAT, AxisTaper
from blocksar.focusing.chains import steps_of
from blocksar.focusing.dwell_gate import DwellGate
from blocksar.focusing.ground_map import YAW_STEPS, GroundMap, by_range, sum_lit, surfaces
from blocksar.focusing.lines import Focus, Line, focus
from blocksar.focusing.method import Method
from blocksar.focusing.motion import RangeMotionInFrequency
from blocksar.focusing.range_gate import RangeGate
from blocksar.focusing.recovery import Recovery
from blocksar.focusing.relief_map import NodeHeights
from blocksar.focusing.sampling import Sampling
from blocksar.focusing.step import Constants, Stage, Step, stages
from blocksar.focusing.surfaces import Surface
from blocksar.kernels import fourier
from blocksar.kernels.fourier import Axis
from blocksar.kernels.interpolation import taps_needed
from blocksar.planning.aperture_waves import plan_waves
from blocksar.planning.apertures import level_aperture, levelled
from blocksar.planning.binding import AzimuthPart, RangePart, Slab
from blocksar.planning.block_gates import Ends, FineLines, level_spots, plan_dwell_gate, plan_over_band
from blocksar.planning.coefficients import Choice, choose
from blocksar.planning.dwell_weights import beam_moves
from blocksar.planning.gates import GUARD, band_moves, faded_room, full_dwells, plan_range_gate, smear_room
from blocksar.planning.memory import RELIEF_MEMORY, block_memory
from blocksar.planning.motion import plan_motion
from blocksar.planning.nodes import common_ranges, nodes_between
from blocksar.planning.prediction import Prediction, predict
from blocksar.planning.relief import elevation_ratio, map_relief, trace_layer, turns_of
from blocksar.planning.row_sampling import plan_rows, range_scale
from blocksar.planning.sector import Sector
from blocksar.planning.target_lines import Dwells, tail_margin

TIME_GUARD = 0.1  # dwells kept on either side of the time in which a block's targets are lit
LEAST_ROOM = 1.4  # dwells that slow time has room for, so that the windows of the gate can fade out
SLOW_ROOM = 1.25  # oversampling of slow time
IMAGE_ROOM = 1.05  # of the image along Doppler, for the taps of the targets at its ends
RESAMPLING_ROOM = 1.35  # oversampling of Doppler by padding in time: dense enough to interpolate
REGION_STEPS, LEAST_STEPS = 64 * YAW_STEPS, 128  # of yaw over the region, in which a block has its share; at least
GATE_RANGES = 25  # of the lines that a dwell gate on a terrain follows
STEPS_BY_RANGE = 512  # of yaw, where the sum over lit pulses is a table over range and yaw


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
    chain : tuple of Step
        From slab to focused block, in order.
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
    chain: tuple[Step, ...]
    sampling: Sampling
    ground: GroundMap
    prediction: Prediction
    memory: int
    choice: Choice

    def __repr__(self) -> str:
        return f"<BlockPlan {self.name}: yaw {self.low:.6g} .. {self.high:.6g} rad, {self.n_bin} Doppler bins>"

    @property
    def range_gate(self) -> RangeGate | None:
        """The range gate of a sub-block, which one task applies for all sub-blocks; None for a whole block."""
        return self.chain[0] if isinstance(self.chain[0], RangeGate) else None

    @property
    def steps(self) -> tuple[Step, ...]:
        """The steps that the block's own tasks apply: the chain without its range gate."""
        return self.chain if self.range_gate is None else self.chain[1:]

    @property
    def stages(self) -> list[Stage]:
        """All that is run, in order: the first stage, and the rest of the steps once for each part of the gate."""
        return list(chain([self.first_stage], *self.branches))

    @property
    def first_stage(self) -> Stage:
        return stages(self.steps)[0]

    @property
    def branches(self) -> list[list[Stage]]:
        """The stages after the first, once for each part of the gate over the band: their images add up."""
        rest = self.steps[len(self.first_stage.steps) :]
        if not self.sampling.over_band:
            return [stages(rest)]
        return [stages([step.sampled(sampling) for step in rest]) for sampling in self.sampling.branches]

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
    """
    collection, recovery = sector.geometry.collection, sector.recovery
    # Coarse lines through the range steps: for the slab, the coefficients and the sampling.
    nodes, yaws = nodes_between(sector.near, sector.far, 9), np.linspace(sector.low, sector.high, 15)
    dwells = sector.dwells(yaws, coarsely=True)
    line = dwells.lines(nodes[:, None])
    duration = float(line.weight.sum(axis=-1).max())
    everywhere = sector.with_relief(line, lambda part: part.dwells(yaws, coarsely=True).lines(nodes[:, None]))
    margin = tail_margin(duration, stays=sector.staying is not None)
    slab = _plan_slab(collection, recovery.doppler, everywhere, margin=margin)
    band = Axis(float(collection.range_frequency[0]), collection.range_frequency_step, collection.n_range_frequency)
    range_gate = None if part is None else plan_range_gate(band, slab.doppler, everywhere, collection.carrier)
    motion = plan_motion(
        sector.geometry, near=sector.near, far=sector.far, origin=recovery.origin, low=sector.low, high=sector.high
    )
    constants = Constants(
        carrier=collection.carrier, walk=slab.walk, reference=sector.reference(),
        middle=float((line.time.min() + line.time.max()) / 2), motion=motion,
        in_range=AxisTaper.over(sector.weighting.range, band.start, band.step, band.size),
        in_time=None if collection.steered else _pulse_taper(sector),
    )  # fmt: skip
    range_part = RangePart.bind(steps_of(method, measured=motion is not None), constants, line)
    straight = range_part.trace(line)
    azimuth, choice = _plan_azimuth(
        sector, range_part, method, straight, nodes=nodes, dwells=dwells, neighbour=neighbour
    )

    # Fine lines through the whole chain: for the gate, the ground map and the prediction.
    fine_range, fine_yaw = nodes_between(sector.near, sector.far, 13), nodes_between(sector.low, sector.high, 33)
    lit = sector.dwells(fine_yaw).lines(fine_range[:, None])
    compressed = range_part.trace(lit)
    biased, _, fine = azimuth.trace(compressed)
    in_time = constants.in_time
    if in_time is not None:
        in_time, fine = level_aperture(fine, in_time)
        azimuth = azimuth.weighed(in_time)
    about = range_part.scales_time_about
    moves = band_moves(biased, biased.rate) if range_part.compression.in_doppler else None
    ends = _ends(sector, fine, biased.rate, fine_range, fine_yaw, scaled_about=about)._replace(moves=moves)
    weights = sector.weights(lit, uncut=ends.uncut, epoch_range=fine_range, yaw=fine_yaw, scaled_about=about)
    spots = focus(weights.weigh(fine))
    sampling = _plan_sampling(
        recovery, slab, azimuth, straight if sector.relief is None else range_part.trace(everywhere),
        range_frequency=band if range_gate is None else range_gate.range_frequency, duration=duration,
        uncut=float((ends.uncut[1] - ends.uncut[0]).max()) if collection.steered else 0.0,
        turns=azimuth.turns(compressed), tap_error=sector.tap_error, faded=sector.fade > 0,
        gated=beam_moves(collection), overhang=_overhang(sector, ends) if sector.keeps_rims else 0.0,
    )  # fmt: skip
    lines = FineLines(lit, fine, spots, fine_range, fine_yaw, weights, ends, in_time)
    sampling, ground, prediction = _plan_image(sector, azimuth, sampling, lines)
    return BlockPlan(
        index=index, part=part, low=sector.low, high=sector.high, first_bin=slab.first_bin, n_bin=slab.doppler.size,
        chain=azimuth.sampled(sampling) if range_gate is None else (range_gate, *azimuth.sampled(sampling)),
        sampling=sampling, ground=ground, prediction=prediction, choice=choice,
        memory=_plan_memory(range_gate, range_part, sampling) + sector.edge_memory
        + (0 if sector.relief is None else RELIEF_MEMORY),
    )  # fmt: skip


def _plan_image(
    sector: Sector, azimuth: AzimuthPart, sampling: Sampling, lines: FineLines
) -> tuple[Sampling, GroundMap, Prediction]:
    """The sampling with its dwell gate, the ground map, and the prediction."""
    rng, yaw, ends, weights = lines.epoch_range, lines.yaw, lines.ends, lines.weights
    gated = _follow_terrain(sector, azimuth, lines) if sector.gates_by_height else lines
    gate = plan_dwell_gate(sector, sampling, gated)
    over_band = () if gate is None else plan_over_band(sector, sampling, gated, gate)
    sampling = replace(sampling, gate=gate, over_band=over_band)
    if gate is not None:
        lines = level_spots(gate, lines)
    ground = _plan_ground(sector, sampling, lines.line, lines.spots, epoch_range=rng, yaw=yaw)
    if sector.staying is not None and not sector.taper.uniform:
        waves = plan_waves(sector.staying, sector.taper, lines.lit, lines.line, epoch_range=rng, yaw=yaw)
        ground = replace(ground, waves=waves)
    if sector.relief is not None:
        return sampling, *_raise(sector, azimuth, ground, gate, lines)
    prediction = predict(
        lines.line, lines.spots, rng, yaw, sector.geometry, rate=ends.rate, gate=gate, parts=sector.gate_parts,
        scaled_about=ends.scaled_about, moves=ends.moves, weights=weights, band=sector.weighting.range,
    )  # fmt: skip
    return sampling, ground, prediction


def _trace(sector: Sector, azimuth: AzimuthPart, lines: FineLines) -> tuple[Line, Line, FloatArray]:
    """Lines of other targets at the same ranges and yaws, before and after all steps, and their rate in between."""
    lit = sector.dwells(lines.yaw).lines(lines.epoch_range[:, None])
    biased, _, line = azimuth.trace(azimuth.range_part.trace(lit))
    return lit, line if lines.in_time is None else levelled(line, lines.in_time), biased.rate


def _follow_terrain(sector: Sector, azimuth: AzimuthPart, lines: FineLines) -> FineLines:
    """The lines of targets on the finer smooth part of a terrain, which the dwell gate follows, at more ranges."""
    rng, yaw = nodes_between(sector.near, sector.far, GATE_RANGES), lines.yaw
    lit, line, rate = _trace(sector.refined(), azimuth, lines._replace(epoch_range=rng))
    ends = _ends(sector, line, rate, rng, yaw, scaled_about=lines.ends.scaled_about)
    weights = sector.weights(lit, uncut=ends.uncut, epoch_range=rng, yaw=yaw, scaled_about=ends.scaled_about)
    return FineLines(lit, line, focus(weights.weigh(line)), rng, yaw, weights, ends, lines.in_time)


def _ends(
    sector: Sector, line: Line, rate: FloatArray, rng: FloatArray, yaw: FloatArray, *, scaled_about: float | None
) -> Ends:
    """What the ends of dwells of lines (n_range, n_yaw, n), after all steps, depend on."""
    first, last = dwell_at(sector.geometry, yaw, rng[:, None], uncut=True)
    return Ends(
        rate=rate, uncut=(first - sector.geometry.epoch, last - sector.geometry.epoch),
        scaled_about=scaled_about, moves=None,
        full=full_dwells(line, sector.geometry, rng[:, None], yaw), passing=sector.passing(rng[:, None], yaw),
    )  # fmt: skip


def _raise(
    sector: Sector, azimuth: AzimuthPart, ground: GroundMap, gate: DwellGate | None, lines: FineLines
) -> tuple[GroundMap, Prediction]:
    """The ground map with the terrain's heights, and the prediction at usual ones."""
    relief, weights, rng, yaw = sector.relief, lines.weights, lines.epoch_range, lines.yaw
    assert relief is not None
    origin, carrier, degree = sector.recovery.origin, sector.geometry.collection.carrier, (9, 16)

    def trace(geometry: Geometry) -> tuple[Line, FloatArray]:
        return _trace(replace(sector, geometry=geometry), azimuth, lines)[1:]

    def surfaces_of(spots: Focus) -> tuple[Surface, ...]:
        return surfaces(spots, epoch_range=rng, yaw=yaw, origin=origin, carrier=carrier, degree=degree)

    layers = [trace_layer(sector.over(offset).geometry, trace, weights.weigh) for offset in relief.offsets.tolist()]
    if sector.geometry.collection.elevation_pattern is not None:
        of_smooth = sector.geometry, rng, yaw
        layers = [layer._replace(pattern=elevation_ratio(layer.geometry, *of_smooth)) for layer in layers]
    turns = []
    if sector.geometry.collection.has_axis:
        turns = [turns_of(layer.geometry, sector.geometry, rng, yaw) for layer in layers]
        ground = ground.widened(sector.region, float(np.abs(turns).max()))
    by_height = map_relief(relief, layers, surfaces_of, epoch_range=rng, yaw=yaw, degree=degree, turns=turns)
    usual, known = relief.usual(rng.size, yaw.size)
    heights = NodeHeights(smooth=relief.fine, over=usual)
    layer = trace_layer(sector.geometry.over(None, heights), trace, weights.weigh)
    prediction = predict(
        layer.line, layer.spots, rng, yaw, layer.geometry, rate=layer.rate, gate=gate,
        parts=sector.gate_parts, scaled_about=lines.ends.scaled_about, moves=lines.ends.moves, weights=weights,
        reached=known if known.any() else np.ones_like(known), band=sector.weighting.range,
    )  # fmt: skip
    return replace(ground, relief=by_height), prediction


def _pulse_taper(sector: Sector) -> AxisTaper | None:
    """The weighting over the pulses of a beam that is not steered; none where it stays, and depends on the place."""
    pulses = sector.recovery.pulses
    taper = sector.weighting.azimuth if sector.staying is None else FLAT
    return AxisTaper.over(taper, pulses.start, pulses.step, pulses.size)


def _plan_azimuth(
    sector: Sector,
    range_part: RangePart,
    method: Method,
    straight: Line,
    *,
    nodes: FloatArray,
    dwells: Dwells,
    neighbour: Choice | None,
) -> tuple[AzimuthPart, Choice]:
    """The steps after range compression, with coefficients for targets that share an apparent range."""
    recovery = sector.recovery
    ranges, epoch_range = common_ranges(
        lambda at: range_part.trace(dwells.lines(at)), straight, nodes, origin=recovery.origin
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
        neighbour=neighbour,
    )
    return AzimuthPart.bind(range_part, polynomials, straight), choice


def _plan_slab(collection: Collection, spectrum: Axis, line: Line, *, margin: float) -> Slab:
    """The Doppler bins that hold lines at all range frequencies, with a margin (Hz) on either side."""
    band_edge = float(np.abs(collection.range_frequency).max() / collection.carrier)
    band = np.outer([1 - band_edge, 1 + band_edge], [line.doppler.min(), line.doppler.max()])
    first_bin = max(int(np.floor(spectrum.position(np.array(band.min() - margin)))), 0)
    last_bin = min(int(np.ceil(spectrum.position(np.array(band.max() + margin)))) + 1, spectrum.size)
    walk = float((line.doppler.min() + line.doppler.max()) / 2)
    return Slab(first_bin, spectrum.part(first_bin, last_bin - first_bin), walk, margin, band_edge)


def _plan_sampling(
    recovery: Recovery,
    slab: Slab,
    azimuth: AzimuthPart,
    straight: Line,
    *,
    range_frequency: Axis,
    duration: float,
    uncut: float,
    turns: FloatArray,
    tap_error: float,
    faded: bool = False,
    gated: bool = True,
    overhang: float = 0.0,
) -> Sampling:
    """The axes that hold a block's lines, `straight` after range compression, without a gate.

    `uncut` is the longest dwell that the gate has to hold, s, as if the ends of the collection did not cut it, and
    `overhang` the most by which they cut one; `turns` are those of `AzimuthPart.turns`. What is not to be `gated` is
    summed to the end of its smear.
    """
    biased, before_deramp, focused = azimuth.trace(straight)
    spots = focus(focused)
    bands = _doppler_bands(slab, before_deramp)
    bandwidth = max(max(bands) - min(bands), IMAGE_ROOM * float(np.ptp(spots.doppler)) / SLOW_ROOM)
    time = _plan_time(recovery, slab, straight, bandwidth=bandwidth, duration=duration)
    guard = GUARD * duration
    if not gated:
        guard += smear_room(focused, biased.rate) * (IMAGE_TAP_ERROR / tap_error) ** (2 / 3)
    begin = min(float(focused.time.min()) - guard, time.start)
    end = max(float(focused.time.max()) + guard, time.start + time.extent)
    room = RESAMPLING_ROOM if azimuth.range_part.freedom.resampling else 1.0
    held = LEAST_ROOM * uncut
    if faded:
        held = max(held, faded_room(uncut, float(np.ptp(spots.time) / max(np.ptp(spots.doppler), 1e-9))))
    if overhang:  # gates stay open beyond the collection: steps in Doppler wrap no noise from its other end to there
        held = max(held, time.extent + overhang)
    n_padded = fourier.fast_length(max((end - begin) / time.step, room * time.size, held / time.step))
    long_time = Axis(begin, time.step, n_padded)
    middle = azimuth.polynomials.middle
    reach = 2 * max(time.start + time.extent - middle, middle - time.start)
    rows, range_occupancy = plan_rows(spots, range_frequency, turns, tap_error)
    return Sampling(
        slab=slab.doppler,
        range_frequency=range_frequency,
        time=time,
        time_occupancy=min(time.step * slab.doppler.extent, 0.95),
        doppler=fourier.dual(time, size=n_padded, centre=(min(bands) + max(bands)) / 2),
        long_time=long_time,
        doppler_occupancy=min(reach / (time.step * n_padded), 0.95),
        rows=rows,
        range_occupancy=range_occupancy,
        focused_doppler=fourier.dual(
            long_time, size=n_padded, centre=float((spots.doppler.min() + spots.doppler.max()) / 2)
        ),
        gate=None,
    )


def _overhang(sector: Sector, ends: Ends) -> float:
    """The most by which the ends of the collection cut dwells, s."""
    (start, end), epoch = aperture(sector.geometry.collection), sector.geometry.epoch
    first, last = ends.uncut
    cut = max(float((start - epoch - first).max()), float((last + epoch - end).max()))
    return min(max(cut, 0.0), float((last - first).max()))


def _doppler_bands(slab: Slab, before_deramp: list[Line]) -> list[float]:
    """Ends of the Doppler bands that a block occupies before its deramp, Hz, from its lines after each step."""
    start = slab.doppler.start - slab.walk
    bands = [start, slab.doppler.start + slab.doppler.extent - slab.walk]
    for line in before_deramp:
        bands += [float(line.doppler.min()) - slab.margin, float(line.doppler.max()) + slab.margin]
    return bands


def _plan_time(recovery: Recovery, slab: Slab, straight: Line, *, bandwidth: float, duration: float) -> Axis:
    """Slow time in which a block's targets are lit, sampled for a Doppler band of `bandwidth` Hz."""
    span = recovery.time.extent
    full = fourier.fast_length(SLOW_ROOM * span * max(bandwidth, slab.doppler.extent))
    step = span / full
    # Ends of dwells ring beyond. The keystone moves them by up to band_edge times their time from the epoch.
    latest = float(np.abs(straight.time).max())
    room = TIME_GUARD * duration + latest * slab.band_edge
    first = max(math.floor((float(straight.time.min()) - room - recovery.time.start) / step), 0)
    last = min(math.ceil((float(straight.time.max()) + room - recovery.time.start) / step), full)
    # An odd number of cache lines per row, so that the columns of a block do not share cache sets.
    n_time = min(math.ceil((last - first - 8) / 16) * 16 + 8, full - first)
    return Axis(recovery.time.start + first * step, step, n_time)


def _plan_ground(
    sector: Sector, sampling: Sampling, line: Line, spots: Focus, *, epoch_range: FloatArray, yaw: FloatArray
) -> GroundMap:
    """The map from the ground to the focused block, by where lines (n_range, n_yaw) focus."""
    collection, origin = sector.geometry.collection, sector.recovery.origin
    taper, valid, stays = sector.taper, np.ones(collection.n_pulse), sector.staying is not None
    offset, doppler_focus, phase, gain, dwell_time = surfaces(
        spots, epoch_range=epoch_range, yaw=yaw, origin=origin, carrier=collection.carrier, degree=(9, 16)
    )
    yaw_axis = np.linspace(sector.low, sector.high, _yaw_steps(sector))
    near_limit, far_limit = sector.region.at(yaw_axis)
    # Of the sampling rate, what a target's response fills along Doppler without its own carrier.
    reach = np.abs(line.time - spots.time[..., None]).max()
    filled = float(min(2.2 * reach * sampling.image_doppler.step, 0.9))
    return GroundMap(
        geometry=sector.lighting,
        low=sector.low,
        high=sector.high,
        near=sector.near,
        far=sector.far,
        origin=origin,
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
        taper=taper,
        stays=stays,
        lit=sum_lit(
            sector.lighting, near=sector.near, far=sector.far, yaw=yaw_axis, valid=valid, taper=taper, stays=stays
        ),
        scale=range_scale(collection, sampling.range_frequency, sampling.range_period, sector.weighting.range),
        range_taps=(taps_needed(sampling.range_occupancy, error=sector.tap_error), sampling.range_occupancy),
        doppler_taps=(taps_needed(filled, error=sector.tap_error), filled),
    )


def _yaw_steps(sector: Sector) -> int:
    """Yaws at which a block knows its limits: its share of the region's, so that many narrow blocks are small."""
    step = float(np.ptp(sector.region.yaw)) / REGION_STEPS
    share = (sector.high - sector.low) / step if step > 0 else math.inf
    return math.ceil(min(max(share, LEAST_STEPS), STEPS_BY_RANGE if by_range(sector.lighting) else YAW_STEPS))


def _plan_memory(range_gate: RangeGate | None, range_part: RangePart, sampling: Sampling) -> int:
    """Peak memory of a worker that focuses the block, bytes."""
    margin = 0 if range_gate is None else 2 * DOPPLER_GROUP  # its slab in whole chunks
    lengthened = any(isinstance(step, RangeMotionInFrequency) for step in range_part.steps)
    return block_memory(
        n_short=sampling.time.size if lengthened else 0,
        frequency=sampling.range_frequency,
        n_bin=sampling.slab.size + margin,
        n_column=(sampling.doppler if range_part.compression.in_doppler else sampling.time).size,
        n_row=sampling.rows.size,
        n_image=sampling.image_doppler.size,
        length=max(sampling.long_time.size, sampling.range_period),
        divided=bool(sampling.over_band),
    )
