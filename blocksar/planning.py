"""From a collection's metadata to everything that focusing needs: no sample is read.

Blocks with their Doppler supports, margins, padding and coefficients; where every target will focus and
with what phase; predicted residual phase, side lobes, width and range migration; memory of a task.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from blocksar import closed_form, fitting, fourier
from blocksar.azimuth_steps import DopplerTransform, DwellGate
from blocksar.binding import Axes, Binding, Slab
from blocksar.fitting import Candidate
from blocksar.fourier import Axis
from blocksar.geometry import Geometry
from blocksar.ground import YAW_STEPS, GroundMap, surfaces
from blocksar.lines import Focus, Line, RowPolynomial, focus
from blocksar.method import Method
from blocksar.parameters import SINC_PSLR, SINC_WIDTH, SPEED_OF_LIGHT, Collection, FloatArray, InputError
from blocksar.phase import taps_needed
from blocksar.range_steps import RangeGate, ResidualRangeWalk
from blocksar.recovery import Recovery
from blocksar.recovery_plan import middle_line, plan_recovery, recovered_line, tail_margin
from blocksar.region import (
    Extent,
    Grid,
    Region,
    block_seams,
    default_grid,
    grid_extent,
    lit_pulses,
    plan_region,
)
from blocksar.rows import GROUP_BYTES, Resample, Stretch, Transform
from blocksar.steps import Step, stages

PHASE_BUDGET = 0.1  # rad at the edge of the dwell; pi/4 is the usual limit
SIDE_LOBE_BUDGET = 0.2  # dB that the highest side lobe may change: a quartic phase does that below its budget
MIGRATION_BUDGET = 0.25  # range resolution cells over the dwell
TAP_ERROR = 1e-3
DEFAULT = Method()
TIME_GUARD = 0.1  # of a dwell, kept on either side of what a block's targets are lit in
RANGE_GUARD = 48  # range cells on either side of a sub-block, for the side lobes of what lies at its ends
# Oversampling of a focused block: twelve taps in range and eight in Doppler then err by less than TAP_ERROR.
RANGE_ROOM = 1.42
GATE_ROOM = 1.62  # dwells that the Doppler sampling makes room for
RANGE_STEPS = 4  # of the iteration for targets that share an apparent range
RESAMPLING_ROOM = 1.35  # of the time to be transformed: Doppler is then sampled densely enough to interpolate
MAX_BLOCKS = 32
MOST_BLOCKS = 1000  # that may be asked for
MAX_PARTS = 64  # range sub-blocks of a block
MEMORY_SHARE = 0.8  # of a worker's limit that a plan may fill
MIB = 2**20
PROCESS_MEMORY = 288 * MIB  # a worker's interpreter and libraries, before any sample
DOPPLER_GROUP = 512  # Doppler bins of a slab that are read at a time
COLUMN_CHUNK = 256  # range frequencies of a chunk of the spectrum, fewer where Doppler bins are many
CHUNK_SAMPLES = DOPPLER_GROUP * COLUMN_CHUNK  # of a chunk of the spectrum
SPECTRUM_BYTES = 64 * MIB  # of the spectrum written at a time
SIGNAL_BYTES = 96 * MIB  # of the phase history read at a time
SIGNAL_COLUMNS = 512  # at most
IMAGE_CHUNK = 1024  # pixels a side of an image's chunk
IMAGE_PIXELS = IMAGE_CHUNK**2


@dataclass(frozen=True)
class Transforms:
    """FFTs of one length that a stage takes."""

    stage: str
    count: int
    length: int


class Prediction(NamedTuple):
    """What a block's traced lines promise, the worst of its targets."""

    residual_phase: float  # rad, largest over the dwell
    quadratic_phase: float  # rad, its quadratic part at the dwell's edge
    pslr: float  # dB, azimuth
    width: float  # azimuth width over the dwell's limit
    migration: float  # range resolution cells over the dwell
    resolution: float  # azimuth, m
    loss: float  # part of a dwell that dispersion takes from its ends

    @property
    def excess(self) -> float:
        """The worst of phase, side lobes and migration, each over what it may be."""
        return max(
            self.residual_phase / PHASE_BUDGET,
            abs(self.pslr - SINC_PSLR) / SIDE_LOBE_BUDGET,
            self.migration / MIGRATION_BUDGET,
        )


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
    range_gate = None if part is None else _plan_range_gate(frequency, slab.doppler, line, collection.carrier)
    if range_gate is not None:
        frequency = range_gate.range_frequency
    period = fourier.fast_length(RANGE_ROOM * frequency.size)
    row_step = SPEED_OF_LIGHT / (2 * frequency.step * period)
    chain = Binding(method, range_gate, slab=slab, carrier=collection.carrier, range_frequency=frequency)
    reference = fitting.range_series(geometry, np.array((near + far) / 2), np.array((low + high) / 2), order=8)
    chain.reference = np.asarray(reference - recovery.common.taylor(8))
    chain.follow(chain.trace_walk(line))
    straight = chain.trace_range(line)
    ranges, epoch_range = _common_ranges(
        lambda at: chain.trace_range(recovered(at, yaws)), straight, nodes, origin=recovery.origin
    )
    shared = chain.trace_range(recovered(epoch_range, yaws))
    chosen = _choose(
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
    gate = _plan_gate(fine, found, rows=rows, slow=axes.long_time)
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
        prediction=_predict(fine, found, fine_range, fine_yaw, geometry, rate=chain.perturbed(compressed).rate),
        memory=_memory(
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


def _plan_range_gate(full: Axis, slab: Axis, line: Line, carrier: float) -> RangeGate:
    """The gate that holds, at each Doppler, the ranges of lines (n_range, n_yaw), and their side lobes around."""
    u = (2 * line.doppler - slab.start - (slab.start + slab.extent)) / slab.extent
    centre = middle_line(u.ravel(), line.range.ravel(), order=6)
    spread = line.range - chebyshev.chebval(u, centre)
    # At a Doppler bin the band's ends stand at other times than the carrier: a smear that SRC takes back.
    edge = max(abs(full.start), abs(full.start + full.extent)) / carrier
    rate = np.maximum(np.abs(line.rate), 1e-3 * np.abs(line.rate).max())
    smear = SPEED_OF_LIGHT / (2 * carrier) * line.doppler**2 / rate * edge
    cell = SPEED_OF_LIGHT / (2 * full.extent)
    low = float((spread - np.abs(smear)).min()) - RANGE_GUARD * cell
    high = float((spread + np.abs(smear)).max()) + RANGE_GUARD * cell
    period = fourier.fast_length(full.size)
    step = 1 / (period * full.step)
    size, kept = _gate_length((high - low) * 2 / SPEED_OF_LIGHT / step, full.size / period, period)
    gate = fourier.centred((low + high) / SPEED_OF_LIGHT, step, size)
    coarse = 1 / (size * step)
    ramp = np.clip((np.minimum(np.arange(size), np.arange(size)[::-1]) + 0.5) / (RANGE_GUARD / 2), 0, 1)
    place = np.clip((2 * slab.values - 2 * slab.start - slab.extent) / slab.extent, u.min(), u.max())
    return RangeGate(
        slab=slab,
        centre=np.asarray(chebyshev.chebval(place, centre)),
        gate=gate,
        window=np.sin(np.pi / 2 * ramp) ** 2,
        full=full,
        range_frequency=Axis(full.start - full.step / 2 + coarse / 2, coarse, kept),
    )


def _gate_length(needed: float, share: float, at_most: int) -> tuple[int, int]:
    """A fast length of about `needed` samples, and how many of its frequencies fill the band best."""
    lengths = {fourier.fast_length(n) for n in np.linspace(needed, 1.06 * needed + 8, 24)}
    lengths = {n for n in lengths if n < at_most} or {at_most}
    return min(((n, round(n * share)) for n in lengths), key=lambda pair: abs(pair[1] / pair[0] / share - 1))


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


def _plan_gate(line: Line, found: Focus, *, rows: Axis, slow: Axis) -> DwellGate | None:
    """The gate that follows the middles of the dwells along Doppler, from lines (n_range, n_yaw) with full dwell.

    Targets whose dwell the ends of the collection cut are gated as if it went on. None where all targets dwell
    at the same time, as under a beam that is not steered: then there is nothing to tell apart.
    """
    weight = line.weight * line.stretch
    lengths = weight.sum(axis=-1)
    middles = (weight * line.time).sum(axis=-1) / lengths
    if np.ptp(middles) < 0.02 * lengths.max():
        return None
    lit = line.weight.sum(axis=-1)[0]
    full = lit >= 0.999 * lit.max()
    if full.sum() < 6:  # a narrow block at an end of the swath: what is there has to do
        full = np.ones_like(full)
    doppler = found.doppler[:, full]
    centre, scale = float((doppler.min() + doppler.max()) / 2), max(float(np.ptp(found.doppler) / 2), 1e-6)
    near, far = rows.start, rows.start + rows.extent
    u = (2 * found.range[:, full] - near - far) / (far - near)
    z = (doppler - centre) / scale
    basis = chebyshev.chebvander2d(u.ravel(), z.ravel(), [2, 3])
    series = np.linalg.lstsq(basis, middles[:, full].ravel(), rcond=1e-10)[0].reshape(3, 4)
    powers = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [-1, 0, 2, 0], [0, -3, 0, 4]], dtype=float)
    series = series @ powers  # from Chebyshev to powers of z
    integral = np.zeros((3, 5))
    integral[:, 1:] = series / np.arange(1, 5) * scale
    phase = RowPolynomial(series=integral, near=near, far=far, centre=centre, scale=scale)
    at_middle = phase.coefficients(np.array((near + far) / 2))[None]
    common = RowPolynomial(series=at_middle, near=near, far=far, centre=centre, scale=scale)
    slope = RowPolynomial(series=series[:, 1:2] / scale, near=near, far=far, centre=centre, scale=scale)
    # The longest: a gate that cuts a dwell costs width and amplitude, one a little wider only some coherence.
    length = float(lengths[:, full].max())
    _, own, _ = phase.evaluate(found.range, found.doppler[..., None])
    _, shared, _ = common.evaluate(found.range, found.doppler[..., None])
    apart = float(np.abs(own - shared).max())
    size = min(fourier.fast_length((GATE_ROOM * length + 2 * apart) / slow.step), slow.size)
    return DwellGate(phase=phase, common=common, slope=slope, length=length, time=fourier.centred(0.0, slow.step, size))


def _local_occupancy(line: Line, found: Focus, doppler: Axis) -> float:
    """Part of the sampling that a target's response fills along Doppler once its own carrier is out."""
    reach = np.abs(line.time - found.time[..., None]).max()
    return float(min(2.2 * reach * doppler.step, 0.9))


def _choose(
    geometry: Geometry,
    line: Line,
    chain: Binding,
    *,
    ranges: FloatArray,
    epoch_range: FloatArray,
    yaws: FloatArray,
    shift: float,
    candidate: Candidate | None,
) -> Candidate:
    """Give the chain its coefficients as asked: among fitted ones the cheapest whose lines end level and unfolded."""
    lam, freedom = geometry.collection.wavelength, chain.freedom
    if chain.method.coefficients == "closed-form":
        chain.polynomials = closed_form.levelling(
            geometry, freedom, epoch_range=epoch_range, ranges=ranges, yaws=yaws, shift=shift,
            in_doppler=chain.in_doppler, range_model=chain.method.range_model,
        )  # fmt: skip
        return Candidate(0.0, False)
    chosen = candidate or _cheapest(line, chain, ranges=ranges, wavelength=lam)
    chain.polynomials = fitting.fit(line, ranges=ranges, candidate=chosen, freedom=freedom, wavelength=lam)
    return chosen


def _cheapest(line: Line, chain: Binding, *, ranges: FloatArray, wavelength: float) -> Candidate:
    freedom = chain.freedom
    some = np.array([0, ranges.size // 2, ranges.size - 1])
    part = Line(**{name: _pick(getattr(line, name), some, ranges.size) for name in Line.__dataclass_fields__})
    best: tuple[float, Candidate] | None = None
    tried = fitting.candidates(line, wavelength=wavelength, freedom=freedom)
    if len(tried) == 1:
        return tried[0]
    for candidate in tried:
        chain.polynomials = fitting.fit(
            part, ranges=ranges[some], candidate=candidate, freedom=freedom, wavelength=wavelength, roughly=True
        )
        biased = chain.perturbed(part)
        traced = chain.trace_azimuth(part)
        spread = biased.rate * part.weight.sum(axis=-1, keepdims=True) ** 2
        if traced.folded or not np.isfinite(traced.time).all():
            continue
        if spread.min() * spread.max() < 0:
            continue
        residual = float(focus(traced).residual.max())
        loss = float(fitting.end_loss(traced, biased.rate).max())
        length = np.ptp(traced.time) / np.ptp(part.time)
        fault = max(residual / fitting.GOOD_RESIDUAL, loss / fitting.GOOD_LOSS, 1.0)
        growth = max(length, 1.0) * max(np.ptp(biased.doppler) / np.ptp(part.doppler), 1.0)
        cost = fault * growth
        if best is None or cost < 0.9 * best[0]:
            best = (cost, candidate)
        if fault <= 1.0 and growth < 2.5:
            break
    return Candidate(0.0, freedom.time) if best is None else best[1]


def _pick(values: FloatArray, which: NDArray[np.intp], size: int) -> FloatArray:
    return values[which] if values.shape[0] == size else values


def _predict(
    line: Line, found: Focus, rng: FloatArray, yaw: FloatArray, geometry: Geometry, *, rate: FloatArray
) -> Prediction:
    """The worst of traced lines; `rate` is theirs ahead of what is done in Doppler."""
    range_cell = SPEED_OF_LIGHT / (2 * geometry.collection.bandwidth)
    full = found.residual
    worst = np.unravel_index(int(np.argmax(full)), full.shape)
    weight = (line.weight * np.sqrt(np.maximum(line.stretch, 1e-3)))[worst]
    time = line.time[worst] - found.time[worst]
    level = line.phase[worst] - found.doppler[worst] * line.time[worst]
    spread = float(np.ptp(time))
    offsets = np.linspace(-4, 4, 1601) / max(spread, 1e-9)
    # The dwell's ends lie a little outside the outermost nodes; the sum over nodes is exact all the same.
    response = np.abs((weight * np.exp(2j * np.pi * (level - offsets[:, None] * time))).sum(axis=1))
    ideal = np.abs((weight * np.exp(-2j * np.pi * offsets[:, None] * time)).sum(axis=1))
    slope = np.gradient(found.doppler, yaw, axis=1)
    dwell = (line.weight * line.stretch).sum(axis=-1)
    width = SINC_WIDTH / np.maximum(np.abs(slope) * dwell, 1e-12)
    ground = np.sqrt(np.maximum(rng**2 - (geometry.epoch_position[2] - geometry.collection.ground_height) ** 2, 0.0))
    middle = yaw.size // 2
    return Prediction(
        residual_phase=float(full.max()),
        quadratic_phase=float(found.quadratic.max()),
        pslr=_pslr(response),
        width=_width(response) / _width(ideal),
        migration=float(found.migration.max() / range_cell),
        resolution=float(width[rng.size // 2, middle] * ground[rng.size // 2]),
        loss=float(fitting.end_loss(line, rate).max()),
    )


def _pslr(response: FloatArray) -> float:
    peak = int(np.argmax(response))
    left, right = peak, peak
    while left > 0 and response[left - 1] < response[left]:
        left -= 1
    while right < response.size - 1 and response[right + 1] < response[right]:
        right += 1
    side = max(response[:left].max(initial=0.0), response[right + 1 :].max(initial=0.0))
    return float(20 * np.log10(max(side, 1e-12) / response[peak]))


def _width(response: FloatArray) -> float:
    return float(np.count_nonzero(response >= response.max() / np.sqrt(2)))


def _memory(
    *, gate: RangeGate | None, frequency: Axis, n_bin: int, n_column: int, n_row: int, n_image: int, length: int
) -> int:
    """Peak of a worker that focuses a block, bytes: what each stage reads and writes.

    Stages work in place, but for a range gate's slab, and for an image that is wider in Doppler than the signal was
    long.
    """
    buffer = max(frequency.size, n_row) * n_column
    if gate is None:
        loaded = n_bin * COLUMN_CHUNK
        held = [2 * loaded + buffer]
    else:
        slab, loaded = frequency.size * n_bin, DOPPLER_GROUP * gate.full.size
        held = [2 * loaded + slab, slab + buffer]
    groups = 4 * max(GROUP_BYTES, 8 * 8 * length)
    if n_image > n_column:
        held.append(buffer + n_row * n_image)
    return PROCESS_MEMORY + 8 * max(*held, buffer + 3 * IMAGE_PIXELS) + groups


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """How a collection will be focused: everything the tasks need, and what to expect of them.

    Attributes
    ----------
    seams : (n_blocks + 1,) float
        Yaw at which blocks begin and end, rad; only blocks that the grid touches are planned.
    parts : int
        Range sub-blocks of every block, 1 where blocks are whole; each is a `BlockPlan` of its own.
    refusal : str or None
        Why the geometry cannot be focused, with the figure.
    """

    geometry: Geometry
    grid: Grid
    region: Region
    recovery: Recovery
    seams: FloatArray
    parts: int
    blocks: tuple[BlockPlan, ...]
    method: Method
    refusal: str | None

    @property
    def n_blocks(self) -> int:
        return self.seams.size - 1

    @property
    def spectrum_chunk(self) -> tuple[int, int]:
        """Doppler bins and range frequencies of a chunk of the spectrum."""
        column = COLUMN_CHUNK
        while column > 16 and 8 * column * self.recovery.doppler.size > SPECTRUM_BYTES:
            column //= 2
        return min(CHUNK_SAMPLES // column, self.recovery.doppler.size), column

    @property
    def column_group(self) -> int:
        """Range frequencies recovered by a task, whole chunks of the spectrum."""
        chunk = self.spectrum_chunk[1]
        fitting_ = SIGNAL_BYTES // (8 * self.recovery.pulses.size * chunk)
        return chunk * max(min(fitting_, SIGNAL_COLUMNS // chunk), 1)

    @property
    def recovery_memory(self) -> int:
        """Peak of a worker that recovers the spectrum, bytes."""
        signal = self.column_group * self.recovery.pulses.size
        return PROCESS_MEMORY + 8 * (2 * signal + 2 * self.spectrum_chunk[1] * self.recovery.doppler.size)

    @property
    def memory(self) -> int:
        """Peak of a worker, bytes."""
        return max(self.recovery_memory, *(block.memory for block in self.blocks))

    def transforms(self) -> list[Transforms]:
        """All FFTs of samples that carrying out the plan takes, in order."""
        frequency = self.geometry.collection.range_frequency
        found = [Transforms("recover", frequency.size, n) for n in self.recovery.program(frequency).transforms]
        for block in self.blocks:
            for stage in stages(block.chain):
                found += [Transforms(stage.name, stage.program.n_row, n) for n in stage.program.transforms]
        return found

    def work(self) -> float:
        """Floating-point operations of all transforms and resamplings of the blocks."""
        total = 0.0
        for step in (step for block in self.blocks for step in block.chain):
            for operation in step.operations():
                if isinstance(operation, Transform):
                    total += step.n_row * 5 * operation.period * math.log2(operation.period)
                elif isinstance(operation, Stretch | Resample):
                    total += step.n_row * 4 * step.source.size * operation.taps.shape[1]
        return total

    def excess(self) -> float:
        """The worst of phase, side lobes and migration, each over what it may be: at most 1 is a good plan."""
        return max(block.prediction.excess for block in self.blocks)

    def within_budget(self) -> bool:
        return self.excess() <= 1.0


def plan_collection(
    collection: Collection,
    *,
    blocks: int | Literal["auto"] = "auto",
    parts: int | Literal["auto"] = "auto",
    method: Method = DEFAULT,
    grid: Grid | None = None,
    workers: int = 1,
    memory_limit: int | None = None,
) -> Plan:
    """Plan a collection for a processor.

    `auto` takes the fewest blocks that meet the phase and migration budgets, at least one a worker, and the fewest
    range sub-blocks of each that fit a worker's memory.

    Raises
    ------
    InputError
        If the PRF is too low, the grid is empty or outside the swath, or no number of sub-blocks fits the memory.
    """
    if blocks != "auto" and not 1 <= blocks <= MOST_BLOCKS:
        raise InputError(f"blocks = {blocks}: ask for 1 to {MOST_BLOCKS}, or for 'auto'")
    geometry = Geometry(collection=collection)
    region = plan_region(geometry, grid)
    recovery = plan_recovery(geometry, region, linear=method.derotation == "linear")
    grid = grid or default_grid(geometry, region)
    extent = grid_extent(geometry, region, grid)

    def plan(count: int, divided: int, *, probe: bool = False) -> Plan:
        return _plan_blocks(geometry, region, recovery, grid, extent, count, divided, method, probe=probe)

    whole = 1 if parts == "auto" else parts
    made = plan(blocks, whole) if blocks != "auto" else _fewest_blocks(partial(plan, divided=whole), workers)
    if memory_limit is None or made.refusal is not None:
        return made
    return _fewest_parts(partial(plan, made.n_blocks), made, memory_limit, fixed=parts != "auto")


def _fewest_blocks(plan: Callable[..., Plan], workers: int) -> Plan:
    """The first plan within its budgets; while they are far from it, the outermost blocks and the middle one tell."""
    best, stale = math.inf, 0
    for count in range(min(max(workers, 1), MAX_BLOCKS), MAX_BLOCKS + 1):
        made = plan(count, probe=True)
        if made.excess() <= 1.0 and (whole := plan(count)).excess() <= 1.0:
            return whole
        if _folded(made.blocks) is not None:
            break
        # Margins do not shrink with the blocks: stop once more of them have brought nothing three times.
        excess = made.excess()
        stale = stale + 1 if excess > 0.97 * best else 0
        best = min(best, excess)
        if stale == 3:
            break
    return plan(count)


def _fewest_parts(plan: Callable[[int], Plan], whole: Plan, memory_limit: int, *, fixed: bool) -> Plan:
    """The plan with its blocks in as many range sub-blocks as a worker's memory asks for."""
    made, room = whole, MEMORY_SHARE * memory_limit
    least = max(made.recovery_memory, PROCESS_MEMORY)
    if room <= least:
        raise InputError(
            f"memory limit {memory_limit / MIB:.0f} MiB a worker is too low: recovery needs about "
            f"{math.ceil(least / MEMORY_SHARE / MIB)} MiB, however blocks are divided; raise --memory-limit"
        )
    needed = [made.memory]
    while made.memory > room:
        if fixed or made.parts == MAX_PARTS:
            break
        share = (made.memory - PROCESS_MEMORY) / (room - PROCESS_MEMORY)
        made = plan(min(max(made.parts + 1, math.ceil(0.9 * made.parts * share)), MAX_PARTS))
        needed.append(made.memory)
        if len(needed) > 2 and needed[-1] > 0.97 * needed[-2]:
            break
    if made.memory > room:
        raise InputError(
            f"memory limit {memory_limit / MIB:.0f} MiB a worker is too low: {made.n_blocks} blocks need about "
            f"{math.ceil(min(needed) / MEMORY_SHARE / MIB)} MiB even in {made.parts} range sub-blocks; raise "
            "--memory-limit, ask for more --blocks, or image a smaller grid"
        )
    return made


def _plan_blocks(
    geometry: Geometry,
    region: Region,
    recovery: Recovery,
    grid: Grid,
    extent: Extent,
    count: int,
    divided: int,
    method: Method,
    *,
    probe: bool,
) -> Plan:
    """All blocks that the grid touches; of many, as a probe, only the outermost and the one in the middle."""
    seams = block_seams(geometry, region, count)
    planned = []
    touched = [i for i in range(count) if seams[i + 1] > extent.low and seams[i] < extent.high]
    if probe:
        touched = sorted({touched[0], touched[len(touched) // 2], touched[-1]})
    for index in touched:
        low, high = float(seams[index]), float(seams[index + 1])
        near, far = region.limits(low, high)
        near, far = max(near, extent.near), min(far, extent.far)
        # Rows are told apart modulo the range window: a block cannot hold more than that.
        excess = (far - near) - 0.97 * geometry.collection.range_window
        if excess > 0:
            near, far = near + excess / 2, far - excess / 2
        if far <= near:
            continue
        # Nine ranges need some room between them for their polynomials to mean anything.
        least = 64 * SPEED_OF_LIGHT / (2 * geometry.collection.bandwidth)
        room = max(least - (far - near), 0.0) / 2
        edges = np.linspace(near - room, far + room, divided + 1)
        candidate = None
        for part, (nearest, farthest) in enumerate(pairwise(edges.tolist())):
            block = plan_block(
                geometry, recovery, region, index=index, part=part if divided > 1 else None, low=low, high=high,
                near=nearest, far=farthest, method=method, candidate=candidate,
            )  # fmt: skip
            candidate = block.candidate
            planned.append(block)
    if not planned:
        raise InputError(f"none of {count} blocks holds a point of the grid; give it a finer step, or move it")
    return Plan(
        geometry=geometry, grid=grid, region=region, recovery=recovery, seams=seams, parts=divided,
        blocks=tuple(planned), method=method, refusal=_refusal(planned, method),
    )  # fmt: skip


def _refusal(blocks: Sequence[BlockPlan], method: Method) -> str | None:
    """Why a plan cannot be carried out, if so. A rival's blur is what one wants to see of it."""
    return _folded(blocks) or (None if method.rival else _blurred(blocks))


def _folded(blocks: Sequence[BlockPlan]) -> str | None:
    """Why yaws of a block share their Doppler, so that no transform tells them apart, if so.

    Looking along the velocity they share it in the echo itself. Where the platform's acceleration cancels the Doppler
    rate, as on a circle, they do after a deramp that no bias chirp comes before.
    """
    for block in blocks:
        slope = block.ground.doppler_slope() * np.pi / 180
        if slope.min() * slope.max() > 0:
            continue
        said = f"Doppler changes by {slope.min():.3g} .. {slope.max():.3g} Hz a degree of yaw, through zero"
        echo = _echo_slope(block)
        if echo.min() * echo.max() <= 0:
            return (
                f"{_called(block)} looks along the velocity: {said}, so yaws cannot be told apart; image ground away "
                "from the direction of flight, or use --processor backprojection"
            )
        return (
            f"{_called(block)}: {said}, once its steps are through, as acceleration cancels the Doppler rate; use "
            "--processor angular-division, which may add a bias chirp, or backprojection"
        )
    return None


def _echo_slope(block: BlockPlan) -> FloatArray:
    """Of the range rate in the middle of the dwell per yaw, m/s per rad, over a block's ranges and yaws (9, 33)."""
    geometry = block.ground.geometry
    yaw = np.linspace(block.low, block.high, 33)
    rng, yaws = np.meshgrid(np.linspace(block.ground.near, block.ground.far, 9), yaw, indexing="ij")
    start, end = geometry.dwell(yaws)
    _, rate = geometry.range_history(geometry.ground_point(rng, yaws), (start + end) / 2)
    return np.gradient(rate, yaw, axis=1)


def _blurred(blocks: Sequence[BlockPlan]) -> str | None:
    for block in blocks:
        phase, migration = block.prediction.residual_phase, block.prediction.migration
        kept = None
        if not phase < np.pi / 2:
            kept = f"a phase error of {phase:.3g} rad"
        elif not migration < 1.0:
            kept = f"a range migration of {migration:.3g} resolution cells"
        if kept is not None:
            return (
                f"{_called(block)} would keep {kept} over the dwell; ask for more --blocks, or see what "
                "`blocksar plan --processor auto` proposes"
            )
    return None


def _called(block: BlockPlan) -> str:
    return f"block {block.name} (yaw {np.degrees(block.low):.2f} .. {np.degrees(block.high):.2f} degrees)"
