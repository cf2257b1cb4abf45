"""From a collection's metadata to everything that focusing needs: no sample is read.

Blocks with their Doppler supports, margins, padding and coefficients; where every target will focus and
with what phase; predicted residual phase, side lobes, width and range migration; memory of a task.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from blocksar import fitting, fourier
from blocksar.azimuth_steps import Deramp, DopplerTransform, DwellGate, Perturbation
from blocksar.fitting import AzimuthPhases
from blocksar.fourier import Axis
from blocksar.geometry import Geometry
from blocksar.ground import YAW_STEPS, GroundMap, surfaces
from blocksar.lines import Focus, Line, RowPhase, focus
from blocksar.parameters import SINC_WIDTH, SPEED_OF_LIGHT, Collection, FloatArray, InputError
from blocksar.phase import taps_needed
from blocksar.range_steps import Keystone, RangeCompression, ResidualRangeWalk, Step
from blocksar.recovery import Recovery
from blocksar.recovery_plan import plan_recovery, recovered_line, tail_margin
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

Coefficients = Literal["fitted", "closed-form"]

PHASE_BUDGET = 0.1  # rad at the edge of the dwell; pi/4 is the usual limit, this costs no side lobe 0.1 dB
MIGRATION_BUDGET = 0.25  # range resolution cells over the dwell
TAP_ERROR = 1e-3
KEYSTONE_ERROR = 1e-4
GATE_ROOM = 1.5  # dwells that the image's Doppler sampling makes room for
MAX_BLOCKS = 32
MEMORY_SHARE = 0.8  # of a worker's limit that a plan may fill
MIB = 2**20
PROCESS_MEMORY = 330 * MIB  # a worker's interpreter and libraries, before any sample


class Prediction(NamedTuple):
    """What a block's traced lines promise, the worst of its targets."""

    residual_phase: float  # rad, largest over the dwell
    quadratic_phase: float  # rad, its quadratic part at the dwell's edge
    pslr: float  # dB, azimuth
    width: float  # azimuth width over the dwell's limit
    migration: float  # range resolution cells over the dwell
    resolution: float  # azimuth, m


@dataclass(frozen=True, kw_only=True, eq=False)
class BlockPlan:
    """One angular block: its part of the spectrum, its chain, its place on the ground.

    Attributes
    ----------
    index : int
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
    bias : float
        Range acceleration that the time perturbation adds, m/s^2.
    """

    index: int
    low: float
    high: float
    first_bin: int
    n_bin: int
    chain: tuple[Step, ...]
    ground: GroundMap
    prediction: Prediction
    memory: int
    bias: float


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
    coefficients: Coefficients,
) -> BlockPlan:
    """Plan one block that owns the yaws [low, high) and the epoch ranges [near, far)."""
    collection = geometry.collection
    period = fourier.fast_length(1.3 * collection.n_range_frequency)
    row_step = collection.range_window / period

    # Coarse lines through the range steps: for supports, coefficients and sampling.
    nodes = _end_nodes(near, far, 9)
    line = recovered_line(
        geometry,
        epoch_range=nodes[:, None],
        yaw=np.linspace(low, high, 15),
        origin=recovery.origin,
        walk=recovery.walk,
    )
    duration = float(line.weight.sum(axis=-1).max())
    slab = _plan_slab(collection, recovery.doppler, line, margin=tail_margin(duration))
    in_range = _RangeSteps(
        slab=slab.doppler,
        walk=slab.walk,
        carrier=collection.carrier,
        range_frequency=Axis(
            float(collection.range_frequency[0]), collection.range_frequency_step, collection.n_range_frequency
        ),
        reference=np.asarray(
            fitting.range_series(geometry, np.array((near + far) / 2), np.array((low + high) / 2), order=8)
        ),
        period=period,
    )
    # Lines do not ask how time and rows are sampled, which is not known yet.
    straight = _trace(line, in_range.bound(Axis(recovery.time.start, 1.0, 1), 0.5, Axis(0.0, row_step, period)))
    phases, bias = _choose(
        geometry,
        straight,
        ranges=nodes - recovery.origin,
        epoch_range=nodes,
        yaw=(low + high) / 2,
        half_width=(high - low) / 2,
        shift=-2 / collection.wavelength * recovery.walk + slab.walk,
        coefficients=coefficients,
    )
    focused = _trace_azimuth(straight, phases)
    spots = focus(focused)
    axes = _plan_axes(recovery, slab, straight, focused, phases, duration=duration)
    range_filling = collection.n_range_frequency / period
    range_taps = (taps_needed(range_filling, error=TAP_ERROR), range_filling)
    rows = _plan_rows(spots, step=row_step, reach=(range_taps[0] / 2 + 2) * row_step, at_most=period)

    # Fine lines through the whole chain: for the gate, the place of every target, and the prediction.
    range_chain = in_range.bound(axes.time, axes.occupancy, rows)
    fine_range, fine_yaw = _end_nodes(near, far, 13), _end_nodes(low, high, 33)
    fine = recovered_line(
        geometry, epoch_range=fine_range[:, None], yaw=fine_yaw, origin=recovery.origin, walk=recovery.walk
    )
    fine = _trace_azimuth(_trace(fine, range_chain), phases)
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
        low=low,
        high=high,
        first_bin=slab.first_bin,
        n_bin=slab.doppler.size,
        chain=(
            *range_chain,
            *_azimuth_steps(phases, time=axes.time, doppler=axes.doppler, long_time=axes.long_time, rows=rows),
            final,
        ),
        ground=ground,
        prediction=_predict(fine, found, fine_range, fine_yaw, geometry),
        memory=_memory(
            n_frequency=collection.n_range_frequency,
            n_bin=slab.doppler.size,
            n_time=axes.time.size,
            n_row=rows.size,
            n_padded=axes.long_time.size,
            n_image=final.image_doppler.size,
        ),
        bias=bias,
    )


def _end_nodes(low: float, high: float, count: int) -> FloatArray:
    """Chebyshev's nodes with both ends, ascending."""
    return low + (high - low) * (1 - np.cos(np.pi * np.arange(count) / (count - 1))) / 2


class _Slab(NamedTuple):
    """A block's part of the recovered spectrum."""

    first_bin: int
    doppler: Axis
    walk: float  # Hz on the carrier: the middle of the block's Doppler
    margin: float  # Hz


def _plan_slab(collection: Collection, spectrum: Axis, line: Line, *, margin: float) -> _Slab:
    edge = 1 + np.array([-1, 1]) * np.abs(collection.range_frequency).max() / collection.carrier
    band = np.outer(edge, [line.doppler.min(), line.doppler.max()])
    first_bin = max(int(np.floor(spectrum.position(np.array(band.min() - margin)))), 0)
    last_bin = min(int(np.ceil(spectrum.position(np.array(band.max() + margin)))) + 1, spectrum.size)
    walk = float((line.doppler.min() + line.doppler.max()) / 2)
    return _Slab(first_bin, spectrum.part(first_bin, last_bin - first_bin), walk, margin)


class _RangeSteps(NamedTuple):
    """The range steps of a block but for their sampling."""

    slab: Axis
    walk: float
    carrier: float
    range_frequency: Axis
    reference: FloatArray
    period: int

    def bound(self, time: Axis, occupancy: float, rows: Axis) -> tuple[Step, ...]:
        fc, f = self.carrier, self.range_frequency
        taps = taps_needed(occupancy, error=KEYSTONE_ERROR)
        return (
            ResidualRangeWalk(slab=self.slab, time=time, walk=self.walk, carrier=fc, range_frequency=f),
            Keystone(time=time, occupancy=occupancy, taps=taps, carrier=fc, range_frequency=f),
            RangeCompression(
                time=time, reference=self.reference, rows=rows, period=self.period, carrier=fc, range_frequency=f
            ),
        )


class _Axes(NamedTuple):
    """Sampling of a block's azimuth: as it comes out of the slab, and lengthened for deramping."""

    time: Axis
    occupancy: float  # part of that sampling rate which the slab fills
    doppler: Axis
    long_time: Axis


def _plan_axes(
    recovery: Recovery, slab: _Slab, straight: Line, focused: Line, phases: AzimuthPhases, *, duration: float
) -> _Axes:
    """Sampling for the band that the time perturbation leaves, and for the longest reach of any line in time."""
    perturbed = straight.multiply_time(*phases.time.evaluate(straight.range.mean(axis=-1), straight.time))
    start = slab.doppler.start - slab.walk
    bands = [start, slab.doppler.start + slab.doppler.extent - slab.walk]
    bands += [float(perturbed.doppler.min()) - slab.margin, float(perturbed.doppler.max()) + slab.margin]
    held = max(bands) - min(bands)
    span = recovery.time.extent
    n_time = fourier.fast_length(1.25 * span * max(held, slab.doppler.extent))
    time = Axis(recovery.time.start, span / n_time, n_time)
    guard = 0.05 * duration
    begin = min(float(focused.time.min()) - guard, time.start)
    end = max(float(focused.time.max()) + guard, time.start + recovery.pulses.extent)
    n_padded = max(fourier.fast_length((end - begin) / time.step), n_time)
    return _Axes(
        time=time,
        occupancy=min(span * slab.doppler.extent / n_time, 0.95),
        doppler=fourier.dual(time, size=n_padded, centre=(min(bands) + max(bands)) / 2),
        long_time=Axis(begin, time.step, n_padded),
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
    phase = RowPhase(series=integral, near=near, far=far, centre=centre, scale=scale)
    at_middle = phase.coefficients(np.array((near + far) / 2))[None]
    common = RowPhase(series=at_middle, near=near, far=far, centre=centre, scale=scale)
    slope = RowPhase(series=series[:, 1:2] / scale, near=near, far=far, centre=centre, scale=scale)
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


def _trace(line: Line, steps: tuple[Step, ...]) -> Line:
    for step in steps:
        line = step.trace(line)
    return line


def _azimuth_steps(
    phases: AzimuthPhases, *, time: Axis, doppler: Axis, long_time: Axis, rows: Axis
) -> tuple[Perturbation, Deramp]:
    """Perturbation and deramp; the final transform, which moves no line, follows."""
    return (
        Perturbation(time=time, doppler=doppler, rows=rows, time_phase=phases.time, doppler_phase=phases.doppler),
        Deramp(doppler=doppler, time=long_time, rows=rows, phases=phases.deramp),
    )


def _trace_azimuth(line: Line, phases: AzimuthPhases) -> Line:
    """Lines do not ask how time, Doppler and rows are sampled."""
    unknown = Axis(0.0, 1.0, 1)
    return _trace(line, _azimuth_steps(phases, time=unknown, doppler=unknown, long_time=unknown, rows=unknown))


def _choose(
    geometry: Geometry,
    line: Line,
    *,
    ranges: FloatArray,
    epoch_range: FloatArray,
    yaw: float,
    half_width: float,
    shift: float,
    coefficients: Coefficients,
) -> tuple[AzimuthPhases, float]:
    """The coefficients as asked; among fitted chains the cheapest whose lines end level, thick and unfolded."""
    lam = geometry.collection.wavelength
    if coefficients == "closed-form":
        phases = fitting.closed_form_phases(
            geometry, epoch_range=epoch_range, ranges=ranges, yaw=yaw, half_width=half_width, shift=shift
        )
        return phases, 0.0
    some = np.array([0, ranges.size // 2, ranges.size - 1])
    part = Line(**{name: _pick(getattr(line, name), some, ranges.size) for name in Line.__dataclass_fields__})
    best: tuple[float, fitting.Candidate] | None = None
    for candidate in fitting.candidates(line, wavelength=lam):
        phases = fitting.fit_phases(part, ranges=ranges[some], candidate=candidate, wavelength=lam)
        biased = part.multiply_time(*phases.time.evaluate(part.range.mean(axis=-1), part.time))
        traced = _trace_azimuth(part, phases)
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
    if best is None:
        best = (np.inf, fitting.Candidate(0.0, True))
    phases = fitting.fit_phases(line, ranges=ranges, candidate=best[1], wavelength=lam)
    return phases, best[1].bias


def _pick(values: FloatArray, which: NDArray[np.intp], size: int) -> FloatArray:
    return values[which] if values.shape[0] == size else values


def _predict(line: Line, found: Focus, rng: FloatArray, yaw: FloatArray, geometry: Geometry) -> Prediction:
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


def _memory(*, n_frequency: int, n_bin: int, n_time: int, n_row: int, n_padded: int, n_image: int) -> int:
    """Peak of a worker over the chain: each step holds its input and its output."""
    sizes = [n_frequency * n_bin, n_frequency * n_time, n_frequency * n_time, n_row * n_time]
    sizes += [n_row * n_padded, n_row * n_padded, n_row * n_image]
    pairs = [a + b for a, b in pairwise(sizes)]
    return PROCESS_MEMORY + 8 * max(pairs)


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """How a collection will be focused: everything the tasks need, and what to expect of them.

    Attributes
    ----------
    seams : (n_blocks + 1,) float
        Yaw at which blocks begin and end, rad; only blocks that the grid touches are planned.
    refusal : str or None
        Why the geometry cannot be focused, with the figure.
    """

    geometry: Geometry
    grid: Grid
    region: Region
    recovery: Recovery
    seams: FloatArray
    blocks: tuple[BlockPlan, ...]
    coefficients: Coefficients
    refusal: str | None

    @property
    def n_blocks(self) -> int:
        return self.seams.size - 1

    @property
    def memory(self) -> int:
        return max(block.memory for block in self.blocks)

    def excess(self, memory_limit: int | None = None) -> float:
        """The worst of phase, migration and memory, each over what it may be: at most 1 is a good plan."""
        worst = [b.prediction.residual_phase / PHASE_BUDGET for b in self.blocks]
        worst += [b.prediction.migration / MIGRATION_BUDGET for b in self.blocks]
        if memory_limit is not None:
            worst.append(self.memory / (MEMORY_SHARE * memory_limit))
        return max(worst)

    def within_budget(self) -> bool:
        return self.excess() <= 1.0


def plan_collection(
    collection: Collection,
    *,
    blocks: int | Literal["auto"] = "auto",
    coefficients: Coefficients = "fitted",
    grid: Grid | None = None,
    workers: int = 1,
    memory_limit: int | None = None,
) -> Plan:
    """Plan a collection for the angular-division chain.

    `auto` takes the fewest blocks that meet the phase and migration budgets and a worker's memory, and at
    least one a worker.

    Raises
    ------
    InputError
        If the PRF is too low, the grid is empty or outside the swath, or no number of blocks fits the memory.
    """
    geometry = Geometry(collection=collection)
    region = plan_region(geometry, grid)
    recovery = plan_recovery(geometry, region)
    grid = grid or default_grid(geometry, region)
    extent = grid_extent(geometry, region, grid)
    if memory_limit is not None and MEMORY_SHARE * memory_limit <= PROCESS_MEMORY:
        raise InputError(
            f"memory limit {memory_limit / MIB:.0f} MiB a worker is too low: it takes {PROCESS_MEMORY / MIB:.0f} MiB "
            f"before it holds a sample; give --memory-limit {2 * PROCESS_MEMORY / MIB:.0f}MiB or more"
        )
    if blocks != "auto":
        plan = _plan_blocks(geometry, region, recovery, grid, extent, blocks, coefficients)
        _check_memory(plan, memory_limit)
        return plan
    best, stale = math.inf, 0
    for count in range(min(max(workers, 1), MAX_BLOCKS), MAX_BLOCKS + 1):
        plan = _plan_blocks(geometry, region, recovery, grid, extent, count, coefficients)
        excess = plan.excess(memory_limit)
        if plan.refusal is not None or excess <= 1.0:
            return plan
        # Margins do not shrink with the blocks: stop once more of them have brought nothing three times.
        stale = stale + 1 if excess > 0.97 * best else 0
        best = min(best, excess)
        if stale == 3:
            break
    _check_memory(plan, memory_limit)
    return plan


def _check_memory(plan: Plan, memory_limit: int | None) -> None:
    if memory_limit is not None and plan.memory > MEMORY_SHARE * memory_limit:
        raise InputError(
            f"memory limit {memory_limit / MIB:.0f} MiB a worker is too low for {plan.n_blocks} blocks, which need "
            f"{plan.memory / MEMORY_SHARE / MIB:.0f} MiB; raise --memory-limit, ask for more --blocks, or image a "
            "smaller grid"
        )


def _plan_blocks(
    geometry: Geometry,
    region: Region,
    recovery: Recovery,
    grid: Grid,
    extent: Extent,
    count: int,
    coefficients: Coefficients,
) -> Plan:
    seams = block_seams(geometry, region, count)
    planned = []
    for index in range(count):
        low, high = float(seams[index]), float(seams[index + 1])
        if high <= extent.low or low >= extent.high:
            continue
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
        planned.append(
            plan_block(
                geometry, recovery, region, index=index, low=low, high=high, near=near - room, far=far + room,
                coefficients=coefficients,
            )
        )  # fmt: skip
    return Plan(
        geometry=geometry, grid=grid, region=region, recovery=recovery, seams=seams, blocks=tuple(planned),
        coefficients=coefficients, refusal=_refusal(geometry, planned, coefficients),
    )  # fmt: skip


def _refusal(geometry: Geometry, blocks: list[BlockPlan], coefficients: Coefficients) -> str | None:
    """Looking along the velocity yaw and Doppler part company: no Fourier processor can tell yaws apart there."""
    for block in blocks:
        slope = block.ground.doppler_slope()
        if slope.min() * slope.max() <= 0:
            return (
                f"block {block.index} (yaw {np.degrees(block.low):.2f} .. {np.degrees(block.high):.2f} degrees) looks "
                f"along the velocity: Doppler changes by {slope.min() * np.pi / 180:.3g} .. "
                f"{slope.max() * np.pi / 180:.3g} Hz a degree of yaw, through zero, so yaws cannot be told apart; "
                "image ground away from the direction of flight, or use --processor backprojection"
            )
        if coefficients == "fitted" and not block.prediction.residual_phase < np.pi / 2:
            return (
                f"block {block.index} (yaw {np.degrees(block.low):.2f} .. {np.degrees(block.high):.2f} degrees) would "
                f"keep a phase error of {block.prediction.residual_phase:.3g} rad over the dwell; ask for more "
                "--blocks, or use --processor backprojection"
            )
    return None
