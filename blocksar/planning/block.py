"""Planning of one angular block: slab, chain of steps, coefficients, sampling and ground map."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from blocksar.chunks import DOPPLER_GROUP
from blocksar.collection.weighting import AxisTaper
from blocksar.errors import OutsideSwath
from blocksar.focusing.chains import steps_of
from blocksar.focusing.ground_map import GroundMap
from blocksar.focusing.lines import Line
from blocksar.focusing.method import Method
from blocksar.focusing.range_gate import RangeGate
from blocksar.focusing.step import Constants, Sampling, Stage, Step, stages
from blocksar.kernels.fourier import Axis
from blocksar.planning.binding import RESAMPLING_ORDERS, AzimuthPart, RangePart, Slab, plan_motion, plan_range_gate
from blocksar.planning.block_ground import end_layers, map_loss, plan_ground, trace_for_map, usual_layer
from blocksar.planning.block_lines import CoarseLines, FineLines, common_ranges, follow_terrain, lit_beside, under_tiles
from blocksar.planning.block_sampling import plan_sampling, plan_slab
from blocksar.planning.coefficients import Choice, choose
from blocksar.planning.dwell_ends import ImageEdges
from blocksar.planning.dwell_gate import plan_dwell_gate
from blocksar.planning.memory import RELIEF_MEMORY, block_memory
from blocksar.planning.prediction import Judged, Prediction, predict, worst_lobes
from blocksar.planning.relief import Layer
from blocksar.planning.sector import Sector
from blocksar.planning.target_lines import TracedTargets, tail_margin


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
        """All that is run, in order."""
        return stages(self.steps)

    @property
    def even(self) -> bool:
        """Whether a Doppler resampling, if there is one, can be applied to all of the block's Doppler bins."""
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
    for resampling in range(len(RESAMPLING_ORDERS), -1, -1):
        block = _plan_block(sector, method, index=index, part=part, neighbour=neighbour, resampling=resampling)
        if block.even or method.coefficients == "closed-form":
            break
    return block


def _plan_block(
    sector: Sector, method: Method, *, index: int, part: int | None, neighbour: Choice | None, resampling: int
) -> BlockPlan:
    """`plan_block` with a Doppler resampling of at most so many orders."""
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
    azimuth, lines = trace_for_map(sector, azimuth)
    sampling = plan_sampling(
        sector, slab, azimuth, straight if sector.relief is None else range_part.trace(coarse.everywhere), lines,
        range_frequency=band if range_gate is None else range_gate.range_frequency, duration=coarse.duration,
    )  # fmt: skip
    sampling = _with_gate(sector, azimuth, sampling, lines)
    mapped = under_tiles(sector, azimuth, lines)
    steps, ground = azimuth.sampled(sampling), plan_ground(sector, azimuth, sampling, mapped)
    return BlockPlan(
        index=index, part=part, low=sector.low, high=sector.high, first_bin=slab.first_bin, n_bin=slab.doppler.size,
        range_gate=range_gate, steps=steps, sampling=sampling,
        ground=ground,
        prediction=_predict(sector, azimuth, sampling, lines, ground),
        memory=_plan_memory(sector, range_gate, range_part, sampling), choice=choice,
    )  # fmt: skip


def _constants(sector: Sector, slab: Slab, band: Axis, line: Line) -> Constants:
    """Find what the steps are bound to besides the lines of the block."""
    recovery = sector.recovery
    return Constants(
        carrier=sector.geometry.collection.carrier,
        walk=slab.walk,
        reference=sector.reference(),
        middle=float((line.time.min() + line.time.max()) / 2),
        motion=plan_motion(
            sector.geometry, near=sector.near, far=sector.far, origin=recovery.origin, low=sector.low, high=sector.high
        ),
        in_range=AxisTaper.over(sector.weighting.range, band.start, band.step, band.size),
        in_time=None if sector.geometry.collection.steered else _pulse_taper(sector),
    )


def _pulse_taper(sector: Sector) -> AxisTaper | None:
    """The weighting over the pulses of a beam that is not steered."""
    pulses = sector.recovery.pulses
    return AxisTaper.over(sector.weighting.azimuth, pulses.start, pulses.step, pulses.size)


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
    """The steps after range compression, with coefficients for targets that share an apparent range."""
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


def _with_gate(sector: Sector, azimuth: AzimuthPart, sampling: Sampling, lines: FineLines) -> Sampling:
    """The sampling with the dwell gate."""
    gated = follow_terrain(sector, azimuth, lines) if sector.gates_by_height else lines
    beside = lit_beside(sector, azimuth, gated)
    return replace(sampling, gate=plan_dwell_gate(sector, sampling, gated, beside))


def _predict(
    sector: Sector, azimuth: AzimuthPart, sampling: Sampling, lines: FineLines, ground: GroundMap
) -> Prediction:
    """The prediction from the block's lines; on a terrain from those of targets at usual heights.

    Side lobes also from those of targets that lie low, and of such that lie high.
    """
    targets, reached, layers = lines.targets(sector.geometry), None, []
    if sector.relief is not None:
        usual, reached = usual_layer(sector, azimuth, lines)
        targets, layers = _on(targets, usual), end_layers(sector, azimuth, lines)
    imaged = _imaged(sector, lines)
    predicted = predict(
        targets, sampling.gate, reached=reached, imaged=imaged, band=sector.weighting.range,
    )  # fmt: skip
    for layer in layers:
        others = _on(targets, layer)
        judged = Judged.of(others, reached, imaged)
        predicted = predicted.or_lobes(worst_lobes(others, sampling.gate, judged, band=sector.weighting.range))
    seen = np.logical_and.reduce([lines.ends.full, *(each.held for each in imaged)])
    if reached is not None:
        seen, layers = seen & reached, [usual, *layers]
    return predicted.less(sector.beam_loss, map_loss(ground, lines, seen, layers))


def _on(targets: TracedTargets, layer: Layer) -> TracedTargets:
    """The targets on another ground."""
    return replace(targets, geometry=layer.geometry, line=layer.line, spots=layer.spots, rate=layer.rate)


def _imaged(sector: Sector, lines: FineLines) -> tuple[ImageEdges, ImageEdges]:
    """Where the image begins and ends along yaw and range among the targets of the lines."""
    low, high = (np.full(lines.epoch_range.size, yaw) for yaw in sector.imaged)
    return (
        ImageEdges.between(lines.yaw, low, high, axis=1),
        ImageEdges.between(lines.epoch_range, *sector.region.at(lines.yaw), axis=0),
    )


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
