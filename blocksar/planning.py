"""From a collection's metadata to everything that focusing needs: no sample is read.

Blocks with their Doppler supports, margins, padding and coefficients; where every target will focus and
with what phase; predicted residual phase, side lobes, width and range migration; memory of a task.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.polynomial import chebyshev

from blocksar import fitting, fourier
from blocksar.azimuth_steps import Deramp, DopplerTransform, DwellGate, Perturbation
from blocksar.fitting import AzimuthPhases
from blocksar.fourier import Axis
from blocksar.geometry import Geometry
from blocksar.ground import YAW_STEPS, GroundMap, surfaces
from blocksar.lines import Focus, Line, RowPhase, focus
from blocksar.parameters import SPEED_OF_LIGHT, Collection, FloatArray, InputError
from blocksar.phase import taps_needed
from blocksar.range_steps import Keystone, RangeCompression, ResidualRangeWalk, Step
from blocksar.recovery import Recovery

Coefficients = Literal["fitted", "closed-form"]

PHASE_BUDGET = 0.1  # rad at the edge of the dwell; pi/4 is the usual limit, this costs no side lobe 0.1 dB
MIGRATION_BUDGET = 0.25  # range resolution cells over the dwell
LINE_NODES = 16
TAIL_ENERGY = 1e-3  # of a target's energy that may lie outside its block's Doppler support
TAP_ERROR = 1e-3
KEYSTONE_ERROR = 1e-4
WINDOW_GUARD = 8  # range cells kept free at either end of the range window
WINDOW_EDGE = 0.05  # of the range window, at either end, that the PRF need not hold: echoes only pass through
GATE_ROOM = 1.5  # dwells that the image's Doppler sampling makes room for
SINC_WIDTH = 0.8859  # -3 dB width of a sinc, in units of its first null
MAX_BLOCKS = 64
MEMORY_SHARE = 0.8  # of a worker's limit that a plan may fill
PROCESS_MEMORY = 330 * 2**20  # a worker's interpreter and libraries, before any sample


@dataclass(frozen=True)
class Grid:
    """Ground pixels: x0, x0 + dx, ... < x1, likewise y, in m."""

    x0: float
    x1: float
    dx: float
    y0: float
    y1: float
    dy: float

    def __post_init__(self) -> None:
        for name, low, high, step in (("x", self.x0, self.x1, self.dx), ("y", self.y0, self.y1, self.dy)):
            if not all(np.isfinite([low, high, step])) or step <= 0:
                raise InputError(f"grid {name}: {low:g}:{high:g}:{step:g} needs finite ends and a step above 0 m")
            if high <= low:
                raise InputError(f"grid {name}: {low:g}:{high:g} is empty; the end must lie above the start")

    @staticmethod
    def _axis(low: float, high: float, step: float) -> FloatArray:
        count = int(np.ceil((high - low) / step - 1e-9))
        return low + step * np.arange(max(count, 1))

    @cached_property
    def x(self) -> FloatArray:
        return self._axis(self.x0, self.x1, self.dx)

    @cached_property
    def y(self) -> FloatArray:
        return self._axis(self.y0, self.y1, self.dy)

    @property
    def shape(self) -> tuple[int, int]:
        return self.y.size, self.x.size


@dataclass(frozen=True, kw_only=True, eq=False)
class Region:
    """What can be imaged: yaws that are lit, and at each the epoch ranges that the range window holds.

    yaw (n,), rad, ascending, ends included; near, far (n,), m.
    """

    yaw: FloatArray
    near: FloatArray
    far: FloatArray

    def limits(self, low: float, high: float) -> tuple[float, float]:
        """Nearest and farthest range anywhere between two yaws."""
        yaw = np.concatenate([[low], self.yaw[(self.yaw > low) & (self.yaw < high)], [high]])
        near, far = self.at(yaw)
        return float(near.min()), float(far.max())

    def at(self, yaw: FloatArray) -> tuple[FloatArray, FloatArray]:
        return np.interp(yaw, self.yaw, self.near), np.interp(yaw, self.yaw, self.far)


def lit_yaw(collection: Collection) -> tuple[float, float]:
    """First and last yaw that is ever lit by a steered beam, rad."""
    half = (collection.beam_width or 0.0) / 2
    return float(collection.beam_azimuth.min() - half), float(collection.beam_azimuth.max() + half)


def plan_region(geometry: Geometry, grid: Grid | None) -> Region:
    """The yaws and ranges to plan for.

    Raises
    ------
    InputError
        If an unsteered collection comes without a grid, or the grid is not on the imaged ground.
    """
    collection = geometry.collection
    if collection.steered:
        low, high = lit_yaw(collection)
        near, far = _window(geometry, np.linspace(low, high, 65), None)
        return Region(yaw=np.linspace(low, high, 65), near=near, far=far)
    if grid is None:
        raise InputError(
            "grid is missing: a collection whose beam is not steered lights everything, so give --grid "
            "x0:x1:dx,y0:y1:dy for the ground to image"
        )
    x, y = _outline(grid)
    if grid.x0 <= geometry.nadir[0] <= grid.x1 and grid.y0 <= geometry.nadir[1] <= grid.y1:
        raise InputError(
            f"grid {grid.x0:g}:{grid.x1:g},{grid.y0:g}:{grid.y1:g} holds the platform's nadir "
            f"({geometry.nadir[0]:.6g}, {geometry.nadir[1]:.6g}) m, about which yaw has no meaning; move it aside"
        )
    yaw = np.unwrap(geometry.yaw(x, y))
    rng = geometry.epoch_range(x, y)
    pad = 0.01 * np.ptp(yaw)
    nodes = np.linspace(yaw.min() - pad, yaw.max() + pad, 33)
    near, far = _window(geometry, nodes, (float(rng.min()), float(rng.max())))
    return Region(yaw=nodes, near=near, far=far)


def _outline(grid: Grid) -> tuple[FloatArray, FloatArray]:
    t = np.linspace(0, 1, 65)
    x0, x1, y0, y1 = grid.x[0], grid.x[-1], grid.y[0], grid.y[-1]
    x = np.concatenate([x0 + (x1 - x0) * t, np.full(65, x1), x1 - (x1 - x0) * t, np.full(65, x0)])
    y = np.concatenate([np.full(65, y0), y0 + (y1 - y0) * t, np.full(65, y1), y1 - (y1 - y0) * t])
    return x, y


def _window(geometry: Geometry, yaw: FloatArray, within: tuple[float, float] | None) -> tuple[FloatArray, FloatArray]:
    """Epoch ranges at each yaw whose echo stays inside the unambiguous window while it is lit."""
    collection = geometry.collection
    half = collection.range_window / 2 - WINDOW_GUARD * SPEED_OF_LIGHT / (2 * collection.bandwidth)
    reference = np.interp(geometry.epoch, collection.time, collection.reference_range)
    floor = float(geometry.epoch_position[2] - collection.ground_height)
    spread = np.ptp(collection.reference_range) + np.ptp(geometry.track.position(collection.time), axis=0).max()
    low = max(reference - half - spread, floor * 1.0005)
    trial = np.linspace(low, reference + half + spread, 41)
    first, last = geometry.dwell(yaw)
    u = np.linspace(0, 1, 9)
    time = first[:, None] + (last - first)[:, None] * u
    point = geometry.ground_point(trial[None, :], yaw[:, None])
    rng, _ = geometry.range_history(point[:, :, None, :], time[:, None, :])
    held = rng - np.interp(time, collection.time, collection.reference_range)[:, None, :]
    nearest, farthest = held.min(axis=2), held.max(axis=2)
    near = np.array([np.interp(-half, row[np.isfinite(row)], trial[np.isfinite(row)]) for row in nearest])
    far = np.array([np.interp(half, row[np.isfinite(row)], trial[np.isfinite(row)]) for row in farthest])
    if within is not None:
        near, far = np.maximum(near, within[0]), np.minimum(far, within[1])
    if not (far > near).all():
        shown = "" if within is None else f" (the grid's ranges are {within[0]:.6g} .. {within[1]:.6g} m)"
        raise InputError(
            f"grid lies outside the swath: the range window of {collection.range_window:.6g} m about the reference "
            f"range {reference:.6g} m holds none of it{shown}; move the grid"
        )
    return near, far


def recovered_line(
    geometry: Geometry, *, epoch_range: FloatArray, yaw: FloatArray, origin: float, walk: float
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
    rho = rng - origin - walk * slow
    to_cycles = -2 * collection.carrier / SPEED_OF_LIGHT
    return Line(
        time=slow,
        doppler=to_cycles * (rate - walk),
        rate=to_cycles * curvature,
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


def plan_recovery(geometry: Geometry, region: Region) -> Recovery:
    """Unified walk, derotation, padding, and whether the PRF suffices.

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
    line = _lit_lines(geometry, region, origin, walk, margin=0.0)
    inner = _lit_lines(geometry, region, origin, walk, margin=WINDOW_EDGE)
    half = pulses.extent / 2
    middle = pulses.start + pulses.step * (pulses.size - 1) / 2
    u = (inner.time - middle) / half
    series = _middle_line(u.ravel(), inner.doppler.ravel(), order=min(9, time.size // 8))
    bent = inner.doppler - chebyshev.chebval(u, series)
    low, high = float(line.doppler.min()), float(line.doppler.max())
    derotated_low, derotated_high = float(bent.min()), float(bent.max())
    centre_band = (derotated_low + derotated_high) / 2
    spread = (derotated_high - derotated_low) * (1 + band_edge)
    needed = spread
    if collection.prf < needed:
        raise InputError(
            f"PRF {collection.prf:.6g} Hz is too low: after nonlinear derotation the lit scene still spans "
            f"{spread:.6g} Hz of Doppler, so a PRF of at least {needed:.6g} Hz is needed; collect with a higher PRF or "
            + ("a narrower beam" if collection.steered else "image a smaller grid")
        )
    series[0] += centre_band
    derotation = chebyshev.chebint(series) * half

    dwell = float(np.max(np.subtract(*geometry.dwell(region.yaw)[::-1])))
    margin = tail_margin(dwell)
    padded = fourier.fast_length(1.02 * pulses.size + 16)
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
    bulk = to_cycles * (origin + walk * slow - collection.reference_range + unmodelled)
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
    )




def _lit_lines(geometry: Geometry, region: Region, origin: float, walk: float, *, margin: float) -> Line:
    near, far = region.at(region.yaw)
    width = far - near
    ranges = np.linspace(near + margin * width, far - margin * width, 5)
    return recovered_line(geometry, epoch_range=ranges, yaw=region.yaw, origin=origin, walk=walk)


def _middle_line(u: FloatArray, doppler: FloatArray, *, order: int) -> FloatArray:
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
    return np.asarray(chebyshev.chebfit(place, ((low + high) / 2)[filled], min(order, int(filled.sum()) - 1)))


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
    lam, fc = collection.wavelength, collection.carrier
    range_cell = SPEED_OF_LIGHT / (2 * collection.bandwidth)
    nodes = near + (far - near) * (1 - np.cos(np.pi * np.arange(9) / 8)) / 2
    yaw = np.linspace(low, high, 15)
    line = recovered_line(
        geometry, epoch_range=nodes[:, None], yaw=yaw, origin=recovery.origin, walk=recovery.walk
    )
    duration = float(line.weight.sum(axis=-1).max())
    margin = tail_margin(duration)
    edge = 1 + np.array([-1, 1]) * np.abs(collection.range_frequency).max() / fc
    band = np.outer(edge, [line.doppler.min(), line.doppler.max()])
    spectrum = recovery.doppler
    first_bin = max(int(np.floor(spectrum.position(np.array(band.min() - margin)))), 0)
    last_bin = min(int(np.ceil(spectrum.position(np.array(band.max() + margin)))) + 1, spectrum.size)
    slab = spectrum.part(first_bin, last_bin - first_bin)
    walk = float((line.doppler.min() + line.doppler.max()) / 2)

    frequency = Axis(float(collection.range_frequency[0]), collection.range_frequency_step, collection.n_range_frequency)
    middle = fitting.range_series(
        geometry, np.array((near + far) / 2), np.array((low + high) / 2), order=8
    )
    base: dict[str, Any] = {"carrier": fc, "range_frequency": frequency}
    steps_in_range = {"walk": walk, "reference": np.asarray(middle)}

    def range_steps(slow: Axis, occupancy: float, rows: Axis, period: int) -> tuple[Step, ...]:
        return (
            ResidualRangeWalk(slab=slab, time=slow, walk=steps_in_range["walk"], **base),
            Keystone(time=slow, occupancy=occupancy, taps=taps_needed(occupancy, error=KEYSTONE_ERROR), **base),
            RangeCompression(time=slow, reference=steps_in_range["reference"], rows=rows, period=period, **base),
        )

    period = fourier.fast_length(1.3 * collection.n_range_frequency)
    row_step = collection.range_window / period
    nothing = Axis(0.0, row_step, period)
    straight = line
    for step in range_steps(Axis(recovery.time.start, 1.0, 1), 0.5, nothing, period):
        straight = step.trace(straight)

    ranges = nodes - recovery.origin
    phases, bias = _choose(
        geometry, straight, ranges=ranges, epoch_range=nodes, yaw=(low + high) / 2, half_width=(high - low) / 2,
        shift=-2 / lam * recovery.walk + walk, coefficients=coefficients,
    )  # fmt: skip

    # Sampling: the band that the time perturbation leaves, and the longest reach of any line in time.
    perturbed = straight.multiply_time(*phases.time.evaluate(straight.range.mean(axis=-1), straight.time))
    bands = [slab.start - walk, slab.start + slab.extent - walk]
    bands += [float(perturbed.doppler.min()) - margin, float(perturbed.doppler.max()) + margin]
    held = max(bands) - min(bands)
    span = recovery.time.extent
    n_time = fourier.fast_length(1.25 * span * max(held, slab.extent))
    occupancy = min(span * slab.extent / n_time, 0.95)
    slow = Axis(recovery.time.start, span / n_time, n_time)
    focused = _trace_azimuth(straight, phases)
    first, last = float(focused.time.min()), float(focused.time.max())
    guard = 0.05 * duration
    begin, end = min(first - guard, slow.start), max(last + guard, slow.start + recovery.pulses.extent)
    n_padded = max(fourier.fast_length((end - begin) / slow.step), n_time)
    long_time = Axis(min(begin, slow.start), slow.step, n_padded)
    doppler = fourier.dual(slow, size=n_padded, centre=(min(bands) + max(bands)) / 2)

    spots = focus(focused)
    image_centre = float((spots.doppler.min() + spots.doppler.max()) / 2)
    image_doppler = fourier.dual(long_time, size=n_padded, centre=image_centre)
    row_taps = (taps_needed(collection.n_range_frequency / period, error=TAP_ERROR), collection.n_range_frequency / period)
    reach = (row_taps[0] / 2 + 2) * row_step
    nearest, farthest = float(spots.range.min()) - reach, float(spots.range.max()) + reach
    rows = Axis(nearest, row_step, min(int(np.ceil((farthest - nearest) / row_step)) + 1, period))
    fine_range = near + (far - near) * (1 - np.cos(np.pi * np.arange(13) / 12)) / 2
    fine_yaw = low + (high - low) * (1 - np.cos(np.pi * np.arange(33) / 32)) / 2
    range_chain = range_steps(slow, occupancy, rows, period)
    fine = recovered_line(
        geometry, epoch_range=fine_range[:, None], yaw=fine_yaw, origin=recovery.origin, walk=recovery.walk
    )
    for step in range_chain:
        fine = step.trace(fine)
    fine = _trace_azimuth(fine, phases)
    found = focus(fine)
    gate = _plan_gate(geometry, fine, found, fine_yaw, rows=rows, slow=long_time) if collection.steered else None
    final = DopplerTransform(time=long_time, doppler=image_doppler, rows=rows, gate=gate)
    image_doppler = final.image_doppler
    common = None if gate is None else gate.common
    local = _local_occupancy(fine, found, common, image_doppler)
    doppler_taps = (taps_needed(local, error=TAP_ERROR), local)
    chain = (
        *range_chain,
        Perturbation(time=slow, doppler=doppler, rows=rows, time_phase=phases.time, doppler_phase=phases.doppler),
        Deramp(doppler=doppler, time=long_time, rows=rows, phases=phases.deramp),
        final,
    )
    offset, doppler_focus, phase, gain, dwell_time = surfaces(
        found, epoch_range=fine_range, yaw=fine_yaw, origin=recovery.origin, carrier=fc, degree=(9, 16)
    )
    yaw_axis = np.linspace(low, high, YAW_STEPS)
    near_limit, far_limit = region.at(yaw_axis)
    ground = GroundMap(
        geometry=geometry, low=low, high=high, near=near, far=far, origin=recovery.origin, rows=rows,
        doppler=image_doppler, range_offset=offset, doppler_focus=doppler_focus, phase=phase, gain=gain,
        time=dwell_time, common=common, yaw_axis=yaw_axis, near_limit=near_limit, far_limit=far_limit,
        lit=lit_pulses(collection, yaw_axis, np.ones(collection.n_pulse)),
        scale=collection.n_range_frequency / period, range_taps=row_taps, doppler_taps=doppler_taps,
    )  # fmt: skip
    prediction = _predict(fine, found, fine_range, fine_yaw, range_cell, geometry)
    memory = _memory(
        n_frequency=collection.n_range_frequency, n_bin=slab.size, n_time=n_time, n_row=rows.size, n_padded=n_padded,
        n_image=image_doppler.size,
    )  # fmt: skip
    return BlockPlan(
        index=index, low=low, high=high, first_bin=first_bin, n_bin=slab.size, chain=chain, ground=ground,
        prediction=prediction, memory=memory, bias=bias,
    )  # fmt: skip


def _plan_gate(geometry: Geometry, line: Line, found: Focus, yaw: FloatArray, *, rows: Axis, slow: Axis) -> DwellGate:
    """The gate that follows the middles of the dwells along Doppler, from lines (n_range, n_yaw) with full dwell.

    Targets whose dwell the ends of the collection cut are gated as if it went on.
    """
    weight = line.weight * line.stretch
    lengths = weight.sum(axis=-1)
    middles = (weight * line.time).sum(axis=-1) / lengths
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
    length = float(np.median(lengths[:, full]))
    _, own, _ = phase.evaluate(found.range, found.doppler[..., None])
    _, shared, _ = common.evaluate(found.range, found.doppler[..., None])
    apart = float(np.abs(own - shared).max())
    size = min(fourier.fast_length((GATE_ROOM * length + 2 * apart) / slow.step), slow.size)
    return DwellGate(
        phase=phase, common=common, slope=slope, length=length, time=fourier.centred(0.0, slow.step, size)
    )


def _local_occupancy(line: Line, found: Focus, common: RowPhase | None, doppler: Axis) -> float:
    """Part of the sampling that a target's response fills along Doppler once its own carrier is out."""
    reach = np.abs(line.time - found.time[..., None]).max()
    return float(min(2.2 * reach * doppler.step, 0.9))


def _trace_azimuth(line: Line, phases: AzimuthPhases) -> Line:
    row = line.range.mean(axis=-1)
    line = line.multiply_time(*phases.time.evaluate(row, line.time))
    line = line.multiply_doppler(*phases.doppler.evaluate(row, line.doppler))
    return line.multiply_time(*phases.deramp.evaluate(row, line.time))


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


def _pick(values: FloatArray, which: Any, size: int) -> FloatArray:
    return values[which] if values.shape[0] == size else values


def lit_pulses(collection: Collection, yaw: FloatArray, valid: FloatArray) -> FloatArray:
    """Number of lit pulses at each yaw, missing ones left out: sum of `valid` (n_pulse,) over the dwell."""
    total = np.concatenate([[0.0], np.cumsum(valid)])
    if collection.beam_width is None:
        return np.full(yaw.shape, total[-1])
    beam = collection.beam_azimuth
    middle = (beam[0] + beam[-1]) / 2
    turn = middle + np.mod(yaw - middle + np.pi, 2 * np.pi) - np.pi
    sign = 1.0 if beam[-1] >= beam[0] else -1.0
    half = collection.beam_width / 2
    first = np.searchsorted(sign * beam, sign * turn - half, side="left")
    last = np.searchsorted(sign * beam, sign * turn + half, side="right")
    return total[last] - total[first]


def _predict(
    line: Line, found: Focus, rng: FloatArray, yaw: FloatArray, range_cell: float, geometry: Geometry
) -> Prediction:
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
    pairs = [a + b for a, b in zip(sizes, sizes[1:], strict=False)]
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

    def within_budget(self) -> bool:
        worst = [(b.prediction.residual_phase, b.prediction.migration) for b in self.blocks]
        return all(phase <= PHASE_BUDGET and migration <= MIGRATION_BUDGET for phase, migration in worst)


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
    extent = _grid_extent(geometry, region, grid)
    if blocks != "auto":
        plan = _plan_blocks(geometry, region, recovery, grid, extent, blocks, coefficients)
        _check_memory(plan, memory_limit)
        return plan
    plan = None
    for count in range(max(workers, 1), MAX_BLOCKS + 1):
        plan = _plan_blocks(geometry, region, recovery, grid, extent, count, coefficients)
        fits = memory_limit is None or plan.memory <= MEMORY_SHARE * memory_limit
        if plan.refusal is not None or (plan.within_budget() and fits):
            return plan
        # More blocks than this bring nothing once they are within budget but for memory or a hard geometry.
        if plan.within_budget() and not fits and plan.memory - PROCESS_MEMORY < 2 * recovery.pulses.size * 8:
            break
    assert plan is not None
    _check_memory(plan, memory_limit)
    return plan


def _check_memory(plan: Plan, memory_limit: int | None) -> None:
    if memory_limit is not None and plan.memory > MEMORY_SHARE * memory_limit:
        mib = 2**20
        raise InputError(
            f"memory limit {memory_limit / mib:.0f} MiB a worker is too low for {plan.n_blocks} blocks, which need "
            f"{plan.memory / MEMORY_SHARE / mib:.0f} MiB; raise --memory-limit, ask for more --blocks, or image a "
            "smaller grid"
        )


def default_grid(geometry: Geometry, region: Region) -> Grid:
    """The box around the lit sector, at about half the resolution of its centre, on round coordinates."""
    yaw = np.concatenate([region.yaw, region.yaw])
    point = geometry.ground_point(np.concatenate([region.near, region.far]), yaw)
    x, y = point[:, 0], point[:, 1]
    middle = region.yaw.size // 2
    centre = (region.near[middle] + region.far[middle]) / 2
    range_width, azimuth_width = ground_resolution(geometry, centre, float(region.yaw[middle]))
    step = _round_step(min(range_width, azimuth_width) / 2)

    def box(values: FloatArray) -> tuple[float, float, float]:
        return float(np.floor(values.min() / step) * step), float(np.ceil(values.max() / step + 1) * step), step

    x0, x1, dx = box(x)
    y0, y1, dy = box(y)
    return Grid(x0, x1, dx, y0, y1, dy)


def _round_step(value: float) -> float:
    """The nearest of 1, 1.5, 2, 3, 5, 7 times a power of ten."""
    decade = 10.0 ** np.floor(np.log10(value))
    steps = decade * np.array([1.0, 1.5, 2.0, 3.0, 5.0, 7.0, 10.0])
    return float(f"{steps[np.argmin(np.abs(np.log(steps / value)))]:.3g}")


def ground_resolution(geometry: Geometry, epoch_range: float, yaw: float) -> tuple[float, float]:
    """-3 dB widths on the ground of a target with its own dwell: across iso-range lines, and along them, m."""
    collection = geometry.collection
    point = geometry.ground_point(np.array(epoch_range), np.array(yaw))
    ends = np.array(geometry.dwell(np.array(yaw)))
    sight = point - geometry.track.position(ends)
    gradient = (sight / np.linalg.norm(sight, axis=1, keepdims=True))[:, :2]
    mean = gradient.mean(axis=0)
    along = np.array([-mean[1], mean[0]]) / np.linalg.norm(mean)
    turned = abs(float((gradient[1] - gradient[0]) @ along))
    azimuth = SINC_WIDTH * collection.wavelength / 2 / max(turned, 1e-12)
    return SINC_WIDTH * SPEED_OF_LIGHT / (2 * collection.bandwidth) / float(np.linalg.norm(mean)), azimuth


class _Extent(NamedTuple):
    """Yaw and epoch range that a grid reaches, clipped to the region."""

    low: float
    high: float
    near: float
    far: float


def _grid_extent(geometry: Geometry, region: Region, grid: Grid) -> _Extent:
    x, y = _outline(grid)
    inside_x = np.linspace(grid.x[0], grid.x[-1], 65)
    inside_y = np.linspace(grid.y[0], grid.y[-1], 65)
    mesh_x, mesh_y = (m.ravel() for m in np.meshgrid(inside_x, inside_y))
    x, y = np.concatenate([x, mesh_x]), np.concatenate([y, mesh_y])
    middle = (region.yaw[0] + region.yaw[-1]) / 2
    turn = geometry.yaw(x, y) - middle
    yaw = middle + turn - 2 * np.pi * np.rint(turn / (2 * np.pi))
    rng = geometry.epoch_range(x, y)
    near, far = region.at(yaw)
    covered = (yaw >= region.yaw[0]) & (yaw <= region.yaw[-1]) & (rng >= near) & (rng <= far)
    step = np.hypot((grid.x[-1] - grid.x[0]) / 64, (grid.y[-1] - grid.y[0]) / 64)
    if not covered.any():
        degrees = np.degrees([yaw.min(), yaw.max(), region.yaw[0], region.yaw[-1]])
        raise InputError(
            f"grid {grid.x0:g}:{grid.x1:g},{grid.y0:g}:{grid.y1:g} lies outside the swath: it spans yaw "
            f"{degrees[0]:.2f} .. {degrees[1]:.2f} degrees and range {rng.min():.0f} .. {rng.max():.0f} m, but lit are "
            f"{degrees[2]:.2f} .. {degrees[3]:.2f} degrees and {region.near.min():.0f} .. {region.far.max():.0f} m; "
            "move the grid"
        )
    slack = step / np.hypot(x - geometry.nadir[0], y - geometry.nadir[1])[covered].min()
    return _Extent(
        low=max(float(yaw[covered].min() - slack), float(region.yaw[0])),
        high=min(float(yaw[covered].max() + slack), float(region.yaw[-1])),
        near=float(rng[covered].min() - step),
        far=float(rng[covered].max() + step),
    )


def block_seams(geometry: Geometry, region: Region, count: int) -> FloatArray:
    """Yaws (count + 1,) between which blocks lie, rad, ascending.

    A steered collection's steering interval is divided evenly (paper A, Figure 7); the first and last block
    reach to the ends of what is lit. One that is not steered is divided evenly from end to end.
    """
    collection = geometry.collection
    low, high = region.yaw[0], region.yaw[-1]
    if not collection.steered or np.ptp(collection.beam_azimuth) == 0:
        return np.linspace(low, high, count + 1)
    seams = np.linspace(collection.beam_azimuth.min(), collection.beam_azimuth.max(), count + 1)
    seams[0], seams[-1] = low, high
    return seams


def _plan_blocks(
    geometry: Geometry,
    region: Region,
    recovery: Recovery,
    grid: Grid,
    extent: _Extent,
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
                f"{slope.max() * np.pi / 180:.3g} Hz a degree of yaw, through zero, so yaws cannot be told apart; image "
                "ground away from the direction of flight, or use --processor backprojection"
            )
        if coefficients == "fitted" and not block.prediction.residual_phase < np.pi / 2:
            return (
                f"block {block.index} (yaw {np.degrees(block.low):.2f} .. {np.degrees(block.high):.2f} degrees) would "
                f"keep a phase error of {block.prediction.residual_phase:.3g} rad over the dwell; ask for more --blocks, "
                "or use --processor backprojection"
            )
    return None
