"""Planning of one angular block: slab, chain of steps, coefficients, gate and place on the ground."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from blocksar.arrays import FloatArray
from blocksar.collection import range_series
from blocksar.collection.beam import lit_pulses
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.region import Region
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.focusing.azimuth_steps import DopplerTransform
from blocksar.focusing.ground_map import YAW_STEPS, GroundMap, surfaces
from blocksar.focusing.lines import Focus, Line, focus
from blocksar.focusing.method import Method
from blocksar.focusing.range_steps import ResidualRangeWalk
from blocksar.focusing.recovery import Recovery
from blocksar.focusing.step import Step
from blocksar.kernels import fourier
from blocksar.kernels.fourier import Axis
from blocksar.kernels.interpolation import taps_needed
from blocksar.planning.binding import Axes, Binding, Slab
from blocksar.planning.coefficients import choose
from blocksar.planning.fitting import Candidate
from blocksar.planning.gates import plan_gate, plan_range_gate
from blocksar.planning.memory import block_memory
from blocksar.planning.prediction import Prediction, predict
from blocksar.planning.target_lines import recovered_line, tail_margin

TAP_ERROR = 1e-3
TIME_GUARD = 0.1  # of a dwell, kept on either side of what a block's targets are lit in
# Oversampling of a focused block: twelve taps in range and eight in Doppler then err by less than TAP_ERROR.
RANGE_ROOM = 1.42
RANGE_STEPS = 4  # of the iteration for targets that share an apparent range
RESAMPLING_ROOM = 1.35  # of the time to be transformed: Doppler is then sampled densely enough to interpolate


@dataclass(frozen=True, kw_only=True, eq=False)
class BlockPlan:
    """One angular block: its part of the spectrum, its chain, its place on the ground.

    Attributes
    ----------
    index : int
    part : int or None
        Which range sub-block of the block; None where the block is whole.
    low, high : float
        Yaw interval, rad.
    first_bin, n_bin : int
        Doppler slab of the recovered spectrum.
    chain : tuple of Step
        From slab to focused block, in order.
    ground : GroundMap
    prediction : Prediction
    memory : int
        Peak of a worker that focuses the block, bytes.
    candidate : Candidate
        The kind of chain that was chosen: its bias is the range acceleration that the time perturbation adds, m/s^2.
    """

    index: int
    part: int | None
    low: float
    high: float
    first_bin: int
    n_bin: int
    chain: tuple[Step, ...]
    ground: GroundMap
    prediction: Prediction
    memory: int
    candidate: Candidate

    @property
    def name(self) -> str:
        return str(self.index) if self.part is None else f"{self.index}.{self.part}"

    @property
    def range_frequency(self) -> Axis:
        """Of the block's own samples, Hz."""
        return next(step.range_frequency for step in self.chain if isinstance(step, ResidualRangeWalk))


def plan_block(
    geometry: Geometry,
    recovery: Recovery,
    region: Region,
    *,
    index: int,
    low: float,
    high: float,
    near: float,
    far: float,
    method: Method,
    part: int | None = None,
    candidate: Candidate | None = None,
) -> BlockPlan:
    """Plan one block, or a range sub-block of it, that owns the yaws [low, high) and the epoch ranges [near, far).

    The kind of chain is chosen unless it is given, as for further sub-blocks of a block.
    """
    collection = geometry.collection

    def recovered(epoch_range: FloatArray, yaw: FloatArray) -> Line:
        return recovered_line(
            geometry,
            epoch_range=epoch_range,
            yaw=yaw,
            origin=recovery.origin,
            walk=recovery.walk,
            common=recovery.common,
        )

    # Coarse lines through the range steps: for supports, coefficients and sampling.
    nodes, yaws = _end_nodes(near, far, 9), np.linspace(low, high, 15)
    line = recovered(nodes[:, None], yaws)
    duration = float(line.weight.sum(axis=-1).max())
    slab = _plan_slab(collection, recovery.doppler, line, margin=tail_margin(duration))
    frequency = Axis(
        float(collection.range_frequency[0]), collection.range_frequency_step, collection.n_range_frequency
    )
    range_gate = None if part is None else plan_range_gate(frequency, slab.doppler, line, collection.carrier)
    if range_gate is not None:
        frequency = range_gate.range_frequency
    period = fourier.fast_length(RANGE_ROOM * frequency.size)
    row_step = SPEED_OF_LIGHT / (2 * frequency.step * period)
    chain = Binding(method, range_gate, slab=slab, carrier=collection.carrier, range_frequency=frequency)
    reference = range_series.range_series(geometry, np.array((near + far) / 2), np.array((low + high) / 2), order=8)
    chain.reference = np.asarray(reference - recovery.common.taylor(8))
    chain.follow(chain.trace_walk(line))
    straight = chain.trace_range(line)
    ranges, epoch_range = _common_ranges(
        lambda at: chain.trace_range(recovered(at, yaws)), straight, nodes, origin=recovery.origin
    )
    shared = chain.trace_range(recovered(epoch_range, yaws))
    chosen = choose(
        geometry,
        shared,
        chain,
        ranges=ranges,
        epoch_range=epoch_range,
        yaws=yaws,
        shift=-2 / collection.wavelength * recovery.walk + slab.walk,
        candidate=candidate,
    )
    focused = chain.trace_azimuth(straight)
    spots = focus(focused)
    chain.axes = axes = _plan_axes(recovery, slab, straight, focused, chain, duration=duration)
    range_filling = frequency.size / period
    range_taps = (taps_needed(range_filling, error=TAP_ERROR), range_filling)
    chain.rows = rows = _plan_rows(spots, step=row_step, reach=(range_taps[0] / 2 + 2) * row_step, at_most=period)

    # Fine lines through the whole chain: for the gate, the place of every target, and the prediction.
    fine_range, fine_yaw = _end_nodes(near, far, 13), _end_nodes(low, high, 33)
    compressed = chain.trace_range(recovered(fine_range[:, None], fine_yaw))
    fine = chain.trace_azimuth(compressed)
    found = focus(fine)
    gate = plan_gate(fine, found, rows=rows, slow=axes.long_time)
    image_centre = float((spots.doppler.min() + spots.doppler.max()) / 2)
    image = fourier.dual(axes.long_time, size=axes.long_time.size, centre=image_centre)
    final = DopplerTransform(time=axes.long_time, doppler=image, rows=rows, gate=gate)
    ground = _plan_ground(
        geometry,
        recovery,
        region,
        found,
        final,
        low=low,
        high=high,
        near=near,
        far=far,
        epoch_range=fine_range,
        yaw=fine_yaw,
        range_taps=range_taps,
        doppler_filling=_local_occupancy(fine, found, final.image_doppler),
    )
    return BlockPlan(
        index=index,
        part=part,
        low=low,
        high=high,
        first_bin=slab.first_bin,
        n_bin=slab.doppler.size,
        chain=chain.bound(final),
        ground=ground,
        prediction=predict(fine, found, fine_range, fine_yaw, geometry, rate=chain.perturbed(compressed).rate),
        memory=block_memory(
            gate=range_gate,
            frequency=frequency,
            n_bin=slab.doppler.size,
            n_column=chain.n_column,
            n_row=rows.size,
            n_image=final.image_doppler.size,
            length=max(axes.long_time.size, period),
        ),
        candidate=chosen,
    )


def _common_ranges(
    trace: Callable[[FloatArray], Line], line: Line, nodes: FloatArray, *, origin: float
) -> tuple[FloatArray, FloatArray]:
    """Apparent ranges that span all of lines (n_range, n_yaw), and the epoch range of each yaw's target there.

    What shares an output row shares its coefficients, and its targets need not share the range at the epoch: range
    curvature that is corrected at the Doppler of a target's own moves it by that curvature (paper C, below (5)).

    Returns
    -------
    ranges : (n_range,) m from the origin, ascending
    epoch_range : (n_range, n_yaw) m
    """
    apparent = line.range.mean(axis=-1)
    ranges = _end_nodes(float(apparent.min()), float(apparent.max()), nodes.size)
    epoch_range = origin + ranges[:, None] - np.mean(apparent - (nodes[:, None] - origin), axis=0)
    for _ in range(RANGE_STEPS):
        epoch_range = epoch_range + ranges[:, None] - trace(epoch_range).range.mean(axis=-1)
    return ranges, epoch_range


def _end_nodes(low: float, high: float, count: int) -> FloatArray:
    """Chebyshev's nodes with both ends, ascending."""
    return low + (high - low) * (1 - np.cos(np.pi * np.arange(count) / (count - 1))) / 2


def _plan_slab(collection: Collection, spectrum: Axis, line: Line, *, margin: float) -> Slab:
    band_edge = float(np.abs(collection.range_frequency).max() / collection.carrier)
    band = np.outer([1 - band_edge, 1 + band_edge], [line.doppler.min(), line.doppler.max()])
    first_bin = max(int(np.floor(spectrum.position(np.array(band.min() - margin)))), 0)
    last_bin = min(int(np.ceil(spectrum.position(np.array(band.max() + margin)))) + 1, spectrum.size)
    walk = float((line.doppler.min() + line.doppler.max()) / 2)
    return Slab(first_bin, spectrum.part(first_bin, last_bin - first_bin), walk, margin, band_edge)


def _plan_axes(
    recovery: Recovery, slab: Slab, straight: Line, focused: Line, chain: Binding, *, duration: float
) -> Axes:
    """Sampling for the band that the time perturbation leaves, and for the longest reach of any line in time.

    Of the recovered signal only what the block's targets are lit in is kept: the rest of the aperture lit others.
    """
    row, polynomials = straight.range.mean(axis=-1), chain.polynomials
    perturbed = chain.perturbed(straight)
    shift = polynomials.resampling.evaluate(row, perturbed.doppler)
    resampled = perturbed.resample_doppler(*shift, middle=polynomials.middle)
    start = slab.doppler.start - slab.walk
    bands = [start, slab.doppler.start + slab.doppler.extent - slab.walk]
    for line in (perturbed, resampled):
        bands += [float(line.doppler.min()) - slab.margin, float(line.doppler.max()) + slab.margin]
    held = max(bands) - min(bands)
    span = recovery.time.extent
    full = fourier.fast_length(1.25 * span * max(held, slab.doppler.extent))
    step = span / full
    # Ends of dwells ring on; the keystone moves them by the band's share of the time from the epoch.
    latest = float(np.abs(straight.time).max())
    room = TIME_GUARD * duration + latest * slab.band_edge
    first = max(math.floor((float(straight.time.min()) - room - recovery.time.start) / step), 0)
    last = min(math.ceil((float(straight.time.max()) + room - recovery.time.start) / step), full)
    # An odd number of cache lines a row: columns of a block then do not fall on each other's place in the cache.
    n_time = min(math.ceil((last - first - 8) / 16) * 16 + 8, full - first)
    time = Axis(recovery.time.start + first * step, step, n_time)
    guard = 0.05 * duration
    begin = min(float(focused.time.min()) - guard, time.start)
    end = max(float(focused.time.max()) + guard, time.start + time.extent)
    room = RESAMPLING_ROOM if chain.freedom.resampling else 1.0
    n_padded = fourier.fast_length(max((end - begin) / step, room * n_time))
    middle = polynomials.middle
    return Axes(
        time=time,
        occupancy=min(step * slab.doppler.extent, 0.95),
        doppler=fourier.dual(time, size=n_padded, centre=(min(bands) + max(bands)) / 2),
        long_time=Axis(begin, step, n_padded),
        filled=min(2 * max(time.start + time.extent - middle, middle - time.start) / (step * n_padded), 0.95),
    )


def _plan_rows(spots: Focus, *, step: float, reach: float, at_most: int) -> Axis:
    """Ranges, less the origin, at which anything focuses, and `reach` more on either side for interpolation."""
    nearest, farthest = float(spots.range.min()) - reach, float(spots.range.max()) + reach
    return Axis(nearest, step, min(int(np.ceil((farthest - nearest) / step)) + 1, at_most))


def _plan_ground(
    geometry: Geometry,
    recovery: Recovery,
    region: Region,
    found: Focus,
    final: DopplerTransform,
    *,
    low: float,
    high: float,
    near: float,
    far: float,
    epoch_range: FloatArray,
    yaw: FloatArray,
    range_taps: tuple[int, float],
    doppler_filling: float,
) -> GroundMap:
    """Maps from ground to the focused block, from where lines (n_range, n_yaw) focus."""
    collection = geometry.collection
    offset, doppler_focus, phase, gain, dwell_time = surfaces(
        found, epoch_range=epoch_range, yaw=yaw, origin=recovery.origin, carrier=collection.carrier, degree=(9, 16)
    )
    yaw_axis = np.linspace(low, high, YAW_STEPS)
    near_limit, far_limit = region.at(yaw_axis)
    return GroundMap(
        geometry=geometry,
        low=low,
        high=high,
        near=near,
        far=far,
        origin=recovery.origin,
        rows=final.rows,
        doppler=final.image_doppler,
        range_offset=offset,
        doppler_focus=doppler_focus,
        phase=phase,
        gain=gain,
        time=dwell_time,
        common=None if final.gate is None else final.gate.common,
        yaw_axis=yaw_axis,
        near_limit=near_limit,
        far_limit=far_limit,
        lit=lit_pulses(collection, yaw_axis, np.ones(collection.n_pulse)),
        scale=range_taps[1],
        range_taps=range_taps,
        doppler_taps=(taps_needed(doppler_filling, error=TAP_ERROR), doppler_filling),
    )


def _local_occupancy(line: Line, found: Focus, doppler: Axis) -> float:
    """Part of the sampling that a target's response fills along Doppler once its own carrier is out."""
    reach = np.abs(line.time - found.time[..., None]).max()
    return float(min(2.2 * reach * doppler.step, 0.9))
