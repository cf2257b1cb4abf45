"""Plan one angular block: slab, chain of steps, coefficients, sampling, dwell gate and ground map.

The dwell gate follows the lines of targets. The ground map leads from the ground to the focused block, to where those
lines focus; on a terrain also by height.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev

from blocksar import solvers
from blocksar.arrays import BoolArray, FloatArray
from blocksar.chunks import DOPPLER_GROUP
from blocksar.collection.collection import Collection
from blocksar.collection.geometry import Geometry
from blocksar.collection.weighting import AxisTaper, Taper
from blocksar.constants import SPEED_OF_LIGHT
from blocksar.errors import OutsideSwath
from blocksar.focusing.chains import steps_of
from blocksar.focusing.dwell_gate import DwellGate, DwellTaper, HalfDwell
from blocksar.focusing.ground_map import YAW_STEPS, GroundMap, NodeHeights, by_range, straighten, surfaces
from blocksar.focusing.lines import LEAST_STRETCH, Focus, Line, RowPolynomial
from blocksar.focusing.method import Method
from blocksar.focusing.range_gate import RangeGate
from blocksar.focusing.step import Constants, Sampling, Stage, Step, stages
from blocksar.focusing.surfaces import Surface, fit_surface
from blocksar.kernels import fourier
from blocksar.kernels.fourier import Axis
from blocksar.kernels.interpolation import taps_needed
from blocksar.planning.binding import RESAMPLING_ORDERS, AzimuthPart, RangePart, Slab, plan_motion, plan_range_gate
from blocksar.planning.block_lines import (
    MORE_RANGES,
    CoarseLines,
    FineLines,
    common_ranges,
    follow_terrain,
    lit_beside,
    retrace,
    trace_finely,
    under_tiles,
)
from blocksar.planning.block_sampling import plan_sampling, plan_slab, range_scale
from blocksar.planning.coefficients import Choice, choose
from blocksar.planning.dwell_ends import ImageEdges, LitTimes, Moments, band_spread, end_lift, end_smear, gate_blur
from blocksar.planning.dwell_weights import beam_moves
from blocksar.planning.memory import RELIEF_MEMORY, block_memory
from blocksar.planning.prediction import JudgedTargets, Prediction, predict, worst_lobes
from blocksar.planning.relief import FINE_DEGREE, Layer, Relief, map_relief, turns_of
from blocksar.planning.sector import Sector
from blocksar.planning.target_lines import TracedTargets, tail_margin

RANGE_DEGREE, YAW_DEGREE = 0.75, 16  # of what the map knows, along range for each node, and along yaw
MISS_SHARE = 0.1  # of the coherence that may be lost, which the map may miss before lines at more ranges are traced
SWING = 2e-3  # cycles by which a series of that degree along yaw may miss the phase on a track that wobbles
REGION_STEPS, LEAST_STEPS = 64 * YAW_STEPS, 128  # of yaw over the region, in which a block has its share; at least
STEPS_BY_RANGE = 512  # of yaw, where the sum over lit pulses is a table over range and yaw


def plan_ground(sector: Sector, azimuth: AzimuthPart, sampling: Sampling, lines: FineLines) -> GroundMap:
    """The map of a block with its sampling; lines (n_range, n_yaw) are through the whole chain."""
    ground = _on_smooth_ground(sector, sampling, lines)
    return ground if sector.relief is None else _raise(sector, sector.relief, azimuth, ground, lines)


def _on_smooth_ground(sector: Sector, sampling: Sampling, lines: FineLines) -> GroundMap:
    collection, z = sector.geometry.collection, sector.geometry.collection.ground_height
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
    """Surfaces of the map over range and yaw, from the places where lines focus."""
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


def _raise(sector: Sector, relief: Relief, azimuth: AzimuthPart, ground: GroundMap, lines: FineLines) -> GroundMap:
    """The map with the terrain's heights, from lines over the smooth ground at several heights."""
    geometry, rng, yaw = sector.geometry, lines.epoch_range, lines.yaw
    layers = [_layer(sector, azimuth, lines, relief.over(geometry, offset)) for offset in relief.offsets.tolist()]
    turns = []
    if geometry.collection.has_axis:
        turns = [turns_of(layer.geometry, geometry, rng, yaw) for layer in layers]
        ground = ground.widened(sector.region, float(np.abs(turns).max()))
    by_height = map_relief(
        relief, layers, lambda spots: _surfaces(sector, lines, spots), along=sector.ground_range, yaw=yaw,
        degree=_degree(sector, lines), turns=turns,
    )  # fmt: skip
    return replace(ground, relief=by_height, levels=(relief.lowest, relief.highest))


def _usual_layers(
    sector: Sector, relief: Relief, azimuth: AzimuthPart, lines: FineLines
) -> tuple[list[Layer], BoolArray]:
    """Lines of targets at usual heights of a terrain, low ones and high ones, and where (n_range, n_yaw) there are any.

    Heights are over the finer smooth ground.
    """
    shape = lines.epoch_range.size, lines.yaw.size
    usual, known = relief.usual(*shape)
    grounds = (
        sector.geometry.over(None, NodeHeights(smooth=relief.fine, over=heights))
        for heights in (usual, *relief.usual_ends(*shape))
    )
    layers = [_layer(sector, azimuth, lines, ground) for ground in grounds]
    return layers, known if known.any() else np.ones_like(known)


def _layer(sector: Sector, azimuth: AzimuthPart, lines: FineLines, geometry: Geometry) -> Layer:
    """The lines of targets on another ground, straightened, with the weights of their dwells."""
    line, rate = retrace(replace(sector, geometry=geometry), azimuth, lines)
    summed = lines.weights.weigh_chain(line)
    straight, bend, spots = straighten(summed, lambda spots: _carrier_time(sector, lines, spots))
    return Layer(geometry, replace(straight, weight=line.weight), bend, spots, rate)


LENGTHS, MOST_LENGTHS = {1e-3: 1, 0.04: 2, 0.15: 3}, 4  # windows by the relative spread of the halves' lengths
MOST_SPREAD = 1.6  # the longest half over the shortest, between which so many windows are blended


def divide_dwells(times: LitTimes, ends: Moments, middle: FloatArray) -> Moments:
    """Lengths of both halves of the dwells that begin and end at `ends` after all steps, (n_range, n_yaw), s.

    The beam's centre passes targets at the moment `middle`, s from the epoch.
    """
    divide = times.after(middle)
    return divide - ends[0], ends[1] - divide


def plan_taper(
    taper: Taper, halves: Sequence[FloatArray], lengths: Sequence[RowPolynomial], *, full: BoolArray
) -> DwellTaper:
    """The taper over dwells with halves of these lengths (n_range, n_yaw), s, which polynomials fit."""
    begin, end = (
        HalfDwell(length=length, lengths=_window_lengths(*_blended(half, full)))
        for half, length in zip(halves, lengths, strict=True)
    )
    return DwellTaper(taper=taper, begin=begin, end=end)


def _blended(lengths: FloatArray, full: BoolArray) -> tuple[float, float]:
    """Shortest and longest half for which windows are made, s.

    Where a beam turns slowly near the collection's ends, dwells that these cut may be several times as long as those
    with `full` dwell; windows for both would lie too far apart to be blended. Then they are made for full dwells, and
    for others as far as `MOST_SPREAD` reaches.
    """
    shortest, longest = float(lengths.min()), float(lengths.max())
    if longest > MOST_SPREAD * shortest and full.any():
        least, most = float(lengths[full].min()), float(lengths[full].max())
        room = max(MOST_SPREAD * least / most, 1.0) ** 0.5
        shortest = max(shortest, least / room)
        longest = min(longest, max(most, MOST_SPREAD * shortest))
    return shortest, longest


def _window_lengths(shortest: float, longest: float) -> tuple[float, ...]:
    """So many lengths between two, s, that blending windows of them errs by less than a thousandth."""
    count = next((n for spread, n in LENGTHS.items() if longest <= (1 + spread) * shortest), MOST_LENGTHS)
    if count == 1:
        return ((shortest + longest) / 2,)
    return tuple(np.linspace(shortest, longest, count).tolist())


class RowFit(NamedTuple):
    """Where polynomials along rows lie: ranges, m, and the centre and scale of Doppler, Hz."""

    near: float
    far: float
    centre: float
    scale: float

    @classmethod
    def over(cls, rows: Axis, spots: Focus) -> RowFit:
        """Over the rows of an image, and the Doppler at which targets focus."""
        doppler = spots.doppler
        scale = max(float(np.ptp(doppler) / 2), 1e-6)
        centre = float((doppler.min() + doppler.max()) / 2)
        return cls(rows.start, rows.start + rows.extent, centre=centre, scale=scale)

    def polynomial(self, series: FloatArray) -> RowPolynomial:
        return RowPolynomial(series=series, near=self.near, far=self.far, centre=self.centre, scale=self.scale)

    def fit(self, spots: Focus, values: FloatArray, degrees: tuple[int, int]) -> list[FloatArray]:
        """Fit values (n, n_range, n_yaw), s, where targets focus: series in range of powers of z, one for each."""
        u = (2 * spots.range.ravel() - self.near - self.far) / (self.far - self.near)
        z = (spots.doppler.ravel() - self.centre) / self.scale
        basis = np.asarray(chebyshev.chebvander2d(u, z, degrees).T, np.float64)
        fitted = solvers.least_squares(basis, values.reshape(values.shape[0], -1), damping=1e-20 * u.size)
        shape = degrees[0] + 1, degrees[1] + 1
        return [solvers.product(row.reshape(shape), _to_powers(degrees[1])) for row in fitted.T]

    def fit_amid(self, rng: FloatArray, values: FloatArray, which: BoolArray, *, degree: int) -> FloatArray:
        """Fit a series in range amid those of values (n_range, n_yaw) at each range that are chosen by `which`."""
        whole = which.any(axis=1)
        rows = [(values[i, which[i]], rng[i, which[i]].mean()) for i in np.flatnonzero(whole)]
        u = np.array([(2 * mean - self.near - self.far) / (self.far - self.near) for _, mean in rows])
        middles = np.array([(row.min() + row.max()) / 2 for row, _ in rows])
        terms = chebyshev.chebvander(u, min(degree, (len(rows) - 1) // 2)).T
        return np.asarray(solvers.least_squares(terms, middles, damping=1e-20 * u.size))

    def integral(self, series: FloatArray) -> RowPolynomial:
        """The polynomial whose derivative has these coefficients (n, order + 1): cycles."""
        integral = np.zeros((series.shape[0], series.shape[1] + 1))
        integral[:, 1:] = series / np.arange(1, series.shape[1] + 1) * self.scale
        return self.polynomial(integral)

    def slope(self, series: FloatArray) -> RowPolynomial:
        """The linear coefficient, per Hz."""
        return self.polynomial(series[:, 1:2] / self.scale)


@lru_cache
def _to_powers(most: int) -> FloatArray:
    """Power coefficients of the Chebyshev polynomials of degrees 0 .. most, one a row; read-only."""
    powers = np.zeros((most + 1, most + 1))
    for degree, row in enumerate(np.eye(most + 1)):
        powers[degree, : degree + 1] = chebyshev.cheb2poly(row[: degree + 1])
    powers.flags.writeable = False
    return powers


# Dwells that the sampling in Doppler has room for; of a look it needs room for what the whole beam lights, which would
# wrap into it.
GATE_ROOM = 1.62
GATE_DEGREES = 4, 5  # of the ends of dwells in range and in Doppler
LEAST_SPREAD = 0.02  # of the longest dwell: where the middles of dwells differ by less, no gate separates them


def plan_dwell_gate(sector: Sector, sampling: Sampling, lines: FineLines, beside: FineLines | None) -> DwellGate | None:
    """The gate that follows the ends of the dwells along Doppler.

    It follows those of the lines, and `beside` the block too where that has some (`block_lines.lit_beside`).

    Dwells that the ends of the collection cut are gated as if they continued: nothing lies beyond. None where all is
    lit all the time, and where all targets dwell at the same time: a gate could not separate them. Without a gate the
    sum over time is that over the pulses, however the steps in Doppler smear the collection's ends.
    """
    if not beam_moves(sector.geometry.collection):
        return None
    line, spots, taper = lines.line, lines.spots, sector.taper
    weighed = not taper.uniform

    dwells = _dwells_of(lines, weighed=weighed)
    begins, ends = dwells.ends
    lengths = ends - begins
    if np.ptp((begins + ends) / 2) < LEAST_SPREAD * lengths.max() and not weighed:  # a taper needs its windows anyway
        return None

    # Both ends and the lengths of halves along Doppler; phases that move the ends, and all dwells, to t = 0.
    length, followed = float(lengths.mean()), lines if beside is None else beside
    fit = RowFit.over(sampling.rows, followed.spots)
    shown = dwells if beside is None else _dwells_of(beside, weighed=weighed)
    begin, end, *fitted = _fit_ends(sector, fit, followed.spots, shown, length=length)
    phases = fit.integral(begin), fit.integral(end)
    at_middle = fit.integral((begin + end) / 2).coefficients(np.array((fit.near + fit.far) / 2))[None]
    common = fit.polynomial(at_middle)

    # The smear that the windows have to have, and the time that they need.
    (_, shared, _), *along = (each.evaluate(spots.range, spots.doppler[..., None]) for each in (common, *phases))
    apart = max(float(np.abs(at - shared).max()) for _, at, _ in along)
    smear = end_smear(line, lines.ends.rate)
    begin_slope, end_slope = (
        _end_slope(fit, series, lines, smear[..., i] + along[i][2][..., 0]) for i, series in enumerate((begin, end))
    )
    room = GATE_ROOM * length
    if (whole := sector.geometry.collection.lit_widths) > 1:
        room = max(room, length * (GATE_ROOM / 2 + whole))
    size = min(fourier.fast_length((room + 2 * apart) / sampling.long_time.step), sampling.long_time.size)

    polynomials = [fit.polynomial(series) for series in fitted]
    spread = band_spread(sector.geometry.collection, lines.ends.uncut, scaled_about=lines.ends.scaled_about)
    blur = gate_blur(sector.geometry.collection, spread)
    return DwellGate(
        begin=phases[0],
        end=phases[1],
        common=common,
        begin_slope=begin_slope,
        end_slope=end_slope,
        blur=blur,
        lift=end_lift(blur, spread, sector.weighting.range),
        length=length,
        time=fourier.centred(0.0, sampling.long_time.step, size),
        taper=plan_taper(taper, dwells.halves, polynomials, full=lines.ends.full) if weighed else None,
    )


class _Dwells(NamedTuple):
    """Dwells of lines after all steps, (n_range, n_yaw), s."""

    ends: Moments  # uncut
    halves: tuple[FloatArray, ...]  # the lengths of both halves, where dwells are weighed


def _dwells_of(lines: FineLines, *, weighed: bool) -> _Dwells:
    times, uncut, middle = LitTimes.of(lines.lit, lines.line), lines.ends.uncut, lines.ends.passing
    ends = times.ends(uncut)
    middle = (uncut[0] + uncut[1]) / 2 if middle is None else middle
    return _Dwells(ends, divide_dwells(times, ends, middle) if weighed else ())


def _fit_ends(sector: Sector, fit: RowFit, spots: Focus, dwells: _Dwells, *, length: float) -> list[FloatArray]:
    """Fit begins and ends, and under a weighting the lengths of halves: (2 or 4, n_range, n_yaw), s."""
    degree = FINE_DEGREE if sector.gates_by_height else GATE_DEGREES
    begins, ends = dwells.ends
    return fit.fit(spots, np.stack([begins + length / 2, ends - length / 2, *dwells.halves]), degree)


def _end_slope(fit: RowFit, series: FloatArray, lines: FineLines, slopes: FloatArray) -> RowPolynomial:
    """Slope of an end in Doppler with which its window is made, s/Hz.

    At each range it lies amid those of the targets with full dwell there, `slopes`, their smear included.
    """
    slope, spots = fit.slope(series), lines.spots
    left = slopes - slope.coefficients(spots.range)[..., 0]
    amid = fit.fit_amid(spots.range, left, lines.ends.full, degree=GATE_DEGREES[0])
    slope.series[: amid.size, 0] += amid
    return slope


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
    """Constants of the block that its steps bind."""
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
    targets, reached = lines.targets(sector.geometry), None
    layers: list[Layer] = []
    if sector.relief is not None:
        layers, reached = _usual_layers(sector, sector.relief, azimuth, lines)
        targets = _on(targets, layers[0])
    imaged = _imaged(sector, lines)
    predicted = predict(
        targets, sampling.gate, reached=reached, imaged=imaged, band=sector.weighting.range,
    )  # fmt: skip
    for layer in layers[1:]:
        others = _on(targets, layer)
        judged = JudgedTargets.of(others, reached, imaged)
        predicted = predicted.or_lobes(worst_lobes(others, sampling.gate, judged, band=sector.weighting.range))
    seen = np.logical_and.reduce([lines.ends.full, *(each.held for each in imaged)])
    seen = seen if reached is None else seen & reached
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
