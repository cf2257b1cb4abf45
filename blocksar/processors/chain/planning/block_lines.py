"""Time-frequency lines of a block's targets: coarse ones to plan the chain, fine ones through the whole chain.

Coarse lines go as far as range compression. They tell the block's part of the spectrum, the coefficients of its steps
and how its samples are spaced. Fine lines tell the dwell gate, where each target focuses and how sharp it becomes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from blocksar import solvers
from blocksar.arrays import BoolArray, FloatArray
from blocksar.collection.geometry import Geometry
from blocksar.processors.chain.dwells.dwell_ends import Moments, band_moves, dwell_ends, full_dwells
from blocksar.processors.chain.dwells.dwell_weights import DwellWeights, dwell_weights, level_aperture, levelled
from blocksar.processors.chain.dwells.steadiness import scans_evenly
from blocksar.processors.chain.dwells.target_lines import NODES_PER_INTERVAL, Dwells, Sector
from blocksar.processors.chain.ground.ground_map import tile_extent
from blocksar.processors.chain.planning.binding import AzimuthPart
from blocksar.processors.chain.steps.lines import LEAST_STRETCH, Focus, Line, focus


def nodes_between(low: float, high: float, count: int) -> FloatArray:
    """Chebyshev end nodes (`solvers.end_nodes`) scaled to low .. high."""
    return low + (high - low) * (1 + solvers.end_nodes(count)) / 2


def common_ranges(
    trace: Callable[[FloatArray], Line], line: Line, nodes: FloatArray, *, origin: float, least: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Apparent ranges that span those of lines (n_range, n_yaw), and the epoch range of the target at each, by yaw.

    Targets of one output row share its coefficients but not always the range at the epoch: correcting range curvature
    at a target's own Doppler moves the target by that curvature (paper C, below (5)). No epoch range is below
    `least`, m.

    Returns
    -------
    ranges : (n_range,) m from the origin, ascending
    epoch_range : (n_range, n_yaw) m
    """
    apparent = line.range.mean(axis=-1)  # (n_range, n_yaw)
    ranges = nodes_between(float(apparent.min()), float(apparent.max()), nodes.size)
    # Between the nodes of each yaw; then a step with the targets' own lines, for those beyond the nodes.
    epoch_range = np.stack([np.interp(ranges, column, nodes) for column in apparent.T], axis=1)
    epoch_range = epoch_range + ranges[:, None] - trace(epoch_range).range.mean(axis=-1)
    return ranges, np.maximum(epoch_range, least)


COARSE_NODES = 9, 15  # along range and yaw
FINE_NODES, MORE_RANGES = (13, 33), 25
MOST_YAWS = 129  # of fine lines, where a spline's intervals pass from yaw to yaw
MOST_WIDER = 2.0  # times as many yaws, where lines go on beyond a block
FOLDED = 1.0  # octaves of stretch, of lines that are not followed


class CoarseLines(NamedTuple):
    """Lines (n_range, n_yaw) in the recovered signal."""

    line: Line
    everywhere: Line  # on a terrain also those of the lowest and of the highest targets
    nodes: FloatArray  # (n_range,) epoch ranges, m
    dwells: Dwells  # at yaws (n_yaw,)

    @classmethod
    def of(cls, sector: Sector) -> CoarseLines:
        """Trace the lines of the targets of a sector."""
        n_range, n_yaw = COARSE_NODES
        nodes, yaw = nodes_between(sector.near, sector.far, n_range), np.linspace(sector.low, sector.high, n_yaw)
        dwells = sector.dwells(yaw, coarsely=True)
        line = dwells.lines(nodes[:, None])
        if sector.relief is None:
            return cls(line, line, nodes, dwells)
        grounds = (sector.relief.over(sector.geometry, z) for z in (sector.relief.low, sector.relief.high))
        ends = (replace(sector, geometry=ground).dwells(yaw, like=line) for ground in grounds)
        return cls(line, _stacked([line, *(each.lines(nodes[:, None]) for each in ends)]), nodes, dwells)

    @property
    def duration(self) -> float:
        """The longest dwell, s."""
        return float(self.line.weight.sum(axis=-1).max())


def _stacked(lines: list[Line]) -> Line:
    """Concatenate lines (n_range, n_yaw, n) along the first axis."""
    shape = lines[0].time.shape
    return Line(
        **{
            name: np.concatenate([np.broadcast_to(getattr(line, name), shape) for line in lines])
            for name in Line.__dataclass_fields__
        }
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class TracedTargets:
    """Targets at epoch ranges (n_range,) and yaws (n_yaw,), traced through a whole chain.

    Attributes
    ----------
    geometry : Geometry
        Its ground is the one on which they lie.
    epoch_range, yaw : (n_range,), (n_yaw,) float
        m and rad.
    lit, compressed, line : Line
        (n_range, n_yaw, n), before all steps, after range compression, and after all steps.
    spots : Focus
        (n_range, n_yaw), where and how the lines focus.
    weights : DwellWeights
        At the nodes of the lines.
    uncut : pair of (n_yaw,) or (n_range, n_yaw) float
        Slow time at which the dwells would begin and end if the collection did not cut them, s from the epoch.
    rate : (n_range, n_yaw, n) float
        The lines' Doppler rate before the steps in Doppler, Hz/s.
    scaled_about : float or None
        Time, s from the epoch, about which a keystone scales time with range frequency; None without one.
    moves : (n_range, n_yaw, n) float or None
        From `dwell_ends.band_moves`, s; None with a keystone.
    """

    geometry: Geometry
    epoch_range: FloatArray
    yaw: FloatArray
    lit: Line
    compressed: Line
    line: Line
    spots: Focus
    weights: DwellWeights
    uncut: Moments
    rate: FloatArray
    scaled_about: float | None
    moves: FloatArray | None

    @cached_property
    def full(self) -> BoolArray:
        """Mask (n_range, n_yaw) of targets that are lit over a full dwell: see `full_dwells`."""
        return full_dwells(self.line, self.geometry, self.epoch_range[:, None], self.yaw)

    @cached_property
    def passes(self) -> Moments:
        """Pulse times at which targets are first and last lit, (n_yaw,) or (n_range, n_yaw) s."""
        return self.geometry.beam.dwell_at(self.yaw, self.epoch_range[:, None])

    @cached_property
    def cut(self) -> BoolArray:
        """Mask of dwell ends that the collection cuts, beginning and end: (n_yaw, 2) or (n_range, n_yaw, 2)."""
        collection = self.geometry.collection
        return np.asarray(np.abs(np.stack(self.passes, axis=-1) - collection.time[[0, -1]]) < collection.pulse_interval)

    @cached_property
    def ends(self) -> Moments:
        """Times at which the dwells begin and end after all steps, (n_range, n_yaw) s."""
        return dwell_ends(self.line)

    @cached_property
    def uncut_ends(self) -> Moments:
        """Ends of dwells as in `ends`, if the collection did not cut them."""
        (first, last), (begin, end), stretch = dwell_ends(self.lit), self.ends, self.line.stretch
        return begin - (first - self.uncut[0]) * stretch[..., 0], end + (self.uncut[1] - last) * stretch[..., -1]

    def after(self, moment: FloatArray) -> FloatArray:
        """Times (n_range, n_yaw), s, after all steps, of one moment of each target; linear beyond dwells."""
        first, last = dwell_ends(self.lit)
        n, stretch = self.line.time.shape[-1], self.line.stretch
        u = (2 * np.clip(moment, first, last) - first - last) / (last - first)
        series = solvers.product(self.line.time, solvers.legendre_series(n, n - 1).T)
        time = np.asarray(np.polynomial.legendre.legval(u, np.moveaxis(series, -1, 0), tensor=False))
        before, beyond = np.minimum(moment - first, 0.0), np.maximum(moment - last, 0.0)
        return np.asarray(time + before * stretch[..., 0] + beyond * stretch[..., -1])

    def moved(self, end: int) -> FloatArray:
        """Time by which relative range frequency moves the begin (0) or the end (-1) of dwells, s."""
        if self.moves is not None:
            return self.moves[..., end]
        if self.scaled_about is None:
            return np.zeros(self.yaw.shape)
        return np.asarray(self.passes[end] - self.geometry.epoch - self.scaled_about)


def trace_targets(
    sector: Sector, azimuth: AzimuthPart, epoch_range: FloatArray, yaw: FloatArray, *, ground: Geometry | None = None
) -> TracedTargets:
    """Trace targets at epoch ranges (n_range,), m, and yaws (n_yaw,), rad.

    With another `ground`, the lines are those of targets on that, and what weighs them is of the sector's.
    """
    geometry, part = sector.geometry, azimuth.range_part
    lit = replace(sector, geometry=ground or geometry).dwells(yaw).lines(epoch_range[:, None])
    compressed = part.trace(lit)
    biased, _, line = azimuth.trace(compressed)
    first, last = geometry.beam.dwell_at(yaw, epoch_range[:, None], uncut=True)
    uncut, about = (first - geometry.epoch, last - geometry.epoch), part.scales_time_about
    moves = band_moves(biased, biased.rate) if part.compression.in_doppler else None
    weights = dwell_weights(
        geometry, sector.taper, lit, uncut=uncut, epoch_range=epoch_range, yaw=yaw,
        lit_band=sector.lit_band(lit, uncut), moves=moves if about is None else lit.time - about,
    )  # fmt: skip
    line = line if part.constants.in_time is None else levelled(line, part.constants.in_time)
    return TracedTargets(
        geometry=geometry, epoch_range=epoch_range, yaw=yaw, lit=lit, compressed=compressed, line=line,
        spots=focus(weights.weigh_chain(line)), weights=weights, uncut=uncut, rate=biased.rate, scaled_about=about,
        moves=moves,
    )  # fmt: skip


def trace_finely(sector: Sector, azimuth: AzimuthPart, *, n_range: int = FINE_NODES[0]) -> TracedTargets:
    """Trace the targets of a sector as densely as its dwell gate, ground map and prediction need."""
    yaw = nodes_between(sector.low, sector.high, _fine_yaws(sector))
    return trace_targets(sector, azimuth, sector.ground_range.nodes(n_range), yaw)


def with_level_aperture(sector: Sector, azimuth: AzimuthPart) -> AzimuthPart:
    """Return the steps under a taper over pulses that levels the aperture; unchanged under a steered beam."""
    in_time = azimuth.range_part.constants.in_time
    if in_time is None:
        return azimuth
    return azimuth.weighed(level_aperture(trace_finely(sector, azimuth).line, in_time))


def _fine_yaws(sector: Sector) -> int:
    """Number of yaws of the fine lines: on a wobbling track, enough to follow it as the beam turns."""
    geometry = sector.geometry
    if geometry.track.wobble is None or not geometry.collection.steered:
        return FINE_NODES[1]
    first, last = geometry.beam.dwell_at(np.array([sector.low, sector.high]), np.array((sector.near + sector.far) / 2))
    passed = float(np.ptp(first + last)) / 2 / geometry.track.wobble.step
    return max(FINE_NODES[1], math.ceil(min(NODES_PER_INTERVAL * passed, MOST_YAWS)))


def under_tiles(sector: Sector, azimuth: AzimuthPart, lines: TracedTargets) -> TracedTargets:
    """Extend lines on a wobbling track as far beyond the block as its tiles of pixels reach; else unchanged.

    Tiles at its edge take what the map knows beyond it. Series of few terms can be asked there, but not those that
    follow the waves of a track.
    """
    if sector.geometry.track.wobble is None:
        return lines
    near = max(sector.near, sector.region.limits(sector.low, sector.high)[0])
    _, beyond = tile_extent(sector.geometry, sector.low, sector.high, near, sector.far)
    return _trace_wider(sector, azimuth, lines, sector.low - beyond, sector.high + beyond)


def lit_beside(sector: Sector, azimuth: AzimuthPart, lines: TracedTargets) -> TracedTargets:
    """Add lines of the targets lit beside the block, which its pixels also sum; unchanged where they suffice.

    A pixel also sums what its pulses have of other targets, gated as is right for the Doppler at which those focus.
    Windows with sharp ends make that count as far as the beam reaches, beyond the seams too. Ends of a beam that scans
    evenly hardly bend along Doppler and are extrapolated. Lines end before targets beside the block that fold, as its
    steps are not made for them.
    """
    collection, region = sector.geometry.collection, sector.region
    if sector.gates_by_height or scans_evenly(collection):
        return lines
    reach, middle = collection.beam_width or 0.0, (sector.near + sector.far) / 2
    if collection.has_axis:
        reach *= middle / float(sector.ground_range.on_ground(np.array(middle)))
    low = min(max(sector.low - reach, float(region.yaw[0])), sector.low)
    high = max(min(sector.high + reach, float(region.yaw[-1])), sector.high)
    wider = _trace_wider(sector, azimuth, lines, low, high)
    folds = (np.abs(np.log2(np.maximum(wider.line.stretch, LEAST_STRETCH))) > FOLDED).any(axis=(0, 2))
    if not folds.any():
        return wider
    before, behind = (np.flatnonzero(folds & outside) for outside in (wider.yaw < sector.low, wider.yaw > sector.high))
    first, last = before.max(initial=-1) + 1, behind.min(initial=wider.yaw.size) - 1
    ends = min(float(wider.yaw[first]), sector.low), max(float(wider.yaw[last]), sector.high)
    return _trace_wider(sector, azimuth, lines, *ends)


def _trace_wider(sector: Sector, azimuth: AzimuthPart, lines: TracedTargets, low: float, high: float) -> TracedTargets:
    """Trace at the same ranges and at yaws from low to high, rad, about as densely."""
    wider = (high - low) / (sector.high - sector.low)
    yaw = nodes_between(low, high, math.ceil(min(wider, MOST_WIDER) * lines.yaw.size))
    return trace_targets(sector, azimuth, lines.epoch_range, yaw)


def retrace(sector: Sector, azimuth: AzimuthPart, lines: TracedTargets, ground: Geometry) -> TracedTargets:
    """Trace targets at the same ranges and yaws on another ground, with the dwells and weights of the lines.

    With as many nodes, for the weights of their dwells are those of the lines: the longest dwell depends on the ground.
    """
    lit = replace(sector, geometry=ground).dwells(lines.yaw, like=lines.lit).lines(lines.epoch_range[:, None])
    biased, _, line = azimuth.trace(azimuth.range_part.trace(lit))
    in_time = azimuth.range_part.constants.in_time
    line = line if in_time is None else levelled(line, in_time)
    return replace(lines, geometry=ground, line=line, spots=focus(lines.weights.weigh_chain(line)), rate=biased.rate)
